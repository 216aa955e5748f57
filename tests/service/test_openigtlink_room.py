"""Planning stations at a running room: they see what is true and may plan; they move nothing."""

from __future__ import annotations

import random
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from attended_room import AttendedRoom, arm, calibrated, running_room, stop_all, tidied, wait_for
from browser import set_theme, violations
from lone_service import CONFIG, ready_service
from openigtlink_station import OwnStation, Station, station
from page_states import SIZES, layout_faults
from playwright.sync_api import expect
from pydicom.dataset import Dataset, FileDataset, FileMetaDataset
from pydicom.uid import ExplicitVRLittleEndian, generate_uid
from pynetdicom import AE
from pynetdicom.sop_class import SpatialFiducialsStorage
from station_screen import assert_shows_what_the_page_shows, beside, ras, shown_points

from case_record.record import CaseRecord
from service.client import RefusedByServiceError, RoomClient
from service.room.proposals import ProposalState
from service.room.state import RoomState
from service.slicer.messages import HEADER, TO_RAS, Message, Point, points

TABLE = "\n[openigtlink]\nport = 0\ninwards = true\n"
KINDS = ["own", "official"]


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Iterator[AttendedRoom]:
    with running_room(tmp_path_factory.mktemp("planned"), TABLE) as running:
        yield running


@pytest.fixture(scope="module")
def port(room: AttendedRoom) -> int:
    return int(room.family.children["service"].ready["openigtlink"].rpartition(":")[2])


def open_proposals(client: RoomClient) -> list[ProposalState]:
    return [one for one in client.state().proposals if one.state == "open"]


def refuse_all(client: RoomClient) -> None:
    """Whatever the tests before have proposed: no more than eight may wait."""
    for one in open_proposals(client):
        client.refuse_proposal(one.number)


def target_status(message: Any) -> bool:
    return message["kind"] == "STATUS" and message["device"] == "TARGET"


@pytest.mark.parametrize("kind", KINDS)
def test_a_planning_station_plans_watches_and_stops(room, port, kind):
    with RoomClient(room.url, by="Olga") as client, station(kind, port) as screen:
        calibrated(client)
        state = client.state()
        before = state.target_patient_mm
        target, entry = beside(state, 3.0), beside(state, 3.5)
        since = screen.mark()
        screen.say("point", "Plan", "ENTRY", ras(entry), "TARGET", ras(target))
        assert screen.wait_for(target_status, since)["code"] == 1
        screen.wait_for(lambda m: m["device"] == "REACHABLE_TARGET", since)
        one = [p for p in client.state().proposals if p.state == "open"][-1]
        assert client.state().target_patient_mm == before, "nothing changes by itself"

        since = screen.mark()
        client.take_proposal(one.number, in_water=False, label="L4")
        told = screen.wait_for(lambda m: target_status(m) and m["name"] == "taken", since)
        assert "Olga" in told["text"]
        assert_shows_what_the_page_shows(screen, client)
        assert shown_points(screen, "Targets")["target"] == pytest.approx(target, abs=1e-3)

        client.start_approach()
        wait_for(client.state, lambda s: s.question is not None, 120.0)
        screen.wait_for(lambda m: m["device"] == "AutoSPINe" and m["name"] == "approach")
        since = screen.mark()
        screen.say("string", "CMD_0007", "STOP")
        assert screen.wait_for(lambda m: m["device"] == "ACK_0007", since)["text"] == "STOP"
        told = screen.wait_for(lambda m: m["kind"] == "STATUS" and m["device"] == "STOP", since)
        assert told["code"] == 13
        stopped = wait_for(client.state, lambda s: s.procedure is None)
        assert stopped.robot.stopped
        assert_shows_what_the_page_shows(screen, client)

        arm(client)
        client.withdraw_target()
        assert_shows_what_the_page_shows(screen, client)
        assert "target" not in shown_points(screen, "Targets")


@pytest.mark.parametrize("kind", KINDS)
def test_what_the_robot_has_left_is_not_shown_any_more(room, port, kind):
    with RoomClient(room.url, by="Olga") as client, station(kind, port) as screen:
        if calibrated(client).measurement.lost is not None:  # by a STOP of the test before
            client.start_calibration()
            wait_for(client.state, lambda s: s.procedure is not None)
            wait_for(client.state, lambda s: s.procedure is None, 120.0)
        client.jog("xt", 500)
        wait_for(client.state, lambda s: s.procedure is None)
        assert_shows_what_the_page_shows(screen, client)
        moved = screen.wait_for(
            lambda m: m["device"] == "CURRENT_POSITION" and m["meta"].get("PoseSource")
        )
        assert moved["meta"]["Origin"] == "fiducial"
        client.start_calibration()
        wait_for(client.state, lambda s: s.robot.moving)
        screen.say("string", "CMD_8", "EMERGENCY")
        wait_for(client.state, lambda s: s.robot.phase == "EMERGENCY")
        screen.wait_for(lambda m: m["device"] == "AutoSPINe" and m["code"] == 3, screen.mark())
        stop_all(client)


