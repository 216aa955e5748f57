"""The rules: why a request is refused, as one pure function of how the bridge stands.

`refusal` is the only place that says no. It is asked before anything is done, and what it lets
pass still goes through the driver's own checks.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from robot_bridge.daemon.travel import check_setpoints
from robot_bridge.daemon.whereabouts import Whereabouts
from robot_bridge.protocol.messages import (
    NAME_MAX,
    Arm,
    AxisTravel,
    Code,
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
from robot_bridge.protocol.phases import ALLOWED, WorkPhase, may_follow


@dataclass(frozen=True)
class BridgeFacts:
    """How the bridge stands when a request arrives; all that the rules look at."""

    phase: WorkPhase
    armed: bool
    stopped: bool
    stop_reason: str
    stop_count: int
    insertion_locked: bool
    in_flight: str | None
    certain_axes: frozenset[str]
    readback_um: Mapping[str, int]
    whereabouts: Whereabouts
    fault: str | None
    last_motion: str
    measurement_used: bool
    now_ms: int
    stale_after_ms: int
    axes: tuple[AxisTravel, ...]


Refusal = tuple[Code, str]


def refusal(standing: BridgeFacts, request: Message) -> Refusal | None:
    """The rule that `request` breaks and a text that names it, or None if it may be done."""
    for rule in _RULES[type(request)]:
        broken = rule(standing, request)
        if broken is not None:
            return broken
    return None


def is_fresh(now_ms: int, seen_ms: int, stale_after_ms: int) -> bool:
    """Whether the sender saw our clock less than `stale_after_ms` ago (and not in our future)."""
    return 0 <= now_ms - seen_ms <= stale_after_ms


def _stale(standing: BridgeFacts, request: Message) -> Refusal | None:
    seen_ms = getattr(request, "seen_ms")  # noqa: B009
    if is_fresh(standing.now_ms, seen_ms, standing.stale_after_ms):
        return None
    return Code.STALE_COMMAND, (
        f"sent {standing.now_ms - seen_ms} ms after the sender last heard from the bridge (limit "
        f"{standing.stale_after_ms} ms)"
    )


def _stale_unlock(standing: BridgeFacts, request: Message) -> Refusal | None:
    # Locking is the safe direction and is never too late.
    assert isinstance(request, SetInsertionLock)
    return None if request.locked else _stale(standing, request)


def _nobody(standing: BridgeFacts, request: Message) -> Refusal | None:
    by = getattr(request, "by")  # noqa: B009
    if len(by.strip()) > 0 and len(by) <= NAME_MAX:
        return None
    return Code.NO_OPERATOR, f"the request names no operator (1 to {NAME_MAX} characters)"


def _nameless(standing: BridgeFacts, request: Message) -> Refusal | None:
    assert isinstance(request, Move | Home)
    if 0 < len(request.command_id) <= NAME_MAX:
        return None
    return Code.MALFORMED, f"the command id must have 1 to {NAME_MAX} characters"


def _stop_latched(standing: BridgeFacts, request: Message) -> Refusal | None:
    if not standing.stopped:
        return None
    return Code.STOP_LATCHED, (
        f"stop {standing.stop_count} ({standing.stop_reason}) is latched until an operator re-arms"
    )


def _no_stop(standing: BridgeFacts, request: Message) -> Refusal | None:
    return None if standing.stopped else (Code.NOT_STOPPED, "no stop is latched")


def _wrong_stop(standing: BridgeFacts, request: Message) -> Refusal | None:
    assert isinstance(request, Arm | Rearm)
    if request.stop_count == standing.stop_count:
        return None
    return Code.WRONG_STOP, (
        f"the request refers to stop {request.stop_count}, but the bridge is at stop "
        f"{standing.stop_count}"
    )


def _faulty(standing: BridgeFacts, request: Message) -> Refusal | None:
    if standing.fault is None:
        return None
    return Code.MOTOR_FAULT, f"the motors report {standing.fault}"


def _not_armed(standing: BridgeFacts, request: Message) -> Refusal | None:
    return None if standing.armed else (Code.NOT_ARMED, "the bridge is not armed")


def _locked(standing: BridgeFacts, request: Message) -> Refusal | None:
    if not standing.insertion_locked:
        return None
    return Code.INSERTION_LOCKED, "the insertion lock is set: the needle may be in"


def _in_flight(standing: BridgeFacts, request: Message) -> Refusal | None:
    if standing.in_flight is None:
        return None
    return Code.MOTION_IN_FLIGHT, f"command {standing.in_flight!r} is still running"


def _phase_forbids_move(standing: BridgeFacts, request: Message) -> Refusal | None:
    if ALLOWED[standing.phase].move:
        return None
    return Code.WRONG_PHASE, f"motion is not allowed in phase {standing.phase}"


def _phase_forbids_home(standing: BridgeFacts, request: Message) -> Refusal | None:
    if ALLOWED[standing.phase].home:
        return None
    return Code.WRONG_PHASE, f"homing is not allowed in phase {standing.phase}"


def _phase_not_reachable(standing: BridgeFacts, request: Message) -> Refusal | None:
    assert isinstance(request, SetPhase)
    if request.phase not in WorkPhase.__members__:
        return Code.MALFORMED, f"{request.phase[:40]!r} is not a work phase"
    if may_follow(standing.phase, WorkPhase(request.phase)):
        return None
    return Code.PHASE_NOT_ALLOWED, f"{request.phase} may not follow {standing.phase}"


def _beyond_travel(standing: BridgeFacts, request: Message) -> Refusal | None:
    assert isinstance(request, Move)
    return check_setpoints(request.setpoints_um, standing.axes, standing.readback_um)


def _declared_beyond_travel(standing: BridgeFacts, request: Message) -> Refusal | None:
    assert isinstance(request, DeclarePosition)
    named = [axis for axis in standing.axes if axis.name in request.positions_um]
    if not named and not request.positions_um:
        return Code.MALFORMED, "the declaration names no axis"
    return check_setpoints(request.positions_um, named) or _bad_bounds(request.within_um, standing)


def _bad_bounds(within_um: Mapping[str, int], standing: BridgeFacts) -> Refusal | None:
    known = {axis.name for axis in standing.axes}
    for axis, bound_um in within_um.items():
        if axis not in known:
            return Code.UNKNOWN_AXIS, f"axis {axis[:40]!r} is not one of {', '.join(sorted(known))}"
        if bound_um < 0:
            return Code.MALFORMED, f"axis {axis!r}: known to within {bound_um} um"
    return None


def _bad_correction(standing: BridgeFacts, request: Message) -> Refusal | None:
    assert isinstance(request, CorrectPosition)
    if request.correction_um.keys() != request.within_um.keys() or not request.correction_um:
        return Code.MALFORMED, "every correction needs its own bound, and there must be no others"
    if request.based_on_motion != standing.last_motion:
        return Code.OUTDATED_MEASUREMENT, "the robot has moved since that position was read"
    return _bad_bounds(request.within_um, standing)


def _drives_held_off(standing: BridgeFacts, request: Message) -> Refusal | None:
    # Power on may shift an axis a little; off is the safe direction.
    assert isinstance(request, SetDrives)
    if not request.on:
        return None
    return _stop_latched(standing, request) or _locked(standing, request)


def _no_such_axis(standing: BridgeFacts, request: Message) -> Refusal | None:
    assert isinstance(request, Home)
    known = {axis.name for axis in standing.axes}
    for axis in request.axes:
        if axis not in known:
            return Code.UNKNOWN_AXIS, f"axis {axis[:40]!r} is not one of {', '.join(sorted(known))}"
    return None


def _moved_axes(standing: BridgeFacts, request: Move) -> list[AxisTravel]:
    """Those that do not stand already where they are asked to be."""
    return [
        axis
        for axis in standing.axes
        if abs(request.setpoints_um[axis.name] - standing.readback_um[axis.name])
        > axis.tolerance_um
    ]


def _uncertain(standing: BridgeFacts, request: Message) -> Refusal | None:
    assert isinstance(request, Move)
    for axis in _moved_axes(standing, request):
        if axis.name not in standing.certain_axes:
            return Code.POSITION_UNCERTAIN, (
                f"the position of axis {axis.name!r} is uncertain: home or declare it first"
            )
    return None


def _too_little_known(standing: BridgeFacts, request: Message) -> Refusal | None:
    assert isinstance(request, Move)
    for axis in _moved_axes(standing, request):
        setpoint_um = request.setpoints_um[axis.name]
        low_um, high_um = standing.whereabouts.reach_um(axis.name, setpoint_um)
        if not (axis.min_um <= low_um and high_um <= axis.max_um):
            return Code.BEYOND_TRAVEL, (
                f"axis {axis.name!r}: sent to {setpoint_um} um it could end up anywhere from "
                f"{low_um:.0f} to {high_um:.0f} um; its travel is {axis.min_um} to "
                f"{axis.max_um} um. Check where it is, then home or declare it"
            )
    return None


def _outdated(standing: BridgeFacts, request: Message) -> Refusal | None:
    assert isinstance(request, Move)
    if request.based_on_motion != standing.last_motion:
        return Code.OUTDATED_MEASUREMENT, (
            f"outdated measurement: the move rests on motion {request.based_on_motion[:60]!r}, "
            f"but the last one was {standing.last_motion[:60]!r}"
        )
    if standing.measurement_used:
        return Code.OUTDATED_MEASUREMENT, (
            "outdated measurement: the robot has already moved on "
            f"{str(request.measurement_id)[:60]!r}"
        )
    return None


Rule = Callable[[BridgeFacts, Any], Refusal | None]

_MAY_MOVE: tuple[Rule, ...] = (
    _nameless,
    _stale,
    _stop_latched,
    _faulty,
    _not_armed,
    _locked,
    _in_flight,
)

_RULES: dict[type[Message], tuple[Rule, ...]] = {
    Arm: (_nobody, _stale, _stop_latched, _wrong_stop, _faulty),
    Rearm: (_nobody, _stale, _no_stop, _wrong_stop, _in_flight, _faulty),
    Disarm: (),
    SetPhase: (_nobody, _stale, _stop_latched, _in_flight, _phase_not_reachable),
    SetInsertionLock: (_nobody, _stale_unlock),
    Move: (
        *_MAY_MOVE,
        _phase_forbids_move,
        _beyond_travel,
        _uncertain,
        _too_little_known,
        _outdated,
    ),
    Home: (*_MAY_MOVE, _nobody, _phase_forbids_home, _no_such_axis),
    DeclarePosition: (_nobody, _stale, _in_flight, _declared_beyond_travel),
    SetDrives: (_nobody, _stale, _in_flight, _drives_held_off),
    CorrectPosition: (_stale, _in_flight, _bad_correction),
}
