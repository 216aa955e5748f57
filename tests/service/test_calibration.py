"""Calibration in the offline room: what it finds is true, what it says of its errors too."""

from dataclasses import replace

import numpy as np
import pytest
from offline_arguments import GATE, calibration_arguments

from room_config.service import STRATEGIES as CONFIGURABLE
from service.procedure.calibration import calibrate
from service.procedure.fiducials import ONE_FIDUCIAL
from service.procedure.jacobian import CalibrationError
from service.procedure.observe import ProcedureFailedError, move
from service.procedure.steps import MoveTo
from service.procedure.strategies import STRATEGIES, look
from simulator.config import Fiducial, StaticObject, VirtualRoom
from simulator.stage_physics import StageParameters
from sr_engine.reconstruction.shiftset import named
from studies.offline_room import MrImaging, OfflineRoom

ORIGIN = {"xt": 0, "yt": 0}


def normalised_errors(shift_set, seeds):
    found = []
    for seed in seeds:
        room = OfflineRoom(MrImaging(VirtualRoom()), StageParameters(), seed)
        shifts = named(shift_set).shifts_px
        calibration = room.run(calibrate(calibration_arguments(shifts_px=shifts)))
        miss = room.true_plane_mm - calibration.estimate.plane_mm
        found.append(miss @ np.linalg.solve(calibration.estimate.covariance_mm2, miss))
    return np.array(found)


@pytest.mark.parametrize("shift_set", ["single", "quarter"])
def test_where_it_says_that_the_fiducial_is_has_an_honest_covariance(shift_set):
    found = normalised_errors(shift_set, range(40))
    assert 1.2 < found.mean() < 3.0  # two degrees of freedom; 40 draws scatter by 0.32
    assert np.mean(found < 5.99) >= 0.85


def test_its_moves_go_out_along_both_axes_and_back_to_the_origin(make_room):
    room = make_room()
    room.run(calibrate(calibration_arguments()))
    assert room.moves == [
        ORIGIN,
        {"xt": 15_000, "yt": 0},
        {"xt": 15_000, "yt": 15_000},
        ORIGIN,
    ]
    assert room.frames == 4


def test_the_jacobian_predicts_what_the_stages_really_do(calibrated, make_room):
    _, calibration = calibrated
    quiet = make_room(stages=StageParameters(scatter=0.0, repeatability_um=0.0, park_shift_um=0.0))
    before = quiet.true_plane_mm
    quiet.execute(MoveTo({"xt": 4000, "yt": -3000}, "test"))
    predicted, covariance = calibration.jacobian.displacement({"xt": 4.0, "yt": -3.0})
    miss = quiet.true_plane_mm - before - predicted
    assert np.sqrt(miss @ np.linalg.solve(covariance, miss)) < 3.5


def test_the_paper_random_set_serves_as_well(make_room):
    shifts = ((0.0, 0.0), (0.7, -0.3), (-0.4, 0.9), (0.2, 0.6))
    room = make_room(seed=4)
    room.run(calibrate(calibration_arguments(shifts_px=shifts)))
    assert room.frames == 8


def test_a_stage_that_does_not_move_is_refused_and_said(make_room):
    room = make_room()
    room.stages["yt"].apply_load(2.0)  # beyond stall: the steps are counted, the stage stands
    with pytest.raises(ProcedureFailedError, match=r"axis yt: the fiducial moved 0\.0"):
        room.run(calibrate(calibration_arguments()))


def test_motors_connected_crosswise_or_backwards_are_learnt_not_assumed():
    room = OfflineRoom(MrImaging(VirtualRoom()), StageParameters(mounting=-1), 1)
    calibration = room.run(calibrate(calibration_arguments(axes=("yt", "xt"))))
    columns = calibration.jacobian.columns
    # robot y is inferior, so the row index grows with it; robot x is left, so the column index
    assert columns[0, 0] > 0.95
    assert columns[1, 2] > 0.95


def test_a_fiducial_that_is_not_in_the_slice_is_said_so():
    room = OfflineRoom(
        MrImaging(VirtualRoom(fiducials=(Fiducial(offset_mm=(0.0, 0.0, 30.0)),), background=())),
        StageParameters(),
        0,
    )
    with pytest.raises(ProcedureFailedError, match="no usable measurement: no round object"):
        room.run(calibrate(calibration_arguments()))


