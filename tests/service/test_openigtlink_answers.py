"""The table of what peers may say, against every state of the room: no I/O."""

import asyncio
import contextlib
import struct
from types import SimpleNamespace

import numpy as np
import pytest

from robot_bridge.protocol.phases import WorkPhase
from service.room.commands.allowance import Allowance, Allowances
from service.room.proposals import Verdict
from service.room.state import RobotState, RoomState
from service.slicer.answers import (
    acknowledge,
    answer,
    concerns_us,
    decision_of,
    not_looked_at,
    registered,
    verdict_of,
)
from service.slicer.messages import Message, Point, points, string, transform
from service.slicer.peer import Peer
from service.slicer.pose import Pose
from service.slicer.reading import Received, Stream, matrix_of, stop_word, string_of

ROBOT = RobotState(linked=True, armed=True, position_certain=True, phase="PLANNING")
STATES = {
    "no link": RobotState(),
    "not armed": ROBOT.model_copy(update={"armed": False, "phase": "START_UP"}),
    "fault": ROBOT.model_copy(update={"fault": "bus voltage"}),
    **{
        str(phase): ROBOT.model_copy(update={"phase": str(phase)})
        for phase in WorkPhase
        if phase not in ("STOP", "EMERGENCY")
    },
    "STOP": ROBOT.model_copy(update={"stopped": True, "armed": False, "phase": "STOP"}),
    "EMERGENCY": ROBOT.model_copy(update={"stopped": True, "armed": False, "phase": "EMERGENCY"}),
}


def room(robot: RobotState = ROBOT, **more) -> RoomState:
    return RoomState(
        revision=1,
        at_s=5.0,
        room="r",
        virtual=True,
        tolerance_mm=0.2,
        ready_valid_s=60.0,
        robot=robot,
        **more,
    )


def received(message: Message, version: int = 2) -> Received:
    (found,) = Stream().feed(message.encoded(version))
    return found


def said(message: Message, state: RoomState | None = None, *, pose=None, inwards=True):
    return answer(received(message), state or room(), lambda: pose, "10.1.0.7:50000", inwards)


def code_of(message: Message) -> tuple[int, int]:
    assert message.kind == "STATUS"
    code, subcode = struct.unpack(">Hq", message.content[:10])
    return code, subcode


def text(device: str, what: str) -> Message:
    return string(device, 1.0, what)


TGT = transform("TGT_0042", 1.0, np.eye(3), (1.0, 2.0, 3.0))
POSE = Pose(np.eye(3), np.array([1.0, 2.0, 3.0]), "fiducial", 0.02, True)


@pytest.mark.parametrize("robot", STATES.values(), ids=STATES)
@pytest.mark.parametrize("device", ["CMD_0001", "STOP", "X", ""])
@pytest.mark.parametrize("word", ["STOP", "EMERGENCY", "stop"])
def test_a_stop_is_a_stop_however_it_is_addressed_and_in_every_state(robot, device, word):
    message = received(text(device, word))
    assert stop_word(message) == word.upper()
    ack = acknowledge(message, room(robot))
    assert string_of(received(ack)) == word
    if device == "CMD_0001":
        assert ack.device == "ACK_0001"


@pytest.mark.parametrize("robot", STATES.values(), ids=STATES)
@pytest.mark.parametrize("word", ["START_UP", "PLANNING", "CALIBRATION", "TARGETING"])
def test_a_phase_that_is_asked_for_is_answered_with_what_is(robot, word):
    ack, status = said(text("CMD_12", word), room(robot)).replies
    assert (ack.device, string_of(received(ack))) == ("ACK_12", word)
    assert status.device == word
    assert code_of(status)[0] in (1, 13)
    could = robot.linked and robot.armed and not robot.stopped and not robot.fault
    if not could:
        assert code_of(status)[0] == 13


@pytest.mark.parametrize("robot", STATES.values(), ids=STATES)
@pytest.mark.parametrize(
    "query", [("CURRENT_STATUS", "x"), ("GET_STATUS", ""), ("CMD_1", "GET_STATUS")]
)
def test_the_status_is_named_by_the_phase(robot, query):
    (status,) = said(text(*query), room(robot)).replies
    assert status.device == robot.phase
    wanted = {"no link": 13, "not armed": 13, "fault": 18, "STOP": 13, "EMERGENCY": 3, "MANUAL": 14}
    name = next(name for name, one in STATES.items() if one is robot)
    assert code_of(status)[0] == wanted.get(name, 1)


@pytest.mark.parametrize("robot", STATES.values(), ids=STATES)
def test_motion_is_denied_and_the_page_is_named(robot):
    ack, status = said(text("CMD_7", "MOVE_TO_TARGET"), room(robot)).replies
    assert ack.device == "ACK_7"
    assert code_of(status)[0] == 5
    assert b"on the page" in status.content


