"""The daemon as a real process, on a real serial line, with emulated controllers that run."""

import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
from bridge_room import AXES, BridgeRoom, bridge_room, wait_for

from robot_bridge.client.client import LinkLostError, MoveOutcome, RefusedError
from robot_bridge.protocol.messages import CommandState
from robot_bridge.protocol.phases import WorkPhase
from simulator.serial_line import LineFaults

FAR = dict.fromkeys(AXES, 14_000)  # about two seconds at full speed


def begin_long_move(room: BridgeRoom, client, command_id: str = "long") -> threading.Thread:
    """A move in a thread of its own; returns when the motors turn. Outcomes: room.outcomes."""
    thread = threading.Thread(target=_move, args=(room, client, command_id), daemon=True)
    thread.start()
    wait_for(room.controllers.on_a_long_way, 60, "the motors to turn")
    return thread


def _move(room: BridgeRoom, client, command_id: str) -> None:
    try:
        room.outcomes.append(client.move(room.id(command_id), FAR, None))
    except LinkLostError as error:
        room.outcomes.append(error)


def assert_stands(room: BridgeRoom, within_s: float) -> float:
    took_s = wait_for(lambda: not room.controllers.moving, within_s, "standstill")
    stood = room.controllers.positions_um()
    assert all(um < 13_000 for um in stood.values()), (
        "the move ended by itself; test proves nothing"
    )
    time.sleep(0.3)
    assert room.controllers.positions_um() == pytest.approx(stood, abs=5), "it moved on"
    return took_s


def test_moves_arrive_where_they_were_sent(shared_room: BridgeRoom):
    room = shared_room
    client = room.ready_client()
    outcome = client.move(room.id("a"), {"xt": 1000, "yt": -2000, "xb": 500, "yb": 0}, "m1")
    assert outcome.state is CommandState.DONE, outcome
    truth = room.controllers.positions_um()
    assert truth == pytest.approx({"xt": 1000, "yt": -2000, "xb": 500, "yb": 0}, abs=20)
    assert outcome.readback_um == pytest.approx(truth, abs=5)


def test_on_a_line_that_loses_a_fifth_of_the_frames_moves_arrive_all_the_same(
    shared_room: BridgeRoom,
):
    room = shared_room
    client = room.ready_client()
    room.line.set_faults(LineFaults(loss=0.2, bit_flip=0.02, duplicate=0.05))
    for number in range(60):
        if number >= 8 and client.counters.frames_resent > 0:
            break
        setpoints_um = dict.fromkeys(AXES, 200 * (number % 3))
        outcome = client.move(room.id(f"{number}"), setpoints_um, None)
        assert outcome.done, outcome
        assert room.controllers.positions_um() == pytest.approx(setpoints_um, abs=20)
    assert client.counters.frames_resent > 0


def test_stop_during_motion_stops_the_motors_at_once(shared_room: BridgeRoom):
    room = shared_room
    client = room.ready_client()
    thread = begin_long_move(room, client)
    client.request_stop()
    assert_stands(room, within_s=0.5)  # the benchmark measures it properly
    thread.join(5)
    assert isinstance(room.outcomes[0], MoveOutcome)
    assert room.outcomes[0].code == "operator_stop"


def test_emergency_also_parks_the_drives(shared_room: BridgeRoom):
    room = shared_room
    client = room.ready_client()
    thread = begin_long_move(room, client)
    client.request_stop(emergency=True)
    assert_stands(room, within_s=1.0)
    thread.join(5)
    client.pump(2.0)
    assert client.status.phase is WorkPhase.EMERGENCY
    assert client.status.parked
    assert all(controller.parked for controller in room.controllers.all)


