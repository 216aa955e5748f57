"""What a bridge is told once, when it starts."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from robot_bridge.daemon.whereabouts import Growth
from robot_bridge.protocol.messages import AxisTravel


@dataclass(frozen=True)
class BridgeSettings:
    axes: tuple[AxisTravel, ...]
    deadman_s: float = 1.0
    motion_timeout_s: float = 60.0
    motion_poll_s: float = 0.02
    software: str = ""
    growth: Mapping[str, Growth] = field(default_factory=dict)
