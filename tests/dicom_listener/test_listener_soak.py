"""Ten thousand slices and five thousand bare connections: nothing grows."""

import random
import socket
import time
from pathlib import Path

import pytest
from listener_room import ListenerProcess, wait_for, write_room
from made_slices import mr_data_set
from pydicom.uid import ExplicitVRLittleEndian
from pynetdicom import AE

from case_record.record import CaseRecord
from dicom_listener.association_fix import mended
from dicom_slice.quirks import MR_IMAGE


def resident_kib(pid: int) -> int:
    for line in Path(f"/proc/{pid}/status").read_text().splitlines():
        if line.startswith("VmRSS"):
            return int(line.split()[1])
    raise AssertionError("no VmRSS")


def threads(pid: int) -> int:
    return len(list(Path(f"/proc/{pid}/task").iterdir()))


def send_slices(port: int, first: int, count: int, per_association: int) -> None:
    dice = random.Random(first)
    for start in range(first, first + count, per_association):
        ae = AE("SOAK")
        ae.add_requested_context(MR_IMAGE, [ExplicitVRLittleEndian])
        association = mended(ae.associate("127.0.0.1", port, ae_title="AUTOSPINE"))
        assert association.is_established
        sock = association.dul.socket.socket
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        data_set = mr_data_set()
        for number in range(start, min(start + per_association, first + count)):
            data_set.SOPInstanceUID = f"1.2.826.0.7.{number + 1}"
            data_set.file_meta.MediaStorageSOPInstanceUID = data_set.SOPInstanceUID
            data_set.AcquisitionNumber = number + 1
            data_set.PixelData = dice.randbytes(48 * 40 * 2)
            assert association.send_c_store(data_set).Status == 0
        association.release()


def bare_connections(port: int, count: int) -> None:
    for number in range(count):
        with socket.create_connection(("127.0.0.1", port), 60) as sock:
            if number % 10 == 0:
                sock.sendall(b"GET / HTTP/1.0\r\n\r\n")


def soak(folder: Path, warm_up: int, slices: int, connections: int) -> tuple[float, int, int]:
    """Return (growth of resident memory, threads before, threads after) past the warm-up."""
    listener = ListenerProcess(write_room(folder))
    pid = listener.process.pid
    try:
        with CaseRecord(folder / "case") as record:
            send_slices(listener.port, 0, warm_up, 100)
            bare_connections(listener.port, connections // 10)
            wait_for(lambda: sum(record.count_slices().values()) == warm_up, 600)
            time.sleep(2)
            before_kib, threads_before = resident_kib(pid), threads(pid)
            send_slices(listener.port, warm_up, slices, 100)
            bare_connections(listener.port, connections)
            wait_for(lambda: sum(record.count_slices().values()) == warm_up + slices, 600)
            wait_for(lambda: threads(pid) <= threads_before)
            after_kib, threads_after = resident_kib(pid), threads(pid)
            record.verify_events()
    finally:
        listener.end()
    growth = after_kib / before_kib - 1
    print(f"resident {before_kib} -> {after_kib} KiB ({growth:+.1%}), threads {threads_after}")
    return growth, threads_before, threads_after


def test_slices_and_bare_connections_leave_no_threads_behind(tmp_path):
    growth, before, after = soak(tmp_path, warm_up=50, slices=150, connections=300)
    assert after <= before
    assert growth < 0.2


@pytest.mark.soak
def test_ten_thousand_slices_and_five_thousand_connections_grow_nothing(tmp_path):
    growth, before, after = soak(tmp_path, warm_up=2000, slices=10_000, connections=5000)
    assert after <= before
    assert growth <= 0.05
