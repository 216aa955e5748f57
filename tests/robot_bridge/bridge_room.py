"""A small real room for tests: emulated controllers, a serial line, the daemon as a process."""

import contextlib
import json
import random
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

from robot_bridge.client.client import BridgeClient
from robot_bridge.emulator.axis import EmulatedController, Motor
from robot_bridge.emulator.bus import EmulatedBus
from robot_bridge.emulator.physics import IdealStage, StagePhysics
from robot_bridge.emulator.server import EmulatorServer, PseudoTerminal
from robot_bridge.emulator.switches import Switches
from robot_bridge.protocol.phases import WorkPhase
from simulator.serial_line import LineFaults, NullModem

AXES = ("xt", "yt", "xb", "yb")

CONFIG = """
[bridge]
link = "{link}"
state_dir = "{state_dir}"
heartbeat_s = 0.1
deadman_s = 1.0
motion_timeout_s = 200
{extra}
"""

AXIS = """
[[bridge.axis]]
name = "{name}"
controller = "{controller}"
address = {address}
drive = "closed_loop"
travel_min_mm = -{travel_mm}
travel_max_mm = {travel_mm}
sign = 1
speed_hz = {speed_hz}
counts_per_mm = 10000
tolerance_um = 20
home_mm = -{travel_mm}
"""


class EmulatedControllers:
    """Four closed-loop axes on one bus, served by a thread; their true positions are visible."""

    def __init__(self, make_stage: Callable[[], StagePhysics] = IdealStage) -> None:
        switches = Switches()
        self.stages = {name: make_stage() for name in AXES}
        controllers = [
            EmulatedController(address, stage, Motor(), switches, time.monotonic(), 1.0)
            for address, stage in enumerate(self.stages.values(), start=1)
        ]
        self.all = controllers
        self.bus = EmulatedBus(controllers, switches, random.Random(0))
        self._server = EmulatorServer(self.bus, PseudoTerminal())
        self.url = self._server.wire.url
        self._running = True
        self.last_moving_s = 0.0
        self._thread = threading.Thread(target=self._serve, name="controllers", daemon=True)
        self._thread.start()

    def _serve(self) -> None:
        while self._running:
            self._server.serve_once()
            if self.moving:
                self.last_moving_s = time.monotonic()

    def power_cycle(self) -> None:
        for controller in self.all:
            controller.power_on(time.monotonic(), deaf_s=0.2)

    @property
    def moving(self) -> bool:
        return any(controller.moving for controller in self.all)

    def on_a_long_way(self) -> bool:
        """All axes are past the short run in which an encoder is tried first."""
        return self.moving and min(map(abs, self.positions_um().values())) > 450

    def positions_um(self) -> dict[str, float]:
        return {name: stage.position_um for name, stage in self.stages.items()}

    def close(self) -> None:
        self._running = False
        self._thread.join()
        self._server.close()


class Closable(Protocol):
    def close(self) -> None: ...


@dataclass
class BridgeRoom:
    folder: Path
    controllers: EmulatedControllers
    line: NullModem
    config_file: Path
    daemons: list[subprocess.Popen[str]] = field(default_factory=list)
    clients: list[Closable] = field(default_factory=list)
    outcomes: list[object] = field(default_factory=list)
    test: str = "test"

    def start_daemon(
        self, *arguments: str, python: Sequence[str] = (sys.executable, "-m", "robot_bridge")
    ) -> subprocess.Popen[str]:
        command = [*python, "--config", str(self.config_file)]
        log = (self.folder / f"daemon-{len(self.daemons)}.log").open("w")
        with log:
            daemon = subprocess.Popen(
                [*command, *arguments], stdin=subprocess.PIPE, stderr=log, text=True
            )
        self.daemons.append(daemon)
        return daemon

    @property
    def log(self) -> str:
        files = sorted(self.folder.glob("daemon-*.log"))
        return "\n".join(file.read_text() for file in files)

    def client(self, **settings: object) -> BridgeClient:
        client = BridgeClient(self.line.far, heartbeat_s=0.1, **settings)  # type: ignore[arg-type]
        self.clients.append(client)
        return client

    def ready_client(self) -> BridgeClient:
        """Open, armed in MANUAL, without lock; standing at zero, which is declared as it is."""
        client = self.client()
        client.open(15.0)
        if client.status.stopped:
            client.rearm("test")
        if client.status.insertion_locked:
            client.set_insertion_lock(False, "test")
        truth_um = {axis: round(um) for axis, um in self.controllers.positions_um().items()}
        client.declare_position(truth_um, "test", dict.fromkeys(truth_um, 1))  # measured
        client.set_phase(WorkPhase.MANUAL, "test")
        client.arm("test")
        if any(abs(um) > 5 for um in truth_um.values()):
            name = f"back to zero {time.monotonic_ns()}"
            assert client.move(name, dict.fromkeys(AXES, 0), None).done
        return client

    def status_file(self) -> dict[str, object]:
        return json.loads((self.folder / "state" / "bridge_status.json").read_text())

    def id(self, name: str) -> str:
        """A command id that no other test of this room has used."""
        return f"{self.test}/{name}"

    def close_clients(self) -> None:
        while self.clients:
            self.clients.pop().close()

    def close(self) -> None:
        self.close_clients()
        for daemon in self.daemons:
            if daemon.poll() is None:
                daemon.terminate()
        for daemon in self.daemons:
            assert daemon.stdin is not None
            with contextlib.suppress(BrokenPipeError):
                daemon.stdin.close()
            daemon.wait(10)
        self.line.close()
        self.controllers.close()


@contextlib.contextmanager
def bridge_room(
    folder: Path,
    faults: LineFaults | None = None,
    *,
    seed: int = 0,
    speed_hz: int = 1500,
    travel_mm: float = 15.0,
    make_stage: Callable[[], StagePhysics] = IdealStage,
    extra: str = "",
) -> Iterator[BridgeRoom]:
    controllers = EmulatedControllers(make_stage)
    line = NullModem(faults, seed=seed).start()
    text = CONFIG.format(link=line.near, state_dir=folder / "state", extra=extra)
    for address, name in enumerate(AXES, start=1):
        text += AXIS.format(
            name=name,
            controller=controllers.url,
            address=address,
            speed_hz=speed_hz,
            travel_mm=travel_mm,
        )
    config_file = folder / "room.toml"
    config_file.write_text(text)
    room = BridgeRoom(folder, controllers, line, config_file)
    try:
        yield room
    finally:
        room.close()


def wait_for(condition: object, timeout_s: float, what: str) -> float:
    """Seconds until `condition()` was true."""
    begun_s = time.monotonic()
    while not condition():  # type: ignore[operator]
        assert time.monotonic() - begun_s < timeout_s, f"{what}: not within {timeout_s} s"
        time.sleep(0.002)
    return time.monotonic() - begun_s
