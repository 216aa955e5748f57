"""The control loop under faults: what fails ends alone, and a record in trouble ends nothing."""

import contextlib
import sqlite3
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from lone_service import CONFIG

from case_record.record import FILE_NAME, CaseRecord
from room_config.load import load_config
from service.room.conditions import disk_refuses
from service.room.control import STALE_S, ControlLoop
from service.room.link import PumpedClient, RoomLink
from service.room.refusal import ConflictError
from service.room.state import RoomState


@pytest.fixture
def loop(tmp_path: Path) -> Iterator[ControlLoop]:
    (tmp_path / "room.toml").write_text(CONFIG)
    config = load_config(tmp_path / "room.toml", {})
    client = PumpedClient(config.service.bridge_link, name="service")
    loop = ControlLoop(config, RoomLink(client, lambda text: None))
    loop.start()
    wait_for_state(loop, lambda s: s.case_uid)
    yield loop
    loop.close()


def wait_for_state(loop: ControlLoop, wanted: Callable[[RoomState], object]) -> RoomState:
    deadline_s = time.monotonic() + 60.0
    while not wanted(state := loop.state) or loop.state_age_s > STALE_S:
        assert time.monotonic() < deadline_s, state
        time.sleep(0.01)
    return state


@contextmanager
def locked(case_dir: Path) -> Iterator[None]:
    """As a backup program does that takes the whole file for itself."""
    other = sqlite3.connect(case_dir / FILE_NAME, isolation_level=None, timeout=10.0)
    other.execute("BEGIN IMMEDIATE")
    try:
        yield
    finally:
        other.execute("ROLLBACK")
        other.close()


def is_unusable(state: RoomState) -> bool:
    return any(alarm.code == "record_unusable" for alarm in state.alarms)


def test_a_disk_on_which_no_slice_can_be_stored_is_an_alarm_of_the_service(tmp_path):
    """The listener, who notices first, can record no alarm there."""
    assert disk_refuses(tmp_path, 1) == []
    with pytest.raises(OSError, match="gone"):  # the loop holds then, as without a record
        disk_refuses(tmp_path / "gone", 1)
    listener = f"\n[listener]\nport = 0\nmin_free_mib = {10**9}\n"
    (tmp_path / "room.toml").write_text(CONFIG.split("[listener]")[0] + listener)
    config = load_config(tmp_path / "room.toml", {})
    client = PumpedClient(config.service.bridge_link, name="service")
    with contextlib.closing(ControlLoop(config, RoomLink(client, lambda text: None))) as loop:
        loop.start()
        state = wait_for_state(loop, lambda s: s.case_uid)
        assert "slices are refused" in {a.code: a.text for a in state.alarms}["disk_refuses"]


def describe(loop: ControlLoop) -> None:
    loop.call("describe_case", {"by": "op", "label": "x", "operator": "", "note": ""})


def test_a_locked_record_holds_the_room_says_so_and_is_gone_on_with(loop, tmp_path):
    case_dir = tmp_path / "case"
    with locked(case_dir):
        with pytest.raises(sqlite3.OperationalError, match="locked"):
            describe(loop)  # it finds out at this order, and says so to whoever gave it
        wait_for_state(loop, is_unusable)
        with pytest.raises(ConflictError, match="cannot be used"):
            describe(loop)
        assert not loop.state.ready
        loop.stop("op")
        wait_for_state(loop, is_unusable)
        assert loop.failure is None
    wait_for_state(loop, lambda s: not is_unusable(s))
    describe(loop)
    with CaseRecord(case_dir) as record:
        kinds = [event.kind for event in record.events()]
    assert kinds.index("record_usable_again") < kinds.index("stop") < kinds.index("case_described")


def test_a_stop_while_the_record_is_locked_ends_the_procedure_that_ran(loop, tmp_path):
    case_dir = tmp_path / "case"
    with CaseRecord(case_dir) as record:
        number = record.begin_procedure("jog", {"setpoints_um": {"xt": 100}})
    wait_for_state(loop, lambda s: s.procedure == "jog")  # it waits for the robot
    with locked(case_dir):
        with pytest.raises(sqlite3.OperationalError):
            describe(loop)
        loop.stop("op")
        wait_for_state(loop, is_unusable)
    state = wait_for_state(loop, lambda s: not is_unusable(s) and s.procedure is None)
    assert state.last_outcome == "jog aborted: STOP by op"
    with CaseRecord(case_dir) as record:
        assert [p.state for p in record.procedures() if p.procedure_id == number] == ["aborted"]


@pytest.mark.parametrize(
    ("name", "arguments"),
    [
        ("jog", {}),  # KeyError
        ("jog", {"setpoints_um": 7}),  # TypeError
        ("approach", {"start": {"jacobian": {"columns": "x"}}}),
        ("no such procedure", {}),
    ],
)
def test_a_procedure_that_the_program_fails_at_fails_alone(loop, tmp_path, name, arguments):
    with CaseRecord(tmp_path / "case") as record:
        number = record.begin_procedure(name, arguments)
    wait_for_state(loop, lambda s: s.last_outcome.startswith(f"{name} failed"))
    with CaseRecord(tmp_path / "case") as record:
        assert record.running_procedure() is None
        assert "internal error" in record.last_ended_procedure().result["reason"]
        assert record.last_event("procedure_failed").body["procedure_id"] == number
    describe(loop)


def test_a_record_that_does_not_open_is_said_and_tried_again(tmp_path):
    (tmp_path / "room.toml").write_text(CONFIG)
    config = load_config(tmp_path / "room.toml", {})
    CaseRecord(config.room.case_dir, create=True).close()
    file = config.room.case_dir / FILE_NAME
    whole = file.read_bytes()
    file.write_bytes(b"this is no database" * 1000)
    client = PumpedClient(config.service.bridge_link, name="service")
    loop = ControlLoop(config, RoomLink(client, lambda text: None))
    loop.start()
    try:
        state = wait_for_state(loop, is_unusable)
        assert "not a database" in state.prompt
        file.write_bytes(whole)
        assert wait_for_state(loop, lambda s: s.case_uid and not is_unusable(s)).prompt
    finally:
        loop.close()