@pytest.mark.parametrize("robot", STATES.values(), ids=STATES)
@pytest.mark.parametrize(
    "order",
    [
        "RETRACT_NEEDLE",
        "HOME",
        "INIT",
        "MANUAL",
        "12.5,30.0",
        "ARM",
        "RESET",
        "CONFIRM",
        "NEEDLE_OUT",
    ],
)
def test_nothing_else_is_done_from_here(robot, order):
    for device in ("CMD_9", order):
        answered = said(text(device, order), room(robot))
        assert [code_of(one)[0] for one in answered.replies] == [12]
        assert answered.plan is None


def test_a_command_is_answered_with_an_error_under_its_number():
    content = struct.pack(">I128sHI", 4711, b"HOME", 3, 4) + b"HOME"
    (reply,) = said(Message("COMMAND", "Slicer", 1.0, content)).replies
    assert (reply.kind, struct.unpack(">I", reply.content[:4])) == ("RTS_COMMAND", (4711,))
    assert b"not available here" in reply.content


def test_the_pose_is_told_or_that_there_is_none():
    place, targeting, reached = said(text("CURRENT_POSITION", ""), pose=POSE).replies
    assert matrix_of(received(place))[1].tolist() == [1.0, 2.0, 3.0]
    assert [targeting.device, reached.device] == ["IS_IN_TARGETING_POS", "HAS_REACHED_TARGET"]
    assert {string_of(received(one)) for one in (targeting, reached)} == {"0"}
    (none,) = said(text("GET_TRANSFORM", "")).replies
    assert code_of(none)[0] == 13
    at_ready = said(text("CURRENT_POSITION", ""), room(ready=True), pose=POSE).replies[2]
    assert string_of(received(at_ready)) == "1"


@pytest.mark.parametrize("robot", STATES.values(), ids=STATES)
def test_a_target_is_a_proposal_in_every_state(robot):
    answered = said(TGT, room(robot))
    (ack,) = answered.replies
    assert (ack.device, ack.content) == ("ACK_0042", TGT.content)
    assert answered.plan is not None
    assert answered.plan.target_mm == (1.0, 2.0, 3.0)
    assert answered.plan.direction == (0.0, 0.0, 1.0)


def bad_matrices():
    finite, left, skew = np.eye(3), np.diag([1.0, 1.0, -1.0]), np.eye(3) + 0.2
    yield transform("TGT_1", 1.0, finite, (np.nan, 0.0, 0.0))
    yield transform("TGT_1", 1.0, finite, (np.inf, 0.0, 0.0))
    yield transform("TGT_1", 1.0, finite * np.nan, (0.0, 0.0, 0.0))
    yield transform("TGT_1", 1.0, left, (0.0, 0.0, 0.0))
    yield transform("TGT_1", 1.0, skew, (0.0, 0.0, 0.0))
    yield transform("TGT_1", 1.0, np.zeros((3, 3)), (0.0, 0.0, 0.0))
    yield Message("TRANSFORM", "TGT_1", 1.0, bytes(24))


@pytest.mark.parametrize("message", list(bad_matrices()))
def test_a_matrix_that_is_no_pose_is_a_configuration_error(message):
    answered = said(message)
    assert answered.plan is None
    assert code_of(answered.replies[-1]) == (10, 1)
    assert answered.replies[-1].device == "TARGET"


def listed(*named: tuple[str, tuple[float, float, float], str]) -> Message:
    return points("F", 1.0, [Point(name, place, group=group) for name, place, group in named])


def test_points_are_taken_by_label_never_by_index():
    entry, target = ("Entry 1", (1.0, 2.0, 60.0), ""), ("TARGET", (1.0, 2.0, 3.0), "Unselected")
    for order in ([entry, target], [target, entry], [("F-1", (0.0, 0.0, 0.0), ""), entry, target]):
        plan = said(listed(*order)).plan
        assert plan is not None
        assert (plan.target_mm, plan.entry_mm) == ((1.0, 2.0, 3.0), (1.0, 2.0, 60.0))


def test_of_two_targets_the_selected_one_counts():
    one, two = (1.0, 2.0, 3.0), (4.0, 5.0, 6.0)
    chosen = said(listed(("TARGET", one, "Unselected"), ("TARGET", two, "Selected"))).plan
    assert chosen is not None
    assert chosen.target_mm == two
    both = said(listed(("TARGET", one, "Selected"), ("TARGET", two, "Selected")))
    assert both.plan is None
    assert code_of(both.replies[-1]) == (10, 1)


@pytest.mark.parametrize(
    "message",
    [
        listed(("F-1", (1.0, 2.0, 3.0), "")),
        listed(("TARGET", (np.nan, 2.0, 3.0), "")),
        listed(*[("TARGET", (float(n), 0.0, 0.0), "") for n in range(10_000)]),
        points("F", 1.0, []),
        Message("POINT", "F", 1.0, bytes(100)),
    ],
    ids=["no label", "NaN", "10,000", "empty", "cut off"],
)
def test_points_that_are_no_plan_are_a_configuration_error(message):
    answered = said(message)
    assert answered.plan is None
    assert code_of(answered.replies[-1]) == (10, 1)


