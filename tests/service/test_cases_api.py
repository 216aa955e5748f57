"""Cases by the API: begun, finished, found again; a real service, no robot and no listener."""

import sqlite3
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from datetime import timedelta
from pathlib import Path

import httpx
import pytest
from attended_room import wait_for
from lone_service import CONFIG, ready_service

from case_record.cases import Cases
from case_record.holding import Held, Holding
from case_record.record import CaseRecord
from service.client import RefusedByServiceError, RoomClient

ROOM = 'case_dir = "case"', 'cases_dir = "cases"'


@contextmanager
def running(folder: Path):
    with (
        ready_service(folder, config=CONFIG.replace(*ROOM)) as ready,
        RoomClient(ready["url"], by="Olga") as client,
    ):
        yield client


def refusal(run, *arguments, **named) -> RefusedByServiceError:
    with pytest.raises(RefusedByServiceError) as caught:
        run(*arguments, **named)
    return caught.value


def test_five_cases_one_after_the_other_each_of_its_own(tmp_path):
    cases = Cases(tmp_path / "cases")
    with running(tmp_path) as client:
        state = client.state()
        assert state.case_folder is None
        assert state.cases_begin_here
        assert state.prompt == "Start a case."
        for order in (client.describe_case, client.set_target):
            error = refusal(order, (1.0, 2.0, 3.0) if order == client.set_target else "x")
            assert (error.status, error.code) == (409, "no_case")
        assert refusal(client.slices).code == "no_case"
        assert refusal(client.finish_case).code == "no_case"
        uids = []
        for number in range(5):
            folder = client.begin_case(f"case {number}", "Olga")
            state = client.state()
            assert state.case_folder == folder == cases.open.name
            assert state.case.label == f"case {number}"
            assert state.target_patient_mm is None
            assert state.entry_patient_mm is None
            uids.append(state.case_uid)
            client.set_target((1.0, 2.0, float(number)))
            client.set_entry((1.0, 2.0, 30.0 + number))
            assert client.state().target_patient_mm == (1.0, 2.0, float(number))
            error = refusal(client.begin_case)
            assert error.code == "case_open"
            assert f"case {number}" in str(error)
            assert client.finish_case() == folder
            state = client.state()
            assert (state.case_folder, state.case_uid, state.case) == (None, "", None)
            assert state.target_patient_mm is None
        assert len(set(uids)) == 5
        listed = client.cases()
        assert [one.label for one in listed] == [f"case {n}" for n in (4, 3, 2, 1, 0)]
        assert not any(one.current for one in listed)
        for number, one in enumerate(reversed(listed)):
            events = client.events(case=one.folder)
            said = str([event.body for event in events])
            assert f"case {number}" in said
            assert not any(f"case {other}" in said for other in range(5) if other != number)
            assert events[-1].kind == "case_finished"
            with CaseRecord(cases.home / one.folder, read_only=True) as record:
                record.verify_events()


def test_report_and_export_are_written_into_the_folder_of_a_finished_case(tmp_path):
    with running(tmp_path) as client:
        folder = tmp_path / "cases" / client.begin_case("with papers")
        client.finish_case()
        papers = folder / "papers"
        wait_for(lambda: sorted(p.name for p in papers.glob("*")), lambda names: names == [
            "case.zip", "report.html"])  # fmt: skip
        assert "case_finished" in (papers / "report.html").read_text()


def test_a_killed_service_goes_on_with_the_case_that_was_open(tmp_path):
    with running(tmp_path) as client:
        folder = client.begin_case("goes on")
        client.set_target((1.0, 2.0, 3.0))
    with running(tmp_path) as client:
        state = client.state()
        assert state.case_folder == folder
        assert state.case.label == "goes on"
        assert state.target_patient_mm == (1.0, 2.0, 3.0)
        assert state.case_question == ""


