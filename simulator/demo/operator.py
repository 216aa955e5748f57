"""The unattended operator of the demo: reads the state as a person reads the page, and acts.

It knows nothing but what the API says, so it goes on by itself after a restart in the middle of a
case. What it writes down (one line a puncture) is compared with the truth of the virtual room.
"""

from __future__ import annotations

import contextlib
import json
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from room_config.exit_codes import COULD_NOT
from service.client import RefusedByServiceError, RoomClient, ServiceGoneError
from simulator.config import VirtualRoom
from simulator.scene import true_fiducial_mm, true_guide
from simulator.truth_client import TruthAddress, ask_where

Vector = NDArray[np.float64]

WHO = "virtual operator"
_POLL_S = 0.05
_NOT_NOW = 409
_PATIENCE_S = 90.0
_MOST_FAILURES = 4
_TARGET_REACH_MM = 7.0
# with four axes: the skin and the target, below the plane of the lower ball joints
_ENTRY_DEPTH_MM, _TARGET_DEPTH_MM = 25.0, 80.0
_ASKED_IN_VAIN = 4
_CLOCK_READING_S = 0.02


class DemoFailedError(Exception):
    """The room could not do its job; the text says why."""

    exit_code = COULD_NOT


@dataclass(frozen=True)
class PunctureResult:
    """One puncture: what the room believed, and what was true."""

    procedure_id: int
    true_error_mm: float
    estimated_error_mm: float
    sigma_mm: float
    iterations: int
    frames: int
    scan_s: float

    def public(self) -> dict[str, Any]:
        """The keys that `demo --json` promises."""
        return {key: value for key, value in asdict(self).items() if key != "procedure_id"}