def test_a_registration_is_kept_and_a_tracked_tip_is_not():
    matrix = transform("CLB_3", 1.0, np.eye(3), (1.0, 2.0, 3.0))
    kept = said(matrix)
    assert [one.device for one in kept.replies] == ["ACK_3"]
    for verdict, code in ((Verdict("recorded", ""), 1), (Verdict("too_many", "why"), 13)):
        told = registered(verdict, 1.0)
        assert (told.device, code_of(told)[0]) == ("CALIBRATION", code)
    assert np.allclose(np.array(kept.registration)[:, 3], (1.0, 2.0, 3.0))
    tip = said(transform("NPOS_3", 1.0, np.eye(3), (1.0, 2.0, 3.0)))
    assert (tip.replies[0].device, tip.plan, tip.registration) == ("ACK_3", None, None)


def test_what_is_not_for_the_robot_is_not_answered():
    other = transform("LinearTransform_1", 1.0, np.eye(3), (0.0, 0.0, 0.0))
    for message in (other, Message("STATUS", "", 1.0, bytes(31)), Message("IMAGE", "a", 1.0, b"")):
        assert not concerns_us(received(message))
        assert said(message).replies == ()


def test_a_flood_is_told_that_it_is_too_many_under_the_name_of_what_it_sent():
    registration = transform("CLB_", 1.0, np.eye(3), (0, 0, 0))
    flood = ((TGT, "TARGET"), (listed(), "TARGET"), (registration, "CALIBRATION"))
    for message, name in flood:
        assert concerns_us(received(message))
        told = not_looked_at(received(message), 1.0)
        assert code_of(told)[0] == 13
        assert told.device == name
        assert b"too_many" in told.content


def test_a_machine_may_ask_ten_times_at_once_and_then_once_a_second():
    at_s = [0.0]
    one = Allowance(lambda: at_s[0])
    assert [one.take() for _ in range(12)] == [True] * 10 + [False] * 2
    at_s[0] = 1.1
    assert [one.take(), one.take(), one.is_whole] == [True, False, False]
    at_s[0] = 20.0
    assert one.is_whole


def test_the_allowance_is_a_machines_and_not_a_connections():
    known = Allowances()
    assert [known.of("10.0.0.7", "propose").take() for _ in range(11)] == [True] * 10 + [False]
    assert known.of("10.0.0.7", "note_registration").take()
    assert known.of("10.0.0.8", "propose").take()


def test_where_inwards_is_off_everything_but_stop_is_denied():
    for message in (TGT, text("CMD_1", "PLANNING"), text("GET_STATUS", ""), listed()):
        answered = said(message, inwards=False)
        assert [code_of(one)[0] for one in answered.replies] == [5]
        assert answered.plan is None
    assert stop_word(received(text("CMD_1", "STOP"))) == "STOP"


def test_the_sender_is_told_what_the_room_makes_of_a_plan():
    plan = said(TGT).plan
    assert plan is not None
    waits = verdict_of(plan, Verdict("proposed", "waits", 7, reach_known=True), room())
    assert [one.device for one in waits] == ["TARGET", "REACHABLE_TARGET"]
    assert waits[1].content == TGT.content
    unknown = verdict_of(plan, Verdict("proposed", "waits", 7), room())
    assert [one.device for one in unknown] == ["TARGET"]
    codes = {"invalid": (10, 1), "out_of_reach": (10, 3), "too_many": (13, 0), "no_case": (13, 0)}
    for code, expected in codes.items():
        (told,) = verdict_of(plan, Verdict(code, "why"), room())
        assert code_of(told) == expected
    assert b"no_case" in told.content
    refused = decision_of(7, "refused", "Olga", "vessel in the way", 1.0)
    assert code_of(refused) == (5, 0)
    assert b"refused by Olga: vessel in the way" in refused.content
    assert code_of(decision_of(7, "taken", "Olga", "", 1.0)) == (1, 0)


def test_what_was_sent_in_version_1_is_said_again_with_its_validity_in_version_2():
    """Also if the peer says which version it reads while that very message is on its way."""

    class Wire:
        sent = b""

        def write(self, data):
            self.sent += data

        async def drain(self):
            peer._note_version(2)

    async def send():
        peer._wake.set()
        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for(peer._send(), 0.2)

    wire = Wire()
    scene = {"CURRENT_POSITION": POSE.message("CURRENT_POSITION", 1.0)}
    peer = Peer("10.0.0.7:5000", SimpleNamespace(scene=scene), None, wire)
    asyncio.run(send())
    first, again = Stream().feed(wire.sent)
    assert (first.version, again.version) == (1, 2)
    assert again.meta["TransformStatus"] == "OK"
