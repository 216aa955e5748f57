"""The processes of the virtual room and the configuration that ties them together.

motors (emulated controllers and stages) - bridge - serial line - service - worker - listener -
scanner: all real processes on real DICOM, HTTP and serial bytes; only the physics is simulated.
"""

from __future__ import annotations

import socket
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from room_config.exit_codes import BAD_INPUT
from room_config.shell import autospine
from service.cli.children import ChildError, Family
from service.web.access import new_token, token_hash
from simulator.config import CANNULATED, FiducialKind, VirtualRoom, parse_virtual_room
from simulator.faults import FAULTS
from simulator.truth_client import TruthAddress, TruthError, ask_where

AXES, GUIDE_AXES = ("xt", "yt"), ("xt", "yt", "xb", "yb")
UPPER_ALONG_MM, LOWER_ALONG_MM = 48.0, 14.0
_TRAVEL_MM = 20.0
_CONFIG = "room.toml"
_CLOCK_OFFSET_S = 37.2


@dataclass(frozen=True)
class DemoOptions:
    """What the user chose; port 0 means any free one.

    tokens: the room asks for tokens. guide: two fiducials and four axes. attended: a person
    operates it on the page, which asks before every move. fiducial: slightly oval, with the void
    of the cannula that goes through it, or a sphere.
    """

    case_dir: Path
    seed: int
    faults: tuple[str, ...] = ()
    page_port: int = 0
    dicom_port: int = 0
    speed_factor: float = 3.0
    tokens: bool = False
    guide: bool = False
    attended: bool = False
    fiducial: FiducialKind = "cannulated"


class PortInUseError(Exception):
    """A port that the user asked for cannot be had."""

    exit_code = BAD_INPUT


