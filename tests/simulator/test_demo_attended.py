"""`autospine demo --attended`: the page asks, a person's clicks answer, faults come and go."""

import re
import signal
import subprocess
import time
from pathlib import Path

from room_config.shell import autospine
from service.client import RoomClient

PATIENCE_S = 120.0


def wait_until(look, patience_s: float = PATIENCE_S):
    deadline_s = time.monotonic() + patience_s
    while not (seen := look()):
        assert time.monotonic() < deadline_s
        time.sleep(0.05)
    return seen


def test_a_case_begins_on_the_page_and_faults_are_switched_while_it_runs(tmp_path: Path) -> None:
    said = tmp_path / "said"
    with said.open("wb") as log:
        demo = subprocess.Popen(
            autospine("demo", "--attended", "--case", str(tmp_path / "case")),
            stdin=subprocess.PIPE,
            stderr=log,
            text=True,
        )
    try:
        found = wait_until(lambda: re.search(r"http://127\.0\.0\.1:\d+", said.read_text()))
        wait_until(lambda: "faults" in said.read_text())
        with RoomClient(found.group(), by="visitor") as client:
            wait_until(lambda: client.state().robot.linked)
            assert demo.stdin is not None
            demo.stdin.write("no such fault\nduplicate\n")
            demo.stdin.flush()
            wait_until(lambda: "duplicate is on" in said.read_text())
            assert "unknown fault 'no such fault'" in said.read_text()
            client.reset(client.state().robot.taken_um)
            client.start_calibration()
            wait_until(lambda: client.state().calibrated, 300.0)
            measured = client.state().measurement
            assert measured is not None
            assert measured.patient_mm is not None
            x, y, z = measured.patient_mm
            client.set_target((x + 2.0, y, z))
            client.start_approach()
            # nobody else confirms: the page asks the person
            assert wait_until(lambda: client.state().question).plan is not None
    finally:
        demo.send_signal(signal.SIGINT)
        demo.communicate(timeout=60)
    assert demo.returncode == 0
    truth = (tmp_path / "case" / "virtual" / "acquisitions.jsonl").read_text()
    assert '"duplicate"' in truth
