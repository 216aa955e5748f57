"""Orders in any order and faults in between, in running processes: what moved, and where the
fiducial truly was at READY, is asked of the motors' truth port.
"""

import contextlib
import os
import random
import signal
import threading
import time
from collections import Counter
from collections.abc import Callable

import numpy as np
import pytest
from attended_room import AttendedRoom, arm, read_off, running_room, wait_for

from case_record.record import CaseRecord
from service.client import RefusedByServiceError, RoomClient, ServiceGoneError
from service.room.state import RoomState
from service.room.validity import READY, READY_LOST
from simulator.config import VirtualRoom
from simulator.scene import true_fiducial_mm
from simulator.truth_client import TruthAddress, ask_where
from simulator.unintended import TrueMotion, ask_motions, unintended_motions

ORDERS, SOAK_ORDERS = 40, 2000
REFUSED = (RefusedByServiceError, ServiceGoneError, AssertionError)


class Rough:
    """Somebody who presses whatever there is, in a room whose processes die."""

    def __init__(self, room: AttendedRoom, client: RoomClient, seed: int) -> None:
        self.room, self.client, self.dice = room, client, random.Random(seed)
        self.done: Counter[str] = Counter()
        self.readies = 0
        self.motions: dict[tuple[str, float], TrueMotion] = {}
        self._truth = TruthAddress("127.0.0.1", room.truth_port)

    def act(self) -> None:
        acts: list[Callable[[], None]] = [
            *[self.go_to_ready] * 3, self.jog, self.target, self.answer, self.client.needle_out,
            self.reset, self.client.record_puncture, self.client.stop, self.emergency,
            self.client.abort, self.client.start_approach, *[self.fault] * 3,
        ]  # fmt: skip
        act = self.dice.choice(acts)
        self.done[act.__name__] += 1
        with contextlib.suppress(*REFUSED):
            act()
        self.look()

    def look(self) -> None:
        """READY is true whenever it is said."""
        for motion in ask_motions(self._truth):
            self.motions[motion.axis, motion.start_s] = motion
        with contextlib.suppress(ServiceGoneError):
            state = self.client.state()
            if state.ready and state.target_patient_mm is not None:
                where = ask_where(self._truth).positions_mm
                off_mm = np.array(true_fiducial_mm(VirtualRoom(), where)) - state.target_patient_mm
                off_mm[1] = 0.0  # along the slice's normal nothing is steered
                assert np.linalg.norm(off_mm) < 4 * state.tolerance_mm, state
                self.readies += 1

    def go_to_ready(self) -> None:
        self.client.needle_out()
        arm(self.client)
        if not self.client.state().calibrated:
            self.client.start_calibration()
        else:
            self.target()
            self.client.start_approach()
        wait_for(self.client.state, self._is_over, 60.0)

    def _is_over(self, state: RoomState) -> bool:
        if state.question is not None:
            with contextlib.suppress(RefusedByServiceError):
                self.client.answer(state.question.question_id, state.question.choices[0])
        stands = not state.robot.moving and (state.robot.stopped or not state.robot.armed)
        return state.procedure is None or stands

    def jog(self) -> None:
        self.client.jog(self.dice.choice(["xt", "yt"]), self.dice.randrange(-2000, 2000))

    def target(self) -> None:
        seen = self.client.state().measurement
        if seen is not None and seen.patient_mm is not None:
            x, y, z = seen.patient_mm
            self.client.set_target((x + self.dice.uniform(-1, 1), y, z + self.dice.uniform(-1, 1)))

    def answer(self) -> None:
        question = self.client.state().question
        if question is not None:
            self.client.answer(question.question_id, self.dice.choice(question.choices))

    def reset(self) -> None:
        self.client.reset(read_off(self.client, self.client.state().robot.taken_um))

    def emergency(self) -> None:
        self.client.stop(emergency=True)

    def fault(self) -> None:
        name = self.dice.choice(["service", "worker", "listener", "bridge", "hang"])
        if name == "hang":
            pid = self.room.family.children["service"].process.pid
            os.kill(pid, signal.SIGSTOP)
            threading.Event().wait(self.dice.uniform(0.1, 1.5))
            os.kill(pid, signal.SIGCONT)
            return
        self.room.kill(name)
        if name == "bridge":
            self.room.start_bridge_again()
        else:
            self.room.start_again(name)


def campaign(folder, seed: int, orders: int) -> Rough:
    with running_room(folder) as room, RoomClient(room.url, by="rough") as client:
        rough = Rough(room, client, seed)
        rough.go_to_ready()  # the calibration
        while rough.done.total() < orders:
            rough.act()
        with contextlib.suppress(*REFUSED):
            client.stop()
        room.wait_for_standstill()
        time.sleep(0.5)
        rough.look()
        for child in room.family.children.values():
            assert child.process.poll() is None, child.describe_end()
    with CaseRecord(room.folder, read_only=True) as record:
        assert record.verify().events > orders
        assert unintended_motions(list(rough.motions.values()), record.moves()) == []
        _check_punctures(record)
    return rough


def _check_punctures(record: CaseRecord) -> None:
    """None without a READY that stood."""
    said = {event.body["procedure_id"]: event.seq for event in record.events_of_kind(READY)}
    lost = {event.body["procedure_id"]: event.seq for event in record.events_of_kind(READY_LOST)}
    for puncture in record.events_of_kind("puncture"):
        number = puncture.body["procedure_id"]
        assert said[number] < puncture.seq < lost.get(number, puncture.seq + 1)


def test_orders_in_any_order_in_running_processes(tmp_path):
    rough = campaign(tmp_path, 3, ORDERS)
    assert rough.readies, rough.done


@pytest.mark.soak
@pytest.mark.timeout(0)
def test_two_thousand_orders_in_running_processes(tmp_path):
    assert campaign(tmp_path, 4, SOAK_ORDERS).readies > 50
