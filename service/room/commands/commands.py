"""What the operator (or a program with the operator's rights) may ask of the control loop.

Every command runs in the control loop's thread. What cannot be done now is a `ConflictError` whose
text says what to do instead; every command that is carried out is an event that names who asked.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from service.room.cases.life import CaseLife
from service.room.commands.case import CaseCommands
from service.room.commands.procedure import ProcedureCommands
from service.room.commands.proposals import ProposalCommands
from service.room.commands.record import RecordCommands
from service.room.commands.robot import RobotCommands
from service.room.commands.settings import SettingsCommands
from service.room.commands.target import TargetCommands
from service.room.context import RoomContext
from service.room.ready_keeper import keep_ready


class Commands:
    """Everything that may be asked, by name."""

    def __init__(self, room: RoomContext, life: CaseLife) -> None:
        self._room = room
        self._case = CaseCommands(room, life)
        self._proposals = ProposalCommands(room, TargetCommands(room))
        all_of_case = (*_all_of(room, life, self._proposals), *self._case.all())
        self._by_name = {one.__name__: one for one in all_of_case}

    def carry_out(self, name: str, arguments: Mapping[str, Any]) -> Any:
        """Carry out a command; raises ConflictError if it cannot be done now."""
        self._case.check(name)
        return self._by_name[name](**arguments)

    def keep_ready(self) -> None:
        """See `ready_keeper`: nobody asks for it, it is done all the time."""
        keep_ready(self._room)

    def look_for_plans(self) -> None:
        """See ProposalCommands: what workstations sent to the listener is proposed."""
        self._proposals.look_for_plans()


def _all_of(
    room: RoomContext, life: CaseLife, proposals: ProposalCommands
) -> tuple[Callable[..., Any], ...]:
    robot = RobotCommands(room)
    target, procedure, record = (
        TargetCommands(room),
        ProcedureCommands(room, life.cases),
        RecordCommands(room),
    )
    return (
        robot.reset,
        robot.note_stop,
        robot.jog,
        robot.lock_motion,
        robot.needle_out,
        target.set_target,
        target.reach,
        target.withdraw_target,
        target.choose_target,
        target.record_target,
        target.set_entry,
        procedure.start_calibration,
        procedure.start_approach,
        procedure.answer,
        procedure.confirm_acquisition,
        procedure.abort,
        procedure.puncture,
        record.assign_slice,
        record.give_up_slices,
        record.describe_case,
        record.compare_clocks,
        record.forget_clock,
        SettingsCommands(room).change_settings,
        proposals.propose,
        proposals.take_proposal,
        proposals.refuse_proposal,
        proposals.note_registration,
    )
