"""The whole listener as a process: from C-STORE to the row in the case record, through crashes."""

import json
import os
import random
import re
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
import urllib.request
from datetime import UTC, datetime
from pathlib import Path

import pytest
from listener_room import COMPARED, ListenerProcess, listening, wait_for, write_room
from made_slices import begin_hold, mr_data_set
from pydicom.uid import ExplicitVRLittleEndian
from pynetdicom import AE, evt
from pynetdicom.association import Association

from case_record.record import CaseRecord
from dicom_listener.association_fix import mended
from dicom_listener.inbox import is_whole, read_envelope
from dicom_listener.operator_actions import reassign, sync_clock
from dicom_listener.process import run
from dicom_listener.slice_rows import slice_from_record
from dicom_slice.header import read_header
from dicom_slice.pixels import magnitude_pixels
from dicom_slice.quirks import MR_IMAGE
from room_config.load import ConfigError, load_config

ROOT = Path(__file__).parents[2]


@pytest.fixture
def config(tmp_path):
    return write_room(tmp_path, **COMPARED)


@pytest.fixture
def record(config):
    with CaseRecord(config.parent / "case", create=True) as opened:
        yield opened


def send(port: int, *data_sets) -> list[int]:
    """Statuses of a C-STORE of each; -1 where no answer came."""
    ae = AE("SCANNER")
    for syntax in {str(d.file_meta.TransferSyntaxUID) for d in data_sets}:
        ae.add_requested_context(MR_IMAGE, [syntax])
    association = mended(ae.associate("127.0.0.1", port, ae_title="AUTOSPINE"))
    assert association.is_established
    statuses = [association.send_c_store(d).get("Status", -1) for d in data_sets]
    association.release()
    return statuses


def rows(record: CaseRecord, count: int):
    wait_for(lambda: len(record.slices()) >= count)
    return record.slices()


def alarms(record: CaseRecord) -> list[str]:
    return [event.body["alarm"] for event in record.events() if event.kind == "alarm"]


def test_a_slice_acquired_at_the_standing_hold_is_assigned_and_its_pixels_can_be_read(
    config, record
):
    hold_id = begin_hold(record, time.time() - 5.0)
    with listening(config) as listener:
        assert send(listener.port, mr_data_set(began_s=time.time() - 0.6)) == [0]
        (row,) = rows(record, 1)
    assert (row.state, row.hold_id, row.reason_code) == ("assigned", hold_id, "")
    assert row.time_source == "AcquisitionDateTime"
    assert row.acquired_to_s <= row.received_s
    path = record.case_dir / row.path
    assert magnitude_pixels(path, row.frame).shape == (48, 40)
    assert slice_from_record(row.header) == read_header(path)[0]
    assert row.header["envelope"]["calling_ae_title"] == "SCANNER"
    assert [event.kind for event in record.events()] == ["slice_received", "case_bound"]
    record.verify_events()


def test_with_no_case_open_slices_are_kept_and_recorded_as_without_a_hold(config):
    with listening(config) as listener:
        assert send(listener.port, mr_data_set()) == [0]
        with CaseRecord(config.parent / "case") as record:
            (row,) = rows(record, 1)
            assert (row.state, row.reason_code) == ("quarantined", "no_open_hold")


def test_the_same_slice_again_changes_nothing_and_other_bytes_under_its_uid_are_an_alarm(
    config, record
):
    began_s = time.time() - 1
    begin_hold(record, time.time() - 5.0, expected=3)
    with listening(config) as listener:
        first = mr_data_set("1.2.826.0.9", began_s=began_s)
        send(listener.port, first, first)
        wait_for(lambda: any(e.kind == "duplicate_slice" for e in record.events()))
        assert len(record.slices()) == 1
        assert len(list((record.case_dir / "inbox").glob("*.dcm"))) == 1
        other = mr_data_set("1.2.826.0.9", began_s=began_s)
        other.PixelData = bytes(reversed(other.PixelData))
        send(listener.port, other)
        first_row, second_row = rows(record, 2)
    assert first_row.state == "assigned"
    assert second_row.reason_code == "same_uid_other_bytes"
    assert (record.case_dir / first_row.path).exists()
    assert (record.case_dir / second_row.path).exists()
    assert alarms(record) == ["same_uid_other_bytes"]


