"""Fault campaign: driver and bridge over emulated boards, in virtual time, against the truth.

Whatever goes wrong (supply, plugs, boards that change places, switches, encoders, scales, step
lengths, slow adapters), three things hold: an axis that nobody asked never moves, no axis comes
beyond its travel, and what is called certain is where it is said to be.
"""

import os
import random
from collections import Counter
from dataclasses import replace
from pathlib import Path

import pytest
from pmd_rig import StageWithEnds, axis_config
from virtual_ports import Line, Plug

from robot_bridge.daemon.bridge import Bridge
from robot_bridge.daemon.bridge_settings import BridgeSettings
from robot_bridge.daemon.config import AxisConfig
from robot_bridge.daemon.journal import Journal
from robot_bridge.daemon.main import growth_of
from robot_bridge.emulator.axis import EmulatedController, Motor
from robot_bridge.emulator.bus import EmulatedBus
from robot_bridge.emulator.switches import Switches
from robot_bridge.pmd.driver import PmdMotors
from robot_bridge.protocol.bridge_end import SessionOpened
from robot_bridge.protocol.messages import (
    Arm,
    Code,
    DeclarePosition,
    HelloRequest,
    Home,
    Message,
    Move,
    Rearm,
    SetPhase,
    Status,
)

TRAVELS_UM = ((-20_000, 20_000), (-3000, 12_000), (0, 30_000), (-8000, 700), (500, 4500))
STOP_UM = 1000  # how far outside of the travel the hard stops stand
WRONG_SCALES = (0.3, 0.5, 0.55, 1.8, 2.0, 4.0)
TOLERANCE_UM = 20
NAMES = ("xt", "yt", "xb", "yb")
KINDS = (
    "power", "flash", "plug", "swap", "stuck", "encoder", "stall", "stop", "garble", "drop",
)  # fmt: skip
# What a stage may go on while its encoder has just died: the time in which that is found.
BLIND_UM = float(STOP_UM)  # at most to the hard stops


class ScatteringStage(StageWithEnds):
    """Steps that are as wrong as they may be, by direction, and differ from run to run."""

    def __init__(
        self, rng: random.Random, step_error: float, travel_um: tuple[int, int], at_um: float
    ) -> None:
        super().__init__(position_um=at_um)
        self.ends_um = (travel_um[0] - STOP_UM, travel_um[1] + STOP_UM)
        self._rng = rng
        self._nominal_um = 4.5
        self._by_direction = {d: 1 + rng.uniform(-step_error, step_error) for d in (1, -1)}
        self._scatter = 1.0

    def begin_run(self) -> None:
        self._scatter = 1 + self._rng.gauss(0.0, 0.002)

    def drive(self, microsteps: int, frequency_hz: float) -> None:
        direction = 1 if microsteps > 0 else -1
        self._step_length_um = self._nominal_um * self._by_direction[direction] * self._scatter
        super().drive(microsteps, frequency_hz)


