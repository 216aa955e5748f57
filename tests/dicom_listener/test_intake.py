"""From the inbox into the record, without a network: many frames, clocks, retention, damage."""

import os
import time
from datetime import datetime
from pathlib import Path

import pytest
from made_slices import begin_hold, mr_data_set
from mangled import mangled
from pydicom import dcmread
from pydicom.dataset import Dataset
from pydicom.sequence import Sequence
from real_slices import DICOM

from case_record.cases import Cases
from case_record.record import CaseRecord
from dicom_listener.clock_offset import ClockRules, Comparison
from dicom_listener.inbox import Envelope, Inbox, NotFromInboxError, read_envelope, sha256_of
from dicom_listener.intake import Intake, IntakeRules
from dicom_listener.metrics import ListenerMetrics
from dicom_listener.operator_actions import give_up_slices, reset_clock, sync_clock
from dicom_listener.promptness import Promptness
from dicom_listener.retention import remove_old
from dicom_slice.eligibility import SliceRules
from dicom_slice.quirks import ENHANCED_MR_IMAGE
from service.room.cases.life import begin, reopen


class Desk:
    """A record, an inbox and an intake in one folder."""

    def __init__(self, folder: Path, **rules) -> None:
        rules.setdefault("comparison", Comparison(0.0, 0.1, time.time()))
        self.record = CaseRecord(folder / "case", create=True)
        self.inbox = Inbox(folder / "case" / "inbox")
        self.folder = folder
        self.intake = Intake(self.record, self.inbox, IntakeRules(**rules), ListenerMetrics())

    def receive(self, data: Dataset | bytes, syntax: str = "1.2.840.10008.1.2.1", **changes):
        """Store a data set as if it had just been sent, take it, and return its rows."""
        body = data if isinstance(data, bytes) else self.encoded(data)
        uid = "1.2.3" if isinstance(data, bytes) else str(data.SOPInstanceUID)
        values = {
            "calling_ae_title": "SCANNER",
            "called_ae_title": "AUTOSPINE",
            "peer_address": "127.0.0.1",
            "peer_port": 104,
            "received_s": time.time(),
            "received_monotonic_s": time.monotonic(),
            "transfer_syntax_uid": syntax,
            "sop_class_uid": "1.2.840.10008.5.1.4.1.1.4",
            "sop_instance_uid": uid,
            "sha256": sha256_of(body),
            "size_bytes": len(body),
            **changes,
        }
        self.intake.take(self.inbox.store(body, Envelope(**values)))
        return self.record.slices(sha256=values["sha256"])

    def encoded(self, data_set: Dataset) -> bytes:
        path = self.folder / "encoded.dcm"
        data_set.save_as(path, enforce_file_format=True)
        whole = path.read_bytes()
        return whole[144 + int.from_bytes(whole[140:144], "little") :]

    def alarms(self) -> list[str]:
        return [e.body["alarm"] for e in self.record.events() if e.kind == "alarm"]


@pytest.fixture
def make_desk(tmp_path):
    desks = []

    def make(**rules) -> Desk:
        desks.append(Desk(tmp_path, **rules))
        return desks[-1]

    yield make
    for desk in desks:
        desk.intake.close()
        desk.record.close()


def enhanced(n_frames: int, began_s: float) -> Dataset:
    """An enhanced object whose frames are coronal slices 5 mm apart."""
    data_set = mr_data_set("1.2.826.0.5", began_s=began_s)
    data_set.SOPClassUID = ENHANCED_MR_IMAGE
    data_set.file_meta.MediaStorageSOPClassUID = ENHANCED_MR_IMAGE
    data_set.NumberOfFrames = n_frames
    data_set.PixelData = data_set.PixelData * n_frames
    frames = []
    for k in range(n_frames):
        frame, position = Dataset(), Dataset()
        position.ImagePositionPatient = [-20, 10 + 5 * k, 24]
        frame.PlanePositionSequence = Sequence([position])
        frames.append(frame)
    data_set.PerFrameFunctionalGroupsSequence = Sequence(frames)
    return data_set


def stack(place: int, began_s: float) -> Dataset:
    """One slice of a stack, in an object of its own."""
    data_set = mr_data_set(f"1.2.7.{place}", began_s=began_s)
    data_set.ImagePositionPatient = [-20, 10 + 5 * place, 24]
    data_set.InstanceNumber = place + 1
    return data_set