def test_a_surplus_slice_waits_until_the_hold_expects_it(config, record):
    hold_id = begin_hold(record, time.time() - 5.0, expected=1)
    with listening(config) as listener:
        began_s = time.time() - 0.6
        send(listener.port, *(mr_data_set(f"1.2.9.{k}", began_s=began_s) for k in (1, 2, 3)))
        found = rows(record, 3)
        assert [(row.state, row.reason_code) for row in found] == [
            ("assigned", ""),
            ("pending", "not_expected"),
            ("pending", "not_expected"),
        ], [row.reason for row in found]
        record.expect_slices(hold_id, 2)
        wait_for(lambda: record.slices()[1].state == "assigned")
        assert record.slices()[2].state == "pending"
        # within the guard time of its end the hold could not be told from what comes after it
        record.end_open_hold(time.time() + 1.0)
        wait_for(lambda: record.slices()[2].state == "quarantined")
    assert record.slices()[2].reason_code == "not_expected"


def test_an_operator_may_overrule_and_who_is_recorded(config, record):
    with listening(config) as listener:
        send(listener.port, mr_data_set())
        (row,) = rows(record, 1)
        hold_id = begin_hold(record, time.time(), expected=1)
        reassign(record, row.slice_id, hold_id, "anna", "the robot had not moved")
        row = record.slice(row.slice_id)
        assert (row.state, row.hold_id, row.decided_by) == ("assigned", hold_id, "anna")
        assert record.events()[-1].who == "anna"
        # the listener follows: the hold is full now
        time.sleep(1.2)
        send(listener.port, mr_data_set("1.2.77", began_s=time.time() - 0.6))
        assert rows(record, 2)[1].reason_code == "not_expected"


def test_a_scanner_clock_set_forward_stops_assignment_until_the_clocks_are_compared(config, record):
    begin_hold(record, time.time() - 100.0, expected=9)
    with listening(config) as listener:
        send(listener.port, mr_data_set("1.2.1", began_s=time.time() - 40.6))
        assert rows(record, 1)[0].state == "assigned"
        send(listener.port, mr_data_set("1.2.2", began_s=time.time() + 30.0))
        assert rows(record, 2)[1].reason_code == "clock_unknown"
        assert alarms(record) == ["clock_jump"]
        # what was known is not replaced by what contradicts it
        send(listener.port, mr_data_set("1.2.3", began_s=time.time() + 29.4))
        waiting = rows(record, 3)[2]
        assert (waiting.state, waiting.reason_code) == ("pending", "clock_unknown")
        assert "ahead of the comparison: compare the clocks, or confirm" in waiting.reason
        sync_clock(record, -30.0, 0.1, "anna")
        wait_for(lambda: "before the scanner's clock was set" in record.slices()[2].reason)


def test_a_slice_that_seems_minutes_late_is_set_aside_with_an_alarm(tmp_path):
    config = write_room(tmp_path, late_limit_s=30.0, **COMPARED)
    with CaseRecord(tmp_path / "case", create=True) as record, listening(config) as listener:
        begin_hold(record, time.time() - 5.0, expected=9)
        send(listener.port, mr_data_set("1.2.1", began_s=time.time() - 0.6))
        assert rows(record, 1)[0].state == "assigned"
        send(listener.port, mr_data_set("1.2.2", began_s=time.time() - 60.6))
        assert rows(record, 2)[1].reason_code == "late_or_clock_jump"
        assert alarms(record) == ["late_or_clock_jump"]


