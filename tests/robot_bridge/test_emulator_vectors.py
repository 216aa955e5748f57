"""The exchanges that the controllers' manuals print, against the emulator, byte by byte."""

import itertools
import random

import pytest

from robot_bridge.emulator.axis import EmulatedController, Motor
from robot_bridge.emulator.bus import EmulatedBus
from robot_bridge.emulator.physics import IdealStage
from robot_bridge.emulator.switches import Switches


class Bench:
    """A bus with a clock of its own: `say` sends a line and returns all that is answered."""

    def __init__(
        self,
        addresses: tuple[int, ...] = (0,),
        switches: Switches | None = None,
        motor: Motor | None = None,
        stage: IdealStage | None = None,
    ) -> None:
        self.now_s = 100.0
        chosen = switches or Switches()
        self.controllers = [
            EmulatedController(a, stage or IdealStage(), motor or Motor(), chosen, self.now_s)
            for a in addresses
        ]
        self.bus = EmulatedBus(self.controllers, chosen, random.Random(1))

    def say(self, data: bytes, wait_s: float = 0.2) -> bytes:
        self.bus.receive(data, self.now_s)
        return self.wait(wait_s)

    def wait(self, seconds: float) -> bytes:
        heard = b""
        until_s = self.now_s + seconds
        while self.now_s < until_s:
            self.now_s = min(until_s, self.now_s + 0.005)
            self.bus.advance(self.now_s)
            heard += self.bus.take_output(self.now_s)
        return heard


class LongerForward(IdealStage):
    """Steps forward are longer than steps back, so there and back does not close."""

    def drive(self, microsteps: int, frequency_hz: float) -> None:
        self._step_length_um = 4.5 * (1.03 if microsteps > 0 else 1.0)
        super().drive(microsteps, frequency_hz)


def unparked(bench: Bench) -> Bench:
    for controller in bench.controllers:
        bench.say(f"X{controller.address}M2\r".encode())
    return bench


def test_the_first_session_of_the_manual():
    stage = LongerForward(4.5)
    bench = Bench(motor=Motor(um_per_count=0.43), stage=stage)
    assert bench.say(b"XM2\r") == b"XM2\r"
    assert bench.say(b"XE\r") == b"XE:0\r"
    assert bench.say(b"XJ200,0,100\r", 2.2) == b"XJ200,0,100\r"
    assert bench.say(b"XJ-200,0,500\r", 0.6) == b"XJ-200,0,500\r"
    # The way back is shorter than the way there: 3 % of 200 steps at 0.43 um a count.
    assert bench.say(b"XE\r") == b"XE:63\r"
    bench.say(b"XY11,25000\r")
    assert bench.say(b"XT20\r", 1.0) == b"XT20\r"
    timer = bench.say(b"XY23\r")
    assert timer.startswith(b"XY23:")
    assert timer.endswith(b",1\r")
    count = int(bench.say(b"XE\r").removeprefix(b"XE:"))
    assert abs(count - 20) <= 1
    assert bench.say(b"XS\r") == b"XS\r"
    assert bench.say(b"XM4\r", 0.3) == b"XM4\r"
    assert bench.say(b"XM\r") == b"XM:6\r"


def test_a_new_address_holds_at_once_and_the_answer_still_uses_the_old_one():
    bench = Bench()
    assert bench.say(b"X0Y40\r") == b"X0Y40:0\r"
    assert bench.say(b"X0Y40,1\r") == b"X0Y40,1\r"
    assert bench.say(b"X0\r") == b""
    assert bench.say(b"X1\r") == b"X1\r"
    assert bench.say(b"X1Y1\r") == b"X1Y1:2, Axis differ\r"
    assert bench.say(b"X1Y32\r") == b"X1Y32:0, Flash OK\r"
    assert bench.say(b"X1Y1\r") == b"X1Y1:0, Flash equal\r"


