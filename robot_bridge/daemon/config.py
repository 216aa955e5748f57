"""The `[bridge]` table of the room's file: strict, physical, checked before anything opens.

Every key is known, present (or has a default), of its type and inside its bounds; anything else is
a ConfigError that names the file and the key. Lengths are millimetres in the file and integer
micrometres in the program.
"""

import math
import tomllib
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

from robot_bridge.protocol.messages import NAME_MAX, AxisTravel

TRAVEL_MAX_MM = 1000.0
DRIVES = ("open_loop", "closed_loop")
HOMING_OVERTRAVEL = 1.2  # of the travel: as far as the search for a mechanical end may go
HOMING_CHUNK_UM = 2000.0  # of a run towards a mechanical end, between two looks at the encoder
HOMING_EXTRA_S = 5.0  # unparking, backing off
HOMING_RESERVE = 1.2  # steps may be shorter than set
# What homing asks its board, at a slow adapter's pace; the axes of a bus take turns.
ANSWER_S = 0.035
HOMING_ANSWERS, CHUNK_ANSWERS = 50, 8


class ConfigError(ValueError):
    """One line: file, key, what is wrong and what would be right."""


@dataclass(frozen=True)
class AxisConfig:
    """One motor: where it is, how it counts, how far it may go.

    sign: +1 if the axis grows when the controller moves forward, -1 if it shrinks.
    travel_min_um, travel_max_um: both ends allowed.
    step_um_forward, step_um_reverse: length of one wfm-step (open loop).
    counts_per_mm, tolerance_counts, encoder_type: encoder (closed loop); encoder_type is Y13.
    step_error: how wrong the step lengths may be, as a fraction; what is not known of the position
        of an axis without encoder grows by that much of every way that it goes.
    serial_number: of the board that drives this axis; None: whichever answers first is remembered.
    home_to: the mechanical end or limit switch nearest to `home_um`, or the encoder's index.
    limit_switches (Y2: 0 none, 1 active high, 2 active low), encoder_direction (Y6): None leaves
        what the board's flash holds. ramp_up_hz_per_ms is Y9, overshoot_model Y12.
    estop_input: 0 or 3, the board's digital input that an emergency stop pulls low; None: none.
    """

    name: str
    controller: str
    address: int
    drive: str
    travel_min_um: int
    travel_max_um: int
    sign: int
    speed_hz: int
    tolerance_um: int
    step_um_forward: float
    step_um_reverse: float
    approach_um: int
    counts_per_mm: float
    tolerance_counts: int
    encoder_type: int
    home_um: int | None
    step_error: float = 0.05
    serial_number: int | None = None
    home_to: str = "end"
    limit_switches: int | None = None
    encoder_direction: int | None = None
    ramp_up_hz_per_ms: int = 20
    overshoot_model: int = 3
    estop_input: int | None = None
    waveform: Literal["rhomb", "delta"] = "delta"

    @property
    def travel(self) -> AxisTravel:
        return AxisTravel(self.name, self.travel_min_um, self.travel_max_um, self.tolerance_um)

    def homing_s(self, axes_on_bus: int) -> float:
        """How long homing may take at the set speed, all axes of the bus at once: there and, for
        an index, back.
        """
        step_um = min(self.step_um_forward, self.step_um_reverse)
        way_um = HOMING_OVERTRAVEL * (self.travel_max_um - self.travel_min_um)
        ways = 2.0 if self.home_to == "index" else 1.0
        runs_s = HOMING_RESERVE * ways * way_um / (step_um * self.speed_hz)
        to_end = self.home_to == "end" and self.drive == "closed_loop" and not self.limit_switches
        chunks = math.ceil(way_um / HOMING_CHUNK_UM) + 3 if to_end else 0
        answers = axes_on_bus * (HOMING_ANSWERS + CHUNK_ANSWERS * chunks)
        return runs_s + answers * ANSWER_S + HOMING_EXTRA_S


@dataclass(frozen=True)
class BridgeConfig:
    """link: the bridge's end of the line to the service; "" on a bench without one.

    service_link: the service's end, for the engineer's commands; the service's own `bridge_link`
    in the same file stands in for it.
    """

    link: str
    link_baud: int
    service_link: str | None
    state_dir: Path
    status_file: Path
    heartbeat_s: float
    deadman_s: float
    motion_timeout_s: float
    motion_poll_s: float
    controller_baud: int
    controller_timeout_s: float
    controller_response_delay_us: int
    park_after_move: bool
    guardian: bool
    capture_file: Path | None
    axes: tuple[AxisConfig, ...]


