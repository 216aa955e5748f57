"""Four degrees of freedom in the offline room, the needle's tip against the truth."""

import json
from dataclasses import replace

import numpy as np
import pytest
from offline_arguments import GATE

from case_record.record import CaseRecord
from service.cli.replay import replay_measurements, replay_procedure
from service.procedure.aim import ApproachArguments
from service.procedure.approach import approach
from service.procedure.calibration import Calibration, CalibrationArguments, calibrate
from service.procedure.fiducials import (
    GuideGeometry,
    GuideSeenWrongError,
    judged_point,
    line_of_state,
    state_on_line,
)
from service.procedure.observe import REJECT, ProcedureFailedError
from service.procedure.recording import RecordingArguments, record_place
from service.procedure.registry import GUIDE_APPROACH, GUIDE_CALIBRATION
from service.procedure.registry import approach_arguments as recorded_approach
from service.procedure.registry import calibration_arguments as recorded_calibration
from service.procedure.targets import needle_line
from simulator.config import Fiducial, VirtualRoom
from simulator.mr_slice import slice_geometry
from simulator.scene import true_fiducials_mm
from simulator.scene import true_guide as line_of_room
from simulator.stage_physics import StageParameters
from studies.offline_room import MrImaging, OfflineRoom, plane_of
from studies.recorded_room import RecordedRoom

AXES = ("xt", "yt", "xb", "yb")
UPPER, LOWER, APART, BELOW = 48.0, 14.0, 60.0, 80.0
ROOM = VirtualRoom(
    fiducials=(
        Fiducial(name="upper", mount="guide", along_guide_mm=UPPER),
        Fiducial(name="lower", mount="guide", along_guide_mm=LOWER),
    )
)
GEOMETRY = GuideGeometry(UPPER, LOWER, APART, (58.0 - APART + UPPER, 58.0 - APART + LOWER), BELOW)
PLANE = plane_of(slice_geometry(ROOM.protocol))

LOWER_PLANE = 58.0 - APART


def calibration_arguments(**changes):
    values = {
        "axes": AXES,
        "origin_um": dict.fromkeys(AXES, 0),
        "move_um": 6000,
        "shifts_px": (),
        "geometry": GEOMETRY,
        "gate": GATE,
    }
    return CalibrationArguments(**{**values, **changes})


def approach_arguments(target_mm, **changes):
    values = {
        "geometry": GEOMETRY,
        "lower_plane_mm": LOWER_PLANE,
        "target_mm": tuple(float(value) for value in target_mm),
        "travel_um": dict.fromkeys(AXES, (-20_000, 20_000)),
        "tolerance_mm": 0.25,
        "confidence": 0.95,
        "max_iterations": 8,
        "confirm_moves": True,
        "gate": GATE,
    }
    return ApproachArguments(**{**values, **changes})


def make_room(seed, room=ROOM, **options):
    return OfflineRoom(MrImaging(room), StageParameters(), seed, axes=AXES, **options)


def true_guide(room):
    """Line of the guide (point: lower joint) in patient mm."""
    return line_of_room(ROOM, room.stage_mm)


def true_tip(room):
    return PLANE.from_patient(true_guide(room).at(-BELOW).tolist())


def true_state(room):
    centres = true_fiducials_mm(ROOM, room.stage_mm)
    return np.concatenate([PLANE.from_patient(centres[n].tolist()) for n in ("upper", "lower")])


@pytest.fixture(scope="module")
def recorded():
    room = make_room(0)
    return room.run(calibrate(calibration_arguments())).to_json()


@pytest.fixture
def calibrated(recorded):
    """The same room again, as it stands after its calibration."""
    room = make_room(0)
    return room, room.run(calibrate(calibration_arguments()))


@pytest.mark.parametrize("same_mount", [True, False])
def test_a_calibration_is_held_against_the_last_one_of_this_robot(recorded, same_mount):
    again = calibration_arguments(last=recorded["jacobian"], same_mount=same_mount)
    for seed in range(1, 4):
        make_room(seed).run(calibrate(again))
    other = make_room(5)
    other.nominal_step_um["xb"] = 4.5 / 0.8  # an axis that goes a fifth less far than it did
    with pytest.raises(ProcedureFailedError, match=r"axis xb.*differs from the last calibration"):
        other.run(calibrate(again))


def test_the_tip_is_linear_in_what_is_seen():
    room = make_room(0)
    for stage in ((0, 0, 0, 0), (5, -3, 1, 8), (-9, 2, 6, -7)):
        for axis, value in zip(AXES, stage, strict=True):
            room.stages[axis].displace(1000.0 * value - room.stages[axis].position_um)
        tip = GEOMETRY.tip_from_fiducials @ true_state(room)
        assert tip == pytest.approx(true_tip(room), abs=1e-9)


def test_the_state_of_a_guide_on_a_given_line_is_what_would_be_seen():
    room = make_room(0)
    room.stages["xt"].displace(4000.0)
    line = true_guide(room)
    state = state_on_line(GEOMETRY, line.point_mm, line.direction, PLANE)
    assert state == pytest.approx(true_state(room), abs=1e-9)


