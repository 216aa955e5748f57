"""How often a process died at a piece of work: what killed it twice is not given to it again.

An exception can be caught where it arises. A process that is killed (for its memory, by a library
that crashes) cannot say so any more: it says beforehand what it is about to do.
"""

from __future__ import annotations

import contextlib
import json
import os
from collections.abc import Iterator
from pathlib import Path

from case_record.presence import FOLDER

MOST_DEATHS = 2
_MOST_KEPT = 64


class Attempts:
    """The work that a process of this name began on a case and did not come back from.

    Nothing here may keep the work itself from being done: where the disk takes no more, deaths are
    not counted.
    """

    def __init__(self, case_dir: Path, name: str) -> None:
        folder = case_dir / FOLDER
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        flags = os.O_RDWR | os.O_CREAT | os.O_CLOEXEC
        self._file = os.open(folder / f"{name}.doing", flags, 0o600)
        self._begun = _read(self._file)

    def deaths(self, key: str) -> int:
        """How often the process ended while it was at this piece of work."""
        return self._begun.get(key, 0)

    @contextlib.contextmanager
    def at(self, key: str) -> Iterator[None]:
        """Around one piece of work; an exception is an end that is known, and no death."""
        self._begun[key] = self.deaths(key) + 1
        while len(self._begun) > _MOST_KEPT:
            del self._begun[next(iter(self._begun))]
        self._write()
        try:
            yield
        finally:
            self.forget(key)

    def forget(self, key: str) -> None:
        if self._begun.pop(key, None) is not None:
            self._write()

    def _write(self) -> None:
        text = json.dumps(self._begun).encode()
        with contextlib.suppress(OSError):
            os.pwrite(self._file, text, 0)
            os.ftruncate(self._file, len(text))

    def close(self) -> None:
        with contextlib.suppress(OSError):
            os.close(self._file)

    def __enter__(self) -> Attempts:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _read(file: int) -> dict[str, int]:
    with contextlib.suppress(OSError, ValueError):
        known = json.loads(os.pread(file, 1 << 20, 0) or b"{}")
        if isinstance(known, dict):
            return {str(key): count for key, count in known.items() if isinstance(count, int)}
    return {}
