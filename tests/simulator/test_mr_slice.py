"""Slices of the virtual room against what is known of them, on grids that are not square."""

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from simulator.config import Fiducial, SliceProtocol, StaticObject, VirtualRoom
from simulator.mr_slice import StagePath, acquire, chemical_shift_px, slice_geometry
from simulator.scene import true_fiducial_mm, true_fiducials_mm
from sr_engine.localize import localize
from sr_engine.simulate import render_sphere_slab

QUIET = SliceProtocol(
    shape=(96, 128),
    snr=1e7,
    shading_per_mm=(0.0, 0.0),
    shading_per_mm2=0.0,
    fov_centre_mm=(5, 58, -18),
)


def quiet_room(**protocol: object) -> VirtualRoom:
    return VirtualRoom(background=(), protocol=QUIET.model_copy(update=protocol))


def centroid_px(image: NDArray[np.float64]) -> NDArray[np.float64]:
    """By the phase of the first harmonic of the squared image, which sampling hardly touches."""
    power = image**2
    phases = []
    for axis in (0, 1):
        n = image.shape[axis]
        harmonic = (power.sum(axis=1 - axis) * np.exp(2j * np.pi * np.arange(n) / n)).sum()
        phases.append(np.angle(harmonic) / (2 * np.pi) * n % n)
    return np.array(phases)


def test_a_quiet_slice_is_the_engines_own_sphere_in_a_slab() -> None:
    room = quiet_room()
    seen = acquire(room, {"xt": 3.3, "yt": -2.2}, np.random.default_rng(0))
    centre = tuple(seen.centres_px["upper"])
    _, out_of_plane_mm = seen.geometry.pixel_from_patient(seen.fiducials_mm["upper"])
    model = render_sphere_slab((96, 128), centre, 4.0, (-float(out_of_plane_mm), 3.0))
    # the shell, the rounding of the slab's place to a micrometre, and the noise stay below this
    assert np.abs(seen.signal.real / 1000 - model).max() < 2e-5


@settings(max_examples=25, deadline=None)
@given(xt=st.floats(-18, 18), yt=st.floats(-18, 18))
def test_the_fiducial_appears_where_it_truly_is(xt: float, yt: float) -> None:
    room = quiet_room()
    stage = {"xt": xt, "yt": yt}
    seen = acquire(room, stage, np.random.default_rng(0))
    there_px, _ = seen.geometry.pixel_from_patient(true_fiducial_mm(room, stage))
    assert np.allclose(centroid_px(seen.magnitude), there_px, atol=0.005)


def test_millimetres_are_kept_when_rows_and_columns_are_not_spaced_alike() -> None:
    room = quiet_room(spacing_mm=(0.8, 1.25), shape=(120, 90))
    stage = {"xt": -4.0, "yt": 7.0}
    seen = acquire(room, stage, np.random.default_rng(0))
    there_px, _ = seen.geometry.pixel_from_patient(true_fiducial_mm(room, stage))
    assert np.allclose(centroid_px(seen.magnitude), there_px, atol=0.005)
    half = seen.magnitude > 500
    assert np.ptp(np.nonzero(half)[0]) + 1 == pytest.approx(8.0 / 0.8, abs=1.0)
    assert np.ptp(np.nonzero(half)[1]) + 1 == pytest.approx(8.0 / 1.25, abs=1.0)


def test_the_background_does_not_move_with_the_robot() -> None:
    room = VirtualRoom(protocol=SliceProtocol(snr=1e7))
    here, there = (
        acquire(room, {"xt": x, "yt": 0.0}, np.random.default_rng(0)).magnitude for x in (-5.0, 9.0)
    )
    changed = np.abs(here - there) > 20
    assert changed[40:90, 40:90].any()
    assert not changed[:30].any()
    assert not changed[105:].any()
    assert here[100:].max() > 300, "there is a water phantom"
    assert here[:30].max() > 300, "there are tubes"


def test_noise_is_rician_of_the_stated_signal_to_noise_ratio() -> None:
    room = quiet_room(snr=25.0)
    seen = acquire(room, {"xt": 0.0, "yt": 0.0}, np.random.default_rng(5))
    air = seen.magnitude[:30]
    sigma = 1000 / 25
    assert air.mean() == pytest.approx(sigma * np.sqrt(np.pi / 2), rel=0.03)
    assert air.std() == pytest.approx(sigma * np.sqrt(2 - np.pi / 2), rel=0.05)


