"""`autospine scanner` as a process of its own."""

import json
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from click.testing import Result
from neighbours import Page, Receiver, Stages
from pydantic import BaseModel
from typer.testing import CliRunner

from simulator import command_line
from simulator.config import (
    Fiducial,
    ScannerSettings,
    StaticObject,
    VirtualRoom,
    VirtualRoomError,
    parse_virtual_room,
)
from simulator.faults import FAULTS

ROOT = Path(__file__).parents[2]
# pynetdicom leaves the socket of a refused connection to the garbage collector
STRICT = ["-W", "error", "-W", "ignore::ResourceWarning"]
COMMAND = [sys.executable, *STRICT, "-m", "simulator.command_line"]


@pytest.fixture
def config(tmp_path: Path, stages: Stages, page: Page, receiver: Receiver) -> Path:
    path = tmp_path / "room.toml"
    path.write_text(
        f"""
        [virtual]
        seed = 5
        [virtual.placement]
        rotation_deg = 2.0
        [virtual.scanner]
        service_url = "{page.url}"
        listener_port = {receiver.port}
        motors_truth_port = {stages.port}
        truth_file = "truth.jsonl"
        acquisition_s = 0.05
        reconstruction_s = 0.02
        poll_s = 0.02
        """
    )
    return path


@contextmanager
def scanner(*arguments: str) -> Iterator[subprocess.Popen[bytes]]:
    process = subprocess.Popen(
        [*COMMAND, *arguments],
        cwd=ROOT,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )
    with process:
        try:
            yield process
        finally:
            process.kill()


def ready(process: subprocess.Popen[bytes]) -> dict[str, Any]:
    assert process.stdout is not None
    line: dict[str, Any] = json.loads(process.stdout.readline())
    return line


def run(config: Path) -> Result:
    return CliRunner().invoke(command_line.app, ["--config", str(config)])


def test_the_process_says_where_its_truth_is_scans_and_ends_with_its_parent(
    config: Path, page: Page, receiver: Receiver
) -> None:
    with scanner("--config", str(config), "--exit-with-parent") as process:
        line = ready(process)
        assert line == {"ready": "scanner", "truth_file": str(config.parent / "truth.jsonl")}
        page.ask_for("r1", hold_id=3, count=2)
        receiver.wait_for(2)
        assert process.stdin is not None
        process.stdin.close()
        assert process.wait(timeout=60) == 0
        assert process.stderr is not None
        assert process.stderr.read() == b""
    truth = [json.loads(entry) for entry in Path(line["truth_file"]).read_text().splitlines()]
    assert [entry["hold_id"] for entry in truth if entry["kind"] == "acquisition"] == [3, 3]


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_ends_the_process_cleanly(config: Path, number: signal.Signals) -> None:
    with scanner("--config", str(config)) as process:
        ready(process)
        os.kill(process.pid, number)
        assert process.wait(timeout=60) == 0
        assert process.stderr is not None
        assert process.stderr.read() == b""


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("seed = 5", "sede = 5"), "virtual.sede"),
        (("rotation_deg = 2.0", 'rotation_deg = "2"'), "virtual.placement.rotation_deg"),
        (("acquisition_s = 0.05", "acquisition_s = nan"), "virtual.scanner.acquisition_s"),
        (("seed = 5", 'faults = ["gremlins"]'), "unknown fault 'gremlins'"),
        (("service_url", "servce_url"), "virtual.scanner.service_url"),
        (("seed = 5", "seed = "), "not valid TOML"),
        (("[virtual.scanner]", "[virtual.motors]"), "virtual.scanner: missing table"),
        (('truth_file = "truth.jsonl"', 'truth_file = "room.toml/x"'), "truth_file"),
    ],
)
def test_a_bad_configuration_is_one_line_that_names_file_and_key(
    config: Path, change: tuple[str, str], message: str
) -> None:
    config.write_text(config.read_text().replace(*change))
    ended = run(config)
    assert ended.exit_code == 2
    assert ended.stdout == ""
    assert ended.stderr.count("\n") == 1
    assert message in ended.stderr
    assert "room.toml" in ended.stderr
    assert "Traceback" not in ended.stderr


def test_the_process_ends_with_code_2_and_one_line_on_bad_input(config: Path) -> None:
    with scanner("--config", str(config.parent / "absent.toml")) as process:
        assert process.wait(timeout=60) == 2
        assert process.stdout is not None
        assert process.stderr is not None
        assert process.stdout.read() == b""
        assert process.stderr.read().count(b"\n") == 1


def test_a_configuration_that_does_not_exist_is_named(tmp_path: Path) -> None:
    ended = run(tmp_path / "absent.toml")
    assert (ended.exit_code, ended.stderr.count("\n")) == (2, 1)
    assert "absent.toml" in ended.stderr


def test_every_fault_has_a_line_that_says_what_it_does() -> None:
    assert set(FAULTS) >= {
        "late",
        "duplicate",
        "out_of_order",
        "missing",
        "corrupted",
        "wrong_orientation",
        "clock_jump",
        "extra_series",
        "motion_during_scan",
    }
    assert all(10 < len(text) < 100 and "\n" not in text for text in FAULTS.values())


def test_every_key_of_the_virtual_room_is_described() -> None:
    todo: list[type[BaseModel]] = [VirtualRoom, Fiducial, StaticObject, ScannerSettings]
    todo += [type(VirtualRoom().placement), type(VirtualRoom().protocol)]
    for model in todo:
        for name, field in model.model_fields.items():
            assert field.description, f"{model.__name__}.{name}"


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ({"background": [{"kind": "box", "centre_mm": [0.0, 0.0, 0.0]}]}, "needs size_mm"),
        (
            {"background": [{"kind": "sphere", "centre_mm": [0.0, 0.0, 0.0], "radius_mm": -1.0}]},
            "background.0.radius_mm",
        ),
        ({"fiducials": []}, "virtual.fiducials"),
        ({"fiducials": [{}, {}]}, "the same name"),
        ({"protocol": {"shape": [128]}}, "virtual.protocol.shape"),
        ({"protocol": {"window": "boxcar"}}, "virtual.protocol.window"),
        ({"placement": {"bottom_plane_mm": 5.0}}, "above bottom_plane_mm"),
        ({"scanner": {"ae_title": "A" * 17}}, "virtual.scanner.ae_title"),
    ],
)
def test_impossible_rooms_are_refused(table: dict[str, Any], message: str) -> None:
    with pytest.raises(VirtualRoomError, match=message) as caught:
        parse_virtual_room(table)
    assert "\n" not in str(caught.value)


def test_a_listener_that_is_not_there_is_one_line_on_stderr_for_each_slice(
    config: Path, page: Page, receiver: Receiver
) -> None:
    with socket.socket() as unused:
        unused.bind(("127.0.0.1", 0))
        port = unused.getsockname()[1]
        text = config.read_text().replace(
            f"listener_port = {receiver.port}",
            f"""
        listener_port = {port}
        retries = 2
        retry_s = 0.05""",
        )
        config.write_text(text)
        with scanner("--config", str(config)) as process:
            ready(process)
            page.ask_for("r1", count=2)
            assert process.stderr is not None
            lines = [json.loads(process.stderr.readline()) for _ in range(2)]
            process.terminate()
            assert process.wait(timeout=60) == 0
            assert process.stderr.read() == b""
    assert all("could not be delivered: no association" in line["note"] for line in lines)