@pytest.mark.parametrize("kind", KINDS)
def test_a_refusal_is_told_with_its_reason(room, port, kind):
    with RoomClient(room.url, by="Olga") as client, station(kind, port) as screen:
        calibrated(client)
        target = beside(client.state(), 2.0)
        screen.say("transform", "TGT_9", *_pose(target))
        screen.wait_for(lambda m: target_status(m) and m["code"] == 1)
        one = [p for p in client.state().proposals if p.state == "open"][-1]
        client.refuse_proposal(one.number, "a vessel is in the way")
        told = screen.wait_for(lambda m: target_status(m) and m["code"] == 5)
        assert "refused by Olga: a vessel is in the way" in told["text"]
        with pytest.raises(RefusedByServiceError, match="not open"):
            client.take_proposal(one.number, in_water=True)


def test_out_of_reach_is_said_and_not_shown_to_the_operator(room, port):
    with RoomClient(room.url, by="Olga") as client, station("own", port) as screen:
        calibrated(client)
        known = len(client.state().proposals)
        for far_mm in (80.0, 5000.0):
            since = screen.mark()
            screen.say("transform", "TGT_far", *_pose(beside(client.state(), far_mm)))
            told = screen.wait_for(target_status, since)
            assert (told["code"], told["subcode"]) == (10, 3)
        assert len(client.state().proposals) == known


def test_a_plan_in_another_frame_of_reference_is_refused(room, port):
    with RoomClient(room.url, by="Olga") as client, station("own", port) as screen:
        calibrated(client)
        assert isinstance(screen, OwnStation)
        other = Message("POINT", "Plan", 1.0, b"", {})
        named = points("Plan", 1.0, [Point("TARGET", beside(client.state(), 1.0))])
        other = Message("POINT", "Plan", 1.0, named.content, {"FrameOfReferenceUID": "1.2.3"})
        screen.send(other.encoded())
        told = screen.wait_for(target_status)
        assert (told["code"], told["subcode"]) == (10, 1)
        assert "frame of reference" in told["text"]


def test_two_stations_that_propose_at_once_are_both_seen_and_told_apart(room, port):
    with (
        RoomClient(room.url, by="Olga") as client,
        station("own", port) as one,
        station("own", port) as other,
    ):
        calibrated(client)
        here = client.state()
        one.say("transform", "TGT_1", *_pose(beside(here, 1.0)))
        other.say("transform", "TGT_1", *_pose(beside(here, 2.0)))
        for screen in (one, other):
            screen.wait_for(target_status)
        waiting = open_proposals(client)
        assert len({p.sender for p in waiting}) == 2
        for proposal in waiting:
            client.refuse_proposal(proposal.number)


def _pose(place: tuple[float, float, float]) -> list[str]:
    """Rows of the matrix, RAS: at the place, patient axes."""
    x, y, z = ras(place).split()
    return ["1", "0", "0", x, "0", "1", "0", y, "0", "0", "1", z]


# Every message of the table in every phase

Say = Callable[[Station, str], None]


def _messages(state: RoomState, number: int) -> dict[str, list[object]]:
    """All of the table but STOP: what is said, by the device name of its last answer."""
    target = beside(state, 1.5)
    pose = _pose(target)
    bad = [*pose[:3], "nan", *pose[4:]]
    left = [*pose[:10], "-1", pose[11]]
    phases = ("START_UP", "PLANNING", "CALIBRATION", "TARGETING", "MOVE_TO_TARGET")
    said: dict[str, list[object]] = {
        f"phase {word}": ["string", f"CMD_{number}{at}", word] for at, word in enumerate(phases)
    }
    for word in ("RETRACT_NEEDLE", "HOME", "INIT", "MANUAL", "ARM", "RESET", "CONFIRM", "JOG"):
        said[word] = ["string", f"CMD_{number}", word]
    return said | {
        "status": ["string", "CURRENT_STATUS", "x"],
        "get status": ["string", "GET_STATUS", "x"],
        "pose": ["string", "CURRENT_POSITION", "x"],
        "get pose": ["string", "GET_TRANSFORM", "x"],
        "target": ["transform", f"TGT_{number}", *pose],
        "target NaN": ["transform", f"TGT_{number}", *bad],
        "target left-handed": ["transform", f"TGT_{number}", *left],
        "points": ["point", "F", "TARGET", ras(target)],
        "registration": ["transform", f"CLB_{number}", *pose],
        "tip": ["transform", f"NPOS_{number}", *pose],
    }


