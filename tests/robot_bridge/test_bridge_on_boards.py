"""The bridge on the driver and emulated boards, in virtual time: what it knows after a fault."""

from collections.abc import Callable
from pathlib import Path

import pytest
from pmd_bench import NAMES, Bench
from pmd_rig import StageWithEnds

from robot_bridge.daemon.bridge import Bridge
from robot_bridge.daemon.bridge_settings import BridgeSettings
from robot_bridge.daemon.journal import CommandRecord, Journal
from robot_bridge.daemon.main import growth_of
from robot_bridge.emulator.axis import Motor
from robot_bridge.emulator.settings import INDEX_OFFSET
from robot_bridge.protocol.framing import encode_stop
from robot_bridge.protocol.messages import Answer, Code, CommandState, DeclarePosition
from robot_bridge.protocol.service_end import Answered, ServiceEnd


class Room:
    """A bridge that hears from its service all the time."""

    def __init__(self, bench: Bench, folder: Path) -> None:
        self.bench, self.line = bench, bench.line
        self.journal = Journal(folder)
        self.bridge = Bridge(
            BridgeSettings(
                axes=tuple(axis.travel for axis in bench.axes),
                growth={axis.name: growth_of(axis) for axis in bench.axes},
                motion_timeout_s=60.0,
            ),
            bench.motors,
            self.journal,
            boot_id="boot",
            new_session=lambda: 1,
            clock=lambda: self.line.now_s,
            wall_clock=lambda: self.line.now_s,
        )
        self.motion = self.bridge._motion
        self.deaf_s = 0.0

    def run(self, seconds: float, until: Callable[[], bool] = lambda: False) -> None:
        end_s = self.line.now_s + seconds
        while self.line.now_s < end_s and not until():
            self.bridge._fresh_s = self.line.now_s
            self.bridge.tick()
            self.line.wait(0.005)

    def move(self, **setpoints_um: int) -> None:
        name = f"move {self.line.now_s}"
        self.motion.accept(CommandRecord(name, "move", setpoints_um, None, self.motion.last_motion))

    def listen(self, data: bytes = b"") -> None:
        """One turn of the daemon's loop; how long it was deaf is noted."""
        began_s = self.line.now_s
        self.bridge.receive(data)
        self.bridge._fresh_s = self.line.now_s
        self.bridge.tick()
        self.deaf_s = max(self.deaf_s, self.line.now_s - began_s)
        self.line.wait(0.005)

    def home(self) -> None:
        self.motion.accept(CommandRecord("home", "home", {}, None, self.motion.last_motion))


@pytest.mark.parametrize("names", [("xt",), ("xt", "yt", "xb", "yb")], ids=len)
@pytest.mark.parametrize("latency_s", [0.0, 0.016, 0.03])
def test_boards_that_were_silent_for_long_are_asked_once_where_they_stand(
    tmp_path, names, latency_s
):
    bench = Bench(latency_s=latency_s, names=names)
    room = Room(bench, tmp_path)
    room.motion.declare_position(dict.fromkeys(names, 0), {})
    room.run(1.0)
    room.move(**dict.fromkeys(names, 9000))
    room.run(1.5)
    assert room.bridge.moving
    for board in bench.boards:
        board.faults.dead = True
    room.run(5.0)
    for board in bench.boards:
        board.faults.dead = False
    room.run(20.0)
    assert not bench.motors.poll().moving
    room.motion.declare_position({n: round(bench.truth_um(n)) for n in names}, {})
    room.run(2.0)
    assert room.motion.certain
    assert not bench.motors.poll().moving


def test_a_homing_that_was_stopped_before_it_began_leaves_what_was_known(tmp_path):
    room = Room(Bench("open_loop", names=("xt", "yt")), tmp_path)
    room.motion.declare_position({"xt": 0, "yt": 0}, {"xt": 300, "yt": 300})
    room.motion.correct_position({"xt": 800}, {"xt": 50})
    before = dict(room.motion.whereabouts.stands)
    room.home()
    room.bridge.stop_for(Code.OPERATOR_STOP, "STOP")
    room.run(0.5)
    assert room.motion.last_command.state is CommandState.STOPPED
    assert room.motion.whereabouts.stands == before


def test_a_correction_of_before_is_not_laid_on_the_count_of_an_axis_that_has_homed(tmp_path):
    names = ("xt", "yt")
    bench = Bench(names=names, stage=StageWithEnds, speed_hz=1500)
    room = Room(bench, tmp_path)
    room.motion.declare_position({"xt": 0, "yt": 0}, {"xt": 5, "yt": 5})
    room.run(0.5)
    room.move(xt=-19000, yt=15000)
    room.run(20.0, until=lambda: not room.bridge.moving)
    room.motion.correct_position({"xt": 800}, {"xt": 50})
    room.home()
    room.run(1.0)
    room.run(60.0, until=lambda: "xt" in bench.motors.poll().certain_axes)
    assert room.bridge.moving, "yt is on its way"
    room.journal.close()  # killed
    room.line.wait(2.0)
    bench.restart()
    assert "xt" not in Room(bench, tmp_path).motion.whereabouts.stands


