"""OpenIGTLink: the bytes against the protocol's own examples, and receivers of a real service."""

import socket
import struct
import time
from pathlib import Path

import httpx
import numpy as np
import pytest
from lone_service import CONFIG, ready_service

from case_record.record import CaseRecord
from dicom_slice.geometry import SliceGeometry
from room_config.load import ConfigError, load_config
from room_config.openigtlink import OpenIgtLinkConfig
from room_config.service import GuideConfig
from service.client import RoomClient
from service.procedure.steps import Acquire, HoldShift, Measure
from service.room.images import slice_pixels
from service.room.state import (
    ArrivalState,
    FiducialState,
    LostState,
    MeasurementState,
    ReconstructionState,
    RobotState,
    RoomState,
    SliceState,
)
from service.slicer.messages import (
    HEADER,
    STATUS_NOT_READY,
    Point,
    crc64,
    image,
    points,
    status,
    string,
    transform,
)
from service.slicer.reading import Received, Stream, points_of
from service.slicer.scene import Images, scene_of, standing
from service.slicer.server import bind_openigtlink
from simulator.config import VirtualRoom
from simulator.stage_physics import StageParameters
from studies.offline_room import MrImaging
from studies.recorded_room import RecordedRoom

# the protocol's published example of a TRANSFORM body and the CRC in its header
EXAMPLE_BODY = bytes.fromhex(
    "bf7473cd 3e4959e6 be63dd98 be4959e6 3e12491b 3f7852d6 3e63dd98 3f7852d6 bdc830ae"
    "42383660 419bc467 42383660"
)
EXAMPLE_CRC = 0xF6DD2B8EB4DF6DD2


def bitwise_crc(body: bytes) -> int:
    value = 0
    for byte in body:
        value ^= byte << 56
        for _ in range(8):
            value = (value << 1 ^ (0x42F0E1EBA9EA3693 if value >> 63 else 0)) & (2**64 - 1)
    return value


def test_the_crc_is_that_of_the_protocols_example():
    assert crc64(EXAMPLE_BODY) == EXAMPLE_CRC
    assert crc64(b"123456789") == 0x6C40DF5F0B497347


@pytest.mark.parametrize("size", [0, 1, 127, 128, 129, 1000, 4096])
def test_the_crc_does_not_depend_on_how_the_body_is_divided(size):
    body = np.random.default_rng(size).bytes(size)
    assert crc64(body) == bitwise_crc(body)


def test_a_transform_is_written_column_by_column_in_ras():
    values = np.array(struct.unpack(">12f", EXAMPLE_BODY))
    to_lps = np.array([-1.0, -1.0, 1.0])
    columns, origin = values[:9].reshape(3, 3) * to_lps, values[9:] * to_lps
    encoded = transform("Needle", 12.5, columns.T, origin).encoded(1)
    version, kind, device, stamp, size, crc = HEADER.unpack(encoded[:58])
    assert (version, kind.rstrip(b"\0"), device.rstrip(b"\0")) == (1, b"TRANSFORM", b"Needle")
    assert (stamp >> 32, stamp & 0xFFFFFFFF) == (12, 2**31)
    assert (size, crc) == (48, EXAMPLE_CRC)
    assert encoded[58:] == EXAMPLE_BODY


@pytest.mark.parametrize("version", [1, 2])
def test_another_implementation_reads_what_we_write(version):
    pyigtl = pytest.importorskip("pyigtl", reason="pyigtl is not installed")
    geometry = SliceGeometry(
        (-50.0, 62.5, 40.0), (0.0, 0.0, -1.0), (1.0, 0.0, 0.0), (1.0, 0.5), (3, 4)
    )
    pixels = np.arange(12.0).reshape(3, 4)

    def read(message):
        encoded = message.encoded(version)
        fields = pyigtl.messages.MessageBase.parse_header(encoded[:58])
        made = pyigtl.messages.MessageBase.create_message(fields["message_type"])
        made.unpack(fields, encoded[58:])
        return made

    shown = read(image("Slice", 3.0, pixels, geometry))
    assert np.array_equal(shown.image[0], pixels)
    corner = shown.ijk_to_world_matrix @ [3, 2, 0, 1]
    assert np.allclose(corner[:3], geometry.patient_from_pixel([2, 3]) * [-1, -1, 1])
    listed = read(points("Targets", 3.0, [Point("target", (1.0, 2.0, 3.0), 4.0)]))
    assert (listed.names, listed.positions) == (["target"], [(-1.0, -2.0, 3.0)])
    moved = read(transform("Needle", 3.0, np.eye(3), (1.0, 2.0, 3.0)))
    assert moved.matrix[:3, 3].tolist() == [-1.0, -2.0, 3.0]
    assert read(string("ACK_1", 3.0, "STOP")).string == "STOP"


