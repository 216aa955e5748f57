"""The event stream of a long case: who comes late, many at once, gets all of it in order."""

from concurrent.futures import ThreadPoolExecutor
from itertools import islice
from pathlib import Path

import httpx
import pytest
from lone_service import running_service

from case_record.record import CaseRecord

EVENTS = 2500
AT_ONCE = 8


@pytest.fixture(scope="module")
def url(tmp_path_factory):
    """A service on a case in which more has happened than it keeps in memory."""
    folder = tmp_path_factory.mktemp("long")
    write_long_case(folder / "case")
    with running_service(folder) as url:
        yield url


def write_long_case(folder: Path) -> None:
    with CaseRecord(folder, create=True) as record:
        record.start_case("long", 1)
        with record.transaction():
            for number in range(EVENTS):
                record.append_event("note", {"number": number}, source="test")


def ids_on_stream(url: str, after: int, count: int) -> list[int]:
    with httpx.stream("GET", f"{url}/api/v1/events/live?after={after}", timeout=120.0) as stream:
        ids = (int(line[4:]) for line in stream.iter_lines() if line.startswith("id: "))
        return list(islice(ids, count))


@pytest.mark.parametrize("after", [0, 99, 100, 1234, 1600, EVENTS - 5])
def test_every_event_after_the_given_one_comes_once_and_in_order(url: str, after: int) -> None:
    count = EVENTS - after
    assert ids_on_stream(url, after, count) == list(range(after + 1, EVENTS + 1))


def test_many_who_want_the_whole_case_at_once_each_get_it(url: str) -> None:
    with ThreadPoolExecutor(AT_ONCE) as pool:
        found = pool.map(lambda _: ids_on_stream(url, 0, EVENTS), range(AT_ONCE))
        assert all(ids == list(range(1, EVENTS + 1)) for ids in found)


def test_the_state_comes_after_what_was_missed(url: str) -> None:
    kinds = []
    with httpx.stream("GET", f"{url}/api/v1/events/live?after=100", timeout=120.0) as stream:
        for line in stream.iter_lines():
            if line.startswith("event: "):
                kinds.append(line[7:])
            if kinds and kinds[-1] == "state":
                break
    assert kinds[:-1] == ["record"] * (len(kinds) - 1)
    assert len(kinds) > EVENTS - 100