@pytest.fixture
def left_open(tmp_path, monkeypatch):
    """A case with a running procedure and an open hold, last touched some time ago."""

    def leave(ago: timedelta) -> Path:
        cases = Cases(tmp_path / "cases")
        made = cases.make_folder()
        now_s = time.time
        with monkeypatch.context() as clock, CaseRecord(made, create=True) as record:
            clock.setattr(time, "time", lambda: now_s() - ago.total_seconds())
            record.start_case("room", 0)
            record.begin_hold(
                set_id=1, place=0, setpoints_um={}, readback_um={}, shift_um={},
                shift_px=(0.0, 0.0), settled_at_s=time.time(),
            )  # fmt: skip
            record.begin_procedure("jog", {"setpoints_um": {"xt": 0}})
        cases.set_open(made)
        return made

    return leave


def test_a_case_of_yesterday_is_asked_about_and_nothing_of_it_goes_on_by_itself(
    tmp_path, left_open
):
    folder = left_open(timedelta(days=1))
    with running(tmp_path) as client:
        state = wait_for(client.state, lambda s: s.case_folder)
        assert "another day" in state.case_question
        assert state.prompt == state.case_question
        assert state.procedure is None
        assert state.hold is None
        error = refusal(client.set_target, (1.0, 2.0, 3.0))
        assert error.code == "case_of_another_day"
        client.continue_case()
        state = client.state()
        assert state.case_question == ""
        client.set_target((1.0, 2.0, 3.0))
        client.stop()
    with running(tmp_path) as client:
        assert wait_for(client.state, lambda s: s.case_folder).case_question == ""
    with CaseRecord(folder) as record:
        assert record.last_event("case_continued").who == "Olga"
        assert record.last_event("procedure_aborted").body["reason"].endswith("another day")


def test_a_case_of_yesterday_can_be_finished_instead(tmp_path, left_open):
    folder = left_open(timedelta(days=1))
    with running(tmp_path) as client:
        wait_for(client.state, lambda s: s.case_question)
        assert client.finish_case() == folder.name
        client.begin_case("today")
        assert client.state().case_question == ""


def test_a_case_of_an_hour_ago_is_not_asked_about(tmp_path, left_open):
    left_open(timedelta(minutes=50))
    with running(tmp_path) as client:
        assert wait_for(client.state, lambda s: s.case_folder).case_question == ""


def test_two_people_who_begin_a_case_at_once_get_one(tmp_path):
    def begin(client):
        try:
            return client.begin_case(f"by {id(client)}")
        except RefusedByServiceError as error:
            return error

    with running(tmp_path) as client:
        others = [RoomClient(client.url, by=f"person {n}") for n in range(6)]
        with ThreadPoolExecutor(6) as pool:
            answers = list(pool.map(begin, others))
        for other in others:
            other.close()
        folders = [answer for answer in answers if isinstance(answer, str)]
        assert len(folders) == 1
        assert {a.code for a in answers if not isinstance(a, str)} == {"case_open"}
        assert len(Cases(tmp_path / "cases").folders()) == 1


def test_a_finished_case_is_opened_again_and_must_be_calibrated_anew(tmp_path):
    with running(tmp_path) as client:
        folder = client.begin_case("again")
        client.finish_case()
        assert refusal(client.reopen_case, "no such").status == 404
        client.reopen_case(folder)
        state = client.state()
        assert state.case_folder == folder
        assert state.calibrated is False
        assert [event.kind for event in client.events()][-1] == "case_reopened"
        assert refusal(client.reopen_case, folder).code == "case_open"


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        (lambda f: (f / "case.sqlite").write_bytes(b"no database" * 500), "not a usable"),
        (lambda f: (f / "case.sqlite").unlink(), "no case record"),
        (lambda f: set_version(f, 99), "newer than this program's"),
    ],
)
def test_an_open_case_that_cannot_be_used_is_named_and_another_one_can_begin(
    tmp_path, damage, said
):
    with running(tmp_path) as client:
        folder = tmp_path / "cases" / client.begin_case("will be damaged")
    for path in folder.glob("case.sqlite-*"):
        path.unlink()
    damage(folder)
    before = {p: p.read_bytes() for p in folder.rglob("*") if p.is_file()}
    with running(tmp_path) as client:
        state = wait_for(client.state, lambda s: s.alarms)
        alarm = next(a for a in state.alarms if a.code == "case_unusable")
        assert said in alarm.text
        assert folder.name in alarm.text
        assert said in str(refusal(client.set_target, (1.0, 2.0, 3.0)))
        assert client.begin_case("the next one") != folder.name
        assert client.state().case.label == "the next one"
    assert {p: p.read_bytes() for p in folder.rglob("*") if p.is_file()} == before


