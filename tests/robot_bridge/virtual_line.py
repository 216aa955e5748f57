"""Driver and emulated bus in one thread on a clock of their own: fast, and the same every time.

The bytes are the real ones; only the wire and the clock are not.
"""

import random

from pmd_rig import axis_config

from robot_bridge.daemon.motors import MotorStatus
from robot_bridge.emulator.axis import EmulatedController, Motor
from robot_bridge.emulator.bus import EmulatedBus
from robot_bridge.emulator.physics import IdealStage
from robot_bridge.emulator.switches import Switches
from robot_bridge.pmd.driver import PmdMotors

READ_WAIT_S = 0.002


class VirtualLine:
    """A port for the driver, the bus behind it, and their clock."""

    def __init__(
        self,
        drives: dict[str, str],
        *,
        seed: int = 0,
        switches: Switches | None = None,
        timeout_s: float = 0.05,
        **changes: object,
    ) -> None:
        self.now_s = 1000.0
        self.causes: list[tuple[int, str]] = []
        chosen = switches or Switches()
        controllers = [self._controller(address, chosen) for address in range(1, len(drives) + 1)]
        self.bus = EmulatedBus(controllers, chosen, random.Random(seed))
        axes = [
            axis_config(name, "virtual", address, drive, **changes)
            for address, (name, drive) in enumerate(drives.items(), 1)
        ]
        self.motors = PmdMotors(
            axes, timeout_s=timeout_s, clock=lambda: self.now_s, open_port=lambda _: self
        )

    def _controller(self, address: int, switches: Switches) -> EmulatedController:
        return EmulatedController(
            address,
            IdealStage(),
            Motor(),
            switches,
            self.now_s,
            on_motion=lambda cause: self.causes.append((address, cause)),
        )

    # The driver's port

    def read(self, size: int = 1, /) -> bytes:
        heard = self.bus.take_output(self.now_s)
        if not heard:
            self.wait(READ_WAIT_S)
            heard = self.bus.take_output(self.now_s)
        return heard

    def write(self, data: bytes, /) -> int:
        self.bus.receive(data, self.now_s)
        return len(data)

    def reset_input_buffer(self) -> None:
        self.bus.take_output(self.now_s)

    def close(self) -> None:
        pass

    # The test's part

    def wait(self, seconds: float) -> None:
        self.now_s += seconds
        self.bus.advance(self.now_s)

    def controller(self, address: int = 1) -> EmulatedController:
        return self.bus.controllers[address - 1]

    def position_um(self, address: int = 1) -> float:
        return self.controller(address).physics.position_um

    def runs(self) -> int:
        return sum(cause not in ("park", "unpark") for _, cause in self.causes)

    def moving(self) -> bool:
        return any(c.moving for c in self.bus.controllers)

    def poll(self, times: int = 1, every_s: float = 0.02) -> MotorStatus:
        for _ in range(times):
            status = self.motors.poll()
            self.wait(every_s)
        return status

    def finish(self, within_s: float = 60.0) -> MotorStatus:
        until_s = self.now_s + within_s
        while (status := self.poll()).moving:
            assert self.now_s < until_s, f"still {status}"
        return status

    def open_at_zero(self) -> None:
        self.motors.open()
        self.motors.declare_position({name: 0 for name in self.motors.poll().readback_um})
