"""What peers may say and what they are answered: one table, no I/O.

STOP and EMERGENCY are heeded from every peer. Targets and entry points become proposals, queries
are answered with what is, everything else is told that it is not done from here. There is no
message that arms, homes, calibrates, moves, confirms or unlocks.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dicom_slice.plan import ENTRY, TARGET, label_of
from service.room.proposals import OPENIGTLINK, Plan, Verdict
from service.room.state import RoomState
from service.slicer.messages import (
    COMMAND_HEAD,
    DEVICE_BYTES,
    STATUS_ACCESS_DENIED,
    STATUS_CONFIGURATION_ERROR,
    STATUS_NOT_READY,
    STATUS_OK,
    STATUS_UNKNOWN_INSTRUCTION,
    US_ASCII,
    Message,
    ascii_text,
    status,
    string,
    transform,
)
from service.slicer.pose import Pose
from service.slicer.reading import (
    MessageError,
    Received,
    ReceivedPoint,
    matrix_of,
    points_of,
    string_of,
)
from service.slicer.scene import axes_along, code_of, status_of

Array = NDArray[np.float64]
INVALID, OUT_OF_REACH = 1, 3
_REGISTRATION = "CALIBRATION"
_TRANSFORMS = {"TGT_": "TARGET", "CLB_": _REGISTRATION, "NPOS_": "CURRENT_POSITION"}
_ANSWERED = ("STRING", "GET_STATUS", "GET_TRANSFORM", "GET_TRANS", "POINT", "COMMAND")
_PHASES = ("START_UP", "PLANNING", "CALIBRATION", "TARGETING")
_STATUS_QUERIES, _POSE_QUERIES = (
    ("CURRENT_STATUS", "GET_STATUS"),
    ("CURRENT_POSITION", "GET_TRANSFORM", "GET_TRANS"),
)
_MOST_POINTS = 256
_NOT_RIGID = 1e-2
_OFF = "only STOP is accepted from peers here: openigtlink.inwards is off"


@dataclass(frozen=True)
class Answer:
    """replies: sent at once. plan: to be put before the operator; registration: to be kept; the
    room's verdict on either is told later.
    """

    replies: tuple[Message, ...] = ()
    plan: Plan | None = None
    registration: list[list[float]] | None = None


def acknowledge(message: Received, state: RoomState) -> Message:
    """The same content under the name ACK_XXXX."""
    if message.kind == "COMMAND":
        return _command_answer(message, "", state.at_s)
    return Message(message.kind, _ack_name(message.device), state.at_s, message.content)


def concerns_us(message: Received) -> bool:
    """Whether it is for the robot at all: stations stream transforms of their own as well."""
    if message.kind == "TRANSFORM":
        return message.device.startswith(tuple(_TRANSFORMS))
    return message.kind in _ANSWERED


def not_looked_at(message: Received, at_s: float) -> Message:
    """What a flood is told."""
    text = "too many messages at once: some were not looked at"
    return status(_about(message), at_s, STATUS_NOT_READY, "too_many", text)


def answer(
    message: Received, state: RoomState, pose: Callable[[], Pose | None], sender: str, inwards: bool
) -> Answer:
    """What a message that is no STOP is answered; nothing for what is not for the robot."""
    known: dict[str, Callable[[], Answer]] = {
        "STRING": lambda: _string(message, state, pose),
        "GET_STATUS": lambda: _status_query(state),
        "GET_TRANSFORM": lambda: _pose_query(state, pose),
        "GET_TRANS": lambda: _pose_query(state, pose),
        "TRANSFORM": lambda: _transform(message, state, sender),
        "POINT": lambda: _points(message, state, sender),
        "COMMAND": lambda: Answer((_command_answer(message, _NO_SUCH, state.at_s),)),
    }
    if not concerns_us(message):
        return Answer()
    if not inwards:
        return Answer((status(_about(message), state.at_s, STATUS_ACCESS_DENIED, "off", _OFF),))
    try:
        return known[message.kind]()
    except MessageError as error:
        said = _error(_about(message), state, INVALID, str(error))
        return Answer((said,))


def verdict_of(plan: Plan, verdict: Verdict, state: RoomState) -> tuple[Message, ...]:
    """What the sender of a plan is told once the room has looked at it."""
    if verdict.code == "invalid":
        return (_error("TARGET", state, INVALID, verdict.text),)
    if verdict.code == "out_of_reach":
        return (_error("TARGET", state, OUT_OF_REACH, verdict.text),)
    if verdict.code != "proposed":  # the room cannot now, and says why
        return (status("TARGET", state.at_s, STATUS_NOT_READY, verdict.code, verdict.text),)
    said = status("TARGET", state.at_s, STATUS_OK, verdict.code, verdict.text)
    if not verdict.reach_known or plan.target_mm is None:
        return (said,)
    axes = _axes_of(plan)
    return said, transform("REACHABLE_TARGET", state.at_s, axes, np.array(plan.target_mm))


def registered(verdict: Verdict, at_s: float) -> Message:
    """What the sender of a registration is told once the room has kept it, or has not."""
    if verdict.code == "recorded":
        return status(_REGISTRATION, at_s, STATUS_OK, _REGISTRATION, "recorded and shown only")
    return status(_REGISTRATION, at_s, STATUS_NOT_READY, verdict.code, verdict.text)


def decision_of(number: int, state_word: str, by: str, reason: str, at_s: float) -> Message:
    """What became of a proposal when the operator had seen it."""
    if state_word == "taken":
        text = f"proposal {number} was accepted by {by}"
        return status("TARGET", at_s, STATUS_OK, "taken", text)
    who = f" by {by}" if by else ""
    why = f": {reason}" if reason else ""
    text = f"proposal {number} was {state_word}{who}{why}"
    return status("TARGET", at_s, STATUS_ACCESS_DENIED, state_word, text)


# By type


def _string(message: Received, state: RoomState, pose: Callable[[], Pose | None]) -> Answer:
    text = string_of(message)
    named = {message.device, text}
    if named & set(_STATUS_QUERIES):
        return _status_query(state)
    if named & set(_POSE_QUERIES):
        return _pose_query(state, pose)
    if message.device.startswith("CMD_") and text in _PHASES:
        code, why = _phase(text, state)
        said = status(text, state.at_s, code, text, why)
        return Answer((acknowledge(message, state), said))
    if message.device.startswith("CMD_") and text == "MOVE_TO_TARGET":
        why = "the robot moves when the operator confirms it on the page"
        said = status(text, state.at_s, STATUS_ACCESS_DENIED, text, why)
        return Answer((acknowledge(message, state), said))
    word = text if message.device.startswith("CMD_") else message.device
    said = status(word, state.at_s, STATUS_UNKNOWN_INSTRUCTION, word, _NO_SUCH)
    return Answer((said,))


def _status_query(state: RoomState) -> Answer:
    return Answer((status_of(state, state.robot.phase),))


def _pose_query(state: RoomState, pose: Callable[[], Pose | None]) -> Answer:
    found = pose()
    if found is None:
        why = "the guide's present position is not known: it must be measured"
        said = status("CURRENT_POSITION", state.at_s, STATUS_NOT_READY, "no pose", why)
        return Answer((said,))
    reached = str(int(state.ready))
    return Answer(
        (
            found.message("CURRENT_POSITION", state.at_s),
            string("IS_IN_TARGETING_POS", state.at_s, reached),
            string("HAS_REACHED_TARGET", state.at_s, reached),
        )
    )


def _phase(word: str, state: RoomState) -> tuple[int, str]:
    """What is, of a phase that somebody asks for; nothing is begun."""
    if code_of(state.robot) != STATUS_OK:
        return STATUS_NOT_READY, state.prompt
    if word == "CALIBRATION" and not state.calibrated:
        return STATUS_NOT_READY, "not calibrated: the operator starts the calibration on the page"
    if word == "TARGETING" and not state.calibrated:
        return STATUS_NOT_READY, "not calibrated yet"
    busy = state.procedure is not None and state.robot.phase != word
    return (STATUS_NOT_READY, state.prompt) if busy else (STATUS_OK, state.prompt)


def _transform(message: Received, state: RoomState, sender: str) -> Answer:
    about = _about(message)
    ack = acknowledge(message, state)
    axes, origin = matrix_of(message)
    why = _why_no_pose(axes, origin)
    if why:
        return Answer((ack, _error(about, state, INVALID, why)))
    if message.device.startswith("TGT_"):
        x, y, z = origin.tolist()
        u, v, w = axes[:, 2].tolist()
        plan = Plan(
            sender, message.device, OPENIGTLINK, (x, y, z), None, (u, v, w), _frame_of(message)
        )
        return Answer((ack,), plan=plan)
    if message.device.startswith("CLB_"):
        matrix = np.hstack([axes, origin[:, None]]).tolist()
        return Answer((ack,), registration=matrix)
    return Answer((ack, status_of(state, about)))


def _points(message: Received, state: RoomState, sender: str) -> Answer:
    found = points_of(message)
    if len(found) > _MOST_POINTS:
        raise MessageError(f"{len(found)} points are not a plan: send TARGET and ENTRY")
    target, entry = _labelled(found, TARGET), _labelled(found, ENTRY)
    if target is None and entry is None:
        raise MessageError("no point is labelled TARGET or ENTRY")
    plan = Plan(
        sender,
        message.device,
        OPENIGTLINK,
        target,
        entry,
        frame_of_reference_uid=_frame_of(message),
    )
    origin = target or entry
    assert origin is not None
    if not np.isfinite([*origin, *(entry or origin)]).all():
        raise MessageError("a point is not three finite numbers")
    ack = transform(_ack_name(message.device), state.at_s, _axes_of(plan), np.array(origin))
    return Answer((ack,), plan=plan)


def _labelled(found: list[ReceivedPoint], label: str) -> tuple[float, float, float] | None:
    """The point of this label: of several the one that is selected."""
    named = [point for point in found if label_of(point.name) == label]
    selected = [point for point in named if point.group.strip().upper() == "SELECTED"]
    chosen = selected or named
    if len(chosen) > 1:
        raise MessageError(f"{len(chosen)} points are labelled {label}")
    return chosen[0].patient_mm if chosen else None


# Pieces

_NO_SUCH = "not available here: only STOP, EMERGENCY, queries and proposals are"


def _command_answer(message: Received, error: str, at_s: float) -> Message:
    """RTS_COMMAND under the command's number; the error stands where its name was."""
    if len(message.content) < COMMAND_HEAD.size:
        return status("COMMAND", at_s, STATUS_UNKNOWN_INSTRUCTION, "COMMAND", _NO_SUCH)
    number, name, _, _ = COMMAND_HEAD.unpack_from(message.content)
    said = ascii_text(error, 128) if error else name
    content = COMMAND_HEAD.pack(number, said, US_ASCII, len(error)) + error.encode("ascii")
    return Message("RTS_COMMAND", message.device, at_s, content)


