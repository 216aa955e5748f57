"""Carries out the steps of a procedure: moves the robot, waits for slices, asks the operator."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from case_record.record import CaseRecord
from case_record.rows import Hold, Measurement
from robot_bridge.client.client import BridgeStatus, LinkLostError, MoveOutcome, RefusedError
from robot_bridge.protocol.messages import Code, CommandState
from robot_bridge.protocol.phases import WorkPhase, motion_allowed
from room_config.load import Config
from service.procedure.observe import ABORT, CONFIRM, ProcedureFailedError
from service.procedure.plan import PLAN_VOID, why_void
from service.procedure.runner import measurement_name
from service.procedure.scan_frame import ScanFrame, frame_of
from service.procedure.steps import (
    Acquire,
    Acquired,
    Answered,
    AskOperator,
    Measure,
    Measured,
    Moved,
    MoveTo,
    Outcome,
    Step,
)
from service.room.going_on import GO_ON, Permitted
from service.room.link import RoomLink
from service.room.measuring import measure_request, measured_from_result
from service.room.scanner_clock import clock_margin_s, is_by_another_clock
from service.room.validity import RESTS_ON, bridge_facts, rests_on, why_stood_no_more
from sr_engine.request import is_at_position

_SERVICE = "service"
_STOPPED_BY_PEOPLE = frozenset({Code.OPERATOR_STOP.value, Code.EMERGENCY_STOP.value})


def _stands_at(hold: Hold, status: BridgeStatus) -> bool:
    """Whether the robot has stood at the hold ever since it began."""
    undisturbed = bool(hold.bridge) and why_stood_no_more(hold.bridge, status) is None
    return undisturbed and hold.readback_um == dict(status.positions_um)


class ProcedureAbortedError(Exception):
    """The operator ended the procedure, or STOP did. The robot stands still."""


@dataclass(frozen=True)
class AcquisitionRequest:
    """What the scanner operator is asked to acquire now."""

    request_id: str
    hold_id: int
    count: int
    slice_position_mm: float | None = None


@dataclass(frozen=True)
class Question:
    """What the operator is asked; an answer must name `question_id`."""

    question_id: str
    question: str
    choices: tuple[str, ...]
    plan: Mapping[str, Any] | None


class Execution:
    """Executes one step at a time; between looks at the record it lets the control loop tick."""

    def __init__(
        self, config: Config, record: CaseRecord, link: RoomLink, tick: Callable[[], None]
    ) -> None:
        self._config = config
        self._record = record
        self._link = link
        self._tick = tick
        self._answer: Answered | None = None
        self._abort: str | None = None
        self._permitted = Permitted(record)
        self.request: AcquisitionRequest | None = None
        self.question: Question | None = None
        self.prompt = ""

    def execute(self, step: Step, command_id: str) -> Outcome:
        """Carry out a step; raises ProcedureAbortedError when the operator or STOP ends it."""
        self._check_abort()
        self._permitted.recall()
        if isinstance(step, MoveTo):
            return self._move(step, command_id)
        if isinstance(step, Acquire):
            return self._acquire(step)
        if isinstance(step, Measure):
            return self._measure(step)
        return self._ask(step, command_id)

    def answer(self, choice: str, who: str) -> None:
        self._answer = Answered(choice, who)
        self.question = None  # at once: nobody sees or answers it a second time
        if choice == CONFIRM and self._link.status is not None:
            self._permitted.confirm(self._link.status)

    def abort(self, reason: str) -> None:
        """End the running procedure at its next look; nothing if none runs."""
        self._abort = reason

    @property
    def aborting(self) -> str | None:
        """Why the running procedure is about to end, if it is."""
        return self._abort

    def clear(self) -> None:
        self._answer = self._abort = self.request = self.question = None
        self.prompt = ""
        self._permitted.forget()

    def permitted_by(self) -> dict[str, Any]:
        """How the bridge stands as somebody orders a procedure: only then it may move by it."""
        status = self._link.status
        return {} if status is None else self._permitted.facts(status)

    # Moves

    def _move(self, step: MoveTo, command_id: str) -> Moved:
        case_uid = command_id.split("/")[0]
        measurement = None
        if step.rests_on is not None:
            measurement = measurement_name(case_uid, step.rests_on)
        while True:
            self._wait_until_ready_to_move(step, command_id)
            void = self._why_void(step, command_id)
            if void:
                return self._refuse(void)
            with self._record.transaction():
                self._record.end_open_hold(time.time())
                self._record.send_move(
                    command_id,
                    setpoints_um=step.setpoints_um,
                    measurement_id=step.rests_on,
                    purpose=step.purpose,
                )
                self._record.append_event(
                    "move_sent",
                    {"command_id": command_id, "setpoints_um": dict(step.setpoints_um)},
                    source=_SERVICE,
                )
            self.prompt = f"The robot is moving ({step.purpose})."
            try:
                if not self._stands_in_motion_phase(step.phase):
                    self._link.enter_phase(step.phase, _SERVICE)
                outcome = self._link.client.move(
                    command_id,
                    step.setpoints_um,
                    measurement,
                    based_on_motion=self._based_on_motion(step),
                )
            except LinkLostError as error:
                self._link.lost(error)
                self._permitted.interrupt()
                continue  # asked again under the same id: the bridge's journal answers
            except RefusedError as error:
                outcome = MoveOutcome(command_id, CommandState.REFUSED, error.code, error.text, {})
            return self._settled(step, outcome)

    def _based_on_motion(self, step: MoveTo) -> str | None:
        """The motion after which the measurement was taken on which a move rests; of one that
        rests on none, the last one. None where the record does not say.
        """
        if step.rests_on is None:
            status = self._link.status
            return None if status is None else status.last_motion
        facts = self._record.measurement(step.rests_on).request.get(RESTS_ON)
        return None if facts is None else str(facts["last_motion"])

    def _why_void(self, step: MoveTo, command_id: str) -> str:
        """Why the plan behind a move is void; a move that was sent is only asked for again."""
        status = self._link.status
        if step.from_um is None or status is None or self._record.has_move(command_id):
            return ""
        newest = self._record.last_measurement("done")
        newest_id = None if newest is None else newest.measurement_id
        return why_void(step.from_um, step.rests_on, status.positions_um, newest_id)

    def _refuse(self, reason: str) -> Moved:
        hold = self._hold_to_image(fresh=False)
        self._record.append_event("plan_void", {"reason": reason}, source=_SERVICE)
        return Moved("REFUSED", PLAN_VOID, reason, hold.hold_id, hold.readback_um)

    def _stands_in_motion_phase(self, wanted: WorkPhase) -> bool:
        status = self._link.status
        return status is not None and status.phase == wanted and motion_allowed(status.phase)

    def _settled(self, step: MoveTo, outcome: MoveOutcome) -> Moved:
        settled_at_s = time.time()
        readback_um = dict(outcome.readback_um)
        status = self._link.status
        if not readback_um and status is not None:
            readback_um = dict(status.positions_um)
        with self._record.transaction():
            self._record.end_move(
                outcome.command_id, outcome.state, outcome.code, outcome.text, readback_um
            )
            self._record.append_event(
                "move_ended",
                {
                    "command_id": outcome.command_id,
                    "state": str(outcome.state),
                    "code": outcome.code,
                    "readback_um": readback_um,
                },
                source=_SERVICE,
            )
            hold = self._begin_hold(step, readback_um, settled_at_s)
        self._check_abort()
        return Moved(str(outcome.state), outcome.code, outcome.text, hold.hold_id, hold.readback_um)

    def _begin_hold(
        self, step: MoveTo | None, readback_um: Mapping[str, int], settled_at_s: float
    ) -> Hold:
        next_set = self._record.next_set_id()
        in_set = step is not None and not step.new_set
        return self._record.begin_hold(
            set_id=next_set - 1 if in_set else next_set,
            place=step.place if step else 0,
            setpoints_um=step.setpoints_um if step else readback_um,
            readback_um=readback_um,
            shift_um=step.shift_um if step else {},
            shift_px=step.shift_px if step else (0.0, 0.0),
            settled_at_s=settled_at_s,
            bridge=None if self._link.status is None else bridge_facts(self._link.status),
        )

    def _wait_until_ready_to_move(self, step: MoveTo, command_id: str) -> None:
        """Until the robot may move, and by an order that was given as it stands now.

        A robot that was stopped, disarmed or lost since moves only when somebody says: go on.
        """
        while True:
            status = self._link.status
            if status is None:
                self.prompt = f"No link to the robot: {self._link.problem}"
            elif status.moving:
                self.prompt = "The robot is coming to a stop."
            elif status.stopped or not status.armed:
                self._permitted.interrupt()
                self.prompt = "Re-arm the robot to continue."
            elif not status.position_certain:
                self._permitted.interrupt()
                self.prompt = "The robot was restarted. Check it, then re-arm to continue."
            elif self._permitted.covers(status):
                return
            else:
                self._ask_to_go_on(step, command_id, status)
                continue
            self._wait()

    def _ask_to_go_on(self, step: MoveTo, command_id: str, status: BridgeStatus) -> None:
        """Raises ProcedureAbortedError unless the answer is to go on."""
        ways = ", ".join(
            f"{axis} {status.positions_um[axis] / 1000:.3f} → {to_um / 1000:.3f} mm"
            for axis, to_um in step.setpoints_um.items()
            if status.positions_um.get(axis, to_um) != to_um
        )
        question = f"The robot was interrupted. Continue ({step.purpose}: {ways or 'no motion'})?"
        answer = self._ask(
            AskOperator(question, (GO_ON, ABORT)), f"{command_id}/go-on.{status.stop_count}"
        )
        if answer.choice != GO_ON:
            raise ProcedureAbortedError(f"ended by {answer.who} after an interruption")
        self._permitted.give(command_id, self._link.status or status, answer.who, _SERVICE)

    # Slices and measurements

    def _acquire(self, step: Acquire) -> Acquired:
        hold = self._hold_to_image(fresh=step.fresh)
        self._expect(hold, step)
        self._let_clocks_agree(hold)
        attempt = 0
        while True:
            if is_by_another_clock(self._record, hold):
                hold = self._hold_again(hold)
            missing = step.count - self._assigned(hold, step.slice_position_mm)
            if missing <= 0:
                break
            self._expect(hold, step)
            where = "" if step.slice_position_mm is None else f"@{step.slice_position_mm:.1f}"
            self.request = AcquisitionRequest(
                f"{hold.hold_id}.{step.count}{where}.{attempt}",
                hold.hold_id,
                missing,
                step.slice_position_mm,
            )
            again = " again" if attempt else ""
            at = "" if not where else f" at {step.slice_position_mm:.1f} mm"
            self.prompt = f"Acquire {missing} coronal slice{'s' * (missing > 1)}{at}{again}."
            self._wait_for_slices(hold, missing, step.slice_position_mm)
            attempt += 1
        self.request = None
        return Acquired(hold.hold_id, step.count)

    def _hold_again(self, hold: Hold) -> Hold:
        """The same hold by the clock as it is now; the robot stands where it stood."""
        now_s = time.time()
        with self._record.transaction():
            self._record.end_open_hold(now_s)
            return self._record.begin_hold(
                set_id=hold.set_id,
                place=hold.place,
                setpoints_um=hold.setpoints_um,
                readback_um=hold.readback_um,
                shift_um=hold.shift_um,
                shift_px=hold.shift_px,
                settled_at_s=now_s,
                bridge=hold.bridge,
            )

    def _expect(self, hold: Hold, step: Acquire) -> None:
        """Tell the listener how many slices the hold has in all: those elsewhere come on top."""
        elsewhere = self._assigned(hold, None) - self._assigned(hold, step.slice_position_mm)
        self._record.expect_slices(hold.hold_id, step.count + elsewhere)

    def _let_clocks_agree(self, hold: Hold) -> None:
        """Ask for slices only when the hold is older than the scanner's clock is uncertain."""
        margin_s = clock_margin_s(self._config, self._record, time.time())
        wait_s = max(self._config.service.settle_s, margin_s)
        began_s = time.monotonic()  # the other clock may be set meanwhile
        if hold.settled_monotonic_s is not None and hold.settled_monotonic_s < began_s:
            began_s = hold.settled_monotonic_s
        while time.monotonic() < began_s + wait_s:
            self.prompt = "Waiting for the robot to settle before the next slice."
            self._wait()

    def _assigned(self, hold: Hold, slice_position_mm: float | None) -> int:
        rows = self._record.slices(hold_id=hold.hold_id, state="assigned")
        return sum(is_at_position(row, slice_position_mm) for row in rows)

    def _wait_for_slices(self, hold: Hold, missing: int, slice_position_mm: float | None) -> None:
        """Until the slices are there, or as many came but were set aside, or none for too long."""
        last = self._record.last_slice()
        last_id = last.slice_id if last else 0
        wanted = self._assigned(hold, slice_position_mm) + missing
        deadline_s = time.monotonic() + self._config.service.rescan_after_s
        while time.monotonic() < deadline_s:
            assigned = self._assigned(hold, slice_position_mm)
            aside = self._record.count_slices_after(last_id, "quarantined")
            if assigned >= wanted or (aside and assigned + aside >= wanted):
                return
            if is_by_another_clock(self._record, hold):
                return
            self._wait()

    def _hold_to_image(self, *, fresh: bool) -> Hold:
        """The open hold; a new one where the robot stands if asked for, or after a restart."""
        while True:
            hold = self._record.open_hold()
            status = self._link.status
            if status is not None and not status.moving and status.position_certain:
                if hold is not None and not fresh and _stands_at(hold, status):
                    return hold
                with self._record.transaction():
                    self._record.end_open_hold(time.time())
                    return self._begin_hold(None, dict(status.positions_um), time.time())
            self.prompt = "The robot's position is uncertain. Check it, then re-arm to continue."
            self._wait()

    def _measure(self, step: Measure) -> Measured:
        imaging = self._config.imaging
        radius_mm = (imaging.fiducial_radius_min_mm, imaging.fiducial_radius_max_mm)
        hold_ids = [h.hold_id for h in step.holds]
        request = measure_request(step, radius_mm, imaging.start_region_px)
        status = self._linked()
        request[RESTS_ON] = rests_on(self._record, status)
        number = self._record.request_measurement(step.method, hold_ids, request)
        if disturbed := self._disturbed(hold_ids, status):
            self._record.fail_measurement(number, "disturbed", disturbed)
        self.prompt = "Localizing the fiducial."
        while (measurement := self._record.measurement(number)).state == "requested":
            self._wait()
        if measurement.state == "failed" or measurement.result is None:
            return Measured(number, measurement.reason_code or "failed", measurement.reason)
        self._check_scan_frame(measurement)
        return measured_from_result(number, measurement.result)

    def _check_scan_frame(self, measurement: Measurement) -> None:
        """Raise ProcedureFailedError for slices that are not as those that it rests on."""
        here, expected = frame_of(self._record, measurement), self._scan_frame_before(measurement)
        if here is None or expected is None:
            return
        if other := expected.other_place(here):
            text = f"the slices are from {other}: the table may have moved. Set the target again"
            raise ProcedureFailedError("other_place", text)
        if other := expected.other_protocol(here):
            text = (
                f"the slices have {other}, so oil appears elsewhere in them. Start again with these"
            )
            raise ProcedureFailedError("other_protocol", text)

    def _scan_frame_before(self, measurement: Measurement) -> ScanFrame | None:
        """What the running procedure was begun with, or measured first."""
        running = self._record.running_procedure()
        if running is None:
            return None
        begun_with = running.arguments.get("scan_frame")
        if begun_with is not None:
            return ScanFrame(**begun_with)
        first = self._record.first_measurement_since(running.begun_seq)
        return None if first is None else frame_of(self._record, first)

    def _linked(self) -> BridgeStatus:
        """The bridge's status; waits for the link, for what is measured is of a robot that stands
        somewhere.
        """
        while (status := self._link.status) is None:
            self.prompt = f"No link to the robot: {self._link.problem}"
            self._wait()
        return status

    def _disturbed(self, hold_ids: list[int], status: BridgeStatus) -> str:
        """What happened to the robot while its slices were taken; empty if nothing did."""
        for hold in map(self._record.hold, hold_ids):
            known = dict(hold.bridge)
            if not known:
                return "the robot's position at the hold is unknown"
            if hold.ended_at_s is not None:  # it moved on, as commanded, to the next place
                known["last_motion"] = status.last_motion
            lost = why_stood_no_more(known, status)
            if lost is not None:
                return f"the slices no longer count: {lost.text}"
        return ""

    # The operator

    def _ask(self, step: AskOperator, question_id: str) -> Answered:
        self._answer = None
        self.question = Question(question_id, step.question, step.choices, step.plan)
        self.prompt = step.question
        while self._answer is None:
            self._wait()
        self.question = None
        return self._answer

    def _wait(self) -> None:
        self._tick()
        self._check_abort()
        status = self._link.status
        if status is not None and status.stopped and status.stop_reason in _STOPPED_BY_PEOPLE:
            raise ProcedureAbortedError(f"STOP ({status.stop_reason.replace('_', ' ')})")

    def _check_abort(self) -> None:
        if self._abort is not None:
            reason, self._abort = self._abort, None
            raise ProcedureAbortedError(reason)
