"""The live view for whoever stands at the camera: picture, slice, focus, exposure, circles.

Served on loopback by the standard library: two pictures a second are enough to turn a lens by.
"""

from __future__ import annotations

import io
import json
import threading
from collections.abc import Callable
from dataclasses import asdict
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from bench.config import CameraConfigError, CameraError
from bench.slices import BenchCamera, Sharpness
from bench.source import FrameSource

_PAGE = Path(__file__).with_name("preview.html")


class Preview:
    """Owns the loopback server."""

    def __init__(self, port: int, camera: BenchCamera, source: FrameSource) -> None:
        answers = {
            "/": lambda: (_PAGE.read_bytes(), "text/html; charset=utf-8"),
            "/state.json": lambda: (
                json.dumps(_state(camera, source)).encode(),
                "application/json",
            ),
            "/picture.jpg": lambda: (_jpeg(source), "image/jpeg"),
            "/slice.png": lambda: (_slice_png(camera, source), "image/png"),
        }
        try:
            self._server = ThreadingHTTPServer(("127.0.0.1", port), _handler(answers))
        except OSError as error:
            raise CameraConfigError(f"camera.preview_port {port}: {error.strerror}") from None
        self._server.daemon_threads = True
        threading.Thread(target=self._server.serve_forever, name="preview", daemon=True).start()

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self._server.server_address[1]}/"

    def close(self) -> None:
        self._server.shutdown()
        self._server.server_close()


Answers = dict[str, Callable[[], tuple[bytes, str]]]


def _handler(answers: Answers) -> type[BaseHTTPRequestHandler]:
    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            make = answers.get(self.path.split("?")[0])
            if make is None:
                self.send_error(404)
                return
            try:
                body, kind = make()
            except CameraError as error:
                self.send_error(503, str(error))
                return
            self.send_response(200)
            self.send_header("Content-Type", kind)
            self.send_header("Content-Length", str(len(body)))
            self.send_header("Cache-Control", "no-store")
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, *_: object) -> None:
            """Two requests a second are no news."""

    return Handler


def _state(camera: BenchCamera, source: FrameSource) -> dict[str, object]:
    try:
        exposure = source.next_after(0)
        source.check()
        sharpness = camera.judge(exposure)
    except (CameraError, CameraConfigError) as error:
        return {"problem": str(error)}
    return {**asdict(sharpness), "number": exposure.number, "help": _help(camera, sharpness)}


def _help(camera: BenchCamera, sharpness: Sharpness) -> str:
    if sharpness.overexposed > camera.config.most_overexposed:
        return "Overexposed: shorten the exposure or dim the light."
    if complaint := camera.complaint_about(sharpness.circles):
        return f"{complaint[0].upper()}{complaint[1:]}."
    if sharpness.focus < 0.3:
        return "Soft edge: turn the lens until the focus value is highest."
    return "One sharp circle: good."


def _jpeg(source: FrameSource) -> bytes:
    return _encoded(source.next_after(0).picture, "JPEG")


def _slice_png(camera: BenchCamera, source: FrameSource) -> bytes:
    pixels = camera.slice_of([source.next_after(0)]).pixels
    low, high = np.percentile(pixels, (1, 99.8))
    grey = np.clip((pixels - low) / max(high - low, 1.0) * 255, 0, 255).astype(np.uint8)
    return _encoded(grey, "PNG")


def _encoded(picture: NDArray[np.uint8], kind: str) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(picture).save(buffer, kind, quality=80)
    return buffer.getvalue()