@pytest.mark.parametrize("keys", [{}, {"prompt_delay_s": 3.0}], ids=["nothing known", "promptness"])
def test_a_slice_of_before_the_hold_that_is_pushed_late_waits_for_the_clocks_to_be_compared(
    tmp_path, keys
):
    """Equal clocks, and nothing that shows it: acquired before the robot stood, pushed after."""
    config = write_room(tmp_path, **keys)
    with CaseRecord(tmp_path / "case", create=True) as record, listening(config) as listener:
        settled_s = time.time() - 20.0
        hold_id = begin_hold(record, settled_s, expected=9)
        send(listener.port, mr_data_set("1.2.1", began_s=settled_s - 6.0))
        (row,) = rows(record, 1)
        assert (row.state, row.reason_code) == ("pending", "clock_unknown")
        assert "compare the clocks, or confirm the hold at which" in row.reason
        good = mr_data_set("1.2.2", began_s=settled_s + 2.0)
        good.AcquisitionNumber = 2
        send(listener.port, good)
        assert rows(record, 2)[1].reason_code == "clock_unknown"
        sync_clock(record, 0.0, 0.5, "anna")
        wait_for(lambda: [r.state for r in record.slices()] == ["quarantined", "assigned"])
        early, late = record.slices()
        assert early.reason_code in ("outside_hold", "no_open_hold")
        assert "before" in early.reason
        assert late.hold_id == hold_id


@pytest.mark.parametrize(("early_s", "late_s"), [(2.0, 6.0), (4.0, 8.0), (10.0, 20.0)])
def test_after_a_comparison_no_earlier_slice_says_how_late_this_one_is(tmp_path, early_s, late_s):
    config = write_room(tmp_path, clock_offset_s=0.0, clock_uncertainty_s=1.0)
    with CaseRecord(tmp_path / "case", create=True) as record, listening(config) as listener:
        settled_s = time.time() - late_s
        send(listener.port, mr_data_set("1.2.1", began_s=settled_s - 60.0))
        rows(record, 1)
        begin_hold(record, settled_s, expected=9)
        early = mr_data_set("1.2.2", began_s=settled_s - early_s)
        good = mr_data_set("1.2.3", began_s=settled_s + 2.0)
        early.AcquisitionNumber, good.AcquisitionNumber = 2, 3
        send(listener.port, early, good)
        assert [row.state for row in rows(record, 3)][1:] == ["quarantined", "assigned"]


def test_a_comparison_counts_at_the_hold_that_stood_and_a_slice_at_the_next_one_waits(
    tmp_path, record
):
    config = write_room(tmp_path, **{**COMPARED, "clock_may_be_set": True})
    with listening(config) as listener:
        sync_clock(record, 0.0, 0.05, "anna")
        hold_id = begin_hold(record, time.time())
        began_s = time.time() + 0.3
        wait_for(lambda: time.time() > began_s + 0.6)
        send(listener.port, mr_data_set("1.2.1", began_s=began_s))
        waiting = rows(record, 1)[0]
        assert (waiting.state, waiting.reason_code) == ("pending", "clock_unknown")
        assert f"not been compared since hold {hold_id} settled" in waiting.reason
        sync_clock(record, 0.0, 0.05, "anna")
        wait_for(lambda: record.slices()[0].hold_id == hold_id)


def test_a_comparison_from_long_ago_holds_no_more_unless_the_scanner_is_synchronized(tmp_path):
    hours_ago = datetime.fromtimestamp(time.time() - 7200, UTC).isoformat()
    config = write_room(tmp_path, **COMPARED, clock_compared_at=hours_ago)
    with CaseRecord(tmp_path / "case", create=True) as record, listening(config) as listener:
        begin_hold(record, time.time() - 20.0, expected=9)
        send(listener.port, mr_data_set("1.2.1", began_s=time.time() - 0.6))
        assert "compared 120 min before" in rows(record, 1)[0].reason
        disciplined = mr_data_set("1.2.2", began_s=time.time() - 0.6)
        disciplined.AcquisitionTimeSynchronized = "Y"
        send(listener.port, disciplined)
        assert rows(record, 2)[1].state == "assigned"


