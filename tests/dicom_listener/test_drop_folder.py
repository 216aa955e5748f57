"""Slices by a shared folder: the same inbox and the same proofs as what comes by C-STORE."""

import errno
import os
import time
from pathlib import Path

import pytest
from listener_room import COMPARED, listening, wait_for, write_room
from made_slices import begin_hold, mr_data_set
from pydicom import dcmread
from pydicom.uid import RLELossless
from test_listener_process import alarms, send

from case_record.record import CaseRecord
from dicom_listener.inbox import Inbox, read_envelope
from dicom_listener.network.drop_folder import DropFolder, NotWholeError, whole_file


def file_bytes(folder: Path, uid: str, began_s: float | None = None) -> bytes:
    path = folder / "made.bytes"
    mr_data_set(uid, began_s=began_s).save_as(path, enforce_file_format=True)
    return path.read_bytes()


class Watching:
    """A drop folder that is looked at when the test says so."""

    def __init__(self, folder: Path) -> None:
        self.share = folder / "share"
        self.share.mkdir(exist_ok=True)
        self.inbox = Inbox(folder / "inbox")
        self.stored: list[Path] = []
        self.drop_folder = DropFolder(
            self.share, folder / "taken", self.inbox, self.stored.append,
            still_s=0.0, unfinished_alarm_s=0.1,
        )  # fmt: skip

    def look(self, times: int = 2) -> None:
        for _ in range(times):
            self.drop_folder.look()

    @property
    def kinds(self) -> list[str]:
        return [kind for kind, _ in self.drop_folder.alarms]


@pytest.fixture
def watching(tmp_path):
    return Watching(tmp_path)


def test_a_whole_file_is_taken_once_with_the_instant_at_which_it_was_first_seen(tmp_path, watching):
    before_s = time.time()
    (watching.share / "sub").mkdir()
    raw = file_bytes(tmp_path, "1.2.3")
    (watching.share / "sub" / "a.dcm").write_bytes(raw)
    watching.look(1)
    seen_s = time.time()
    watching.look(3)
    (path,) = watching.stored
    envelope, start = read_envelope(path)
    assert before_s <= envelope.received_s <= seen_s
    assert (envelope.calling_ae_title, envelope.sop_instance_uid) == ("watch_dir", "1.2.3")
    assert path.read_bytes()[start:] == whole_file(raw)[1]
    again = Watching(tmp_path)  # after a restart
    again.look(3)
    assert again.stored == []


def test_only_a_file_that_appears_while_the_folder_is_watched_is_fresh(tmp_path, watching):
    def freshness(name: str, changed_s: float | None = None) -> bool:
        path = watching.share / name
        path.write_bytes(file_bytes(tmp_path, f"1.2.{name}"))
        if changed_s is not None:
            os.utime(path, (changed_s, changed_s))
        watching.look()
        return read_envelope(watching.stored[-1])[0].is_fresh

    assert not freshness("1")  # it lay there at the start
    assert freshness("2")
    assert not freshness("3", time.time() - 3600)
    away = watching.share.rename(tmp_path / "away")
    watching.look(1)
    (away / "4").write_bytes(file_bytes(tmp_path, "1.2.4"))
    watching.drop_folder._looked_s -= 60  # that the share was gone for
    away.rename(watching.share)
    watching.look()
    assert not read_envelope(watching.stored[-1])[0].is_fresh
    assert len(watching.stored) == 4


def test_a_file_that_cannot_be_read_yet_is_taken_once_it_can(tmp_path, watching, monkeypatch):
    (watching.share / "a.dcm").write_bytes(file_bytes(tmp_path, "1.2.3"))
    plain = os.open

    def locked(path, *rest, **more):
        if Path(path).name == "a.dcm":
            raise PermissionError(errno.EACCES, "Permission denied")
        return plain(path, *rest, **more)

    with monkeypatch.context() as lock:  # root may read what is locked: as a share would refuse it
        lock.setattr(os, "open", locked)
        watching.look(5)
    assert watching.kinds == ["watch_dir_refused"]  # once
    watching.look(1)
    assert len(watching.stored) == 1


