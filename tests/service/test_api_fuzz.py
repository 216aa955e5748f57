"""schemathesis: every operation of the OpenAPI document with generated input, on real services.

The default run tries each operation a few times; `make soak` does so many times, and as nobody, as
a viewer, and as an operator.
"""

import re
import shutil
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import httpx
import pytest
import requests
import schemathesis
from attended_room import AttendedRoom, calibrated
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from lone_service import running_service
from schemathesis.checks import not_a_server_error
from schemathesis.specs.openapi.checks import (
    content_type_conformance,
    negative_data_rejection,
    response_schema_conformance,
    status_code_conformance,
    unsupported_method,
)

from service.client import RoomClient
from service.web.access import new_token, token_hash

PATIENCE_S = 300.0
_FEW, _MANY, _SLOW_ONES = 8, 150, 2
_NEGATIVE = schemathesis.GenerationMode.NEGATIVE
_CHECKS = [
    not_a_server_error,
    status_code_conformance,
    content_type_conformance,
    response_schema_conformance,
    negative_data_rejection,
    unsupported_method,
]
# their answers say 503 where no robot is linked: documented, and no failure of the server
_CHECKS_WITHOUT_ROBOT = _CHECKS[1:]
_LIVE = "/api/v1/events/live"
# made by a process of its own each: tried, but not hundreds of times
_SLOW = re.compile(r"^/api/v1/(report|export)$")
OPERATOR, VIEWER, EXPIRED = new_token(), new_token(), new_token()
_TOKENS = "\nlock_out_after = 1000000\n" + "".join(
    f'\n[[service.token]]\nname = "{name}"\nrole = "{role}"\nsha256 = "{token_hash(token)}"\n{more}'
    for name, role, token, more in (
        ("Olga", "operator", OPERATOR, ""),
        ("Victor", "viewer", VIEWER, ""),
        ("Eve", "operator", EXPIRED, "expires = 2020-01-01\n"),
    )
)


@pytest.fixture(scope="module")
def recorded(room: AttendedRoom) -> Path:
    with RoomClient(room.url) as client:
        calibrated(client)
    return room.folder


@contextmanager
def served_copy(recorded: Path, folder: Path, more: str = "") -> Iterator[str]:
    """A service without robot on a copy of a real case, so that there are slices to ask for."""
    (folder / "case").mkdir()
    for part in ("inbox", "images"):
        shutil.copytree(recorded / part, folder / "case" / part)
    for file in recorded.glob("case.sqlite*"):
        shutil.copy(file, folder / "case")
    with running_service(folder, more) as url:
        yield url