def test_after_the_clock_was_set_what_was_acquired_before_may_not_be_told_from_what_is_new(
    config, record
):
    """The clock goes back by 60 s, somebody compares: a slice of before looks a minute later."""
    settled_s = time.time() - 25.0
    begin_hold(record, settled_s, expected=9)
    with listening(config) as listener:
        sync_clock(record, 60.0, 0.1, "anna")
        of_before = mr_data_set("1.2.1", began_s=settled_s - 50.0)
        new = mr_data_set("1.2.2", began_s=time.time() - 60.6)
        new.AcquisitionNumber = 2
        send(listener.port, of_before, new)
        assert {row.state for row in rows(record, 2)} == {"pending"}


def test_in_arrival_mode_a_confirmed_acquisition_needs_no_time(tmp_path):
    config = write_room(tmp_path, arrival_mode=True)
    with CaseRecord(tmp_path / "case", create=True) as record, listening(config) as listener:
        hold_id = begin_hold(record, time.time() - 5.0)
        timeless = mr_data_set()
        del timeless.AcquisitionDateTime
        send(listener.port, timeless)
        assert rows(record, 1)[0].reason_code == "not_confirmed"
        record.append_event(
            "acquisition_confirmed", {"hold_id": hold_id}, source="service", who="anna"
        )
        wait_for(lambda: record.slices()[0].state == "assigned")
        assert record.slices()[0].time_source == "arrival"


def test_what_was_received_before_a_restart_keeps_its_meaning_after(config, record):
    hold_id = begin_hold(record, time.time() - 5.0, expected=2)
    with listening(config) as listener:
        send(listener.port, mr_data_set("1.2.1", began_s=time.time() - 0.6))
        rows(record, 1)
    with listening(config) as listener:
        first = mr_data_set("1.2.1", began_s=time.time() - 0.6)
        send(listener.port, first, mr_data_set("1.2.2", began_s=time.time() - 0.6))
        found = rows(record, 3)
    assert [row.reason_code for row in found] == ["", "same_uid_other_bytes", ""]
    assert [row.hold_id for row in found] == [hold_id, None, hold_id]


def test_metrics_count_what_happened(tmp_path):
    config = write_room(tmp_path, metrics_port=0)
    with listening(config) as listener:
        send(listener.port, mr_data_set())
        url = f"http://127.0.0.1:{listener.ready['metrics_port']}/metrics"

        def page() -> str:
            with urllib.request.urlopen(url) as answer:
                return answer.read().decode()

        wait_for(lambda: 'reason="no_open_hold",state="quarantined"} 1.0' in page())
        text = page()
    assert "autospine_listener_slices_stored_total 1.0" in text
    assert "autospine_listener_store_seconds_count 1.0" in text
    assert re.search(r"autospine_listener_disk_free_bytes \d", text)


def test_no_patient_is_in_the_log_or_in_the_record(config, record):
    with listening(config) as listener:
        send(listener.port, mr_data_set())
        rows(record, 1)
        log_file = listener.log
    text = log_file.read_text()
    for event in record.events():
        text += json.dumps(event.body)
    text += json.dumps(record.slices()[0].header)
    assert "serving" in text
    assert "Doe" not in text
    assert "4711" not in text


def run_listener(config: Path, *words: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "dicom_listener.command_line", "--config", str(config), *words]
    return subprocess.run(command, capture_output=True, text=True, cwd=ROOT, timeout=300)


def test_a_bad_configuration_ends_with_code_2_and_one_line(tmp_path):
    ended = run_listener(write_room(tmp_path, prot=1))
    assert ended.returncode == 2
    assert "prot" in ended.stderr
    assert len(ended.stderr.strip().splitlines()) == 1


