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
from service.client import RoomClient
from service.procedure.steps import Acquire, HoldShift, Measure
from service.room.images import slice_pixels
from service.room.state import ArrivalState, MeasurementState, RoomState
from service.slicer.messages import (
    HEADER,
    STATUS_NOT_READY,
    Point,
    crc64,
    image,
    points,
    status,
    transform,
)
from service.slicer.scene import scene_of
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
    encoded = transform("Needle", 12.5, columns.T, origin)
    version, kind, device, stamp, size, crc = HEADER.unpack(encoded[:58])
    assert (version, kind.rstrip(b"\0"), device.rstrip(b"\0")) == (1, b"TRANSFORM", b"Needle")
    assert (stamp >> 32, stamp & 0xFFFFFFFF) == (12, 2**31)
    assert (size, crc) == (48, EXAMPLE_CRC)
    assert encoded[58:] == EXAMPLE_BODY


def test_another_implementation_reads_what_we_write():
    pyigtl = pytest.importorskip("pyigtl", reason="pyigtl is not installed")
    geometry = SliceGeometry(
        (-50.0, 62.5, 40.0), (0.0, 0.0, -1.0), (1.0, 0.0, 0.0), (1.0, 0.5), (3, 4)
    )
    pixels = np.arange(12.0).reshape(3, 4)

    def read(encoded):
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


def test_text_is_cut_to_what_the_protocol_holds():
    encoded = status("A name that is much too long", 1.0, 1, "x" * 50, "µm and more")
    assert encoded[14:34] == b"A name that is much\0"
    assert encoded[58 + 10 :] == b"x" * 19 + b"\0" + b"?m and more\0"


def state(**more) -> RoomState:
    return RoomState(revision=1, at_s=5.0, room="r", virtual=True, tolerance_mm=0.2, **more)


def test_what_is_not_known_is_not_shown_and_what_is_withdrawn_is_emptied():
    scene = scene_of(state())
    assert set(scene) == {"AutoSPINe", "Fiducials", "Targets"}
    assert scene["Targets"] == points("Targets", 5.0, [])
    assert struct.unpack(">H", scene["AutoSPINe"][58:60]) == (13,), "no robot: not ready"


def test_the_needle_points_from_the_joint_to_its_tip_with_a_right_handed_frame():
    arrival = ArrivalState(
        procedure_id=1, measurement_id=1, error_mm=0, sigma_mm=0, probability=1, iterations=1,
        frames=1, scan_s=1, tip_mm=(10.0, -20.0, 5.0), joint_mm=(10.0, 40.0, 85.0),
    )  # fmt: skip
    encoded = scene_of(state(arrival=arrival))["NeedleGuide"]
    values = np.array(struct.unpack(">12f", encoded[58:]))
    axes = values[:9].reshape(3, 3).T
    assert np.allclose(axes[:, 2], np.array([0.0, 60.0, -80.0]) / 100, atol=1e-6)
    assert np.linalg.det(axes) == pytest.approx(1.0, abs=1e-5)
    assert values[9:].tolist() == [-10.0, 20.0, 5.0]


def test_a_fiducial_is_a_sphere_of_its_size_in_the_patient():
    measured = MeasurementState(
        measurement_id=3, method="ml", state="done", finished_s=4.0, radius_mm=4.5,
        patient_mm=(1.0, 60.0, -2.0),
    )  # fmt: skip
    scene = scene_of(state(measurement=measured))
    assert scene["Fiducials"] == points(
        "Fiducials", 4.0, [Point("fiducial", (1.0, 60.0, -2.0), 9.0, (255, 200, 0))]
    )


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
        _, kind, device, _, size, crc = HEADER.unpack(head)
        body = self._file.read(size)
        assert crc64(body) == crc
        return kind.rstrip(b"\0").decode(), device.rstrip(b"\0").decode(), body

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
    """A folder whose case has one measured slice; where the fiducial is, and the pixels."""
    folder = tmp_path_factory.mktemp("scene")
    with CaseRecord(folder / "case", create=True) as record:
        room = RecordedRoom(record, MrImaging(VirtualRoom()), StageParameters(), 4)
        room.execute(Acquire(1))
        room.execute(Measure((HoldShift(record.open_hold().hold_id, (0.0, 0.0)),), "ml"))
        measured = record.last_measurement("done").result
        pixels = slice_pixels(record, measured["slice_id"])
    return folder, measured, pixels


@pytest.fixture(scope="module")
def ready(case):
    with ready_service(case[0], TABLE) as ready:
        yield ready


def test_a_receiver_gets_the_whole_scene(case, ready):
    _, measured, pixels = case
    with Receiver(port_of(ready)) as receiver:
        fiducials = receiver.wait_for("Fiducials")
        shown = receiver.wait_for("Slice")
        assert struct.unpack(">H", receiver.wait_for("AutoSPINe")[:2]) == (STATUS_NOT_READY,)
    x, y, z, diameter = struct.unpack(">4f", fiducials[100:116])
    assert np.allclose([-x, -y, z], measured["patient_mm"], atol=1e-4)
    assert diameter == pytest.approx(2 * measured["radius_px"], rel=1e-4)
    assert struct.unpack(">3H", shown[6:12]) == (pixels.shape[1], pixels.shape[0], 1)
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
            devices.append(receiver.read()[1])
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
        ("host = '0.0.0.0'\nport = 18944", "peer_networks must say who may connect"),
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
