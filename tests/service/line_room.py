"""The service's own control loop with the bridge's own code behind a virtual line, in one process.

Control loop, commands, execution, record, bridge and both ends of the protocol are the program's
own. The wire and the motors are models in virtual time (`tests/robot_bridge/virtual_room`), and
scanner and worker together are one: whoever asks for slices gets them at once, and a measurement
says where the model's fiducial truly is, give or take `sigma_mm`.
"""

from __future__ import annotations

import queue
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from case_record.record import CaseRecord
from case_record.rows import Measurement, NewSlice
from room_config.load import load_config
from service.room.commands.commands import Commands
from service.room.control import ControlLoop
from service.room.link import PumpedClient, RoomLink
from service.room.state import RoomState

sys.path.insert(0, str(Path(__file__).parents[1] / "robot_bridge"))
from virtual_room import VirtualRoom, VirtualTransport

ORIGIN_MM = (40.0, 60.0)
"""Where the fiducial is with both stages at zero, (row, col) mm in the image plane."""
_PATIENCE_S = 60.0
Result = TypeVar("Result")

_FILE = """
[room]
name = "line room"
case_dir = "case"
virtual = true

[service]
bridge_link = "none"
settle_s = 0.0
calibration_move_mm = 6.0
shift_set = "single"
confirm_moves = false
{more}
"""


# what says where the fiducial is here fits nothing to images
IMAGING = '[imaging]\nlocalization = "disc"\n'


class LineClient(PumpedClient):
    """Lets the room do what it is asked for, in the control loop's thread, each time it pumps."""

    meanwhile: Callable[[], None] = staticmethod(lambda: None)

    def pump(self, wait_s: float = 0.0) -> None:
        self.meanwhile()
        super().pump(wait_s)