def series(place: int, began_s: float) -> Dataset:
    """One of several short acquisitions that are pushed together."""
    data_set = stack(place, began_s + 0.3 * place)
    data_set.AcquisitionDuration, data_set.AcquisitionNumber = 0.2, place + 1
    return data_set


@pytest.mark.parametrize("made", [stack, series])
@pytest.mark.parametrize("held_up_s", [15.0, 86400.0])
def test_what_comes_late_at_once_bears_no_witness_to_its_own_promptness(make_desk, made, held_up_s):
    desk = make_desk(clock=ClockRules(promptness=Promptness(0.0, 2.0)), comparison=None)
    now_s = time.time()
    begin_hold(desk.record, now_s - held_up_s / 2, expected=5)
    for place in range(5):
        desk.receive(made(place, now_s - held_up_s - 2.0), received_s=now_s + 0.2 * place)
    assert {row.reason_code for row in desk.record.slices()} == {"clock_unknown"}
    assert "separate acquisitions" in desk.record.slices()[0].reason


def test_the_frames_of_a_late_object_bear_no_witness_to_their_own_promptness(make_desk):
    desk = make_desk(clock=ClockRules(promptness=Promptness(0.0, 2.0)), comparison=None)
    begin_hold(desk.record, time.time() - 10, expected=5)
    rows = desk.receive(enhanced(5, time.time() - 20.5))
    assert {row.reason_code for row in rows} == {"clock_unknown"}


@pytest.mark.parametrize("is_fresh", [True, False])
def test_files_that_may_have_lain_there_bear_no_witness_to_promptness(make_desk, is_fresh):
    desk = make_desk(clock=ClockRules(promptness=Promptness(0.0, 2.0)), comparison=None)
    now_s = time.time()
    begin_hold(desk.record, now_s - 50, expected=5)
    for place in range(5):
        sent = stack(place, now_s - 40 + 8 * place)
        sent.AcquisitionNumber = place + 1
        desk.receive(sent, received_s=now_s - 39 + 8 * place, is_fresh=is_fresh)
    states = {row.state for row in desk.record.slices()}
    assert states == ({"assigned"} if is_fresh else {"pending"})


@pytest.mark.parametrize("says_start", [True, False])
def test_a_reference_within_the_hold_does_not_hide_a_start_before_it(make_desk, says_start):
    desk = make_desk(clock=ClockRules(unseen_steps=False))
    now_s = time.time()
    begin_hold(desk.record, now_s - 12)
    sent = enhanced(1, now_s - 20)
    del sent.AcquisitionDuration
    if not says_start:
        del sent.AcquisitionDateTime
    content = Dataset()
    content.FrameReferenceDateTime = f"{datetime.fromtimestamp(now_s - 10):%Y%m%d%H%M%S.%f}"
    sent.PerFrameFunctionalGroupsSequence[0].FrameContentSequence = Sequence([content])
    (row,) = desk.receive(sent)
    assert row.state == "quarantined"
    assert ("before" if says_start else "unknown duration") in row.reason
    assert row.time_source == ("AcquisitionDateTime" if says_start else "")


def test_every_frame_of_one_object_is_a_slice_of_the_hold(make_desk):
    desk = make_desk()
    hold_id = begin_hold(desk.record, time.time() - 5, expected=2)
    rows = desk.receive(enhanced(3, time.time() - 0.6))
    assert [(row.frame, row.state) for row in rows] == [
        (0, "assigned"),
        (1, "assigned"),
        (2, "pending"),  # one more than the hold expects
    ]
    assert {row.hold_id for row in rows} == {hold_id, None}
    assert rows[1].header["geometry"]["position_mm"] == [-20, 15, 24]


def test_a_flood_of_slices_that_wait_sets_the_oldest_aside_and_says_so_once(make_desk):
    desk = make_desk()
    hold_id = begin_hold(desk.record, time.time() - 5, expected=1)
    rows = desk.receive(enhanced(230, time.time() - 0.6))
    waiting = [row.frame for row in rows if row.state == "pending"]
    assert waiting == list(range(30, 230))
    assert (rows[1].state, rows[1].reason_code) == ("quarantined", "not_expected")
    assert rows[1].reason.startswith(
        "more than 200 slices were pending (hold 1 already has all its slices, 1 of 1"
    )
    assert desk.alarms() == ["many_slices_wait"]
    desk.record.expect_slices(hold_id, 2)
    desk.record.end_open_hold(time.time() + 1.0)
    desk.intake._decide_pending()
    assert desk.record.slice(rows[30].slice_id).state == "assigned"
    assert not desk.record.slices(state="pending")