@pytest.mark.parametrize(
    ("listener", "text"),
    [
        ({"peer_networks": ["10.0.0.0/99"]}, "10.0.0.0/99"),
        ({"scanner_time_zone": "Mars/Olympus"}, "Mars/Olympus"),
        (
            {"tls_certificate": "a", "tls_key": "b", "tls_authority": "c"},
            "certificates cannot be used",
        ),
        ({"tls_certificate": "a"}, "belong together"),
        ({"max_associations": 0}, "max_associations"),
    ],
)
def test_what_cannot_work_is_a_configuration_error_before_anything_is_served(
    tmp_path, listener, text
):
    path = write_room(tmp_path, **listener)
    with pytest.raises(ConfigError, match=text):
        run(load_config(path, {}), threading.Event(), lambda ready: pytest.fail("served"))


def test_a_port_in_use_ends_with_code_2_and_one_line(tmp_path, config):
    with listening(config) as listener:
        second = tmp_path / "second"
        second.mkdir()
        ended = run_listener(write_room(second, port=listener.port))
        assert ended.returncode == 2
        assert f"127.0.0.1:{listener.port}" in ended.stderr
        assert len(ended.stderr.strip().splitlines()) == 1


def test_a_second_listener_on_the_same_case_ends_with_code_2_and_one_line(config):
    with listening(config) as listener:
        ended = run_listener(config)
        assert ended.returncode == 2
        assert "another listener" in ended.stderr
        assert str(listener.process.pid) in ended.stderr
        assert len(ended.stderr.strip().splitlines()) == 1
        assert send(listener.port, mr_data_set()) == [0]
        listener.kill()
    with listening(config) as listener:
        assert send(listener.port, mr_data_set("1.2.826.0.5")) == [0]


def test_check_tries_everything_once(config):
    ended = run_listener(config, "--check")
    assert ended.returncode == 0, ended.stdout + ended.stderr
    assert re.findall(r"^ok +(\w+):", ended.stdout, re.M) == ["disk", "write", "clock", "echo"]


def test_check_beside_the_running_listener_asks_that_one(tmp_path):
    with listening(write_room(tmp_path)) as listener:
        config = write_room(tmp_path, port=listener.port)
        ended = run_listener(config, "--check")
        assert ended.returncode == 0, ended.stdout + ended.stderr
        assert f"by the process that has the port: C-ECHO answered on port {listener.port}" in (
            ended.stdout
        )


