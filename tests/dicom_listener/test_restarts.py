"""Random days through inbox and record: duplicates, conflicts, pending slices; and restarts.

Time is made up: every instant comes with the operation.
"""

import random
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from made_slices import begin_hold, mr_data_set
from pydicom.dataset import Dataset

from case_record.record import CaseRecord
from dicom_listener.clock_offset import ClockRules
from dicom_listener.inbox import Envelope, Inbox, sha256_of
from dicom_listener.intake import Intake, IntakeRules
from dicom_listener.metrics import ListenerMetrics
from dicom_listener.promptness import Promptness
from dicom_slice.quirks import MR_IMAGE

_BEGAN_S = 1.75e9
_HEAD_BYTES = 144


@dataclass(frozen=True)
class Sent:
    uid: str
    number: int
    began_s: float
    length_s: float
    received_s: float
    pixel: int = 0


@dataclass(frozen=True)
class Stand:
    settled_s: float
    expected: int


@dataclass(frozen=True)
class Leave:
    at_s: float


def a_day(dice: random.Random) -> list[Any]:
    """Operations in their order. The scanner's clock is off by up to a minute, and may jump."""
    offset_s, now_s, number = dice.uniform(-60, 60), _BEGAN_S, 0
    operations: list[Any] = []
    sent: list[Sent] = []
    for _ in range(dice.randint(2, 5)):
        operations.append(Stand(now_s, expected := dice.randint(1, 3)))
        for _ in range(expected + dice.choice((-1, 0, 0, 0, 1))):
            number += 1
            began_s = now_s + dice.uniform(0.5, 4.0)
            now_s = began_s + 1.0 + dice.uniform(0.05, 0.9)
            slice_ = Sent(f"1.2.3.{number}", number, began_s - offset_s, 1.0, now_s)
            operations.append(slice_)
            sent.append(slice_)
        if sent and dice.random() < 0.4:  # sent again, the same or, worse, not the same
            old = dice.choice(sent)
            again = Sent(**{**vars(old), "received_s": now_s, "pixel": dice.choice((0, 0, 1))})
            operations.append(again)
        if dice.random() < 0.1:
            offset_s += dice.choice((-20.0, 20.0))
        now_s += dice.uniform(0.1, 2.0)
        operations.append(Leave(now_s))
        now_s += dice.uniform(0.2, 5.0)
    return operations


class Desk:
    """The listener's side and the service's side of one case."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.service = CaseRecord(folder / "case", create=True)
        self.start()

    def start(self) -> None:
        self.record = CaseRecord(self.folder / "case")
        self.inbox = Inbox(self.folder / "case" / "inbox")
        rules = IntakeRules(clock=ClockRules(Promptness(0.0, 1.0), witnesses=2))
        self.intake = Intake(self.record, self.inbox, rules, ListenerMetrics())

    def end(self) -> None:
        self.intake.close()
        self.record.close()

    def restart(self) -> None:
        self.end()
        self.start()

    def carry_out(self, operation: Any) -> None:
        if isinstance(operation, Stand):
            begin_hold(self.service, operation.settled_s, operation.expected)
        elif isinstance(operation, Leave):
            self.service.end_open_hold(operation.at_s)
        else:
            self.receive(operation)
        self.intake.look_at_record()

    def receive(self, sent: Sent) -> None:
        body = self.encoded(sent)
        envelope = Envelope(
            "SCANNER", "AUTOSPINE", "127.0.0.1", 1, sent.received_s, 1.0, "1.2.840.10008.1.2.1",
            MR_IMAGE, sent.uid, sha256_of(body), len(body),
        )  # fmt: skip
        self.intake.take(self.inbox.store(body, envelope))

    def encoded(self, sent: Sent) -> bytes:
        data_set: Dataset = mr_data_set(sent.uid, began_s=sent.began_s)
        data_set.AcquisitionDuration = sent.length_s
        data_set.AcquisitionNumber = sent.number
        data_set.PixelData = bytes([sent.pixel]) + data_set.PixelData[1:]
        path = self.folder / "encoded.dcm"
        data_set.save_as(path, enforce_file_format=True)
        whole = path.read_bytes()
        return whole[_HEAD_BYTES + int.from_bytes(whole[140:_HEAD_BYTES], "little") :]

    def decisions(self) -> list[tuple[str, str, int | None, str]]:
        return [
            (row.sop_instance_uid, row.state, row.hold_id, row.reason_code)
            for row in self.record.slices()
        ]


def live_through(folder: Path, operations: list[Any], restarts: set[int]) -> Desk:
    desk = Desk(folder)
    for number, operation in enumerate(operations):
        desk.carry_out(operation)
        if number in restarts:
            desk.restart()
    return desk


@pytest.mark.parametrize(
    "seeds", [range(8), pytest.param(range(8, 40), marks=pytest.mark.soak)], ids=["few", "many"]
)
def test_a_restart_at_any_point_of_any_day_changes_no_decision(tmp_path, seeds):
    assigned = 0
    for seed in seeds:
        dice = random.Random(seed)
        operations = a_day(dice)
        restarts = {n for n in range(len(operations)) if dice.random() < 0.4}
        through = live_through(tmp_path / f"{seed}a", operations, set())
        broken = live_through(tmp_path / f"{seed}b", operations, restarts)
        assert through.decisions() == broken.decisions(), f"seed {seed}"
        assigned += sum(state == "assigned" for _, state, _, _ in through.decisions())
        check_whole(broken, operations)
        for desk in (through, broken):
            desk.end()
            desk.service.close()
    assert assigned > 20


def check_whole(desk: Desk, operations: list[Any]) -> None:
    """Nothing is lost or there twice, and no hold has more slices than it expects."""
    sent = {(op.uid, op.pixel) for op in operations if isinstance(op, Sent)}
    rows = desk.record.slices()
    assert len({(row.sop_instance_uid, row.sha256) for row in rows}) == len(rows) == len(sent)
    assert all((desk.record.case_dir / row.path).exists() for row in rows)
    assert len(desk.inbox.files()) == len(sent)
    counts = Counter(row.hold_id for row in rows if row.hold_id is not None)
    for hold in desk.record.holds():
        assert counts[hold.hold_id] <= hold.expected_slices
