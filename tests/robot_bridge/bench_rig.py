"""A bench: an emulator in a process of its own, and the engineer's commands to it."""

import contextlib
import io
import json
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from robot_bridge.engineer.main import main

AXIS = """
[[bridge.axis]]
name = "{name}"
controller = "{port}"
address = {address}
drive = "{drive}"
travel_min_mm = -20.0
travel_max_mm = 20.0
sign = 1
speed_hz = 1500
counts_per_mm = 10000
step_um_forward = 4.5
step_um_reverse = 4.5
home_mm = -20.0
limit_switches = 1
"""


@dataclass(frozen=True)
class Bench:
    folder: Path
    port: str
    control_port: int

    def robot(self, *words: str) -> tuple[int, dict, str]:
        out, err = io.StringIO(), io.StringIO()
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            code = main(["--yes", "--json", *words])
        return code, json.loads(out.getvalue() or "{}"), err.getvalue()

    def direct(self, *words: str) -> dict:
        config = str(self.folder / "bench.toml")
        code, fields, said = self.robot("--config", config, "--direct", *words)
        assert code == 0, said
        return fields

    def refused(self, *words: str) -> str:
        config = str(self.folder / "bench.toml")
        code, _, said = self.robot("--config", config, "--direct", *words)
        assert code == 3, said
        assert "Traceback" not in said
        return said

    def write_file(self, drives: dict[str, str], extra: str = "") -> None:
        text = '[bridge]\nstate_dir = "state"\n' + extra
        for address, (name, drive) in enumerate(drives.items(), 1):
            text += AXIS.format(name=name, port=self.port, address=address, drive=drive)
        (self.folder / "bench.toml").write_text(text)

    def tell(self, request: str) -> dict:
        with socket.create_connection(("127.0.0.1", self.control_port), 5.0) as line:
            line.sendall(request.encode() + b"\n")
            return json.loads(line.makefile().readline())

    def truth_mm(self) -> dict[str, float]:
        return self.tell("where")["positions_mm"]


@contextlib.contextmanager
def bench(folder: Path, addresses: str, *more: str) -> Iterator[Bench]:
    words = ["--addresses", addresses, "--pty-path", str(folder / "motors"), *more]
    command = [sys.executable, "-m", "robot_bridge.emulator", "serve", "--switches", *words]
    command += ["--travel-mm", "42", "--speed-factor", "10"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as emulator:
        assert emulator.stdout is not None
        ready = json.loads(emulator.stdout.readline())
        try:
            yield Bench(folder, ready["url"], ready["control_port"])
        finally:
            emulator.send_signal(signal.SIGTERM)
