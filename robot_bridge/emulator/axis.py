"""One emulated PMD401/PMD301: power, motion and status as time goes on. No bytes here.

Time is an argument: `advance(now_s)` brings the controller to an instant of a monotonic clock.
`speed_factor` makes motion and parking faster than real (for demonstrations and studies); the
timing of the protocol stays real. The motor model behind it is the caller's (StagePhysics).
"""

from collections.abc import Callable
from dataclasses import dataclass

from robot_bridge.emulator import settings as y
from robot_bridge.emulator.physics import StagePhysics
from robot_bridge.emulator.runs import OpenRun, PositionLog, TargetRun
from robot_bridge.emulator.settings import EmulatedSettings, Model
from robot_bridge.emulator.switches import AxisFaults, Switches
from robot_bridge.pmd.protocol import MICROSTEPS_PER_STEP
from robot_bridge.pmd.status import Status

UNPARK_S, PARK_S, REBOOT_S = 0.08, 0.25, 2.5
TICK_S = 0.001  # the period of the controller's position loop
MAX_SPEED_HZ = {"PMD401": 1500, "PMD301": 2500}
# Capacitance x frequency that the output stage can drive, from the examples in the manuals.
DERATING_NF_HZ = {"PMD401": 944_000, "PMD301": 3_501_000}
SCRIPT_STEPS = 16
OUTPUTS_HIGH = {"PMD401": 0b111, "PMD301": 0b011}  # they are inputs, pulled up, until they are set
INDEXED = 1  # the position was reset at the index
INDEX_SEARCHES = (STOP_AT_INDEX, RESET_AT_INDEX) = (2, 4)


@dataclass(frozen=True)
class Motor:
    """What is connected to one controller."""

    model: Model = "PMD401"
    capacitance_nf: int = 600
    serial_number: int = 4010001
    firmware: str = "V13"
    um_per_count: float = 0.1
    encoder_reversed: bool = False
    index_um: float | None = None
    # where the stage presses its switches, reverse and forward, in the motor's forward direction
    switches_um: tuple[float, float] | None = None
    mounting: int = 1  # -1: the stage's position shrinks when the motor runs forward

    @property
    def max_frequency_hz(self) -> int:
        derated = DERATING_NF_HZ[self.model] // self.capacitance_nf
        return min(MAX_SPEED_HZ[self.model], derated)


