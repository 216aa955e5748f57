"""The camera's pieces against a camera whose pose and lens are known."""

import io
import json
import time
from dataclasses import replace

import cv2
import numpy as np
import pytest
from PIL import Image
from scipy.ndimage import center_of_mass

from bench.config import CameraConfigError, CameraError, load_bench
from bench.optics import Resampler, colour_plane, learn_lens, read_lens, sheet_of
from bench.slice_writer import BenchAcquisition, BenchStudy, write_bench_slice
from bench.slices import BenchCamera, focus_of
from bench.source import Exposure, FrameSource, QueueWatch, picture_files, read_picture
from dicom_slice.eligibility import SliceRules, why_not_usable
from dicom_slice.header import slices_of
from dicom_slice.quirks import Kind
from dicom_slice.reasons import Reason
from room_config.camera import CameraConfig
from room_config.load import ConfigError
from simulator.bench_camera import Scene, VirtualCamera, jpeg, write_board

CONFIG = {"source": "0", "sensor_px_per_mm": 1.5}


@pytest.fixture(scope="module")
def scene() -> Scene:
    return Scene(VirtualCamera(), 1)


@pytest.fixture(scope="module")
def lens(scene, tmp_path_factory):
    folder = tmp_path_factory.mktemp("board")
    write_board(scene, folder, (8, 11), 10.0)
    pictures = [read_picture(path) for path in picture_files(str(folder))]
    return learn_lens(pictures, (8, 11), 10.0)


def seen(scene: Scene, x_mm: float, y_mm: float) -> np.ndarray:
    data = jpeg(scene.picture({"xt": x_mm, "yt": y_mm}), 92)
    return np.asarray(Image.open(io.BytesIO(data)))


def bench_room(tmp_path, **camera):
    path = tmp_path / "room.toml"
    keys = {**CONFIG, **camera}
    lines = "\n".join(f"{key} = {json.dumps(value)}" for key, value in keys.items())
    path.write_text(
        '[room]\nname = "bench"\ncase_dir = "case"\n[service]\nbridge_link = "line"\n'
        f"[imaging]\nfiducial_radius_min_mm = 3.5\n[camera]\n{lines}\n"
    )
    return load_bench(path)


def test_the_lens_learnt_from_a_board_maps_the_sheet_as_it_truly_is(scene, lens):
    """Points 60 mm apart: distances between them are right to 0.2 %, a ruler's width at 60 mm."""
    grid_mm = np.stack(np.meshgrid([-60.0, 0.0, 60.0], [-40.0, 0.0, 40.0]), axis=-1).reshape(-1, 2)
    true_mm = scene.camera.true_sheet_mm(lens.picture_from_sheet(grid_mm))
    for array in (grid_mm, true_mm):
        array -= array.mean(axis=0)
    u, _, v = np.linalg.svd(true_mm.T @ grid_mm)
    assert np.abs(true_mm @ (u @ v) - grid_mm).max() < 0.12
    assert lens.residual_px < 0.2


def test_a_point_of_the_picture_and_its_place_on_the_sheet_belong_together(lens):
    point_px = np.array([130.0, 410.0])
    assert lens.picture_from_sheet(sheet_of(lens, point_px)) == pytest.approx(point_px, abs=1e-6)


def test_the_circle_moves_in_the_slices_as_on_the_sheet(scene, lens):
    """Up to a turn and 0.2 % of scale, which the calibration finds: within 0.04 px."""
    config = CameraConfig(source="0", lens_file="lens.json")
    resample = Resampler(config, scene.camera.shape, lens)
    rng = np.random.default_rng(5)
    places_mm = rng.uniform(-18, 18, (10, 2))
    centres = []
    for x_mm, y_mm in places_mm:
        planes = [colour_plane(seen(scene, x_mm, y_mm), "redness") for _ in range(4)]
        slice_ = resample(np.mean(planes, axis=0))
        centres.append(center_of_mass(np.clip(slice_ - 0.2 * slice_.max(), 0, None)))
    rows_cols = places_mm[:, ::-1]
    design = np.c_[rows_cols, np.ones(len(rows_cols))]
    fit, *_ = np.linalg.lstsq(design, np.array(centres), rcond=None)
    assert np.abs(design @ fit - centres).max() < 0.04
    assert np.linalg.svd(fit[:2])[1] == pytest.approx([1, 1], abs=3e-3)


