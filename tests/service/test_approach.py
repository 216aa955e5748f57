"""Approaches in the offline room against the truth."""

from dataclasses import replace

import numpy as np
import pytest
from offline_arguments import approach_arguments, beside, calibration_arguments

from service.procedure.approach import approach
from service.procedure.calibration import calibrate
from service.procedure.estimate import FiducialEstimate
from service.procedure.observe import CONFIRM, REJECT, ProcedureFailedError
from service.procedure.steps import AskOperator, Measured, MoveTo
from simulator.config import Placement, StaticObject, VirtualRoom
from simulator.stage_physics import StageParameters
from studies.offline_room import MrImaging, OfflineRoom


def test_adaptive_is_as_accurate_as_promised_and_its_sigma_is_honest():
    """100 punctures: median <= 0.03 mm, 95 % <= 0.06 mm, <= 3 frames, 90 to 98 % inside 95 %."""
    errors, frames, normalised, iterations = [], [], [], []
    for seed in range(10):
        room = OfflineRoom(MrImaging(VirtualRoom()), StageParameters(), seed)
        calibration = room.run(calibrate(calibration_arguments()))
        home = calibration.estimate.plane_mm
        rng = np.random.default_rng(seed)
        for _ in range(10):
            target = home + rng.uniform(-6.0, 6.0, 2)
            before = room.frames
            arrival = room.run(approach(approach_arguments(target), calibration))
            calibration = arrival.calibration
            miss = room.true_plane_mm - calibration.estimate.plane_mm
            covariance = calibration.estimate.covariance_mm2
            normalised.append(miss @ np.linalg.solve(covariance, miss))
            errors.append(np.linalg.norm(room.true_plane_mm - target))
            frames.append(room.frames - before)
            iterations.append(arrival.iterations)
            assert arrival.frames == frames[-1]
            assert arrival.iterations <= 4
    assert np.median(errors) <= 0.03
    assert np.quantile(errors, 0.95) <= 0.06
    assert np.median(frames) <= 3
    assert 0.90 <= np.mean(np.array(normalised) < 5.99) <= 0.98


@pytest.mark.parametrize("strategy", ["base", "bicubic", "sr", "hybrid"])
def test_the_papers_strategies_end_within_a_pixel_by_the_papers_rule(calibrated, strategy):
    room, calibration = calibrated
    target = beside(calibration, 3.3, -4.1)
    arguments = approach_arguments(target, strategy=strategy, stop_rule="paper")
    arrival = room.run(approach(arguments, calibration))
    pixel = 0.5 if strategy in ("bicubic", "sr", "hybrid") else 1.0
    assert arrival.error_mm < pixel * np.sqrt(2)
    assert np.linalg.norm(room.true_plane_mm - target) < pixel
    assert np.array_equal(arrival.calibration.jacobian.columns, calibration.jacobian.columns)


def test_sr_takes_four_slices_a_look_and_returns_to_the_first_point(calibrated):
    room, calibration = calibrated
    target = beside(calibration, 3.3, -4.1)
    before, moves = room.frames, len(room.moves)
    arguments = approach_arguments(target, strategy="sr", stop_rule="paper", seed=5)
    arrival = room.run(approach(arguments, calibration))
    looks = arrival.iterations + 1
    assert room.frames - before == 4 * looks
    here = room.moves[moves:]
    assert len(here) == 5 * looks + arrival.iterations
    assert here[4] == here[0]  # the way back
    assert len({tuple(place.values()) for place in here[:4]}) == 4


def test_hybrid_takes_the_shift_set_only_at_the_end(calibrated):
    room, calibration = calibrated
    target = beside(calibration, 5.0, 5.0)
    before = room.frames
    arguments = approach_arguments(target, strategy="hybrid", stop_rule="paper")
    arrival = room.run(approach(arguments, calibration))
    assert arrival.iterations == 1
    assert room.frames - before == 1 + 1 + 4