class EmulatedController:
    """State of one axis.

    `on_motion(cause)` is called whenever a motion begins: run, target, index, script, and park or
    unpark, which may shift the stage a little.
    """

    def __init__(
        self,
        address: int,
        physics: StagePhysics,
        motor: Motor,
        switches: Switches,
        now_s: float,
        speed_factor: float = 1.0,
        on_motion: Callable[[str], None] | None = None,
    ) -> None:
        self.physics, self.motor, self.switches = physics, motor, switches
        self.settings = EmulatedSettings(motor.model, address)
        self.faults = AxisFaults()
        self.on_motion = on_motion or (lambda cause: None)
        self._now_s = now_s
        self.speed_factor = speed_factor
        self._raw_count = self._encoder_raw()
        self.power_on(now_s)

    # Power

    def power_on(self, now_s: float, deaf_s: float = 0.0) -> None:
        """As after a loss of supply: memory from flash, parked, encoder at zero."""
        self.settings.power_on()
        self.deaf_until_s = now_s + deaf_s
        self.latched = Status.RESET
        self.run: OpenRun | TargetRun | None = None
        self.parked = True
        self._power_change: tuple[float, bool] | None = None  # (due, parked afterwards)
        self.waveform = 2
        self.reverse = False
        self.servo_mode = self.settings[y.ENCODER_TYPE] == y.SERVO_INPUT
        self.target_limit = False
        self.external_limit_at_ms: int | None = None
        self.index_mode, self.index_position, self.index_unreported = 0, 0, False
        self.index_found = False
        self.default_speed_hz = 1000
        self.last_target = 0
        self.stored: str | None = None
        self.outputs = OUTPUTS_HIGH[self.motor.model]
        self.script_outcome = 0
        self.log: PositionLog | None = None
        self.log_armed_s: float | None = None
        self.microsteps = 0
        self.count = 0
        self.supply_error_seen = False
        self._boot_s = now_s

    @property
    def address(self) -> int:
        return self.settings[y.ADDRESS]

    @property
    def deaf(self) -> bool:
        return self.faults.dead or self._now_s < self.deaf_until_s

    def unpark(self, waveform: int | None = None) -> None:
        self.waveform = waveform or self.waveform
        if self.parked or self._power_change:
            self._power_change = (self._now_s + UNPARK_S / self.speed_factor, False)

    def park(self) -> None:
        if isinstance(self.run, OpenRun):
            self.run = None
        if not self.parked:
            self._power_change = (self._now_s + PARK_S / self.speed_factor, True)

    def _finish_power_change(self) -> None:
        if self._power_change and self._now_s >= self._power_change[0]:
            parked = self._power_change[1]
            self._power_change = None
            if parked != self.parked:
                self.parked = parked
                self.on_motion("park" if parked else "unpark")
                (self.physics.park if parked else self.physics.unpark)()

    @property
    def can_run(self) -> bool:
        return not (self.parked or self._power_change or self.powerless)

    @property
    def unparking(self) -> bool:
        return bool(self._power_change and not self._power_change[1] and not self.powerless)

    @property
    def powerless(self) -> bool:
        return self.faults.overheat or self.faults.supply_lost

    # Runs

    def begin_open_run(self, run: OpenRun, cause: str) -> None:
        self._begin(cause)
        self.run = run
        self.reverse = run.direction < 0

    def begin_target(self, target_count: int, speed_hz: float) -> None:
        self._begin("target")
        self.last_target = target_count
        self.reverse = target_count < self.count
        self.run = TargetRun(target_count, self.count, speed_hz)

    def _begin(self, cause: str) -> None:
        self.servo_mode = False
        self.target_limit = False
        self.external_limit_at_ms = None
        if self.log_armed_s is not None:
            self.log = PositionLog(self.log_armed_s, self.time_ms)
            self.log_armed_s = None
        self.physics.begin_run()
        self.on_motion(cause)

    def stop(self) -> None:
        self.run = None
        self.servo_mode = False

    def clamp_speed(self, speed_hz: float) -> float:
        return max(1.0, min(abs(speed_hz), self.motor.max_frequency_hz))

    # Time

    def advance(self, now_s: float) -> None:
        """Bring the controller to `now_s`; going back in time does nothing."""
        elapsed_s = max(0.0, now_s - self._now_s) * self.speed_factor
        self._now_s = max(self._now_s, now_s)
        self._finish_power_change()
        self._apply_faults()
        self._follow_encoder()
        while elapsed_s > 1e-12:
            if not self.busy and self.log is None:
                break
            tick_s = min(TICK_S, elapsed_s)
            elapsed_s -= tick_s
            self._tick(tick_s)

    @property
    def busy(self) -> bool:
        """Whether time changes anything here: a run, a regulated target or a change of power."""
        return self.run is not None or self._power_change is not None

    @property
    def moving(self) -> bool:
        return self._run_turns and not (self.parked and not self.unparking)

    @property
    def _run_turns(self) -> bool:
        return isinstance(self.run, OpenRun) or (
            isinstance(self.run, TargetRun) and not self.run.idle
        )

    @property
    def time_ms(self) -> int:
        return int((self._now_s - self._boot_s) * 1000) % 32763

    def _apply_faults(self) -> None:
        if self.faults.supply_lost:
            self.latched |= Status.VOLTAGE_ERROR
            self.supply_error_seen = True
        if self.faults.encoder_error:
            self.latched |= Status.ENCODER_ERROR
        if self.powerless and self.run is not None:
            self.stop()
        self._heed_limits()

    @property
    def limits(self) -> tuple[bool, bool]:
        """Whether the reverse and the forward limit switch are pressed, or seem to be."""
        reverse = self.faults.limit_switch or self.faults.limit_reverse
        forward = self.faults.limit_switch or self.faults.limit_forward
        if self.motor.switches_um is not None and not self.faults.limits_dead:
            at_um = self.motor.mounting * self.physics.position_um
            reverse = reverse or at_um <= self.motor.switches_um[0]
            forward = forward or at_um >= self.motor.switches_um[1]
        return reverse, forward

    @property
    def inputs(self) -> int:
        """in3..in0 as four bits; in1 is limit reverse, in2 limit forward."""
        wiring = self.settings[y.EXTERNAL_LIMIT]
        if not wiring:
            return 0xC
        reverse, forward = (pressed is (wiring == 1) for pressed in self.limits)
        return 0x8 | forward << 2 | reverse << 1

    def _heed_limits(self) -> None:
        """Each switch stops motion in its own direction, so that it can be left again."""
        if not (self.moving and self.settings[y.EXTERNAL_LIMIT]):
            return
        reverse, forward = self.limits
        if (reverse and self.reverse) or (forward and not self.reverse):
            self.stop()
            self.external_limit_at_ms = self.time_ms

    def _tick(self, tick_s: float) -> None:
        if self.log is not None:
            self.log.tick(tick_s, self.count)
        if not self.can_run or self.faults.dead:
            return
        if isinstance(self.run, OpenRun):
            self._open_tick(self.run, tick_s)
        elif isinstance(self.run, TargetRun):
            self._target_tick(self.run, tick_s)

    def _open_tick(self, run: OpenRun, tick_s: float) -> None:
        microsteps = run.advance(self.clamp_speed(run.frequency_hz), tick_s)
        self._drive(microsteps, run.frequency_hz)
        self._heed_limits()
        if run.remaining == 0 and self.run is run:
            self.run = None
            if run.script:
                self._script_turn(run)

    def _target_tick(self, run: TargetRun, tick_s: float) -> None:
        if not run.reached:
            run.timer_s += tick_s
        error = run.target_count - self.count
        if abs(error) <= self.settings[y.STOP_RANGE]:
            run.arrive()
            return
        if run.beyond_limit(self.count, self.settings):
            self.target_limit = run.idle = True
            return
        run.idle = False
        self.reverse = error < 0
        ceiling_hz = self.clamp_speed(run.speed_hz)
        microsteps = run.regulate(error, self.settings, ceiling_hz, tick_s)
        self._drive(microsteps, run.frequency_hz)
        self._heed_limits()

    def _script_turn(self, run: OpenRun) -> None:
        """The auto-setup script: forward, then back, then direction and gain from the counts."""
        if run.direction > 0:
            self._script_from = self.count
            back = OpenRun(run.remaining or SCRIPT_STEPS * MICROSTEPS_PER_STEP, -1, 100.0)
            back.script = True
            self.begin_open_run(back, "script")
            return
        moved = self._script_from - self.count
        if moved < 0:
            self.settings.store(y.ENCODER_DIRECTION, 1 - self.settings[y.ENCODER_DIRECTION])
        counts_per_step = abs(moved) / SCRIPT_STEPS
        self.script_outcome = 0 if moved else -1
        gain = int(65536 * 4 / counts_per_step) if moved else 1
        self.settings.store(y.STEPS_PER_COUNT, max(1, gain))

    # Motor and encoder

    def _drive(self, microsteps: int, frequency_hz: float) -> None:
        self.microsteps += microsteps
        if not self.faults.stalled and microsteps:
            self.physics.drive(microsteps, frequency_hz)
        self._follow_encoder()

    def _encoder_raw(self) -> int:
        measured_um = self.physics.read_encoder_um()
        if measured_um is None:
            return 0
        sign = -1 if self.motor.encoder_reversed else 1
        return sign * round(measured_um / self.motor.um_per_count)

    def _follow_encoder(self) -> None:
        raw = self._encoder_raw()
        raw_before, self._raw_count = self._raw_count, raw
        change = raw - raw_before
        if self.settings[y.ENCODER_TYPE] == y.HOST_ENCODER or self.faults.encoder_frozen:
            return
        if self.settings[y.ENCODER_DIRECTION]:
            change = -change
        self.count += change
        self._look_for_index(raw_before, raw)

    def _look_for_index(self, raw_before: int, raw: int) -> None:
        searching = self.index_mode in INDEX_SEARCHES and not self.index_found
        if self.motor.index_um is None or not searching or raw == raw_before:
            return
        sign = -1 if self.motor.encoder_reversed else 1
        mark = sign * round(self.motor.index_um / self.motor.um_per_count)
        if not min(raw_before, raw) <= mark <= max(raw_before, raw):
            return
        self.latched |= Status.INDEX
        beyond = mark - raw if self.settings[y.ENCODER_DIRECTION] else raw - mark
        self.index_position, self.index_unreported = self.count - beyond, True
        self.run = None
        self.index_found = True
        if self.index_mode == RESET_AT_INDEX:
            self.count = self.settings[y.INDEX_OFFSET] + beyond
            self.index_mode = INDEXED

    # Status

    def status(self) -> Status:
        """The live bits and what is latched, without clearing anything."""
        run = self.run
        live = Status(0)
        for bit, is_set in (
            (Status.EXTERNAL_LIMIT, self.external_limit_at_ms is not None),
            (Status.SCRIPT, isinstance(run, OpenRun) and run.script),
            (Status.SERVO_MODE, self.servo_mode),
            (Status.TARGET_LIMIT, self.target_limit),
            (Status.TARGET_MODE, isinstance(run, TargetRun)),
            (Status.TARGET_REACHED, isinstance(run, TargetRun) and run.reached),
            (Status.PARKED, self.parked),
            (Status.OVERHEAT, self.faults.overheat),
            (Status.REVERSE, self.reverse),
            (Status.RUNNING, self.moving),
        ):
            if is_set:
                live |= bit
        return live | self.latched

    def report_status(self) -> Status:
        """As `U0` does: the latched bits are cleared by being reported."""
        reported = self.status()
        self.latched = Status(0)
        self._apply_faults()
        return reported