class _Table:
    """Takes keys out of a TOML table one by one; what is left at the end was misspelt."""

    def __init__(self, table: Mapping[str, Any], where: str) -> None:
        self._left = dict(table)
        self._where = where

    def fail(self, key: str, problem: str) -> ConfigError:
        return ConfigError(f"{self._where}{key}: {problem}")

    def take(self, key: str, default: Any) -> Any:
        if key in self._left:
            return self._left.pop(key)
        if default is ...:
            raise self.fail(key, "is missing")
        return default

    def text(self, key: str, default: Any = ..., among: tuple[str, ...] = ()) -> Any:
        value = self.take(key, default)
        if value is default:
            return value
        if not isinstance(value, str) or not 0 < len(value) <= NAME_MAX:
            raise self.fail(key, f"{value!r} is not text of 1 to {NAME_MAX} characters")
        if among and value not in among:
            raise self.fail(key, f"{value!r} is not one of {', '.join(among)}")
        return value

    def boolean(self, key: str, default: bool) -> bool:
        value = self.take(key, default)
        if not isinstance(value, bool):
            raise self.fail(key, f"{value!r} is not true or false")
        return value

    def number(self, key: str, lo: float, hi: float, default: Any = ...) -> Any:
        value = self.take(key, default)
        if value is default:
            return value
        if isinstance(value, bool) or not isinstance(value, int | float) or not lo <= value <= hi:
            raise self.fail(key, f"{value!r} is not a number from {lo} to {hi}")
        return value

    def integer(self, key: str, lo: int, hi: int, default: Any = ...) -> Any:
        value = self.number(key, lo, hi, default)
        if value is not default and not isinstance(value, int):
            raise self.fail(key, f"{value!r} is not a whole number")
        return value

    def finish(self) -> None:
        for key in self._left:
            raise self.fail(key, "is not a known key")


def _um(value_mm: float, round_inwards: Any) -> int:
    # 1e-6 um forgives the binary representation of decimal millimetres.
    inwards = -1e-6 if round_inwards is math.ceil else 1e-6
    return int(round_inwards(value_mm * 1000.0 + inwards))


def _travel_mm(table: _Table) -> tuple[float, float]:
    lo_mm = table.number("travel_min_mm", -TRAVEL_MAX_MM, TRAVEL_MAX_MM)
    hi_mm = table.number("travel_max_mm", -TRAVEL_MAX_MM, TRAVEL_MAX_MM)
    if not lo_mm < hi_mm:
        raise table.fail("travel_max_mm", f"{hi_mm} is not above travel_min_mm {lo_mm}")
    return lo_mm, hi_mm


def _sign(table: _Table) -> int:
    sign: int = table.integer("sign", -1, 1)
    if sign == 0:
        raise table.fail("sign", "must be 1 or -1")
    return sign


def _axis_from_table(raw: Any, where: str) -> AxisConfig:
    if not isinstance(raw, Mapping):
        raise ConfigError(f"{where}: is not a table")
    table = _Table(raw, where + ".")
    name = table.text("name")
    table = _Table(raw, f"{where} ({name}).")
    table.text("name")
    drive = table.text("drive", among=DRIVES)
    closed = drive == "closed_loop"
    lo_mm, hi_mm = _travel_mm(table)
    sign = _sign(table)
    home_mm = table.number("home_mm", lo_mm, hi_mm, default=None)
    axis = AxisConfig(
        name=name,
        controller=table.text("controller"),
        address=table.integer("address", 0, 126),
        drive=drive,
        travel_min_um=_um(lo_mm, math.ceil),
        travel_max_um=_um(hi_mm, math.floor),
        sign=sign,
        speed_hz=table.integer("speed_hz", 1, 3000, default=400),
        tolerance_um=table.integer("tolerance_um", 1, 1000, default=20),
        step_um_forward=table.number("step_um_forward", 0.1, 20.0, 4.5 if closed else ...),
        step_um_reverse=table.number("step_um_reverse", 0.1, 20.0, 4.5 if closed else ...),
        approach_um=table.integer("approach_um", 0, 2000, default=0),
        counts_per_mm=table.number("counts_per_mm", 1.0, 1e7, ... if closed else 1000.0),
        tolerance_counts=table.integer("tolerance_counts", 1, 65535, default=2),
        encoder_type=table.integer("encoder_type", 0, 60, default=1),
        home_um=None if home_mm is None else round(home_mm * 1000.0),
        step_error=float(table.number("step_error", 0.0, 1.0, default=0.05)),
        serial_number=table.integer("serial_number", 0, 2**32 - 1, default=None),
        home_to=table.text("home_to", default="end", among=("end", "index")),
        limit_switches=table.integer("limit_switches", 0, 2, default=None),
        encoder_direction=table.integer("encoder_direction", 0, 1, default=None),
        ramp_up_hz_per_ms=table.integer("ramp_up_hz_per_ms", 1, 800, default=20),
        overshoot_model=table.integer("overshoot_model", 0, 3, default=3),
        estop_input=table.integer("estop_input", 0, 3, default=None),
        waveform=table.text("waveform", default="delta", among=("rhomb", "delta")),
    )
    if axis.estop_input in (1, 2):
        raise table.fail("estop_input", "inputs 1 and 2 are the limit switches: use 0 or 3")
    if axis.home_to == "index" and not closed:
        raise table.fail("home_to", "an axis without an encoder has no index")
    table.finish()
    return axis