def test_a_slice_waits_for_the_clocks_no_longer_than_a_comparison_would_count(make_desk):
    desk = make_desk(comparison=None)
    begin_hold(desk.record, time.time() - 4000.0, expected=3)
    long_ago_s = time.time() - 3610.0
    old = mr_data_set("1.2.1", began_s=long_ago_s - 1.0)
    (old_row,) = desk.receive(old, received_s=long_ago_s)
    (new_row,) = desk.receive(mr_data_set("1.2.2", began_s=time.time() - 0.6))
    old_row = desk.record.slice(old_row.slice_id)
    assert (old_row.state, old_row.reason_code) == ("quarantined", "clock_unknown")
    assert old_row.reason.startswith("it was pending too long: the clocks were not compared")
    assert new_row.state == "pending"


def test_a_stack_at_the_next_hold_must_lie_where_the_first_one_lay(make_desk):
    desk = make_desk(clock=ClockRules(unseen_steps=False))
    begin_hold(desk.record, time.time() - 5, expected=1)
    desk.receive(mr_data_set("1.2.1", began_s=time.time() - 0.6))
    desk.record.end_open_hold(time.time())
    begin_hold(desk.record, time.time() + 0.1, expected=2)
    time.sleep(1.3)
    moved = mr_data_set("1.2.2", began_s=time.time() - 0.6)
    moved.AcquisitionNumber = 2
    moved.ImagePositionPatient = [-20, 12, 24]
    assert desk.receive(moved)[0].reason_code == "geometry_differs_from_set"
    same = mr_data_set("1.2.3.3", began_s=time.time() - 0.6)
    same.AcquisitionNumber = 3
    assert desk.receive(same)[0].state == "assigned"


def test_a_data_set_with_another_uid_than_it_was_sent_under_is_set_aside(make_desk):
    (row,) = make_desk().receive(mr_data_set("1.2.9"), sop_instance_uid="1.2.10")
    assert row.reason_code == "uid_contradiction"


def test_a_slice_without_any_uid_still_has_a_row(make_desk):
    data_set = mr_data_set()
    body = make_desk().encoded(data_set)
    (row,) = make_desk().receive(body, sop_instance_uid="")
    assert row.sop_instance_uid.startswith("none-")


def test_a_comparison_of_the_clocks_releases_the_slice_that_waits_for_it(make_desk):
    desk = make_desk(comparison=None)
    begin_hold(desk.record, time.time() - 60, expected=9)
    hour_off = mr_data_set("1.2.1", began_s=time.time() - 3600.6)
    assert desk.receive(hour_off)[0].reason_code == "clock_unknown"
    with CaseRecord(desk.record.case_dir) as service:  # another connection, as in life
        sync_clock(service, 3600.0, 0.5, "anna")
    desk.intake.look_at_record()
    again = mr_data_set("1.2.2", began_s=time.time() - 3600.6)
    assert desk.receive(again)[0].state == "assigned"
    assert desk.record.slices()[0].state == "assigned"


def test_set_aside_files_are_removed_after_their_retention_and_used_ones_never(make_desk):
    desk = make_desk()
    begin_hold(desk.record, time.time() - 5)
    (used,) = desk.receive(mr_data_set("1.2.1", began_s=time.time() - 0.6))
    (aside,) = desk.receive(mr_data_set("1.2.2", began_s=time.time() - 500))
    assert (used.state, aside.state) == ("assigned", "quarantined")
    assert remove_old(desk.record, 0.0, time.time() + 1e9) == 0  # 0: keep all
    assert remove_old(desk.record, 100.0, time.time() + 50) == 0
    assert remove_old(desk.record, 100.0, time.time() + 200) == 1
    assert (desk.record.case_dir / used.path).exists()
    assert not (desk.record.case_dir / aside.path).exists()
    assert desk.record.events()[-1].kind == "files_removed"


