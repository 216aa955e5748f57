"""Orders in any order, faults in between: READY is true, and nothing moves that nobody ordered.

The room is the service's own control loop and the bridge's own code (`line_room`); who gives the
orders knows nothing. What is true is asked of the model: where the fiducial is, what began to move.
"""

import math
import random
import time
from collections import Counter

import numpy as np
import pytest
from line_room import ORIGIN_MM, LineRoom, patient_mm

from case_record.record import CaseRecordError
from service.room.refusal import ConflictError

ORDERS = 2000
SOAK_SEEDS = range(100, 150)
_MOVING_ORDERS = ("jog", "start_calibration", "start_approach", "record_target")


class Monkey:
    """Gives orders and makes faults; `check` says what must never be."""

    def __init__(self, room: LineRoom, seed: int, patch_time) -> None:
        self.room, self.dice = room, random.Random(seed)
        self.done: Counter[str] = Counter()
        self.refused: Counter[str] = Counter()
        self.readies: dict[int, tuple[float, float]] = {}  # by procedure: error, probability
        self.wrong: list[str] = []
        self.needle_in = self.ordered = False
        self.unseen = False  # a push that no encoder has told of yet
        self.log: list[str] = []
        self._patch_time = patch_time
        self._watch()

    # --- the truth, watched in the control loop's thread

    def _watch(self) -> None:
        show, run = self.room.loop._show, self.room.line.stage.run

        def showing(state):
            show(state)
            if state.ready:
                self._ready(state)

        def running(setpoints_um, *, homing=False):
            if self.needle_in:
                self._fail(f"moves to {setpoints_um} with the needle in")
            if not self.ordered:
                self._fail(f"moves to {setpoints_um} without an order")
            run(setpoints_um, homing=homing)

        self.room.loop._show = showing
        self.room.line.stage.run = running

    def _ready(self, state) -> None:
        bridge = self.room.line.bridge  # None: killed; its journal keeps the lock
        if bridge is not None and not bridge.insertion_locked:
            self._fail("READY although motion is not locked")
        x, _, z = state.target_patient_mm
        error_mm = float(np.linalg.norm(self.room.true_plane_mm() - np.array([-z, x])))
        if self.unseen:
            return
        if error_mm > 4 * state.tolerance_mm:
            self._fail(f"READY at {error_mm:.3f} mm")
        self.readies[state.arrival.procedure_id] = (error_mm, state.arrival.probability)

    def _fail(self, text: str) -> None:
        self.wrong.append(f"{text}; last: {self.log[-12:]}")

    # --- orders

    def order(self, name: str, **arguments) -> bool:
        moves = name in _MOVING_ORDERS or (
            name == "answer" and arguments["choice"] not in ("abort", "reject")
        )
        before = self.ordered
        if moves:
            self.ordered = True
        self.log.append(f"{name} {arguments}")
        self.done[name] += 1
        try:
            self.room.call(name, **arguments)
        except (ConflictError, CaseRecordError) as error:
            self.refused[getattr(error, "code", "record")] += 1
            self.log[-1] += f" -> {error}"
            if moves:
                self.ordered = before
            return False
        return True

    def jog(self) -> None:
        axis, distance_um = self.dice.choice(["xt", "yt", "no"]), self.dice.randrange(-3000, 3000)
        self.order("jog", axis=axis, distance_um=distance_um)

    def set_target(self) -> None:
        row, col = (self.dice.uniform(-3, 3) for _ in range(2))
        wanted = patient_mm(ORIGIN_MM[0] + row, ORIGIN_MM[1] + col)
        if self.dice.random() < 0.1:  # where the fiducial stands just now
            wanted = patient_mm(*self.room.do(self.room.true_plane_mm))
        self.order("set_target", patient_mm=wanted)

    def choose_target(self) -> None:
        with self.room.record() as record:
            known = record.events_of_kind("target_set")
        if known:
            self.order("choose_target", number=self.dice.choice(known).event_id)

    def answer(self) -> None:
        question = self.room.state.question
        if question is None:
            self.order("answer", question_id="none", choice="confirm")
            return
        choice = self.dice.choice([question.choices[0], *question.choices])
        self.order("answer", question_id=question.question_id, choice=choice)

    def approach(self) -> None:
        self.order("start_approach")

    def go_to_ready(self) -> None:
        """What a sensible operator does, lest the room never comes to READY."""
        if (
            not self.order("reset", positions_um=self.room.read_off(self.room.state.robot.taken_um))
            and self.room.state.robot.insertion_locked
        ):
            self.needle_out()
        if self.room.state.robot.insertion_locked:
            self.needle_out()
        if not self.room.state.calibrated:
            self.order("start_calibration")
        else:
            self.set_target()
            self.order("start_approach")
        self.wait_idle()

    def wait_idle(self) -> None:
        """Answer as asked until no procedure runs, for a while."""
        until_s = time.monotonic() + 5.0
        while self.room.state.procedure is not None and time.monotonic() < until_s:
            if self.room.state.question is not None:
                self.answer()
            time.sleep(0.002)

    def puncture(self) -> None:
        ready = self.room.state.ready
        if self.order("puncture"):
            self.needle_in = True
            if not ready and not self.room.later().punctured:
                self._fail("a puncture without READY")

    def lock(self) -> None:
        if self.order("lock_motion"):
            self.needle_in = True

    def needle_out(self) -> None:
        self.needle_in = False  # before it is said
        self.order("needle_out")

    def reset(self) -> None:
        """Re-arming alone moves nothing."""
        if self.room.state.procedure is None:
            self.ordered = False
        begun = len(self.room.line.stage.begun)
        moved_by_order = self.ordered and not self._interrupted()
        read_um = self.room.read_off(self.room.state.robot.taken_um)
        if self.order("reset", positions_um=read_um) and not moved_by_order:
            self.room.later()
            if len(self.room.line.stage.begun) != begun and self.room.state.question is None:
                self._fail("re-arming moved the robot")

    def _interrupted(self) -> bool:
        robot = self.room.state.robot
        return robot.stopped or not robot.armed or not robot.position_certain

    def stop(self, emergency: bool = False) -> None:
        self.log.append("STOP")
        self.done["stop"] += 1
        self.room.stop(emergency=emergency)
        self.ordered = False  # from the answer on

    # --- faults

    def fault(self) -> None:
        name, happens = self.dice.choice(
            [
                ("bridge killed", self.room.line.crash_bridge),
                ("line cut", self.room.line.unplug),
                ("line back", self.room.line.plug_in),
                ("power lost", lambda: self.room.line.motors._certain.clear()),
                ("motor fault", lambda: setattr(self.room.line.motors, "fault", "overheat")),
                ("fault gone", lambda: setattr(self.room.line.motors, "fault", None)),
                ("pushed", self._push),
                ("fiducial out, a decoy in", self._decoy),
                ("fiducial back", self._no_decoy),
                ("other patient", lambda: self._slice(reason_code="other_patient")),
                ("clock", self._clock),
            ]
        )
        self.log.append(name)
        self.done[name] += 1
        if name == "bridge killed" and self.room.line.bridge is None:
            return
        if name == "pushed":
            return self._be_pushed()
        self.room.do(happens)
        if name == "line cut":
            time.sleep(self.dice.uniform(0, 0.01))
            self.room.do(self.room.line.plug_in)

    def _be_pushed(self) -> None:
        """By hand, at a robot that stands: its encoder sees it, and the bridge soon hears of it."""
        self.unseen = True
        self.room.do(self._push)
        until_s = time.monotonic() + 1.0
        at_um = self.room.line.stage.to_um["xt"]
        while self.room.state.robot.positions_um.get("xt") != at_um and time.monotonic() < until_s:
            time.sleep(0.002)
        self.unseen = False

    def _push(self) -> None:
        stage = self.room.line.stage
        if not stage.moving and not self.room.state.robot.moving:
            for places in (stage.from_um, stage.to_um):
                places["xt"] += 250

    def _decoy(self) -> None:
        """Between procedures: what is exchanged while the robot moves to just that place looks as
        if it had come along.
        """
        if self.room.state.procedure is not None:
            return
        target = self.room.state.target_patient_mm
        self.room.fiducial_visible = False
        if target is not None:
            self.room.decoys_mm = [np.array([-target[2], target[0]])]

    def _no_decoy(self) -> None:
        self.room.fiducial_visible, self.room.decoys_mm = True, []

    def _slice(self, reason_code: str) -> None:
        header = {**self.room.header, "study_instance_uid": "9.9"}
        self.room._add_slice(None, header, reason_code=reason_code)

    def _clock(self) -> None:
        self._patch_time(self.dice.choice([0, 600, -600, 3600, -3600]))

    # --- the whole

    def run(self, orders: int) -> None:
        choices = [
            *[self.go_to_ready] * 5,
            *[self.jog, self.set_target, self.answer, self.needle_out] * 3,
            *[self.reset, self.wait_idle, self.puncture, self.fault] * 3,
            *[self.approach, self.choose_target, self.lock] * 1,
            lambda: self.order("start_calibration"),
            lambda: self.order("record_target"),
            lambda: self.order("withdraw_target"),
            lambda: self.order("abort"),
            self.stop,
            lambda: self.stop(emergency=True),
        ]
        while self.done.total() < orders and not self.wrong:
            self.dice.choice(choices)()
            assert self.room.loop.failure is None, self.room.loop.failure
        assert not self.wrong, self.wrong[0]


