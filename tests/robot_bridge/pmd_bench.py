"""A driver and its boards on one bus, in virtual time."""

import random

from pmd_rig import axis_config
from virtual_ports import Line, Plug

from robot_bridge.daemon.motors import MotorStatus
from robot_bridge.emulator.axis import EmulatedController, Motor
from robot_bridge.emulator.bus import EmulatedBus
from robot_bridge.emulator.physics import IdealStage
from robot_bridge.emulator.switches import Switches
from robot_bridge.pmd.driver import PmdMotors

NAMES = ("xt", "yt", "xb", "yb")
POLL_S = 0.005


class Bench:
    """Opened and, if asked, declared to stand at zero. `changes`: of the axes' configuration."""

    def __init__(
        self,
        drive: str = "closed_loop",
        latency_s: float = 0.0,
        speed_factor: float = 1.0,
        *,
        names: tuple[str, ...] = NAMES,
        motor: Motor | None = None,
        stage: type[IdealStage] = IdealStage,
        declare: bool = True,
        **changes: object,
    ) -> None:
        switches = Switches()
        self.line = Line()
        self.names = names
        self.boards = [
            EmulatedController(
                n, stage(), motor or Motor(), switches, self.line.now_s, speed_factor
            )
            for n in range(1, len(names) + 1)
        ]
        self.board = self.boards[0]
        self.bus = EmulatedBus(self.boards, switches, random.Random(1))
        self.bus.faults.reply_delay_s = latency_s
        self.line.plugs["port"] = Plug(self.line, self.bus)
        self.axes = [
            axis_config(name, "port", n, drive, **changes) for n, name in enumerate(names, start=1)
        ]
        self.motors = self.new_motors()
        self.motors.open()
        if declare:
            self.motors.declare_position(dict.fromkeys(names, 0))

    def new_motors(self) -> PmdMotors:
        """Another program, which knows nothing of what this one knew."""
        return PmdMotors(self.axes, clock=lambda: self.line.now_s, open_port=self.line.open_port)

    def restart(self) -> MotorStatus:
        self.motors.close()
        self.motors = self.new_motors()
        return self.motors.open()

    def poll_for(self, seconds: float) -> None:
        until_s = self.line.now_s + seconds
        while self.line.now_s < until_s and self.motors.poll().moving:
            self.line.wait(0.02)

    def rest(self, seconds: float = 0.5) -> MotorStatus:
        """Poll although nothing moves."""
        until_s = self.line.now_s + seconds
        while self.line.now_s < until_s:
            status = self.motors.poll()
            self.line.wait(POLL_S)
        return status

    def finish(self, within_s: float = 200.0) -> MotorStatus:
        """Poll until the motion has ended."""
        until_s = self.line.now_s + within_s
        while (status := self.motors.poll()).moving:
            assert self.line.now_s < until_s, f"still {status}"
            self.line.wait(POLL_S)
        return status

    def move(self, to_um: int, axis: str = "xt") -> MotorStatus:
        self.motors.move_to({axis: to_um})
        return self.finish()

    def truth_um(self, axis: str = "xt") -> float:
        return self.boards[self.names.index(axis)].physics.position_um

    def move_until(self, to_um: int, at_um: float) -> None:
        """The move is under way, and its axis at that place."""
        self.motors.move_to({"xt": to_um})
        while self.truth_um() < at_um:
            self.motors.poll()
            self.line.wait(POLL_S)

    def move_and_stop(self, to_um: int, at_um: float) -> None:
        self.move_until(to_um, at_um)
        self.motors.stop()
        self.poll_for(5.0)