def test_a_file_on_which_the_codec_aborts_is_set_aside_and_the_next_is_taken(make_desk):
    """The bytes of kept seed 2785: GDCM ends the process that decodes them."""
    desk = make_desk(slices=SliceRules(coronal_tolerance_deg=None))
    source = DICOM / "dicom2nifti/hdr/jpegll.dcm"
    bad, jpeg_lossless = mangled(source.read_bytes(), 2785), "1.2.840.10008.1.2.4.70"
    start = 144 + int.from_bytes(bad[140:144], "little")
    uid = str(dcmread(source).SOPInstanceUID)
    (row,) = desk.receive(bad[start:], jpeg_lossless, sop_instance_uid=uid)
    assert row.reason_code == "undecodable_pixels"
    good = source.read_bytes()
    start = 144 + int.from_bytes(good[140:144], "little")
    rows = desk.receive(good[start:], jpeg_lossless, sop_instance_uid=uid + ".1")
    assert rows[0].reason_code != "undecodable_pixels"


def test_slice_and_folders_are_synced_before_the_inbox_says_that_it_has_them(tmp_path, monkeypatch):
    """By the rules of fsync: the bytes, the slice's name, and the names of the folders above."""
    synced, fsync = [], os.fsync

    def watched(descriptor: int) -> None:
        synced.append(Path(os.readlink(f"/proc/self/fd/{descriptor}")))
        fsync(descriptor)

    monkeypatch.setattr(os, "fsync", watched)
    inbox = Inbox(tmp_path / "cases" / "first" / "inbox")
    assert synced == [tmp_path, tmp_path / "cases", tmp_path / "cases" / "first"]
    body = b"\x08\x00\x05\x00CS\x00\x00"
    path = inbox.store(body, Envelope("A", "B", "::1", 1, 1e9, 1.0, "1", "2", "3", "ab", len(body)))
    assert synced[3:] == [path.with_suffix(".part"), path.parent]


def test_a_file_that_is_not_ours_in_the_inbox_is_an_alarm_and_no_row(make_desk):
    desk = make_desk()
    stray = desk.inbox.folder / "stray.dcm"
    mr_data_set().save_as(stray, enforce_file_format=True)
    with pytest.raises(NotFromInboxError):
        read_envelope(stray)
    desk.intake.take(stray)
    assert desk.record.slices() == []
    assert desk.alarms() == ["foreign_file"]
    assert desk.intake.left_over() == []


def test_a_damaged_envelope_is_told_from_a_whole_one(make_desk):
    desk = make_desk()
    (row,) = desk.receive(mr_data_set())
    path = desk.record.case_dir / row.path
    whole = path.read_bytes()
    path.write_bytes(whole[:150] + b"\xff" * 40 + whole[190:])
    with pytest.raises(NotFromInboxError):
        read_envelope(path)


def test_a_hold_whose_slices_were_given_up_costs_no_extra_scan(make_desk):
    desk = make_desk()
    first = begin_hold(desk.record, time.time() - 20, expected=1)
    desk.record.end_open_hold(time.time() - 10)
    begin_hold(desk.record, time.time() - 9, expected=3, set_id=2)
    (doubted,) = desk.receive(mr_data_set("1.2.1", began_s=time.time() - 0.6))
    assert doubted.reason_code == "may_belong_to_incomplete_hold"
    with CaseRecord(desk.record.case_dir) as service:
        assert give_up_slices(service, first, "anna", "the scan was cancelled") == 1
        event = service.last_event("slices_given_up")
    assert (event.who, event.body["why"]) == ("anna", "the scan was cancelled")
    assert (event.body["expected"], event.body["there"]) == (1, 0)
    assert desk.record.hold(first).expected_slices == 0
    taken = mr_data_set("1.2.2", began_s=time.time() - 0.6)
    taken.AcquisitionNumber = 2
    assert desk.receive(taken)[0].state == "assigned"


def test_without_giving_up_the_hold_costs_one_scan_and_no_more(make_desk):
    desk = make_desk()
    begin_hold(desk.record, time.time() - 20, expected=1)
    desk.record.end_open_hold(time.time() - 10)
    begin_hold(desk.record, time.time() - 9, expected=3, set_id=2)
    codes = []
    for number in (1, 2):
        data_set = mr_data_set(f"1.2.{number}", began_s=time.time() - 0.6)
        data_set.AcquisitionNumber = number
        codes.append(desk.receive(data_set)[0].reason_code)
    assert codes == ["may_belong_to_incomplete_hold", ""]