def test_meta_data_stand_behind_the_content_where_the_other_implementation_looks():
    pyigtl = pytest.importorskip("pyigtl", reason="pyigtl is not installed")
    encoded = transform("Needle", 3.0, np.eye(3), (1.0, 2.0, 3.0), {"TransformStatus": "OK"})
    fields = pyigtl.messages.MessageBase.parse_header(encoded.encoded()[:58])
    read = pyigtl.messages.MessageBase.create_message(fields["message_type"])
    read.unpack(fields, encoded.encoded()[58:])
    assert read.metadata == {"TransformStatus": "OK"}


def test_what_is_withdrawn_can_be_told_to_readers_of_either_version():
    empty = points("Targets", 3.0, [])
    assert empty.withdraws
    assert len(empty.encoded(1)) > 58, "a body of no bytes is refused by the official library"
    ended = transform("NeedleGuide", 3.0, np.eye(3), np.zeros(3), {"TransformStatus": "INVALID"})
    assert ended.withdraws
    assert np.isnan(struct.unpack(">12f", ended.encoded(1)[58:])).all()


def test_text_is_cut_to_what_the_protocol_holds():
    made = status("A name that is much too long", 1.0, 1, "x" * 50, "µm and more")
    encoded = made.encoded(1)
    assert encoded[14:34] == b"A name that is much\0"
    assert encoded[58 + 10 :] == b"x" * 19 + b"\0" + b"?m and more\0"


STANDING = RobotState(linked=True, armed=True, position_certain=True, phase="PLANNING")
CORONAL = {
    "shape": (64, 64), "position_mm": (-32.0, 40.0, 32.0), "row_direction": (0.0, 0.0, -1.0),
    "col_direction": (1.0, 0.0, 0.0), "spacing_mm": (1.0, 1.0),
}  # fmt: skip


def state(**more) -> RoomState:
    given = {"robot": STANDING, **more}
    return RoomState(
        revision=1, at_s=5.0, room="r", virtual=True, tolerance_mm=0.2, ready_valid_s=60.0, **given
    )


def seen_in(number: int, place: tuple[float, float, float]) -> MeasurementState:
    return MeasurementState(
        measurement_id=number, method="ml", state="done", finished_s=4.0, radius_mm=4.5,
        patient_mm=place,
    )  # fmt: skip


def arrived() -> ArrivalState:
    return ArrivalState(
        procedure_id=1, measurement_id=1, error_mm=0, sigma_mm=0, probability=1, iterations=1,
        frames=1, scan_s=1, tip_mm=(10.0, -20.0, 5.0), joint_mm=(10.0, 40.0, 85.0),
    )  # fmt: skip


def test_every_device_is_always_in_the_scene_and_what_there_is_not_is_withdrawn():
    scene = scene_of(state()) | Images().of(state(), None)
    assert {name for name, message in scene.items() if message.withdraws} == {
        "Fiducials", "Targets", "NeedleGuide", "Slice", "SuperResolution",
    }  # fmt: skip
    assert set(scene) == {"AutoSPINe", *(name for name in scene if scene[name].withdraws)}


@pytest.mark.parametrize(
    ("robot", "code"),
    [
        ({}, 1),
        ({"linked": False}, 13),
        ({"stopped": True, "phase": "STOP"}, 13),
        ({"stopped": True, "phase": "EMERGENCY"}, 3),
        ({"armed": False}, 13),
        ({"position_certain": False}, 13),
        ({"phase": "MANUAL"}, 14),
        ({"fault": "bus voltage"}, 18),
    ],
)
def test_status_is_ok_only_while_the_robot_could_take_an_order(robot, code):
    scene = scene_of(state(robot=STANDING.model_copy(update=robot)))
    assert struct.unpack(">H", scene["AutoSPINe"].content[:2]) == (code,)


def test_the_needle_points_from_the_joint_to_its_tip_with_a_right_handed_frame():
    needle = scene_of(state(ready=True, arrival=arrived()))["NeedleGuide"]
    assert not needle.withdraws
    values = np.array(struct.unpack(">12f", needle.content))
    axes = values[:9].reshape(3, 3).T
    assert np.allclose(axes[:, 2], np.array([0.0, 60.0, -80.0]) / 100, atol=1e-6)
    assert np.linalg.det(axes) == pytest.approx(1.0, abs=1e-5)
    assert values[9:].tolist() == [-10.0, 20.0, 5.0]


