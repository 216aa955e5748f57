"""Pictures from a camera, a video, a folder or a network stream, each with when it was exposed."""

from __future__ import annotations

import contextlib
import glob
import itertools
import os
import threading
import time
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench.config import CameraError

Picture = NDArray[np.uint8]
_PICTURE_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff")
_FOLDER_RATE_HZ = 15.0
_OPEN_PATIENCE_S = 10.0
_RECENT = 8  # pictures from which the rate is told
_WAITED = 0.3  # of a period: shorter waits are those of a queue


@dataclass(frozen=True, eq=False)
class Exposure:
    """picture (rows, cols, 3), RGB; it was exposed between `from_s` and `to_s` (time.time).

    fresh: whoever read it had to wait for it, so it had not stood in a queue.
    """

    picture: Picture
    from_s: float
    to_s: float
    number: int
    fresh: bool


class FrameSource:
    """Owns the device and the thread that reads it; the newest picture is always at hand.

    Reading without pause empties the driver's queue, so that no picture is older than latency_s.
    """

    def __init__(self, source: str, *, latency_s: float, stall_s: float) -> None:
        self._source = source
        self._latency_s = latency_s
        self._stall_s = stall_s
        self._changed = threading.Condition()
        self._newest: Exposure | None = None
        self._problem = ""
        self._stopped = threading.Event()
        self._thread = threading.Thread(target=self._run, name="camera", daemon=True)

    def __enter__(self) -> FrameSource:
        """Raises CameraError where the source gives no first picture."""
        self._thread.start()
        try:
            self.next_after(0, patience_s=_OPEN_PATIENCE_S)
        except CameraError:
            self._stop()
            raise
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._stop()

    def _stop(self) -> None:
        self._stopped.set()
        self._thread.join(timeout=_OPEN_PATIENCE_S)

    @property
    def hangs(self) -> bool:
        """A driver does not come back from a read: this process cannot end as others do."""
        return self._stopped.is_set() and self._thread.is_alive()

    @property
    def has_ended(self) -> bool:
        """No more pictures will come: unplugged, at its end, or of another size than before."""
        return bool(self._problem)

    @property
    def newest(self) -> Exposure | None:
        return self._newest

    def check(self) -> None:
        """Raise CameraError where the camera has ended or stalled."""
        newest = self._newest
        if self._problem:
            raise CameraError(self._problem)
        if newest is not None and time.time() - newest.to_s > self._stall_s:
            self.next_after(newest.number)

    def next_after(self, number: int, *, patience_s: float | None = None) -> Exposure:
        """The first picture with a greater number; raises CameraError where none comes."""
        wait_s = self._stall_s if patience_s is None else patience_s

        def arrived() -> bool:
            fresh = self._newest is not None and self._newest.number > number
            return fresh or bool(self._problem)

        with self._changed:
            if not self._changed.wait_for(arrived, wait_s):
                raise CameraError(
                    f"camera {self._source}: no picture for {wait_s:g} s; check cable and supply"
                )
            newest = self._newest
            if newest is None or newest.number <= number:
                raise CameraError(self._problem)
            return newest

    def exposed_after(self, instant_s: float, count: int) -> list[Exposure]:
        """`count` pictures whose exposure began after `instant_s` (time.time).

        A picture that came out of a queue may be older than it seems and is passed over; raises
        CameraError where all do.
        """
        found: list[Exposure] = []
        number, last_s = 0, time.monotonic()
        while len(found) < count:
            exposure = self.next_after(number)
            number = exposure.number
            if exposure.fresh:
                last_s = time.monotonic()
                if exposure.from_s >= instant_s:
                    found.append(exposure)
            elif time.monotonic() - last_s > self._stall_s:
                raise CameraError(
                    f"camera {self._source}: pictures arrive faster than this computer can read "
                    "them; lower the camera's rate or resolution"
                )
        return found

    def _run(self) -> None:
        try:
            queue = QueueWatch()
            pictures = _pictures(self._source, self._stopped, self._stall_s)
            for number in itertools.count(1):
                began_s = time.monotonic()
                picture = next(pictures, None)
                if picture is None:
                    break
                self._take(picture, number, queue.is_empty(began_s, time.monotonic()))
            problem = (
                f"camera {self._source}: no more pictures; a video and a folder are played once: "
                "name a camera, or a stream"
            )
        except CameraError as error:
            problem = str(error)
        except Exception as error:  # whatever a codec or a driver raises ends the camera, by name
            problem = f"camera {self._source}: {type(error).__name__}: {error}"
        with self._changed:
            self._problem = problem
            self._changed.notify_all()

    def _take(self, picture: Picture, number: int, fresh: bool) -> None:
        now_s = time.time()
        with self._changed:
            before = self._newest
            if before is not None and before.picture.shape != picture.shape:
                rows, cols = picture.shape[:2]
                was_rows, was_cols = before.picture.shape[:2]
                raise CameraError(
                    f"camera {self._source}: the picture changed from {was_cols} x {was_rows} to "
                    f"{cols} x {rows} pixels; set its resolution and start again"
                )
            self._newest = Exposure(picture, now_s - self._latency_s, now_s, number, fresh)
            self._changed.notify_all()