@pytest.mark.parametrize("window", ["hamming", "fermi", "elliptical"])
def test_a_filter_lowers_and_colours_the_noise(window: str) -> None:
    room = quiet_room(snr=25.0, window=window)
    seen = acquire(room, {"xt": 0.0, "yt": 0.0}, np.random.default_rng(5))
    air = seen.signal.real[:30]
    assert 0.3 * 40 < air.std() < 0.93 * 40
    neighbours = np.corrcoef(air[:-1].ravel(), air[1:].ravel())[0, 1]
    assert neighbours > 0.02, "white noise has no correlation between neighbours"


def test_oil_is_displaced_along_the_readout_and_water_is_not() -> None:
    tube = StaticObject(
        kind="cylinder", centre_mm=(-40.0, 58.0, 10.0), radius_mm=5.0, length_mm=50.0, signal=0.8
    )
    for encoding, axis in (("COL", 1), ("ROW", 0)):
        protocol = QUIET.model_copy(
            update={"chemical_shift_ppm": 3.4, "bandwidth_hz_px": 300.0, "phase_encoding": encoding}
        )
        room = VirtualRoom(background=(tube,), protocol=protocol)
        shift = chemical_shift_px(protocol)
        assert shift[axis] == pytest.approx(3.4 * 123.2 / 300.0)
        assert shift[1 - axis] == 0
        seen = acquire(room, {"xt": 6.0, "yt": 3.0}, np.random.default_rng(0))
        there_px, _ = seen.geometry.pixel_from_patient(seen.fiducials_mm["upper"])
        right = seen.magnitude.copy()
        right[:, :40] = 0
        assert np.allclose(centroid_px(right), there_px + shift, atol=0.02)
        left = seen.magnitude.copy()
        left[:, 40:] = 0
        tube_px, _ = seen.geometry.pixel_from_patient(tube.centre_mm)
        assert np.allclose(centroid_px(left), tube_px, atol=0.02)


def test_a_slice_taken_while_the_robot_moves_is_smeared_and_one_taken_after_is_not() -> None:
    room = quiet_room()
    times_s = np.linspace(10.0, 10.2, 201)
    path = StagePath(("xt", "yt"), times_s, np.outer((times_s - 10.0) / 0.2, [0.0, 3.0]))
    rng = np.random.default_rng(0)
    during = acquire(room, path, rng, interval_s=(10.0, 10.2))
    after = acquire(room, path, rng, interval_s=(10.2, 10.4))
    still = acquire(room, {"xt": 0.0, "yt": 3.0}, rng)
    assert during.travel_mm == pytest.approx(3.0)
    assert np.abs(after.magnitude - still.magnitude).max() < 1.0
    assert np.abs(during.magnitude - still.magnitude).max() > 100
    ghosts, ringing = during.magnitude.copy(), still.magnitude.copy()
    for image in (ghosts, ringing):
        image[35:65] = 0
    assert ghosts.max() > 2 * ringing.max(), "motion throws ghosts along the phase encoding"


def test_a_slice_that_misses_the_fiducial_does_not_show_it() -> None:
    room = quiet_room()
    stage = {"xt": 0.0, "yt": 0.0}
    rng = np.random.default_rng(0)
    there = true_fiducial_mm(room, stage)[1]
    missed = acquire(room, stage, rng, slice_position_mm=there + 6.0)
    assert missed.in_slice == ()
    assert missed.magnitude.max() < 1
    grazed = acquire(room, stage, rng, slice_position_mm=there + 3.0)
    assert grazed.in_slice == ("upper",)
    hit = acquire(room, stage, rng, slice_position_mm=there)
    assert (grazed.magnitude > 500).sum() < 0.8 * (hit.magnitude > 500).sum()


def test_two_fiducials_on_the_guide_follow_both_stages() -> None:
    fiducials = (
        Fiducial(name="upper", mount="guide", along_guide_mm=80.0),
        Fiducial(name="lower", mount="guide", along_guide_mm=30.0),
    )
    room = VirtualRoom(fiducials=fiducials)
    at_rest = true_fiducials_mm(room, {"xt": 0.0, "yt": 0.0, "xb": 0.0, "yb": 0.0})
    tilted = true_fiducials_mm(room, {"xt": 6.0, "yt": 0.0, "xb": 0.0, "yb": 0.0})
    assert np.linalg.norm(at_rest["upper"] - at_rest["lower"]) == pytest.approx(50.0)
    assert np.linalg.norm(tilted["upper"] - tilted["lower"]) == pytest.approx(50.0)
    moved = {name: tilted[name][0] - at_rest[name][0] for name in tilted}
    assert moved["upper"] == pytest.approx(80 * 6.0 / np.hypot(60, 6), rel=0.01)
    assert moved["lower"] == pytest.approx(30 * 6.0 / np.hypot(60, 6), rel=0.01)


