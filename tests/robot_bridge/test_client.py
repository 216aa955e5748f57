"""The client against the bridge in virtual time, on a clean line."""

import contextlib
from collections.abc import Iterator
from pathlib import Path

import pytest
from axis_model import AXES
from virtual_room import VirtualRoom

from robot_bridge.client.client import LinkLostError, RefusedError
from robot_bridge.protocol.messages import CommandState
from robot_bridge.protocol.phases import WorkPhase
from simulator.serial_line import LineFaults


@pytest.fixture
def room(tmp_path: Path) -> Iterator[VirtualRoom]:
    room = VirtualRoom(tmp_path, seed=1)
    yield room
    room.close()


def ready(room: VirtualRoom):
    client = room.client()
    client.open()
    client.declare_position(dict.fromkeys(AXES, 0), "test")
    client.set_phase(WorkPhase.MANUAL, "test")
    client.arm("test")
    return client


def at(um: int) -> dict[str, int]:
    return {axis: um + offset for offset, axis in enumerate(AXES)}


def test_a_move_ends_done_at_its_setpoints(room: VirtualRoom):
    client = ready(room)
    states = []
    outcome = client.move("a", at(3000), None, lambda state, status: states.append(state))
    assert outcome.state is CommandState.DONE
    assert outcome.readback_um == room.stage.positions_um() == at(3000)
    assert states == [CommandState.RUNNING, CommandState.DONE]


def test_the_same_command_id_is_answered_from_the_journal_and_moves_nothing(room: VirtualRoom):
    client = ready(room)
    first = client.move("a", at(3000), "m1")
    client.move("b", at(-3000), None)
    again = client.move("a", at(3000), "m1")
    assert again == first
    assert len(room.stage.begun) == 2


def test_after_a_restart_of_both_sides_the_same_id_still_gets_its_result(room: VirtualRoom):
    first = ready(room).move("a", at(3000), "m1")
    room.crash_bridge()
    client = room.client()
    client.open()
    assert client.move("a", at(3000), "m1") == first
    assert len(room.stage.begun) == 1


def test_a_used_id_with_other_setpoints_is_refused(room: VirtualRoom):
    client = ready(room)
    client.move("a", at(3000), None)
    outcome = client.move("a", at(2000), None)
    assert (outcome.state, outcome.code) == (CommandState.REFUSED, "command_id_reused")
    assert len(room.stage.begun) == 1


def test_a_stop_from_outside_ends_the_move_as_stopped_and_latches(room: VirtualRoom):
    client = ready(room)
    called_s = []

    def stop(state: CommandState, status: object) -> None:
        if state is CommandState.RUNNING:
            called_s.append(room.clock())
            client.request_stop()

    outcome = client.move("a", at(9000), None, stop)
    assert (outcome.state, outcome.code) == (CommandState.STOPPED, "operator_stop")
    assert client.stop_acknowledged
    assert room.stage.stopped_s[0] - called_s[0] < 0.02
    assert client.status.stopped
    assert client.status.phase is WorkPhase.STOP
    with pytest.raises(RefusedError, match="stop_latched"):
        client.arm("test")
    client.rearm("test")
    assert client.status.armed
    assert client.status.phase is WorkPhase.START_UP


def test_a_latched_stop_survives_a_restart_of_the_bridge(room: VirtualRoom):
    client = ready(room)
    client.request_stop(emergency=True)
    client.pump(0.1)
    room.crash_bridge()
    client.open()
    assert client.status.stopped
    assert client.status.phase is WorkPhase.EMERGENCY
    with pytest.raises(RefusedError, match="stop_latched"):
        client.arm("test")
    client.rearm("test")
    assert client.status.armed


def test_silence_of_the_bridge_is_a_lost_link_and_open_begins_anew(room: VirtualRoom):
    client = ready(room)
    room.unplug()
    begun_s = room.clock()
    with pytest.raises(LinkLostError, match="nothing heard"):
        client.pump(5.0)
    assert room.clock() - begun_s < 1.5
    room.plug_in()
    client.open()
    assert client.status.stop_reason == "link_lost"
    assert not client.status.armed


def test_a_restarted_bridge_ends_the_session_and_is_uncertain(room: VirtualRoom):
    client = ready(room)
    room.crash_bridge()
    with pytest.raises(LinkLostError, match="does not know this session"):
        client.pump(5.0)
    hello = client.open()
    assert hello.boot_id_changed
    assert not hello.position_certain


def test_a_second_session_ends_the_first(room: VirtualRoom):
    first = ready(room)
    second = room.client()
    second.open()
    assert not second.status.armed
    with pytest.raises(LinkLostError, match="session"):
        first.pump(1.0)


def test_requests_without_a_session_are_a_lost_link(room: VirtualRoom):
    with pytest.raises(LinkLostError, match="not open"):
        room.client().arm("test")


@pytest.mark.parametrize("value", [float("nan"), 1e300, 1.5, 10**12, True, None, "1"])
def test_what_is_not_a_whole_micrometre_never_reaches_the_line(room: VirtualRoom, value):
    client = ready(room)
    outcome = client.move("a", {**at(0), "xt": value}, None)
    assert (outcome.state, outcome.code) == (CommandState.REFUSED, "malformed")
    assert "xt" in outcome.text
    assert room.stage.begun == []


def test_closing_sees_a_requested_stop_through(room: VirtualRoom):
    client = ready(room)
    room.set_faults(LineFaults(loss=1.0))
    client.request_stop()
    room.set_faults(LineFaults())
    client.close()
    assert room.bridge is not None
    assert room.bridge.stopped
    assert room.bridge.stop_reason == "operator_stop"


def test_a_stray_motion_is_stopped_and_latched_once(room: VirtualRoom):
    client = ready(room)
    room.motors.move_to(at(8000))  # not by any command
    client.pump(0.5)
    assert not room.stage.moving
    assert client.status.stop_reason == "motor_fault"
    count = client.status.stop_count
    room.motors.move_to(at(-8000))
    client.pump(0.5)
    assert not room.stage.moving
    assert client.status.stop_count == count


@pytest.mark.parametrize("deadman_s", [0.5, 1.0, 2.0])
def test_the_deadman_halts_the_motors_within_a_poll_of_its_time(tmp_path: Path, deadman_s: float):
    room = VirtualRoom(tmp_path, seed=2, deadman_s=deadman_s)
    client = ready(room)
    silent_from_s: list[float] = []

    def fall_silent(state: CommandState, status: object) -> None:
        silent_from_s.append(room.clock())
        room.run(deadman_s + 0.5)  # the control loop hangs

    room.stage.speed_um_s = 1000.0  # it would run on for seconds
    outcome = client.move("a", at(9000), None, fall_silent)
    assert (outcome.state, outcome.code) == (CommandState.STOPPED, "link_lost")
    halted_s = room.stage.stopped_s[0] - silent_from_s[0]
    assert deadman_s - 0.06 <= halted_s <= deadman_s + 0.02
    room.close()


def test_heartbeats_that_were_held_up_do_not_feed_the_deadman(room: VirtualRoom):
    """The line delivers, but everything two seconds late."""
    client = ready(room)
    assert room.bridge is not None
    room.to_bridge.faults = LineFaults(latency_s=2.0)
    for _ in range(100):
        with contextlib.suppress(LinkLostError):
            client.pump(0.02)
    assert room.bridge.stopped
    assert room.bridge.stop_reason == "link_lost"
    stops = room.bridge.stop_count
    room.run(3.0)
    assert room.bridge.stop_count == stops
    assert room.stage.begun == []
