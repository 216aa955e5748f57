"""The API against the whole virtual room: reading, ordering once, resuming, images."""

import io
import itertools
import re
import threading
import time

import httpx
import numpy as np
import pytest
from attended_room import AttendedRoom, calibrated, stop_all, wait_for
from PIL import Image

from case_record.record import CaseRecord
from dicom_slice.pixels import magnitude_pixels
from service.client import RefusedByServiceError, RoomClient, ServiceGoneError
from service.room.state import RoomState


@pytest.fixture
def state(client: RoomClient) -> RoomState:
    return calibrated(client)


def test_a_command_sent_again_under_its_key_is_carried_out_once(
    room: AttendedRoom, state: RoomState
) -> None:
    order = {"json": {"axis": "xt", "distance_um": 200}, "headers": {"Idempotency-Key": "jog-1"}}
    first = httpx.post(f"{room.url}/api/v1/jog", **order)
    with RoomClient(room.url) as client:
        wait_for(client.state, lambda s: s.procedure is None and not s.robot.moving)
        again = httpx.post(f"{room.url}/api/v1/jog", **order)
        assert first.status_code == again.status_code == 202
        assert first.json() == again.json()
        after = wait_for(client.state, lambda s: s.procedure is None and not s.robot.moving)
    assert after.robot.positions_um["xt"] - state.robot.positions_um["xt"] == pytest.approx(
        200, abs=20
    )
    other = {**order, "json": {"axis": "xt", "distance_um": -200}}
    refused = httpx.post(f"{room.url}/api/v1/jog", **other)
    assert (refused.status_code, refused.json()["title"]) == (422, "key_reused")


def test_a_jog_out_of_travel_is_refused_with_axis_and_limits(
    client: RoomClient, state: RoomState
) -> None:
    refused = None
    for _ in range(9):  # 45 mm: more than the whole travel
        now = wait_for(client.state, lambda s: s.procedure is None and not s.robot.moving)
        try:
            client.jog("yt", 5000)
        except RefusedByServiceError as error:
            refused = error
            break
    assert refused is not None
    assert re.search(r"axis yt.*outside its travel", str(refused))
    assert (refused.status, refused.code) == (409, "out_of_travel")
    assert client.state().robot.positions_um == now.robot.positions_um
    with pytest.raises(RefusedByServiceError, match="no axis"):
        client.jog("zz", 100)
    while (away_um := now.robot.positions_um["yt"]) > 100:  # others come after this one
        client.jog("yt", -min(away_um, 5000))
        now = wait_for(client.state, lambda s: s.procedure is None and not s.robot.moving)


def test_motion_that_is_locked_for_the_needle_is_refused_until_it_is_out(
    client: RoomClient, state: RoomState
) -> None:
    client.lock_motion()
    wait_for(client.state, lambda s: s.robot.insertion_locked)
    for order in (lambda: client.jog("xt", 100), client.start_calibration, client.start_approach):
        with pytest.raises(RefusedByServiceError) as refused:
            order()
        assert refused.value.code == "insertion_locked"
    client.needle_out()
    wait_for(client.state, lambda s: not s.robot.insertion_locked)


def test_two_operators_at_once_get_one_procedure(client: RoomClient, state: RoomState) -> None:
    answers: list[object] = []

    def start(by: str) -> None:
        with RoomClient(client.url, by=by) as other:
            try:
                answers.append(other.start_calibration())
            except RefusedByServiceError as error:
                answers.append(error.code)

    both = [threading.Thread(target=start, args=(name,)) for name in ("A", "B")]
    for thread in both:
        thread.start()
    for thread in both:
        thread.join()
    assert sum(isinstance(answer, int) for answer in answers) == 1
    assert any(answer in ("busy", "moving") for answer in answers)
    stop_all(client)


def test_pages_lead_from_the_first_event_to_the_last(
    room: AttendedRoom, client: RoomClient, state: RoomState
) -> None:
    path, seen = "/api/v1/events?limit=7", []
    while path:
        page = httpx.get(room.url + path)
        seen += [event["event_id"] for event in page.json()]
        path = page.links.get("next", {}).get("url", "")
    assert seen == list(range(1, seen[-1] + 1))
    newest = httpx.get(f"{room.url}/api/v1/events?newest=true&limit=3").json()
    assert [e["event_id"] for e in newest] == sorted((e["event_id"] for e in newest), reverse=True)
    assert newest[0]["event_id"] >= seen[-1]