def test_the_line_of_a_state_is_the_guides_true_line():
    room = make_room(0)
    for axis, value in zip(AXES, (5.0, -3.0, 1.0, 8.0), strict=True):
        room.stages[axis].displace(1000.0 * value)
    true = true_guide(room)
    found = line_of_state(GEOMETRY, true_state(room), PLANE, float(true.point_mm[1]))
    assert found.point_mm == pytest.approx(true.point_mm, abs=1e-9)
    assert found.direction == pytest.approx(true.direction, abs=1e-9)


def test_fiducials_further_apart_than_on_the_guide_are_refused():
    with pytest.raises(GuideSeenWrongError, match=r"impossible with 34\.0 mm between them"):
        line_of_state(GEOMETRY, np.array([40.0, 0.0, 0.0, 0.0]), PLANE, LOWER_PLANE)


def test_the_tip_80_mm_below_the_lower_plane_is_as_wrong_as_its_covariance_says():
    """30 approaches: honest covariance at the tip, and most tips within the tolerance."""
    normalised, errors, frames = [], [], []
    for seed in range(5):
        room = make_room(seed)
        calibration = room.run(calibrate(calibration_arguments()))
        home = calibration.estimate.plane_mm
        rng = np.random.default_rng(seed)
        for _ in range(6):
            target = home + rng.uniform(-3.0, 3.0, 4)
            wanted = GEOMETRY.tip_from_fiducials @ target
            before = room.frames
            arrival = room.run(approach(approach_arguments(target), calibration))
            calibration = arrival.calibration
            tip, covariance = judged_point(GEOMETRY, calibration.estimate)
            miss = true_tip(room) - tip
            normalised.append(miss @ np.linalg.solve(covariance, miss))
            errors.append(np.linalg.norm(true_tip(room) - wanted))
            frames.append(room.frames - before)
            assert arrival.frames == frames[-1]
            assert arrival.probability >= 0.95
    assert np.mean(np.array(normalised) < 5.99) >= 0.85
    assert np.median(errors) < 0.12
    assert np.quantile(errors, 0.95) < 0.25
    assert np.median(frames) <= 8


def test_the_jacobian_has_the_levers_of_the_mechanism(calibrated):
    _, calibration = calibrated
    matrix = calibration.jacobian.mean_columns
    # robot x is patient left (columns), robot y is inferior (rows)
    assert matrix[1, 0] == pytest.approx(UPPER / APART, abs=0.05)
    assert matrix[3, 0] == pytest.approx(LOWER / APART, abs=0.05)
    assert matrix[1, 2] == pytest.approx(1 - UPPER / APART, abs=0.05)
    assert matrix[3, 2] == pytest.approx(1 - LOWER / APART, abs=0.05)


def test_fiducials_above_the_top_plane_work_as_well():
    along = (105.0, 75.0)
    room_model = VirtualRoom(
        fiducials=tuple(
            Fiducial(name=name, mount="guide", along_guide_mm=at)
            for name, at in zip(("upper", "lower"), along, strict=True)
        ),
        background=(),
    )
    geometry = GuideGeometry(*along, APART, (58.0 - APART + along[0], 58.0 - APART + along[1]))
    room = make_room(1, room_model)
    # the levers are long: stay within the field of view and near the vertical
    calibration = room.run(calibrate(calibration_arguments(geometry=geometry, move_um=4000)))
    target = calibration.estimate.plane_mm + np.array([1.0, -2.0, 0.5, 0.5])
    changed = approach_arguments(target, geometry=geometry)
    arrival = room.run(approach(changed, calibration))
    assert arrival.probability >= 0.95
    assert arrival.error_mm < 0.25


def test_swapped_fiducials_are_noticed_in_the_calibration():
    swapped = replace(GEOMETRY, slice_positions_mm=GEOMETRY.slice_positions_mm[::-1])
    room = make_room(0)
    with pytest.raises(ProcedureFailedError, match="appear to be swapped") as failure:
        room.run(calibrate(calibration_arguments(geometry=swapped)))
    assert failure.value.code == "fiducials_swapped"
    assert len(room.moves) == 5  # and not moved any further


def test_fiducials_swapped_after_the_calibration_stop_the_approach(calibrated):
    room, calibration = calibrated
    swapped = replace(GEOMETRY, slice_positions_mm=GEOMETRY.slice_positions_mm[::-1])
    room.stages["xt"].displace(9000.0)  # the guide leans: the two are not above each other
    moves = len(room.moves)
    target = calibration.estimate.plane_mm + 1.0
    with pytest.raises(ProcedureFailedError):
        room.run(approach(approach_arguments(target, geometry=swapped), calibration))
    assert len(room.moves) <= moves + 1


