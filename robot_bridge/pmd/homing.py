"""Finding the reference of one axis, and believing it only on evidence.

A limit switch counts if it was off before the run, is the one at that end, is on after it and
goes off again when the axis leaves it. A mechanical end counts if the encoder followed the motor,
stopped following it there, and follows it away. An axis with neither cannot be homed, only
declared. What does not add up is a fault `cannot_home` that says why; the position is uncertain
then.
"""

from robot_bridge.daemon.config import HOMING_CHUNK_UM, HOMING_OVERTRAVEL
from robot_bridge.pmd import protocol as pmd_protocol
from robot_bridge.pmd import units as pmd_units
from robot_bridge.pmd.axis import PmdAxis
from robot_bridge.pmd.controller import INDEX_HAS_RESET, INDEX_RESETS, AxisFaultError, Steps
from robot_bridge.pmd.line import Procedure
from robot_bridge.pmd.progress import FOLLOWS, STANDS, agrees, disagreement
from robot_bridge.pmd.protocol import Command
from robot_bridge.pmd.setup import INDEX_POSITION, disarm_index, verify
from robot_bridge.pmd.status import Inputs

BACK_OFF_UM, PULL_OFF_UM, BACK_OFF_S = 1000.0, 500.0, 1.0
SWITCH_DELAY_S = 0.02  # a switch may tell so late, and the motor stop: on the faster of two trips


def home(axis: PmdAxis, home_um: int) -> Procedure:
    """Find the place that is called `home_um`, and declare it."""
    axis.fault = None
    yield from verify(axis)
    yield from axis.unpark()
    axis.lose_position()
    yield from axis.withdraw_mark()
    axis.proven = False
    if axis.config.home_to == "index":
        yield from _home_to_index(axis, home_um)
        return
    axis.limit_wiring = (yield from axis.ask("Y2")).integer()
    if axis.limit_wiring:
        yield from _home_to_switch(axis, home_um)
    elif axis.closed_loop:
        yield from _home_to_end(axis, home_um)
    else:
        raise _cannot(
            axis,
            "it has no encoder or limit switch to detect a reference; declare its position",
        )


def _cannot(axis: PmdAxis, why: str) -> AxisFaultError:
    return axis.error("cannot_home", f"cannot home: {why}")


def _outwards(axis: PmdAxis, home_um: int) -> int:
    """+1 or -1 in the axis's own direction, towards the end that is nearest to `home_um`."""
    config = axis.config
    low = home_um - config.travel_min_um <= config.travel_max_um - home_um
    return -1 if low else 1


def _search_um(axis: PmdAxis) -> float:
    return HOMING_OVERTRAVEL * (axis.config.travel_max_um - axis.config.travel_min_um)


def _run(axis: PmdAxis, distance_um: float, speed_hz: int | None = None) -> Steps[None]:
    microsteps = pmd_units.microsteps_from_um(axis.config, distance_um)
    yield from axis.run_open_loop(microsteps, speed_hz)


# --- limit switches ---------------------------------------------------------------------------


