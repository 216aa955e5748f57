"""Motors in any time: four axes that run at constant speed. The truth of a campaign lives here."""

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field

from robot_bridge.daemon.motors import MotorError, MotorStatus

AXES = ("xt", "yt", "xb", "yb")
NO_DRIVER = "no driver"


@dataclass(frozen=True)
class Begun:
    """A motion that really began."""

    at_s: float
    setpoints_um: dict[str, int]
    homing: bool = False


@dataclass
class Stage:
    """What survives the bridge: the axes, where they are, and everything that ever moved them."""

    clock: Callable[[], float]
    speed_um_s: float = 20_000.0
    from_um: dict[str, int] = field(default_factory=lambda: dict.fromkeys(AXES, 0))
    to_um: dict[str, int] = field(default_factory=lambda: dict.fromkeys(AXES, 0))
    begun_s: float = -1e9
    parked: bool = True
    begun: list[Begun] = field(default_factory=list)
    stopped_s: list[float] = field(default_factory=list)

    def positions_um(self) -> dict[str, int]:
        travelled_um = max(0.0, (self.clock() - self.begun_s) * self.speed_um_s)
        return {axis: self._position_um(axis, travelled_um) for axis in AXES}

    def _position_um(self, axis: str, travelled_um: float) -> int:
        start, end = self.from_um[axis], self.to_um[axis]
        way_um = end - start
        if travelled_um >= abs(way_um):
            return end
        return round(start + travelled_um * (1 if way_um > 0 else -1))

    @property
    def moving(self) -> bool:
        return self.positions_um() != self.to_um

    def run(self, setpoints_um: Mapping[str, int], *, homing: bool = False) -> None:
        assert not self.moving, "two motions in flight"
        self.from_um = self.positions_um()
        self.to_um = {**self.from_um, **setpoints_um}
        self.begun_s = self.clock()
        self.parked = False
        self.begun.append(Begun(self.begun_s, dict(setpoints_um), homing))

    def halt(self) -> None:
        self.from_um = self.to_um = self.positions_um()
        self.stopped_s.append(self.clock())


class ModelMotors:
    """Implements robot_bridge.daemon.motors.Motors over a Stage; forgets what a driver forgets."""

    def __init__(self, stage: Stage) -> None:
        self.stage = stage
        self.fault: str | None = None
        self.refuse_moves = False
        self.stop_fails = 0
        self._moving = False
        self._reached = False
        self._certain: set[str] = set()
        self._homing = False

    def open(self) -> MotorStatus:
        return self.poll()

    def move_to(self, setpoints_um: Mapping[str, int]) -> None:
        if self.refuse_moves:
            raise MotorError("no_power", "axis xt: 48 V is missing")
        self.stage.run(setpoints_um)
        self._moving, self._reached = True, False

    def home(self, axes: Collection[str] = ()) -> None:
        self.stage.run(dict.fromkeys(AXES, 0), homing=True)
        self._moving, self._reached, self._homing = True, False, True

    def poll(self) -> MotorStatus:
        if self._moving and not self.stage.moving:
            self._moving, self._reached = False, True
            if self._homing:
                self._certain |= set(AXES)
            self._homing = False
        return MotorStatus(
            moving=self._moving,
            reached=self._reached,
            readback_um=self.stage.positions_um(),
            certain_axes=frozenset(self._certain),
            parked=self.stage.parked,
            fault=self.fault,
            fault_text=f"axis xt: {self.fault}" if self.fault else "",
        )

    def stop(self) -> None:
        if self.stop_fails:
            self.stop_fails -= 1
            raise MotorError("stop_unconfirmed", "axis xt did not confirm the stop")
        self.stage.halt()
        self._moving = self._reached = self._homing = False

    def park(self) -> None:
        self.stage.parked = True

    def unpark(self) -> None:
        self.stage.parked = False

    def declare_position(self, positions_um: Mapping[str, int]) -> None:
        now_um = {**self.stage.positions_um(), **positions_um}
        self.stage.from_um = self.stage.to_um = now_um
        self._certain |= set(positions_um)

    def close(self) -> None:
        pass