def campaign(folder, seed, orders, monkeypatch):
    real = time.time
    step = [0.0]
    monkeypatch.setattr(time, "time", lambda: real() + step[0])
    room = LineRoom(folder, "ready_valid_s = 2.0", seed)
    monkey = Monkey(room, seed, lambda by: step.__setitem__(0, by))
    room.loop.start()
    try:
        room.arm()
        monkey.run(orders)
    finally:
        room.loop.close()
        room.line.close()
    with room.record() as record:
        assert record.verify().events > orders / 4
        punctures = record.events_of_kind("puncture")
        said = {event.body["procedure_id"] for event in record.events_of_kind("ready")}
        assert {event.body["procedure_id"] for event in punctures} <= said
    return monkey


def check_probability(readies):
    """No more of them are outside of the tolerance than they said of themselves, by chance."""
    outside = sum(error_mm > 0.06 for error_mm, _ in readies)
    expected = sum(1 - probability for _, probability in readies)
    assert outside <= expected + 4 * math.sqrt(expected) + 3


def test_orders_in_any_order_and_faults_in_between(tmp_path, monkeypatch):
    monkey = campaign(tmp_path, 7, ORDERS, monkeypatch)
    assert monkey.done.total() >= ORDERS
    assert len(monkey.readies) > 10, (monkey.done, monkey.refused)
    check_probability(monkey.readies.values())


@pytest.mark.soak
@pytest.mark.parametrize("seed", SOAK_SEEDS)
def test_the_same_for_a_hundred_thousand_orders(tmp_path, monkeypatch, seed):
    monkey = campaign(tmp_path, seed, ORDERS, monkeypatch)
    check_probability(monkey.readies.values())
