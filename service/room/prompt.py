"""What the operator is told in one line: what the room waits for, how the last procedure ended."""

from __future__ import annotations

from typing import Any

from case_record.record import CaseRecord
from robot_bridge.client.client import BridgeStatus
from robot_bridge.protocol.phases import WorkPhase
from room_config.load import Config
from service.procedure.registry import latest_calibration
from service.procedure.targets import current_entry, current_target, why_void_target
from service.room.execution import Execution
from service.room.link import RoomLink
from service.room.validity import Readiness


def prompt(
    config: Config,
    record: CaseRecord,
    link: RoomLink,
    execution: Execution,
    found: Readiness | None,
) -> str:
    """What is to be done next; found: how it stands with READY."""
    if link.status is None:
        return f"No link to the robot: {link.problem}"
    return execution.prompt or _idle_prompt(config, record, link.status, found)


def _idle_prompt(
    config: Config, record: CaseRecord, status: BridgeStatus, found: Readiness | None
) -> str:
    if found is not None and found.ready:
        if is_punctured(record, found.procedure_id):
            return "Puncture recorded. Withdraw the needle, then unlock motion."
        return "READY: make the puncture."
    if status.phase is WorkPhase.EMERGENCY:
        return "EMERGENCY: drives parked. Attend to the patient and the needle, then re-arm."
    if not status.position_certain and not status.moving:
        return "Check where the stages stand, then confirm their positions."
    if status.stopped:
        return f"Stopped ({plain_words(status.stop_reason)}). Re-arm to continue."
    if found is not None:
        return _after_arrival(found, status)
    if not status.armed:
        return "Arm the robot."
    if not is_calibrated(config, record):
        return "Start the calibration."
    target = current_target(record)
    if target is None:
        return "Set a target."
    if why := why_void_target(record, target):
        return f"Set the target again: {why}."
    if config.service.guide is not None and current_entry(record) is None:
        return "Set an entry point."
    return "Start the approach, or set another target."


def _after_arrival(found: Readiness, status: BridgeStatus) -> str:
    """The guide came to its target, but READY cannot be said, or not any more."""
    if found.lost is None:
        return "Locking motion for the needle."
    first = "First confirm that the needle is withdrawn. " if status.insertion_locked else ""
    return f"READY was lost: measure again. {first}({found.lost.text})"


def is_punctured(record: CaseRecord, procedure_id: int) -> bool:
    """Whether the puncture at the end of this approach was recorded."""
    puncture = record.last_event("puncture")
    return puncture is not None and puncture.body["procedure_id"] == procedure_id


def is_calibrated(config: Config, record: CaseRecord) -> bool:
    """As the room is used: with the guide's four axes if it has them."""
    return latest_calibration(record, guide=config.service.guide is not None) is not None


def plain_words(code: str) -> str:
    return code.replace("_", " ")


def outcome_text(name: str, state: str, result: Any) -> str:
    reason = (result or {}).get("reason", "")
    return f"{name} {state}" + (f": {reason}" if reason else "")


def next_action(
    config: Config,
    record: CaseRecord,
    link: RoomLink,
    execution: Execution,
    found: Readiness | None,
) -> str:
    """What the prompt asks the operator to do, as the API calls it; empty: wait, or look."""
    status = link.status
    if status is None:
        return ""
    if execution.question is not None:
        return "answer"
    if record.running_procedure() is not None:
        idle = not status.moving and (status.stopped or not status.armed)
        return "reset" if idle else "acquisition" if execution.request is not None else ""
    if found is not None and found.ready:
        return "needle-out" if is_punctured(record, found.procedure_id) else "puncture"
    if status.stopped or not status.armed:
        return "reset"
    if status.insertion_locked:
        return "needle-out"
    return _next_of_an_idle_room(config, record)


def _next_of_an_idle_room(config: Config, record: CaseRecord) -> str:
    if not is_calibrated(config, record):
        return "calibration"
    target = current_target(record)
    if target is None or why_void_target(record, target):
        return "target"
    if config.service.guide is not None and current_entry(record) is None:
        return "entry"
    return "approach"