def _say_everything(screen: Station, state: RoomState, number: int, order: random.Random) -> None:
    said = list(_messages(state, number).items())
    order.shuffle(said)
    for name, words in said:
        since = screen.mark()
        screen.say(*words)
        for wanted in _answers(name, words):
            try:
                screen.wait_for(wanted, since)
            except AssertionError as error:
                raise AssertionError(f"{name}, {words}: {error}") from None


def _answers(name: str, words: list[object]) -> list[Callable[[Any], bool]]:
    """What the table promises, whatever the room is at."""
    device, text = str(words[1]), str(words[-1])
    ack = f"ACK_{device.partition('_')[2]}"

    def status(about: str, *codes: int) -> Callable[[Any], bool]:
        return lambda m: (m["kind"], m["device"]) == ("STATUS", about) and m["code"] in codes

    if name.startswith("phase"):
        codes = (5,) if text == "MOVE_TO_TARGET" else (1, 13)
        return [lambda m: m["device"] == ack and m["text"] == text, status(text, *codes)]
    if name in ("status", "get status"):
        return [lambda m: m["kind"] == "STATUS" and m["device"] != "AutoSPINe"]
    if name in ("pose", "get pose"):
        return [
            lambda m: (
                m["device"] in ("HAS_REACHED_TARGET",)
                or status(device, 13)(m)
                or status("CURRENT_POSITION", 13)(m)
            )
        ]
    if name == "target":
        return [lambda m: m["device"] == ack, status("TARGET", 1)]
    if name.startswith("target"):
        return [lambda m: m["device"] == ack, status("TARGET", 10)]
    if name == "points":
        return [status("TARGET", 1)]
    if name in ("registration", "tip"):
        return [lambda m: m["device"] == ack]
    return [status(text, 12)]


@pytest.mark.parametrize(
    "seed", [7, *(pytest.param(seed, marks=pytest.mark.soak) for seed in range(100, 130))]
)
def test_every_message_in_every_phase_changes_nothing_without_the_operator(room, port, seed):
    order = random.Random(seed)
    with RoomClient(room.url, by="Olga") as client, station("own", port) as screen:
        tidied(client)
        refuse_all(client)
        stop_all(client)
        state = calibrated(client)
        client.set_target(beside(state, 4.0))
        seen: set[str] = set()

        def everything(number: int) -> None:
            before = client.state()
            seen.add(before.robot.phase)
            _say_everything(screen, before, number, order)
            after = client.state()
            assert after.target_patient_mm == before.target_patient_mm
            assert after.entry_patient_mm == before.entry_patient_mm

        everything(1)
        client.jog("xt", 200)
        wait_for(client.state, lambda s: s.procedure is None)
        everything(2)
        client.start_calibration()
        wait_for(client.state, lambda s: s.robot.phase == "CALIBRATION")
        everything(3)
        wait_for(client.state, lambda s: s.procedure is None, 120.0)
        client.set_target(beside(client.state(), 4.0))
        client.start_approach()
        asked = wait_for(client.state, lambda s: s.question is not None, 120.0).question
        everything(4)
        assert client.state().question == asked, "the question waits for the operator"
        positions = client.state().robot.positions_um
        everything(5)
        assert client.state().robot.positions_um == positions
        client.answer(asked.question_id, "confirm", asked.plan["plan_id"])
        wait_for(client.state, lambda s: s.robot.phase == "MOVE_TO_TARGET")
        everything(6)
        wait_for(client.state, lambda s: s.procedure is None or s.question is not None, 120.0)
        client.stop()
        wait_for(client.state, lambda s: s.robot.stopped and s.procedure is None)
        everything(7)
        client.stop(emergency=True)
        wait_for(client.state, lambda s: s.robot.phase == "EMERGENCY")
        everything(8)
        # PLANNING and TARGETING are passed through, not stood in, and START_UP is over with the
        # first move of the room: the pure table has them too
        wanted = {"CALIBRATION", "MOVE_TO_TARGET", "MANUAL", "STOP", "EMERGENCY"}
        assert wanted <= seen
        stop_all(client)
    with CaseRecord(room.folder) as record:
        by_peers = {e.kind for e in record.events() if e.who.startswith("OpenIGTLink")}
    kept = {"plan_proposed", "proposal_turned_away", "registration_received"}
    assert by_peers <= kept | {"stop", "emergency"}