def test_a_board_that_is_not_in_view_is_named(scene):
    with pytest.raises(CameraError, match="shows no board of 8 x 11 squares"):
        learn_lens([seen(scene, 0, 0)], (8, 11), 10.0)


@pytest.mark.parametrize("text", ["", "[]", '{"matrix": 3}'])
def test_a_file_that_is_no_lens_is_named(tmp_path, text):
    path = tmp_path / "lens.json"
    path.write_text(text)
    with pytest.raises(CameraConfigError, match=r"lens\.json: not a lens file"):
        read_lens(path)


def test_a_slice_that_does_not_fit_or_has_no_scale_is_refused(scene, lens):
    big = CameraConfig(**CONFIG, shape=(400, 400))
    with pytest.raises(CameraConfigError, match="does not fit in the picture"):
        Resampler(big, scene.camera.shape, None)
    with pytest.raises(CameraConfigError, match="the scale is unknown"):
        Resampler(CameraConfig(source="0"), scene.camera.shape, None)
    with pytest.raises(CameraConfigError, match="the lens file is for pictures of 640 x 480"):
        Resampler(CameraConfig(**CONFIG), (720, 1280), lens)


@pytest.mark.parametrize("colour", ["greenness", "blueness"])
def test_a_colour_plane_is_bright_where_that_colour_is(colour):
    picture = np.full((4, 4, 3), 200, np.uint8)
    picture[1, 2] = {"greenness": (20, 180, 30), "blueness": (20, 30, 180)}[colour]
    plane = colour_plane(picture, colour)
    assert plane[1, 2] > 100
    assert np.abs(np.delete(plane.ravel(), 6)).max() == 0


def test_a_slice_of_the_bench_is_read_back_as_what_it_is():
    pixels = np.linspace(-3, 250, 30 * 40).reshape(30, 40)
    began_s = 1_790_000_000.25
    dataset = write_bench_slice(
        pixels,
        0.8,
        BenchStudy.new(began_s, "BENCHCAMERA"),
        BenchAcquisition("1.2.3", 2, 1, 7, began_s, began_s + 1.5, 4),
        "bench redness",
    )
    (slice_,) = slices_of(dataset)
    assert slice_.kind is Kind.CAMERA
    assert slice_.interval is not None
    assert (slice_.interval.start_s, slice_.interval.end_s) == pytest.approx(
        (began_s, began_s + 1.5)
    )
    assert slice_.clock_synchronized
    assert slice_.geometry is not None
    assert slice_.geometry.angle_to_coronal_deg == 0
    middle_px = ((30 - 1) / 2, (40 - 1) / 2)
    assert slice_.geometry.patient_from_pixel(middle_px) == pytest.approx([0, 0, 0])
    assert dataset.pixel_array * float(dataset.RescaleSlope) == pytest.approx(pixels, abs=1 / 32)
    reason = why_not_usable(slice_, SliceRules())
    assert reason is not None
    assert reason.code == Reason.NOT_MR
    assert why_not_usable(slice_, replace(SliceRules(), allow_camera=True)) is None


def exposure(picture: np.ndarray) -> Exposure:
    return Exposure(picture, 0.0, 0.1, 1, True)


def test_what_is_wrong_in_the_picture_is_said(scene, tmp_path):
    camera = BenchCamera(bench_room(tmp_path, shape=[120, 120]))
    good = seen(scene, 0, 0)
    assert camera.judge(exposure(good)).circles == 1
    assert camera.complaint_about(camera.judge(exposure(good)).circles) == ""
    grey = np.repeat(good.mean(axis=2, keepdims=True), 3, axis=2).astype(np.uint8)
    assert "no circle" in camera.complaint_about(camera.judge(exposure(grey)).circles)
    other = np.roll(good, (-30, 45), axis=(0, 1))
    two = np.where(colour_plane(other, "redness")[..., None] > 40, other, good)
    assert "2 circles in view" in camera.complaint_about(camera.judge(exposure(two)).circles)
    bright = np.clip(good.astype(int) * 2, 0, 255).astype(np.uint8)
    assert camera.slice_of([exposure(bright)]).overexposed > camera.config.most_overexposed


