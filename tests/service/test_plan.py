"""A plan: the setpoints that bring the fiducial to the target, or the reason why not."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.procedure.estimate import FiducialEstimate
from service.procedure.jacobian import ImageJacobian
from service.procedure.plan import PlanRefusedError, Travel, check_travel, plan_move

COLUMNS = np.array([[0.02, 0.02, -0.99, -1.01], [1.0, 0.98, 0.03, 0.03]])
JACOBIAN = ImageJacobian(("xt", "yt"), COLUMNS, np.eye(8) * 1e-8)
TRAVEL = {"xt": Travel(-20_000, 20_000), "yt": Travel(-20_000, 20_000)}


def test_a_setpoint_that_fits_only_if_more_were_known_says_what_to_do():
    narrowed = {"xt": Travel(-9_741, 9_741, unsure_um=10_259)}
    with pytest.raises(PlanRefusedError, match=r"known only to within 10\.259 mm.*home it"):
        check_travel({"xt": 10_000}, narrowed)
    with pytest.raises(PlanRefusedError, match=r"to 20\.000 mm$"):
        check_travel({"xt": 20_001}, TRAVEL)


def planned(target, start_um=(1000, -500)):
    setpoints = dict(zip(("xt", "yt"), start_um, strict=True))
    estimate = FiducialEstimate(setpoints, np.array([-17.6, 5.3]), np.eye(2) * 1e-4)
    return estimate, plan_move(
        estimate, np.array(target), JACOBIAN, TRAVEL, measurement_id=7, plan_id="7.0"
    )


@given(st.floats(-10, 10), st.floats(-10, 10))
def test_the_planned_setpoints_bring_the_fiducial_to_the_target_within_a_micrometre(row, col):
    target = np.array([-17.6 + row, 5.3 + col])
    estimate, plan = planned(target)
    change = {a: (plan.setpoints_um[a] - estimate.setpoints_um[a]) / 1000 for a in ("xt", "yt")}
    displacement, _ = JACOBIAN.displacement(change)
    assert estimate.plane_mm + displacement == pytest.approx(target, abs=1.1e-3)
    assert all(isinstance(value, int) for value in plan.setpoints_um.values())


def test_a_plan_names_what_it_rests_on():
    estimate, plan = planned((-10.0, 5.0))
    assert plan.measurement_id == 7
    assert plan.from_um == estimate.setpoints_um


def test_a_target_out_of_reach_is_refused_with_axis_setpoint_and_limits():
    with pytest.raises(PlanRefusedError, match=r"axis xt: setpoint 2\d\.\d+ mm .* -20\.000 to 20"):
        planned((-17.6, 5.3 + 25.0))


@pytest.mark.parametrize("setpoint", [float("nan"), float("inf"), 20_001, -20_001])
def test_a_setpoint_that_is_not_inside_the_travel_is_refused(setpoint):
    with pytest.raises(PlanRefusedError, match="axis xt"):
        check_travel({"xt": setpoint}, TRAVEL)


def test_both_ends_of_the_travel_are_inside():
    check_travel({"xt": 20_000, "yt": -20_000}, TRAVEL)


def test_an_axis_without_limits_never_moves():
    with pytest.raises(PlanRefusedError, match="axis zt has no travel limits"):
        check_travel({"zt": 0}, TRAVEL)