def test_the_needle_ends_with_ready():
    assert scene_of(state(ready=False, arrival=arrived()))["NeedleGuide"].withdraws


def test_a_fiducial_is_a_sphere_of_its_size_in_the_patient():
    scene = scene_of(state(measurement=seen_in(3, (1.0, 60.0, -2.0))))
    assert scene["Fiducials"] == points(
        "Fiducials", 4.0, [Point("fiducial", (1.0, 60.0, -2.0), 9.0, (255, 200, 0))]
    )


LOST = LostState(code="moved", text="measured before the last move")


def test_a_fiducial_is_not_shown_where_it_may_not_be_any_more():
    seen = seen_in(3, (1.0, 60.0, -2.0))
    for robot in (
        STANDING.model_copy(update=change) for change in ({"moving": True}, {"linked": False})
    ):
        assert scene_of(state(robot=robot, measurement=seen))["Fiducials"].withdraws
    lost = seen.model_copy(update={"lost": LOST})
    assert scene_of(state(measurement=lost))["Fiducials"].withdraws


def test_of_two_fiducials_only_the_one_that_was_seen_here_is_shown():
    other = FiducialState(measurement_id=3, patient_mm=(1.0, 5.0, -2.0), radius_mm=4.5, lost=LOST)
    scene = scene_of(state(measurement=seen_in(4, (1.0, 60.0, -2.0)), other_fiducial=other))
    assert scene["Fiducials"] == points(
        "Fiducials", 4.0, [Point("fiducial", (1.0, 60.0, -2.0), 9.0, (255, 200, 0))]
    )


GUIDE = GuideConfig(
    upper_plane_mm=60.0, lower_plane_mm=-10.0, upper_fiducial_mm=55.0, lower_fiducial_mm=20.0,
    upper_slice_mm=40.0, lower_slice_mm=5.0,
)  # fmt: skip


@pytest.mark.parametrize("newest_is_upper", [True, False])
def test_two_fiducials_keep_their_names_and_places_in_the_list(newest_is_upper):
    """The slice's normal is -y: rows go down, columns to the left."""
    normal = np.cross(CORONAL["col_direction"], CORONAL["row_direction"])
    places = [tuple((np.array([1.0, 0.0, 2.0]) + mm * normal).tolist()) for mm in (40.1, 4.9)]
    newest, other = places if newest_is_upper else places[::-1]
    shown = SliceState(slice_id=1, state="assigned", received_s=3.0, **CORONAL)
    scene = scene_of(
        state(
            slice=shown,
            measurement=seen_in(4, newest),
            other_fiducial=FiducialState(measurement_id=3, patient_mm=other, radius_mm=4.5),
        ),
        GUIDE,
    )
    found = points_of(Received(2, "POINT", "Fiducials", scene["Fiducials"].content))
    assert [point.name for point in found] == ["upper", "lower"]
    assert np.allclose([point.patient_mm for point in found], places, atol=1e-4)


def reconstruction(number: int) -> ReconstructionState:
    return ReconstructionState(
        measurement_id=number, factor=2, patient_mm=(1.0, 60.0, -2.0), radius_mm=4.5, **CORONAL
    )


def test_a_reconstruction_is_shown_only_beside_the_fiducials_that_were_seen_in_it():
    seen = seen_in(4, (1.0, 60.0, -2.0))
    assert standing(state(measurement=seen, reconstruction=reconstruction(4))).reconstruction
    assert not standing(state(measurement=seen, reconstruction=reconstruction(3))).reconstruction


# A real service


class Receiver:
    """Reads whole messages from the service."""

    def __init__(self, port: int) -> None:
        self._socket = socket.create_connection(("127.0.0.1", port), timeout=60)
        self._file = self._socket.makefile("rb")

    def __enter__(self) -> "Receiver":
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()
        self._socket.close()

    def say(self, text: bytes) -> None:
        self._socket.sendall(text)

    def read(self) -> tuple[str, str, bytes] | None:
        head = self._file.read(58)
        if len(head) < 58:
            return None
        (size,) = struct.unpack(">Q", head[42:50])
        whole = Stream()
        (message,) = whole.feed(head + self._file.read(size))
        assert not whole.faults
        return message.kind, message.device, message.content

    def wait_for(self, device: str) -> bytes:
        while (found := self.read()) is not None:
            if found[1] == device:
                return found[2]
        raise AssertionError(f"hung up before {device} came")


TABLE = "\n[openigtlink]\nport = 0\n"


def port_of(ready: dict[str, str]) -> int:
    return int(ready["openigtlink"].rpartition(":")[2])