def test_focus_falls_as_the_lens_is_turned_away():
    sharp, soft = (
        focus_of(Scene(replace(VirtualCamera(), blur_px=b), 1).picture({"xt": 0.0, "yt": 0.0}))
        for b in (0.4, 3.0)
    )
    assert sharp > 2 * soft


def write_video(path, scene, count, size=(640, 480)):
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 30.0, size)
    assert writer.isOpened()
    picture = cv2.resize(scene.picture({"xt": 0.0, "yt": 0.0}), size)
    for _ in range(count):
        writer.write(picture[..., ::-1])
    writer.release()


def test_a_video_is_a_camera_until_it_ends(scene, tmp_path):
    path = tmp_path / "bench.avi"
    write_video(path, scene, 20)
    with FrameSource(str(path), latency_s=0.0, stall_s=5.0) as source:
        first = source.next_after(0)
        assert first.picture.shape == (480, 640, 3)
        redness = colour_plane(first.picture, "redness")
        assert redness.max() > 100, "RGB, and red"
        with pytest.raises(CameraError, match="no more pictures"):
            source.exposed_after(time.time() + 60, 1)
        assert source.newest is not None
        assert source.newest.number == 20
        assert source.has_ended


def test_a_camera_that_drops_to_another_resolution_ends(scene, tmp_path):
    for number in range(6):
        size = (640, 480) if number < 4 else (320, 240)
        picture = cv2.resize(scene.picture({"xt": 0.0, "yt": 0.0}), size)
        cv2.imwrite(str(tmp_path / f"{number}.png"), picture)
    with (
        FrameSource(str(tmp_path / "*.png"), latency_s=0.0, stall_s=5.0) as source,
        pytest.raises(CameraError, match="changed from 640 x 480 to 320 x 240"),
    ):
        source.exposed_after(time.time() + 60, 1)


@pytest.mark.parametrize("source", ["/nowhere/video0", "http://127.0.0.1:9/camera.mjpg", "77"])
def test_no_camera_is_one_clear_line(source):
    with (
        pytest.raises(CameraError, match="cannot be opened") as caught,
        FrameSource(source, latency_s=0.0, stall_s=5.0),
    ):
        pass
    assert "\n" not in str(caught.value)


def test_pictures_that_stood_in_a_queue_are_told_from_fresh_ones():
    watch = QueueWatch()
    asked_s = 0.0
    for _ in range(20):  # the reader waits for each: 100 ms apart
        fresh = watch.is_empty(asked_s, asked_s + 0.095)
        asked_s += 0.1
    assert fresh
    asked_s += 5.0  # the computer was busy; fifty pictures wait, and come at once
    told = [watch.is_empty(asked_s + 0.004 * n, asked_s + 0.004 * n + 0.003) for n in range(7)]
    assert not any(told)


@pytest.mark.parametrize(
    ("keys", "words"),
    [
        ({"soruce": "0"}, "unknown key camera.soruce .did you mean 'source'"),
        ({"source": "0", "pixel_mm": 0}, "camera.pixel_mm"),
        ({"source": "0", "colour": "pink"}, "camera.colour"),
    ],
)
def test_a_wrong_key_is_named(tmp_path, keys, words):
    room = tmp_path / "room.toml"
    table = "".join(f"{key} = {json.dumps(value)}\n" for key, value in keys.items())
    room.write_text(
        '[room]\nname = "bench"\ncase_dir = "case"\n[service]\nbridge_link = "none"\n'
        f"[camera]\n{table}"
    )
    with pytest.raises(ConfigError, match=words):
        load_bench(room)