def test_links_to_nowhere_and_pipes_keep_nothing_from_being_taken(tmp_path, watching):
    (watching.share / "loop").symlink_to("loop")
    (watching.share / "dangling").symlink_to("nothing")
    os.mkfifo(watching.share / "pipe")
    (watching.share / "a.dcm").write_bytes(file_bytes(tmp_path, "1.2.3"))
    watching.look(3)
    assert len(watching.stored) == 1
    assert watching.kinds == []


def test_a_file_that_is_being_written_is_taken_when_it_is_whole(tmp_path, watching):
    raw = file_bytes(tmp_path, "1.2.3")
    path = watching.share / "a.dcm"
    for size in (10, 200, len(raw) - 100, len(raw) - 2):
        path.write_bytes(raw[:size])
        watching.look(1)
        assert watching.stored == []
    path.write_bytes(raw)
    watching.look()
    assert len(watching.stored) == 1
    assert watching.kinds == []


@pytest.mark.parametrize("cut", [0, 50, 140, 400, 0.5, -1])
def test_a_file_cut_off_anywhere_is_not_whole(tmp_path, cut):
    raw = file_bytes(tmp_path, "1.2.3")
    size = round(cut * len(raw)) if isinstance(cut, float) else cut
    with pytest.raises(NotWholeError):
        whole_file(raw[:size])


def test_a_file_that_stays_unfinished_is_one_alarm_and_taken_if_it_is_finished_after_all(
    tmp_path, watching
):
    raw = file_bytes(tmp_path, "1.2.3")
    path = watching.share / "a.dcm"
    path.write_bytes(raw[:-100])
    watching.look()
    time.sleep(0.15)
    watching.look(3)
    assert watching.kinds == ["watch_dir_refused"]
    assert "incomplete for" in watching.drop_folder.alarms[0][1]
    path.write_bytes(raw)
    watching.look()
    assert len(watching.stored) == 1


def test_a_share_that_disappears_is_one_alarm_and_is_used_again_when_it_is_back(tmp_path, watching):
    away = watching.share.rename(tmp_path / "away")
    watching.look(3)
    assert watching.kinds == ["watch_dir_gone"]
    (away / "a.dcm").write_bytes(file_bytes(tmp_path, "1.2.3"))
    away.rename(watching.share)
    watching.look()
    assert len(watching.stored) == 1


def test_what_programs_call_unfinished_is_left_alone(tmp_path, watching):
    raw = file_bytes(tmp_path, "1.2.3")
    for name in (".hidden.dcm", "a.part", "b.TMP"):
        (watching.share / name).write_bytes(raw)
    watching.look(3)
    assert watching.stored == []
    os.rename(watching.share / "a.part", watching.share / "a.dcm")
    watching.look()
    assert len(watching.stored) == 1


def test_slices_by_folder_and_by_c_store_are_one_and_have_the_same_proofs(tmp_path):
    share = tmp_path / "share"
    share.mkdir()
    config = write_room(tmp_path, watch_dir="share", **COMPARED)
    with CaseRecord(tmp_path / "case", create=True) as record, listening(config) as listener:
        hold_id = begin_hold(record, time.time() - 5.0, expected=9)
        began_s = time.time() - 0.6
        (share / "a.dcm").write_bytes(file_bytes(tmp_path, "1.2.3", began_s))
        wait_for(lambda: record.slices())
        (row,) = record.slices()
        assert (row.state, row.hold_id) == ("assigned", hold_id)
        assert row.header["envelope"]["calling_ae_title"] == "watch_dir"
        early = file_bytes(tmp_path, "1.2.4", time.time() - 30.0)
        (share / "b.dcm").write_bytes(early)
        wait_for(lambda: len(record.slices()) == 2)
        assert record.slices()[1].state == "quarantined"
        send(listener.port, mr_data_set("1.2.3", began_s=began_s))
        wait_for(lambda: record.events_of_kind("duplicate_slice"))
        compressed = mr_data_set("1.2.3", began_s=began_s)
        compressed.compress(RLELossless, generate_instance_uid=False)
        compressed.save_as(tmp_path / "compressed.dcm", enforce_file_format=True)
        send(listener.port, dcmread(tmp_path / "compressed.dcm"))
        wait_for(lambda: len(record.slices()) == 3)
        assert record.slices()[2].reason_code == "same_slice_other_encoding"
        assert [row.state for row in record.slices()] == ["assigned", "quarantined", "quarantined"]
        assert alarms(record) == []
