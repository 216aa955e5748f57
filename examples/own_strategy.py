"""A strategy of one's own, tried in the virtual room beside the default.

python examples/own_strategy.py
"""

import numpy as np

from service.procedure.aim import ApproachArguments
from service.procedure.approach import approach
from service.procedure.calibration import CalibrationArguments, calibrate
from service.procedure.observe import ValidationGate
from service.procedure.strategies import STRATEGIES, Imaging, Strategy
from simulator.config import VirtualRoom
from simulator.stage_physics import StageParameters
from sr_engine.reconstruction.shiftset import named
from studies.offline_room import MrImaging, OfflineRoom

# one native image while it is far, the paper's reconstruction near the target, moves remembered
MINE = Strategy(coarse=Imaging("ml"), fine=Imaging("sr", shifted=True, factor=2), fuses=True)

GATE = ValidationGate(3.0, gate_sigma=5.0, repeatability_mm=0.014, scale_error=0.015)
AXES, TRAVEL_UM = ("xt", "yt"), (-20_000, 20_000)

for name, strategy in (("mine", MINE), ("adaptive", STRATEGIES["adaptive"])):
    errors_mm, frames = [], []
    for seed in range(3):
        room = OfflineRoom(MrImaging(VirtualRoom()), StageParameters(), seed)
        origin_um = dict.fromkeys(AXES, 0)
        shifts_px = named("single").shifts_px
        calibration = room.run(
            calibrate(CalibrationArguments(AXES, origin_um, 15_000, shifts_px, GATE))
        )
        target_mm = calibration.estimate.plane_mm + np.array([3.0, -4.0])
        arguments = ApproachArguments(
            target_mm=tuple(target_mm), travel_um=dict.fromkeys(AXES, TRAVEL_UM),
            tolerance_mm=0.15, confidence=0.95, max_iterations=8, confirm_moves=True,
            gate=GATE, strategy=strategy,
        )  # fmt: skip
        arrival = room.run(approach(arguments, calibration))
        errors_mm.append(float(np.hypot(*(room.true_plane_mm - target_mm))))
        frames.append(arrival.frames)
    print(f"{name}: mean true error {np.mean(errors_mm):.3f} mm with {np.mean(frames):.1f} slices")
