"""The processes of the virtual room for tests: nobody operates it but the test."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TypeVar

import numpy as np

from room_config.shell import autospine
from service.client import RoomClient, ServiceGoneError
from service.room.state import RoomState
from simulator.demo.room import DemoOptions, DemoRoom
from simulator.truth_client import TruthAddress, ask_path, ask_where

Seen = TypeVar("Seen")
_TRUTH_PORTS: dict[str, int] = {}  # by the address of the service


class AttendedRoom(DemoRoom):
    """The demo's room, but it asks before every approach move; `more` ends its file.

    tokens: it asks whoever comes for a token, the scanner too; `operator_token` is the operator's.
    guide: two fiducials and four axes.
    """

    def __init__(
        self, folder: Path, more: str = "", *, tokens: bool = False, guide: bool = False
    ) -> None:
        super().__init__(DemoOptions(folder, seed=3, speed_factor=1.5, tokens=tokens, guide=guide))
        self._more = more

    def _write_config(self, ports: tuple[int, int]) -> Path:
        path = super()._write_config(ports)
        text = path.read_text().replace("confirm_moves = false", "confirm_moves = true")
        path.write_text(text + self._more)
        return path

    def start(self) -> None:
        super().start()
        _TRUTH_PORTS[self.url] = self.truth_port

    def kill(self, name: str) -> None:
        """As `kill -9` does."""
        process = self.family.children[name].process
        process.kill()
        process.wait(5.0)

    def start_again(self, name: str) -> None:
        self.family.children[name].end()
        words = autospine(name, "--config", str(self.folder / "room.toml"))
        self.family.start(name, words)

    def start_bridge_again(self) -> None:
        self.family.children["bridge"].end()
        here = ["--config", str(self.folder / "room.toml")]
        self.family.launch("bridge", [sys.executable, "-m", "robot_bridge", *here])

    def power_cycle_controllers(self) -> None:
        """They count from zero again; the stages stand where they stood."""
        self.kill("bridge")
        self.kill("motors")
        self.family.children["motors"].end()
        self.family.start("motors", [*self._motors_words(), "--truth-port", str(self.truth_port)])
        self.start_bridge_again()

    def standstill_s(self, from_s: float, until_s: float) -> float:
        """The instant of the last motion of any stage, as the motors know it."""
        path = ask_path(TruthAddress("127.0.0.1", self.truth_port), from_s, until_s)
        steps = np.any(np.abs(np.diff(path.positions_mm, axis=0)) > 0, axis=1)
        moved_s = path.times_s[1:][steps]
        return float(moved_s[-1]) if len(moved_s) else from_s


@contextmanager
def running_room(
    folder: Path, more: str = "", *, tokens: bool = False, guide: bool = False
) -> Iterator[AttendedRoom]:
    room = AttendedRoom(folder, more, tokens=tokens, guide=guide)
    try:
        room.start()
        yield room
    finally:
        room.end()


def wait_for(
    look: Callable[[], Seen], wanted: Callable[[Seen], object], timeout_s: float = 60.0
) -> Seen:
    """Look until it is as wanted; the last look is in the error."""
    deadline_s = time.monotonic() + timeout_s
    seen: Seen | ServiceGoneError
    while True:
        try:
            seen = look()
            if wanted(seen):
                return seen
        except ServiceGoneError as error:  # for a moment it does not know: on a busy machine
            seen = error
        assert time.monotonic() < deadline_s, f"after {timeout_s:.0f} s still {seen}"
        time.sleep(0.02)


def read_off(client: RoomClient, axes: Iterable[str]) -> dict[str, int]:
    """Where a person reads on the stages' scales that these axes stand, µm."""
    truth = ask_where(TruthAddress("127.0.0.1", _TRUTH_PORTS[client.url]))
    return {axis: round(1000 * truth.positions_mm[axis]) for axis in axes}


def arm(client: RoomClient) -> None:
    """Link, arm, and wait until the state says so.

    Where an interrupted motion left an axis is read off its scale: a guess would narrow its travel.
    """
    state = wait_for(client.state, lambda s: s.robot.linked and not s.robot.moving)
    if state.robot.stopped or not state.robot.armed or not state.robot.position_certain:
        client.reset(read_off(client, state.robot.taken_um))
    wait_for(client.state, lambda s: s.robot.armed and not s.robot.stopped)


def stop_all(client: RoomClient) -> None:
    """STOP, until the robot is stopped and no procedure runs; then arm again."""
    client.stop()
    wait_for(client.state, lambda s: s.robot.stopped and s.procedure is None)
    arm(client)


def calibrated(client: RoomClient) -> RoomState:
    """The state of a room that has been calibrated, if need be now."""
    arm(client)
    state = client.state()
    if not state.calibrated:
        client.start_calibration()
        state = wait_for(client.state, lambda s: s.calibrated and s.procedure is None, 120.0)
    return state


def tidied(client: RoomClient) -> None:
    """Nothing runs and no needle is in, whatever a test before has left of a shared room."""
    state = client.state()
    if state.procedure is not None:
        client.abort()
        state = wait_for(client.state, lambda s: s.procedure is None)
    if state.robot.insertion_locked or state.ready:
        client.needle_out()