def _home_to_switch(axis: PmdAxis, home_um: int) -> Steps[None]:
    outwards = _outwards(axis, home_um)
    forward = outwards * axis.config.sign > 0
    name, other = ("forward", "reverse") if forward else ("reverse", "forward")
    before = yield from axis.read_inputs()
    if _is_on(before, name) or _is_on(before, other):
        on = name if _is_on(before, name) else other
        raise _cannot(
            axis,
            f"the {on} limit switch is on before the run: it is stuck or wired the wrong way "
            "round, or the axis is on it (jog off it first)",
        )
    yield from axis.read_position()
    if not (yield from _run_to_switch(axis, outwards * _search_um(axis))):
        raise _cannot(axis, f"no limit switch found within {_search_um(axis) / 1000:.1f} mm")
    there = yield from axis.read_inputs()
    if not _is_on(there, name) or _is_on(there, other):
        wrong = other if _is_on(there, other) else "no"
        raise _cannot(axis, f"the run {name} was stopped, and {wrong} limit switch is now on")
    yield from axis.read_position()
    first_um, back_um = axis.position_um, min(BACK_OFF_UM, _search_um(axis) / 4)
    yield from _leave(axis, -outwards * back_um, name)
    if not (yield from _run_to_switch(axis, outwards * 2 * back_um, _slow_hz(axis))):
        raise _cannot(axis, f"the {name} limit switch did not trip again")
    yield from axis.read_position_surely()
    second_um = axis.position_um
    if abs(second_um - first_um) > _trips_within_um(axis, back_um):
        raise _cannot(
            axis,
            f"the {name} limit switch tripped {second_um - first_um:+.0f} um away the second time: "
            "it is loose or intermittent",
        )
    # Off the switch again, or the next homing could not tell it from one that is stuck.
    yield from _leave(axis, -outwards * min(PULL_OFF_UM, back_um), name)
    yield pmd_protocol.stop(axis.address)
    yield from axis.declare(home_um + axis.position_um - second_um)


def _slow_hz(axis: PmdAxis) -> int:
    """So that backing off lasts, and its time tells its length of an axis without encoder."""
    step_um = max(axis.config.step_um_forward, axis.config.step_um_reverse)
    return max(1, min(axis.speed_hz, round(BACK_OFF_UM / step_um / BACK_OFF_S)))


def _trips_within_um(axis: PmdAxis, back_um: float) -> float:
    """How far two trips of the same switch may seem to differ: the first is the faster one."""
    step_um = max(axis.config.step_um_forward, axis.config.step_um_reverse)
    late_um = SWITCH_DELAY_S * step_um * (axis.speed_hz - _slow_hz(axis))
    least_um = max(axis.config.tolerance_um, axis.jitter_um) + late_um
    if axis.closed_loop:
        return least_um
    return least_um + 2 * axis.config.step_error * back_um + (axis.within_um or 0.0)


def _is_on(inputs: Inputs, name: str) -> bool:
    return inputs.forward if name == "forward" else inputs.reverse


def _run_to_switch(axis: PmdAxis, distance_um: float, speed_hz: int | None = None) -> Steps[bool]:
    """Whether a limit switch ended the run. Raises AxisFaultError if something else did."""
    microsteps = pmd_units.microsteps_from_um(axis.config, distance_um)
    try:
        stood = yield from axis.run_while_followed(microsteps, speed_hz)
    except AxisFaultError as error:
        if error.code != "external_limit":
            raise
        yield pmd_protocol.stop(axis.address)  # needed before it goes the other way
        return True
    if stood:
        raise _cannot(axis, "the encoder no longer follows: the stage is blocked, or it is dead")
    return False


def _leave(axis: PmdAxis, distance_um: float, name: str) -> Steps[None]:
    from_um = axis.position_um
    try:
        yield from _run(axis, distance_um, _slow_hz(axis))
        tripped = False
    except AxisFaultError as error:
        if error.code != "external_limit":
            raise
        tripped = True
    if tripped or _is_on((yield from axis.read_inputs()), name):
        raise _cannot(axis, f"the {name} limit switch stays on when the axis leaves it")
    yield from _expect_encoder(axis, from_um, distance_um)


def _expect_encoder(axis: PmdAxis, from_um: float, distance_um: float) -> Steps[None]:
    if not axis.closed_loop:
        return
    yield from axis.read_position_surely()
    moved_um = axis.position_um - from_um
    if not agrees(moved_um, distance_um):
        raise _cannot(axis, disagreement(moved_um, distance_um))
    axis.proven = True


# --- mechanical ends, told by the encoder -----------------------------------------------------