def test_an_alarm_comes_before_the_disk_is_so_full_that_slices_are_refused(tmp_path):
    free_mib = shutil.disk_usage(tmp_path).free // 2**20
    with (
        CaseRecord(tmp_path / "case", create=True) as record,
        listening(write_room(tmp_path, min_free_mib=free_mib * 3 // 4)) as listener,
    ):
        wait_for(lambda: alarms(record) == ["disk_low"])
        assert send(listener.port, mr_data_set()) == [0]


def test_what_was_negotiated_is_in_the_log(config):
    with listening(config) as listener:
        send(listener.port, mr_data_set())
        log_file = listener.log
    lines = [json.loads(line) for line in log_file.read_text().splitlines()]
    (said,) = [line["text"] for line in lines if line["event"] == "association"]
    assert "association of 'SCANNER' (127.0.0.1) to 'AUTOSPINE': accepted" in said
    assert "MR Image Storage in Explicit VR Little Endian: accepted" in said


def test_check_says_when_the_disk_is_low(tmp_path):
    ended = run_listener(write_room(tmp_path, min_free_mib=10**9), "--check")
    assert ended.returncode == 3
    assert "FAIL disk" in ended.stdout


def test_it_ends_when_its_parent_is_gone_and_on_sigterm(config):
    listener = ListenerProcess(config)
    assert listener.end() == 0
    listener = ListenerProcess(config)
    listener.process.send_signal(signal.SIGTERM)
    assert listener.process.wait(60) == 0
    listener.end()


# Crashes


class Sender(threading.Thread):
    """Sends slices with content of their own until the peer dies; remembers what was answered."""

    def __init__(self, port: int, name: str) -> None:
        super().__init__()
        self.port, self.prefix = port, name
        self.answered: dict[str, bytes] = {}

    def run(self) -> None:
        ae = AE(f"S{self.prefix}"[:16])
        ae.add_requested_context(MR_IMAGE, [ExplicitVRLittleEndian])
        opened: list[socket.socket] = []  # pynetdicom leaves it open when the peer dies
        remember = (evt.EVT_CONN_OPEN, lambda event: opened.append(event.assoc.dul.socket.socket))
        association = ae.associate(
            "127.0.0.1", self.port, ae_title="AUTOSPINE", evt_handlers=[remember]
        )
        self.messages = mended(association).dimse.msg_queue
        try:
            self.send_all(association)
        finally:
            for sock in opened:
                sock.close()

    def end(self) -> None:
        """The peer is dead: end the wait for its answer, which pynetdicom would sit out."""
        while self.is_alive():
            self.messages.put((None, None))  # type: ignore[arg-type]
            self.join(0.05)

    def send_all(self, association: Association) -> None:
        dice = random.Random(self.prefix)
        number = 0
        while association.is_established:
            number += 1
            uid = f"1.2.826.0.{self.prefix}.{number}"
            data_set = mr_data_set(uid)
            data_set.PixelData = dice.randbytes(48 * 40 * 2)
            try:
                status = association.send_c_store(data_set)
            except (RuntimeError, ValueError):
                return
            if status.get("Status", -1) == 0:
                self.answered[uid] = data_set.PixelData


def processor_s(pid: int) -> float:
    """Processor time that a process has had: what a start takes where nothing else runs."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return sum(map(int, fields[11:13])) / os.sysconf("SC_CLK_TCK")


def crash_campaign(folder: Path, kills: int) -> float:
    """Kill under load, at random instants; return the slowest restart, s of processor time."""
    config = write_room(folder)
    inbox = folder / "case" / "inbox"
    dice = random.Random(20)
    answered: dict[str, bytes] = {}
    slowest_restart_s = 0.0  # of processor time, until it serves
    for kill in range(kills):
        listener = ListenerProcess(config)
        slowest_restart_s = max(slowest_restart_s, processor_s(listener.process.pid))
        senders = [Sender(listener.port, f"{kill + 1}.{n + 1}") for n in range(2)]
        for sender in senders:
            sender.start()
        under_load = dice.randrange(10, 60)
        wait_for(lambda s=senders, n=under_load: sum(len(x.answered) for x in s) >= n)
        time.sleep(dice.uniform(0.0, 0.02))
        listener.kill()
        for sender in senders:
            sender.end()
            answered |= sender.answered
    print(f"{len(answered)} answered in {kills} runs, slowest restart {slowest_restart_s:.2f} s")
    with listening(config), CaseRecord(folder / "case") as record:
        # also what was made durable and not answered any more is taken
        kept = {read_envelope(path)[0].sop_instance_uid for path in inbox.glob("*.dcm")}
        assert kept >= answered.keys()
        wait_for(lambda: {row.sop_instance_uid for row in record.slices()} >= kept)
        record.verify_events()
        by_uid = {row.sop_instance_uid: record.case_dir / row.path for row in record.slices()}
    for uid, pixels in answered.items():
        assert is_whole(by_uid[uid])
        assert by_uid[uid].read_bytes().endswith(pixels)
    assert list(inbox.glob("*.part")) == []
    for path in inbox.glob("*.dcm"):
        assert is_whole(path)
    return slowest_restart_s


def test_what_was_answered_success_survives_kill_9(tmp_path):
    crash_campaign(tmp_path, kills=3)


@pytest.mark.soak
def test_what_was_answered_success_survives_twenty_kills(tmp_path):
    assert crash_campaign(tmp_path, kills=20) < 2.0
