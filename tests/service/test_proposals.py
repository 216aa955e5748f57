"""Proposals and the room they were made for: another table, another case, another sender."""

import asyncio
import threading
from contextlib import contextmanager
from dataclasses import replace

import pytest
from line_room import patient_mm, running_line_room
from openigtlink_station import station

from case_record.cases import Cases
from dicom_listener.belonging import ACCEPTED, BOUND, event_body
from dicom_slice.patient import Identity
from service.room.proposals import MOST_OF_ONE, OPENIGTLINK, Plan
from service.room.refusal import ConflictError
from service.slicer.server import OpenIgtLinkServer, bind_openigtlink

INWARDS = "[openigtlink]\nport = 0\ninwards = true\n"
GUIDE = """
[service.guide]
upper_plane_mm = 58.0
lower_plane_mm = -2.0
upper_fiducial_mm = 48.0
lower_fiducial_mm = 14.0
upper_slice_mm = 46.0
lower_slice_mm = 12.0
"""
PLAN = Plan("workstation", "L4", "OpenIGTLink", patient_mm(41.0, 58.0), (58.0, -50.0, -41.0))


def bind(room, kind, frame, study="1.2.3"):
    body = event_body(Identity("p", study, frame))
    room.do(lambda: room.loop._record.append_event(kind, body, source="listener"))


MOVED = {
    "a study with another frame is accepted": lambda room: bind(room, ACCEPTED, "1.2.8", "1.2.4"),
    "a slice of another frame": lambda room: room.receive(frame_of_reference_uid="1.2.8"),
    "a slice of another study": lambda room: room.receive(study_instance_uid="1.2.2"),
}


@pytest.mark.parametrize("moved", MOVED)
def test_a_proposal_does_not_survive_a_table_that_may_have_moved(tmp_path, moved):
    """Also where it does not say its frame of reference."""
    with running_line_room(tmp_path) as room:
        room.calibrate()
        bind(room, BOUND, "1.2.9")
        number = room.call("propose", plan=PLAN).number
        assert room.until(lambda s: s.proposals).proposals[-1].state == "open"
        MOVED[moved](room)
        (one,) = room.until(lambda s: s.proposals[-1].state != "open").proposals
        assert (one.state, one.by) == ("withdrawn", "")
        assert "plan it again" in one.reason
        with pytest.raises(ConflictError):
            room.call("take_proposal", number=number, in_water=False)
        assert room.later().target_patient_mm is None
        # what is proposed from now on is for the table as it lies now
        assert room.call("propose", plan=PLAN).number > number


def test_a_proposal_stays_open_while_nothing_moves(tmp_path):
    with running_line_room(tmp_path) as room:
        number = room.call("propose", plan=PLAN).number
        bind(room, BOUND, "1.2.9")
        room.calibrate()
        room.receive()
        assert room.later().proposals[-1].state == "open"
        room.call("refuse_proposal", number=number, why="no")


def by_dicom(room, **more):
    """What the listener notes of a plan that a workstation has sent."""
    body = {"sender": "WORKSTATION 10.0.0.5", "name": "PLAN", "via": "DICOM Spatial Fiducials"}
    room.do(lambda: room.loop._record.append_event("plan_received", body | more, source="listener"))


REFUSED = {
    "of no frame": {"why": "its TARGET has no frame of reference"},
    "of another frame": {"target_mm": [1.0, 2.0, 3.0], "frame_of_reference_uid": "1.2.8"},
    "out of the bore": {"target_mm": [9e3, 2.0, 3.0], "frame_of_reference_uid": "1.2.9"},
}


@pytest.mark.parametrize("plan", REFUSED)
def test_a_plan_by_dicom_that_is_refused_is_one_alarm_that_says_why(tmp_path, plan):
    with running_line_room(tmp_path) as room:
        room.calibrate()
        by_dicom(room, **REFUSED[plan])
        told = room.until(lambda s: [a for a in s.alarms if a.code == "plan_refused"])
        assert not told.proposals
        (alarm,) = [a for a in room.later().alarms if a.code == "plan_refused"]
        with room.record() as record:
            (event,) = record.events_of_kind("proposal_turned_away")
        assert "WORKSTATION 10.0.0.5" in alarm.text
        assert alarm.text.endswith(event.body["why"])
        assert alarm.what_to_do.startswith("Correct the plan")


def test_a_frame_of_reference_that_no_slice_confirms_yet_is_not_accepted(tmp_path):
    with running_line_room(tmp_path) as room:
        place = patient_mm(41.0, 58.0)
        by_dicom(room, target_mm=list(place), frame_of_reference_uid="1.2.9")
        (one,) = room.until(lambda s: s.proposals).proposals
        with pytest.raises(ConflictError, match="acquire a slice"):
            room.call("take_proposal", number=one.number, in_water=False)
        room.calibrate()
        room.call("take_proposal", number=one.number, in_water=False)
        assert room.later().target_patient_mm == place


