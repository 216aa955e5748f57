"""The whole bench, virtual: motors emulated, the camera a real MJPEG stream, the rest as it is."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np

from bench.optics import read_lens, sheet_of
from room_config.shell import autospine
from simulator.bench_camera import Scene, VirtualCamera, main
from simulator.demo.operator import Operator
from simulator.demo.room import DemoOptions, DemoRoom
from simulator.truth_client import ask_where

SQUARES, SQUARE_MM = "8x11", 10.0
RADIUS_MM = (3.5, 6.5)


class BenchDemoRoom(DemoRoom):
    """A lens is learnt from pictures of a board first, as the documentation says."""

    def __init__(self, options: DemoOptions, **camera: Any) -> None:
        super().__init__(options)
        self.camera = camera
        self.preview_url = ""
        self.service: dict[str, Any] = {}

    @property
    def lens_file(self) -> Path:
        return self.folder / "lens.json"

    def start(self) -> None:
        board = self.virtual_dir / "board"
        assert main(["--board", str(board)]) == 0
        words = ["--board", str(board), "--squares", SQUARES, "--square-mm", str(SQUARE_MM)]
        subprocess.run(autospine("camera", *words, "--out", str(self.lens_file)), check=True)
        super().start()

    def _start_scanner(self, here: list[str]) -> None:
        ready = self.family.start("camera", autospine("camera", *here))
        self.preview_url = str(ready["preview"])

    def _adapt(self, tables: dict[str, dict[str, Any]]) -> None:
        words = [
            *(sys.executable, "-m", "simulator.bench_camera"),
            *("--truth-port", str(self.truth_port), "--seed", str(self.options.seed)),
        ]
        url = str(self.family.start("virtual camera", words)["url"])
        listener = tables["listener"]
        # one computer, one clock
        listener.update(clock_offset_s=0.0, clock_uncertainty_s=0.02, clock_may_be_set=False)
        listener["camera_slices"] = True
        tables["imaging"].update(
            fiducial_radius_min_mm=RADIUS_MM[0], fiducial_radius_max_mm=RADIUS_MM[1]
        )
        tables["service"].update(self.service)
        tables["camera"] = {
            "source": url,
            "lens_file": "lens.json",
            "service_url": f"http://127.0.0.1:{tables['service']['port']}",
            "preview_port": 0,
            # the camera is rendered on this computer, which has other things to do
            "stall_s": 30.0,
            **self.camera,
        }


class BenchTruth:
    """What a point of the patient's frame is on the sheet in truth, whatever the lens file says."""

    def __init__(self, lens_file: Path) -> None:
        self.camera = VirtualCamera()
        self.scene = Scene(self.camera, 0)
        self._lens = read_lens(lens_file)
        middle = (np.array(self.camera.shape) - 1) / 2
        # the slice's middle shows the picture's
        self._offset_mm = sheet_of(self._lens, middle)

    def miss_mm(self, stage_mm: dict[str, float], patient_mm: list[float]) -> np.ndarray:
        """From the target to the circle's true centre, on the sheet (x, y)."""
        sheet_mm = np.array([patient_mm[0], -patient_mm[2]]) + self._offset_mm
        target = self.camera.true_sheet_mm(self._lens.picture_from_sheet(sheet_mm))
        return self.scene.circle_mm(stage_mm) - target


class BenchOperator(Operator):
    """The operator of the demo, with the bench's truth."""

    bench_truth: BenchTruth

    def _miss_mm(self, arrival: dict[str, Any], target_mm: list[float]) -> np.ndarray:
        return self.bench_truth.miss_mm(ask_where(self._truth).positions_mm, target_mm)


def read_json_lines(path: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in path.read_text().splitlines()]
