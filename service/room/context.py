"""The room as commands find it: configuration, record, link to the robot, running procedure."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from case_record.record import CaseRecord
from robot_bridge.client.client import BridgeStatus
from room_config.load import Config
from room_config.service import GuideConfig
from service.procedure.calibration import Calibration
from service.procedure.fiducial_plan import gate_of
from service.procedure.plan import Travel
from service.procedure.registry import latest_calibration
from service.procedure.start_point import start_point
from service.room.belief.goal import effective
from service.room.execution import Execution
from service.room.link import RoomLink
from service.room.motion_allowed import may_start
from service.room.present import Now
from service.room.readiness import ConflictError
from service.room.stop_latch import StopLatch

SOURCE = "service"


def now_of(config: Config, link: RoomLink) -> Now:
    """How things stand beside the record: the robot, and how long a measurement is good for."""
    return Now(link.status, config.service.ready_valid_s, link.problem)


@dataclass(frozen=True, eq=False)
class Room:
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
                "no_guide", "This room has no [service.guide] table: it steers two axes only."
            )
        return configured if guide or guide is None else None

    def travel(self) -> dict[str, Travel]:
        return {axis: Travel(low, high) for axis, (low, high) in self.link.travel_left_um.items()}

    def seed(self) -> int:
        """Of the next procedure's random choices: from the case's seed and its number."""
        case = self.record.case()
        words = (case.seed if case else 0, len(self.record.procedures()))
        return int(np.random.SeedSequence(words).generate_state(1)[0])

    def start_point(self, *, guide: bool = False) -> Calibration:
        """The calibration with the estimate carried to where the robot stands now."""
        calibration = latest_calibration(self.record, guide=guide)
        if calibration is None:
            raise ConflictError("not_calibrated", "Calibrate first.")
        status = self.linked()
        noise = gate_of(self.config).noise
        return start_point(self.record, calibration, status.positions_um, noise)
