"""Arguments of the procedures as the default room has them."""

import numpy as np

from service.procedure.aim import ApproachArguments
from service.procedure.calibration import Calibration, CalibrationArguments
from service.procedure.observe import ValidationGate
from sr_engine.reconstruction.shiftset import named

GATE = ValidationGate(
    position_gate_mm=3.0, gate_sigma=5.0, repeatability_mm=0.014, scale_error=0.015
)


def calibration_arguments(**changes) -> CalibrationArguments:
    values = {
        "axes": ("xt", "yt"),
        "origin_um": {"xt": 0, "yt": 0},
        "move_um": 15_000,
        "shifts_px": named("single").shifts_px,
        "gate": GATE,
    }
    return CalibrationArguments(**{**values, **changes})


def approach_arguments(target_mm, **changes) -> ApproachArguments:
    values = {
        "target_mm": tuple(float(x) for x in target_mm),
        "travel_um": {"xt": (-20_000, 20_000), "yt": (-20_000, 20_000)},
        "tolerance_mm": 0.06,
        "confidence": 0.95,
        "max_iterations": 8,
        "confirm_moves": True,
        "gate": GATE,
    }
    return ApproachArguments(**{**values, **changes})


def beside(calibration: Calibration, row_mm: float, col_mm: float) -> np.ndarray:
    """A target so far from where the fiducial was last seen."""
    return calibration.estimate.plane_mm + np.array([row_mm, col_mm])