def test_a_viewer_that_comes_back_gets_every_event_that_it_missed(
    client: RoomClient, state: RoomState
) -> None:
    client.describe_case("before")
    all_ids = [event.event_id for event in client.events()]
    missed = itertools.islice((m for m in client.live(after=3) if m.kind == "record"), 20)
    assert [message.event_id for message in missed] == all_ids[3:23]


def test_an_event_and_the_state_are_on_the_stream_within_150_ms(
    client: RoomClient, state: RoomState
) -> None:
    last = client.state().event_id
    stream = (m for m in client.live(after=last) if m.kind == "record")
    delays_s = []
    with RoomClient(client.url) as other:
        for number in range(12):
            order = threading.Timer(0.05, other.describe_case, [f"case {number}"])
            order.start()
            message = next(m for m in stream if m.body["kind"] == "case_described")
            delays_s.append(time.time() - message.body["wall_s"])
            order.join()
    # of a dozen at least some come when the machine does nothing else
    assert sorted(delays_s)[2] < 0.15


def test_the_stream_of_a_service_that_is_not_there_ends_with_a_clear_error() -> None:
    with RoomClient("http://127.0.0.1:9") as nobody, pytest.raises(ServiceGoneError, match="9"):
        next(nobody.live())


def test_a_slice_is_given_as_dicom_as_pixels_and_as_png(
    room: AttendedRoom, client: RoomClient, state: RoomState
) -> None:
    known = client.slices(state="assigned")[-1]
    with CaseRecord(room.folder) as record:
        path = record.case_dir / record.slice(known.slice_id).path
    dicom = client.slice_dicom(known.slice_id)
    assert dicom == path.read_bytes()
    truth = magnitude_pixels(path)
    base = f"{room.url}/api/v1/slices/{known.slice_id}"
    raw = httpx.get(f"{base}/pixels")
    rows, cols = map(int, raw.headers["x-shape"].split(","))
    np.testing.assert_allclose(
        np.frombuffer(raw.content, "<f4").reshape(rows, cols), truth, rtol=1e-6
    )
    png = httpx.get(f"{base}/image.png", params={"window": 500, "level": 300, "scale": 3})
    grey = np.asarray(Image.open(io.BytesIO(png.content)))
    assert grey.shape == (3 * rows, 3 * cols)
    wanted = np.clip((truth - 50.0) / 500.0, 0, 1) * 255
    np.testing.assert_allclose(grey[::3, ::3], wanted, atol=0.51)


def test_an_image_that_the_caller_has_is_not_sent_again(
    room: AttendedRoom, state: RoomState
) -> None:
    for path in ("image.png", "pixels", "image.dcm"):
        url = f"{room.url}/api/v1/slices/1/{path}"
        first = httpx.get(url)
        again = httpx.get(url, headers={"If-None-Match": first.headers["etag"]})
        assert (again.status_code, again.content) == (304, b"")
    other = httpx.get(f"{room.url}/api/v1/slices/1/image.png", params={"level": 10})
    assert other.headers["etag"] != httpx.get(url).headers["etag"]


def test_the_reconstruction_and_its_geometry_cover_what_the_slices_cover(
    room: AttendedRoom, client: RoomClient, state: RoomState
) -> None:
    found = client.state().reconstruction
    assert found is not None
    answer = httpx.get(f"{room.url}/api/v1/measurements/{found.measurement_id}/pixels")
    assert answer.headers["x-shape"] == f"{found.shape[0]},{found.shape[1]}"
    with CaseRecord(room.folder) as record:
        result = record.measurement(found.measurement_id).result
        assert result is not None
        slice_ = record.slice(result["slice_id"]).header["geometry"]
    assert found.factor == 2
    # the half pixel: the fine grid begins a quarter of a coarse pixel before its first centre
    step = np.array(found.position_mm) - np.array(slice_["position_mm"])
    rows, cols = np.array(slice_["row_direction"]), np.array(slice_["col_direction"])
    assert [step @ rows, step @ cols] == pytest.approx([-0.25, -0.25])


