"""schemathesis: every operation of the OpenAPI document with generated input, on a real service."""

import shutil
from collections.abc import Iterator
from typing import Any

import pytest
import schemathesis
from attended_room import AttendedRoom, calibrated
from hypothesis import HealthCheck, given, settings
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

_NEGATIVE = schemathesis.GenerationMode.NEGATIVE
_CHECKS = [
    not_a_server_error,
    status_code_conformance,
    content_type_conformance,
    response_schema_conformance,
    negative_data_rejection,
    unsupported_method,
]


@pytest.fixture(scope="module")
def api_schema(room: AttendedRoom, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    """A service without robot on a copy of a real case, so that there are slices to ask for."""
    with RoomClient(room.url) as client:
        calibrated(client)
    folder = tmp_path_factory.mktemp("fuzzed")
    (folder / "case").mkdir()
    for part in ("inbox", "images"):
        shutil.copytree(room.folder / part, folder / "case" / part)
    for file in room.folder.glob("case.sqlite*"):
        shutil.copy(file, folder / "case")
    with running_service(folder) as url:
        schema = schemathesis.openapi.from_url(f"{url}/api/v1/openapi.json")
        # the event stream has no end, and without a robot health is a 503: see test_api.py
        yield schema.exclude(path=["/api/v1/events/live", "/healthz"])


def test_no_input_makes_it_fail_and_every_answer_is_as_documented(api_schema: Any) -> None:
    operations = [found.ok() for found in api_schema.get_all_operations()]
    assert len(operations) > 20
    failures = [text for operation in operations if (text := _fuzz(operation))]
    assert not failures, "\n\n".join(failures)


def _fuzz(operation: Any) -> str:
    """Try one operation with many inputs; what was wrong, or an empty text."""

    @settings(max_examples=12, deadline=None, suppress_health_check=list(HealthCheck))
    @given(case=operation.as_strategy() | operation.as_strategy(generation_mode=_NEGATIVE))
    def tried(case: Any) -> None:
        case.call_and_validate(checks=_CHECKS)

    try:
        tried()
    except (schemathesis.errors.SchemathesisError, BaseExceptionGroup, AssertionError) as error:
        return f"{operation.label}: {error}"
    return ""