def test_an_axis_pushed_as_another_moves_is_remembered_with_both_places(tmp_path):
    bench = Bench(names=("xt", "yt"))
    room = Room(bench, tmp_path)
    room.motion.declare_position({"xt": 0, "yt": 0}, {})
    room.run(1.0)
    bench.boards[0].physics._position_um += 3000
    room.move(xt=0, yt=3000)
    room.run(5.0)
    assert "xt" not in room.motion.certain_axes
    stand = room.motion.whereabouts.stands["xt"]
    for place_um in (0, 3000):
        assert abs(place_um - stand.true_um) <= stand.known_to_um


def spoiled(bench: Bench, name: str, what: Callable[[int, str], str | None]) -> None:
    """What a board answers to `name` on the line; None: nothing arrives."""
    real, seen = bench.bus._reply, [0]

    def reply(shown, answer, delimiter, at):
        if answer.text.startswith(f"{name}:"):
            seen[0] += 1
            text = what(seen[0], answer.text)
            if text is None:
                return
            answer = answer._replace(text=text)
        real(shown, answer, delimiter, at)

    bench.bus._reply = reply


def test_three_lost_answers_do_not_skip_the_proof_of_the_encoder():
    bench = Bench(names=("xt",))
    bench.rest(0.3)
    spoiled(bench, "Y0", lambda count, text: None if count <= 3 else text)
    bench.board.faults.encoder_frozen = True
    bench.motors.move_to({"xt": 15000})
    status = bench.finish()
    assert status.fault in ("no_answer", "encoder_disagrees")
    assert bench.truth_um() <= 200.0


@pytest.mark.parametrize(
    "what",
    [
        lambda count, text: text.replace("5000", "1000") if count == 1 else text,
        lambda count, text: None,
    ],
    ids=["damaged once", "silent"],
)
def test_the_count_at_the_index_is_believed_only_if_it_is_told_twice_alike(what):
    bench = Bench(
        names=("xt",),
        motor=Motor(index_um=-19000.0),
        home_um=-20000,
        home_to="index",
        declare=False,
    )
    bench.board.settings.store(INDEX_OFFSET, 5000)
    spoiled(bench, "Y14", what)
    bench.motors.home(["xt"])
    status = bench.finish()
    assert status.fault in ("cannot_home", "no_answer")
    assert "xt" not in status.certain_axes


def declared_by_a_service(room: Room, turns_before_stop: int = 1000) -> Answer:
    """Asked again until it is answered, as a client does."""
    service, answers = ServiceEnd(), []

    def turn(data: bytes) -> None:
        room.listen(data)
        events = service.receive(room.bridge.take_output(), room.line.now_s)
        answers.extend(event.answer for event in events if isinstance(event, Answered))

    service.say_hello(round(room.line.now_s * 1000), "test", room.line.now_s)
    turn(service.take_output())
    seen_ms = room.bridge.status().now_ms
    positions_um = {axis: 1000 * number for number, axis in enumerate(room.bench.names, 1)}
    service.send_request(DeclarePosition(positions_um, "test", seen_ms), room.line.now_s)
    for number in range(300):
        service.tick(room.line.now_s)
        stop = encode_stop(7, False) if number == turns_before_stop else b""
        turn(service.take_output() + stop)
        if answers:
            return answers[0]
    raise AssertionError("no answer")


@pytest.mark.parametrize("latency_s", [0.0, 0.016, 0.03])
def test_a_declaration_of_four_axes_does_not_make_the_bridge_deaf(tmp_path, latency_s):
    bench = Bench(latency_s=latency_s, declare=False)
    room = Room(bench, tmp_path)
    answer = declared_by_a_service(room)
    assert (answer.code, room.motion.certain) == (Code.OK, True)
    assert bench.motors.poll().readback_um == {"xt": 1000, "yt": 2000, "xb": 3000, "yb": 4000}
    assert room.deaf_s < 0.3


def test_a_stop_between_the_axes_of_a_declaration_ends_it(tmp_path):
    room = Room(Bench(latency_s=0.03, declare=False), tmp_path)
    answer = declared_by_a_service(room, turns_before_stop=1)
    assert room.bridge.stopped
    assert answer.code == Code.STOP_LATCHED
    assert set(room.motion.certain_axes) < set(NAMES)
    assert all(axis in answer.text for axis in set(NAMES) - room.motion.certain_axes)
    room.run(1.0)
    assert declared_by_a_service(room).code == Code.OK, "once more, while the stop is latched"
    assert room.motion.certain


def test_a_declaration_waits_for_a_board_that_is_set_up_again_and_listens_meanwhile(tmp_path):
    bench = Bench(latency_s=0.03, declare=False)
    room = Room(bench, tmp_path)
    room.run(0.5)
    bench.board.power_on(room.line.now_s, deaf_s=0.1)
    room.run(2.0, until=lambda: room.bridge.motors.status.setting_up)
    assert room.bridge.motors.status.setting_up
    answer = declared_by_a_service(room)
    assert (answer.code, room.motion.certain) == (Code.OK, True)
    assert room.deaf_s < 0.3