@pytest.mark.parametrize(
    ("method", "path", "status", "code"),
    [
        ("GET", "/api/v1/slices/99999", 404, "not_found"),
        ("GET", "/api/v1/slices/x", 422, "invalid_request"),
        ("GET", "/api/v1/slices/9223372036854775808", 422, "invalid_request"),
        ("GET", "/api/v1/measurements/99999/image.png", 404, "not_found"),
        ("GET", "/api/v1/measurements/1/image.png", 404, "no_image"),
        ("GET", "/api/v1/nothing", 404, "not_found"),
        ("DELETE", "/api/v1/state", 405, "method_not_allowed"),
        ("GET", "/api/v1/events?limit=0", 422, "invalid_request"),
        ("POST", "/api/v1/answer", 422, "invalid_request"),
    ],
)
def test_every_error_is_a_problem_document(
    room: AttendedRoom, state: RoomState, method: str, path: str, status: int, code: str
) -> None:
    answer = httpx.request(method, room.url + path)
    assert (answer.status_code, answer.json()["title"]) == (status, code)
    assert answer.headers["content-type"] == "application/problem+json"


def test_a_slice_is_set_aside_and_taken_back_and_the_record_says_by_whom(
    client: RoomClient, state: RoomState
) -> None:
    slice_ = client.slices(state="assigned")[0]
    client.assign_slice(slice_.slice_id, None, why="a doubtful one")
    aside = next(s for s in client.slices() if s.slice_id == slice_.slice_id)
    assert (aside.state, aside.decided_by, aside.reason) == (
        "quarantined",
        "tester",
        "a doubtful one",
    )
    client.assign_slice(slice_.slice_id, slice_.hold_id, why="it was right")
    back = next(s for s in client.slices() if s.slice_id == slice_.slice_id)
    assert (back.state, back.hold_id) == ("assigned", slice_.hold_id)
    events = [e for e in client.events() if e.kind == "slice_reassigned"]
    assert [event.who for event in events] == ["tester", "tester"]
    with pytest.raises(RefusedByServiceError, match="no hold 99999"):
        client.assign_slice(slice_.slice_id, 99999, why="a slip")


def test_a_clock_is_reset_and_slices_are_given_up_and_the_record_says_by_whom_and_why(
    client: RoomClient, state: RoomState
) -> None:
    hold_id = client.slices(state="assigned")[0].hold_id
    assert hold_id is not None
    client.forget_clock("the scanner was restarted")
    client.give_up_slices(hold_id, "the scan was cancelled")
    said = {e.kind: e for e in client.events()}
    assert said["clock_reset"].who == said["slices_given_up"].who == "tester"
    assert said["clock_reset"].body == {"why": "the scanner was restarted"}
    assert said["slices_given_up"].body["why"] == "the scan was cancelled"
    assert said["slices_given_up"].body["hold_id"] == hold_id
    with pytest.raises(RefusedByServiceError, match="no hold 99999"):
        client.give_up_slices(99999)


def test_health_and_metrics_name_every_part(room: AttendedRoom, state: RoomState) -> None:
    health = httpx.get(f"{room.url}/healthz")
    assert health.json() == {
        "status": "ok",
        "parts": {"control_loop": "ok", "robot": "ok", "listener": "ok", "worker": "ok"},
    }
    metrics = httpx.get(f"{room.url}/metrics").text
    assert "autospine_robot_linked 1.0" in metrics
    assert 'autospine_process_up{process="worker"} 1.0' in metrics
    assert 'autospine_motor_supply_volts{axis="xt"} 47.2' in metrics
    assert re.search(r'autospine_motor_board_celsius\{axis="yt"\} \d', metrics)


def test_a_plan_of_another_number_is_not_confirmed(client: RoomClient, state: RoomState) -> None:
    at = client.state().measurement
    assert at is not None
    assert at.patient_mm is not None
    x, y, z = at.patient_mm
    client.set_target((x + 2.0, y, z - 1.5))
    client.start_approach()
    asked = wait_for(client.state, lambda s: s.question is not None).question
    assert asked is not None
    assert asked.plan is not None
    with pytest.raises(RefusedByServiceError) as stale:
        client.answer(asked.question_id, "confirm", plan_id="another plan")
    assert (stale.value.status, stale.value.code) == (409, "stale_plan")
    with pytest.raises(RefusedByServiceError) as unknown:
        client.answer(asked.question_id, "perhaps")
    assert unknown.value.code == "unknown_choice"
    before = client.state().robot.positions_um
    stop_all(client)
    with pytest.raises(RefusedByServiceError) as closed:
        client.answer(asked.question_id, "confirm", plan_id=asked.plan["plan_id"])
    assert closed.value.code == "stale_question"
    assert client.state().robot.positions_um == before