def test_a_lost_fiducial_is_said_so(calibrated):
    room, calibration = calibrated
    room.imaging = MrImaging(VirtualRoom(fiducials=(ROOM.fiducials[0],), background=()))
    moves = len(room.moves)
    target = calibration.estimate.plane_mm + 1.0
    with pytest.raises(ProcedureFailedError, match="no usable measurement"):
        room.run(approach(approach_arguments(target), calibration))
    assert len(room.moves) == moves + 1


def test_slices_turned_since_the_calibration_are_refused_before_anything_moves(calibrated):
    room, calibration = calibrated
    turned = replace(PLANE, row_direction=PLANE.col_direction, col_direction=PLANE.row_direction)
    recording = RecordingArguments(sigma_mm=0.05, gate=GATE, geometry=GEOMETRY)
    moves = len(room.moves)
    with pytest.raises(ProcedureFailedError, match="orientation differs") as failure:
        room.run(record_place(recording, replace(calibration, plane=turned)))
    assert failure.value.code == "plane_changed"
    assert len(room.moves) == moves


def test_an_axis_that_does_not_move_is_named():
    room = make_room(0)
    room.stages["xb"].apply_load(1.05)  # beyond what the motor can push
    with pytest.raises(ProcedureFailedError, match=r"axis xb: .* moved 0\.00 mm per mm"):
        room.run(calibrate(calibration_arguments()))


def test_a_line_out_of_reach_moves_nothing(calibrated):
    room, calibration = calibrated
    moves = len(room.moves)
    target = calibration.estimate.plane_mm + np.array([0.0, 30.0, 0.0, 0.0])
    with pytest.raises(ProcedureFailedError, match="outside its travel"):
        room.run(approach(approach_arguments(target), calibration))
    assert len(room.moves) == moves


def test_a_rejected_move_is_not_made(calibrated):
    _, calibration = calibrated
    room = make_room(0, answer=lambda _: REJECT)
    room.setpoints_um = dict(calibration.estimate.setpoints_um)
    target = calibration.estimate.plane_mm + 1.0
    with pytest.raises(ProcedureFailedError, match="rejected by operator"):
        room.run(approach(approach_arguments(target), calibration))
    assert room.moves == []


def test_a_calibration_survives_its_json_form(recorded):
    again = Calibration.from_json(json.loads(json.dumps(recorded)))
    assert again.to_json() == recorded


@pytest.mark.parametrize(("upper", "lower"), [(10.0, 10.0), (10.0, 20.0), (10.0, -5.0)])
def test_fiducials_in_an_order_that_cannot_be_are_refused(upper, lower):
    with pytest.raises(ValueError, match="above the lower one"):
        GuideGeometry(upper, lower, APART, (1.0, 2.0))


def test_a_recorded_case_of_four_axes_replays_to_the_last_bit(tmp_path):
    """Real DICOM files of two slice positions, the real worker, and the case's record."""
    with CaseRecord(tmp_path, create=True) as record:
        room = RecordedRoom(record, MrImaging(ROOM), StageParameters(), 3, axes=AXES)
        calibration = room.run_recorded(
            GUIDE_CALIBRATION, recorded_calibration(calibration_arguments())
        )
        target = calibration.estimate.plane_mm + np.array([1.0, -1.5, 0.5, 1.0])
        approached = recorded_approach(approach_arguments(target), calibration)
        arrival = room.run_recorded(GUIDE_APPROACH, approached)
        wanted = GEOMETRY.tip_from_fiducials @ target
        assert np.linalg.norm(true_tip(room) - wanted) < 0.25
        assert arrival.probability >= 0.95
        assert all(replay_procedure(record, row).agrees for row in record.procedures())
        again = list(replay_measurements(record, None))
    assert len(again) == 2 * 6 + arrival_measurements(arrival)
    assert all(row.difference_mm == 0.0 for row in again)


def test_a_recorded_line_is_where_the_guide_truly_points_as_well_as_it_says():
    misses = []
    for seed in range(12):
        room = make_room(seed)
        calibration = room.run(calibrate(calibration_arguments()))
        recording = RecordingArguments(
            sigma_mm=0.05, gate=GATE, geometry=GEOMETRY, lower_plane_mm=LOWER_PLANE
        )
        place = room.run(record_place(recording, calibration))
        assert place.sigma_mm < 0.05
        needle = place.needle
        assert needle.tip_below_joint_mm == BELOW
        assert place.frames >= 2
        miss = (np.array(needle.tip_mm) - true_guide(room).at(-BELOW))[[0, 2]]
        misses.append(float(np.linalg.norm(miss)) / place.sigma_mm)
        line = needle_line(needle.joint_mm, needle.tip_mm, PLANE, LOWER_PLANE, LOWER_PLANE + APART)
        assert line.state(GEOMETRY, PLANE) == pytest.approx(place.calibration.estimate.plane_mm)
    assert 0.6 < np.sqrt(np.mean(np.square(misses)) / 2) < 1.6  # of 24 normal numbers


def arrival_measurements(arrival):
    """Two a look; looking longer measures both fiducials again."""
    return arrival.calibration.measurement_id - 2 * 6
