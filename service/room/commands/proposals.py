"""Commands about what planning stations propose: record it, take it over, refuse it.

Whoever is on the network may propose; only the operator takes over.
"""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import structlog

from case_record.rows import Event
from service.procedure.registry import latest_calibration
from service.procedure.scan_frame import newest_frame
from service.room.commands.allowance import Allowances, Said
from service.room.commands.target import TargetCommands
from service.room.context import RoomContext
from service.room.proposals import (
    PROPOSED,
    REFUSED,
    SCAN_FRAME,
    TAKEN,
    WITHDRAWN,
    Plan,
    Point3,
    ProposalBook,
    ProposalState,
    Verdict,
    frame_of_reference,
    machine_of,
    why_frameless,
    why_no_direction,
    why_not_in_bore,
    why_other_frame,
    why_senseless,
    why_too_many,
    why_void,
    with_other_half,
)
from service.room.reach import OutOfReachError, ReachUnknownError, check_reach, entry_of
from service.room.refusal import ConflictError

log = structlog.get_logger()
TURNED_AWAY = "proposal_turned_away"
PLAN_RECEIVED = "plan_received"  # by the listener
REGISTRATION = "registration_received"


class ProposalCommands:
    """Proposals never change a plan by themselves."""

    def __init__(self, room: RoomContext, target: TargetCommands) -> None:
        self._room = room
        self._target = target
        self._book = ProposalBook()
        self._allowances, self._said = Allowances(), Said()
        self._put_off: dict[str, Event] = {}  # by machine, the newest of those that came too fast
        self._seen_event_id = -1
        self._looked_at = (-1, -1)

    def look_for_plans(self) -> None:
        """Propose what workstations have sent to the listener since the last look; withdraw what
        the table has left.
        """
        record = self._room.record
        changes = record.change_count()
        if changes != self._looked_at:
            self._looked_at = changes
            self._withdraw_void()
            for event in self._received():
                self._put_off_another(event)
        for machine, event in list(self._put_off.items()):
            if self._allowances.of(machine, PLAN_RECEIVED).take():
                del self._put_off[machine]
                self._heed(event)

    def _received(self) -> list[Event]:
        """What the listener noted since the last look."""
        record = self._room.record
        newest = record.last_event_id()
        if newest == self._seen_event_id:
            return []
        if self._seen_event_id < 0:
            done = [*record.events_of_kind(PROPOSED), *record.events_of_kind(TURNED_AWAY)]
            self._seen_event_id = max((e.body.get("received", 0) for e in done), default=0)
        events = record.events_of_kind(PLAN_RECEIVED, after_id=self._seen_event_id)
        self._seen_event_id = newest
        return events

    def _put_off_another(self, event: Event) -> None:
        """Every plan that comes waits for its machine's allowance; who waits too long is outdated
        by the next.
        """
        machine = machine_of(str(event.body.get("sender")))
        before = self._put_off.pop(machine, None)
        if before is not None and self._allowances.of(machine, PLAN_RECEIVED).take():
            self._heed(before)
        elif before is not None:
            self._alarm(
                "plans_too_many",
                f"{machine} sends plans faster than one per second: some were not looked at; the "
                "last one counts",
            )
        self._put_off[machine] = event

    def _alarm(self, code: str, text: str) -> None:
        if self._said.is_news(text):
            self._room.note("alarm", "", {"alarm": code, "text": text})

    def _heed(self, event: Event) -> None:
        try:
            self._propose_received(event)
        except (KeyError, TypeError, ValueError):  # whatever stands in it must not end the loop
            log.exception("plan not proposed", event_id=event.event_id)

    def _withdraw_void(self) -> None:
        for one in self._book.update(self._room.record):
            if one.state == "open" and (why := self._why_void(one.number)):
                body = {"proposal": one.number, "sender": one.sender, "why": why}
                self._room.note(WITHDRAWN, "", body)

    def _why_void(self, number: int) -> str:
        (proposed,) = self._room.record.events_of_kind(PROPOSED, number - 1)[:1]
        return why_void(self._room.record, proposed)

    def _propose_received(self, event: Event) -> None:
        body = event.body
        plan = Plan(
            sender=body["sender"],
            name=body["name"],
            via=body["via"],
            target_mm=_place(body.get("target_mm")),
            entry_mm=_place(body.get("entry_mm")),
            frame_of_reference_uid=body.get("frame_of_reference_uid", ""),
        )
        why = body.get("why") or why_frameless(self._room.record, plan, body.get("slice_ids", ()))
        if why:
            self._turn_away(plan, plan.sender, why, event.event_id)
        else:
            self.propose(plan, plan.sender, received=event.event_id)

    def _turn_away(self, plan: Plan, by: str, why: str, received: int) -> None:
        """Record it. To a storage command nobody answers why: of those the room says it."""
        room = self._room
        told = {"sender": plan.sender, "name": plan.name, "via": plan.via, "why": why}
        with room.record.transaction():
            room.note(TURNED_AWAY, by, {**told, "received": received})
            if received:
                text = f"plan {plan.name} ({plan.via}) from {plan.sender} was refused: {why}"
                self._alarm("plan_refused", text)

    def propose(self, plan: Plan, by: str, received: int = 0) -> Verdict:
        """Record a plan for the operator to see, unless it cannot be one.

        received: the event by which it came, if it came by DICOM.
        """
        self._withdraw_void()  # a half for where the table lay before joins no other
        known = self._book.update(self._room.record)
        why = why_no_direction(plan, guide=self._room.config.service.guide is not None)
        plan = with_other_half(plan, known)
        mine = [one for one in known if one.state == "open" and _same(one, plan)]
        if mine and not why:
            return self._waiting(mine[0], reach_known=not mine[0].note)
        verdict = Verdict("invalid", why) if why else self._judge(plan, known)
        if verdict.code != "proposed":
            self._turn_away(plan, by, verdict.text, received)
            return verdict
        note = "" if verdict.reach_known else verdict.text
        body = {**_as_json(plan), "note": note, "received": received}
        if (frame := newest_frame(self._room.record)) is not None:
            body[SCAN_FRAME] = frame.to_json()
        self._room.note(PROPOSED, by, body)
        new = self._book.update(self._room.record)[-1]
        return self._waiting(new, reach_known=verdict.reach_known)

    def _waiting(self, one: ProposalState, *, reach_known: bool) -> Verdict:
        case = self._room.record.case()
        case_uid = "" if case is None else case.case_uid
        return Verdict("proposed", _waits(one), one.number, reach_known, case_uid)

    def _judge(self, plan: Plan, known: list[ProposalState]) -> Verdict:
        why = why_senseless(plan) or why_other_frame(
            plan.frame_of_reference_uid, frame_of_reference(self._room.record)
        )
        if why:
            return Verdict("invalid", why)
        if why := why_too_many(plan, known):
            return Verdict("too_many", why)
        if why := why_not_in_bore(plan):
            return Verdict("out_of_reach", why)
        try:
            check_reach(self._room, plan)
        except OutOfReachError as error:
            return Verdict("out_of_reach", str(error))
        except ReachUnknownError as error:
            return Verdict("proposed", str(error))
        return Verdict("proposed", "", reach_known=True)

    def take_proposal(self, number: int, by: str, in_water: bool, label: str = "") -> None:
        """Make a proposal the target (and entry). in_water: a place in tissue; nobody but the
        operator can say that.
        """
        one = self._open(number)
        room = self._room
        plan = Plan(one.sender, one.name, one.via, one.target_mm, one.entry_mm, one.direction)
        here = frame_of_reference(room.record)
        why = (
            why_other_frame(one.frame_of_reference_uid, here)
            or why_frameless(room.record, one)
            or self._why_void(number)
        )
        if one.frame_of_reference_uid and not here:
            why = (
                "no slice names its frame of reference yet: whether the table has moved since it "
                "was planned is not known; acquire a slice"
            )
        if why:
            raise ConflictError("other_frame", f"Not accepted: {why}.")
        try:
            if plan.target_mm is not None:
                check_reach(room, plan, in_water=in_water)
        except OutOfReachError as error:
            raise ConflictError("out_of_reach", f"Not accepted: {error}.") from error
        except ReachUnknownError:
            pass  # an approach asks again before anything moves
        entry_mm = self._entry_of(plan)
        with room.record.transaction():
            if entry_mm is not None:
                self._target.set_entry(entry_mm, by)
            if one.target_mm is not None:
                self._target.set_target(one.target_mm, by, label or one.name, in_water)
            room.note(TAKEN, by, {"proposal": number, "sender": one.sender, "in_water": in_water})

    def _entry_of(self, plan: Plan) -> Point3 | None:
        """The plan's own, or what its direction says where a guide has one."""
        room = self._room
        if plan.entry_mm is not None or plan.direction is None or not room.config.service.guide:
            return plan.entry_mm
        calibration = latest_calibration(room.record, guide=True)
        if calibration is None:
            raise ConflictError(
                "not_calibrated",
                "Not accepted: the direction that it proposes can be used only once the guide is "
                "calibrated. Calibrate first.",
            )
        try:
            return entry_of(room, plan, calibration)
        except (OutOfReachError, ReachUnknownError) as error:
            raise ConflictError("out_of_reach", f"Not accepted: {error}.") from error

    def refuse_proposal(self, number: int, by: str, why: str = "") -> None:
        """Say no; the sender is told why."""
        one = self._open(number)
        self._room.note(REFUSED, by, {"proposal": number, "sender": one.sender, "why": why})

    def note_registration(self, by: str, name: str, matrix: list[list[float]]) -> None:
        """Somebody's transform from a fixture to the scanner: kept and shown, nothing else."""
        body = {"sender": by, "name": name, "matrix_lps": matrix}
        last = self._room.record.last_event(REGISTRATION)
        if last is None or dict(last.body) != body:
            self._room.note(REGISTRATION, by, body)

    def _open(self, number: int) -> ProposalState:
        known = {one.number: one for one in self._book.update(self._room.record)}
        one = known.get(number)
        if one is None:
            raise ConflictError("no_proposal", f"There is no proposal {number} in this case.")
        if one.state != "open":
            done = f"{one.state} by {one.by}" if one.by else one.reason
            raise ConflictError("no_proposal", f"Proposal {number} is not open: {done}.")
        return one


def _place(value: Any) -> Point3 | None:
    if value is None:
        return None
    x, y, z = value
    return float(x), float(y), float(z)


def _as_json(plan: Plan) -> dict[str, Any]:
    return {name: list(v) if isinstance(v, tuple) else v for name, v in asdict(plan).items()}


def _same(one: ProposalState, plan: Plan) -> bool:
    names = ("sender", "name", "target_mm", "entry_mm", "direction", "frame_of_reference_uid")
    return all(getattr(one, name) == getattr(plan, name) for name in names)


def _waits(one: ProposalState) -> str:
    note = f"; {one.note}" if one.note else ""
    both = ", target and entry point as one plan" if one.apart else ""
    return f"proposal {one.number} is waiting for the operator{both}{note}"
