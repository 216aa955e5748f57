"""How a board is made ready: identified, stopped, set up, and every setting read back.

Run when a port opens and whenever a board is seen to have lost its supply, because it comes back
with factory settings for everything that its flash does not hold. Nothing moves. Only what differs
is written, in memory and never to flash.
"""

from robot_bridge.pmd import protocol as pmd_protocol
from robot_bridge.pmd import units as pmd_units
from robot_bridge.pmd.controller import (
    DECLARED_MARK,
    INDEX_HAS_RESET,
    INDEX_OFF,
    INITIALISED_MARK,
    MARK,
    MICROSTEP_PHASE,
    MODELS,
    POWER_ON_DELAY_US,
    PmdController,
    Steps,
)
from robot_bridge.pmd.protocol import Command, PmdError, PmdNoValueError, PmdTimeoutError
from robot_bridge.pmd.status import Status

MIN_SPEED_HZ = 10
RAMP_UP_HZ_PER_MS = 20
RAMP_DOWN_HZ_PER_MS = 10
SERIAL_TRIES = 5
NO_ENCODER = 0
ENCODER_DIRECTION, ENCODER_TYPE, INDEX_POSITION, RESPONSE_DELAY = 6, 13, 14, 44
FIRST_IN_ALL, LAST_IN_ALL = 2, 13  # what Y30 tells in one answer


def initialise(c: PmdController) -> Steps[None]:
    """Afterwards the settings are ours; the position is as certain as it was left.

    Raises PmdError.
    """
    c.needs_setup = True
    c.certain = c.proven = False
    c.begin_anew()
    yield from _identify(c)
    yield from _stop(c)
    c.mark = mark = yield from _read_mark(c)
    c.status_body = "U" if c.config.estop_input is None else "U4"  # with the inputs
    first = yield from c.read_status()
    yield from c.read_status()  # what was latched is cleared now
    at_index = yield from disarm_index(c)
    declared = (
        mark == DECLARED_MARK
        and c.believes_mark
        and not first & (Status.RESET | Status.ENCODER_ERROR)
        and at_index != INDEX_HAS_RESET
    )
    yield from _probe_storing(c)
    yield from c.ask_if_it_can(*MICROSTEP_PHASE)  # silence later is the line's
    moved = yield from _apply_settings(c)
    yield from c.read_position()
    c.certain = declared and c.closed_loop and not moved
    if not c.certain:
        yield from c.set_mark(INITIALISED_MARK)
    c.expected_parked = c.parked
    c.at_rest_um = c.position_um
    yield from c.check_status()
    c.needs_setup = False


def verify(c: PmdController) -> Steps[None]:
    """Before a move: it is the axis's own board, with the settings that it was given.

    Cables can change places behind an adapter that never drops out. Raises PmdError.
    """
    if c.board and (yield from c.ask("Y42")).integer() != int(c.board):
        board = yield from _serial_number(c)  # it may have been the line
        c.needs_setup = board != c.board
        c.certain = c.certain and not c.needs_setup
        _check_board(c, board)
    yield from _check_index(c)
    if not c.settings:
        return
    differing = yield from _differing(c)
    if differing:
        differing = yield from _differing(c)  # it may have been the line
    for number, value in differing.items():
        c.needs_setup = True
        c.certain = False
        if number in (ENCODER_DIRECTION, ENCODER_TYPE):  # who knows what it counted since
            c.lose_position()
        raise c.error("setting", f"Y{number} reads {value}, not {c.settings[number]} as set")


def _differing(c: PmdController) -> Steps[dict[int, int]]:
    now = yield from _read_some(c, c.settings)
    return {n: value for n, value in now.items() if c.settings.get(n, value) != value}


def _identify(c: PmdController) -> Steps[None]:
    reply = yield from c.ask_if_it_can("?", "what it is")
    c.identity = reply.value if reply else ""
    model = c.identity.partition(" ")[0]
    if reply and model not in MODELS:
        raise c.error("unknown_controller", f"identifies as '{c.identity}'")
    board = yield from _serial_number(c)
    _check_board(c, board)
    c.board = board