@pytest.fixture(scope="module")
def open_url(recorded: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    with served_copy(recorded, tmp_path_factory.mktemp("fuzzed")) as url:
        yield url


@pytest.fixture(scope="module")
def guarded_url(recorded: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    with served_copy(recorded, tmp_path_factory.mktemp("guarded"), _TOKENS) as url:
        yield url


Call = Callable[[Any], Any]


def as_nobody(case: Any) -> Any:
    return case.call(timeout=PATIENCE_S)


def with_token(token: str) -> Call:
    return lambda case: case.call(headers={"Authorization": f"Bearer {token}"}, timeout=PATIENCE_S)


def fuzz(url: str, examples: int, *callers: Call) -> list[str]:
    """Try every operation but the endless one, as one of the callers each time; what was wrong."""
    headers = {"Authorization": f"Bearer {OPERATOR}"}
    schema = schemathesis.openapi.from_url(f"{url}/api/v1/openapi.json", headers=headers)
    found = [one.ok() for one in schema.exclude(path=_LIVE).get_all_operations()]
    assert len(found) > 25
    assert {"/healthz", "/metrics", "/api/v1/export"} <= {one.path for one in found}
    return [text for operation in found if (text := fuzz_one(operation, examples, callers))]


def fuzz_one(operation: Any, examples: int, callers: tuple[Call, ...]) -> str:
    """Try one operation with many inputs; what was wrong, or an empty text."""
    checks = _CHECKS_WITHOUT_ROBOT if operation.path == "/healthz" else _CHECKS
    slow = _SLOW.match(operation.path)

    @settings(
        max_examples=min(examples, _SLOW_ONES) if slow else examples,
        deadline=None,
        suppress_health_check=list(HealthCheck),
    )
    @given(
        case=operation.as_strategy() | operation.as_strategy(generation_mode=_NEGATIVE),
        call=st.sampled_from(callers or (as_nobody,)),
    )
    def tried(case: Any, call: Call) -> None:
        case.validate_response(call(case), checks=checks)

    try:
        tried()
    except (schemathesis.errors.SchemathesisError, BaseExceptionGroup, AssertionError) as error:
        return f"{operation.label}: {error}"
    return ""


def test_no_input_makes_it_fail_and_every_answer_is_as_documented(open_url: str) -> None:
    failures = fuzz(open_url, _FEW)
    assert not failures, "\n\n".join(failures)


def test_whoever_asks_every_answer_is_as_documented(guarded_url: str) -> None:
    failures = fuzz(guarded_url, _FEW, *map(with_token, ("wrong", VIEWER, EXPIRED)))
    assert not failures, "\n\n".join(failures)


@pytest.mark.soak
@pytest.mark.parametrize(
    "token", [None, "wrong", VIEWER, OPERATOR], ids=["nobody", "wrong", "viewer", "operator"]
)
def test_no_input_makes_it_fail_in_many_tries(guarded_url: str, token: str | None) -> None:
    call = as_nobody if token is None else with_token(token)
    failures = fuzz(guarded_url, _MANY, call)
    assert not failures, "\n\n".join(failures)


@pytest.mark.soak
def test_no_input_makes_an_open_room_fail_in_many_tries(open_url: str) -> None:
    failures = fuzz(open_url, _MANY)
    assert not failures, "\n\n".join(failures)


_PRINTABLE = st.characters(min_codepoint=0x20, max_codepoint=0x7E)
_HEADER_TEXT = st.text(_PRINTABLE, max_size=60).map(str.strip)
_COOKIE = st.builds("autospine_session={}".format, _HEADER_TEXT)


@settings(max_examples=40, deadline=None, suppress_health_check=list(HealthCheck))
@given(
    said=st.one_of(
        _HEADER_TEXT,
        st.builds("Bearer {}".format, _HEADER_TEXT).map(str.strip),
        st.sampled_from([f"Bearer {VIEWER}x", f"Basic {VIEWER}", f"Bearer  {EXPIRED}", "Bearer"]),
    ),
    cookie=st.one_of(
        st.none(), _HEADER_TEXT, st.builds("autospine_session={}".format, _HEADER_TEXT)
    ),
)
def test_no_other_word_than_a_token_lets_in(
    guarded_url: str, said: str, cookie: str | None
) -> None:
    headers = {"Authorization": said, **({} if cookie is None else {"Cookie": cookie})}
    for method, path in (("GET", "/api/v1/state"), ("POST", "/api/v1/reset")):
        answer = httpx.request(method, guarded_url + path, headers=headers)
        assert answer.status_code == 401
        assert answer.json()["title"] == "unauthorized"


@settings(max_examples=25, deadline=None, suppress_health_check=list(HealthCheck))
@given(
    after=st.one_of(st.none(), st.integers(-5, 2**65), st.text("0123456789-x.", max_size=8)),
    last_id=st.one_of(st.none(), _HEADER_TEXT, st.integers(-5, 2**65).map(str)),
)
def test_the_event_stream_begins_with_a_state_or_is_refused(
    open_url: str, after: object, last_id: str | None
) -> None:
    """Read to its first state only: it has no end."""
    headers = {} if last_id is None else {"Last-Event-ID": last_id}
    params = {} if after is None else {"after": str(after)}
    with requests.get(
        open_url + _LIVE, params=params, headers=headers, stream=True, timeout=60
    ) as answer:
        if answer.status_code == 422:
            assert answer.headers["content-type"] == "application/problem+json"
            assert answer.json()["title"] == "invalid_request"
            return
        assert answer.status_code == 200
        assert answer.headers["content-type"].startswith("text/event-stream")
        with closing(answer.iter_lines()) as lines:
            assert any(line == b"event: state" for line in lines)