def test_workstations_that_flood_are_heeded_at_a_measured_pace_and_the_last_plan_counts(tmp_path):
    """Two at once; half of what they send is refused."""
    with running_line_room(tmp_path) as room:
        room.calibrate()

        def flood():
            for n in range(400):
                for host in ("10.0.0.5", "10.0.0.6"):
                    body = {"sender": f"STATION {host}", "name": f"{n}", "via": "DICOM SR"}
                    if n % 2:
                        body |= {
                            "target_mm": [*TARGET[:2], TARGET[2] + n / 1000],
                            "frame_of_reference_uid": "1.2.9",
                        }
                    else:
                        body |= {"why": "its TARGET is nowhere"}
                    room.loop._record.append_event("plan_received", body, source="listener")

        room.do(flood)
        last = room.until(lambda s: [p.name for p in s.proposals].count("399") == 2)
        with room.record() as record:
            kinds = ("plan_proposed", "proposal_turned_away", "alarm")
            proposed, refused, alarms = map(record.events_of_kind, kinds)
        assert len(proposed) + len(refused) <= 2 * 15
        assert all(one.state == "open" for one in last.proposals if one.name == "399")
        floods = [a.body["text"] for a in alarms if a.body["alarm"] == "plans_too_many"]
        assert sorted(text.split()[0] for text in floods) == ["10.0.0.5", "10.0.0.6"]


FRAMELESS = {"target_mm": list(patient_mm(41.0, 58.0)), "frame_of_reference_uid": ""}


def test_no_two_places_match_because_neither_says_its_frame_of_reference(tmp_path):
    with running_line_room(tmp_path) as room:
        room.header["frame_of_reference_uid"] = ""
        room.calibrate()
        bind(room, BOUND, "")
        with room.record() as record:
            before = record.last_slice("assigned").slice_id
        by_dicom(room, slice_ids=[before], **FRAMELESS)
        room.until(lambda s: s.proposals[-1:] and s.proposals[-1].state == "open")
        bind(room, ACCEPTED, "", "1.2.1")
        room.until(lambda s: s.proposals[-1].state == "withdrawn")
        by_dicom(room, name="LATE", slice_ids=[before], **FRAMELESS)
        state = room.until(lambda s: [a for a in s.alarms if "LATE" in a.text])
        assert [p.name for p in state.proposals] == ["PLAN"]
        assert "the table may have moved since its image was acquired" in state.alarms[0].text


def test_a_plan_without_a_frame_of_reference_is_not_one_of_slices_that_have_one(tmp_path):
    with running_line_room(tmp_path) as room:
        room.header["frame_of_reference_uid"] = ""
        room.calibrate()
        with room.record() as record:
            before = record.last_slice("assigned").slice_id
        by_dicom(room, slice_ids=[before], **FRAMELESS)
        number = room.until(lambda s: s.proposals).proposals[-1].number
        room.header["frame_of_reference_uid"] = "1.2.9"
        room.calibrate()
        with pytest.raises(ConflictError, match="names no frame of reference"):
            room.call("take_proposal", number=number, in_water=False)
        by_dicom(room, name="LATE", slice_ids=[before], **FRAMELESS)
        room.until(lambda s: [a for a in s.alarms if "LATE" in a.text])


def test_a_plan_of_before_a_study_was_accepted_is_of_another_frame(tmp_path):
    """Though no slice of the new one has come yet."""
    with running_line_room(tmp_path) as room:
        room.calibrate()
        bind(room, BOUND, "1.2.9")
        bind(room, ACCEPTED, "1.2.8", "1.2.4")
        place = {"target_mm": list(TARGET), "frame_of_reference_uid": "1.2.9"}
        by_dicom(room, **place)
        state = room.until(lambda s: [a for a in s.alarms if a.code == "plan_refused"])
        assert "a different frame of reference" in state.alarms[0].text
        assert not state.proposals


def sent_from(sender, **more):
    return Plan(**{"sender": sender, "name": "T", "via": OPENIGTLINK, "target_mm": None} | more)


def test_a_machine_that_connects_again_and_again_takes_nobody_elses_place(tmp_path):
    place = patient_mm(41.0, 58.0)
    with running_line_room(tmp_path) as room:
        other = room.call("propose", plan=sent_from("10.0.0.8:4000", target_mm=place))
        codes = [
            room.call("propose", plan=sent_from(f"10.0.0.7:{5000 + n}", target_mm=place)).code
            for n in range(12)
        ]
        assert codes == ["proposed"] * MOST_OF_ONE + ["too_many"] * (12 - MOST_OF_ONE)
        third = room.call("propose", plan=sent_from("fe80::9:4000", target_mm=place))
        assert third.code == "proposed"
        open_now = [p.number for p in room.later().proposals if p.state == "open"]
        assert {other.number, third.number} < set(open_now)
        assert len(open_now) == MOST_OF_ONE + 2