def _check_board(c: PmdController, board: str) -> None:
    """Raises AxisFaultError."""
    wanted = c.config.serial_number
    known = str(wanted) if wanted else c.board
    if known and board != known:
        accept = "change serial_number in the file" if wanted else "use accept-boards"
        raise c.error(
            "wrong_board",
            f"board {board or 'without a serial number'} answers on {c.config.controller} where "
            f"board {known} belongs: two boards were swapped, or one was replaced (if on purpose, "
            f"{accept})",
        )


def _serial_number(c: PmdController) -> Steps[str]:
    """Read until two answers agree: the line has no checksum, and this one is kept for long."""
    last = None
    for _ in range(SERIAL_TRIES):
        reply = yield from c.ask_if_it_can("Y42", "swapped boards would not be noticed")
        board = str(reply.integer()) if reply else ""
        if board == last:
            return board
        last = board
    raise c.error("protocol", f"reports a different serial number each time, last '{last}'")


def _stop(c: PmdController) -> Steps[None]:
    c.doubts.pop("S", None)
    try:
        yield pmd_protocol.stop(c.address)
    except PmdNoValueError:
        c.doubts["S"] = "the echo does not confirm a stop"


def _read_mark(c: PmdController) -> Steps[int | None]:
    reply = yield from c.ask_if_it_can(MARK, "a supply failure shows only in its status")
    return reply.integer() if reply else None


def disarm_index(c: PmdController) -> Steps[int | None]:
    """Whoever armed it: passing it would reset the count. Returns the mode in which it was found.

    E clears it as well, but nothing may have to be declared.
    """
    c.tells_index = c.index_trapped = False
    reply = yield from c.ask_if_it_can("N", "whether its index may reset the count")
    if reply is None:
        return None
    found = reply.integer()
    yield Command(c.address, f"N{INDEX_OFF}", reads=False)
    now = (yield from c.ask("N")).integer()
    if now not in (INDEX_OFF, INDEX_HAS_RESET):  # the latter tells of a search that is over
        raise c.error("setting", f"N reads {now} after it was set to {INDEX_OFF}")
    c.tells_index, c.index_at_rest = True, now
    return found


def _check_index(c: PmdController) -> Steps[None]:
    if not (c.tells_index and c.closed_loop):
        return
    mode = (yield from c.ask("N")).integer()
    if mode != c.index_at_rest:
        mode = (yield from c.ask("N")).integer()  # it may have been the line
    if mode != c.index_at_rest:
        c.lose_to_index()
        raise c.error("index", f"the encoder's index was armed: N reads {mode}")


def _probe_storing(c: PmdController) -> Steps[None]:
    """Whether a command can be stored (`…b`), asked with a question, whose running is harmless."""
    c.can_store = False
    try:
        yield pmd_protocol.overwrite_stored(c.address)
        stored = yield from c.ask("B")
        c.can_store = stored.value.rstrip("b") == "E"
    except PmdTimeoutError as error:
        yield from c.must_live(error)
    except PmdError:
        pass
    if not c.can_store:
        c.doubts["B"] = "commands cannot be stored: a damaged motion is noticed only once it starts"


def _wanted(c: PmdController) -> dict[int, int]:
    config = c.config
    wanted = {} if config.limit_switches is None else {2: config.limit_switches}
    if not c.closed_loop:
        # No encoder, at count 0 between limits at 0: no target command, meant or made of
        # another one by a wrong bit, can move the motor.
        return wanted | {ENCODER_TYPE: NO_ENCODER, 3: 0, 4: 0}
    low, high = pmd_units.count_limits(config)
    if config.encoder_direction is not None:
        wanted[6] = config.encoder_direction
    return wanted | {
        ENCODER_TYPE: config.encoder_type,
        3: low,
        4: high,
        5: config.tolerance_counts,
        7: MIN_SPEED_HZ,
        9: config.ramp_up_hz_per_ms or RAMP_UP_HZ_PER_MS,
        10: RAMP_DOWN_HZ_PER_MS,
        11: pmd_units.speed_parameter(config),
        12: config.overshoot_model,
    }