def spatial_fiducials(study: str, frame: str, place: tuple[float, float, float]) -> FileDataset:
    """What a workstation sends: one point, labelled TARGET."""
    meta = FileMetaDataset()
    meta.MediaStorageSOPClassUID = SpatialFiducialsStorage
    meta.MediaStorageSOPInstanceUID = generate_uid()
    meta.TransferSyntaxUID = ExplicitVRLittleEndian
    made = FileDataset("", {}, file_meta=meta, preamble=bytes(128))
    made.SOPClassUID, made.SOPInstanceUID = SpatialFiducialsStorage, meta.MediaStorageSOPInstanceUID
    made.Modality, made.Manufacturer, made.ContentLabel = "FID", "Planning Station", "PLAN"
    made.PatientID, made.PatientName = "VIRTUAL-1", "Phantom^Virtual"
    made.StudyInstanceUID, made.SeriesInstanceUID = study, generate_uid()
    point, group = Dataset(), Dataset()
    point.FiducialIdentifier, point.ShapeType = "TARGET", "POINT"
    point.ContourData = [f"{value:.3f}" for value in place]
    group.FrameOfReferenceUID, group.FiducialSequence = frame, [point]
    made.FiducialSetSequence = [group]
    return made


def test_a_plan_by_dicom_is_a_proposal_like_the_others(room, port):
    with RoomClient(room.url, by="Olga") as client:
        calibrated(client)
        with CaseRecord(room.folder) as record:
            header = record.last_slice("assigned").header
        study, frame = header["study_instance_uid"], header["frame_of_reference_uid"]
        place = beside(client.state(), 2.0)
        before = client.state().target_patient_mm
        workstation = AE("WORKSTATION")
        workstation.add_requested_context(SpatialFiducialsStorage)
        listener = room.virtual_table["scanner"]["listener_port"]
        association = workstation.associate("127.0.0.1", listener, ae_title="AUTOSPINE")
        for uid in ("1.2.3.4", frame):
            sent = association.send_c_store(spatial_fiducials(study, uid, place))
            assert sent.Status == 0
        association.release()

        def of_workstation(state: RoomState) -> list[Any]:
            return [p for p in state.proposals if p.sender.startswith("WORKSTATION")]

        (one,) = of_workstation(wait_for(client.state, of_workstation))
        assert one.target_mm == pytest.approx(place, abs=1e-3)
        assert one.via == "DICOM Spatial Fiducials"
        assert client.state().target_patient_mm == before
        client.take_proposal(one.number, in_water=False)
        assert client.state().target_patient_mm == pytest.approx(place, abs=1e-3)
        with CaseRecord(room.folder) as record:
            turned_away = record.events_of_kind("proposal_turned_away")
        assert any("frame of reference" in e.body["why"] for e in turned_away)


def test_a_proposal_is_refused_and_another_accepted_by_clicking(room, port, browser):
    with RoomClient(room.url, by="Olga") as client, station("own", port) as screen:
        calibrated(client)
        refuse_all(client)
        page = browser.new_page(viewport={"width": 1280, "height": 800})
        page.goto(room.url)
        card = page.locator("#proposals")
        refused, wanted = beside(client.state(), 2.0), beside(client.state(), 3.0)
        screen.say("point", "L4", "TARGET", ras(refused))
        expect(card.locator("li")).to_have_count(1)
        expect(card).to_contain_text(f"({refused[0]:.2f}, ".replace("-", "−"))
        for theme in ("dark", "light"):
            set_theme(page, theme)
            assert violations(page) == []
        for width, height in SIZES:
            page.set_viewport_size({"width": width, "height": height})
            assert layout_faults(page) == []
        card.get_by_label("Why not").fill("a vessel is in the way")
        card.get_by_role("button", name="Refuse").click()
        told = screen.wait_for(lambda m: target_status(m) and m["code"] == 5)
        assert "a vessel is in the way" in told["text"]
        expect(card).to_be_hidden()

        since = screen.mark()
        screen.say("point", "L5", "ENTRY", ras(beside(client.state(), 4.0)), "TARGET", ras(wanted))
        expect(card.locator("li")).to_have_count(1)
        card.get_by_role("button", name="Accept: target for the fiducial").click()
        screen.wait_for(lambda m: target_status(m) and m["name"] == "taken", since)
        expect(card).to_be_hidden()
        assert client.state().target_patient_mm == pytest.approx(wanted, abs=1e-3)
        assert_shows_what_the_page_shows(screen, client)
        page.close()