def test_a_circle_transform_is_not_certain_enough_for_a_fine_tolerance(calibrated):
    room, calibration = calibrated
    target = beside(calibration, 1.0, 1.0)
    with pytest.raises(ProcedureFailedError, match=r"not reached in 3 moves: .* P\(error < 0.06"):
        room.run(
            approach(approach_arguments(target, strategy="base", max_iterations=3), calibration)
        )


def test_where_it_already_stands_it_looks_once_before_it_says_ready(calibrated):
    room, calibration = calibrated
    frames, moves = room.frames, len(room.moves)
    arrival = room.run(approach(approach_arguments(calibration.estimate.plane_mm), calibration))
    assert room.frames > frames
    assert arrival.iterations == 0
    assert len(room.moves) == moves


@pytest.mark.parametrize("cancels", [True, False])
def test_what_draws_a_disc_averages_out_only_where_it_drew_the_target_alike(calibrated, cancels):
    """READY at the fiducial's own place; in tissue no number of looks makes it sure."""
    room, calibration = calibrated
    drawn_mm = 0.04
    target = calibration.estimate.plane_mm

    def run():
        step = next(steps)
        while True:
            outcome = room.execute(step)
            if isinstance(outcome, Measured):
                wider = np.array(outcome.covariance_mm2) + np.eye(2) * drawn_mm**2
                (a, b), (c, d) = wider.tolist()
                outcome = replace(
                    outcome, covariance_mm2=((a, b), (c, d)), common_mm=(drawn_mm, drawn_mm)
                )
            try:
                step = steps.send(outcome)
            except StopIteration as finished:
                return finished.value

    unsure = replace(calibration.estimate, covariance_mm2=np.eye(2))
    steps = approach(
        approach_arguments(target, common_cancels=cancels), replace(calibration, estimate=unsure)
    )
    if cancels:
        assert run().probability >= 0.95
    else:
        with pytest.raises(
            ProcedureFailedError, match=r"not reached in 8 moves: .* P\(error < 0.06"
        ):
            run()


def test_every_move_waits_for_confirmation_and_a_rejection_holds_it(make_room, calibrated):
    _, calibration = calibrated
    asked = []

    def reject(question: AskOperator) -> str:
        asked.append(question)
        return REJECT

    room = make_room(seed=3, answer=reject)
    room.setpoints_um = dict(calibration.estimate.setpoints_um)
    target = beside(calibration, 1.0, 1.0)
    with pytest.raises(ProcedureFailedError, match="rejected by operator"):
        room.run(approach(approach_arguments(target), calibration))
    assert room.moves == []
    assert asked[0].choices == (CONFIRM, REJECT)
    assert asked[0].plan["displacement_mm"] == pytest.approx((1.0, 1.0))


def test_a_target_out_of_reach_moves_nothing(calibrated):
    room, calibration = calibrated
    moves = len(room.moves)
    target = beside(calibration, 0.0, 40.0)
    with pytest.raises(ProcedureFailedError, match=r"axis xt: setpoint \d+\.\d+ mm is outside"):
        room.run(approach(approach_arguments(target), calibration))
    assert len(room.moves) == moves


def test_h10_a_motor_that_was_turned_round_drives_the_robot_once_not_twice(calibrated):
    room, calibration = calibrated
    stage = room.stages["xt"]
    stage.parameters = replace(stage.parameters, mounting=-1)
    moves = len(room.moves)
    target = beside(calibration, 0.0, 1.2)
    with pytest.raises(ProcedureFailedError) as failure:
        room.run(approach(approach_arguments(target), calibration))
    assert failure.value.code == "prediction_missed"
    assert len(room.moves) == moves + 1


@pytest.mark.parametrize("slip_mm", [0.5, 2.0])
def test_h10_a_stage_that_slips_is_noticed_before_the_next_move(calibrated, slip_mm):
    room, calibration = calibrated
    moves = len(room.moves)
    room.stages["yt"].displace(slip_mm * 1000)
    target = beside(calibration, 0.5, 0.5)
    with pytest.raises(ProcedureFailedError, match="calibrate again"):
        room.run(approach(approach_arguments(target), calibration))
    assert len(room.moves) == moves + 1