class QueueWatch:
    """Tells from how long the reader waited whether pictures queue up between camera and reader."""

    def __init__(self) -> None:
        self._arrivals_s: deque[float] = deque(maxlen=_RECENT)

    def is_empty(self, asked_s: float, arrived_s: float) -> bool:
        """Whether the picture that arrived was waited for, by the rate of the ones before it."""
        self._arrivals_s.append(arrived_s)
        if len(self._arrivals_s) < _RECENT:
            return False
        period_s = (self._arrivals_s[-1] - self._arrivals_s[0]) / (_RECENT - 1)
        return arrived_s - asked_s > _WAITED * period_s


def _pictures(source: str, stopped: threading.Event, stall_s: float) -> Iterator[Picture]:
    files = picture_files(source)
    if files:
        yield from _paced(map(read_picture, files), _FOLDER_RATE_HZ, stopped)
        return
    with _capture(source, stall_s) as capture:
        is_file = Path(source).is_file()
        frames = _frames(capture, stopped)
        rate_hz = float(capture.get(require_opencv().CAP_PROP_FPS)) or _FOLDER_RATE_HZ
        yield from _paced(frames, rate_hz, stopped) if is_file else frames


def picture_files(source: str) -> list[Path]:
    """The picture files that a pattern, a folder or a name stands for, in order; maybe none."""
    if Path(source).is_dir():
        found = sorted(Path(source).iterdir())
    else:
        found = sorted(map(Path, glob.glob(source)))
    return [path for path in found if path.suffix.lower() in _PICTURE_SUFFIXES]


def read_picture(path: Path) -> Picture:
    """An RGB picture (rows, cols, 3); raises CameraError."""
    cv2 = require_opencv()
    picture = cv2.imread(str(path), cv2.IMREAD_COLOR)
    if picture is None:
        raise CameraError(f"{path}: not a readable picture")
    return np.asarray(picture[..., ::-1], dtype=np.uint8)


def _frames(capture: Any, stopped: threading.Event) -> Iterator[Picture]:
    while not stopped.is_set():
        good, picture = capture.read()
        if not good:
            return
        colour = picture if picture.ndim == 3 else np.repeat(picture[..., None], 3, axis=2)
        yield np.asarray(colour[..., ::-1], dtype=np.uint8)


def _paced(
    pictures: Iterator[Picture], rate_hz: float, stopped: threading.Event
) -> Iterator[Picture]:
    """As a camera would give them: a file is read in the time that it shows."""
    due_s = time.monotonic()
    for picture in pictures:
        if stopped.wait(max(0.0, due_s - time.monotonic())):
            return
        due_s += 1 / rate_hz
        yield picture


@contextlib.contextmanager
def _capture(source: str, stall_s: float) -> Iterator[Any]:
    cv2 = require_opencv()
    if "://" in source:  # a stream that falls silent would hold its reader for half a minute
        limits = {
            cv2.CAP_PROP_OPEN_TIMEOUT_MSEC: _OPEN_PATIENCE_S,
            cv2.CAP_PROP_READ_TIMEOUT_MSEC: stall_s,
        }
        flat = [number for key, limit_s in limits.items() for number in (key, int(1000 * limit_s))]
        capture = cv2.VideoCapture(source, cv2.CAP_FFMPEG, flat)
    else:
        capture = cv2.VideoCapture(int(source) if source.isdecimal() else source)
    try:
        if not capture.isOpened():
            raise CameraError(
                f"camera {source}: cannot be opened; check that it exists, that this user may "
                "read it and that no other program is using it"
            )
        yield capture
    finally:
        capture.release()


def require_opencv() -> Any:
    """OpenCV, which only the bench needs; CameraError where it is not installed."""
    # what is wrong is said once, by us
    os.environ.setdefault("OPENCV_LOG_LEVEL", "SILENT")
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    try:
        import cv2
    except ImportError:
        raise CameraError(
            "the camera needs OpenCV: install the extra `bench`, or opencv-python-headless"
        ) from None
    return cv2
