"""Step lengths per direction: from readings, from an encoder, from an instrument."""

import random

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pmd_rig import axis_config, finish, opened, rig

from robot_bridge.daemon.motors import MotorError
from robot_bridge.emulator.physics import IdealStage
from robot_bridge.engineer.calibrate_steps import (
    CalibrationError,
    StepReading,
    calibrate_steps,
    step_lengths,
)
from simulator.stage_physics import PiezoLegsStage, StageParameters


class Asymmetric(IdealStage):
    def drive(self, microsteps: int, frequency_hz: float) -> None:
        self._step_length_um = 4.4 if microsteps > 0 else 4.2
        super().drive(microsteps, frequency_hz)


@given(
    forward_um=st.floats(1.0, 8.0),
    reverse_um=st.floats(1.0, 8.0),
    steps=st.lists(st.integers(10, 2000), min_size=2, max_size=6),
    sign=st.sampled_from([1, -1]),
)
def test_exact_readings_give_exact_lengths(forward_um, reverse_um, steps, sign):
    readings = [StepReading(n, sign * n * forward_um) for n in steps]
    readings += [StepReading(-n, -sign * n * reverse_um) for n in steps]
    found = step_lengths("xt", sign, readings)
    assert found.forward.step_um == pytest.approx(forward_um)
    assert found.reverse.step_um == pytest.approx(reverse_um)
    assert found.forward.scatter == pytest.approx(0, abs=1e-9)
    assert found.asymmetry == pytest.approx(
        2 * (forward_um - reverse_um) / (forward_um + reverse_um)
    )


def test_scatter_is_reported_as_it_is():
    rng = random.Random(4)
    readings = [StepReading(500, 500 * 4.5 * (1 + rng.gauss(0, 0.01))) for _ in range(400)]
    readings += [StepReading(-500, -500 * 4.3 * (1 + rng.gauss(0, 0.01))) for _ in range(400)]
    found = step_lengths("xt", 1, readings)
    assert found.forward.scatter == pytest.approx(0.01, rel=0.15)
    assert abs(found.forward.step_um - 4.5) < 4 * found.forward.sigma_um
    assert found.forward.sigma_um == pytest.approx(4.5 * 0.01 / 20, rel=0.15)


@pytest.mark.parametrize(
    ("readings", "named"),
    [
        (
            [(100, 450.0), (-100, -450.0), (-100, -450.0)],
            "at least 2 readings forward needed, got 1",
        ),
        ([(100, 450.0), (100, -450.0)], "contradicts its sign"),
        ([(100, float("nan"))], "reading 1"),
        ([(0, 450.0)], "reading 1"),
        ([(100, 9000.0)], r"outside 0\.1\.\.20\.0 um"),
        ([], "at least 2 readings forward needed, got 0"),
    ],
)
def test_readings_that_make_no_sense_are_named(readings, named):
    with pytest.raises(CalibrationError, match=named):
        step_lengths("xt", 1, [StepReading(*r) for r in readings])


def test_the_encoder_measures_the_steps_of_the_motor():
    with rig(stage=Asymmetric) as made, opened(made, "closed_loop") as motors:
        axis = axis_config("xt", made.url, 1, "closed_loop")
        found = calibrate_steps(motors, axis, steps=300, runs=2)
        assert found.forward.step_um == pytest.approx(4.4, abs=0.001)
        assert found.reverse.step_um == pytest.approx(4.2, abs=0.001)
        fields = found.as_fields()
        assert (fields["step_um_forward"], fields["step_um_reverse"]) == (4.4, 4.2)


@pytest.mark.parametrize("sign", [1, -1])
def test_an_instrument_does_it_without_an_encoder_and_open_loop_moves_then_arrive(sign: int):
    with rig(stage=Asymmetric) as made:
        with opened(made, sign=sign) as motors:
            found = calibrate_steps(
                motors,
                axis_config("xt", made.url, 1, sign=sign),
                steps=300,
                runs=2,
                read_um=lambda what: sign * made.position_um(1),
            )
        lengths = {
            "step_um_forward": found.forward.step_um,
            "step_um_reverse": found.reverse.step_um,
        }
        start_um = made.position_um(1)
        with opened(made, sign=sign, **lengths) as motors:
            motors.move_to({"xt": 3000})
            finish(motors)
            assert made.position_um(1) - start_um == pytest.approx(sign * 3000, abs=1)
            motors.move_to({"xt": -500})
            finish(motors)
            assert made.position_um(1) - start_um == pytest.approx(-sign * 500, abs=1)


def test_without_encoder_and_without_readings_it_is_refused():
    with rig() as made, opened(made) as motors:
        with pytest.raises(CalibrationError, match="axis xt has no encoder"):
            calibrate_steps(motors, axis_config("xt", made.url, 1), steps=10, runs=2)
        with pytest.raises(MotorError, match="open loop"):
            motors.measure_um("xt")
        assert made.runs() == 0


def test_a_run_that_could_leave_the_travel_is_refused():
    with rig() as made, opened(made, travel_max_um=1000) as motors:
        with pytest.raises(MotorError, match="beyond_travel"):
            motors.run_steps("xt", 200)  # 900 um, and twice that if the steps are longer
        with pytest.raises(MotorError, match="bad_run"):
            motors.run_steps("xt", 0)
        assert made.runs() == 0


def test_calibrated_steps_of_a_rough_motor_are_within_their_own_uncertainty():
    class Rough(PiezoLegsStage):
        def __init__(self) -> None:
            super().__init__(
                StageParameters(has_encoder=True, repeatability_um=0.0), 0.0, random.Random(11)
            )

    with rig(stage=Rough) as made, opened(made, "closed_loop") as motors:
        axis = axis_config("xt", made.url, 1, "closed_loop")
        found = calibrate_steps(motors, axis, steps=200, runs=12)
        true_um = 4.5 * (1 - 0.045 * 0.176)
        assert found.forward.scatter == pytest.approx(0.01, rel=0.6)
        expected_um = true_um * (1 - 0.5 * 0.05) * 1.015
        assert abs(found.forward.step_um - expected_um) < 4 * found.forward.sigma_um
        assert found.asymmetry == pytest.approx(0.03 - 0.05, abs=0.015)  # load helps in reverse
