"""One PMD401/PMD301 board: what it says of itself, whether it stands, parked and unparked.

Everything here is a procedure (see pmd.line) or plain state; nothing moves the motor but the small
shift that parking may bring. How a board is set up is in pmd.setup, its motions in pmd.axis.
"""

import time
from collections.abc import Callable, Generator
from typing import TypeVar

from robot_bridge.daemon.config import AxisConfig
from robot_bridge.pmd import protocol as pmd_protocol
from robot_bridge.pmd import units as pmd_units
from robot_bridge.pmd.line import Pause, Procedure
from robot_bridge.pmd.protocol import (
    Command,
    PmdError,
    PmdNoValueError,
    PmdSyntaxError,
    PmdTimeoutError,
    Reply,
)
from robot_bridge.pmd.status import (
    ERRORS,
    Inputs,
    Status,
    Supply,
    names,
    parse_drive,
    parse_input_bits,
    parse_inputs,
    parse_status,
    parse_supply,
)

T = TypeVar("T")
Steps = Generator[Command | Pause, Reply | None, T]

MODELS = {"PMD401": 1500, "PMD301": 2500}  # highest drive frequency, Hz
POWER_CHANGE_DEADLINE_S = 1.5
POLL_PAUSE_S = 0.01
POWER_ON_DELAY_US = 20  # Y44, before a controller answers
# The default speed of runs (H) is given with every run here, so it is free to be a mark: it falls
# back at every power-on and is not kept in flash. It tells that the controller has not lost its
# supply since we wrote it, even if the answer with the latched reset bit was lost.
MARK = "H"
INITIALISED_MARK, DECLARED_MARK = 41, 42
SUPPLY_PERIOD_S = 5.0
INDEX_OFF, INDEX_HAS_RESET, INDEX_RESETS = 0, 1, 4  # N


class AxisFaultError(PmdError):
    """A motion failed, or the controller reported an error."""

    def __init__(self, code: str, text: str) -> None:
        super().__init__(text)
        self.code = code


MICROSTEP_PHASE = "Y0", "the length of a run cannot be checked afterwards"