def _home_to_end(axis: PmdAxis, home_um: int) -> Steps[None]:
    outwards = _outwards(axis, home_um)
    yield from _run_to_end(axis, outwards, _search_um(axis))
    yield from axis.read_position_surely()
    at_um = axis.position_um
    back_um = min(BACK_OFF_UM, _search_um(axis) / 4)
    yield from _run(axis, -outwards * back_um)
    yield from _expect_encoder(axis, at_um, -outwards * back_um)
    yield from _run_to_end(axis, outwards, 3 * back_um)
    yield from axis.read_position_surely()
    if abs(axis.position_um - at_um) > max(axis.config.tolerance_um, axis.jitter_um):
        raise _cannot(
            axis,
            f"the end was {axis.position_um - at_um:+.0f} um away the second time",
        )
    yield pmd_protocol.stop(axis.address)
    yield from axis.declare(home_um)


def _run_to_end(axis: PmdAxis, outwards: int, search_um: float) -> Steps[None]:
    """In short runs, until the encoder does not follow any more."""
    gone_um = 0.0
    while gone_um < search_um:
        yield from axis.read_position()
        from_um = axis.position_um
        microsteps = pmd_units.microsteps_from_um(axis.config, outwards * HOMING_CHUNK_UM)
        stands = yield from axis.run_while_followed(microsteps)
        yield from axis.read_position()
        moved_um = axis.position_um - from_um
        if stands or abs(moved_um) < STANDS * HOMING_CHUNK_UM:
            return
        if outwards * moved_um < 0 or abs(moved_um) > HOMING_CHUNK_UM / FOLLOWS:
            raise _cannot(axis, disagreement(moved_um, outwards * HOMING_CHUNK_UM))
        gone_um += HOMING_CHUNK_UM
    raise _cannot(axis, f"no end stop found within {search_um / 1000:.1f} mm")


# --- the encoder's index ----------------------------------------------------------------------


def _home_to_index(axis: PmdAxis, home_um: int) -> Steps[None]:
    """The count is set to Y14 as the index passes; what was travelled since then is in it."""
    if not axis.tells_index:
        raise _cannot(axis, "its controller does not answer N: the index is not known to pass")
    outwards = _outwards(axis, home_um)
    at_index = yield from _count_at_index(axis)
    for direction in (outwards, -outwards):
        yield from axis.read_position()
        from_um = axis.position_um
        if (yield from _search_index(axis, direction * _search_um(axis))):
            yield pmd_protocol.stop(axis.address)
            yield from axis.read_position_surely()
            count = pmd_units.count_from_um(axis.config, axis.position_um)
            home_count = pmd_units.count_from_um(axis.config, home_um)
            yield from axis.declare_count(count - at_index + home_count)
            return
        yield from _expect_any_motion(axis, from_um)
    raise _cannot(axis, "the encoder's index was not found in either direction")


def _count_at_index(axis: PmdAxis) -> Steps[int]:
    """Y14, twice alike: the line has no checksum."""
    told = (yield from axis.ask(f"Y{INDEX_POSITION}")).integer()
    again = (yield from axis.ask(f"Y{INDEX_POSITION}")).integer()
    if again != told:
        raise _cannot(axis, f"the count at its index reads {told}, then {again}")
    return told


def _expect_any_motion(axis: PmdAxis, from_um: float) -> Steps[None]:
    yield from axis.read_position()
    if abs(axis.position_um - from_um) <= axis.jitter_um:
        raise _cannot(axis, "the encoder did not move")


def _search_index(axis: PmdAxis, distance_um: float) -> Steps[bool]:
    microsteps = pmd_units.microsteps_from_um(axis.config, distance_um)
    axis.seeks_index = axis.needs_setup = True  # if it is left before its end, it is to be disarmed
    try:
        yield Command(axis.address, f"N{INDEX_RESETS}", reads=False)
        try:
            yield from axis.run_while_followed(microsteps, to_index=True)
        except AxisFaultError as error:
            if error.code != "external_limit":
                raise
            yield pmd_protocol.stop(axis.address)
        # Left armed, a later run would end at the index, and its count begin anew there.
        mode = yield from disarm_index(axis)
    finally:
        axis.seeks_index = False
    axis.needs_setup = False
    return mode == INDEX_HAS_RESET