def test_giving_up_a_complete_hold_changes_nothing(make_desk):
    desk = make_desk()
    hold_id = begin_hold(desk.record, time.time() - 5, expected=1)
    desk.receive(mr_data_set("1.2.1", began_s=time.time() - 0.6))
    assert give_up_slices(desk.record, hold_id, "anna", "") == 0
    assert desk.record.hold(hold_id).expected_slices == 1


def test_a_clock_that_was_set_is_not_known_again_by_a_restart(make_desk):
    """Slices, comparisons and resets are replayed in the order in which they came."""
    desk = make_desk()
    begin_hold(desk.record, time.time() - 60, expected=9)
    assert desk.receive(mr_data_set("1.2.1", began_s=time.time() - 0.6))[0].state == "assigned"
    reset_clock(desk.record, "anna", "it had been set")
    for number, room in enumerate((desk, make_desk()), start=2):
        (row,) = room.receive(mr_data_set(f"1.2.{number}", began_s=time.time() - 0.6))
        assert (row.state, row.reason_code) == ("pending", "clock_unknown")
        assert "before the scanner's clock was set" in row.reason


class RoomDesk(Desk):
    """The listener's side of one case of a room, whose scanner's clock nobody sets."""

    def __init__(self, folder: Path, filed: Comparison | None = None) -> None:
        self.folder, self.record = folder, CaseRecord(folder)
        self.inbox = Inbox(folder / "inbox")
        self.rules = IntakeRules(clock=ClockRules(unseen_steps=False), comparison=filed)
        self.intake = Intake(self.record, self.inbox, self.rules, ListenerMetrics())
        begin_hold(self.record, time.time() - 15)

    def restart(self) -> None:
        self.intake.close()
        self.intake = Intake(self.record, self.inbox, self.rules, ListenerMetrics())
        self.intake.look_at_record()

    def late_slice(self, number: int) -> str:
        """Acquired before the hold, by a clock that is 30 s ahead: why it waits."""
        sent = mr_data_set(f"1.2.1.{number}", began_s=time.time() - 10)
        sent.AcquisitionNumber = number
        (row,) = self.receive(sent)
        assert row.state == "pending", row
        return row.reason

    def contradict(self, **changes) -> None:
        self.receive(mr_data_set("1.2.1", began_s=time.time() + 29.4), **changes)


def test_what_contradicts_a_comparison_counts_in_the_next_case_and_after_a_restart(tmp_path):
    cases = Cases(tmp_path)
    first = RoomDesk(begin(cases, "room", "op", {}))
    sync_clock(first.record, 0.0, 0.2, "op")
    first.intake.look_at_record()
    first.contradict()
    assert "ahead of the comparison" in first.late_slice(2)
    second = RoomDesk(begin(cases, "room", "op", {}))
    assert "ahead of the comparison" in second.late_slice(3)
    second.restart()
    assert "ahead of the comparison" in second.late_slice(4)
    reopen(cases, first.folder.name, "op")
    first.restart()
    assert "ahead of the comparison" in first.late_slice(5)
    sync_clock(first.record, -30.0, 0.2, "op")  # which ends it, in what comes next as well
    third = RoomDesk(begin(cases, "room", "op", {}))
    third.receive(mr_data_set("1.2.9", began_s=time.time() + 29.4))
    assert third.record.last_slice("pending").reason.startswith("it may have been acquired before")


def test_a_clock_that_was_set_in_one_case_was_set_in_the_next(tmp_path):
    cases = Cases(tmp_path)
    filed = Comparison(0.0, 0.2, time.time() - 600)
    first = RoomDesk(begin(cases, "room", "op", {}), filed)
    reset_clock(first.record, "op", "it was set")
    second = RoomDesk(begin(cases, "room", "op", {}), filed)
    assert "before the scanner's clock was set" in second.late_slice(1)
    third = RoomDesk(begin(cases, "room", "op", {}), Comparison(-30.0, 0.2, time.time()))
    assert "before the scanner's clock was set" in third.late_slice(2)


def test_a_slice_that_was_taken_after_a_comparison_contradicts_it_after_a_restart_too(tmp_path):
    desk = RoomDesk(begin(Cases(tmp_path), "room", "op", {}))
    received_s = time.time()
    sync_clock(desk.record, 0.0, 0.2, "op")
    desk.contradict(received_s=received_s - 0.001)
    told = desk.late_slice(2)
    assert "ahead of the comparison" in told
    desk.restart()
    assert desk.late_slice(3) == told
    assert "assigned" not in {row.state for row in desk.record.slices()}