class PmdController:
    """`needs_setup`: its settings are not known to be ours; nothing moves until they are.

    `board`: its serial number, "" if it does not tell one. `believes_mark`: nothing was seen since
    the last declaration that speaks against the count, so that the board's mark may restore it.
    """

    def __init__(
        self,
        config: AxisConfig,
        clock: Callable[[], float] = time.monotonic,
        *,
        response_delay_us: int = POWER_ON_DELAY_US,
    ) -> None:
        self.config = config
        self.response_delay_us = response_delay_us
        self.clock = clock
        self.status = Status(0)
        self.certain = False
        self.believes_mark = True
        self.needs_setup = True
        self.position_um = 0.0
        self.speed_cap_hz = 1
        self.identity = ""
        self.board = ""
        self.supply: Supply | None = None
        self.fault: tuple[str, str] | None = None  # lasts as long as its cause
        self.doubts: dict[str, str] = {}  # what the board does not answer, and what follows
        self.park_shift_um: float | None = None
        self.at_rest_um: float | None = None
        self.expected_parked: bool | None = None  # None while that is changed
        self.mark: int | None = None  # what H was set to; None: H cannot be used
        self.can_store = True
        self.estop = False  # the emergency stop's input is low
        self.limit_wiring = 0  # Y2
        self.proven = False  # since set-up and the last fault the encoder was seen to follow
        self.settings: dict[int, int] = {}  # Y numbers as they were set and read back
        self.tells_index = False
        self.index_at_rest = INDEX_OFF  # what N reads once nobody searches the index
        self.seeks_index = False  # homing has armed it
        self._index_passed = False  # or perhaps: an answer was not heard
        self.index_trapped = False  # it may have reset the count, or stopped the motor
        # One wrong bit makes `T0` (go to zero) of `U0`, but a harmless question of a bare `U`.
        self.status_body = "U"
        self._answered: set[str] = set()
        self._silent_to: set[str] = set()
        self._supply_due_s = 0.0
        self._asked_in_vain = False  # what an answer told that nobody heard, it does not tell again

    @property
    def address(self) -> int:
        return self.config.address

    @property
    def closed_loop(self) -> bool:
        return self.config.drive == "closed_loop"

    @property
    def parked(self) -> bool:
        return bool(self.status & Status.PARKED)

    @property
    def jitter_um(self) -> float:
        """How far two readings of a standing encoder may differ."""
        return (self.config.tolerance_counts + 1) * pmd_units.um_per_count(self.config)

    @property
    def model_max_hz(self) -> int:
        return MODELS.get(self.identity.partition(" ")[0], min(MODELS.values()))

    def named(self, text: str) -> str:
        return f"axis {self.config.name} (controller {self.address}): {text}"

    def error(self, code: str, text: str) -> AxisFaultError:
        return AxisFaultError(code, self.named(text))

    # Reading

    def ask(self, name: str) -> Steps[Reply]:
        reply = yield pmd_protocol.read(self.address, name)
        assert reply is not None  # the line answers every command
        return reply

    def ask_if_it_can(self, name: str, otherwise: str) -> Steps[Reply | None]:
        """None, and a doubt for people to read, if this board does not answer that.

        What it was silent to is not asked again; what it has answered before, it can.
        """
        reply = None
        if name not in self._silent_to:
            try:
                reply = yield from self.ask(name)
            except PmdTimeoutError as error:
                if name in self._answered:
                    raise
                yield from self.must_live(error)
                self._silent_to.add(name)
            except PmdError:
                pass
        if reply is None:
            self.doubts[name] = otherwise
            return None
        self._answered.add(name)
        self.doubts.pop(name, None)
        return reply

    def must_live(self, error: PmdTimeoutError) -> Steps[None]:
        """A board that is silent to one question answers another; else it is the line, or dead."""
        if isinstance(error, PmdNoValueError):
            return
        try:
            yield from self.ask("E")
        except PmdNoValueError:
            pass
        except PmdTimeoutError:
            raise error from None
        except PmdError:
            pass

    def begin_anew(self) -> None:
        """Forget what it was seen to answer or not."""
        self.doubts = {}
        self._answered.clear()
        self._silent_to.clear()

    def read_status(self) -> Steps[Status]:
        unheard, self._asked_in_vain = self._asked_in_vain, True
        try:
            reply = yield from self.ask(self.status_body)
        except (PmdSyntaxError, PmdNoValueError):
            if self.status_body != "U" or not self.needs_setup:
                raise
            self.status_body = "U0"  # it does not understand the harmless form
            reply = yield from self.ask(self.status_body)
        self.status = parse_status(reply.value)
        if self.config.estop_input is not None:
            self.estop = not parse_input_bits(reply.value) >> self.config.estop_input & 1
        if (reply.retried or unheard) and not (yield from self.mark_stands()):
            self.status |= Status.RESET  # the answer that told it was lost
        passed = self.status & Status.INDEX or (self.tells_index and (reply.retried or unheard))
        if passed and self.closed_loop and not (self.seeks_index or self.needs_setup):
            self._index_passed = True  # asked about when there is time: not while stopping
        self._asked_in_vain = False
        if self.status & Status.RESET:
            self.needs_setup = True
            self.certain = False
        if self.status & Status.ENCODER_ERROR and self.closed_loop:
            self.lose_position()
        return self.status

    def lose_position(self) -> None:
        """The count is not where the axis stands, or may not be; until it is declared or homed."""
        self.certain = False
        self.believes_mark = False

    def withdraw_mark(self) -> Steps[None]:
        """What was lost is not to be believed by the next program either."""
        if not self.believes_mark and self.mark == DECLARED_MARK:
            yield from self.set_mark(INITIALISED_MARK)

    def look_for_index(self) -> Steps[None]:
        """Somebody may have armed it; then passing it has reset the count, or stopped the motor."""
        if not self._index_passed:
            return
        mode = (yield from self.ask("N")).integer() if self.tells_index else None
        self._index_passed = False
        self.index_trapped = mode != self.index_at_rest
        if self.index_trapped:
            self.lose_to_index()

    def lose_to_index(self) -> None:
        """It was armed by somebody: the count may have been reset, and it is to be disarmed."""
        self.needs_setup = True
        self.lose_position()

    def mark_stands(self) -> Steps[bool]:
        """Without a mark nothing speaks against a reset: it is believed to have been one."""
        if self.mark is None:
            return False
        return (yield from self.ask(MARK)).integer() == self.mark

    def set_mark(self, mark: int) -> Steps[None]:
        if self.mark is None:
            return
        yield Command(self.address, f"{MARK}{mark}", reads=False)
        got = (yield from self.ask(MARK)).integer()
        if got != mark:
            raise self.error("setting", f"{MARK} reads {got} after it was set to {mark}")
        self.mark = mark

    def ask_position(self) -> Steps[float]:
        if not self.closed_loop:
            return self.position_um
        count = (yield from self.ask("E")).integer()
        return pmd_units.um_from_count(self.config, count)

    def read_position(self) -> Steps[None]:
        self.position_um = yield from self.ask_position()

    def read_position_surely(self) -> Steps[None]:
        """The line has no checksum: two readings that agree, or the third decides."""
        yield from self.read_position()
        first_um = self.position_um
        yield from self.read_position()
        if abs(self.position_um - first_um) > self.jitter_um:
            yield from self.read_position()

    def read_inputs(self) -> Steps[Inputs]:
        """The limit switches, as `limit_wiring` says that they are wired."""
        reply = yield from self.ask("U1")
        return parse_inputs(reply.value, self.limit_wiring)

    def check_status(self) -> Steps[None]:
        """Raise AxisFaultError for whatever the status says is wrong."""
        yield from self.look_for_index()
        status = self.status
        if status & Status.RESET or (self.parked and self.expected_parked is False):
            self.certain = False
            self.needs_setup = True
            raise self.error("controller_reset", "the controller restarted; position uncertain")
        if self.index_trapped:
            raise self.error(
                "index", "the encoder's index was armed (N) and may have reset the count"
            )
        if self.estop:
            raise self.error("estop", "the emergency stop is pressed")
        if status & Status.OVERHEAT:
            raise self.error("overheat", "the controller reports overheating")
        if status & Status.VOLTAGE_ERROR:
            supply = parse_supply((yield from self.ask("U2")).value)
            raise self.error(
                "voltage",
                f"supply or motor fault: 48 V reads {supply.volts_48} V, "
                f"motor test {supply.motor_test}",
            )
        if status & ERRORS:
            raise self.error("controller_error", names(status & ERRORS))

    def refresh(self) -> Procedure:
        """Status and position while nothing of ours moves."""
        yield from self.look_at_rest()
        if self.at_rest_um is None:
            self.at_rest_um = self.position_um
        yield from self._read_supply_if_due()
        self.fault = None

    def look_at_rest(self) -> Steps[None]:
        """Raises AxisFaultError if it does not rest."""
        at_um = yield from self._look()
        was_um = self.position_um if self.at_rest_um is None else self.at_rest_um
        if not self._is_near(at_um, was_um):
            at_um = yield from self._look()  # it may have been the line
        if self.closed_loop:
            self.position_um = at_um
        self.check_rest()

    def _look(self) -> Steps[float]:
        """The position, and then whether the board had lost its supply before it told that."""
        at_um = yield from self.ask_position()
        yield from self.check_no_reset()
        return at_um

    def check_no_reset(self) -> Steps[None]:
        """After a position was read: a board that has lost its supply counts from zero again."""
        yield from self.read_status()
        yield from self.check_status()

    def _is_near(self, at_um: float, other_um: float) -> bool:
        return abs(at_um - other_um) <= self.config.tolerance_um

    def _read_supply_if_due(self) -> Steps[None]:
        if self.clock() < self._supply_due_s:
            return
        self._supply_due_s = self.clock() + SUPPLY_PERIOD_S
        reply = yield from self.ask_if_it_can("U2", "supply and temperature are unknown")
        try:
            self.supply = parse_supply(reply.value) if reply else None
        except PmdError:
            self.doubts["U2"] = "cannot parse supply and temperature"

    def check_rest(self) -> None:
        """Raise AxisFaultError if the stage moves, or has moved, without a command."""
        if self.status & (Status.RUNNING | Status.TARGET_MODE):
            self.lose_position()
            raise self.error("moving_by_itself", "the controller moves without a command")
        if self.at_rest_um is not None and not self._is_near(self.position_um, self.at_rest_um):
            self.lose_position()
            moved_um = self.position_um - self.at_rest_um
            self.at_rest_um = self.position_um
            raise self.error("moved_by_itself", f"moved {moved_um:+.0f} um without a command")

    # Power

    def read_speed_cap(self) -> Steps[None]:
        """What the motor's capacitance allows; the controller measures it while it unparks."""
        self.speed_cap_hz = self.model_max_hz
        reply = yield from self.ask_if_it_can("U3", "the motor's drive limit is unknown")
        if reply is None:
            return
        try:
            cap_hz = parse_drive(reply.value).max_frequency_hz
        except PmdError:
            self.doubts["U3"] = f"cannot parse drive limit '{reply.value}'"
            return
        if cap_hz > 0:
            self.speed_cap_hz = min(self.model_max_hz, cap_hz)

    def unpark(self) -> Steps[None]:
        yield from self.read_status()
        yield from self.check_status()
        if self.parked or self.expected_parked is None:  # None: a parking may be under way
            yield pmd_protocol.unpark(self.address, self.config.waveform)
            yield from self._await_parked(False)
            yield from self.read_speed_cap()
        self.expected_parked = False

    def park(self) -> Procedure:
        """Leave target mode first: a regulated target would move the motor at the next unpark."""
        yield pmd_protocol.stop(self.address)
        yield from self.read_position()
        before_um = self.position_um
        self.expected_parked = None
        yield pmd_protocol.park(self.address)
        yield from self._await_parked(True)
        yield from self.read_position()
        self.expected_parked = True
        self.at_rest_um = self.position_um
        self.park_shift_um = self.position_um - before_um if self.closed_loop else None

    def _await_parked(self, parked: bool) -> Steps[None]:
        deadline_s = self.clock() + POWER_CHANGE_DEADLINE_S
        while True:
            yield Pause(POLL_PAUSE_S)
            status = yield from self.read_status()
            if bool(status & Status.PARKED) == parked:
                return
            if status & (Status.RESET | Status.VOLTAGE_ERROR | Status.OVERHEAT):
                yield from self.check_status()
            if self.clock() > deadline_s:
                wanted = "parked" if parked else "unparked"
                raise self.error("power", f"not {wanted} after {POWER_CHANGE_DEADLINE_S} s")
