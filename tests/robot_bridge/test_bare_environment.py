"""The computer in the scanner room has Python, pyserial, cobs and cbor2, and nothing else."""

import subprocess
import sys
import venv
from pathlib import Path

import pytest
from bridge_room import AXES, bridge_room

ALLOWED = {"robot_bridge", "serial", "cobs", "cbor2"}

ONLY_THE_BRIDGES_OWN = f"""
import runpy, sys

class Refuse:
    def find_spec(self, name, path=None, target=None):
        top = name.partition(".")[0]
        if top in sys.stdlib_module_names or top in {ALLOWED!r} or top.startswith("_"):
            return None
        raise ModuleNotFoundError(f"no module named {{name!r}} in the scanner room", name=name)

sys.meta_path.insert(0, Refuse())
sys.argv[0] = "robot_bridge"
runpy.run_module("robot_bridge", run_name="__main__", alter_sys=True)
"""


def test_the_daemon_moves_the_robot_with_its_own_packages_only(tmp_path: Path):
    with bridge_room(tmp_path) as room:
        room.start_daemon(python=[sys.executable, "-c", ONLY_THE_BRIDGES_OWN])
        client = room.ready_client()
        assert client.move("a", dict.fromkeys(AXES, 500), "m1").done, room.log
        assert room.controllers.positions_um() == pytest.approx(dict.fromkeys(AXES, 500), abs=20)


def test_the_refusal_above_would_be_noticed(tmp_path: Path):
    code = ONLY_THE_BRIDGES_OWN.replace('"robot_bridge", run_name', '"numpy", run_name')
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert "in the scanner room" in ended.stderr


@pytest.mark.soak
def test_the_daemon_runs_in_a_fresh_environment(tmp_path: Path):
    environment = tmp_path / "venv"
    venv.create(environment, with_pip=True)
    python = str(environment / "bin" / "python")
    packages = ["pyserial", "cobs", "cbor2"]
    subprocess.run(
        [python, "-m", "pip", "install", "--quiet", "--disable-pip-version-check", *packages],
        check=True,
    )
    site = next((environment / "lib").glob("python*/site-packages"))
    (site / "robot_bridge").symlink_to(Path(__file__).parents[2] / "robot_bridge")
    with bridge_room(tmp_path) as room:
        room.start_daemon(python=[python, "-m", "robot_bridge"])
        assert room.ready_client().move("a", dict.fromkeys(AXES, 500), "m1").done, room.log
