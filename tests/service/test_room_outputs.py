"""A whole virtual room with an archive and a planning workstation: what they get of a puncture."""

import io
from pathlib import Path

import httpx
import pydicom
import pytest
from attended_room import AttendedRoom, calibrated, running_room, wait_for
from pynetdicom.dsutils import decode
from receivers import ARCHIVE, receiving, wait_until

from dicom_slice.plan import SPATIAL_FIDUCIALS
from service.client import RoomClient
from service.room.state import RoomState

_PATIENCE_S = 120.0


def test_a_puncture_is_reported_to_the_archive_and_the_plan_goes_to_the_workstation(
    tmp_path: Path,
) -> None:
    with receiving() as archive, receiving(sop_classes=(SPATIAL_FIDUCIALS,)) as workstation:
        table = f"""
[[outputs.destination]]
name = "archive"
host = "127.0.0.1"
port = {archive.port}
ae_title = "{ARCHIVE}"

[[outputs.destination]]
name = "workstation"
host = "127.0.0.1"
port = {workstation.port}
ae_title = "{ARCHIVE}"
kinds = ["plan"]
"""
        with running_room(tmp_path, table) as room, RoomClient(room.url) as client:
            ready = brought_to_ready(room, client)
            client.record_puncture()
            outbox = f"{room.url}/api/v1/outbox"
            wait_until(lambda: {one["kind"] for one in sent(outbox)} >= {"report", "presentation"})
            wait_until(lambda: any("puncture" in one["name"] for one in sent(outbox)))
            wait_until(lambda: bool(workstation.received))
            uids = {
                one["sop_instance_uid"] for one in sent(outbox) if one["destination"] == "archive"
            }
            report = httpx.get(
                f"{room.url}/api/v1/approaches/{ready.arrival.procedure_id}/report.dcm"
            ).content
    assert set(archive.uids) >= uids
    shown = pydicom.dcmread(io.BytesIO(report))
    assert shown.Modality == "SR"
    assert str(shown.SOPInstanceUID) in uids
    assert not set(workstation.uids) & set(archive.uids)
    plan = decode(io.BytesIO(workstation.received[-1][1]), False, True)
    (target,) = plan.FiducialSetSequence[0].FiducialSequence
    assert target.FiducialIdentifier == "TARGET"
    assert ready.target_patient_mm is not None
    assert list(target.ContourData) == pytest.approx(ready.target_patient_mm, abs=1e-6)


def sent(outbox: str) -> list[dict[str, str]]:
    found = httpx.get(outbox).json()["deliveries"]
    return [one for one in found if one["state"] == "sent"]


def brought_to_ready(room: AttendedRoom, client: RoomClient) -> RoomState:
    """Two millimetres beside where it is; every move confirmed."""
    at = calibrated(client).measurement
    assert at is not None
    assert at.patient_mm is not None
    x, y, z = at.patient_mm
    client.set_target((x + 2.0, y, z - 1.5))
    client.start_approach()
    while True:
        state = wait_for(client.state, lambda s: s.question is not None or s.ready, _PATIENCE_S)
        if state.ready:
            return state
        question = state.question
        assert question is not None
        assert question.plan is not None
        client.answer(question.question_id, "confirm", plan_id=question.plan["plan_id"])
        wait_for(
            client.state,
            lambda s, asked=question: s.question is None or s.question != asked,
            _PATIENCE_S,
        )
