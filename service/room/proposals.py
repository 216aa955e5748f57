"""What planning stations propose: targets and entry points that nobody has taken over yet.

A proposal is an event; that it was taken over or refused is another. Nothing in it changes the
target before the operator says so, and of one sender only the newest is open. It is meant for the
table as it lies: when that may have moved, it is withdrawn.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from pydantic import BaseModel, ConfigDict

from case_record.record import CaseRecord
from case_record.rows import Event
from service.procedure.scan_frame import (
    STUDY_ACCEPTED,
    ScanFrame,
    calibration_good_since,
    other_place_since,
)

PROPOSED, TAKEN, REFUSED = "plan_proposed", "proposal_taken", "proposal_refused"
WITHDRAWN = "proposal_withdrawn"
SCAN_FRAME = "scan_frame"
OPENIGTLINK = "OpenIGTLink"
MOST_SENDERS, MOST_OF_ONE = 8, 4
_MOST_SHOWN = 24
_BORE_MM = 500.0
_NOT_TURNED = 1.0 - 1e-4

Point3 = tuple[float, float, float]


class ProposalState(BaseModel):
    """Patient LPS mm. state: open, taken, refused (with the reason), replaced by a newer one,
    joined with its other half as a newer one, or withdrawn because the table may have moved.
    """

    model_config = ConfigDict(frozen=True)

    number: int
    at_s: float
    sender: str
    name: str
    via: str
    target_mm: Point3 | None = None
    entry_mm: Point3 | None = None
    direction: Point3 | None = None
    frame_of_reference_uid: str = ""
    apart: bool = False
    note: str = ""
    state: str = "open"
    by: str = ""
    reason: str = ""


@dataclass(frozen=True)
class Plan:
    """What somebody proposes, patient LPS mm.

    sender: where it came from; name: what the sender calls it. direction: unit vector of the
    needle, where the plan has one. frame_of_reference_uid: empty where the way it came cannot tell.
    apart: its target and its entry point came in two messages.
    """

    sender: str
    name: str
    via: str
    target_mm: Point3 | None
    entry_mm: Point3 | None = None
    direction: Point3 | None = None
    frame_of_reference_uid: str = ""
    apart: bool = False


@dataclass(frozen=True)
class Verdict:
    """code: `proposed` (with its number in the case), `invalid`, `out_of_reach` or `too_many`; or
    why the room can take none now, `no_case` say.
    """

    code: str
    text: str
    number: int | None = None
    reach_known: bool = False
    case_uid: str = ""


def host_of(one: Plan | ProposalState) -> str:
    """The machine that it came from: who connects again has another port."""
    if one.via == OPENIGTLINK:
        return one.sender.rpartition(":")[0] or one.sender
    return machine_of(one.sender)


def machine_of(dicom_sender: str) -> str:
    """Its address, which follows the AE title: who sends may call itself what it likes."""
    return dicom_sender.rpartition(" ")[2]


def why_too_many(plan: Plan, known: Sequence[ProposalState]) -> str:
    """Why the operator is not to be shown one more; empty where that may be. One machine cannot
    take the place of the others.
    """
    hosts = [host_of(one) for one in known if one.state == "open" and one.sender != plan.sender]
    own = hosts.count(host_of(plan))
    if own >= MOST_OF_ONE:
        return f"{own} proposals of {host_of(plan)} are already waiting for the operator"
    others = set(hosts) - {host_of(plan)}
    if len(others) >= MOST_SENDERS:
        return f"proposals of {len(others)} stations are already waiting for the operator"
    return ""


def with_other_half(plan: Plan, known: Sequence[ProposalState]) -> Plan:
    """Target and entry point that one sender sends apart are one plan while they are open: with the
    half that it sent before, if it did so apart. A given entry point says the direction.
    """
    for one in known:
        is_half = one.apart or one.target_mm is None or one.entry_mm is None
        if one.state != "open" or one.sender != plan.sender or not is_half:
            continue
        if why_other_frame(one.frame_of_reference_uid, plan.frame_of_reference_uid):
            continue
        frame = plan.frame_of_reference_uid or one.frame_of_reference_uid
        both = replace(plan, frame_of_reference_uid=frame, direction=None, apart=True)
        if plan.entry_mm is None and one.entry_mm is not None:
            return replace(both, entry_mm=one.entry_mm)
        if plan.target_mm is None and one.target_mm is not None:
            return replace(both, target_mm=one.target_mm, name=one.name)
    return plan


def why_senseless(plan: Plan) -> str:
    """Why the numbers make no plan, whatever the room; empty where they do."""
    if plan.target_mm is None and plan.entry_mm is None:
        return "it has neither a target nor an entry point"
    for name, place in (("target", plan.target_mm), ("entry", plan.entry_mm)):
        if place is not None and not all(math.isfinite(value) for value in place):
            return f"its {name} is not three finite numbers"
    if plan.target_mm is not None and plan.target_mm == plan.entry_mm:
        return "its entry point and target are the same point, which gives no direction"
    return ""


def why_no_direction(plan: Plan, *, guide: bool) -> str:
    """Why its direction of the needle cannot be heeded; empty where it can, or has none. A matrix
    that is not turned (the patient's axes) states none to a room that cannot set one.
    """
    if guide or plan.direction is None or plan.direction[2] > _NOT_TURNED:
        return ""
    return (
        "it gives a direction of the needle, which this robot cannot set (it has no needle guide): "
        "send the target with a matrix that is not turned, or as a POINT labelled TARGET"
    )


def why_not_in_bore(plan: Plan) -> str:
    """Why no scanner could reach it; empty where one could."""
    for name, place in (("target", plan.target_mm), ("entry", plan.entry_mm)):
        if place is not None and not math.hypot(*place) <= _BORE_MM:
            return f"its {name} is {math.hypot(*place):.0f} mm from the isocentre"
    return ""


def why_other_frame(plan_frame: str, room_frame: str) -> str:
    """Why a plan is of another frame of reference; empty where it is not, or nobody can tell."""
    if not plan_frame or not room_frame or plan_frame == room_frame:
        return ""
    return "it is given in a different frame of reference from the slices"


def why_frameless(
    record: CaseRecord, plan: Plan | ProposalState, slice_ids: Sequence[int] = ()
) -> str:
    """Why a place on an image that names no frame of reference need not be one of now; empty where
    nothing says so. slice_ids: the images, if the listener knows them.
    """
    if plan.frame_of_reference_uid or plan.via == OPENIGTLINK:
        return ""
    if frame_of_reference(record):
        return "it lies on an image that names no frame of reference, while newer slices do"
    for row in map(record.slice, slice_ids):
        frame = ScanFrame.of_header(row.header)
        if row.seq <= calibration_good_since(record) or other_place_since(record, row.seq, frame):
            return "the table may have moved since its image was acquired; plan it on a newer one"
    return ""


def frame_of_reference(record: CaseRecord) -> str:
    """Of the newest slice that was used, or of the study that a person accepted since; empty where
    that names none, or there is none yet.
    """
    row = record.last_slice("assigned") or record.last_slice()
    accepted = record.last_event(STUDY_ACCEPTED)
    if accepted is not None and (row is None or row.seq < accepted.seq):
        return str(accepted.body.get("frame_of_reference") or "")
    return "" if row is None else str(row.header.get("frame_of_reference_uid") or "")


def why_void(record: CaseRecord, proposed: Event) -> str:
    """Why the place that was proposed is not where it was meant any more; empty if nothing says so.

    Whether the sender says its frame of reference or not: it saw the slices of its time.
    """
    if proposed.seq <= calibration_good_since(record):
        return (
            "the table may have moved since, or the case was finished and continued; plan it again"
        )
    frame = ScanFrame(**proposed.body.get(SCAN_FRAME, {}))
    other = other_place_since(record, proposed.seq, frame)
    if not other:
        return ""
    return f"slices from {other} have since arrived and the table may have moved; plan it again"


class ProposalBook:
    """The proposals of a case, from its events; each event is read once."""

    def __init__(self) -> None:
        self._case_uid = ""
        self._seen_event_id = 0
        self._known: dict[int, ProposalState] = {}

    def update(self, record: CaseRecord) -> list[ProposalState]:
        """Every open proposal and the newest others, in the order in which they came."""
        case = record.case()
        if case is None or case.case_uid != self._case_uid:
            self._case_uid = "" if case is None else case.case_uid
            self._seen_event_id, self._known = 0, {}
        newest = record.last_event_id()
        if newest != self._seen_event_id:
            for event in _events(record, self._seen_event_id):
                self._heed(event)
            self._seen_event_id = newest
        closed = [number for number, one in self._known.items() if one.state != "open"]
        for number in closed[: max(0, len(self._known) - _MOST_SHOWN)]:
            del self._known[number]
        return list(self._known.values())

    def _heed(self, event: Event) -> None:
        body = event.body
        if event.kind == PROPOSED:
            for number, one in self._known.items():
                if (one.sender, one.state) == (body["sender"], "open"):
                    self._close(number, _followed_by(event))
            self._known[event.event_id] = ProposalState(
                number=event.event_id, at_s=event.wall_s, **body
            )
        elif body.get("proposal") in self._known:
            state = event.kind.removeprefix("proposal_")
            change = {"state": state, "by": event.who, "reason": body.get("why", "")}
            self._close(int(body["proposal"]), change)

    def _close(self, number: int, change: Mapping[str, Any]) -> None:
        self._known[number] = self._known[number].model_copy(update=dict(change))


def _followed_by(event: Event) -> dict[str, str]:
    if event.body.get("apart"):
        return {"state": "joined", "reason": f"joined with its other half as {event.event_id}"}
    return {"state": "replaced", "reason": f"replaced by proposal {event.event_id}"}


def _events(record: CaseRecord, after_id: int) -> list[Event]:
    found = [
        e
        for kind in (PROPOSED, TAKEN, REFUSED, WITHDRAWN)
        for e in record.events_of_kind(kind, after_id)
    ]
    return sorted(found, key=lambda event: event.event_id)