def test_h10_a_wrong_scale_is_noticed(calibrated):
    room, calibration = calibrated
    stage = room.stages["xt"]
    stage.parameters = replace(stage.parameters, step_um=4.5 * 1.3)
    target = beside(calibration, 0.0, 6.0)
    with pytest.raises(ProcedureFailedError, match="calibrate again"):
        room.run(approach(approach_arguments(target), calibration))


def test_h11_another_round_object_is_not_taken_for_the_fiducial(calibrated):
    room, calibration = calibrated
    target = beside(calibration, 2.0, 2.0)
    decoy = StaticObject(
        kind="sphere", centre_mm=(5.3 + 12.0, 58.0, -17.6), radius_mm=4.0, signal=1.4
    )
    room.imaging = MrImaging(VirtualRoom(background=(decoy,)))
    room.run(approach(approach_arguments(target), calibration))
    assert np.linalg.norm(room.true_plane_mm - target) < 0.06


def test_h11_when_only_the_other_object_is_left_nothing_is_believed(calibrated):
    room, calibration = calibrated
    target = beside(calibration, 2.0, 2.0)
    decoy = StaticObject(kind="sphere", centre_mm=(17.3, 58.0, -17.6), radius_mm=4.0, signal=1.0)
    away = Placement(origin_mm=(5.3, 90.0, -17.6))
    room.imaging = MrImaging(VirtualRoom(background=(decoy,), placement=away))
    with pytest.raises(ProcedureFailedError, match="no usable measurement"):
        room.run(approach(approach_arguments(target), calibration))


def test_more_slices_only_where_they_decide():
    arguments = approach_arguments((0.0, 0.0))

    def wanted(error_mm, sigma_mm):
        estimate = FiducialEstimate({}, np.array([error_mm, 0.0]), np.eye(2) * sigma_mm**2)
        return arguments.frames_wanted(estimate, 1)

    assert wanted(0.0, 0.01) == 1
    assert wanted(0.0, 0.03) == 2
    assert wanted(0.0, 0.5) == 1  # no number of slices would do
    assert wanted(0.05, 0.02) == 1  # a move is worth more


def test_the_same_outcomes_lead_to_the_same_steps(calibrated):
    room, calibration = calibrated
    target = beside(calibration, 2.0, -1.0)
    arguments = approach_arguments(target, strategy="sr", stop_rule="paper", seed=9)
    recorded = []
    procedure = approach(arguments, calibration)
    step = next(procedure)
    for _ in range(100):
        outcome = room.execute(step)
        recorded.append((step, outcome))
        try:
            step = procedure.send(outcome)
        except StopIteration as finished:
            first = finished.value
            break
    again = approach(arguments, calibration)
    step = next(again)
    for known, outcome in recorded:
        assert step == known
        try:
            step = again.send(outcome)
        except StopIteration as finished:
            second = finished.value
    assert second.to_json() == first.to_json()


def test_a_stopped_move_is_never_asked_for_again(calibrated):
    room, calibration = calibrated
    target = beside(calibration, 2.0, -1.0)
    before = len(room.moves)
    room.stop_next_moves = 1
    with pytest.raises(ProcedureFailedError, match="was stopped during the move"):
        room.run(approach(approach_arguments(target), calibration))
    assert len(room.moves) <= before + 1


def test_the_first_step_of_an_uncertain_start_is_to_look(calibrated):
    _, calibration = calibrated
    unsure = replace(calibration.estimate, covariance_mm2=np.eye(2) * 25.0)
    steps = approach(
        approach_arguments(calibration.estimate.plane_mm + 1.0),
        replace(calibration, estimate=unsure),
    )
    assert not isinstance(next(steps), MoveTo)
