"""The serial link: harm under faults, and the time from STOP to standstill.

    python benchmarks/link.py [--quick] [--json]

double_moves, wrong_moves (and the other counts of harm): a campaign of commands in virtual time on
a line with every fault and restarts of both sides; the oracle is that of the tests.
stop_ms_*: real time, real processes: from the call of `request_stop` to the last instant at which
an emulated motor at full speed still turned; on a clean line and on one that loses 20 % of frames.
"""

import argparse
import json
import math
import random
import sys
import tempfile
import threading
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))
sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "robot_bridge"))

from bridge_room import AXES, BridgeRoom, bridge_room
from campaign import Campaign

from robot_bridge.client.client import BridgeClient, LinkLostError, RefusedError
from robot_bridge.protocol.messages import Code, CommandState
from robot_bridge.protocol.phases import WorkPhase
from simulator.serial_line import LineFaults

LOSSY = LineFaults(loss=0.2)
FAR_UM = 14_000
COMMANDS_A_SEED = 2_000


def percentile(values: list[float], percent: float) -> float:
    """The value that `percent` of the values do not exceed (nearest rank, no interpolation)."""
    ranked = sorted(values)
    rank = math.ceil(len(ranked) * percent / 100)
    return ranked[max(rank, 1) - 1]


def harm(commands: int) -> dict[str, int]:
    total: dict[str, int] = {"commands": 0}
    for seed in range(max(1, commands // COMMANDS_A_SEED)):
        with tempfile.TemporaryDirectory() as folder:
            findings = Campaign(Path(folder), seed).run(min(commands, COMMANDS_A_SEED))
        total["commands"] += findings.commands
        for name, count in findings.harm.items():
            total[name] = total.get(name, 0) + count
    return total


def make_ready(client: BridgeClient) -> None:
    """Armed in MANUAL, however often the bad line needs."""
    while True:
        try:
            if not client.is_open:
                client.open(20.0)
            if not client.status.position_certain:
                client.declare_position(client.status.positions_um, "benchmark")
            if client.status.stopped:
                client.rearm("benchmark")
            client.set_phase(WorkPhase.MANUAL, "benchmark")
            client.arm("benchmark")
            return
        except (LinkLostError, RefusedError):
            if client.is_open:
                client.pump(0.05)


def time_one_stop(room: BridgeRoom, client: BridgeClient, name: str, wait_s: float) -> float | None:
    """Milliseconds from STOP to standstill, or None if the link was lost before the STOP."""
    middle = sum(client.status.positions_um.values()) / len(AXES)
    setpoints_um = dict.fromkeys(AXES, -FAR_UM if middle > 0 else FAR_UM)
    called_s: list[float] = []

    def stop() -> None:
        called_s.append(time.monotonic())
        client.request_stop()

    def begin(state: CommandState, status: object) -> None:
        if state is CommandState.RUNNING:
            threading.Timer(wait_s, stop).start()

    try:
        outcome = client.move(name, setpoints_um, None, begin)
        while not client.stop_acknowledged:
            client.pump(0.01)
    except LinkLostError:
        return None
    time.sleep(0.1)
    if outcome.code != Code.OPERATOR_STOP:  # something else ended it first
        return None
    return (room.controllers.last_moving_s - called_s[0]) * 1000


def stop_times_ms(faults: LineFaults, count: int, seed: int) -> list[float]:
    rng = random.Random(seed)
    times: list[float] = []
    with (
        tempfile.TemporaryDirectory() as folder,
        bridge_room(Path(folder), faults, seed=seed, speed_hz=1500) as room,
    ):
        room.start_daemon()
        client = room.client()
        number = 0
        while len(times) < count:
            number += 1
            make_ready(client)
            took_ms = time_one_stop(room, client, f"{seed}-{number}", rng.uniform(0.15, 0.5))
            if took_ms is not None:
                times.append(max(0.0, took_ms))
    return times


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args()
    commands, stops = (4_000, 25) if args.quick else (100_000, 200)
    result: dict[str, float] = dict(harm(commands))
    for line, faults in (("clean", LineFaults()), ("lossy", LOSSY)):
        times = stop_times_ms(faults, stops, seed=1)
        result[f"stops_{line}"] = len(times)
        for name, percent in (("p50", 50), ("p99", 99), ("max", 100)):
            result[f"stop_ms_{line}_{name}"] = round(percentile(times, percent), 1)
    if args.json:
        print(json.dumps(result))
    else:
        for name, value in result.items():
            print(f"{name:24} {value}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
