"""The computer in the scanner room has Python, pyserial, cobs and cbor2, and nothing else."""

import importlib.util
import os
import subprocess
import sys
import tomllib
import venv
import zipfile
from pathlib import Path

import pytest
from bridge_room import AXES, bridge_room
from packaging.requirements import Requirement

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


def build_wheel(folder: Path) -> Path:
    """As `make bridge-wheel` does, with the build backend of this environment."""
    project = Path(__file__).parents[2] / "wheels" / "robot_bridge"
    command = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(folder)]
    subprocess.run(command, cwd=project, check=True, capture_output=True)
    (wheel,) = folder.glob("autospine_bridge-*.whl")
    return wheel


def dependencies() -> list[str]:
    project = Path(__file__).parents[2] / "wheels" / "robot_bridge" / "pyproject.toml"
    return [
        Requirement(d).name for d in tomllib.loads(project.read_text())["project"]["dependencies"]
    ]


def test_a_wheel_of_the_bridge_alone_runs_with_its_three_dependencies(tmp_path: Path):
    """Its own files and nothing else of the project, in an interpreter without site packages."""
    site = tmp_path / "site"
    with zipfile.ZipFile(build_wheel(tmp_path / "dist")) as wheel:
        tops = {name.split("/")[0] for name in wheel.namelist()}
        assert {top for top in tops if not top.endswith(".dist-info")} == {"robot_bridge"}
        wheel.extractall(site)
    for name in dependencies():
        module = {"pyserial": "serial"}.get(name, name)
        package = importlib.util.find_spec(module)
        assert package is not None
        assert package.origin is not None
        (site / module).symlink_to(Path(package.origin).parent)
    assert {entry.name for entry in site.iterdir() if entry.is_symlink()} == ALLOWED - {
        "robot_bridge"
    }
    bare = {"PYTHONPATH": str(site), "PATH": os.environ["PATH"]}
    python = [sys.executable, "-S", "-m"]
    for module in ("robot_bridge", "robot_bridge.engineer.main", "robot_bridge.emulator"):
        told = subprocess.run(
            [*python, module, "--help"], env=bare, cwd=tmp_path, capture_output=True, text=True
        )
        assert told.returncode == 0, told.stderr
    with bridge_room(tmp_path) as room:
        room.start_daemon(python=["env", "-i", f"PYTHONPATH={site}", *python, "robot_bridge"])
        client = room.ready_client()
        assert client.move("a", dict.fromkeys(AXES, 500), "m1").done, room.log


@pytest.mark.soak
def test_the_wheel_installs_and_runs_in_an_empty_environment(tmp_path: Path):
    """With the package index: what an engineer does on the small computer."""
    environment = tmp_path / "venv"
    venv.create(environment, with_pip=True)
    scripts = environment / "bin"
    wheel = build_wheel(tmp_path / "dist")
    pip = [str(scripts / "python"), "-m", "pip", "install", "--quiet"]
    subprocess.run([*pip, "--disable-pip-version-check", str(wheel)], check=True)
    with bridge_room(tmp_path) as room:
        room.start_daemon(python=[str(scripts / "autospine-bridge")])
        assert room.ready_client().move("a", dict.fromkeys(AXES, 500), "m1").done, room.log
        config = ["--config", str(room.config_file), "--link", room.line.far]
        status = subprocess.run(
            [str(scripts / "autospine-robot"), *config, "status"], capture_output=True, text=True
        )
        assert status.returncode == 0, status.stderr