class Operator:
    """Drives a case to the wanted number of punctures through the API alone."""

    def __init__(
        self,
        client: RoomClient,
        room: VirtualRoom,
        truth: TruthAddress,
        results_file: Path,
        seed: int,
    ) -> None:
        self._client = client
        self._room = room
        self._truth = truth
        self._results_file = results_file
        self._seed = seed
        self._console = results_file.with_name("acquisitions.jsonl")
        self._compared_at = ""
        self._failures = 0
        self._failed_id: int | None = None
        self._changed_s = time.monotonic()
        self._last_event = -1
        self.results = self._read_results()
        self.state: dict[str, Any] = {}

    def run(
        self, punctures: int, look: Callable[[dict[str, Any]], None], check: Callable[[], None]
    ) -> None:
        """Act until the punctures are made; `look` sees every state, `check` may end it all."""
        while True:
            check()
            try:
                self.state = self._client.state().model_dump(mode="json")
                look(self.state)
                self._be_patient()
                if not self._act(punctures):
                    return
            except ServiceGoneError:
                # the service is gone or busy: `check` names a dead process in its next round
                self._be_patient()
            time.sleep(_POLL_S)

    def close(self) -> None:
        self._client.close()

    def stop(self) -> None:
        """Press STOP, if anybody still listens."""
        with contextlib.suppress(ServiceGoneError, RefusedByServiceError):
            self._client.stop()

    def _act(self, punctures: int) -> bool:
        """Do the next thing that a person would do; False when there is nothing left."""
        state = self.state
        robot = state["robot"]
        if not robot["linked"] or robot["moving"]:
            return True
        if robot["stopped"] or not robot["armed"] or not robot["position_certain"]:
            self._order(self._client.reset, robot["taken_um"])
        elif state["question"] is not None:
            self._answer(state["question"])
        elif state["procedure"] is not None:
            self._compare_clocks_if_slices_are_refused(state["acquisition_request"])
        elif state["ready"]:
            self._puncture(state)
        elif robot["insertion_locked"]:
            self._order(self._client.needle_out)  # READY was lost: nothing was inserted
        elif len(self.results) >= punctures:
            return False
        elif not state["calibrated"] or "calibrate again" in state["last_outcome"]:
            self._note_failure(state)
            self._order(self._client.start_calibration)
        else:
            self._note_failure(state)
            self._set_target(state)
            self._order(self._client.start_approach)
        return True

    def _compare_clocks_if_slices_are_refused(self, request: dict[str, Any] | None) -> None:
        """Slices asked for again and again: look whether the scanner's clock was set."""
        if request is None or request["request_id"] == self._compared_at:
            return
        if int(request["request_id"].rsplit(".", 1)[1]) % _ASKED_IN_VAIN != _ASKED_IN_VAIN - 1:
            return
        self._compared_at = request["request_id"]
        last = next((s for s in reversed(self._scans()) if s.get("kind") == "acquisition"), None)
        if last is not None:
            offset_s = last["started_s"] - last["scanner_clock_s"]
            self._order(self._client.compare_clocks, offset_s, _CLOCK_READING_S)

    def _scans(self) -> list[dict[str, Any]]:
        """What the scanner's console shows of its acquisitions."""
        lines = self._console.read_text().splitlines() if self._console.exists() else []
        return [json.loads(line) for line in lines]

    def _answer(self, question: dict[str, Any]) -> None:
        choice = next(
            c for c in ("confirm", "rescan", *question["choices"]) if c in question["choices"]
        )
        self._order(self._client.answer, question["question_id"], choice)

    def _puncture(self, state: dict[str, Any]) -> None:
        arrival = state["arrival"]
        if all(r.procedure_id != arrival["procedure_id"] for r in self.results):
            self._write_result(self._result(arrival, state["target_patient_mm"]))
            self._order(self._client.record_puncture)
        self._order(self._client.needle_out)

    def _result(self, arrival: dict[str, Any], target_mm: list[float]) -> PunctureResult:
        return PunctureResult(
            procedure_id=arrival["procedure_id"],
            true_error_mm=float(np.linalg.norm(self._miss_mm(arrival, target_mm))),
            estimated_error_mm=arrival["error_mm"],
            sigma_mm=arrival["sigma_mm"],
            iterations=arrival["iterations"],
            frames=arrival["frames"],
            scan_s=arrival["scan_s"],
        )

    def _miss_mm(self, arrival: dict[str, Any], target_mm: list[float]) -> Vector:
        """What is missing to the target in truth, along left-right and foot-head."""
        stages = ask_where(self._truth)
        depth_mm = arrival["tip_below_joint_mm"]
        if depth_mm is None:
            there_mm = true_fiducial_mm(self._room, stages.positions_mm)
        else:
            there_mm = true_guide(self._room, stages.positions_mm).at(-depth_mm)
        # the needle guide is steered in the coronal plane
        return np.asarray((np.asarray(there_mm) - np.asarray(target_mm))[[0, 2]])

    def _set_target(self, state: dict[str, Any]) -> None:
        """A point within reach, the same one for the same seed and puncture."""
        rng = np.random.default_rng((self._seed, len(self.results)))
        x, y, z = self._origin_mm(state)
        if state["guide"]:
            self._set_needle(rng, (x, z))
            return
        along_x, along_z = rng.uniform(-_TARGET_REACH_MM, _TARGET_REACH_MM, 2).tolist()
        self._order(self._client.set_target, (x + along_x, y, z + along_z))

    def _set_needle(self, rng: np.random.Generator, below: tuple[float, float]) -> None:
        """An entry point and a target below the lower plane, near the upright guide's line."""
        placement = self._room.placement
        lower_plane_mm = placement.origin_mm[1] + placement.bottom_plane_mm
        points = []
        for depth_mm, reach_mm in ((_ENTRY_DEPTH_MM, 2.0), (_TARGET_DEPTH_MM, 3.0)):
            along_x, along_z = rng.uniform(-reach_mm, reach_mm, 2).tolist()
            points.append((below[0] + along_x, lower_plane_mm - depth_mm, below[1] + along_z))
        self._order(self._client.set_entry, points[0])
        self._order(self._client.set_target, points[1])

    def _origin_mm(self, state: dict[str, Any]) -> tuple[float, float, float]:
        """Where the fiducial was seen at the end of the calibration; kept for later targets."""
        path = self._results_file.with_name("origin.json")
        if not path.exists():
            path.write_text(json.dumps(state["measurement"]["patient_mm"]))
        x, y, z = json.loads(path.read_text())
        return x, y, z

    def _note_failure(self, state: dict[str, Any]) -> None:
        """Give up when procedures keep failing; a single one is tried again."""
        outcome = state["last_outcome"]
        if " failed" not in outcome and " aborted" not in outcome:
            self._failures = 0
            return
        self._failures += 1
        if self._failures >= _MOST_FAILURES:
            raise DemoFailedError(outcome)

    def _be_patient(self) -> None:
        """Nothing may stay without any event for longer than a person would wait."""
        event = self.state.get("event_id", -1)
        if event != self._last_event:
            self._last_event, self._changed_s = event, time.monotonic()
        elif time.monotonic() - self._changed_s > _PATIENCE_S:
            prompt = self.state.get("prompt", "no state at all")
            raise DemoFailedError(f"nothing happened for {_PATIENCE_S:.0f} s: {prompt}")

    def _read_results(self) -> list[PunctureResult]:
        if not self._results_file.exists():
            return []
        lines = self._results_file.read_text().splitlines()
        return [PunctureResult(**json.loads(line)) for line in lines]

    def _write_result(self, result: PunctureResult) -> None:
        with self._results_file.open("a") as file:
            file.write(json.dumps(asdict(result)) + "\n")
        self.results.append(result)

    def _order(self, order: Callable[..., object], *arguments: object) -> None:
        """Give an order; "not now" (409) is no failure: the next look at the state says how."""
        try:
            order(*arguments)
        except RefusedByServiceError as error:
            if error.status != _NOT_NOW:
                raise DemoFailedError(f"the service refused a command: {error}") from error
