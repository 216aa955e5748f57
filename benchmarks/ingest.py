"""Reception side by side: our listener, DCMTK's storescp and Orthanc, fed by the same dcmsend.

Every receiver runs at its defaults as a process of its own on this machine; ours makes each slice
durable (fsync of file and folder) before it answers and assigns it to a hold besides. The senders
are unmodified; `nodelay` is the same with TCP_NODELAY set in their environment. Of the pattern
with an association a slice a fifth of the slices is sent. Each result is also said on standard
error as it comes; a part that fails is named under "problems" and costs only itself.
"""

import argparse
import contextlib
import json
import os
import shutil
import signal
import socket
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from datetime import datetime
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))

import numpy as np
from pydicom import dcmread
from pydicom.dataset import FileDataset, FileMetaDataset
from pydicom.uid import ExplicitVRLittleEndian, generate_uid
from pynetdicom import AE

from case_record.record import CaseRecord, CaseRecordError
from dicom_listener.association_fix import mended
from dicom_slice.quirks import MR_IMAGE

ROOT = Path(__file__).parents[1]
TITLE = "AUTOSPINE"
NODELAY = {"TCP_NODELAY": "1"}
PATTERNS = ("one_association", "association_a_slice", "four_senders", "one_association_nodelay")
ASSOCIATIONS_PART = 5
LIMIT_S = 240  # for one part: several times what the slowest takes on an idle machine


def write_slices(folder: Path, count: int, offset: int) -> list[Path]:
    """128 x 128 coronal slices, acquired half a minute ago."""
    folder.mkdir(parents=True)
    study, series, frame = generate_uid(), generate_uid(), generate_uid()
    pixels = np.random.default_rng(offset).integers(0, 4000, (128, 128)).astype("<u2")
    began = datetime.fromtimestamp(time.time() - 30)
    return [
        _write_slice(folder / f"{k:05d}.dcm", k, (study, series, frame), pixels, began)
        for k in range(count)
    ]


def _write_slice(
    path: Path, number: int, uids: tuple[str, str, str], pixels: Any, began: datetime
) -> Path:
    meta = FileMetaDataset()
    meta.MediaStorageSOPClassUID = MR_IMAGE
    meta.MediaStorageSOPInstanceUID = generate_uid()
    meta.TransferSyntaxUID = ExplicitVRLittleEndian
    slice_ = FileDataset("", {}, file_meta=meta, preamble=bytes(128))
    slice_.SOPClassUID, slice_.SOPInstanceUID = MR_IMAGE, meta.MediaStorageSOPInstanceUID
    slice_.ImageType = ["ORIGINAL", "PRIMARY", "M"]
    slice_.Modality, slice_.Manufacturer = "MR", "Benchmark"
    slice_.StudyInstanceUID, slice_.SeriesInstanceUID, slice_.FrameOfReferenceUID = uids
    slice_.PatientName, slice_.PatientID, slice_.StudyID = "Bench^Mark", "BENCH", "1"
    slice_.StudyDate, slice_.StudyTime = began.strftime("%Y%m%d"), began.strftime("%H%M%S")
    slice_.AcquisitionDateTime = began.strftime("%Y%m%d%H%M%S.%f")
    slice_.AcquisitionDuration = 1.0
    slice_.SeriesNumber, slice_.AcquisitionNumber, slice_.InstanceNumber = 1, 1, number + 1
    slice_.ImagePositionPatient = [-64, 10, 64]
    slice_.ImageOrientationPatient = [1, 0, 0, 0, 0, -1]
    slice_.PixelSpacing, slice_.SliceThickness = [1, 1], 3
    slice_.Rows, slice_.Columns = pixels.shape
    slice_.SamplesPerPixel, slice_.PhotometricInterpretation = 1, "MONOCHROME2"
    slice_.BitsAllocated, slice_.BitsStored, slice_.HighBit = 16, 12, 11
    slice_.PixelRepresentation = 0
    slice_.PixelData = np.roll(pixels, number).tobytes()
    slice_.save_as(path, enforce_file_format=True)
    return path


# Receivers: each yields the port that it listens on, and its process


@contextlib.contextmanager
def _running(command: list[str], folder: Path, **options: Any) -> Iterator[subprocess.Popen[bytes]]:
    with (folder / "log").open("ab") as log:
        process = subprocess.Popen(command, stderr=log, cwd=ROOT, **options)
    try:
        yield process
    finally:
        process.send_signal(signal.SIGTERM)
        try:
            process.wait(20)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        if process.stdout is not None:
            process.stdout.close()


Receiver = Callable[[Path], contextlib.AbstractContextManager[tuple[int, int]]]


