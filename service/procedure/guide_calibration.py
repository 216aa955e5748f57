"""Calibration with four axes: how both fiducials of the guide follow each of them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.procedure.calibration import (
    DISC,
    Calibration,
    Templates,
    check_is_as_last,
    drive_and_learn,
)
from service.procedure.estimate import FiducialEstimate
from service.procedure.guide_geometry import GuideGeometry
from service.procedure.guide_looking import BothSeen, gates, see_both
from service.procedure.jacobian import SMALLEST_ANGLE_DEG, ImageJacobian
from service.procedure.observe import (
    ML,
    TEMPLATE,
    Expectation,
    ProcedureFailedError,
    ValidationGate,
    measure_step,
)
from service.procedure.steps import HoldShift, Measured, ProcedureSteps, ask

Array = NDArray[np.float64]
_FIRST_GATE = 1.4
_SHARE_TOLERANCE = 0.35


@dataclass(frozen=True)
class GuideCalibrationArguments:
    """axes: the top stage's two, then the bottom stage's two.

    last: this robot's last image Jacobian with four axes; same_mount: not mounted anew since.
    """

    axes: tuple[str, str, str, str]
    origin_um: Mapping[str, int]
    move_um: int
    geometry: GuideGeometry
    gate: ValidationGate
    localization: str = DISC
    last: Mapping[str, Any] | None = None
    same_mount: bool = False


def calibrate_guide(arguments: GuideCalibrationArguments) -> ProcedureSteps[Calibration]:
    """Move every axis once, and all of them back; learn how both fiducials follow."""

    def look(
        before: FiducialEstimate | None, predicted: FiducialEstimate | None
    ) -> ProcedureSteps[BothSeen]:
        expected = _expectations(arguments, before, predicted)
        by_template = arguments.localization == TEMPLATE
        return (yield from see_both(arguments.geometry, expected, any_shape=by_template))

    def look_by_template(
        last: BothSeen, expected: FiducialEstimate, templates: Templates
    ) -> ProcedureSteps[tuple[Measured, ...]]:
        answers = []
        places = zip(
            last.acquired,
            gates(expected, arguments.gate),
            arguments.geometry.slice_positions_mm,
            templates,
            strict=True,
        )
        for acquired, expectation, at_mm, template in places:
            holds = (HoldShift(acquired.hold_id, (0.0, 0.0)),)
            step = measure_step(holds, ML, expectation, slice_position_mm=at_mm, template=template)
            answers.append((yield from ask(step, Measured)))
        return tuple(answers)

    found = yield from drive_and_learn(
        _places(arguments),
        ImageJacobian.unknown(arguments.axes),
        arguments.gate,
        look,
        lambda jacobian: _check_shares(jacobian, arguments.geometry),
        look_by_template if arguments.localization == TEMPLATE else None,
    )
    check_is_as_last(found, arguments.last, arguments.gate, same_mount=arguments.same_mount)
    return found


def _places(arguments: GuideCalibrationArguments) -> list[dict[str, int]]:
    places = [dict(arguments.origin_um)]
    for axis in arguments.axes:
        places.append({**places[-1], axis: places[-1][axis] + arguments.move_um})
    return [*places, dict(arguments.origin_um)]


def _expectations(
    arguments: GuideCalibrationArguments,
    before: FiducialEstimate | None,
    predicted: FiducialEstimate | None,
) -> tuple[Expectation | None, Expectation | None]:
    if before is None:
        return None, None
    if predicted is not None:
        return gates(predicted, arguments.gate)
    geometry = arguments.geometry
    lever = max(1.0, geometry.upper_along_mm / geometry.joints_apart_mm)
    reach_mm = _FIRST_GATE * lever * abs(arguments.move_um) / 1000
    gate_mm = max(arguments.gate.position_gate_mm, reach_mm)
    return Expectation(before.plane_mm[:2], gate_mm), Expectation(before.plane_mm[2:], gate_mm)


def _check_shares(jacobian: ImageJacobian, geometry: GuideGeometry) -> None:
    """Refuse unless each stage moves each fiducial by the share of the lever that it must have.

    Two fiducials that were taken for each other, one that was lost, and an axis that does not move
    all show here.
    """
    matrix = jacobian.mean_columns
    names, alongs = ("upper", "lower"), (geometry.upper_along_mm, geometry.lower_along_mm)
    shares = np.array([along / geometry.joints_apart_mm for along in alongs])
    swapped = shares[::-1]
    found = np.array(
        [[np.linalg.norm(matrix[2 * f : 2 * f + 2, a]) for a in (0, 1)] for f in (0, 1)]
    )
    if np.all(np.abs(found - swapped[:, None]) < np.abs(found - shares[:, None])):
        raise ProcedureFailedError(
            "fiducials_swapped",
            "the two fiducials appear to be swapped: check the slice positions of the upper and "
            "the lower one",
        )
    for number, axis in enumerate(jacobian.axes):
        for fiducial, (name, share) in enumerate(zip(names, shares, strict=True)):
            expected = abs(share if number < 2 else 1 - share)
            length = float(np.linalg.norm(matrix[2 * fiducial : 2 * fiducial + 2, number]))
            if not abs(length - expected) <= _SHARE_TOLERANCE:
                raise ProcedureFailedError(
                    "calibration",
                    f"axis {axis}: the {name} fiducial moved {length:.2f} mm per mm of setpoint, "
                    f"expected {expected:.2f}; did the robot move?",
                )
    for pair in ((0, 1), (2, 3)):
        _check_angle(jacobian, pair, shares if pair == (0, 1) else 1 - shares)


def _check_angle(jacobian: ImageJacobian, pair: tuple[int, int], shares: Array) -> None:
    """Refuse two axes of one stage that move the guide along (nearly) one line."""
    matrix = jacobian.mean_columns
    # seen by the fiducial that this stage moves most
    rows = slice(0, 2) if abs(shares[0]) >= abs(shares[1]) else slice(2, 4)
    one, other = (matrix[rows, number] for number in pair)
    cosine = abs(float(one @ other)) / float(np.linalg.norm(one) * np.linalg.norm(other))
    angle_deg = float(np.degrees(np.arccos(min(1.0, cosine))))
    if not angle_deg >= SMALLEST_ANGLE_DEG:
        first, second = (jacobian.axes[number] for number in pair)
        raise ProcedureFailedError(
            "calibration",
            f"axes {first} and {second} move the guide along lines only {angle_deg:.0f}° apart, "
            f"expected at least {SMALLEST_ANGLE_DEG:.0f}°: are two axis cables swapped?",
        )