class Campaign:
    """One robot with what may be wrong with it, and everything that is asked of it."""

    def __init__(self, folder: Path, seed: int) -> None:
        self.seed = seed
        self.rng = rng = random.Random(seed)
        self.line = Line()
        self.count = rng.choice((1, 2, 4))
        self.own_ports = rng.random() < 0.5
        self.drive = rng.choice(("open_loop", "closed_loop"))
        self.latency_s = rng.choice((0.0, 0.0, 0.004, 0.016, 0.030))
        self.blind = False
        self.travel_um = rng.choice(TRAVELS_UM)
        self.to_index = self.drive == "closed_loop" and rng.random() < 0.5
        low_um, high_um = self.travel_um
        self.index_um = rng.uniform(low_um + 0.1 * (high_um - low_um), high_um)
        self.home_um = round(self.index_um) if self.to_index else low_um
        self.tally: Counter[str] = Counter()
        switches = Switches()
        self.boards = [self._board(number, switches) for number in range(self.count)]
        self._make_plugs(switches)
        self.axes = [self._axis(number) for number in range(self.count)]
        self.names = [axis.name for axis in self.axes]
        self.motors = PmdMotors(
            self.axes, timeout_s=0.1, clock=lambda: self.line.now_s,
            open_port=self.line.open_port,
        )  # fmt: skip
        self.motors.open()
        self.journal = Journal(folder, sync=lambda descriptor: None)
        self.bridge = Bridge(
            BridgeSettings(
                tuple(axis.travel for axis in self.axes),
                motion_timeout_s=60.0,
                growth={axis.name: growth_of(axis) for axis in self.axes},
            ),
            self.motors,
            self.journal,
            boot_id=f"{seed}",
            new_session=lambda: 7,
            clock=lambda: self.line.now_s,
            wall_clock=lambda: self.line.now_s,
        )
        opened = SessionOpened(HelloRequest(1, "campaign", 1, "x"))
        self.bridge.end.open_session(opened, self.bridge._hello(1))
        self.moves = 0
        self.at_an_end: set[str] = set()  # a homing that failed may have left it there
        self.offset_um = dict.fromkeys(self.names, 0.0)  # of the coordinates: what homing defines

    def _board(self, number: int, switches: Switches) -> EmulatedController:
        wrong: dict[str, object] = {}
        if self.rng.random() < 0.15:
            scales = [{"um_per_count": 0.1 / scale} for scale in WRONG_SCALES]
            wrong = self.rng.choice([{"encoder_reversed": True}, *scales])
        motor = Motor(
            serial_number=4010001 + number, switches_um=self.travel_um, index_um=self.index_um,
            **wrong,
        )  # fmt: skip
        stage = ScatteringStage(
            random.Random(self.rng.random()), 0.04, self.travel_um, sum(self.travel_um) / 2
        )
        address = 1 if self.own_ports else number + 1
        return EmulatedController(address, stage, motor, switches, self.line.now_s)

    def _make_plugs(self, switches: Switches) -> None:
        groups = [[board] for board in self.boards] if self.own_ports else [self.boards]
        for number, group in enumerate(groups):
            bus = EmulatedBus(group, switches, random.Random(self.rng.random()))
            bus.faults.reply_delay_s = self.latency_s
            self.line.plugs[f"port{number}"] = Plug(self.line, bus)

    def _axis(self, number: int) -> AxisConfig:
        return axis_config(
            NAMES[number], f"port{number if self.own_ports else 0}", self.boards[number].address,
            self.drive, approach_um=self.rng.choice((0, 50)), home_um=self.home_um,
            travel_min_um=self.travel_um[0], travel_max_um=self.travel_um[1],
            home_to="index" if self.to_index else "end",
            limit_switches=self.rng.choice((None, 1)), serial_number=4010001 + number,
        )  # fmt: skip

    # --- asking -------------------------------------------------------------------------------

    @property
    def now_ms(self) -> int:
        return self.bridge.status().now_ms

    def ask(self, request: Message) -> str:
        answer = self.bridge._answer(request)
        if answer is None:  # a declaration that waits for a board: it is answered when it is done
            while self.bridge._declaring.under_way:
                self.run(0.02)
        code = answer.code if answer else "declared late"
        self.tally[code] += 1
        return code

    def run(self, seconds: float) -> None:
        until_s = self.line.now_s + seconds
        while self.line.now_s < until_s:
            self.bridge._freshen(self.now_ms)
            self.bridge.tick()
            self.line.wait(0.02)
            self.check_always()

    def until_still(self) -> None:
        deadline_s = self.line.now_s + 70
        while self.bridge.moving and self.line.now_s < deadline_s:
            self.run(0.04)
        assert not self.bridge.moving

    def make_ready(self) -> bool:
        for _ in range(40):
            if self.bridge.motors.status.fault is None:
                break
            self.run(0.25)
        if self.bridge.motors.status.fault is not None:
            self.bridge.motors.stop()
            return False
        if self.bridge.stopped:
            self.ask(Rearm("t", self.bridge.stop_count, self.now_ms))
        for phase in ("MANUAL",):
            self.ask(SetPhase(phase, "t", self.now_ms))
        self.ask(Arm("t", self.bridge.stop_count, self.now_ms))
        return self.bridge.armed

    # --- the truth ----------------------------------------------------------------------------

    def truth_um(self) -> dict[str, float]:
        return {
            name: board.physics.position_um
            for name, board in zip(self.names, self.boards, strict=True)
        }

    def check_always(self) -> None:
        spare_um = TOLERANCE_UM + (BLIND_UM if self.blind else 0.0)
        low_um, high_um = self.travel_um
        for name, at_um in self.truth_um().items():
            told_um = at_um - self.offset_um[name]
            if name in self.at_an_end:
                continue
            assert low_um - spare_um <= told_um <= high_um + spare_um, (
                f"{name} at {told_um:.0f} um, {self}"
            )

    def check_certain(self) -> None:
        self.run(0.3)  # a readback is as old as the last poll
        status = self.bridge.status()
        if status.moving:
            return
        for name in status.certain_axes:
            told_um = status.positions_um[name] + status.correction_um.get(name, 0)
            bound_um = status.bound_um.get(name, 0) + TOLERANCE_UM + 5
            off_um = self.truth_um()[name] - self.offset_um[name] - told_um
            assert abs(off_um) <= bound_um, f"{name}: certain, and {off_um:+.0f} um off, {self}"
        if self.drive == "open_loop":
            self.check_remembered(status)

    def check_remembered(self, status: Status) -> None:
        """Where an axis is taken for, that is not certain, is true within its bound as well."""
        for name, taken_um in status.remembered_um.items():
            off_um = self.truth_um()[name] - self.offset_um[name] - taken_um
            bound_um = status.bound_um[name] + TOLERANCE_UM
            assert abs(off_um) <= bound_um, (
                f"{name}: taken for {taken_um} +- {bound_um} um, and {off_um:+.0f} um off, {self}"
            )

    def __str__(self) -> str:
        return (
            f"seed {self.seed}, {self.count} axes, {self.drive}, own ports {self.own_ports}, "
            f"latency {self.latency_s}, travel {self.travel_um}, "
            f"{[b.motor for b in self.boards]}, tally {dict(self.tally)}"
        )

    # --- what happens -------------------------------------------------------------------------

    def declare_what_is_measured(self) -> None:
        """An engineer with a gauge, for the axes that are not certain or are known too little."""
        for name, at_um in self.truth_um().items():
            status = self.bridge.status()
            loose = status.bound_um.get(name, 0) > 3000
            if name in status.certain_axes and not loose:
                continue
            measured_um = round(at_um - self.offset_um[name] + self.rng.uniform(-20, 20))
            inside_um = min(max(measured_um, self.travel_um[0]), self.travel_um[1])
            if abs(inside_um - measured_um) <= TOLERANCE_UM:
                self.ask(DeclarePosition({name: measured_um}, "t", self.now_ms, {name: 25}))

    def home(self) -> None:
        name = self.rng.choice(self.names)
        if self.ask(Home(f"home {self.moves}", "t", self.now_ms, (name,))) != "ok":
            return
        self.at_an_end.add(name)  # the mechanical one lies outside of the travel
        self.until_still()
        self.run(0.3)
        if name in self.bridge.status().certain_axes:
            self.tally["homed"] += 1
            # what homing found is, by definition, where the coordinates begin
            told_um = self.bridge.status().positions_um[name]
            at_um = self.truth_um()[name]
            wanted_um = self.index_um if self.to_index else self.travel_um[0]
            off_um = at_um - told_um - (wanted_um - self.home_um)
            within_um = TOLERANCE_UM if self.to_index else STOP_UM + 200
            assert abs(off_um) < within_um, f"homed {off_um:+.0f} um off, {self}"
            self.offset_um[name] = at_um - told_um
            self.at_an_end.discard(name)

    def move(self) -> None:
        self.at_an_end -= {
            name
            for name, at_um in self.truth_um().items()
            if self.travel_um[0] <= at_um - self.offset_um[name] <= self.travel_um[1]
        }
        status = self.bridge.status()
        setpoints_um = dict(status.positions_um)
        asked = self.rng.sample(self.names, self.rng.randint(1, self.count))
        for name in asked:
            way_um = self.rng.choice((150, 800, 3000, 9000)) * self.rng.uniform(0.5, 1.0)
            target_um = setpoints_um[name] + self.rng.choice((-1, 1)) * way_um
            setpoints_um[name] = round(
                min(max(target_um, self.travel_um[0] + 500), self.travel_um[1] - 500)
            )
        before_um = self.truth_um()
        self.moves += 1
        number = self.moves
        request = Move(
            f"move {self.moves}", setpoints_um, None, self.bridge.last_motion, self.now_ms
        )
        if self.ask(request) == "ok":
            self._disturb_in_motion()
            self.until_still()
            state = self.bridge.status().command_state
            self.tally[f"move {state}"] += 1
        if self.moves != number:
            return  # others were asked for meanwhile, and were judged there
        for name in set(self.names) - set(asked):
            gone_um = abs(self.truth_um()[name] - before_um[name])
            assert gone_um <= TOLERANCE_UM, f"{name} went {gone_um:.0f} um unasked, {self}"

    def _disturb_in_motion(self) -> None:
        if self.rng.random() > 0.15:
            return
        self.run(self.rng.uniform(0.0, 0.6))
        self.disturb()

    def disturb(self) -> None:
        board = self.rng.choice(self.boards)
        plug = self.rng.choice(list(self.line.plugs.values()))
        kind = self.rng.choice(KINDS)
        self.tally[f"fault {kind}"] += 1
        if kind in ("power", "flash"):
            if kind == "flash":
                board.settings.flash |= {3: -5, 4: 5, 11: 7, 13: 0}
            board.power_on(self.line.now_s, deaf_s=self.rng.choice((0.0, 0.4, 2.5)))
        elif kind == "plug":
            plug.out = True
            self.run(self.rng.uniform(0.1, 1.5))
            plug.out = False
        elif kind == "swap" and len(self.line.plugs) > 1:
            self._swap_for_a_while()
        elif kind == "stuck":
            name = self.rng.choice(("limit_switch", "limit_forward", "limit_reverse"))
            self._for_a_while(board, name)
        elif kind == "encoder":
            self.blind = True
            self._for_a_while(board, "encoder_frozen")
        elif kind == "stall" and self.drive == "closed_loop":  # no board sees it otherwise
            self._for_a_while(board, "stalled")
        elif kind == "stop":
            self.bridge.stop_for(Code.OPERATOR_STOP, "t")
        elif kind == "garble":
            plug.bus.faults.garble_replies = 2
        elif kind == "drop":
            plug.bus.faults.drop_replies = 2

    def _for_a_while(self, board: EmulatedController, fault: str) -> None:
        """A dead encoder stays dead for the whole motion: nobody sees one that misses a moment."""
        setattr(board.faults, fault, True)
        self.run(self.rng.uniform(0.1, 1.0))
        self.until_still()
        setattr(board.faults, fault, False)

    def _swap_for_a_while(self) -> None:
        """Two adapters drop out and come back under each other's names."""
        one, two = self.rng.sample(list(self.line.plugs.values()), 2)
        one.out = two.out = True
        self.run(0.3)
        one.bus, two.bus = two.bus, one.bus
        one.out = two.out = False
        self.run(3.0)
        if self.make_ready():
            self.move()
        one.out = two.out = True
        self.run(0.3)
        one.bus, two.bus = two.bus, one.bus
        one.out = two.out = False

    def mend(self) -> None:
        """An engineer has read why nothing gets anywhere, and rewires what is wrong."""
        self.run(0.3)
        for board in self.boards:
            board.motor = replace(board.motor, um_per_count=0.1, encoder_reversed=False)
            board.power_on(self.line.now_s)
        self.tally["mended"] += 1

    def step(self) -> None:
        self.check_certain()
        if not self.bridge.moving and self.rng.random() < 0.04:
            self.mend()
        if self.rng.random() < 0.06:
            self.disturb()
        if not self.make_ready():
            self.run(1.0)
            return
        if self.rng.random() < 0.03:
            self.home()
        else:
            self.declare_what_is_measured()
            self.move()
        self.check_certain()


def run_campaign(folder: Path, moves: int, first_seed: int) -> Counter[str]:
    total: Counter[str] = Counter()
    done, seed = 0, first_seed
    while done < moves:
        campaign = Campaign(folder / f"{seed}", seed)
        for _ in range(60):
            campaign.step()
        campaign.journal.close()
        total += campaign.tally
        total["robots"] += 1
        done += campaign.moves
        seed += 1
    total["moves"] = done
    return total


def test_a_short_campaign(tmp_path: Path):
    total = run_campaign(tmp_path, 120, 100)
    assert total["move DONE"] > 50, total


@pytest.mark.soak
def test_twenty_thousand_moves(tmp_path: Path):
    first_seed = int(os.environ.get("SEED", "1000"))
    total = run_campaign(tmp_path, int(os.environ.get("MOVES", "20000")), first_seed)
    print(dict(total))
    assert total["move DONE"] > 0.6 * total["moves"], total