class DemoRoom:
    """Start it, talk to it at `url`, end it. Everything it writes lies in the case folder."""

    def __init__(self, options: DemoOptions) -> None:
        self.options = options
        self.folder = options.case_dir.resolve()
        self.virtual_dir = self.folder / "virtual"
        self.virtual_dir.mkdir(parents=True, exist_ok=True)
        self.family = Family(self.folder / "logs")
        self.url = ""
        self.truth_port = 0
        self.virtual_table: dict[str, Any] = {}
        self.operator_token = new_token() if options.tokens else ""

    @property
    def axes(self) -> tuple[str, ...]:
        return GUIDE_AXES if self.options.guide else AXES

    @property
    def truth_file(self) -> Path:
        return self.virtual_dir / "acquisitions.jsonl"

    @property
    def faults_file(self) -> Path:
        """Names of the faults that are switched on just now."""
        return self.virtual_dir / "faults-now"

    def start(self) -> None:
        """Start all processes; ChildError if one does not come up. Call `end` in any case."""
        motors = self.family.start("motors", self._motors_words())
        self.truth_port = int(motors["truth_port"])
        self.family.start("serial line", self._line_words())
        config = self._write_config(self._ports())
        here = ["--config", str(config)]
        self.family.launch("bridge", [sys.executable, "-m", "robot_bridge", *here])
        slow = [self.family.launch(n, autospine(n, *here)) for n in ("listener", "worker")]
        self.url = str(self.family.start("service", autospine("service", *here))["url"])
        for child in slow:
            child.wait_ready(120.0)
        self._start_scanner(here)

    def _start_scanner(self, here: list[str]) -> None:
        self.family.start("scanner", autospine("scanner", *here))

    def check(self) -> None:
        """Raise ChildError if a process of the room has ended by itself."""
        dead = self.family.dead()
        if dead is not None:
            raise ChildError(dead.describe_end())

    def end(self) -> None:
        """End all processes: those that command first, the motors last. Idempotent."""
        self.family.end("service", "bridge")
        self.family.end()

    def wait_for_standstill(self, timeout_s: float = 5.0) -> str:
        """Watch the true stages until nothing moves; say what was seen."""
        if not self.truth_port:
            return "the motors had not been started"
        address = TruthAddress("127.0.0.1", self.truth_port)
        deadline_s = time.monotonic() + timeout_s
        try:
            while ask_where(address).moving:
                if time.monotonic() > deadline_s:
                    return f"the stages were still moving after {timeout_s:.0f} s"
                time.sleep(0.05)
        except TruthError:
            return "the emulated motors have ended; nothing can move"
        return "the stages stand still"

    def _motors_words(self) -> list[str]:
        return [
            *(sys.executable, "-m", "simulator.motors"),
            *("--pty-path", str(self.virtual_dir / "controllers")),
            *("--axes", ",".join(self.axes)),
            *("--seed", str(self.options.seed)),
            *("--state", str(self.virtual_dir / "stages.json")),
            *("--speed-factor", str(self.options.speed_factor)),
        ]

    def _line_words(self) -> list[str]:
        return [
            *(sys.executable, "-m", "simulator.serial_line"),
            *("--near", str(self.virtual_dir / "line-service")),
            *("--far", str(self.virtual_dir / "line-bridge")),
        ]

    def _ports(self) -> tuple[int, int]:
        """The ports of page and DICOM; free ones are found by binding them for a moment."""
        wanted = (self.options.page_port, self.options.dicom_port)
        probes = [socket.socket() for _ in wanted]
        try:
            for probe, port in zip(probes, wanted, strict=True):
                probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                try:
                    probe.bind(("127.0.0.1", port))
                except OSError as error:
                    raise PortInUseError(f"port {port}: {error.strerror}") from None
            first, second = (int(probe.getsockname()[1]) for probe in probes)
        finally:
            for probe in probes:
                probe.close()
        return first, second

    def _write_config(self, ports: tuple[int, int]) -> Path:
        page_port, dicom_port = ports
        self.virtual_table = {
            "seed": self.options.seed,
            "faults": list(self.options.faults),
            "scanner": {
                "service_url": f"http://127.0.0.1:{page_port}",
                "listener_port": dicom_port,
                "motors_truth_port": self.truth_port,
                "truth_file": str(self.truth_file),
                "clock_offset_s": _CLOCK_OFFSET_S,
                **({"faults_file": str(self.faults_file)} if self.options.attended else {}),
                **({"token_file": str(self._token_file)} if self.options.tokens else {}),
            },
        }
        shape = CANNULATED if self.options.fiducial == "cannulated" else {}
        fiducials: list[dict[str, Any]] = [dict(shape)]
        if self.options.guide:
            fiducials = [
                {"name": name, "mount": "guide", "along_guide_mm": along_mm, **shape}
                for name, along_mm in (("upper", UPPER_ALONG_MM), ("lower", LOWER_ALONG_MM))
            ]
        self.virtual_table["fiducials"] = fiducials
        virtual = parse_virtual_room(self.virtual_table)
        line = self.virtual_dir / "line-service"
        tables = {
            "room": {"name": "virtual room", "case_dir": str(self.folder), "virtual": True},
            "imaging": {
                "distortion_corrected": False,
                # the tubes at the edge of the field are round, too
                "start_region_px": [30, 30, 98, 98],
                "readout_polarity": virtual.protocol.readout_polarity,
            },
            "listener": {
                "port": dicom_port,
                # as if the clocks had been compared at the console, to a fiftieth of a second
                "clock_offset_s": -_CLOCK_OFFSET_S,
                "clock_uncertainty_s": 0.02,
                # the virtual scanner reconstructs in 0.15 s and sends at once
                "prompt_delay_s": 0.3,
                # nor does it hold a slice back for longer than the fault `late` does
                "late_limit_s": 8.0,
            },
            "service": {
                "port": page_port,
                "bridge_link": str(line),
                "confirm_moves": self.options.attended,
                # more than the guard and what the prompt delay leaves open of the clock
                "settle_s": 0.25,
                "rescan_after_s": 6.0,
            },
            "virtual": {k: v for k, v in self.virtual_table.items() if k != "scanner"},
            "virtual.scanner": self.virtual_table["scanner"],
            "bridge": {
                "link": str(self.virtual_dir / "line-bridge"),
                "state_dir": str(self.virtual_dir / "bridge"),
                # the emulated controllers share the processors with everything else
                "controller_timeout_s": 1.0,
            },
        }
        if self.options.guide:
            tables["service.guide"] = _guide_table(virtual)
        self._adapt(tables)
        axes = [self._axis_table(name, number) for number, name in enumerate(self.axes, start=1)]
        path = self.folder / _CONFIG
        text = "# Written by `autospine demo`.\n" + _toml(tables)
        text += "".join(f"\n[[bridge.axis]]\n{_toml_keys(axis)}" for axis in axes)
        text += "".join(f"\n[[service.token]]\n{_toml_keys(t)}" for t in self._token_tables())
        path.write_text(text, encoding="utf-8")
        return path

    def _adapt(self, tables: dict[str, dict[str, Any]]) -> None:
        """Change the room's tables before they are written; as they are here."""

    def _token_tables(self) -> list[dict[str, str]]:
        """Who may use the service; the scanner finds its own token in its file."""
        if not self.options.tokens:
            return []
        scanner_token = new_token()
        self._token_file.touch(mode=0o600)
        self._token_file.write_text(scanner_token, encoding="ascii")
        return [
            {"name": name, "role": role, "sha256": token_hash(token)}
            for name, role, token in (
                ("operator", "operator", self.operator_token),
                ("scanner", "viewer", scanner_token),
            )
        ]

    @property
    def _token_file(self) -> Path:
        return self.virtual_dir / "scanner.token"

    def _axis_table(self, name: str, address: int) -> dict[str, Any]:
        return {
            "name": name,
            "controller": str(self.virtual_dir / "controllers"),
            "address": address,
            "drive": "open_loop",
            "travel_min_mm": -_TRAVEL_MM,
            "travel_max_mm": _TRAVEL_MM,
            "sign": 1,
            "speed_hz": 1500,
            "step_um_forward": 4.5,
            "step_um_reverse": 4.5,
        }


def _guide_table(virtual: VirtualRoom) -> dict[str, Any]:
    """`[service.guide]` as somebody would measure it at the robot, which stands a little askew."""
    placement = virtual.placement
    # the robot's z is posterior, as the normal of a coronal slice
    upper_mm, lower_mm = (
        placement.origin_mm[1] + height_mm
        for height_mm in (placement.top_plane_mm, placement.bottom_plane_mm)
    )
    return {
        "axes": list(GUIDE_AXES),
        "upper_plane_mm": upper_mm,
        "lower_plane_mm": lower_mm,
        "upper_fiducial_mm": UPPER_ALONG_MM,
        "lower_fiducial_mm": LOWER_ALONG_MM,
        "upper_slice_mm": lower_mm + UPPER_ALONG_MM,
        "lower_slice_mm": lower_mm + LOWER_ALONG_MM,
    }


def known_faults() -> Sequence[str]:
    return tuple(FAULTS)


def _toml(tables: Mapping[str, Mapping[str, Any]]) -> str:
    return "".join(f"\n[{name}]\n{_toml_keys(keys)}" for name, keys in tables.items())


def _toml_keys(keys: Mapping[str, Any]) -> str:
    return "".join(f"{key} = {_toml_value(value)}\n" for key, value in keys.items())


def _toml_value(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        escaped = value.replace("\\", "\\\\").replace('"', '\\"')
        return f'"{escaped}"'
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{key} = {_toml_value(item)}" for key, item in value.items()) + "}"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(_toml_value(item) for item in value) + "]"
    return repr(value)