def set_version(folder: Path, version: int) -> None:
    db = sqlite3.connect(folder / "case.sqlite")
    db.execute(f"PRAGMA user_version = {version}")
    db.close()


def test_the_clock_that_was_compared_comes_along_into_the_next_case(tmp_path):
    with running(tmp_path) as client:
        client.begin_case()
        client.compare_clocks(-37.2, 0.02)
        before = client.state().clock
        client.finish_case()
        client.begin_case()
        after = client.state().clock
        assert (after.offset_s, after.uncertainty_s) == (before.offset_s, before.uncertainty_s)
        client.forget_clock("set anew")
        client.finish_case()
        client.begin_case()
        assert client.state().clock is None


def test_no_browser_shows_the_images_of_one_case_in_the_next(tmp_path):
    with running(tmp_path) as client:
        client.begin_case()
        for path in ("slices/1/image.png", "measurements/1/image.png"):
            answer = httpx.get(f"{client.url}/api/v1/{path}")
            assert answer.status_code == 404
            assert "immutable" not in answer.headers.get("Cache-Control", "")


def test_what_waits_is_listed_and_of_another_patient_no_more_than_that_it_waits(tmp_path):
    with Holding(tmp_path / "cases") as holding:
        for number, study in enumerate(("1.2.1", "1.2.2")):
            holding.add(
                Held(
                    name=f"{number}.dcm", sop_instance_uid=f"1.{number}", sha256=f"{number}",
                    received_s=time.time(), code="no_case_open", reason="no case was open",
                    patient=f"patient {number}", study=study, frame_of_reference="1.2.9",
                    description=f"cor {number}",
                )
            )  # fmt: skip
    with running(tmp_path) as client:
        state = client.state()
        assert {(one.study, one.may_be_taken) for one in state.holding} == {
            ("1.2.1", False), ("1.2.2", False)}  # fmt: skip
        client.begin_case()
        client.take_slices("1.2.1")
        state = wait_for(client.state, lambda s: len({one.study for one in s.holding}) == 2)
        assert {(one.study, one.description) for one in state.holding} == {
            ("1.2.1", "cor 0"), ("", "")}  # fmt: skip
        error = refusal(client.take_slices, "1.2.2")
        assert "a different patient" in str(error)
        assert "no slices of study" in str(refusal(client.take_slices, "1.2.77"))


def test_another_service_in_the_same_room_is_refused(tmp_path):
    said = r"another service \(process \d+\)"
    with running(tmp_path), pytest.raises(AssertionError, match=said), running(tmp_path):
        pass


def test_a_room_with_one_case_says_how_to_have_more(tmp_path):
    with ready_service(tmp_path) as ready, RoomClient(ready["url"]) as client:
        state = client.state()
        assert not state.cases_begin_here
        assert refusal(client.finish_case).code == "cases"
        assert "cases_dir" in str(refusal(client.finish_case))
        assert refusal(client.begin_case).code == "case_open"


def test_old_cases_are_read_by_name_and_not_written(tmp_path):
    with running(tmp_path) as client:
        folder = client.begin_case("old", "Olga")
        client.set_target((1.0, 2.0, 3.0), label="L4")
        client.finish_case()
        wait_for(lambda: list((tmp_path / "cases" / folder / "papers").glob("*.zip")), bool)
        client.begin_case("new")
        before = {
            p: p.stat().st_mtime_ns for p in (tmp_path / "cases" / folder).rglob("*") if p.is_file()
        }
        url = f"{client.url}/api/v1"
        for path in ("events", "slices", "measurements", "targets", "outbox"):
            answer = httpx.get(f"{url}/{path}", params={"case": folder})
            assert answer.status_code == 200, answer.text
        assert httpx.get(f"{url}/targets", params={"case": folder}).json()[0]["label"] == "L4"
        assert httpx.get(f"{url}/targets").json() == []
        assert httpx.get(f"{url}/slices", params={"case": "../case"}).status_code == 404
        after = {p: p.stat().st_mtime_ns for p in before}
        assert after == before