TARGET, ENTRY = patient_mm(41.0, 58.0), (58.0, -50.0, -41.0)


def test_a_target_and_an_entry_that_a_station_sends_apart_are_one_plan(tmp_path):
    own, other = "10.0.0.7:5000", "10.0.0.7:5001"
    with running_line_room(tmp_path) as room:

        def propose(sender=own, **more):
            number = room.call("propose", plan=sent_from(sender, **more)).number
            return next(p for p in room.until(lambda s: knows(s, number)).proposals[::-1])

        def knows(state, number):
            return any(p.number == number for p in state.proposals)

        first = propose(target_mm=TARGET, direction=(0.0, 0.0, 1.0))
        strangers = propose(other, name="E", entry_mm=ENTRY)
        assert strangers.target_mm is None
        both = propose(name="E", entry_mm=ENTRY)
        assert (both.target_mm, both.entry_mm, both.name) == (TARGET, ENTRY, "T")
        assert both.direction is None
        assert propose(name="E", entry_mm=ENTRY).number == both.number, "the same again"
        moved = propose(name="T2", target_mm=patient_mm(42.0, 58.0))
        assert (moved.target_mm, moved.entry_mm) == (patient_mm(42.0, 58.0), ENTRY)
        states = {p.number: p.state for p in room.later().proposals}
        assert states[first.number] == states[both.number] == "joined"
        room.call("refuse_proposal", number=moved.number, why="no")
        assert propose(name="E", entry_mm=ENTRY).target_mm is None, "what was refused is over"


def test_a_direction_in_a_room_without_a_needle_guide_is_refused_and_not_ignored(tmp_path):
    with running_line_room(tmp_path) as room:
        turned = sent_from("10.0.0.7:5000", target_mm=TARGET, direction=(0.0, -0.6, 0.8))
        verdict = room.call("propose", plan=turned)
        assert verdict.code == "invalid"
        assert "no needle guide" in verdict.text
        room.call("propose", plan=sent_from("10.0.0.7:5000", entry_mm=ENTRY))
        assert room.call("propose", plan=turned).code == "invalid", "nor beside an entry point"
        straight = replace(turned, direction=(0.0, 0.0, 1.0))
        assert room.call("propose", plan=straight).code == "proposed"


def test_a_half_from_before_the_table_moved_joins_no_other(tmp_path):
    with running_line_room(tmp_path) as room:
        room.calibrate()
        plan = sent_from("10.0.0.7:5000", target_mm=TARGET)
        room.call("propose", plan=plan)
        bind(room, BOUND, "1.2.9")
        bind(room, ACCEPTED, "1.2.8", "1.2.4")
        room.call("propose", plan=sent_from("10.0.0.7:5000", entry_mm=ENTRY))
        new = room.until(lambda s: len(s.proposals) == 2).proposals[-1]
        assert (new.target_mm, new.entry_mm) == (None, ENTRY)


def test_a_plan_of_one_message_is_replaced_as_a_whole(tmp_path):
    with running_line_room(tmp_path) as room:
        whole = sent_from("10.0.0.7:5000", target_mm=TARGET, entry_mm=ENTRY)
        room.call("propose", plan=whole)
        room.call("propose", plan=sent_from("10.0.0.7:5000", target_mm=TARGET))
        before, now = room.until(lambda s: len(s.proposals) == 2).proposals
        assert (before.state, now.entry_mm) == ("replaced", None)


def test_a_direction_that_cannot_be_used_yet_is_not_accepted(tmp_path):
    plan = Plan("station", "TGT_1", "OpenIGTLink", (10.0, 20.0, 30.0), None, (0.0, -1.0, 0.0))
    with running_line_room(tmp_path, GUIDE) as room:
        room.call("set_entry", patient_mm=(50.0, -60.0, 0.0))
        number = room.call("propose", plan=plan).number
        with pytest.raises(ConflictError, match="Calibrate first"):
            room.call("take_proposal", number=number, in_water=False)
        state = room.later()
        assert state.target_patient_mm is None
        assert state.proposals[-1].state == "open"


@contextmanager
def served(room):
    """The port at which peers are heard."""
    listening = bind_openigtlink(room.config.openigtlink)
    port, started, over = listening.getsockname()[1], threading.Event(), threading.Event()

    async def serve():
        cases = Cases(*room.config.room.folders)
        server = OpenIgtLinkServer(room.config, cases, room.loop, listening)
        await server.start()
        started.set()
        await asyncio.to_thread(over.wait)
        while server.receivers:
            await asyncio.sleep(0.01)
        await server.close()

    thread = threading.Thread(target=asyncio.run, args=(serve(),))
    thread.start()
    try:
        assert started.wait(10)
        yield port
    finally:
        over.set()
        thread.join()


