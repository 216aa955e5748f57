"""One PMD401/PMD301 board: what it says of itself, how it is set up, parked and unparked.

Everything here is a procedure (see pmd_line) or plain state; nothing moves the motor but the small
shift that parking may bring. The motions are in pmd_axis.
"""

import time
from collections.abc import Callable, Generator, Mapping
from typing import TypeVar

from robot_bridge.daemon.config import AxisConfig
from robot_bridge.pmd import protocol as pmd_protocol
from robot_bridge.pmd import units as pmd_units
from robot_bridge.pmd.line import Pause, Procedure
from robot_bridge.pmd.protocol import Command, PmdError, Reply
from robot_bridge.pmd.status import ERRORS, Status, names, parse_drive, parse_status, parse_supply

T = TypeVar("T")
Steps = Generator[Command | Pause, Reply | None, T]

MODELS = {"PMD401": 1500, "PMD301": 2500}  # highest drive frequency, Hz
POWER_CHANGE_DEADLINE_S = 1.5
POLL_PAUSE_S = 0.01
MIN_SPEED_HZ = 10
RAMP_DOWN_HZ_PER_MS = 10
AVOID_OVERSHOOT = 3
NO_ENCODER = 0
POWER_ON_DELAY_US = 20  # Y44, before a controller answers
# The index offset (Y14) matters to index mode alone, which is not used here, is 0 at every power-on
# and not kept in flash: other values tell that the controller has not lost its supply since we
# wrote them, even if the answer with the latched reset bit was lost.
MARK = 14
POWER_ON_MARK, INITIALISED_MARK, DECLARED_MARK = 0, 10401, 10402


class AxisFaultError(PmdError):
    """A motion failed, or the controller reported an error."""

    def __init__(self, code: str, text: str) -> None:
        super().__init__(text)
        self.code = code