class LineRoom:
    """`call` orders, `do` what happens to the room, `until` the state is as wanted."""

    def __init__(
        self, folder: Path, more: str = "", seed: int = 1, *, many_cases: bool = False
    ) -> None:
        text = _FILE.format(more=more if "[imaging]" in more else more + "\n" + IMAGING)
        if many_cases:
            text = text.replace('case_dir = "case"', 'cases_dir = "cases"')
        if "confirm_moves = true" in more:
            text = text.replace("confirm_moves = false\n", "")
        (folder / "room.toml").write_text(text)
        (folder / "bridge").mkdir()
        self.config = load_config(folder / "room.toml", {})
        self.line = VirtualRoom(folder / "bridge", seed)
        self.sigma_mm = 0.004
        self.header: dict[str, Any] = {
            "study_instance_uid": "1.2.1",
            "frame_of_reference_uid": "1.2.9",
            "imaging_frequency_mhz": 123.2,
            "pixel_bandwidth_hz": 500.0,
            "phase_encoding_direction": "ROW",
        }
        self.decoys_mm: list[np.ndarray] = []
        self.fiducial_visible = True
        self.scanning = True
        self._rng = np.random.default_rng(seed)
        self._todo: queue.Queue[Callable[[], None]] = queue.Queue()
        self._slices = 0
        client = LineClient(
            "virtual line",
            open_transport=lambda: VirtualTransport(self.line),
            clock=self.line.clock,
            pause=self.line.run,
            random_bits=self.line.rng.getrandbits,
            stop_thread=False,
        )
        client.meanwhile = self._meanwhile
        self.link = RoomLink(client, lambda text: None)
        self.loop = ControlLoop(self.config, self.link)
        self._thread: int | None = None
        self._pump_link()

    def _pump_link(self) -> None:
        """Even without a link the room goes on, and a lost one is looked for at once."""
        pump = self.link.pump

        def pumping(wait_s: float) -> None:
            self._meanwhile()
            self.link._next_open_s = 0.0
            if not self.link.is_up:
                self.line.step()
            pump(wait_s)

        self.link.pump = pumping  # type: ignore[method-assign]

    # --- what the test does

    @property
    def state(self) -> RoomState:
        return self.loop.state

    def call(self, name: str, **arguments: Any) -> Any:
        return self.loop.call(name, {"by": "tester", **arguments})

    def do(self, what: Callable[[], Result]) -> Result:
        """Let something happen in the control loop's thread, between two of its looks."""
        done = threading.Event()
        results: list[Result] = []

        def doing() -> None:
            results.append(what())
            done.set()

        self._todo.put(doing)
        assert done.wait(_PATIENCE_S), "the control loop does not get on"
        return results[0]

    def until(self, wanted: Callable[[RoomState], object]) -> RoomState:
        deadline_s = time.monotonic() + _PATIENCE_S
        while not wanted(state := self.state):
            assert self.loop.failure is None, self.loop.failure
            assert time.monotonic() < deadline_s, f"still {state}"
            time.sleep(0.002)
        return state

    def later(self) -> RoomState:
        """A state that was published after this moment."""
        now_s = time.time()
        return self.until(lambda s: s.at_s > now_s)

    def stop(self, *, emergency: bool = False) -> None:
        self.do(lambda: self.loop.stop_answered(self.loop.stop("tester", emergency=emergency)))

    def read_off(self, axes: Iterable[str]) -> dict[str, int]:
        """Where a person reads on the stages' scales that these axes stand, µm."""
        at_um = self.line.stage.positions_um()
        return {axis: round(at_um[axis]) for axis in axes}

    def arm(self) -> RoomState:
        state = self.until(lambda s: s.robot.linked and not s.robot.moving)
        robot = state.robot
        if robot.stopped or not robot.armed or not robot.position_certain:
            self.call("reset", positions_um=self.read_off(robot.taken_um))
        return self.until(lambda s: s.robot.armed and not s.robot.stopped)

    def run_to_end(self, answer: Callable[[RoomState], str] | None = None) -> RoomState:
        """Answer what is asked, by default with the first choice, until no procedure runs."""
        while True:
            state = self.until(lambda s: s.procedure is None or s.question is not None)
            if state.procedure is None:
                return state
            choice = state.question.choices[0] if answer is None else answer(state)
            self.call("answer", question_id=state.question.question_id, choice=choice)
            self.until(lambda s: s.question != state.question)  # noqa: B023

    def calibrate(self) -> RoomState:
        self.arm()
        self.call("start_calibration")
        state = self.run_to_end()
        assert state.calibrated, state.last_outcome
        return state

    def approach(self, row_mm: float, col_mm: float) -> RoomState:
        """To a target so far from where the fiducial is with both stages at zero."""
        self.call("set_target", patient_mm=patient_mm(ORIGIN_MM[0] + row_mm, ORIGIN_MM[1] + col_mm))
        self.call("start_approach")
        return self.run_to_end()

    def ready(self, row_mm: float = 1.0, col_mm: float = -2.0) -> RoomState:
        """Calibrated, approached, and READY said."""
        if not self.state.calibrated:
            self.calibrate()
        self.arm()
        self.approach(row_mm, col_mm)
        return self.until(lambda s: s.ready)

    def receive(self, hold_id: int | None = None, **header: Any) -> int:
        """A slice comes by itself; with a hold it is assigned to it, else set aside."""
        return self.do(lambda: self._add_slice(hold_id, {**self.header, **header}))

    @contextmanager
    def record(self) -> Iterator[CaseRecord]:
        with CaseRecord(self.config.room.case_dir) as record:
            yield record

    # --- the room's own life, in the control loop's thread

    def true_plane_mm(self) -> np.ndarray:
        at_um = self.line.stage.positions_um()
        return np.array([ORIGIN_MM[0] + at_um["yt"] / 1000, ORIGIN_MM[1] + at_um["xt"] / 1000])

    def _meanwhile(self) -> None:
        if self._thread is None:
            self._thread = threading.get_ident()
        with_work = not self._todo.empty()
        while with_work:
            self._todo.get_nowait()()
            with_work = not self._todo.empty()
        execution = getattr(self.loop, "_execution", None)
        if execution is None or not self.scanning or not isinstance(self.loop._commands, Commands):
            return
        if execution.request is not None:
            self._add_slice(execution.request.hold_id, self.header)
        for asked in self.loop._record.requested_measurements():
            self._measure(asked)

    def _add_slice(
        self, hold_id: int | None, header: dict[str, Any], reason_code: str = "outside_hold"
    ) -> int:
        self._slices += 1
        geometry = {
            "shape": [128, 128],
            "position_mm": [0.0, 0.0, 0.0],
            "row_direction": [0.0, 0.0, -1.0],
            "col_direction": [1.0, 0.0, 0.0],
            "spacing_mm": [1.0, 1.0],
        } | header.get("geometry", {})
        row = self.loop._record.add_slice(
            NewSlice(
                sop_instance_uid=f"1.2.3.{self._slices}",
                frame=0,
                sha256="",
                path="none",
                state="quarantined" if hold_id is None else "assigned",
                hold_id=hold_id,
                reason_code="" if hold_id else reason_code,
                reason="",
                received_s=time.time(),
                received_monotonic_s=time.monotonic(),
                acquired_from_s=None,
                acquired_to_s=None,
                time_source="",
                header={**header, "geometry": geometry},
            )
        )
        return row.slice_id

    def _measure(self, asked: Measurement) -> None:
        """The round thing that is nearest to where it is expected, within the gate."""
        record = self.loop._record
        slices = [s for hold in asked.hold_ids for s in record.slices(hold_id=hold)]
        expected, gate_mm = asked.request["expected_plane_mm"], asked.request["gate_mm"]
        seen = [*self.decoys_mm, *([self.true_plane_mm()] if self.fiducial_visible else [])]
        around = self.true_plane_mm() if expected is None else np.array(expected)
        seen.sort(key=lambda place: float(np.linalg.norm(place - around)))
        if not seen or (gate_mm is not None and np.linalg.norm(seen[0] - around) > gate_mm):
            record.fail_measurement(asked.measurement_id, "nothing_round", "nothing round is seen")
            return
        sigma_mm = self.sigma_mm / np.sqrt(len(slices))
        found = seen[0] + self._rng.normal(0.0, sigma_mm, 2)
        plane = {
            "row_direction": [0.0, 0.0, -1.0],
            "col_direction": [1.0, 0.0, 0.0],
            "spacing_mm": [1.0, 1.0],
        }
        record.finish_measurement(
            asked.measurement_id,
            {
                "slice_id": slices[-1].slice_id,
                "slice_ids": [one.slice_id for one in slices],
                "centre_px": found.tolist(),
                "sigma_px": [sigma_mm, sigma_mm],
                "radius_px": 4.0,
                "snr": 30.0,
                "n_frames": len(slices),
                "patient_mm": list(patient_mm(*found)),
                "plane_mm": found.tolist(),
                "covariance_mm2": (np.eye(2) * sigma_mm**2).tolist(),
                "plane": plane,
                "scan_s": 1.0 * len(slices),
                "reconstruction": None,
            },
        )


def patient_mm(row_mm: float, col_mm: float) -> tuple[float, float, float]:
    """Patient LPS mm of a place in the image plane: rows grow along -z, columns along x."""
    return (float(col_mm), 0.0, float(-row_mm))


@contextmanager
def running_line_room(
    folder: Path, more: str = "", seed: int = 1, *, many_cases: bool = False
) -> Iterator[LineRoom]:
    room = LineRoom(folder, more, seed, many_cases=many_cases)
    room.loop.start()
    try:
        yield room
    finally:
        room.loop.close()
        room.line.close()
