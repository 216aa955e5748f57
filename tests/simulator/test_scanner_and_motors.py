"""The virtual scanner beside the process of the emulated motor controllers."""

import json
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import serial
from neighbours import Page, Receiver, wait_until

from simulator.config import parse_virtual_room
from simulator.scan_operator import operate
from simulator.scene import true_fiducial_mm
from simulator.truth_client import TruthAddress, TruthError, ask_path, ask_where

ROOT = Path(__file__).parents[2]


@contextmanager
def motors(folder: Path) -> Iterator[dict[str, Any]]:
    command = [sys.executable, "-m", "simulator.motors", "--axes", "xt,yt", "--seed", "3"]
    paths = ["--pty-path", str(folder / "motors.pty"), "--state", str(folder / "stages.json")]
    with subprocess.Popen([*command, *paths], cwd=ROOT, stdout=subprocess.PIPE) as process:
        try:
            assert process.stdout is not None
            yield json.loads(process.stdout.readline())
        finally:
            process.terminate()


def _answer(line: serial.Serial, question: bytes) -> bytes:
    line.reset_input_buffer()
    line.write(question)
    return bytes(line.read_until(b"\r"))


def test_what_the_motors_do_is_what_the_scanner_sees(
    tmp_path: Path, page: Page, receiver: Receiver
) -> None:
    stop = threading.Event()
    with motors(tmp_path) as ready, serial.Serial(ready["pty"], 115200, timeout=1) as line:
        address = TruthAddress("127.0.0.1", ready["truth_port"])
        table = {
            "service_url": page.url,
            "listener_port": receiver.port,
            "motors_truth_port": address.port,
            "truth_file": str(tmp_path / "truth.jsonl"),
            "acquisition_s": 0.8,
            "poll_s": 0.01,
        }
        room = parse_virtual_room({"scanner": table})
        scanner = threading.Thread(target=operate, args=(room, stop, print))
        scanner.start()
        try:
            before_s = time.time()
            page.ask_for("standing")
            receiver.wait_for(1)
            line.write(b"X1M2\r")
            wait_until(lambda: _answer(line, b"X1M\r") == b"X1M:2\r", "unparked")
            line.write(b"X1J1000,0,250\r")  # about 4.4 mm in four seconds
            while ask_where(address).positions_mm["xt"] < 0.1:
                time.sleep(0.005)
            page.ask_for("moving")
            receiver.wait_for(2)
            while ask_where(address).moving:
                time.sleep(0.02)
            page.ask_for("there")
            receiver.wait_for(3)
            now = ask_where(address).positions_mm
            path = ask_path(address, before_s, time.time())
        finally:
            stop.set()
            scanner.join()
    lines = [json.loads(entry) for entry in (tmp_path / "truth.jsonl").read_text().splitlines()]
    standing, moving, there = (entry for entry in lines if entry["kind"] == "acquisition")
    assert standing["travel_mm"] == 0
    assert standing["stage_mm"] == {"xt": 0.0, "yt": 0.0}
    assert 0.3 < moving["travel_mm"] < 1.5
    assert there["travel_mm"] == 0
    assert there["stage_mm"] == now
    assert 3.5 < now["xt"] < 5.5
    assert np.allclose(there["fiducials"]["upper"]["patient_mm"], true_fiducial_mm(room, now))
    assert path.travel_mm == pytest.approx(now["xt"], abs=0.01)


def test_motors_that_are_not_there_are_an_error_that_names_their_address(tmp_path: Path) -> None:
    with motors(tmp_path) as ready:
        address = TruthAddress("127.0.0.1", ready["truth_port"])
        ask_where(address)
    with pytest.raises(TruthError, match=f":{address.port}: .*refused"):
        ask_where(address)
