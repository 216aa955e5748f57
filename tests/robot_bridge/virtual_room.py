"""Client, line, bridge and motors in virtual time: seconds pass only as the client waits.

The client, both ends of the protocol, the bridge and the journal are the program's own; only the
clock, the wire and the motors are models. Everything follows from one seed.
"""

import json
import random
from dataclasses import dataclass, field
from pathlib import Path

from axis_model import AXES, ModelMotors, Stage

from robot_bridge.client.client import BridgeClient
from robot_bridge.daemon.bridge import Bridge
from robot_bridge.daemon.bridge_settings import BridgeSettings
from robot_bridge.daemon.journal import FILE_NAME, CommandRecord, Journal
from robot_bridge.protocol.framing import Deframer, FrameCounters, StopFrame
from robot_bridge.protocol.messages import AxisTravel
from simulator.serial_line import FaultyDirection, LineFaults

STEP_S = 0.004
TRAVEL = tuple(AxisTravel(axis, -10_000, 10_000) for axis in AXES)


class CrashError(Exception):
    """The bridge's process is killed here."""


@dataclass
class Clock:
    now_s: float = 1000.0

    def __call__(self) -> float:
        return self.now_s


@dataclass(frozen=True)
class DeliveredStop:
    """A STOP frame that reached the bridge's end of the wire undamaged."""

    at_s: float
    nonce: int


class VirtualRoom:
    def __init__(self, folder: Path, seed: int, *, deadman_s: float = 1.0) -> None:
        self.rng = random.Random(seed)
        self.clock = Clock()
        self.stage = Stage(self.clock)
        self.motors = ModelMotors(self.stage)
        self.to_bridge = FaultyDirection(LineFaults(), random.Random(f"{seed}:to bridge"))
        self.to_service = FaultyDirection(LineFaults(), random.Random(f"{seed}:to service"))
        self.stops_delivered: list[DeliveredStop] = []
        self.bridge: Bridge | None = None
        self.bridge_back_s = 0.0
        self.restarts = 0
        self.echoes = False
        self.crash_at_sync = -1  # the how-manieth fsync from now kills the bridge; -1: none
        self._folder = folder
        self._deadman_s = deadman_s
        self._spy = Deframer(FrameCounters())
        self._journal: Journal | None = None
        self.start_bridge()

    # --- the bridge's process -----------------------------------------------------------------

    def start_bridge(self) -> None:
        self.motors = ModelMotors(self.stage)  # a fresh driver, the same stage
        self._journal = Journal(self._folder, sync=self._sync)
        self.restarts += 1
        self.bridge = Bridge(
            BridgeSettings(TRAVEL, deadman_s=self._deadman_s, motion_timeout_s=20.0),
            self.motors,
            self._journal,
            boot_id=f"boot{self.restarts}-{self.rng.randrange(10**9)}",
            new_session=lambda: self.rng.randrange(1, 2**32),
            clock=self.clock,
            wall_clock=self.clock,
        )

    def _sync(self, descriptor: int) -> None:
        if self.crash_at_sync >= 0:
            self.crash_at_sync -= 1
            if self.crash_at_sync < 0:
                raise CrashError

    def crash_bridge(self, away_s: float = 0.3) -> None:
        """kill -9: no farewell; the guardian stops the motors at once."""
        self.bridge = None
        assert self._journal is not None
        self._journal.close()
        self.stage.halt()
        self.bridge_back_s = self.clock() + away_s

    def close(self) -> None:
        assert self._journal is not None
        self._journal.close()

    @property
    def commands(self) -> dict[str, CommandRecord]:
        assert self._journal is not None
        return self._journal.commands

    def rearmed_s(self) -> list[float]:
        """When re-armings were carried out, read from the journal's file."""
        lines = (self._folder / FILE_NAME).read_text().splitlines()
        entries = (json.loads(line[9:]) for line in lines if '"kind":"rearm"' in line)
        return [entry["t"] for entry in entries]

    # --- time ---------------------------------------------------------------------------------

    def step(self) -> None:
        self.clock.now_s += STEP_S
        data = self.to_bridge.take_due(self.clock())
        if self.bridge is None:
            if self.clock() >= self.bridge_back_s:
                self.start_bridge()
            return
        for frame in self._spy.feed(data):
            if isinstance(frame, StopFrame):
                self.stops_delivered.append(DeliveredStop(self.clock(), frame.nonce))
        try:
            if data:
                self.bridge.receive(data)
            self.bridge.tick()
            output = self.bridge.take_output()
        except CrashError:
            self.crash_bridge()
            return
        self.to_service.send(output, self.clock())
        if self.echoes and output and self.bridge is not None:
            self.bridge.receive(output)

    def run(self, seconds: float) -> None:
        for _ in range(round(seconds / STEP_S)):
            self.step()

    # --- the service's process ----------------------------------------------------------------

    def client(self, **settings: object) -> BridgeClient:
        return BridgeClient(
            "virtual line",
            open_transport=lambda: VirtualTransport(self),
            clock=self.clock,
            pause=self.run,
            random_bits=self.rng.getrandbits,
            stop_thread=False,
            **settings,  # type: ignore[arg-type]
        )

    def set_faults(self, faults: LineFaults) -> None:
        self.to_bridge.faults = faults
        self.to_service.faults = faults

    def make_half_duplex(self, byte_s: float) -> None:
        """One pair of wires: collisions destroy, and everybody hears himself."""
        self.to_bridge, self.to_service = (
            FaultyDirection(LineFaults(), random.Random(self.rng.random()), byte_s)
            for _ in range(2)
        )
        self.to_bridge.share_wire_with(self.to_service)
        self.echoes = True

    def unplug(self) -> None:
        for direction in (self.to_bridge, self.to_service):
            direction.connected = False
            direction.clear()

    def plug_in(self) -> None:
        self.to_bridge.connected = self.to_service.connected = True


@dataclass
class VirtualTransport:
    """The service's port; waiting on it is what makes time pass."""

    room: VirtualRoom
    echo: bytearray = field(default_factory=bytearray)

    def read(self, wait_s: float) -> bytes:
        until_s = self.room.clock() + wait_s
        while True:
            data = bytes(self.echo) + self.room.to_service.take_due(self.room.clock())
            self.echo.clear()
            if data or self.room.clock() >= until_s:
                return data
            self.room.step()

    def write(self, data: bytes) -> None:
        self.room.to_bridge.send(data, self.room.clock())
        if self.room.echoes:
            self.echo += data

    def close(self) -> None:
        pass
