"""What the bridge does with one request: refuse it by the first rule it breaks, or carry it out.

A command is only accepted here: it is journalled, answered, and begins in the bridge's next tick.
An id that the journal knows is answered with what became of it and never moves anything again.
"""

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace

from robot_bridge.daemon import rules
from robot_bridge.daemon.arming import Arming
from robot_bridge.daemon.bridge_journal import BridgeJournal
from robot_bridge.daemon.bridge_view import BridgeView
from robot_bridge.daemon.declaring import Declaring
from robot_bridge.daemon.journal import CommandRecord, JournalError
from robot_bridge.daemon.motion import Ending
from robot_bridge.daemon.motion_in_flight import MotionInFlight
from robot_bridge.daemon.motor_watch import MotorWatch
from robot_bridge.daemon.motors import MotorError
from robot_bridge.protocol.messages import (
    TEXT_MAX,
    Answer,
    Arm,
    Code,
    CommandState,
    CorrectPosition,
    DeclarePosition,
    Disarm,
    Home,
    Message,
    Move,
    Rearm,
    SetDrives,
    SetInsertionLock,
    SetPhase,
)
from robot_bridge.protocol.phases import ALLOWED, WorkPhase


@dataclass(frozen=True, eq=False)
class Requests:
    """`refused` counts refusals by their code."""

    view: BridgeView
    permission: Arming
    motion: MotionInFlight
    motors: MotorWatch
    journal: BridgeJournal
    declaring: Declaring
    refused: Counter[str]

    def answer(self, request: Message) -> Answer | None:
        """None: not yet; `go_on_declaring` has the answer in the end."""
        if isinstance(request, Move | Home):
            return self._answer_command(request)
        if isinstance(request, Rearm):
            self.motors.clear_fault()
        broken = rules.refusal(self.view.standing(request), request)
        if broken is not None:
            self.journal.note("refused", request=type(request).__name__, code=broken[0].value)
            return self.refuse(*broken)
        answer = self._carried_out(lambda: _DO[type(request)](self, request))
        later = isinstance(request, DeclarePosition) and self.declaring.under_way
        return None if later else answer

    def go_on_declaring(self) -> Answer | None:
        answer = self._carried_out(self.declaring.go_on)
        return None if self.declaring.under_way else answer

    def give_up_declaring(self) -> Answer:
        axes = ", ".join(self.declaring.give_up())
        return self.refuse(
            Code.STOP_LATCHED, f"a stop came first: declare the position of {axes} again"
        )

    def _carried_out(self, do: Callable[[], object]) -> Answer:
        try:
            do()
        except JournalError as error:
            return self.refuse(Code.JOURNAL, str(error))
        except MotorError as error:
            return self.refuse(Code.MOTOR_FAULT, str(error))
        return Answer(Code.OK, "", None, {})

    def refuse(self, code: Code, text: str) -> Answer:
        self.refused[code.value] += 1
        return Answer(code, text[:TEXT_MAX], None, {})

    # --- requests that are no motion ----------------------------------------------------------

    def _arm(self, request: Arm) -> None:
        self.permission.armed = True
        self.journal.note("arm", by=request.by)

    def _disarm(self, request: Disarm) -> None:
        self.motion.stop(Ending(CommandState.STOPPED, Code.DISARMED, "disarmed"))
        self.permission.armed = False
        self.journal.note("disarm", by=request.by)

    def _rearm(self, request: Rearm) -> None:
        next_phase = ALLOWED[self.permission.phase].after_rearm
        assert next_phase is not None
        self.journal.rearm(request.by)
        self.permission.rearm(next_phase)

    def _set_phase(self, request: SetPhase) -> None:
        self.permission.phase = WorkPhase(request.phase)
        self.journal.note("phase", phase=request.phase, by=request.by)

    def _set_lock(self, request: SetInsertionLock) -> None:
        if request.locked:
            text = "the insertion lock was set during motion"
            self.motion.stop(Ending(CommandState.STOPPED, Code.LOCKED_IN_MOTION, text))
        self.journal.lock(request.locked, request.by)

    def _declare(self, request: DeclarePosition) -> None:
        self.declaring.begin(request)

    def _set_drives(self, request: SetDrives) -> None:
        self.motion.set_drives(on=request.on)
        self.journal.note("drives", on=request.on, by=request.by)

    def _correct(self, request: CorrectPosition) -> None:
        self.motion.correct_position(request.correction_um, request.within_um)

    # --- commands -----------------------------------------------------------------------------

    def _answer_command(self, request: Move | Home) -> Answer:
        record = _record_of(request)
        known = self.journal.known(record.command_id)
        if known is not None:
            return self._answer_known(record, known)
        broken = rules.refusal(self.view.standing(request), request)
        try:
            if broken is not None:
                return self._refuse_command(record, *broken)
            self.motion.accept(record)
        except JournalError as error:
            return replace(self.refuse(Code.JOURNAL, str(error)), state=CommandState.REFUSED.value)
        return _answer_of(record)

    def _answer_known(self, record: CommandRecord, known: CommandRecord) -> Answer:
        if known.asks_the_same(record):
            return _answer_of(known if known.state.final else self.motion.command or known)
        text = f"command {record.command_id[:60]!r} was already used for another command"
        answer = self.refuse(Code.COMMAND_ID_REUSED, text)
        return replace(answer, state=CommandState.REFUSED.value)

    def _refuse_command(self, record: CommandRecord, code: Code, text: str) -> Answer:
        self.refused[code.value] += 1
        text = text[:TEXT_MAX]
        refused = replace(record, state=CommandState.REFUSED, code=code.value, text=text)
        if code is not Code.MALFORMED:  # a malformed id is no id
            self.journal.refuse(refused)
        return _answer_of(refused)


_DO: dict[type[Message], Callable] = {
    Arm: Requests._arm,
    Disarm: Requests._disarm,
    Rearm: Requests._rearm,
    SetPhase: Requests._set_phase,
    SetInsertionLock: Requests._set_lock,
    DeclarePosition: Requests._declare,
    CorrectPosition: Requests._correct,
    SetDrives: Requests._set_drives,
}


def _record_of(request: Move | Home) -> CommandRecord:
    if isinstance(request, Home):
        return CommandRecord(request.command_id, "home", {}, None, "", axes=request.axes)
    return CommandRecord(
        request.command_id,
        "move",
        request.setpoints_um,
        request.measurement_id,
        request.based_on_motion,
    )


def _answer_of(record: CommandRecord) -> Answer:
    return Answer(str(record.code), record.text, record.state.value, dict(record.readback_um))