SERVICE = """
import sys
sys.path.insert(0, {here!r})
from bridge_room import AXES
from robot_bridge.client.client import BridgeClient
from robot_bridge.protocol.phases import WorkPhase
client = BridgeClient({url!r}, heartbeat_s=0.1)
client.open(10.0)
client.declare_position(dict.fromkeys(AXES, 0), "test")
client.set_phase(WorkPhase.MANUAL, "test")
client.arm("test")
print("armed", flush=True)
client.move("service-move", dict.fromkeys(AXES, 14000), None)
"""


@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGSTOP])
def test_with_the_service_killed_or_frozen_the_motors_stand_within_1200_ms(tmp_path: Path, how):
    with bridge_room(tmp_path) as room:
        room.start_daemon()
        code = SERVICE.format(here=str(Path(__file__).parent), url=room.line.far)
        service = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
        assert service.stdout is not None
        assert service.stdout.readline() == "armed\n"
        wait_for(room.controllers.on_a_long_way, 60, "the motors to turn")
        os.kill(service.pid, how)
        took_s = assert_stands(room, within_s=1.2)
        assert took_s > 0.3, "the deadman is a second; something else stopped them"
        if how == signal.SIGSTOP:
            os.kill(service.pid, signal.SIGCONT)
            time.sleep(0.5)
            assert not room.controllers.moving, "it resumed by itself"
        service.kill()
        service.wait()
        service.stdout.close()
        successor = room.client()
        successor.open(5.0)
        assert successor.status.stopped
        assert successor.status.stop_reason == "link_lost"
        outcome = successor.move("service-move", FAR, None)
        assert (outcome.state, outcome.code) == (CommandState.STOPPED, "link_lost")
        with pytest.raises(RefusedError, match="stop_latched"):
            successor.arm("test")


def test_killing_the_daemon_stops_the_motors_through_its_guardian(tmp_path: Path):
    with bridge_room(tmp_path) as room:
        daemon = room.start_daemon()
        client = room.ready_client()
        thread = begin_long_move(room, client)
        daemon.kill()
        assert assert_stands(room, within_s=1.2) < 0.6  # well before any deadman
        thread.join(5)
        assert isinstance(room.outcomes[0], LinkLostError)
        daemon.wait()
        room.start_daemon()
        hello = client.open(15.0)
        assert hello.boot_id_changed
        assert not hello.position_certain
        outcome = client.move(room.id("long"), FAR, None)
        assert (outcome.state, outcome.code) == (CommandState.FAILED, "bridge_restarted")
        assert not room.controllers.moving


def test_a_frozen_daemon_is_stopped_by_its_guardian_and_latches_when_it_thaws(tmp_path: Path):
    with bridge_room(tmp_path) as room:
        daemon = room.start_daemon()
        client = room.ready_client()
        begin_long_move(room, client)
        daemon.send_signal(signal.SIGSTOP)
        assert_stands(room, within_s=1.2)
        daemon.send_signal(signal.SIGCONT)
        time.sleep(0.5)
        assert not room.controllers.moving
        client.open(5.0)
        assert client.status.stopped
        assert client.status.stop_reason in ("loop_stalled", "motor_fault")


def test_the_death_of_the_guardian_stops_the_motors_and_ends_the_daemon(tmp_path: Path):
    with bridge_room(tmp_path) as room:
        daemon = room.start_daemon()
        client = room.ready_client()
        begin_long_move(room, client)
        os.kill(int(str(room.status_file()["guardian_pid"])), signal.SIGKILL)
        assert_stands(room, within_s=1.0)
        assert daemon.wait(5) == 3


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_ends_the_daemon_with_standing_motors(tmp_path: Path, number: int):
    with bridge_room(tmp_path) as room:
        daemon = room.start_daemon()
        client = room.ready_client()
        begin_long_move(room, client)
        daemon.send_signal(number)
        assert_stands(room, within_s=1.0)
        assert daemon.wait(5) == 0
        assert "internal_error" not in room.log
        room.start_daemon()
        client.open(15.0)
        outcome = client.move(room.id("long"), FAR, None)
        assert (outcome.state, outcome.code) == (CommandState.STOPPED, "shutting_down")


