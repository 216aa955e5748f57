"""The image Jacobian against a known linear stage with directions of unequal step length."""

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.procedure.jacobian import CalibrationError, ImageJacobian

AXES = ("xt", "yt")
angles = st.floats(-180, 180)
scales = st.floats(0.8, 1.25)
asymmetries = st.floats(-0.03, 0.03)
changes = st.floats(-20, 20)


def columns_of(angle_deg, first, second, asymmetry):
    a = np.radians(angle_deg)
    x = first * np.array([np.sin(a), np.cos(a)])
    y = second * np.array([np.cos(a), -np.sin(a)])
    up, down = 1 + asymmetry, 1 - asymmetry
    return np.stack([x * up, x * down, y * up, y * down], axis=1)


def learnt(columns, moves, sigma_mm=1e-4, rng=None):
    jacobian = ImageJacobian.unknown(AXES)
    truth = ImageJacobian(AXES, columns, np.eye(8))
    for change in moves:
        change_mm = dict(zip(AXES, change, strict=True))
        displacement, _ = truth.displacement(change_mm)
        if rng is not None:
            displacement = displacement + rng.normal(0, sigma_mm, 2)
        jacobian = jacobian.updated(change_mm, displacement, np.eye(2) * sigma_mm**2)
    return jacobian


@given(angles, scales, scales, asymmetries)
def test_two_long_moves_and_the_way_back_give_the_mean_of_both_directions(angle, a, b, asymmetry):
    columns = columns_of(angle, a, b, asymmetry)
    jacobian = learnt(columns, [(15.0, 0.0), (0.0, 15.0), (-15.0, 0.0), (0.0, -15.0)])
    assert jacobian.columns == pytest.approx(columns, abs=2e-4)


@given(angles, scales, scales, asymmetries, changes, changes)
def test_a_planned_change_displaces_the_fiducial_by_what_was_wanted(
    angle, a, b, asymmetry, row, col
):
    jacobian = ImageJacobian(AXES, columns_of(angle, a, b, asymmetry), np.eye(8) * 1e-8)
    change = jacobian.setpoint_change_mm(np.array([row, col]))
    displacement, _ = jacobian.displacement(change)
    assert displacement == pytest.approx([row, col], abs=1e-9)


def test_its_covariance_is_what_repeated_calibrations_scatter_by():
    columns = columns_of(31.0, 1.01, 0.97, 0.015)
    rng = np.random.default_rng(5)
    moves = [(15.0, 0.0), (0.0, 15.0), (-15.0, -15.0), (4.0, 0.0), (0.0, 4.0)]
    found = [learnt(columns, moves, sigma_mm=0.05, rng=rng) for _ in range(400)]
    change = {"xt": 8.0, "yt": 5.0}
    truth, _ = ImageJacobian(AXES, columns, np.eye(8)).displacement(change)
    misses = np.array([jacobian.displacement(change)[0] - truth for jacobian in found])
    _, predicted = found[0].displacement(change)
    normalised = np.einsum("ki,ij,kj->k", misses, np.linalg.inv(predicted), misses)
    assert 1.7 < normalised.mean() < 2.3


def test_a_short_move_changes_it_less_than_a_long_one():
    columns = columns_of(0.0, 1.0, 1.0, 0.0)
    jacobian = learnt(columns, [(15.0, 0.0), (0.0, 15.0)], sigma_mm=0.01)
    noise = np.eye(2) * 0.01**2
    wrong = np.array([0.0, 0.1])  # the move missed by this much
    after = {}
    for length in (0.5, 15.0):
        change = {"xt": length, "yt": 0.0}
        displacement, _ = jacobian.displacement(change)
        update = jacobian.updated(change, displacement + wrong, noise)
        after[length] = float(np.abs(update.columns - jacobian.columns).max())
    assert after[0.5] < after[15.0] / 5


def test_a_move_that_was_not_seen_is_no_calibration():
    jacobian = learnt(np.zeros((2, 4)), [(15.0, 0.0), (0.0, 15.0)])
    with pytest.raises(CalibrationError, match=r"axis xt: .* expected 0\.6 to 1\.6"):
        jacobian.check()


def test_two_axes_along_one_line_are_no_calibration():
    columns = columns_of(0.0, 1.0, 1.0, 0.0)
    columns[:, 2:] = columns[:, :2] * 1.01
    jacobian = learnt(columns, [(15.0, 0.0), (0.0, 15.0)])
    with pytest.raises(CalibrationError, match="only 0° apart"):
        jacobian.check()


def test_its_json_form_is_lossless():
    jacobian = learnt(columns_of(12.3, 1.01, 0.98, 0.02), [(15.0, 0.0), (0.0, 15.0)])
    again = ImageJacobian.from_json(json.loads(json.dumps(jacobian.to_json())))
    assert again.axes == jacobian.axes
    assert np.array_equal(again.columns, jacobian.columns)
    assert np.array_equal(again.covariance, jacobian.covariance)