@pytest.mark.parametrize("kind", KINDS)
def test_when_a_case_ends_and_the_next_begins_nothing_of_it_is_shown_any_more(kind, tmp_path):
    config = CONFIG.replace('case_dir = "case"', 'cases_dir = "cases"') + TABLE
    with (
        ready_service(tmp_path, config=config) as ready,
        RoomClient(ready["url"], by="Olga") as client,
        station(kind, int(ready["openigtlink"].rpartition(":")[2])) as screen,
    ):
        for number in (1.0, 2.0):
            client.begin_case(f"case {number:g}")
            assert_shows_what_the_page_shows(screen, client)
            assert not shown_points(screen, "Targets")
            client.set_entry((1.0, 2.0, 30.0 + number))
            client.set_target((1.0, 2.0, number))
            assert_shows_what_the_page_shows(screen, client)
            assert set(shown_points(screen, "Targets")) == {"target", "entry"}
            client.finish_case()
            assert_shows_what_the_page_shows(screen, client)
            assert not shown_points(screen, "Targets")


def test_pyigtl_plans_watches_and_stops(room, port):
    """It keeps the last message of a device, and drops every STATUS."""
    pyigtl = pytest.importorskip("pyigtl", reason="pyigtl is not installed")
    with RoomClient(room.url, by="Olga") as client:
        calibrated(client)
        refuse_all(client)
        planning = pyigtl.OpenIGTLinkClient("127.0.0.1", port)

        def until(device: str, wanted: Callable[[Any], bool]) -> Any:
            return wait_for(lambda: planning.wait_for_message(device, 60), wanted)

        try:
            wanted = {"ENTRY": beside(client.state(), 3.0), "TARGET": beside(client.state(), 2.5)}
            ras_mm = np.array(list(wanted.values())) * TO_RAS
            planning.send_message(pyigtl.PointMessage(ras_mm, list(wanted), device_name="Plan"))
            reachable = planning.wait_for_message("REACHABLE_TARGET", timeout=60)
            assert np.allclose(reachable.matrix[:3, 3], ras_mm[1], atol=1e-3)
            (one,) = open_proposals(client)
            client.take_proposal(one.number, in_water=False)
            until(
                "Targets",
                lambda m: (
                    m.names == ["target", "entry"]
                    and np.allclose(m.positions, ras_mm[::-1], atol=1e-3)
                ),
            )

            client.start_approach()
            asked = wait_for(client.state, lambda s: s.question is not None, 120.0).question
            before = planning.wait_for_message("CURRENT_POSITION", timeout=60).matrix
            client.answer(asked.question_id, "confirm", asked.plan["plan_id"])
            until("CURRENT_POSITION", lambda m: np.linalg.norm((m.matrix - before)[:3, 3]) > 0.5)
            planning.send_message(pyigtl.StringMessage("STOP", device_name="CMD_6"))
            assert planning.wait_for_message("ACK_6", timeout=60).string == "STOP"
            wait_for(client.state, lambda s: s.robot.stopped and s.procedure is None)
        finally:
            planning.stop()
        stop_all(client)


def test_a_flood_and_a_peer_that_vanishes_in_mid_message_keep_no_stop_back(room, port):
    """Last here: a machine that has flooded is not listened to for some seconds."""
    with RoomClient(room.url, by="Olga") as client, station("own", port) as screen:
        calibrated(client)
        flooding, vanishing = OwnStation(port), OwnStation(port)
        target = points("Plan", 1.0, [Point("TARGET", beside(client.state(), 1.0))]).encoded()
        events = client.state().event_id
        flooding.send(target * 3000)
        vanishing.send(HEADER.pack(2, b"STRING", b"CMD_1", 0, 4000, 0) + b"half")
        vanishing.close()
        since = screen.mark()
        screen.say("string", "CMD_5", "STOP")
        screen.wait_for(lambda m: m["device"] == "ACK_5", since)
        wait_for(client.state, lambda s: s.robot.stopped)
        flooding.close()
        assert client.state().event_id - events < 100, "a flood does not fill the record"
        stop_all(client)
