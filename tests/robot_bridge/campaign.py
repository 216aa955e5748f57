"""A campaign of commands over a bad line, and the oracle that judges what the motors did.

The oracle does not ask the bridge. It knows what the service asked for (every command has setpoints
of its own), when operators armed, and when a STOP frame reached the bridge's end of the wire; and
it looks at what the stage really did. Everything follows from the seed.
"""

import bisect
import random
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

from axis_model import AXES
from virtual_room import VirtualRoom

from robot_bridge.client.client import BridgeClient, LinkLostError, MoveOutcome, RefusedError
from robot_bridge.protocol.messages import Code, CommandState
from robot_bridge.protocol.phases import WorkPhase
from simulator.serial_line import LineFaults

SPAN_UM = 400  # moves are short, so that a campaign is long
OPERATOR = "operator"


@dataclass(frozen=True)
class Asked:
    command_id: str
    setpoints_um: dict[str, int]
    at_s: float
    should_be_refused: bool


@dataclass
class Findings:
    commands: int = 0
    double_moves: int = 0
    wrong_moves: int = 0
    moves_after_stop: int = 0
    moves_unarmed: int = 0
    moves_of_refused: int = 0
    disagreements: int = 0
    states: Counter[str] = field(default_factory=Counter)
    codes: Counter[str] = field(default_factory=Counter)
    events: Counter[str] = field(default_factory=Counter)

    @property
    def harm(self) -> dict[str, int]:
        return {
            "double_moves": self.double_moves,
            "wrong_moves": self.wrong_moves,
            "moves_after_stop": self.moves_after_stop,
            "moves_unarmed": self.moves_unarmed,
            "moves_of_refused": self.moves_of_refused,
            "disagreements": self.disagreements,
        }


def random_faults(rng: random.Random) -> LineFaults:
    def chance(most: float) -> float:
        return rng.choice((0.0, rng.uniform(0.0, most), most))

    return LineFaults(
        loss=chance(0.3),
        bit_flip=chance(0.2),
        duplicate=chance(0.3),
        truncate=chance(0.1),
        garbage=chance(0.2),
        delay=chance(0.3),
        delay_max_s=rng.choice((0.05, 0.5, 3.0)),
    )


