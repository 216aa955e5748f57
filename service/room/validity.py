"""Whether what was measured still holds, and if not, why not: the one place that says so.

A measurement says where the fiducial was. It says where it *is* only while everything that it rests
on still stands: the case, the study and frame of reference of its slices, their protocol, the
robot's bridge with its last motion, its certain position, no stop, park or fault since, and an age
within `[service] ready_valid_s`. A READY rests on its measurement, on the target that was
approached, and on the insertion lock.

The page, the API, OpenIGTLink, DICOM outputs, the puncture and the alarms ask `why_not_now` and
`readiness` and show what they answer. Both only read; what came first they know by the record's own
order (`seq`), never by a clock that somebody may set.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cache, partial
from pathlib import Path
from typing import Any

from case_record.record import CaseRecord, CaseRecordError
from case_record.rows import Event, Measurement
from robot_bridge.client.client import BridgeStatus
from service.procedure.initial_estimate import POSITION_DECLARED
from service.procedure.plan import SAME_PLACE_UM
from service.procedure.registry import APPROACHES
from service.procedure.scan_frame import (
    CASE_REOPENED,
    ScanFrame,
    frame_of,
    other_place_since,
    others_since,
    seen_seq,
)
from service.procedure.targets import current_entry_number, current_target, why_void_target

READY, READY_LOST = "ready", "ready_lost"
PUNCTURE, NEEDLE_OUT = "puncture", "needle_out"
RESTS_ON = "rests_on"


@cache
def computer_start() -> str:
    """Names this start of the computer: the monotonic clock begins anew with each."""
    try:
        return Path("/proc/sys/kernel/random/boot_id").read_text().strip()
    except OSError:
        return ""


@dataclass(frozen=True)
class Lost:
    """Why something does not hold any more. `code` is for programs, `text` for people."""

    code: str
    text: str


@dataclass(frozen=True)
class Now:
    """What else than the record says how things stand.

    status: the bridge's newest one; None without a link, `link_problem` says why then. valid_s: how
    old a measurement may be. monotonic_s, computer: the clock that nobody sets, and since which
    start of the computer it runs.
    """

    status: BridgeStatus | None
    valid_s: float
    link_problem: str = ""
    monotonic_s: float = field(default_factory=time.monotonic)
    computer: str = field(default_factory=computer_start)


@dataclass(frozen=True)
class Readiness:
    """How it stands with the newest approach that came to its end; `arrival` is its result.

    ready: the needle guide is at its target now, and motion is locked. lost: why it is not, of a
    guide that was there. Neither: the lock is under way.
    """

    procedure_id: int
    arrival: Mapping[str, Any]
    ready: bool
    lost: Lost | None = None


# What a measurement rests on: written down by the control loop when it is asked for


def bridge_facts(status: BridgeStatus) -> dict[str, Any]:
    """How the bridge stands, as holds and measurements keep it."""
    return {
        "boot_id": status.boot_id,
        "last_motion": status.last_motion,
        "stop_count": status.stop_count,
        "parked": status.parked,
        "positions_um": dict(status.positions_um),
    }


def rests_on(record: CaseRecord, status: BridgeStatus) -> dict[str, Any]:
    """What a measurement that is asked for now will rest on."""
    target = current_target(record)
    return {
        **bridge_facts(status),
        "target": None if target is None else target.number,
        "entry": current_entry_number(record),
        "monotonic_s": time.monotonic(),
        "computer": computer_start(),
    }


# Whether it holds


def why_not_now(record: CaseRecord, measurement: Measurement, now: Now) -> Lost | None:
    """Return why a finished measurement does not say any more where the fiducial is, or None."""
    return _why_not(record, measurement, now, _robot_changed)


def why_not_carried(record: CaseRecord, measurement: Measurement, now: Now) -> Lost | None:
    """Return why the fiducial is not where the robot's moves since a finished measurement have
    carried it, or None: as `why_not_now`, but for the moves that this case ordered.
    """
    return _why_not(record, measurement, now, partial(_moved_otherwise, record, measurement))


def _why_not(
    record: CaseRecord,
    measurement: Measurement,
    now: Now,
    robot_changed: Callable[[Mapping[str, Any], Now], Lost | None],
) -> Lost | None:
    """robot_changed: what counts as a change of the robot, by what the measurement rests on."""
    if record.doubt:
        return Lost("record_changed", record.doubt)
    facts = measurement.request.get(RESTS_ON)
    if facts is None:
        return Lost("unknown", "it is unknown what the measurement relies on")
    return (
        _case_ended(record, measurement)
        or robot_changed(facts, now)
        or _scanner_changed(record, measurement)
        or _too_old(facts, now)
        or _measured_again(record, measurement)
    )


def readiness(record: CaseRecord, now: Now) -> Readiness | None:
    """Return how it stands with READY; None if no approach came to its end, or the needle is out
    since, or a procedure runs.
    """
    standing = ready_arrival(record)
    if standing is None:
        return None
    procedure_id, arrival = standing
    noted = _noted_loss(record, procedure_id)
    published = was_ready(record, procedure_id)
    lost = noted or _why_not_there(record, procedure_id, arrival, now)
    locked = now.status is not None and now.status.insertion_locked
    if lost is None and published and not locked:
        lost = Lost("lock_missing", "the insertion lock is not set")
    if lost is not None and not needle_may_be_in(record) and _went_on(record, procedure_id):
        return None  # nobody was ever told READY of it, or the needle is out: history
    return Readiness(procedure_id, arrival, lost is None and locked, lost)


def ready_arrival(record: CaseRecord) -> tuple[int, dict[str, Any]] | None:
    """The approach (id and result) that came to its end last, until the needle is out.

    What came first is said by the record's order. Whether the guide is at the target still is
    another question: `readiness`.
    """
    done = [record.last_procedure(name, "done") for name in APPROACHES]
    arrival = max((row for row in done if row), key=lambda row: row.procedure_id, default=None)
    if arrival is None or arrival.result is None or arrival.ended_s is None:
        return None
    if record.running_procedure() is not None:
        return None
    out = record.last_event(NEEDLE_OUT)
    if out is not None and out.seq > arrival.ended_seq:
        return None
    return arrival.procedure_id, dict(arrival.result)


def needle_may_be_in(record: CaseRecord) -> bool:
    """From READY, or a puncture, until somebody says that the needle is out."""
    out = record.last_event(NEEDLE_OUT)
    out_seq = 0 if out is None else out.seq
    begun = (record.last_event(kind) for kind in (READY, PUNCTURE))
    return any(event is not None and event.seq > out_seq for event in begun)


def _went_on(record: CaseRecord, procedure_id: int) -> bool:
    last = record.last_ended_procedure()
    return last is not None and last.procedure_id > procedure_id


def was_ready(record: CaseRecord, procedure_id: int) -> bool:
    """Whether READY was ever said of this approach: from then on the needle may go in."""
    said = record.last_event(READY)
    return said is not None and said.body["procedure_id"] == procedure_id


def lost_since_ready(record: CaseRecord, procedure_id: int) -> Event | None:
    """The event by which the READY of an approach was withdrawn, if it was."""
    lost = record.last_event(READY_LOST)
    return lost if lost is not None and lost.body["procedure_id"] == procedure_id else None


def _noted_loss(record: CaseRecord, procedure_id: int) -> Lost | None:
    """A READY that was lost does not come back by itself: it is measured again."""
    event = lost_since_ready(record, procedure_id)
    return None if event is None else Lost(event.body["code"], event.body["reason"])


def _why_not_there(
    record: CaseRecord, procedure_id: int, arrival: Mapping[str, Any], now: Now
) -> Lost | None:
    try:
        measurement = record.measurement(int(arrival.get("measurement_id", 0)))
    except CaseRecordError:
        return Lost("unknown", "the measurement it relies on is not in the record")
    arguments = record.procedure(procedure_id).arguments
    return why_not_now(record, measurement, now) or _target_changed(record, arguments)


def _target_changed(record: CaseRecord, approach: Mapping[str, Any]) -> Lost | None:
    target = current_target(record)
    if "target" in approach:
        if target is None:
            return Lost("target_withdrawn", "the target has since been withdrawn")
        if target.number != approach["target"]:
            return Lost("target_changed", "the target has since been changed")
        if why := why_void_target(record, target):
            return Lost("target_void", why)
    if "entry" in approach and current_entry_number(record) != approach["entry"]:
        return Lost("target_changed", "the entry point has since been changed")
    return None


def _case_ended(record: CaseRecord, measurement: Measurement) -> Lost | None:
    """Also where it was opened again: who has lain on the table in between is not known."""
    reopened = record.last_event(CASE_REOPENED)
    if reopened is None or reopened.seq < measurement.requested_seq:
        return None
    return Lost("case_ended", "measured before the case was finished and continued")


def why_stood_no_more(facts: Mapping[str, Any], status: BridgeStatus | None) -> Lost | None:
    """Return what happened to a robot that stood at a hold, or None if it stands there still."""
    if status is None:
        return None  # it may: the link says so when it is back
    return _moved(facts, status) or _stopped(facts, status)


def _robot_changed(facts: Mapping[str, Any], now: Now) -> Lost | None:
    status = now.status
    if status is None:
        return Lost("no_link", f"no link to the robot: {now.link_problem or 'not connected'}")
    return (
        _moved(facts, status)
        or _stopped(facts, status)
        or _disturbed(facts, status)
        or _elsewhere(facts, status)
    )


# what moves a robot besides commands, as the bridge names it in `last_motion`
_MOTIONS = {
    "declared": Lost("declared", "measured before the robot's position was declared"),
    "parked": Lost("parked", "measured before the drives were parked"),
    "lost": Lost("position", "the robot's position has since become uncertain"),
    "stray": Lost("stray", "an axis has since moved without a command"),
}


def _moved(facts: Mapping[str, Any], status: BridgeStatus) -> Lost | None:
    if facts["boot_id"] != status.boot_id:
        return Lost("bridge_restarted", "measured before the robot bridge was restarted")
    if status.last_motion != facts["last_motion"]:
        what = status.last_motion.partition(":")[0]
        return _MOTIONS.get(what, Lost("moved", "measured before the last move"))
    return Lost("moving", "the robot is moving") if status.moving else None


def _moved_otherwise(
    record: CaseRecord, measurement: Measurement, facts: Mapping[str, Any], now: Now
) -> Lost | None:
    """What happened to the robot since besides moves of this case."""
    status = now.status
    declared = record.last_event(POSITION_DECLARED)
    if declared is not None and declared.seq > measurement.requested_seq:
        return _MOTIONS["declared"]
    if status is None or not record.has_move(status.last_motion):
        return _robot_changed(facts, now)
    if facts["boot_id"] != status.boot_id:
        return _moved(facts, status)
    there = {**facts, "positions_um": record.move(status.last_motion).setpoints_um}
    return (
        _stopped(facts, status)
        or _disturbed(facts, status)
        or (None if status.moving else _elsewhere(there, status))
    )


def _stopped(facts: Mapping[str, Any], status: BridgeStatus) -> Lost | None:
    if status.stopped:
        reason = status.stop_reason.replace("_", " ")
        return Lost("stopped", f"measured before the robot was stopped ({reason})")
    if facts["stop_count"] != status.stop_count:
        return Lost("stopped", "measured before the robot was stopped")
    return None


def _disturbed(facts: Mapping[str, Any], status: BridgeStatus) -> Lost | None:
    if status.fault is not None:
        return Lost("fault", f"motor fault ({status.fault})")
    if not status.position_certain:
        return Lost("position", "the robot's position is uncertain")
    if facts["parked"] != status.parked:
        done = "parked" if status.parked else "unparked"
        return Lost("parked", f"measured before the drives were {done}")
    return None


def _elsewhere(facts: Mapping[str, Any], status: BridgeStatus) -> Lost | None:
    for axis, at_um in facts["positions_um"].items():
        now_um = status.positions_um.get(axis)
        if now_um is None or not abs(now_um - at_um) <= SAME_PLACE_UM:
            where = "an unknown position" if now_um is None else f"{now_um / 1000:.3f} mm"
            text = f"measured with axis {axis} at {at_um / 1000:.3f} mm; it is now at {where}"
            return Lost("elsewhere", text)
    return None


def _scanner_changed(record: CaseRecord, measurement: Measurement) -> Lost | None:
    """Slices that came since, used or not, of another study, frame of reference or protocol."""
    seen, since = frame_of(record, measurement), seen_seq(record, measurement)
    if seen is None:
        return None
    if other := other_place_since(record, since, seen) or others_since(record, since):
        return Lost(
            "other_place", f"slices from {other} have since arrived: the table may have moved"
        )
    for came in record.scans_since(since):
        other = seen.other_protocol(ScanFrame.of_header(came))
        if came["state"] == "assigned" and other:
            return Lost("other_protocol", f"slices with {other} have since arrived")
    return None


def _too_old(facts: Mapping[str, Any], now: Now) -> Lost | None:
    age = age_s(facts, now)
    if age is None:
        return Lost("computer_restarted", "measured before the computer was restarted")
    if not age <= now.valid_s:
        text = (
            f"measured more than {now.valid_s:.0f} s ago, the longest that a measurement "
            "stays valid"
        )
        return Lost("expired", text)
    return None


def age_s(facts: Mapping[str, Any], now: Now) -> float | None:
    """How long ago a measurement was asked for; None if no clock can tell any more."""
    age = now.monotonic_s - float(facts["monotonic_s"])
    return age if facts["computer"] == now.computer and age >= 0 else None


def _measured_again(record: CaseRecord, measurement: Measurement) -> Lost | None:
    """A later one that failed: the fiducial was not where it had been seen."""
    newest = record.last_measurement()
    if newest is None or newest.measurement_id <= measurement.measurement_id:
        return None
    if newest.state == "failed":
        return Lost("not_seen", f"the fiducial was not found again: {newest.reason}")
    return None
