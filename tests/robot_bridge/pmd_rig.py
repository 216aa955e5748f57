"""An emulated bus on a real pseudo-terminal (or TCP port), served by a thread, for driver tests."""

import contextlib
import random
import select
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from unittest.mock import patch

from robot_bridge.daemon.config import AxisConfig
from robot_bridge.daemon.motors import MotorStatus
from robot_bridge.emulator.axis import EmulatedController, Motor
from robot_bridge.emulator.bus import EmulatedBus
from robot_bridge.emulator.physics import IdealStage
from robot_bridge.emulator.server import EmulatorServer, PseudoTerminal, TcpPort
from robot_bridge.emulator.switches import Switches
from robot_bridge.pmd.driver import PmdMotors

SPEED_FACTOR = 20.0


@dataclass
class Rig:
    """`lock` guards the bus: hold it to read or to inject faults."""

    server: EmulatorServer
    lock: threading.RLock = field(default_factory=threading.RLock)
    running: bool = True
    causes: list[tuple[int, str]] = field(default_factory=list)

    @property
    def bus(self) -> EmulatedBus:
        return self.server.bus

    @property
    def url(self) -> str:
        return self.server.wire.url

    def controller(self, address: int) -> EmulatedController:
        return next(c for c in self.bus.controllers if c.address == address)

    def position_um(self, address: int) -> float:
        with self.lock:
            return self.controller(address).physics.position_um

    def runs(self) -> int:
        """How many motions the controllers have begun (parking does not count)."""
        return sum(cause not in ("park", "unpark") for _, cause in self.causes)

    def serve(self) -> None:
        while self.running:
            wait_s = min(self.server.wait_s(time.monotonic()), 0.02)
            with contextlib.suppress(OSError):  # closed under our feet
                ready, _, _ = select.select(self.server.wire.descriptors(), [], [], wait_s)
            with self.lock:
                if self.running:
                    self.server.serve(ready)


class StageWithEnds(IdealStage):
    """Hard stops at both ends; `ground_um` is what was driven against them."""

    ends_um = (-21_000.0, 21_000.0)
    ground_um = 0.0

    def drive(self, microsteps: int, frequency_hz: float) -> None:
        super().drive(microsteps, frequency_hz)
        low_um, high_um = self.ends_um
        inside_um = min(max(self._position_um, low_um), high_um)
        self.ground_um += abs(self._position_um - inside_um)
        self._position_um = inside_um


@contextlib.contextmanager
def rig(
    addresses: tuple[int, ...] = (1, 2),
    *,
    switches: Switches | None = None,
    motor: Motor | None = None,
    stage: type[IdealStage] = IdealStage,
    tcp: bool = False,
    speed_factor: float = SPEED_FACTOR,
    seed: int = 0,
) -> Iterator[Rig]:
    chosen = switches or Switches()
    causes: list[tuple[int, str]] = []

    def controller(address: int) -> EmulatedController:
        return EmulatedController(
            address,
            stage(),
            motor or Motor(),
            chosen,
            time.monotonic(),
            speed_factor,
            on_motion=lambda cause: causes.append((address, cause)),
        )

    bus = EmulatedBus([controller(a) for a in addresses], chosen, random.Random(seed))
    made = Rig(EmulatorServer(bus, TcpPort() if tcp else PseudoTerminal()), causes=causes)
    thread = threading.Thread(target=made.serve, daemon=True)
    thread.start()
    try:
        yield made
    finally:
        made.running = False
        thread.join(2.0)
        with contextlib.suppress(OSError):  # a test may have closed it
            made.server.close()


def axis_config(name: str, url: str, address: int, drive: str = "open_loop", **changes: object):
    values: dict[str, object] = {
        "name": name,
        "controller": url,
        "address": address,
        "drive": drive,
        "travel_min_um": -20_000,
        "travel_max_um": 20_000,
        "sign": 1,
        "speed_hz": 1500,
        "tolerance_um": 20,
        "step_um_forward": 4.5,
        "step_um_reverse": 4.5,
        "approach_um": 50,
        "counts_per_mm": 10_000.0,
        "tolerance_counts": 2,
        "encoder_type": 1,
        "home_um": -20_000,
    }
    return AxisConfig(**(values | changes))


@contextlib.contextmanager
def opened(made: Rig, drive: str = "open_loop", declare: bool = True, **changes: object):
    """A driver for axes xt (address 1) and yt (address 2), opened, standing at zero.

    drive "mixed": xt in open loop, yt in closed loop.
    """
    options = {
        k: changes.pop(k)
        for k in ("park_after_move", "capture_file", "response_delay_us")
        if k in changes
    }
    drives = ("open_loop", "closed_loop") if drive == "mixed" else (drive, drive)
    axes = [
        axis_config(name, made.url, address, drives[address - 1], **changes)
        for name, address in (("xt", 1), ("yt", 2))
    ]
    # The emulator is a thread of this process; on a busy computer its answers take long. (The
    # bounds of a stop are held on the line's own clock, in test_pmd401_moves.)
    patient = patch.multiple(
        "robot_bridge.pmd.stop", STOP_DEADLINE_S=2.0, STOP_ANSWER_TIMEOUT_S=0.5
    )
    motors = PmdMotors(axes, timeout_s=0.5, **options)
    with patient, contextlib.closing(motors):
        motors.open()
        if declare:
            motors.declare_position({"xt": 0, "yt": 0})
        yield motors


def finish(motors: PmdMotors, within_s: float = 60.0) -> MotorStatus:
    """Poll until the motion has ended."""
    return wait_until(motors, lambda status: not status.moving, within_s)


def wait_until(motors: PmdMotors, wanted, within_s: float = 60.0) -> MotorStatus:
    deadline_s = time.monotonic() + within_s
    while True:
        status = motors.poll()
        if wanted(status):
            return status
        assert time.monotonic() < deadline_s, f"still {status}"
        time.sleep(0.002)
