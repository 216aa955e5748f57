"""Byte capture of a controller line, and its replay in place of the controllers."""

from pathlib import Path

import pytest
from pmd_rig import axis_config, finish, opened, rig, wait_until

from robot_bridge.pmd.capture import (
    CaptureError,
    ReplayMismatchError,
    ReplayPort,
    read_capture,
)
from robot_bridge.pmd.driver import PmdMotors


def captured_session(folder: Path) -> tuple[Path, str, dict]:
    """Two axes move, park, and the line's bytes are in a file."""
    path = folder / "line.jsonl"
    with rig() as made, opened(made, "mixed", capture_file=path) as motors:
        motors.move_to({"xt": 800, "yt": -400})
        status = finish(motors)
        assert status.reached
        return path, made.url, dict(status.readback_um)


def test_a_captured_session_replays_to_the_same_end(tmp_path: Path):
    path, url, readback_um = captured_session(tmp_path)
    port = ReplayPort(read_capture(path), url)
    motors = PmdMotors(
        [axis_config("xt", url, 1), axis_config("yt", url, 2, "closed_loop")],
        open_port=lambda _: port,
    )
    motors.open()
    motors.declare_position({"xt": 0, "yt": 0})
    motors.move_to({"xt": 800, "yt": -400})
    status = finish(motors)
    assert status.reached
    assert dict(status.readback_um) == readback_um
    assert port.left == {}


def test_a_driver_that_says_something_else_is_found_out(tmp_path: Path):
    path, url, _ = captured_session(tmp_path)
    port = ReplayPort(read_capture(path), url)
    motors = PmdMotors(
        [axis_config("xt", url, 1), axis_config("yt", url, 2, "closed_loop")],
        open_port=lambda _: port,
    )
    motors.open()
    motors.declare_position({"xt": 0, "yt": 0})
    motors.move_to({"xt": 801, "yt": -400})
    with pytest.raises(ReplayMismatchError, match="never captured"):
        finish(motors)


def test_a_capture_tells_direction_time_and_bytes(tmp_path: Path):
    path, url, _ = captured_session(tmp_path)
    captured = read_capture(path)
    assert captured[0].data == b"\x1b;"
    asked = next(c for c in captured if c.data == b"X1?\r")
    answered = b"".join(c.data for c in captured if c.direction == "rx")
    assert asked.direction == "tx"
    assert asked.url == url
    assert answered.startswith(b"X1?:PMD401 V13\r")
    times = [c.at_s for c in captured]
    assert times == sorted(times)


@pytest.mark.parametrize(
    "line", ["{}", "[1, 2]", '[0, "up", "u", "00"]', '[0, "tx", "u", "0g"]', "rubbish"]
)
def test_a_damaged_capture_names_file_and_line(tmp_path: Path, line: str):
    path = tmp_path / "line.jsonl"
    path.write_text('[0.0, "tx", "u", "5831"]\n' + line + "\n")
    with pytest.raises(CaptureError, match=r"line\.jsonl, line 2"):
        read_capture(path)


def test_captures_are_appended_to(tmp_path: Path):
    path, _, _ = captured_session(tmp_path)
    first = len(read_capture(path))
    with rig() as made, opened(made, capture_file=path) as motors:
        wait_until(motors, lambda s: not s.moving)
    assert len(read_capture(path)) > first
