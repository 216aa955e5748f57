"""What is known of where an axis stands: it shrinks by declaring, homing and looking alone."""

import pytest
from axis_model import AXES
from virtual_room import VirtualRoom

from robot_bridge.client.client import BridgeClient, RefusedError
from robot_bridge.daemon.bridge_settings import BridgeSettings
from robot_bridge.daemon.whereabouts import Growth, Stand, Whereabouts, stand_from_entry
from robot_bridge.protocol.phases import WorkPhase

COUNTED = Growth(step_error=0.05, run_um=40.0, approach_um=0, tolerance_um=20)


def ready(room: VirtualRoom) -> BridgeClient:
    assert room.bridge is not None
    client = room.client()
    client.open(5.0)
    return client


def room_of(tmp_path, monkeypatch: pytest.MonkeyPatch) -> VirtualRoom:
    """Its axes count: their steps may be wrong by a twentieth."""
    growth = dict.fromkeys(AXES, COUNTED)
    monkeypatch.setattr(
        "virtual_room.BridgeSettings", lambda *a, **k: BridgeSettings(*a, **k, growth=growth)
    )
    return VirtualRoom(tmp_path, seed=4)


def armed(room: VirtualRoom) -> BridgeClient:
    client = ready(room)
    client.declare_position(dict.fromkeys(AXES, 0), "test")
    client.set_phase(WorkPhase.MANUAL, "test")
    client.arm("test")
    return client


def go(client: BridgeClient, name: str, um: int):
    return client.move(name, {**dict.fromkeys(AXES, 0), "xt": um}, None)


def test_the_bound_grows_with_every_way_of_a_counted_axis_until_a_move_is_refused(
    tmp_path, monkeypatch
):
    room = room_of(tmp_path, monkeypatch)
    client = armed(room)
    for number in range(40):
        outcome = go(client, f"{number}", 8000 if number % 2 == 0 else 0)
        if not outcome.done:
            break
        assert client.status.bound_um["xt"] >= 0.05 * 8000 * (number + 1)
        assert client.status.bound_um["yt"] == 0
    assert outcome.code == "beyond_travel"
    assert "could end up anywhere from" in outcome.text
    assert 3 <= number <= 5  # travel is 10 mm: 8 mm and 5 % of some 40 mm do not fit


def test_looking_makes_room_again_and_a_correction_moves_the_travel(tmp_path, monkeypatch):
    room = room_of(tmp_path, monkeypatch)
    client = armed(room)
    for number in range(4):
        assert go(client, f"{number}", 8000 if number % 2 == 0 else 0).done
    assert go(client, "too little known", 8000).code == "beyond_travel"
    client.correct_position({"xt": 1500}, {"xt": 100})
    assert client.status.correction_um == {"xt": 1500}
    assert client.status.bound_um["xt"] == 100
    assert client.status.positions_um["xt"] == 0  # what is counted stays what it was
    assert go(client, "beyond by the truth", 8300).code == "beyond_travel"
    assert go(client, "inside by the truth", 7900).done
    with pytest.raises(RefusedError, match="has moved since"):
        client.correct_position({"xt": 0}, {"xt": 100}, based_on_motion="2")


def test_a_bridge_killed_in_a_move_knows_that_it_stands_anywhere_between(tmp_path, monkeypatch):
    """The count was lost on the way; nothing drives to an end of travel from a guess."""
    room = room_of(tmp_path, monkeypatch)
    client = armed(room)
    assert go(client, "there", 8000).done
    request = {**dict.fromkeys(AXES, 0), "xt": -8000}
    room.bridge._motion.accept(room_record("late", request))
    room.bridge.tick()
    room.run(0.75)  # most of the way
    room.crash_bridge()
    truth_um = room.stage.positions_um()["xt"]
    room.run(0.5)
    client = ready(room)
    status = client.status
    assert status.certain_axes == ()
    assert abs(status.remembered_um["xt"] - truth_um) <= status.bound_um["xt"]
    assert status.bound_um["xt"] > 8000
    assert status.bound_um["yt"] == 0
    # what is declared is the guess: it is known no better by that
    client.declare_position(dict(status.remembered_um), "test")
    assert client.status.bound_um["xt"] > 8000
    client.set_phase(WorkPhase.MANUAL, "test")
    client.arm("test")
    here_um = client.status.positions_um
    for um in (8000, -8000, 3000, -3000):
        moved = client.move(f"to {um}", {**here_um, "xt": um}, None)
        assert moved.code == "beyond_travel", moved
    assert client.move("yt alone", {**here_um, "yt": 4000}, None).done
    # somebody measured it
    client.declare_position({"xt": 100}, "test", {"xt": 50})
    assert client.status.bound_um["xt"] == 50
    assert client.move("now", {**client.status.positions_um, "xt": 3000}, None).done


def room_record(command_id: str, setpoints_um: dict[str, int]):
    from robot_bridge.daemon.journal import CommandRecord

    return CommandRecord(command_id, "move", setpoints_um, None, "")


def test_only_what_is_named_is_declared_and_only_what_moves_must_be_certain(tmp_path):
    room = VirtualRoom(tmp_path, seed=5)
    client = ready(room)
    client.declare_position({"xt": 1500}, "test")
    assert client.status.certain_axes == ("xt",)
    assert not client.status.position_certain
    client.set_phase(WorkPhase.MANUAL, "test")
    client.arm("test")
    here_um = dict(client.status.positions_um)
    refused = client.move("yt", {**here_um, "yt": here_um["yt"] + 500}, None)
    assert refused.code == "position_uncertain"
    assert "'yt'" in refused.text
    assert client.move("xt", {**here_um, "xt": 2500}, None).done


def test_a_stand_is_the_same_after_the_journal():
    stand = Stand(1234, 56.25, 1600.0, -7)
    assert stand_from_entry(stand.as_entry()) == stand
    with pytest.raises(ValueError, match="unpack"):
        stand_from_entry([1, 2])


def test_an_axis_that_stays_is_known_no_worse():
    known = Whereabouts({"xt": COUNTED}, {"xt": Stand(500, 10.0)})
    known.arrived({"xt": 500}, ["xt"], {})
    assert known.stands["xt"] == Stand(500, 10.0)
    assert known.reach_um("xt", 500) == (490, 510)


def test_measuring_an_axis_that_is_certain_clears_its_bound_and_confirming_a_guess_does_not():
    known = Whereabouts({"xt": COUNTED}, {"xt": Stand(500, known_to_um=7000)})
    known.declared({"xt": 505}, {})
    assert known.stands["xt"].bound_um == 7000  # that was the guess, repeated
    known.declared({"xt": 505}, {}, were_certain={"xt"})
    assert known.stands["xt"].bound_um == 0
