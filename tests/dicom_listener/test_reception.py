"""Slices go into the case that they belong to; what belongs to no open case waits, and is not lost.

Real files through the real inbox; the cases are begun and ended as the service does it.
"""

import time
from pathlib import Path

import pytest
from made_slices import begin_hold, mr_data_set

from case_record.cases import Cases
from case_record.record import CaseRecord
from dicom_listener.case_gate import recorded_binding
from dicom_listener.inbox import Envelope, Inbox, sha256_of
from dicom_listener.intake import IntakeRules
from dicom_listener.metrics import ListenerMetrics
from dicom_listener.operator_actions import sync_clock
from dicom_listener.reception import Reception
from dicom_listener.taking import TakingError, accept_frame, take_study


class Room:
    """A room with several cases, and a scanner that examines several patients."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.cases = Cases(folder / "cases")
        self.inbox = Inbox(self.cases.home / "inbox")
        self.sent = 0
        self.records: list[CaseRecord] = []
        self.start()

    def start(self) -> None:
        self.reception = Reception(self.cases, self.inbox, IntakeRules(), ListenerMetrics())
        self.turn()

    def stop(self) -> None:
        self.reception.close()

    def turn(self) -> None:
        self.reception.follow()
        for path in self.reception.left_over():
            self.reception.take(path)
        self.reception.turn()

    def begin(self, settled_s_ago: float = 5.0) -> CaseRecord:
        folder = self.cases.make_folder()
        record = CaseRecord(folder, create=True)
        self.records.append(record)
        record.start_case("room", 0)
        sync_clock(record, 0.0, 0.05, "tester")
        begin_hold(record, time.time() - settled_s_ago, expected=100)
        self.cases.set_open(folder)
        self.turn()
        return record

    def finish(self) -> None:
        self.cases.set_open(None)
        self.turn()

    def store(self, patient: str, **changes) -> Path:
        """A slice of a patient, received now and not looked at yet."""
        self.sent += 1
        number = sum(map(ord, patient))
        data_set = mr_data_set(f"1.2.826.0.{number}.{self.sent}", began_s=time.time() - 0.6)
        data_set.PatientID, data_set.PatientName = f"ID-{patient}", f"Name^{patient}"
        data_set.StudyInstanceUID = f"1.2.826.1.{number}"
        data_set.FrameOfReferenceUID = f"1.2.826.2.{number}"
        data_set.AcquisitionNumber = self.sent
        for name, value in changes.items():
            setattr(data_set, name, value)
        body = encoded(self.folder, data_set)
        return self.inbox.store(body, envelope_of(body, str(data_set.SOPInstanceUID)))

    def send(self, patient: str, **changes) -> None:
        self.reception.take(self.store(patient, **changes))
        self.reception.turn()

    @property
    def held(self):
        return self.reception._area.holding

    def why_held(self) -> list[str]:
        return [one.code for one in self.held.all()]


def encoded(folder: Path, data_set) -> bytes:
    path = folder / "encoded.dcm"
    data_set.save_as(path, enforce_file_format=True)
    whole = path.read_bytes()
    return whole[144 + int.from_bytes(whole[140:144], "little") :]


def envelope_of(body: bytes, uid: str) -> Envelope:
    return Envelope(
        calling_ae_title="SCANNER",
        called_ae_title="AUTOSPINE",
        peer_address="127.0.0.1",
        peer_port=104,
        received_s=time.time(),
        received_monotonic_s=time.monotonic(),
        transfer_syntax_uid="1.2.840.10008.1.2.1",
        sop_class_uid="1.2.840.10008.5.1.4.1.1.4",
        sop_instance_uid=uid,
        sha256=sha256_of(body),
        size_bytes=len(body),
    )


@pytest.fixture
def room(tmp_path):
    running = Room(tmp_path)
    yield running
    running.stop()
    for record in running.records:
        record.close()


def states(record: CaseRecord) -> list[str]:
    return [row.state for row in record.slices()]


def says(folder: Path, patient: str) -> list[str]:
    """The files below a folder that say anything of a patient."""
    number = sum(map(ord, patient))
    words = [f"ID-{patient}", f"Name^{patient}", f"1.2.826.1.{number}", f"1.2.826.0.{number}."]
    return [
        str(path.relative_to(folder))
        for path in folder.rglob("*")
        if path.is_file() and any(word.encode() in path.read_bytes() for word in words)
    ]


def test_a_slice_with_no_case_open_waits_and_says_why(room):
    room.send("anna")
    assert room.why_held() == ["no_case_open"]
    (study,) = room.held.studies()
    assert study.slices == 1
    assert study.study
    assert not list((room.cases.home / "inbox").glob("*"))


def test_the_first_used_slice_binds_the_case_and_others_stay_out(room):
    record = room.begin()
    room.send("anna")
    assert states(record) == ["assigned"]
    assert recorded_binding(record) is not None
    room.send("berta")
    room.send("anna")
    room.send("berta", StudyInstanceUID="1.2.826.1.1")
    room.send("anna", StudyInstanceUID="1.2.826.1.2")
    assert states(record) == ["assigned", "assigned"]
    assert room.why_held() == ["other_patient", "other_patient", "other_study"]
    assert [e.body["code"] for e in record.events_of_kind("slice_held")] == room.why_held()
    assert says(record.case_dir, "berta") == []


def test_nothing_of_another_patient_gets_in_before_the_case_is_bound_either(room):
    record = room.begin()
    room.send("berta", ImageOrientationPatient=[1, 0, 0, 0, 1, 0])  # axial: never used
    assert states(record) == []
    assert room.why_held() == ["no_slice_used_yet"]
    assert "no slice of this case has been used yet" in room.held.all()[0].reason
    room.send("anna", ImageOrientationPatient=[1, 0, 0, 0, 1, 0])
    room.send("anna")
    # what waited of her comes after, what waited of the other one stays where it is
    assert sorted(states(record)) == ["assigned", "quarantined"]
    assert room.why_held() == ["no_slice_used_yet"]
    assert says(record.case_dir, "berta") == []


def test_five_patients_in_a_row_with_late_slices_of_the_one_before(room):
    names = ["anna", "berta", "carla", "dora", "emma"]
    records = []
    for number, name in enumerate(names):
        records.append(room.begin())
        if number:
            room.send(names[number - 1])  # pushed late by the scanner
            assert room.why_held()[-1] == "other_case"
        for _ in range(3):
            room.send(name)
        if number:
            room.send(names[number - 1])
            assert records[-1].last_event("slice_held").body["same_patient"] is False
        room.finish()
        room.send(name)
        assert room.why_held()[-1] == "no_case_open"
    for record, name in zip(records, names, strict=True):
        assert states(record) == ["assigned"] * 3
        record.verify_events()
        assert says(record.case_dir, name)
        assert [other for other in names if other != name and says(record.case_dir, other)] == []


def test_an_earlier_study_of_the_same_patient_is_said_to_be_of_the_same(room):
    room.begin()
    room.send("anna")
    room.finish()
    record = room.begin()
    room.send("anna", StudyInstanceUID="1.2.826.1.2")
    room.send("anna")
    assert room.why_held()[-1] == "other_case"
    assert record.last_event("slice_held").body["same_patient"] is True


def test_two_patients_whose_slices_come_interleaved(room):
    record = room.begin()
    for name in ("anna", "berta") * 10:
        room.send(name)
    assert states(record) == ["assigned"] * 10
    assert room.why_held() == ["other_patient"] * 10
    assert says(record.case_dir, "berta") == []


def test_slices_that_came_before_the_case_are_taken_into_it_by_a_person(room):
    room.send("anna")
    room.send("anna")
    room.send("berta")
    record = room.begin(settled_s_ago=0)
    study = next(one.study for one in room.held.studies() if one.slices == 2)
    take_study(record, room.cases.home, study, "Olga")
    room.turn()
    # they were received before any hold of the case: here, and not used
    assert states(record) == ["quarantined", "quarantined"]
    assert [one.slices for one in room.held.studies()] == [1]
    assert record.last_event("case_bound").who == "Olga"


def test_a_study_that_was_split_in_two_goes_on_when_a_person_says_so(room):
    record = room.begin()
    room.send("anna")
    room.send("anna", StudyInstanceUID="1.2.826.1.9", FrameOfReferenceUID="1.2.826.2.9")
    assert room.why_held() == ["other_study"]
    take_study(record, room.cases.home, "1.2.826.1.9", "Olga")
    room.turn()
    assert room.why_held() == []
    room.send("anna", StudyInstanceUID="1.2.826.1.9", FrameOfReferenceUID="1.2.826.2.9")
    assert states(record)[-1] == "assigned"
    room.send("anna")  # of before the table was moved
    assert states(record)[-1] == "quarantined"
    assert record.last_slice().reason_code == "other_frame_of_reference"


def test_the_study_of_another_patient_is_never_taken_in(room):
    record = room.begin()
    room.send("anna")
    room.send("berta")
    (study,) = room.held.studies()
    with pytest.raises(TakingError, match="a different patient"):
        take_study(record, room.cases.home, study.study, "Olga")
    with pytest.raises(TakingError, match="no slices of study"):
        take_study(record, room.cases.home, "1.2.3.4", "Olga")


def test_a_new_frame_of_reference_counts_when_a_person_says_so(room):
    record = room.begin()
    room.send("anna")
    with pytest.raises(TakingError, match="No slice"):
        accept_frame(record, "Olga")
    room.send("anna", FrameOfReferenceUID="1.2.826.2.9")
    assert record.last_slice().reason_code == "other_frame_of_reference"
    accept_frame(record, "Olga")
    room.turn()
    room.send("anna", FrameOfReferenceUID="1.2.826.2.9")
    assert record.last_slice().state == "assigned"


def test_what_cannot_be_read_is_nobodys(room):
    record = room.begin()
    room.send("anna")
    junk = b"\x08\x00\x05\x00" + b"no DICOM" * 40
    room.reception.take(room.inbox.store(junk, envelope_of(junk, "1.2.3")))
    assert states(record) == ["assigned"]
    assert room.why_held() == ["unknown_study"]


def test_sent_again_it_waits_once(room):
    path = room.store("anna")
    body = path.read_bytes()
    room.reception.take(path)
    again = path.with_name("9" + path.name[1:])
    again.write_bytes(body)
    room.reception.take(again)
    assert len(room.held.all()) == 1
    assert len(list(room.held.folder.glob("*.dcm"))) == 1
    record = room.begin()
    take_study(record, room.cases.home, room.held.studies()[0].study, "Olga")
    room.turn()
    again.write_bytes(body)
    room.reception.take(again)
    assert len(record.slices()) == 1
    assert not again.exists()


@pytest.mark.parametrize("where", ["received", "moved into the case", "moved into holding"])
def test_a_crash_between_two_steps_loses_nothing(room, where):
    record = room.begin()
    room.send("anna")
    path = room.store("berta" if where == "moved into holding" else "anna")
    room.stop()
    folder = {
        "received": path.parent,
        "moved into the case": record.case_dir / "inbox",
        "moved into holding": room.cases.home / "holding",
    }[where]
    path.rename(folder / path.name)
    room.start()
    if where == "moved into holding":
        assert room.why_held() == ["no_case_open"]
        assert room.held.all()[0].study
    else:
        assert states(record) == ["assigned", "assigned"]
        assert len(list((record.case_dir / "inbox").glob("*.dcm"))) == 2


def test_a_file_left_unrecorded_in_a_case_that_was_finished_meanwhile_is_found(room):
    record = room.begin()
    room.send("anna")
    path = room.store("anna")
    room.stop()
    path.rename(record.case_dir / "inbox" / path.name)
    room.cases.set_open(None)
    room.start()
    assert len(record.slices()) == 1
    assert [one.slices for one in room.held.studies()] == [1]


def test_a_case_that_cannot_be_read_takes_nothing_and_nothing_is_lost(room):
    folder = room.cases.make_folder()
    (folder / "case.sqlite").write_bytes(b"no database, not at all" * 100)
    room.cases.set_open(folder)
    room.turn()
    room.send("anna")
    assert room.why_held() == ["no_case_open"]
    record = room.begin()
    room.send("berta")
    assert states(record) == ["assigned"]


def test_a_case_goes_on_where_the_listener_was_started_again(room):
    record = room.begin()
    room.send("anna")
    room.stop()
    room.start()
    room.send("berta")
    room.send("anna")
    assert states(record) == ["assigned", "assigned"]
    assert room.why_held() == ["other_patient"]


def test_whose_study_it_is_is_learnt_from_the_cases_where_nobody_kept_it(room):
    room.begin()
    room.send("anna")
    room.finish()
    room.stop()
    for path in room.held.folder.glob("holding.sqlite*"):
        path.unlink()
    room.start()
    record = room.begin()
    room.send("anna")
    assert states(record) == []
    assert room.why_held() == ["other_case"]


def test_a_first_hold_that_missed_its_slice_does_not_hold_up_the_case(room):
    """What was set aside there is known to the decisions to come, though no slice was used yet."""
    record = room.begin(settled_s_ago=0)
    room.send("anna")  # acquired before the hold had settled
    record.expect_slices(1, 1)
    time.sleep(0.01)
    record.end_open_hold(time.time())
    begin_hold(record, time.time() - 2, expected=100)
    for _ in range(3):
        room.send("anna")
    assert room.why_held() == []
    assert states(record)[-1] == "assigned"


def test_a_study_is_asked_for_where_nothing_was_ever_held(room, tmp_path):
    record = room.begin()
    with pytest.raises(TakingError, match="nothing was ever held"):
        take_study(record, tmp_path / "elsewhere", "1.2.3.4", "Olga")