def _about(message: Received) -> str:
    """The device name of the STATUS that answers a message."""
    if message.kind == "TRANSFORM":
        starts = (one for one in _TRANSFORMS if message.device.startswith(one))
        return _TRANSFORMS[next(starts)]
    return {"POINT": "TARGET", "STRING": message.device}.get(message.kind, message.kind)


def _ack_name(device: str) -> str:
    """ACK_XXXX for CMD_XXXX, TGT_XXXX...; of other names the name is the id."""
    start, _, rest = device.partition("_")
    number = rest if start in ("CMD", "TGT", "CLB", "NPOS") else device
    return f"ACK_{number}"[: DEVICE_BYTES - 1]


def _frame_of(message: Received) -> str:
    wanted = "frameofreferenceuid"
    known = {name.lower().replace("_", ""): value for name, value in message.meta.items()}
    return known.get(wanted, "").strip()


def _why_no_pose(axes: Array, origin: Array) -> str:
    if not (np.isfinite(axes).all() and np.isfinite(origin).all()):
        return "the matrix has a number that is not finite"
    if not np.allclose(axes.T @ axes, np.eye(3), atol=_NOT_RIGID):
        return "the matrix is not a rotation: its columns are not orthonormal"
    if not np.linalg.det(axes) > 0:
        return "the matrix is left-handed"
    return ""


def _axes_of(plan: Plan) -> Array:
    """z along the plan's needle; the patient's axes in RAS where it has none."""
    if plan.direction is not None:
        return axes_along(np.array(plan.direction) / np.linalg.norm(plan.direction))
    if plan.target_mm is not None and plan.entry_mm is not None:
        along = np.array(plan.target_mm) - np.array(plan.entry_mm)
        length = float(np.linalg.norm(along))
        if np.isfinite(length) and length > 0:
            return axes_along(along / length)
    return np.diag([-1.0, -1.0, 1.0])


def _error(device: str, state: RoomState, subcode: int, text: str) -> Message:
    name = "invalid" if subcode == INVALID else "out of reach"
    return status(device, state.at_s, STATUS_CONFIGURATION_ERROR, name, text, subcode=subcode)
