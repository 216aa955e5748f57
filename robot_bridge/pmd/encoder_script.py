"""The controller's own script (`Y25`) that finds its encoder's direction and gain.

It runs 16 waveform steps forward and back, some 70 um, and writes Y6 and Y11.
"""

from dataclasses import dataclass

from robot_bridge.pmd.axis import PmdAxis
from robot_bridge.pmd.controller import POLL_PAUSE_S, Steps
from robot_bridge.pmd.line import Pause
from robot_bridge.pmd.protocol import Command
from robot_bridge.pmd.setup import verify

SCRIPT_STEPS = 16
SCRIPT_DEADLINE_S = 6.0
STEPS_PER_COUNT_SCALE = 65536 * 4  # Y11 times the counts of one waveform step


@dataclass(frozen=True)
class EncoderFound:
    """direction: Y6. counts_per_step: of one waveform step, mean of both ways."""

    direction: int
    counts_per_step: float


def find_encoder(axis: PmdAxis) -> Steps[EncoderFound]:
    """Unpark, run the script, read what it found. Raises PmdError.

    The axis has to be set up again afterwards: its gain is the script's.
    """
    yield from verify(axis)
    yield from axis.unpark()
    axis.needs_setup = True
    axis.lose_position()  # it may count the other way from now on
    yield from axis.withdraw_mark()
    axis.at_rest_um = None
    yield Command(axis.address, "Y25,1", reads=False, repeatable=False)
    until_s = axis.clock() + SCRIPT_DEADLINE_S
    while True:
        yield Pause(POLL_PAUSE_S)
        state = (yield from axis.ask("Y25")).integers()
        if state[-1] != 1:
            break
        if axis.clock() > until_s:
            raise axis.error("script", f"the script is still running after {SCRIPT_DEADLINE_S:g} s")
    if state[-1] != 0:
        raise axis.error("script", f"the encoder did not follow the motor (Y25 reads {state})")
    direction = (yield from axis.ask("Y6")).integer()
    gain = (yield from axis.ask("Y11")).integer()
    if gain < 1:
        raise axis.error("script", f"Y11 reads {gain}")
    return EncoderFound(direction, STEPS_PER_COUNT_SCALE / gain)