def test_the_end_of_the_parent_ends_the_daemon_with_standing_motors(tmp_path: Path):
    with bridge_room(tmp_path) as room:
        daemon = room.start_daemon("--exit-with-parent")
        client = room.ready_client()
        begin_long_move(room, client)
        assert daemon.stdin is not None
        daemon.stdin.close()
        assert_stands(room, within_s=1.0)
        assert daemon.wait(5) == 0


def test_an_unplugged_line_stops_the_motion_and_the_bridge_says_why(shared_room: BridgeRoom):
    """After exactly how long: test_client, in virtual time."""
    room = shared_room
    client = room.ready_client()
    begin_long_move(room, client)
    room.line.unplug()
    assert_stands(room, within_s=60)
    wait_for(lambda: room.status_file()["stopped"], 60, "the latched stop")
    wait_for(lambda: not room.status_file()["moving"], 60, "the look where it stands")
    health = room.status_file()
    assert health["stop_reason"] == "link_lost"
    assert health["armed"] is False


def test_the_insertion_lock_survives_kill_9(tmp_path: Path):
    with bridge_room(tmp_path) as room:
        daemon = room.start_daemon()
        client = room.ready_client()
        client.set_insertion_lock(True, "test")
        daemon.kill()
        daemon.wait()
        room.start_daemon()
        client.open(15.0)
        assert client.status.insertion_locked
        client.declare_position(dict.fromkeys(AXES, 0), "test")
        client.set_phase(WorkPhase.MANUAL, "test")
        client.arm("test")
        outcome = client.move("a", FAR, None)
        assert (outcome.state, outcome.code) == (CommandState.REFUSED, "insertion_locked")
        client.set_insertion_lock(False, "test")
        assert client.move("b", dict.fromkeys(AXES, 100), None).done


def test_a_second_daemon_on_the_same_state_is_refused(shared_room: BridgeRoom):
    room = shared_room
    room.ready_client()
    second = room.start_daemon()
    assert second.wait(10) == 3
    assert "another bridge is using it" in room.log
    assert "Traceback" not in room.log


def test_without_a_controller_the_daemon_says_which_port_and_exits_3(tmp_path: Path):
    with bridge_room(tmp_path) as room:
        text = room.config_file.read_text().replace(room.controllers.url, "/dev/no-such-port")
        room.config_file.write_text(text)
        daemon = room.start_daemon()
        assert daemon.wait(10) == 3
        last = room.log.strip().splitlines()[-1]
        assert last.startswith("autospine bridge: ")
        assert "/dev/no-such-port" in last
        assert "Traceback" not in room.log


def test_a_status_file_that_cannot_be_written_is_named_and_exit_3(tmp_path: Path):
    extra = f'status_file = "{tmp_path}/room.toml/status.json"'
    with bridge_room(tmp_path, extra=extra) as room:
        daemon = room.start_daemon()
        assert daemon.wait(10) == 3
        assert "room.toml/status.json: cannot be written" in room.log
        assert "Traceback" not in room.log


def test_a_bad_configuration_is_one_line_and_exit_2(tmp_path: Path):
    file = tmp_path / "room.toml"
    file.write_text('[bridge]\nlink = "/dev/ttyUSB0"\nstate_dir = "s"\ndeadman = 1\n')
    command = [sys.executable, "-m", "robot_bridge", "--config", str(file)]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=30)
    assert ended.returncode == 2
    assert ended.stderr == f"autospine bridge: {file}: bridge.axis: is missing\n"


def test_the_status_file_shows_health(shared_room: BridgeRoom):
    room = shared_room
    client = room.ready_client()
    client.pump(0.8)
    health = room.status_file()
    assert health["armed"] is True
    assert health["phase"] == "MANUAL"
    assert health["line_open"] is True
    assert health["positions_um"].keys() == set(AXES)
