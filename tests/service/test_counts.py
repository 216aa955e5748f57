"""Counts that drift are corrected by what the images show, and only where that is consistent."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from service.procedure.calibration import Calibration
from service.procedure.estimate import FiducialEstimate
from service.procedure.jacobian import ImageJacobian
from service.procedure.plane import ImagePlane
from service.room.counts.look import Look, corrections, is_comparable, look_of

AXES = ("xt", "yt")
TURN = np.array([[0.1, -0.99], [0.98, 0.12]])  # mm in the image by mm of each axis
PLANE = ImagePlane((0.0, 0.0, -1.0), (1.0, 0.0, 0.0), (1.0, 1.0))


def seen(true_mm: dict[str, float], counted_um: dict[str, int]) -> Calibration:
    at = TURN @ np.array([true_mm[axis] for axis in AXES])
    columns = np.repeat(TURN, 2, axis=1)
    return Calibration(
        ImageJacobian(AXES, columns, np.eye(8) * 1e-8),
        FiducialEstimate(counted_um, at, np.eye(2) * 0.02**2),
        PLANE,
        1,
    )


def look(true_mm: dict[str, float], counted_um: dict[str, int], bound_um: int, off_um: int = 0):
    calibration = seen(true_mm, counted_um)
    known = dict.fromkeys(AXES, bound_um)
    off = dict.fromkeys(AXES, off_um)
    return look_of(calibration, counted_um, off, known), calibration


REFERENCE, _ = look({"xt": 0.0, "yt": 0.0}, {"xt": 0, "yt": 0}, 300)


@pytest.mark.parametrize("drift_mm", [-3.1, 0.0, 14.3])
def test_a_count_that_has_drifted_is_put_right_whatever_happened_in_between(drift_mm: float):
    true_mm = {"xt": 4.0 + drift_mm, "yt": -2.0}
    now, calibration = look(true_mm, {"xt": 4000, "yt": -2000}, 15_000)
    found = corrections(REFERENCE, now, calibration)
    assert found is not None
    correction_um, within_um = found
    assert correction_um["xt"] == pytest.approx(drift_mm * 1000, abs=2)
    assert correction_um["yt"] == pytest.approx(0, abs=2)
    for axis, moved_mm in true_mm.items():  # 5 % of the way, three sigma, and the reference's own
        expected_um = 300 + 0.05 * abs(moved_mm) * 1000 + 3 * 20 / 0.98
        assert within_um[axis] == pytest.approx(expected_um, abs=5)


def test_what_is_known_better_already_is_left_as_it_is():
    now, calibration = look({"xt": 4.0, "yt": -2.0}, {"xt": 4000, "yt": -2000}, 100)
    assert corrections(REFERENCE, now, calibration) == ({}, {})


def test_what_contradicts_the_counts_corrects_nothing():
    """A table that moved by 10 mm, or another sphere: no count was that wrong."""
    now, calibration = look({"xt": 14.0, "yt": -2.0}, {"xt": 4000, "yt": -2000}, 400)
    assert corrections(REFERENCE, now, calibration) is None


def test_looks_in_another_plane_are_not_compared():
    now, _ = look({"xt": 0.0, "yt": 0.0}, {"xt": 0, "yt": 0}, 300)
    assert is_comparable(REFERENCE, now)
    assert not is_comparable(REFERENCE, replace(now, row_direction=(0.0, 1.0, 0.0)))
    assert not is_comparable(REFERENCE, replace(now, axes=("xt", "yt", "xb", "yb")))


def test_a_look_survives_the_record():
    assert Look.from_json(REFERENCE.to_json()) == REFERENCE