def test_two_equal_round_objects_are_refused_not_guessed():
    twin = StaticObject(kind="sphere", centre_mm=(-24.7, 58.0, 9.4), radius_mm=4.0, signal=1.0)
    room = OfflineRoom(MrImaging(VirtualRoom(background=(twin,))), StageParameters(), 0)
    with pytest.raises(ProcedureFailedError, match="two round objects are equally good"):
        room.run(calibrate(calibration_arguments()))


def test_the_native_jacobian_scaled_is_the_one_of_super_resolution_images(calibrated):
    """As the paper says: repeating the procedure with SR images (0.5 mm pixels) gives the same."""
    room, calibration = calibrated

    def seen_with_sr(setpoints_um, number):
        moved = yield from move(MoveTo(setpoints_um, "calibration"))
        estimate = calibration.estimate.moved_to(
            moved.readback_um, calibration.jacobian, GATE.noise
        )
        here = yield from look(
            ONE_FIDUCIAL,
            STRATEGIES["sr"].fine,
            replace(calibration, estimate=estimate),
            GATE,
            seed=(1, number),
            fresh=True,
        )
        return here.found.plane_mm / 0.5  # in pixels of the SR image

    places = [ORIGIN, {"xt": 15_000, "yt": 0}, {"xt": 15_000, "yt": 15_000}]
    first, second, third = (room.run(seen_with_sr(p, n)) for n, p in enumerate(places))
    sr_px_per_mm = np.stack([second - first, third - second], axis=1) / 15.0
    native_px_per_mm = calibration.jacobian.columns[:, (0, 2)] / 1.0
    # a circle in an SR image errs by about 0.2 of its pixels, a move by 1 %
    assert sr_px_per_mm == pytest.approx(2 * native_px_per_mm, abs=0.06)


@pytest.mark.parametrize("stop_um", [13_000, 11_000, 5_000])
def test_a_drive_into_the_hard_stop_is_no_calibration(make_room, stop_um):
    """The stages stand 10 mm and more beyond where they were said to: the way out is cut short."""
    room = make_room(seed=1, stages=StageParameters(travel_um=(-30_000.0, float(stop_um))))
    with pytest.raises(ProcedureFailedError) as failed:
        room.run(calibrate(calibration_arguments()))
    assert failed.value.code in ("calibration", "prediction_missed")


def calibrated_jacobian(make_room, seed, **stages):
    room = make_room(seed=seed, stages=StageParameters(**stages))
    return room.run(calibrate(calibration_arguments())).jacobian


@pytest.mark.parametrize("same_mount", [True, False])
def test_a_calibration_like_the_last_one_of_this_robot_is_taken(make_room, same_mount):
    last = calibrated_jacobian(make_room, 1).to_json()
    for seed in range(2, 8):
        again = calibration_arguments(last=last, same_mount=same_mount)
        make_room(seed=seed).run(calibrate(again))


@pytest.mark.parametrize("same_mount", [True, False])
def test_a_calibration_unlike_the_last_one_of_this_robot_is_refused(make_room, same_mount):
    last = calibrated_jacobian(make_room, 1).to_json()
    other = make_room(seed=2)
    other.nominal_step_um = dict.fromkeys(other.nominal_step_um, 4.5 / 0.8)
    with pytest.raises(ProcedureFailedError, match="differs from the last calibration"):
        other.run(calibrate(calibration_arguments(last=last, same_mount=same_mount)))


def test_a_robot_that_was_mounted_anew_may_be_turned_and_no_longer_than_before(make_room):
    jacobian = calibrated_jacobian(make_room, 1)
    turn = np.deg2rad(25)
    turned = replace(
        jacobian,
        columns=np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
        @ jacobian.columns,
    )
    turned.check_is_of_same_robot(jacobian, 0.015, same_mount=False)
    with pytest.raises(CalibrationError, match="differs from the last calibration"):
        turned.check_is_of_same_robot(jacobian, 0.015, same_mount=True)


def test_a_room_can_be_configured_with_every_strategy_and_with_no_other() -> None:
    assert set(STRATEGIES) == set(CONFIGURABLE)
