"""Every driver that there is, and the one of the examples, keeps to the seam."""

import importlib.util
from pathlib import Path

from motors_conformance import check_motors
from pmd_rig import axis_config, rig

from robot_bridge.pmd.driver import PmdMotors

EXAMPLE = Path(__file__).parents[2] / "examples" / "own_motor.py"


def test_the_driver_of_the_examples_keeps_to_the_seam():
    spec = importlib.util.spec_from_file_location("own_motor", EXAMPLE)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    check_motors(
        module.PerfectMotors({"xt": (-20_000, 20_000), "yt": (-20_000, 20_000)}), "xt", "yt"
    )


def test_the_driver_of_the_pmd_controllers_keeps_to_the_seam():
    with rig((1, 2)) as running:
        axes = [axis_config(name, running.url, address) for name, address in (("xt", 1), ("yt", 2))]
        check_motors(PmdMotors(axes, timeout_s=0.5), "xt", "yt")
