"""The mechanism: forward and inverse agree, the Jacobian is the derivative, limits hold."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.procedure.kinematics import (
    AXES,
    KinematicsError,
    Mechanism,
    NeedleLine,
    OutOfReachError,
    ball_joints,
    check_reach,
    depth_to_target_mm,
    fiducial_jacobian,
    fiducial_mm,
    guide_line,
    line_from_entry_and_target,
    line_from_fiducials,
    parallel_planes,
    reachable_rectangle_mm,
    stage_from_line,
    tip_mm,
)
from simulator.config import Fiducial, Placement
from simulator.scene import fiducial_in_robot_mm

TRAVEL = dict.fromkeys(AXES, (-20.0, 20.0))
positions = st.floats(-20, 20)
stages = st.tuples(positions, positions, positions, positions).map(
    lambda values: dict(zip(AXES, values, strict=True))
)
angles = st.floats(-30, 30)
alongs = st.floats(-40, 130)


def rigid(a_deg, b_deg, c_deg, offset):
    a, b, c = np.radians((a_deg, b_deg, c_deg))
    about_x = np.array([[1, 0, 0], [0, np.cos(a), -np.sin(a)], [0, np.sin(a), np.cos(a)]])
    about_y = np.array([[np.cos(b), 0, np.sin(b)], [0, 1, 0], [-np.sin(b), 0, np.cos(b)]])
    about_z = np.array([[np.cos(c), -np.sin(c), 0], [np.sin(c), np.cos(c), 0], [0, 0, 1]])
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = about_z @ about_y @ about_x, offset
    return matrix


mechanisms = st.builds(
    lambda base, a, b, c, height: Mechanism(
        base @ rigid(a / 10, b / 10, c / 10, (1.0, -2.0, height)), base, TRAVEL, 5.0
    ),
    st.builds(rigid, angles, angles, st.floats(-180, 180), st.just((5.0, 58.0, -17.0))),
    angles,
    angles,
    angles,
    st.floats(40, 120),
)


@given(mechanisms, stages)
def test_from_stage_to_line_and_back(mechanism, stage):
    again = stage_from_line(mechanism, guide_line(mechanism, stage))
    assert [again[axis] for axis in AXES] == pytest.approx([stage[a] for a in AXES], abs=1e-9)


@given(mechanisms, stages, st.floats(20, 60), st.floats(70, 130))
def test_from_two_fiducials_to_the_stages_between_or_above_the_planes(mechanism, stage, low, high):
    lower, upper = (fiducial_mm(mechanism, stage, along) for along in (low, high))
    line = line_from_fiducials(upper, lower, low)
    assert line.point_mm == pytest.approx(ball_joints(mechanism, stage)[1], abs=1e-8)
    again = stage_from_line(mechanism, line)
    assert [again[axis] for axis in AXES] == pytest.approx([stage[a] for a in AXES], abs=1e-7)


@given(mechanisms, stages, alongs)
def test_the_jacobian_is_the_derivative(mechanism, stage, along):
    jacobian = fiducial_jacobian(mechanism, stage, along)
    step = 1e-4
    for column, axis in enumerate(AXES):
        ahead = fiducial_mm(mechanism, {**stage, axis: stage[axis] + step}, along)
        behind = fiducial_mm(mechanism, {**stage, axis: stage[axis] - step}, along)
        assert jacobian[:, column] == pytest.approx((ahead - behind) / (2 * step), abs=1e-7)


@given(mechanisms, stages, alongs)
def test_a_fiducial_keeps_its_distance_from_the_lower_joint(mechanism, stage, along):
    _, lower = ball_joints(mechanism, stage)
    at = fiducial_mm(mechanism, stage, along)
    assert np.linalg.norm(at - lower) == pytest.approx(abs(along), abs=1e-9)


@given(stages, st.floats(1, 59))
def test_it_is_the_mechanism_that_the_virtual_room_has(stage, along):
    placement = Placement(scale=(1.0, 1.0), skew_deg=0.0)
    mechanism = parallel_planes(60.0, TRAVEL)
    guide = Fiducial(mount="guide", along_guide_mm=along)
    expected = fiducial_in_robot_mm(guide, placement, stage)
    found = fiducial_mm(mechanism, stage, along)
    # the room's origin lies in its top plane, ours in the bottom plane
    assert found == pytest.approx(expected + np.array([0.0, 0.0, 60.0]), abs=1e-9)


@given(mechanisms, stages, st.floats(30, 150))
def test_entry_and_target_give_the_line_through_both_and_its_depth(mechanism, stage, depth):
    line = guide_line(mechanism, stage)
    target, entry = tip_mm(line, depth), tip_mm(line, depth - 25.0)
    planned = line_from_entry_and_target(entry, target)
    again = stage_from_line(mechanism, planned)
    assert [again[axis] for axis in AXES] == pytest.approx([stage[a] for a in AXES], abs=1e-6)
    assert depth_to_target_mm(mechanism, line, target) == pytest.approx(depth + 5.0, abs=1e-9)
    assert line.distance_to_mm(target) < 1e-9


@given(stages)
def test_every_reachable_needle_ends_inside_the_reachable_rectangle(stage):
    mechanism = parallel_planes(60.0, TRAVEL)
    (x_low, x_high), (y_low, y_high) = reachable_rectangle_mm(mechanism, 80.0)
    line = guide_line(mechanism, stage)
    x, y, _ = line.at(-80.0 / line.direction[2])
    assert x_low - 1e-9 <= x <= x_high + 1e-9
    assert y_low - 1e-9 <= y <= y_high + 1e-9


def test_the_corners_of_the_reachable_rectangle_are_reached():
    mechanism = parallel_planes(60.0, TRAVEL)
    (x_low, x_high), _ = reachable_rectangle_mm(mechanism, 80.0)
    line = guide_line(mechanism, {"xt": -20.0, "yt": 0.0, "xb": 20.0, "yb": 0.0})
    assert line.at(-80.0 / line.direction[2])[0] == pytest.approx(x_high)
    assert x_low == pytest.approx(-x_high)


def test_a_line_along_the_planes_is_refused():
    with pytest.raises(KinematicsError, match="upper stage's plane"):
        stage_from_line(
            parallel_planes(60.0, TRAVEL), NeedleLine.through((0.0, 0.0, 10.0), (5.0, 0.0, 10.0))
        )


@pytest.mark.parametrize("value", [20.001, -20.001, float("nan"), float("inf")])
def test_a_stage_outside_its_travel_is_refused_by_name(value):
    mechanism = parallel_planes(60.0, TRAVEL)
    with pytest.raises(OutOfReachError, match=r"axis yb: .* outside its travel -20 to 20 mm"):
        check_reach(mechanism, {"xt": 0.0, "yt": 20.0, "xb": -20.0, "yb": value})


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"base_from_top": np.eye(3)}, "base_from_top must be 4 x 4"),
        ({"base_from_top": np.diag([2.0, 1, 1, 1])}, "base_from_top is not a rigid"),
        ({"base_from_bottom": np.full((4, 4), np.nan)}, "base_from_bottom must be"),
        ({"travel_mm": {"xt": (0.0, 1.0)}}, "axis yt has no travel"),
        ({"travel_mm": {**TRAVEL, "xb": (1.0, 1.0)}}, "axis xb: travel 1.0 to 1.0 mm is empty"),
    ],
)
def test_a_mechanism_that_cannot_be_is_refused(change, said):
    values = {"base_from_top": np.eye(4), "base_from_bottom": np.eye(4), "travel_mm": TRAVEL}
    with pytest.raises(KinematicsError, match=said):
        Mechanism(**{**values, **change})


def test_one_point_twice_is_no_line():
    with pytest.raises(KinematicsError, match="do not define a line"):
        NeedleLine.through((1.0, 2.0, 3.0), (1.0, 2.0, 3.0))


def test_planes_in_one_place_are_no_mechanism():
    with pytest.raises(KinematicsError, match="planes must differ"):
        parallel_planes(0.0, TRAVEL)