@pytest.fixture(scope="module")
def case(tmp_path_factory):
    """A folder whose case has one measured slice; its pixels and thickness."""
    folder = tmp_path_factory.mktemp("scene")
    with CaseRecord(folder / "case", create=True) as record:
        room = RecordedRoom(record, MrImaging(VirtualRoom()), StageParameters(), 4)
        room.execute(Acquire(1))
        room.execute(Measure((HoldShift(record.open_hold().hold_id, (0.0, 0.0)),), "ml"))
        measured = record.last_measurement("done").result
        pixels = slice_pixels(record, measured["slice_id"])
        thickness_mm = record.slice(measured["slice_id"]).header["slice_thickness_mm"]
    return folder, pixels, thickness_mm


@pytest.fixture(scope="module")
def ready(case):
    with ready_service(case[0], TABLE) as ready:
        yield ready


def test_a_receiver_gets_the_whole_scene(case, ready):
    _, pixels, thickness_mm = case
    with Receiver(port_of(ready)) as receiver:
        fiducials = receiver.wait_for("Fiducials")
        shown = receiver.wait_for("Slice")
        assert struct.unpack(">H", receiver.wait_for("AutoSPINe")[:2]) == (STATUS_NOT_READY,)
    assert fiducials == b"", "without a link nobody knows where the guide is now"
    assert struct.unpack(">3H", shown[6:12]) == (pixels.shape[1], pixels.shape[0], 1)
    normal = np.array(struct.unpack(">3f", shown[36:48]))
    assert np.linalg.norm(normal) == pytest.approx(thickness_mm), "the slice's thickness"
    assert np.allclose(np.frombuffer(shown[72:], "<f4").reshape(pixels.shape), pixels)


def test_what_changes_is_sent_and_what_does_not_change_is_not(ready):
    with Receiver(port_of(ready)) as receiver, RoomClient(ready["url"]) as client:
        receiver.wait_for("Targets")
        client.set_target((1.0, 60.0, -2.0), label="L4")
        body = receiver.wait_for("Targets")
        assert body.startswith(b"target\0")
        assert struct.unpack(">3f", body[100:112]) == (-1.0, -60.0, -2.0)
        client.withdraw_target()
        devices = []
        while not devices or devices[-1] != "Targets":
            _, device, body = receiver.read()
            devices.append(device)
        assert body == b"", "withdrawn: there is no point any more"
        assert "Slice" not in devices


def test_what_a_receiver_says_is_not_heeded_and_one_that_does_not_read_holds_up_nobody(ready):
    with Receiver(port_of(ready)) as talks, Receiver(port_of(ready)), Receiver(port_of(ready)) as r:
        talks.say(np.random.default_rng(1).bytes(200_000))
        assert talks.wait_for("Slice")
        assert r.wait_for("Slice")
        metrics = httpx.get(ready["url"] + "/metrics").text
        assert "autospine_openigtlink_receivers 3.0" in metrics


def test_only_who_may_connect_is_served(tmp_path):
    only = "peer_networks = ['10.1.0.0/16']\n"
    with ready_service(tmp_path, TABLE + only) as ready, Receiver(port_of(ready)) as refused:
        assert refused.read() is None


def test_one_more_than_allowed_is_turned_away_until_another_one_has_gone(tmp_path):
    with ready_service(tmp_path, TABLE + "max_receivers = 1\n") as ready:
        with Receiver(port_of(ready)) as first:
            assert first.read() is not None
            with Receiver(port_of(ready)) as second:
                assert second.read() is None
        deadline_s = time.monotonic() + 60
        while time.monotonic() < deadline_s:
            with Receiver(port_of(ready)) as again:
                if again.read() is not None:
                    return
        raise AssertionError("its place was not free again")


@pytest.mark.parametrize(
    ("table", "expected"),
    [
        ("host = '0.0.0.0'\nport = 18944", "peer_networks must list who may connect"),
        ("port = 18944\npeer_networks = ['10.0.0.0/99']", "10.0.0.0/99"),
        ("port = 99999", "key openigtlink.port"),
    ],
)
def test_a_setting_that_would_let_anybody_in_or_makes_no_sense_is_refused(
    tmp_path: Path, table: str, expected: str
) -> None:
    file = tmp_path / "room.toml"
    file.write_text(CONFIG + "[openigtlink]\n" + table)
    with pytest.raises(ConfigError, match=expected):
        load_config(file, {})


def test_a_port_in_use_is_named():
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(ConfigError, match=f"openigtlink port 127.0.0.1:{port}"):
            bind_openigtlink(OpenIgtLinkConfig(port=port))


def test_without_the_table_nothing_listens(tmp_path):
    with ready_service(tmp_path) as ready:
        assert "openigtlink" not in ready
