"""Targets: set, replaced, withdrawn; the oil-water shift against slices that really have it."""

from dataclasses import replace

import numpy as np
import pytest
from offline_arguments import approach_arguments, calibration_arguments
from test_guide import APART, GEOMETRY, PLANE, make_room, true_guide
from test_guide import approach_arguments as guide_arguments
from test_guide import calibration_arguments as guide_calibration

from case_record.record import CaseRecord
from service.procedure.approach import approach
from service.procedure.calibration import BY_DISC, Calibration, FoundBy, calibrate
from service.procedure.estimate import FiducialEstimate
from service.procedure.jacobian import ImageJacobian
from service.procedure.targets import (
    Target,
    TargetError,
    all_targets,
    common_cancels,
    current_target,
    fiducial_must_appear_at,
    needle_line,
    oil_shift_mm,
)
from simulator.config import SliceProtocol, VirtualRoom
from simulator.scene import true_fiducial_mm
from simulator.stage_physics import StageParameters
from studies.offline_room import MrImaging, OfflineRoom, plane_of

HEADER = {
    "imaging_frequency_mhz": 123.2,
    "pixel_bandwidth_hz": 260.0,
    "phase_encoding_direction": "COL",
}


@pytest.fixture
def record(tmp_path):
    with CaseRecord(tmp_path, create=True) as record:
        record.start_case("test", 1)
        yield record


def set_target(record, *patient_mm, **more):
    body = {"patient_mm": list(patient_mm), **more}
    record.append_event("target_set", body, source="test", who="operator")


def test_the_newest_target_counts_until_it_is_withdrawn(record):
    assert current_target(record) is None
    set_target(record, 1.0, 2.0, 3.0, label="first")
    set_target(record, 4.0, 5.0, 6.0, label="second", in_water=True)
    found = current_target(record)
    assert found == Target(found.number, (4.0, 5.0, 6.0), "second", True)
    record.append_event("target_withdrawn", {}, source="test", who="operator")
    assert current_target(record) is None
    set_target(record, 1.0, 2.0, 3.0)
    assert current_target(record).patient_mm == (1.0, 2.0, 3.0)
    assert [target.label for target in all_targets(record)] == ["first", "second", ""]


@pytest.mark.parametrize("encoding", ["ROW", "COL"])
@pytest.mark.parametrize("polarity", [1, -1])
def test_a_target_in_water_is_reached_although_the_fiducial_is_oil(encoding, polarity):
    """The slices really have the shift (1.6 px); without the correction this misses by as much."""
    protocol = SliceProtocol(
        chemical_shift_ppm=3.4, readout_polarity=polarity, phase_encoding=encoding
    )
    room_model = VirtualRoom(protocol=protocol)
    room = OfflineRoom(MrImaging(room_model), StageParameters(), 4)
    calibration = room.run(calibrate(calibration_arguments()))
    x, y, z = true_fiducial_mm(room_model, room.stage_mm).tolist()
    target = Target(1, (x + 3.0, y, z - 2.0), in_water=True)
    header = {**HEADER, "phase_encoding_direction": encoding}
    wanted = fiducial_must_appear_at(target, calibration.plane, header, polarity)
    room.run(approach(approach_arguments(wanted), calibration))
    miss = true_fiducial_mm(room_model, room.stage_mm) - np.array(target.patient_mm)
    assert np.linalg.norm(miss[[0, 2]]) < 0.06
    uncorrected = fiducial_must_appear_at(
        Target(1, target.patient_mm), calibration.plane, header, polarity
    )
    assert np.linalg.norm(wanted - uncorrected) == pytest.approx(3.4 * 123.2 / 260.0)


def test_the_shift_grows_with_the_field_and_shrinks_with_the_bandwidth():
    there = oil_shift_mm(HEADER, (1.0, 2.0), 1)
    assert there == pytest.approx([0.0, 2.0 * 3.4 * 123.2 / 260.0])
    half = {**HEADER, "imaging_frequency_mhz": 61.6}
    assert oil_shift_mm(half, (1.0, 2.0), 1) == pytest.approx(there / 2)
    assert oil_shift_mm(HEADER, (1.0, 2.0), -1) == pytest.approx(-there)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"imaging_frequency_mhz": None}, "ImagingFrequency"),
        ({"pixel_bandwidth_hz": 0.0}, "PixelBandwidth"),
        ({"pixel_bandwidth_hz": float("nan")}, "PixelBandwidth"),
        ({"phase_encoding_direction": ""}, "InPlanePhaseEncodingDirection"),
    ],
)
def test_a_header_that_does_not_tell_the_shift_is_refused_by_attribute(change, said):
    with pytest.raises(TargetError, match=said):
        oil_shift_mm({**HEADER, **change}, (1.0, 1.0), 1)


def test_an_unknown_polarity_is_refused():
    with pytest.raises(TargetError, match="readout_polarity"):
        oil_shift_mm(HEADER, (1.0, 1.0), 0)


def test_a_fiducial_target_needs_no_header():
    place = fiducial_must_appear_at(Target(1, (5.0, 58.0, -18.0)), PLANE, {}, 0)
    assert place == pytest.approx(PLANE.from_patient((5.0, 58.0, -18.0)))


def test_entry_and_target_are_met_by_the_needles_line():
    room = make_room(7)
    calibration = room.run(calibrate(guide_calibration()))
    joint_y = float(true_guide(room).point_mm[1])
    entry, target = (6.0, joint_y - 20.0, -19.0), (9.0, joint_y - 80.0, -22.0)
    needle = needle_line(entry, target, PLANE, joint_y, joint_y + APART)
    assert needle.joint_mm - needle.depth_mm * needle.direction == pytest.approx(target)
    state = needle.state(GEOMETRY, PLANE)
    room.run(approach(guide_arguments(state), calibration))
    line = true_guide(room)
    assert line.distance_to_mm(target) < 0.25
    assert line.distance_to_mm(entry) < 0.15


@pytest.mark.parametrize(
    ("entry", "lower_plane_mm", "said"),
    [
        ((9.0, -20.0, -22.0), -2.0, "do not define a line"),
        ((40.0, -20.5, -22.0), -2.0, "less than 30° from"),
        ((9.0, 10.0, -22.0), -30.0, r"10\.0 mm above the lower plane"),
    ],
)
def test_an_entry_that_makes_no_needle_is_refused(entry, lower_plane_mm, said):
    with pytest.raises(TargetError, match=said):
        needle_line(entry, (9.0, -20.0, -22.0), PLANE, lower_plane_mm, lower_plane_mm + APART)


def test_the_plane_of_the_room_is_coronal():
    from simulator.mr_slice import slice_geometry

    assert plane_of(slice_geometry(VirtualRoom().protocol)) == PLANE


def test_what_draws_a_disc_cancels_only_between_places_found_alike():
    """Not for a place in tissue, nor for one that was found by a template."""
    by_template = FoundBy(((1, 2),), (0.01, 0.01), (0.0, 0.0))
    seen = FiducialEstimate({"xt": 0, "yt": 0}, np.zeros(2), np.eye(2))
    now = Calibration(ImageJacobian.unknown(("xt", "yt")), seen, PLANE, 7)
    here = Target(1, (0.0, 0.0, 0.0), found_by=BY_DISC)
    assert common_cancels(here, now)
    assert common_cancels(replace(here, found_by=None), now)
    assert not common_cancels(replace(here, in_water=True), now)
    assert not common_cancels(replace(here, found_by=by_template), now)
    assert not common_cancels(here, replace(now, found_by=by_template))
