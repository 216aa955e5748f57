"""The truth of a virtual room, written down as it happens: JSON lines, appended."""

import json
import threading
from pathlib import Path
from typing import Any

import numpy as np

from simulator.config import VirtualRoomError


class TruthFile:
    """JSON lines, appended: each acquisition with its truth, each delivery that failed."""

    def __init__(self, path: Path) -> None:
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self.earlier_lines = path.read_bytes().count(b"\n") if path.exists() else 0
            self._file = path.open("a", encoding="utf-8")
        except OSError as error:
            raise VirtualRoomError(
                f"virtual.scanner.truth_file: {path}: {error.strerror}"
            ) from None
        self._lock = threading.Lock()

    def write(self, kind: str, **entry: Any) -> None:
        line = json.dumps({"kind": kind, **entry}, default=_plain)
        with self._lock:
            self._file.write(line + "\n")
            self._file.flush()

    def close(self) -> None:
        self._file.close()


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return value.tolist()
    raise TypeError(f"{type(value).__name__} cannot be written as JSON")