def test_static_objects_have_the_sections_of_their_shapes_in_all_three_planes() -> None:
    centre = (5.0, 58.0, -18.0)
    things = (
        StaticObject(kind="box", centre_mm=centre, size_mm=(20.0, 12.0, 30.0), signal=1.0),
        StaticObject(
            kind="cylinder", centre_mm=centre, radius_mm=9.0, length_mm=40.0, axis="x", signal=1.0
        ),
        StaticObject(kind="sphere", centre_mm=centre, radius_mm=10.0, signal=1.0),
    )
    in_plane = {"coronal": (2, 0), "axial": (1, 0), "sagittal": (2, 1)}
    edges = {0: (20.0, 12.0, 30.0), 1: (40.0, 18.0, 18.0), 2: (20.0, 20.0, 20.0)}
    for (number, thing), plane in itertools.product(enumerate(things), in_plane):
        room = VirtualRoom(
            background=(thing,),
            protocol=QUIET.model_copy(update={"shape": (64, 80), "thickness_mm": 1.0}),
            fiducials=(Fiducial(offset_mm=(200.0, 200.0, 200.0)),),
        )
        seen = acquire(room, {"xt": 0.0, "yt": 0.0}, np.random.default_rng(0), orientation=plane)
        rows, cols = np.nonzero(seen.magnitude > 500)
        row_axis, col_axis = in_plane[plane]
        assert np.ptp(rows) + 1 == pytest.approx(edges[number][row_axis], abs=1.5), (thing, plane)
        assert np.ptp(cols) + 1 == pytest.approx(edges[number][col_axis], abs=1.5), (thing, plane)


def test_the_field_of_view_stays_where_it_was_set_in_every_plane() -> None:
    protocol = SliceProtocol(shape=(96, 128))
    for plane in ("coronal", "axial", "sagittal"):
        geometry = slice_geometry(protocol, None, plane)
        middle = geometry.patient_from_pixel([(96 - 1) / 2, (128 - 1) / 2])
        assert np.allclose(middle, protocol.fov_centre_mm)
    shifted = slice_geometry(protocol, 61.5)
    assert shifted.position_mm[1] == pytest.approx(61.5)
    assert shifted.angle_to_coronal_deg == 0


def test_the_same_seed_gives_the_same_slice() -> None:
    room = VirtualRoom()
    first, again, other = (
        acquire(room, {"xt": 1.0, "yt": 2.0}, np.random.default_rng(seed)).magnitude
        for seed in (3, 3, 4)
    )
    assert np.array_equal(first, again)
    assert not np.array_equal(first, other)


@pytest.mark.parametrize("snr", [20.0, 40.0])
def test_the_maximum_likelihood_fit_finds_the_truth_within_its_own_covariance(snr: float) -> None:
    room = VirtualRoom(protocol=SliceProtocol(shape=(120, 128), snr=snr))
    rng = np.random.default_rng(11)
    errors, normalised = [], []
    for _ in range(60):
        seen = acquire(room, {"xt": rng.uniform(-15, 15), "yt": rng.uniform(-15, 15)}, rng)
        truth_px = seen.centres_px["upper"]
        start_px = tuple(truth_px + rng.normal(0, 0.5, 2))
        found = localize([np.rint(seen.magnitude)], start_px=start_px, radius_px=(2.5, 6.5))
        error = found.centre_px - truth_px
        errors.append(error)
        normalised.append(error @ np.linalg.solve(found.covariance_px2, error))
    bound = 0.533 / (snr * np.sqrt(3.9))
    assert np.hypot(*np.transpose(errors)).mean() < 1.6 * bound * np.sqrt(np.pi / 2)
    assert np.abs(np.mean(errors, axis=0)).max() < 4 * bound / np.sqrt(60)
    assert 1.0 < np.mean(normalised) < 3.5
