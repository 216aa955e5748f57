"""The room as commands find it: configuration, record, link to the robot, running procedure."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from case_record.record import CaseRecord
from robot_bridge.client.client import BridgeStatus
from room_config.load import Config
from room_config.service import GuideConfig
from service.procedure.arguments import gate_of
from service.procedure.calibration import Calibration
from service.procedure.identity import ProofArguments
from service.procedure.initial_estimate import is_proven, start_point
from service.procedure.plan import Travel
from service.procedure.registry import latest_calibration
from service.room.belief.goal import effective
from service.room.execution import Execution
from service.room.link import RoomLink
from service.room.motion_allowed import may_start
from service.room.refusal import ConflictError
from service.room.stop_latch import StopLatch
from service.room.validity import RESTS_ON, Now

SOURCE = "service"


def now_of(config: Config, link: RoomLink) -> Now:
    """How things stand beside the record: the robot, and how long a measurement is good for."""
    return Now(link.status, config.service.ready_valid_s, link.problem)


@dataclass(frozen=True, eq=False)
class RoomContext:
    """What commands act on, and what they have in common."""

    config: Config
    record: CaseRecord
    link: RoomLink
    execution: Execution
    stops: StopLatch = field(default_factory=StopLatch)

    def now(self) -> Now:
        """How things stand beside the record."""
        return now_of(self.config, self.link)

    def settings(self) -> Config:
        """The room's configuration with what was changed for this case."""
        return effective(self.config, self.record)

    def note(self, kind: str, by: str, body: dict[str, Any]) -> None:
        self.record.append_event(kind, body, source=SOURCE, who=by)

    def begin(self, name: str, arguments: dict[str, Any], by: str) -> int:
        with self.record.transaction():
            number = self.record.begin_procedure(name, arguments)
            body = {"procedure_id": number, **self.execution.permitted_by()}
            self.note(f"{name}_started", by, body)
        return number

    def abort(self, reason: str) -> None:
        if self.record.running_procedure() is not None:
            self.execution.abort(reason)

    def linked(self) -> BridgeStatus:
        status = self.link.status
        if status is None:
            raise ConflictError("no_link", f"No link to the robot: {self.link.problem}")
        return status

    def check_may_start(self) -> None:
        self.linked()
        if self.stops.standing:
            raise ConflictError("not_armed", "STOP was pressed: re-arm the robot first.")
        refusal = may_start(self.record, self.now())
        if refusal is not None:
            raise refusal

    def guide_wanted(self, guide: bool | None) -> GuideConfig | None:
        """The guide's table if four axes are to be used; None for one fiducial and two axes."""
        configured = self.config.service.guide
        if guide and configured is None:
            raise ConflictError(
                "no_guide", "This room has no [service.guide] table: it controls two axes only."
            )
        return configured if guide or guide is None else None

    def travel(self) -> dict[str, Travel]:
        status = self.link.status
        unsure_um = status.bound_um if status else {}
        return {
            axis: Travel(low, high, unsure_um.get(axis, 0))
            for axis, (low, high) in self.link.travel_left_um.items()
        }

    def seed(self) -> int:
        """Of the next procedure's random choices: from the case's seed and its number."""
        case = self.record.case()
        words = (case.seed if case else 0, len(self.record.procedures()))
        return int(np.random.SeedSequence(words).generate_state(1)[0])

    def start_point(self, *, guide: bool = False) -> Calibration:
        """The calibration with the estimate carried to where the robot stands now."""
        calibration = latest_calibration(self.record, guide=guide)
        if calibration is None:
            raise ConflictError(
                "not_calibrated",
                "Calibrate first (a new frame of reference voids any earlier calibration).",
            )
        status = self.linked()
        noise = gate_of(self.config).noise
        stood = self._has_stood(calibration.measurement_id)
        return start_point(self.record, calibration, status.positions_um, noise, stood=stood)

    def _has_stood(self, measurement_id: int) -> bool:
        """Whether the bridge knows of no motion since a measurement, parking and restarts too."""
        facts = self.record.measurement(measurement_id).request.get(RESTS_ON, {})
        status = self.linked()
        then = (facts.get("boot_id"), facts.get("last_motion"))
        return then == (status.boot_id, status.last_motion)

    def is_proven(self, start: Calibration) -> bool:
        """Whether what a start point says was seen to move with the robot, and not lost since."""
        stood = self._has_stood(start.measurement_id)
        return stood and is_proven(self.record, start, self.linked().positions_um)

    def proof_arguments(self, start: Calibration) -> ProofArguments:
        confirm, travel_um = self.config.service.confirm_moves, self.link.travel_left_um
        return ProofArguments(self.is_proven(start), dict(travel_um), confirm)
