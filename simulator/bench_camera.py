"""A virtual camera over the virtual robot: a real MJPEG stream over HTTP.

A pinhole camera that stands a little askew, with a lens that bends, an unsharp image, noise and
JPEG, looks at a red circle on a white sheet on the top stage. The stages are where the motors
truly have them. `python -m simulator.bench_camera` serves it; with --board it writes pictures of a
checkerboard instead, as somebody would take them to learn the lens.
"""

from __future__ import annotations

import argparse
import io
import json
import signal
import socket
import sys
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation

from room_config.shell import on_parent_gone
from simulator.truth_client import TruthAddress, TruthError, ask_where

Floats = NDArray[np.float64]
Light = tuple[NDArray[np.float32], NDArray[np.float32]]
_SUBSAMPLES = 4
_RATE_HZ = 12.0
_MOST_OLD_S = 0.4
_FULL_SCALE = 255.0


@dataclass(frozen=True)
class VirtualCamera:
    """Its pose and lens are the truth that nobody at the bench is told. Lengths in mm.

    tilt_deg: of the optical axis about x and y, and the camera about its axis.
    """

    shape: tuple[int, int] = (480, 640)
    focal_px: float = 720.0
    height_mm: float = 480.0
    tilt_deg: tuple[float, float, float] = (1.6, -1.1, 0.8)
    distortion: tuple[float, float] = (-0.09, 0.03)
    blur_px: float = 0.6
    noise_levels: float = 2.0
    jpeg_quality: int = 92
    radius_mm: float = 5.0
    sheet_mm: tuple[float, float] = (46.0, 40.0)
    red: tuple[float, float, float] = (0.74, 0.13, 0.15)
    white: tuple[float, float, float] = (0.86, 0.86, 0.84)
    stage: tuple[float, float, float] = (0.22, 0.22, 0.24)
    home_mm: tuple[float, float] = (1.3, -0.7)
    """Of the circle in the plane of the sheet, where the stages stand at zero."""

    def sheet_points(self, tilt_deg: Sequence[float], height_mm: float) -> Floats:
        """Sheet points (x, y) mm that the subsamples of the sensor see, (rows*n, cols*n, 2)."""
        return _on_sheet(_sensor_rays(self), tilt_deg, height_mm)

    def true_sheet_mm(self, picture_px: Floats) -> Floats:
        """Sheet point (x, y) mm that a picture point (..., 2) in (row, col) truly shows."""
        middle = (np.array(self.shape) - 1) / 2
        bent = ((np.asarray(picture_px) - middle) / self.focal_px)[..., ::-1]
        return _on_sheet(self.ideal_rays(bent), self.tilt_deg, self.height_mm)

    def ideal_rays(self, bent: Floats) -> Floats:
        """The rays (..., 2) that the lens bends into these."""
        rays = bent.copy()
        k1, k2 = self.distortion
        for _ in range(8):
            r2 = rays[..., :1] ** 2 + rays[..., 1:] ** 2
            rays = bent / (1 + r2 * (k1 + r2 * k2))
        return rays


@cache
def _sensor_rays(camera: VirtualCamera) -> Floats:
    """Of every subsample of the sensor, (rows*n, cols*n, 2)."""
    rows, cols = camera.shape
    n = _SUBSAMPLES
    row = (np.arange(rows * n) + 0.5) / n - rows / 2
    col = (np.arange(cols * n) + 0.5) / n - cols / 2
    return camera.ideal_rays(np.stack(np.meshgrid(col, row), axis=-1) / camera.focal_px)


def _on_sheet(rays: Floats, tilt_deg: Sequence[float], height_mm: float) -> Floats:
    turned = np.concatenate([rays, np.ones((*rays.shape[:-1], 1))], axis=-1)
    turned = turned @ Rotation.from_euler("xyz", tilt_deg, degrees=True).as_matrix().T
    return np.asarray(turned[..., :2] / turned[..., 2:] * height_mm)