@contextlib.contextmanager
def ours(folder: Path) -> Iterator[tuple[int, int]]:
    """A real listener with an open hold that expects every slice."""
    config = folder / "room.toml"
    config.write_text(
        '[room]\nname = "bench"\ncase_dir = "case"\n[listener]\nport = 0\nmin_free_mib = 1\n'
        '[service]\nbridge_link = "/dev/null"\n'
    )
    with CaseRecord(folder / "case", create=True) as record:
        record.begin_hold(
            set_id=1,
            place=0,
            setpoints_um={},
            readback_um={},
            shift_um={},
            shift_px=(0.0, 0.0),
            settled_at_s=time.time() - 3600,
            expected_slices=1_000_000,
        )
    command = [sys.executable, "-m", "dicom_listener.command_line", "--config", str(config)]
    with _running(command, folder, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        yield json.loads(process.stdout.readline())["port"], process.pid


@contextlib.contextmanager
def storescp(folder: Path) -> Iterator[tuple[int, int]]:
    port = _free_port()
    (folder / "out").mkdir()
    command = ["storescp", "-aet", TITLE, "-od", str(folder / "out"), str(port)]
    with _running(command, folder) as process:
        _wait_open(port)
        yield port, process.pid


@contextlib.contextmanager
def orthanc(folder: Path) -> Iterator[tuple[int, int]]:
    """Orthanc at its defaults: what is set here is only where, not how."""
    port = _free_port()
    config = {
        "StorageDirectory": str(folder / "db"),
        "IndexDirectory": str(folder / "db"),
        "Plugins": [],
        "DicomAet": TITLE,
        "DicomPort": port,
        "HttpPort": _free_port(),
        "RemoteAccessAllowed": False,
        "AuthenticationEnabled": False,
    }
    (folder / "orthanc.json").write_text(json.dumps(config))
    command = [_program("Orthanc"), str(folder / "orthanc.json")]
    with _running(command, folder, stdout=subprocess.DEVNULL) as process:
        _wait_open(port)
        yield port, process.pid


RECEIVERS: dict[str, Receiver] = {"ours": ours, "storescp": storescp, "orthanc": orthanc}


def _program(name: str) -> str:
    return shutil.which(name) or name


def _free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as sock:
        return int(sock.getsockname()[1])


def _wait_open(port: int) -> None:
    deadline_s = time.monotonic() + 30
    while time.monotonic() < deadline_s:
        with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", port), 1):
            time.sleep(0.5)  # let it finish what it does after it listens
            return
        time.sleep(0.1)
    raise TimeoutError(f"nothing listens on port {port}")


# Senders: each returns slices a second, or raises PartError


class PartError(Exception):
    """One part of the comparison did not come to its end; the others stand all the same."""


def _rate(
    port: int, batches: list[list[Path]], env: dict[str, str], options: tuple[str, ...] = ()
) -> float:
    address = ["-aec", TITLE, "127.0.0.1", str(port)]
    began_s = time.perf_counter()
    senders = [
        subprocess.Popen(
            ["dcmsend", *options, *address, *map(str, files)], env={**os.environ, **env}
        )
        for files in batches
    ]
    try:
        codes = [sender.wait(LIMIT_S) for sender in senders]
    except subprocess.TimeoutExpired:
        raise PartError(f"dcmsend had not ended after {LIMIT_S} s") from None
    finally:
        for sender in senders:
            sender.kill()
            sender.wait()
    if any(codes):
        raise PartError(f"dcmsend ended with {codes}")
    return sum(map(len, batches)) / (time.perf_counter() - began_s)


def send(pattern: str, port: int, files: list[Path]) -> float:
    # A busy machine, or a receiver that serves one association after the other (storescp): wait.
    patient = ("--acse-timeout", str(LIMIT_S))
    if pattern == "four_senders":
        return _rate(port, [files[k::4] for k in range(4)], {}, patient)
    if pattern == "association_a_slice":
        few = files[: max(10, len(files) // ASSOCIATIONS_PART)]
        began_s = time.perf_counter()
        for path in few:
            _rate(port, [[path]], {}, patient)
        return len(few) / (time.perf_counter() - began_s)
    return _rate(port, [files], NODELAY if pattern.endswith("nodelay") else {}, patient)


# Latencies of ours


def latencies(folder: Path, files: list[Path]) -> dict[str, float]:
    """ms from sending a slice (encoding it included) to its answer, and from receipt to row."""
    with ours(folder) as (port, _):
        answer_ms = _answer_ms(port, [dcmread(path) for path in files])
        with CaseRecord(folder / "case") as record:
            deadline_s = time.monotonic() + LIMIT_S
            while record.count_slices().get("assigned", 0) < len(files):
                if time.monotonic() > deadline_s:
                    raise PartError(f"assigned after {LIMIT_S} s: {record.count_slices()}")
                time.sleep(0.05)
            assigned_ms = [
                (event.wall_s - event.body["received_s"]) * 1e3
                for event in record.events_of_kind("slice_received")
            ]
    return {
        **_percentiles("first_byte_to_answer_ms", answer_ms),
        **_percentiles("receipt_to_assigned_ms", assigned_ms),
    }


def _answer_ms(port: int, slices: list[FileDataset]) -> list[float]:
    ae = AE("BENCH")
    ae.acse_timeout = ae.dimse_timeout = LIMIT_S
    ae.add_requested_context(MR_IMAGE, [ExplicitVRLittleEndian])
    association = mended(ae.associate("127.0.0.1", port, ae_title=TITLE))
    if not association.is_established:
        raise PartError("no association with our listener")
    connection = association.dul.socket.socket
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    answer_ms = []
    for slice_ in slices:
        began_s = time.perf_counter()
        status = association.send_c_store(slice_).get("Status")
        answer_ms.append((time.perf_counter() - began_s) * 1e3)
        if status != 0:
            raise PartError(f"slice {len(answer_ms)} was answered with {status}")
    association.release()
    return answer_ms


def _percentiles(name: str, values: list[float]) -> dict[str, float]:
    cuts = statistics.quantiles(values, n=100)
    return {f"{name}_p50": round(cuts[49], 2), f"{name}_p99": round(cuts[98], 2)}


def _rss_mib(pid: int) -> float:
    for line in Path(f"/proc/{pid}/status").read_text().splitlines():
        if line.startswith("VmRSS"):
            return int(line.split()[1]) / 1024
    return 0.0


class Comparison:
    """Collects what is measured, and says it at once: a part that fails costs only itself."""

    def __init__(self, count: int) -> None:
        self.results: dict[str, Any] = {
            "slices": count,
            **{pattern: {} for pattern in PATTERNS},
            "latency": {},
            "memory_mib_before_after": {},
            "problems": [],
        }

    def measure(self, part: str, name: str, work: Callable[[], Any]) -> None:
        began_s = time.perf_counter()
        try:
            value = work()
        except (PartError, OSError, CaseRecordError) as error:
            value = None
            self.results["problems"].append(f"{part}, {name}: {error}")
        if part == "latency":
            self.results[part] = value or {}
        else:
            self.results[part][name] = value
        took_s = time.perf_counter() - began_s
        print(f"ingest: {part}, {name}: {value} ({took_s:.1f} s)", file=sys.stderr, flush=True)


def run(count: int, base: Path) -> dict[str, Any]:
    comparison = Comparison(count)
    for name, receiver in RECEIVERS.items():
        folder = base / name
        folder.mkdir()
        try:
            with receiver(folder) as (port, pid):
                _compare(comparison, name, folder, port, pid, count)
        except (PartError, OSError, ValueError) as error:
            comparison.results["problems"].append(f"{name}: {error}")
    folder = base / "latency"
    folder.mkdir()
    files = write_slices(folder / "files", count, 7)
    comparison.measure("latency", "ours", lambda: latencies(folder, files))
    return comparison.results


def _compare(
    comparison: Comparison, name: str, folder: Path, port: int, pid: int, count: int
) -> None:
    send("one_association", port, write_slices(folder / "warm", 10, 99))
    before_mib = _rss_mib(pid)
    for number, pattern in enumerate(PATTERNS):
        files = write_slices(folder / pattern, count, number)

        def rate(pattern: str = pattern, files: list[Path] = files) -> float:
            return round(send(pattern, port, files), 1)

        comparison.measure(pattern, name, rate)
        shutil.rmtree(folder / pattern)
    memory_mib = [round(before_mib, 1), round(_rss_mib(pid), 1)]
    comparison.results["memory_mib_before_after"][name] = memory_mib


def _print_table(results: dict[str, Any]) -> None:
    print(f"{'slices/s':<26}" + "".join(f"{name:>10}" for name in RECEIVERS))
    for pattern in PATTERNS:
        rates = [results[pattern].get(name) for name in RECEIVERS]
        print(
            f"{pattern:<26}" + "".join("    failed" if r is None else f"{r:>10.1f}" for r in rates)
        )
    for name, value in results["latency"].items():
        print(f"{name:<34}{value:>8.2f}")
    for name, (before, after) in results["memory_mib_before_after"].items():
        print(f"memory of {name:<12}{before:>8.1f} MiB, after all of it {after:>8.1f} MiB")
    for problem in results["problems"]:
        print(f"did not come to its end: {problem}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="100 slices instead of 500")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    options = parser.parse_args()
    missing = [name for name in ("dcmsend", "storescp", "Orthanc") if not shutil.which(name)]
    if missing:
        sys.exit(f"ingest: not installed: {', '.join(missing)} (dcmtk and orthanc are needed)")
    with tempfile.TemporaryDirectory() as base:
        results = run(100 if options.quick else 500, Path(base))
    if options.json:
        print(json.dumps(results))
    else:
        _print_table(results)
    sys.exit(1 if results["problems"] else 0)


if __name__ == "__main__":
    main()