def _heartbeat_and_deadman_s(keys: _Table) -> tuple[float, float]:
    heartbeat_s = float(keys.number("heartbeat_s", 0.02, 1.0, default=0.2))
    deadman_s = float(keys.number("deadman_s", 0.1, 5.0, default=1.0))
    if not deadman_s >= 3 * heartbeat_s:
        raise keys.fail(
            "deadman_s", f"{deadman_s} is shorter than three heartbeats of {heartbeat_s} s"
        )
    return heartbeat_s, deadman_s


def bridge_config_from_table(
    table: Mapping[str, Any], where: str, folder: Path = Path()
) -> BridgeConfig:
    """The checked `[bridge]` table; `where` names the file in errors. Raises ConfigError.

    folder: of the file; its folders and files are relative to it.
    """
    if not isinstance(table, Mapping):
        raise ConfigError(f"{where}: bridge: is not a table")
    keys = _Table(table, f"{where}: bridge.")
    link = keys.text("link", default="")
    state_dir = folder / keys.text("state_dir")
    heartbeat_s, deadman_s = _heartbeat_and_deadman_s(keys)
    status_file = keys.text("status_file", default=None)
    capture_file = keys.text("capture_file", default=None)
    raw_axes = keys.take("axis", ...)
    if not isinstance(raw_axes, list) or not raw_axes:
        raise keys.fail("axis", "needs at least one [[bridge.axis]] table")
    config = BridgeConfig(
        link=link,
        link_baud=keys.integer("link_baud", 9600, 4_000_000, default=115200),
        service_link=keys.text("service_link", default=None),
        state_dir=state_dir,
        status_file=folder / status_file if status_file else state_dir / "bridge_status.json",
        heartbeat_s=heartbeat_s,
        deadman_s=deadman_s,
        motion_timeout_s=float(keys.number("motion_timeout_s", 0.5, 600.0, default=120.0)),
        motion_poll_s=float(keys.number("motion_poll_s", 0.002, 0.1, default=0.02)),
        controller_baud=keys.integer("controller_baud", 9600, 4_000_000, default=115200),
        controller_timeout_s=float(keys.number("controller_timeout_s", 0.005, 2.0, default=0.1)),
        controller_response_delay_us=keys.integer("controller_response_delay_us", 0, 255, 20),
        park_after_move=keys.boolean("park_after_move", default=False),
        guardian=keys.boolean("guardian", default=True),
        capture_file=folder / capture_file if capture_file else None,
        axes=tuple(
            _axis_from_table(raw, f"{where}: bridge.axis[{number}]")
            for number, raw in enumerate(raw_axes)
        ),
    )
    keys.finish()
    _check_axes_differ(config.axes, where)
    _check_homing_fits(config, where)
    return config


def _check_homing_fits(config: BridgeConfig, where: str) -> None:
    on_bus = Counter(axis.controller for axis in config.axes)
    for axis in config.axes:
        needs_s = axis.homing_s(on_bus[axis.controller])
        if axis.home_um is not None and needs_s > config.motion_timeout_s:
            raise ConfigError(
                f"{where}: bridge.motion_timeout_s: homing of {axis.name!r} may take "
                f"{needs_s:.0f} s at {axis.speed_hz} Hz with {on_bus[axis.controller]} axes on its "
                f"port, motion_timeout_s is {config.motion_timeout_s:g}"
            )


def _check_axes_differ(axes: tuple[AxisConfig, ...], where: str) -> None:
    names: set[str] = set()
    places: dict[tuple[str, int], str] = {}
    for axis in axes:
        if axis.name in names:
            raise ConfigError(f"{where}: bridge.axis: the name {axis.name!r} appears twice")
        names.add(axis.name)
        other = places.setdefault((axis.controller, axis.address), axis.name)
        if other != axis.name:
            raise ConfigError(
                f"{where}: bridge.axis: {axis.name!r} and {other!r} have the same address "
                f"{axis.address} on {axis.controller}"
            )


def load_bridge_config(path: Path) -> BridgeConfig:
    """Read the room's file and check its `[bridge]` table. Raises ConfigError."""
    try:
        table = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: is not TOML: {error}") from error
    if "bridge" not in table:
        raise ConfigError(f"{path}: bridge: the table [bridge] is missing")
    config = bridge_config_from_table(table["bridge"], str(path), path.resolve().parent)
    service = table.get("service")
    link = service.get("bridge_link") if isinstance(service, Mapping) else None
    if config.service_link is None and isinstance(link, str):
        return replace(config, service_link=link)
    return config