def _both(flags: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Whether x and y are; `np.all` takes ten times as long over so short an axis."""
    return np.asarray(flags[..., 0] & flags[..., 1])


class Scene:
    """Renders; the map from sensor to sheet is worked out once."""

    def __init__(self, camera: VirtualCamera, seed: int) -> None:
        self.camera = camera
        self._rng = np.random.default_rng(seed)
        self._last: tuple[tuple[float, ...], Light] | None = None

    @cached_property
    def _points(self) -> Floats:
        """What the subsamples of each pixel see, (rows, cols, n*n, 2) mm."""
        camera, n = self.camera, _SUBSAMPLES
        rows, cols = camera.shape
        points = camera.sheet_points(camera.tilt_deg, camera.height_mm)
        points = points.reshape(rows, n, cols, n, 2).swapaxes(1, 2)
        return points.reshape(rows, cols, n * n, 2)

    @cached_property
    def _pixels(self) -> Floats:
        """What the middle of each pixel sees, (rows, cols, 2) mm."""
        return self._points.mean(axis=2)

    def circle_mm(self, stage_mm: dict[str, float]) -> Floats:
        """True centre of the circle (x, y) in the plane of the sheet."""
        return np.array(self.camera.home_mm) + np.array([stage_mm["xt"], stage_mm["yt"]])

    def picture(self, stage_mm: dict[str, float]) -> NDArray[np.uint8]:
        """(rows, cols, 3) RGB."""
        where = tuple(self.circle_mm(stage_mm).tolist())
        if self._last is None or self._last[0] != where:  # what stands still has new noise alone
            self._last = where, self._with_spread(self._light_at(np.array(where)))
        return self._noisy(self._last[1])

    def _light_at(self, circle_mm: Floats) -> Floats:
        """From each pixel's share of sheet and circle; near an edge its subsamples are asked."""
        camera, half_mm = self.camera, np.array(self.camera.sheet_mm) / 2
        near_mm = 2 * camera.height_mm / camera.focal_px  # two pixels

        def share(beyond: Callable[[Floats], Floats]) -> Floats:
            """beyond: how far outside an edge points are, mm."""
            at_pixel = beyond(self._pixels - circle_mm)
            near = np.abs(at_pixel) < near_mm
            seen = (at_pixel < 0).astype(np.float64)
            seen[near] = (beyond(self._points[near] - circle_mm) < 0).mean(axis=1)
            return seen

        return self._behind_lens(
            share(lambda away: np.maximum(*np.moveaxis(np.abs(away) - half_mm, -1, 0))),
            share(lambda away: np.hypot(away[..., 0], away[..., 1]) - camera.radius_mm),
        )

    def board_picture(
        self, squares: tuple[int, int], square_mm: float, tilt_deg: Sequence[float], away_mm: float
    ) -> NDArray[np.uint8]:
        """A checkerboard held before the camera, at a pose of its own."""
        pose = np.array(self.camera.tilt_deg) + np.array(tilt_deg)
        points = self.camera.sheet_points(pose.tolist(), self.camera.height_mm + away_mm)
        size = np.array([squares[1], squares[0]]) * square_mm
        place = (points + size / 2) / square_mm
        on_board = _both((place >= 0) & (place < size / square_mm))
        margin = _both(np.abs(points) < size / 2 + square_mm)
        column, row = np.moveaxis(np.floor(place).astype(int), -1, 0)
        black = on_board & ((column + row) % 2 == 0)
        n, (rows, cols) = _SUBSAMPLES, self.camera.shape
        shares = (
            mask.reshape(rows, n, cols, n).mean(axis=(1, 3), dtype=np.float64)
            for mask in (margin, black)
        )
        return self._noisy(self._with_spread(self._behind_lens(*shares)))

    def _behind_lens(self, white: Floats, coloured: Floats) -> Floats:
        """(rows, cols, 3) light, from the share of each pixel."""
        camera = self.camera
        sheet, circle = (gaussian_filter(s, camera.blur_px)[..., None] for s in (white, coloured))
        stage, white_colour, red = (np.array(c) for c in (camera.stage, camera.white, camera.red))
        return np.asarray(stage + sheet * (white_colour - stage) + circle * (red - white_colour))

    def _with_spread(self, light: Floats) -> Light:
        """Levels of the sensor without noise, and the standard deviation of its noise."""
        camera = self.camera
        spread = camera.noise_levels * np.sqrt(np.maximum(light, 0.02) / max(camera.white))
        return (_FULL_SCALE * light).astype(np.float32), spread.astype(np.float32)

    def _noisy(self, light: Light) -> NDArray[np.uint8]:
        """A picture of the stream: single precision is finer than the levels of a JPEG."""
        levels, spread = light
        noisy = self._rng.standard_normal(levels.shape, np.float32)
        noisy *= spread
        noisy += levels
        return np.clip(np.rint(noisy, noisy), 0, 255, noisy).astype(np.uint8)


def jpeg(picture: NDArray[np.uint8], quality: int) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(picture).save(buffer, "JPEG", quality=quality, subsampling=0)
    return buffer.getvalue()


def serve(scene: Scene, truth: TruthAddress, port: int) -> ThreadingHTTPServer:
    """An MJPEG stream at every path of a loopback port."""

    class Stream(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(200)
            self.send_header("Content-Type", "multipart/x-mixed-replace; boundary=frame")
            self.end_headers()
            last = {"xt": 0.0, "yt": 0.0}
            while True:
                began_s = time.monotonic()
                try:
                    last = ask_where(truth).positions_mm
                except TruthError:
                    time.sleep(0.05)  # without supply the stages stand where they stood
                data = jpeg(scene.picture(last), scene.camera.jpeg_quality)
                if time.monotonic() - began_s > _MOST_OLD_S:
                    continue  # a busy computer: no camera shows what was so long ago
                head = f"--frame\r\nContent-Type: image/jpeg\r\nContent-Length: {len(data)}\r\n\r\n"
                try:
                    self.wfile.write(head.encode() + data + b"\r\n")
                except OSError:
                    return
                time.sleep(max(0.0, began_s + 1 / _RATE_HZ - time.monotonic()))

        def log_message(self, *_: object) -> None:
            """The stream is one request for hours."""

    server = ThreadingHTTPServer(("127.0.0.1", port), Stream)
    server.daemon_threads = True
    # a picture that waits in a deep buffer is shown late
    server.socket.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 65536)
    return server


def write_board(scene: Scene, folder: Path, squares: tuple[int, int], square_mm: float) -> None:
    """Pictures of a board: the first lies flat where the circle is, the others are held askew."""
    folder.mkdir(parents=True, exist_ok=True)
    poses = [((0, 0, 0), 0), ((14, 3, 5), 20), ((-12, 9, -8), -30), ((4, -16, 12), 10),
             ((-9, -11, 20), 40), ((11, 13, -15), -20)]  # fmt: skip
    for number, (tilt_deg, away_mm) in enumerate(poses):
        picture = scene.board_picture(squares, square_mm, tilt_deg, away_mm)
        Image.fromarray(picture).save(folder / f"board-{number}.png")


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m simulator.bench_camera", description=__doc__)
    parser.add_argument("--truth-port", type=int, help="of the emulated motors, on loopback")
    parser.add_argument("--port", type=int, default=0, help="to serve on; 0: any")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--board", type=Path, help="write pictures of a checkerboard here")
    parser.add_argument("--exit-with-parent", action="store_true")
    arguments = parser.parse_args(argv)
    scene = Scene(VirtualCamera(), arguments.seed)
    if arguments.board is not None:
        write_board(scene, arguments.board, (8, 11), 10.0)
        return 0
    if arguments.truth_port is None:
        parser.error("--truth-port or --board is needed")
    scene.picture({"xt": 0.0, "yt": 0.0})  # what is worked out once, before anybody waits for it
    server = serve(scene, TruthAddress("127.0.0.1", arguments.truth_port), arguments.port)
    if arguments.exit_with_parent:
        on_parent_gone(server.shutdown)
    signal.signal(signal.SIGTERM, lambda *_: threading.Thread(target=server.shutdown).start())
    url = f"http://127.0.0.1:{server.server_address[1]}/camera.mjpg"
    print(json.dumps({"ready": "bench camera", "url": url}), flush=True)
    server.serve_forever()
    return 0


if __name__ == "__main__":
    sys.exit(main())