def about_plans(message):
    return message["device"] == "TARGET"


def propose(peer):
    since = peer.mark()
    peer.say("point", "Plan", "ENTRY", "10 20 60", "TARGET", "10 20 30")
    assert peer.wait_for(about_plans, since)["name"] == "proposed"


def test_a_sender_is_told_of_its_own_proposal_and_of_its_end_with_the_case(tmp_path):
    """The numbers begin anew with each case: the second's has the number of the first's."""
    with (
        running_line_room(tmp_path, INWARDS, many_cases=True) as room,
        served(room) as port,
        station("own", port) as first,
        station("own", port) as second,
    ):
        room.call("begin_case", label="anna", operator="", note="")
        propose(first)
        (before,) = room.until(lambda s: s.proposals).proposals
        first.next_beats()
        since = first.mark()
        room.call("finish_case")
        told = first.wait_for(about_plans, since)
        assert (told["code"], told["name"]) == (5, "withdrawn")
        assert "its case has ended" in told["text"]

        room.call("begin_case", label="berta", operator="", note="")
        propose(second)
        (now,) = room.until(lambda s: s.proposals).proposals
        assert now.number == before.number
        since, since_second = first.mark(), second.mark()
        room.call("take_proposal", number=now.number, in_water=False)
        assert second.wait_for(about_plans, since_second)["name"] == "taken"
        first.next_beats()
        assert not [one for one in first.heard[since:] if about_plans(one)]


def test_without_a_case_the_answer_says_so_and_not_that_it_was_too_much(tmp_path):
    with (
        running_line_room(tmp_path, INWARDS, many_cases=True) as room,
        served(room) as port,
        station("own", port) as peer,
    ):
        peer.say("point", "Plan", "TARGET", "10 20 30")
        told = peer.wait_for(about_plans)
        assert (told["code"], told["name"]) == (13, "no_case")
        assert "No case is open" in told["text"]


def test_registrations_of_one_machine_do_not_fill_the_record(tmp_path):
    """Each under a name of its own, from a new connection."""
    pose = "1 0 0 10 0 1 0 20 0 0 1 30"
    with running_line_room(tmp_path, INWARDS) as room, served(room) as port:
        told = []
        for number in range(14):
            with station("own", port) as peer:
                peer.say("transform", f"CLB_{number}", pose)
                told.append(peer.wait_for(lambda m: m["device"] == "CALIBRATION"))
        with room.record() as record:
            kept = record.events_of_kind("registration_received")
        assert len(kept) == sum(one["code"] == 1 for one in told) < 14
        assert {(one["code"], one["name"]) for one in told} == {
            (1, "CALIBRATION"),
            (13, "too_many"),
        }


def test_both_halves_of_a_plan_are_answered_as_one(tmp_path):
    with (
        running_line_room(tmp_path, INWARDS) as room,
        served(room) as port,
        station("own", port) as peer,
    ):
        peer.say("point", "T", "Target_1", "10 20 30")
        assert peer.wait_for(about_plans)["name"] == "proposed"
        since = peer.mark()
        peer.say("point", "E", "Entry", "10 20 60")
        assert "as one plan" in peer.wait_for(about_plans, since)["text"]
        peer.next_beats()
        assert len([one for one in peer.heard[since:] if about_plans(one)]) == 1
        (one,) = [p for p in room.later().proposals if p.state == "open"]
        assert one.target_mm is not None
        assert one.entry_mm is not None


def test_a_pose_is_shown_with_the_state_that_it_belongs_to(tmp_path):
    """The robot moves while the pose is being worked out: what comes out is not where it is now."""

    class Slow(OpenIgtLinkServer):
        moved = False

        def pose(self):
            found = super().pose()
            if not self.moved:
                self.moved = True
                revision = room.state.revision
                room.call("jog", axis="xt", distance_um=500)
                room.until(lambda s: s.revision > revision and s.procedure is None)
                room.later()
            return found

    with running_line_room(tmp_path, INWARDS) as room:
        room.calibrate()
        listening = bind_openigtlink(room.config.openigtlink)
        server = Slow(room.config, Cases(*room.config.room.folders), room.loop, listening)
        listening.close()
        before = OpenIgtLinkServer.pose(server)
        state, pose = asyncio.run(server._state_and_pose())
        assert state.revision == room.state.revision
        now = server.pose()
        assert now.origin_mm.tolist() != before.origin_mm.tolist()
        assert pose.origin_mm.tolist() == now.origin_mm.tolist()
        assert pose.measured == now.measured