def test_identification_of_both_models():
    assert Bench().say(b"X0?\r") == b"X0?:PMD401 V13\r"
    assert Bench(motor=Motor("PMD301", firmware="V20")).say(b"X?\r") == b"X?:PMD301 V20\r"


def test_reset_is_told_once():
    bench = Bench()
    assert bench.say(b"XU0\r") == b"XU0:0808\r"
    assert bench.say(b"XU0\r") == b"XU0:0008\r"


def test_a_syntax_error_is_marked_behind_the_address():
    assert Bench((1,)).say(b"X1Q5\r") == b"X1_??_Q5\r"


def test_an_unimplemented_parameter_is_told():
    assert Bench().say(b"XY99\r") == b"XY99:!\r"


def test_a_chain_goes_through_consecutive_addresses():
    bench = unparked(Bench((1, 2, 3)))
    for controller in bench.controllers:
        controller.latched = 0
    assert bench.say(b"X0~U\r") == b"X1~U:0000\rX2~U:0000\rX3~U:0000\r"


def test_a_syntax_error_breaks_the_chain():
    assert Bench((1, 2)).say(b"X0~Q\r") == b"X1_??_Q\r"


def test_the_broadcast_ping_is_answered_two_milliseconds_apart():
    bench = Bench((0, 1, 2))
    bench.bus.receive(b"X127\r", bench.now_s)
    arrivals = []
    for tick in range(100):
        now_s = bench.now_s + tick * 1e-4
        if heard := bench.bus.take_output(now_s):
            arrivals.append((tick * 0.1, heard))
    assert [heard for _, heard in arrivals] == [b"X0\r", b"X1\r", b"X2\r"]
    gaps_ms = [later[0] - earlier[0] for earlier, later in itertools.pairwise(arrivals)]
    assert all(1.9 <= gap_ms <= 2.1 for gap_ms in gaps_ms)


def test_a_run_while_parked_is_refused_and_unparks_instead():
    bench = Bench((1,))
    assert bench.say(b"X1J10\r") == b"X1J10!\r"
    assert bench.say(b"X1M\r") == b"X1M:2\r"
    assert bench.controllers[0].physics.position_um == 0.0


def test_stored_commands_start_together_and_silently():
    bench = unparked(Bench((1, 2)))
    for address in (1, 2):
        bench.say(f"X{address}Y11,6000\r".encode())
        stored = f"X{address}T200b\r".encode()
        assert bench.say(stored) == stored
    assert [c.run for c in bench.controllers] == [None, None]
    assert bench.say(b"X127B1\r", 1.0) == b""
    assert [abs(c.count - 200) <= 1 for c in bench.controllers] == [True, True]


@pytest.mark.parametrize(
    ("line", "steps", "seconds"),
    [(b"XJ-16,4096,256\r", -16.5, 0.0645), (b"XJ0,128,5\r", 0.015625, 0.0031)],
)
def test_the_manuals_timing_examples(line: bytes, steps: float, seconds: float):
    bench = unparked(Bench())
    controller = bench.controllers[0]
    bench.bus.receive(line, bench.now_s)
    controller.advance(bench.now_s + seconds - 0.0015)
    assert controller.moving
    controller.advance(bench.now_s + seconds + 0.0015)
    assert not controller.moving
    assert controller.physics.position_um == pytest.approx(steps * 4.5, abs=1e-6)


def test_the_index_status_example_decodes():
    bench = unparked(Bench(motor=Motor(um_per_count=0.1, index_um=50.0)))
    bench.say(b"XU0\r")
    assert bench.say(b"XN4\r") == b"XN4\r"
    bench.say(b"XI100,0,100\r", 1.0)
    assert bench.say(b"XN\r").startswith(b"XN:1,")
    assert abs(bench.controllers[0].count) <= 5  # reset at the index, and stopped a tick later
    assert bench.say(b"XU0\r") == b"XU0:0100\r"
    assert bench.say(b"XU0\r") == b"XU0:0000\r"
