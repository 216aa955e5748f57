"""`autospine commission` as a process: prompts, presses, slices, and what it writes."""

import random
import subprocess
import sys
import time
import tomllib
from pathlib import Path

import pytest
from pynetdicom import AE
from virtual_commissioning import Truth, VirtualTechnologist

from dicom_listener.association_fix import mended
from dicom_slice.quirks import MR_IMAGE

ROOT = Path(__file__).parents[2]
ROOM = """[room]
name = "a site"
case_dir = "case"
[listener]
port = 0
min_free_mib = 1
[imaging]
start_region_px = [30, 30, 98, 98]
[service]
bridge_link = "/dev/null"
"""


class Commissioning:
    """The process, and a technologist at the virtual console who does what it says."""

    def __init__(self, folder: Path) -> None:
        (folder / "room.toml").write_text(ROOM)
        self.out = folder / "out"
        words = ["commission", "--config", "room.toml", "--out", "out", "--who", "A. Nobody"]
        self.process = subprocess.Popen(
            [sys.executable, "-c", "from service.cli.main import main; main()", *words],
            cwd=folder, env={"PYTHONPATH": str(ROOT), "PATH": ""}, text=True,
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
        )  # fmt: skip
        self.port = int(self.line("received on port").split("port ")[1].split(" ")[0])

    def line(self, words: str) -> str:
        said = []
        for line in self.process.stdout:
            said.append(line)
            if words in line:
                return line
        raise AssertionError("".join(said))

    def press(self) -> None:
        self.process.stdin.write("\n")
        self.process.stdin.flush()

    def end(self) -> tuple[int, str]:
        rest, _ = self.process.communicate(timeout=120)
        return self.process.returncode, rest

    def scan(self, technologist: VirtualTechnologist, sign: int) -> None:
        """Four slices in real time; the technologist presses a quarter of a second late."""
        room, series = technologist.begin(sign)
        self.line("STARTS")
        technologist.now_s = time.time() - 0.25
        images = []
        for index in range(4):
            images.append(technologist.image(room, series, index))
            technologist.now_s += technologist.length_s
        self.press()
        self.line("ENDS")
        while time.time() < technologist.now_s + 0.25:
            time.sleep(0.01)
        self.press()
        self.send(images)

    def send(self, images) -> None:
        ae = AE("VIRTUALMR")
        ae.add_requested_context(MR_IMAGE)
        association = mended(ae.associate("127.0.0.1", self.port, ae_title="AUTOSPINE"))
        for image in images:
            assert association.send_c_store(image).Status == 0
        association.release()


@pytest.fixture
def technologist():
    return VirtualTechnologist(Truth(12.0, lambda: 0.0), random.Random(3), length_s=0.2)


def test_a_commissioning_that_was_broken_off_goes_on_and_ends_with_keys_and_an_acceptance(
    tmp_path, technologist
):
    first = Commissioning(tmp_path)
    for _ in range(2):
        first.scan(technologist, 1)
        first.line("4 of 4 slices arrived")
    first.line("STARTS")
    first.process.stdin.close()
    assert first.process.wait(60) == 3
    assert "interrupted; run it again with the same --out" in first.process.stdout.read()
    first.process.stdout.close()
    second = Commissioning(tmp_path)
    assert "Series 3" in second.line("Series")
    for sign in (1, 1, 1, -1):
        second.scan(technologist, sign)
        second.line("4 of 4 slices arrived")
    code, said = second.end()
    assert code == 0, said
    assert "Accepted. Keys for the room's file" in said
    keys = tomllib.loads((second.out / "room_keys.toml").read_text())
    listener = keys["listener"]
    assert abs(listener["clock_offset_s"] - 12.0) <= listener["clock_uncertainty_s"]
    assert keys["imaging"]["readout_polarity"] == 1
    assert keys["imaging"]["point_spread"]["kind"] == "flat"
    assert "signed by A. Nobody" in (second.out / "acceptance.html").read_text()
    assert (second.out / "acceptance.pdf").stat().st_size > 1000