def _apply_settings(c: PmdController) -> Steps[bool]:
    """Returns whether that changed the encoder's count, and so lost the position."""
    yield from _set_response_delay(c)
    before = yield from _count(c)
    yield from _set(c, _wanted(c))
    if not c.closed_loop and (yield from _count(c)) not in (0, None):
        yield Command(c.address, "E0", reads=False)
    after = yield from _count(c)
    yield from c.read_speed_cap()
    return c.closed_loop and (
        before is None
        or after is None
        or abs(after - before) * pmd_units.um_per_count(c.config) > c.jitter_um
    )


def _count(c: PmdController) -> Steps[int | None]:
    if c.closed_loop:
        return (yield from c.ask("E")).integer()
    reply = yield from c.ask_if_it_can("E", "no encoder count")
    c.doubts.pop("E", None)
    return reply.integer() if reply else None


def _set_response_delay(c: PmdController) -> Steps[None]:
    reply = yield from c.ask_if_it_can(
        f"Y{RESPONSE_DELAY}",
        f"the response delay is the controller's default ({POWER_ON_DELAY_US} us)",
    )
    if reply and reply.integer() != c.response_delay_us:
        yield from _set_one(c, RESPONSE_DELAY, c.response_delay_us)


def _set(c: PmdController, wanted: dict[int, int]) -> Steps[None]:
    """Write what differs, then believe the readback alone.

    Read again when all are written: a damaged command may have changed another one.
    """
    c.settings = {}
    have = yield from _read_some(c, wanted)
    if unread := [f"Y{number}" for number in wanted if number not in have]:
        c.doubts[", ".join(unread)] = "these settings cannot be read back"
    for number, value in wanted.items():
        if have.get(number) == value:
            continue
        try:
            yield pmd_protocol.set_parameter(c.address, number, value)
        except PmdTimeoutError as error:
            if number in have:
                raise
            yield from c.must_live(error)
    told = {number: value for number, value in wanted.items() if number in have}
    if len(told) < len(wanted) / 2:
        return  # the few that it tells are no settings: some simulators say what they always say
    got = yield from _read_some(c, told)
    for number, value in told.items():
        if got.get(number) != value:
            raise c.error(
                "setting", f"Y{number} reads {got.get(number)} after it was set to {value}"
            )
    c.settings = told


def _set_one(c: PmdController, number: int, value: int) -> Steps[None]:
    yield pmd_protocol.set_parameter(c.address, number, value)
    got = (yield from c.ask(f"Y{number}")).integer()
    if got != value:
        raise c.error("setting", f"Y{number} reads {got} after it was set to {value}")


def _read_all(c: PmdController) -> Steps[dict[int, int] | None]:
    """Y2 to Y13 in one answer, if the board gives it."""
    reply = yield from c.ask_if_it_can("Y30", "settings are read one by one")
    c.doubts.pop("Y30", None)
    if reply is None:
        return None
    try:
        values = reply.integers()
    except PmdError:
        return None
    if len(values) != LAST_IN_ALL - FIRST_IN_ALL + 1:
        return None
    return dict(zip(range(FIRST_IN_ALL, LAST_IN_ALL + 1), values, strict=True))


def _read_some(c: PmdController, numbers: dict[int, int]) -> Steps[dict[int, int]]:
    """The settings by number, as many as the board tells."""
    together = yield from _read_all(c)
    if together is not None:
        return together
    got: dict[int, int] = {}
    for number in numbers:
        name = f"Y{number}"
        reply = yield from c.ask_if_it_can(name, "")
        c.doubts.pop(name, None)  # said of all together
        if reply is not None:
            got[number] = reply.integer()
    return got