class Campaign:
    def __init__(self, folder: Path, seed: int) -> None:
        self.rng = random.Random(seed)
        self.room = VirtualRoom(folder, seed)
        self.client = self.room.client()
        self.asked: dict[str, Asked] = {}
        self.outcomes: dict[str, MoveOutcome] = {}
        self.armings_s: list[float] = []
        self.opened_s: list[float] = []
        self.findings = Findings()
        self._position_asked = 0
        self._stop_at_s: float | None = None
        self._number = 0
        self._rearmed_s: list[float] = []
        self._seed = seed

    # --- the service's life -------------------------------------------------------------------

    def run(self, commands: int) -> Findings:
        while self.findings.commands < commands:
            if self.findings.commands % 40 == 0:
                self.room.set_faults(random_faults(self.rng))
            self._disturb()
            self._one_command()
        self._settle()
        self._judge()
        return self.findings

    def _disturb(self) -> None:
        """Now and then something happens that nobody asked for."""
        dice = self.rng.random()
        if dice < 0.010:
            self._event("bridge killed")
            self.room.crash_bridge(self.rng.uniform(0.05, 1.0))
        elif dice < 0.025:
            self._event("bridge killed while writing")
            self.room.crash_at_sync = self.rng.randrange(3)
        elif dice < 0.035:
            self._event("service killed")
            self.client = self.room.client()
        elif dice < 0.042:
            self._event("line unplugged")
            self.room.unplug()
            self.room.run(self.rng.uniform(0.0, 2.0))
            self.room.plug_in()
        elif dice < 0.055:
            self._event("stop")
            self.client.request_stop(emergency=self.rng.random() < 0.3)
        elif dice < 0.060:
            self._event("service asleep")
            self.room.run(self.rng.uniform(0.5, 2.5))
        elif dice < 0.075:
            self._event("fault of a motor")
            self.room.motors.fault = "encoder"
        elif dice < 0.080:
            self._event("controller refuses")
            self.room.motors.refuse_moves = True
        elif dice < 0.085:
            self._event("stop not confirmed")
            self.room.motors.stop_fails = 2

    def _event(self, name: str) -> None:
        self.findings.events[name] += 1

    def _one_command(self) -> None:
        command = self._new_command()
        while True:
            try:
                self._make_ready()
                self._ask(command)
                return
            except LinkLostError:
                self._event("link lost")
                self._reopen()

    def _reopen(self) -> None:
        for _ in range(20):
            try:
                self.client.open(3.0)
                self.opened_s.append(self.room.clock())
                return
            except LinkLostError:
                self.room.plug_in()
        raise AssertionError(f"seed {self._seed}: the link cannot be opened any more")

    def _make_ready(self) -> None:
        """What an operator does to go on; sometimes they forget."""
        if not self.client.is_open:
            self._reopen()
        self.room.motors.fault = None
        self.room.motors.refuse_moves = False
        for _ in range(6):
            if self.rng.random() < 0.02:
                return
            status = self.client.status
            try:
                if status.stopped and self.client.stop_acknowledged:
                    self.armings_s.append(self.room.clock())
                    self.client.rearm(OPERATOR)
                elif status.stopped:
                    self.client.pump(0.1)
                elif not status.position_certain:
                    stands_um = self.room.stage.positions_um()
                    self.client.declare_position(stands_um, OPERATOR)
                elif status.phase is not WorkPhase.MANUAL:
                    self.client.set_phase(WorkPhase.MANUAL, OPERATOR)
                elif not status.armed:
                    self.armings_s.append(self.room.clock())
                    self.client.arm(OPERATOR)
                else:
                    return
            except RefusedError as refusal:
                self.findings.codes[f"request {refusal.code}"] += 1
                self.client.pump(0.05)

    def _new_command(self) -> Asked:
        self._number += 1
        # Every command has setpoints that no other command of the campaign has.
        base = (self._number * 7) % SPAN_UM
        setpoints = dict(zip(AXES, (base, self._number % 9973, 0, 0), strict=True))
        setpoints["xb"], setpoints["yb"] = self._number // 9973, -base
        bad = self.rng.random() < 0.05
        if bad:
            setpoints["yb"] = self.rng.choice((10_001, -10_001, 2_000_000_000))
        return Asked(f"{self._seed}-{self._number}", setpoints, self.room.clock(), bad)

    def _ask(self, command: Asked) -> None:
        if command.command_id not in self.asked:
            self.asked[command.command_id] = command
            self.findings.commands += 1
        if self.rng.random() < 0.02:
            self._stop_at_s = self.room.clock() + self.rng.uniform(0.0, 0.06)
        outcome = self.client.move(
            command.command_id, command.setpoints_um, None, self._while_moving
        )
        self._stop_at_s = None
        self.outcomes[command.command_id] = outcome

    def _while_moving(self, state: CommandState, status: object) -> None:
        if self._stop_at_s is not None:
            self._event("stop in motion")
            self._stop_at_s = None
            self.client.request_stop()
        elif self.rng.random() < 0.003:
            self._event("bridge killed in motion")
            self.room.crash_bridge(self.rng.uniform(0.05, 0.5))

    # --- the oracle ---------------------------------------------------------------------------

    def _settle(self) -> None:
        """The line is good again; both sides must now agree on every command."""
        self.room.set_faults(LineFaults())
        self.room.crash_at_sync = -1
        self.room.run(4.0)
        self._reopen()

    def _judge(self) -> None:
        begun = self.room.stage.begun
        self._rearmed_s = self.room.rearmed_s()
        by_setpoints = {tuple(a.setpoints_um.values()): a for a in self.asked.values()}
        assert len(by_setpoints) == len(self.asked)
        times_begun = Counter(tuple(motion.setpoints_um.values()) for motion in begun)
        findings = self.findings
        findings.double_moves = sum(count - 1 for count in times_begun.values())
        findings.wrong_moves = sum(setpoints not in by_setpoints for setpoints in times_begun)
        for motion in begun:
            asked = by_setpoints.get(tuple(motion.setpoints_um.values()))
            if asked is not None:
                self._judge_motion(motion.at_s, asked)
        self._judge_agreement()

    def _judge_motion(self, at_s: float, asked: Asked) -> None:
        findings = self.findings
        findings.moves_of_refused += asked.should_be_refused
        # A session begins disarmed: someone must have armed since it was opened.
        armed_s = _last(self.armings_s, at_s)
        if armed_s < _last(self.opened_s, at_s):
            findings.moves_unarmed += 1
            return
        stops = [stop for stop in self.room.stops_delivered if stop.at_s <= at_s]
        if not stops:
            return
        # The last stop frame that reached the bridge needs a re-arming carried out after it, and
        # the last stop that was new (not a repetition) an operator who called after it. Equal
        # times are in that order: a frame arrives within a step, an operator calls after one.
        first_s: dict[int, float] = {}
        for stop in stops:
            first_s.setdefault(stop.nonce, stop.at_s)
        carried_out_s = _last(self._rearmed_s, at_s)
        obeyed = carried_out_s >= stops[-1].at_s and armed_s >= max(first_s.values())
        findings.moves_after_stop += not obeyed

    def _judge_agreement(self) -> None:
        moved = {tuple(motion.setpoints_um.values()) for motion in self.room.stage.begun}
        for command_id, outcome in self.outcomes.items():
            self.findings.states[outcome.state.value] += 1
            self.findings.codes[outcome.code] += 1
            record = self.room.commands.get(command_id)
            if record is None:
                agree = outcome.code == Code.JOURNAL
            else:
                agree = (outcome.state, outcome.code) == (record.state, record.code)
            setpoints = tuple(self.asked[command_id].setpoints_um.values())
            if outcome.state is CommandState.REFUSED:
                agree = agree and setpoints not in moved
            if outcome.state is CommandState.DONE:
                agree = agree and setpoints in moved
                agree = agree and outcome.readback_um == self.asked[command_id].setpoints_um
            self.findings.disagreements += not (agree and outcome.state.final)
        assert len(self.outcomes) == len(self.asked), "a command without an end"


def _last(times_s: list[float], until_s: float) -> float:
    """The last of the ascending times that is not after `until_s`, or -1."""
    place = bisect.bisect_right(times_s, until_s)
    return times_s[place - 1] if place else -1.0


def again_asked_moves_nothing(campaign: Campaign, sample: int) -> bool:
    """Ask for old ids once more: the same outcomes, and not one more motion."""
    begun = len(campaign.room.stage.begun)
    client: BridgeClient = campaign.client
    for command_id in campaign.rng.sample(sorted(campaign.outcomes), sample):
        asked = campaign.asked[command_id]
        outcome = client.move(command_id, asked.setpoints_um, None)
        assert outcome == campaign.outcomes[command_id], (outcome, campaign.outcomes[command_id])
    return len(campaign.room.stage.begun) == begun