class PmdController:
    def __init__(
        self,
        config: AxisConfig,
        clock: Callable[[], float] = time.monotonic,
        *,
        response_delay_us: int = POWER_ON_DELAY_US,
    ) -> None:
        self.config = config
        self._response_delay_us = response_delay_us
        self._clock = clock
        self.status = Status(0)
        self.certain = False
        self.position_um = 0.0
        self.speed_cap_hz = 1
        self.identity = ""
        self.fault: tuple[str, str] | None = None  # lasts as long as its cause
        self.park_shift_um: float | None = None
        self._at_rest_um: float | None = None
        self._expected_parked: bool | None = None
        # One wrong bit makes `T0` (go to zero) of `U0`, but a harmless question of a bare `U`.
        self._status_body = "U"

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
    def _jitter_um(self) -> float:
        """How far two readings of a standing encoder may differ."""
        return (self.config.tolerance_counts + 1) * pmd_units.um_per_count(self.config)

    def _named(self, text: str) -> str:
        return f"axis {self.config.name} (controller {self.address}): {text}"

    def error(self, code: str, text: str) -> AxisFaultError:
        return AxisFaultError(code, self._named(text))

    # Reading

    def _ask(self, name: str) -> Steps[Reply]:
        reply = yield pmd_protocol.read(self.address, name)
        assert reply is not None  # the line answers every command
        return reply

    def _set_all(self, values: Mapping[int, int]) -> Steps[None]:
        """Write settings, and believe the readback alone.

        Read only when all are written: a damaged command may have changed another one.
        """
        for number, value in values.items():
            yield pmd_protocol.set_parameter(self.address, number, value)
        for number, value in values.items():
            got = (yield from self._ask(f"Y{number}")).integer()
            if got != value:
                raise self.error("setting", f"Y{number} reads {got} after it was set to {value}")

    def _read_status(self) -> Steps[Status]:
        reply = yield from self._ask(self._status_body)
        self.status = parse_status(reply.value)
        if reply.retried and (yield from self._read_mark()) == POWER_ON_MARK:
            self.status |= Status.RESET  # the answer that told it was lost
        return self.status

    def _read_mark(self) -> Steps[int]:
        return (yield from self._ask(f"Y{MARK}")).integer()

    def _read_position(self) -> Steps[None]:
        if self.closed_loop:
            count = (yield from self._ask("E")).integer()
            self.position_um = pmd_units.um_from_count(self.config, count)

    def _read_position_surely(self) -> Steps[None]:
        """The line has no checksum: two readings that agree, or the third decides."""
        yield from self._read_position()
        first_um = self.position_um
        yield from self._read_position()
        if abs(self.position_um - first_um) > self._jitter_um:
            yield from self._read_position()

    def _check_status(self) -> Steps[None]:
        """Raise AxisFaultError for whatever the status says is wrong."""
        status = self.status
        if status & Status.RESET or (self.parked and self._expected_parked is False):
            self.certain = False
            self._expected_parked = None
            raise self.error("controller_reset", "the controller restarted; position uncertain")
        if status & Status.OVERHEAT:
            raise self.error("overheat", "the controller reports overheating")
        if status & Status.VOLTAGE_ERROR:
            supply = parse_supply((yield from self._ask("U2")).value)
            raise self.error(
                "voltage",
                f"supply or motor fault: 48 V reads {supply.volts_48} V, "
                f"motor test {supply.motor_test}",
            )
        if status & ERRORS:
            raise self.error("controller_error", names(status & ERRORS))

    def refresh(self) -> Procedure:
        """Status and position while nothing of ours moves."""
        yield from self._read_status()
        yield from self._read_position()
        if abs(self._drift_um) > self.config.tolerance_um:
            yield from self._read_position()  # it may have been the line
        yield from self._check_status()
        self._check_rest()
        self.fault = None

    @property
    def _drift_um(self) -> float:
        return 0.0 if self._at_rest_um is None else self.position_um - self._at_rest_um

    def _check_rest(self) -> None:
        """Raise AxisFaultError if the stage moves, or has moved, without a command."""
        if self.status & (Status.RUNNING | Status.TARGET_MODE):
            self.certain = False
            raise self.error("moving_by_itself", "the controller moves without a command")
        moved_um = self._drift_um
        if abs(moved_um) > self.config.tolerance_um:
            self.certain = False
            self._at_rest_um = self.position_um
            raise self.error("moved_by_itself", f"moved {moved_um:+.0f} um without a command")

    # Setting up

    def initialise(self) -> Procedure:
        """Identify, stop, set limits and speeds (memory, not flash). Nothing moves."""
        self.identity = (yield from self._ask("?")).value
        model = self.identity.partition(" ")[0]
        if model not in MODELS:
            raise self.error("unknown_controller", f"identifies as '{self.identity}'")
        yield pmd_protocol.stop(self.address)
        first = yield from self._first_status()
        yield from self._read_status()  # what was latched is cleared now
        mark = yield from self._read_mark()
        declared = mark == DECLARED_MARK and not first & Status.RESET
        yield from self._apply_settings(MODELS[model])
        yield from self._read_position()
        self.certain = declared and self.closed_loop
        if not self.certain:
            yield from self._set_all({MARK: INITIALISED_MARK})
        self._expected_parked = self.parked
        self._at_rest_um = self.position_um
        yield from self._check_status()

    def _first_status(self) -> Steps[Status]:
        """Find out which form of the question the controller understands."""
        self._status_body = "U"
        try:
            return (yield from self._read_status())
        except PmdError:
            self._status_body = "U0"
        return (yield from self._read_status())

    def _apply_settings(self, model_max_hz: int) -> Steps[None]:
        if (yield from self._ask("Y44")).integer() != self._response_delay_us:
            yield from self._set_all({44: self._response_delay_us})
        if self.closed_loop:
            low, high = pmd_units.count_limits(self.config)
            yield from self._set_all(
                {
                    13: self.config.encoder_type,
                    3: low,
                    4: high,
                    5: self.config.tolerance_counts,
                    7: MIN_SPEED_HZ,
                    10: RAMP_DOWN_HZ_PER_MS,
                    11: pmd_units.speed_parameter(self.config),
                    12: AVOID_OVERSHOOT,
                }
            )
        else:
            # No encoder, at count 0 between limits at 0: no target command, meant or made of
            # another one by a wrong bit, can move the motor.
            yield from self._set_all({13: NO_ENCODER})
            yield Command(self.address, "E0", reads=False)
            yield from self._set_all({3: 0, 4: 0})
        yield from self._read_speed_cap(model_max_hz)

    def _read_speed_cap(self, model_max_hz: int) -> Steps[None]:
        drive = parse_drive((yield from self._ask("U3")).value)
        self.speed_cap_hz = min(model_max_hz, drive.max_frequency_hz)

    # Power

    def unpark(self) -> Steps[None]:
        yield from self._read_status()
        yield from self._check_status()
        if self.parked:
            yield pmd_protocol.unpark(self.address)
            yield from self._await_parked(False)
            # The controller measures the motor's capacitance while it unparks.
            yield from self._read_speed_cap(MODELS[self.identity.partition(" ")[0]])
        self._expected_parked = False

    def park(self) -> Procedure:
        """Leave target mode first: a regulated target would move the motor at the next unpark."""
        yield pmd_protocol.stop(self.address)
        yield from self._read_position()
        before_um = self.position_um
        self._expected_parked = None
        yield pmd_protocol.park(self.address)
        yield from self._await_parked(True)
        yield from self._read_position()
        self._expected_parked = True
        self._at_rest_um = self.position_um
        self.park_shift_um = self.position_um - before_um if self.closed_loop else None

    def _await_parked(self, parked: bool) -> Steps[None]:
        deadline_s = self._clock() + POWER_CHANGE_DEADLINE_S
        while True:
            yield Pause(POLL_PAUSE_S)
            status = yield from self._read_status()
            if bool(status & Status.PARKED) == parked:
                return
            if status & (Status.RESET | Status.VOLTAGE_ERROR | Status.OVERHEAT):
                yield from self._check_status()
            if self._clock() > deadline_s:
                wanted = "parked" if parked else "unparked"
                raise self.error("power", f"not {wanted} after {POWER_CHANGE_DEADLINE_S} s")
