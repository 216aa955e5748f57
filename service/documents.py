"""Report and export of a case, each made by its own command in a process of its own.

Packing a case takes seconds of processor time; in the service's process it would compete with the
control loop for the interpreter.
"""

from __future__ import annotations

import shutil
import subprocess
import tempfile
import threading
from pathlib import Path

from service.children import autospine
from service.problems import ProblemError

_PATIENCE_S = 600.0
_AGAIN_S = "5"
_FAILED = "autospine: "


class Documents:
    """Makes one document at a time; who comes meanwhile is asked to try again."""

    def __init__(self) -> None:
        self._busy = threading.Lock()

    def make(self, command: str, case_dir: Path, name: str) -> Path:
        """Return the file `name` that `autospine COMMAND CASE` wrote, alone in its new folder.

        Whoever uses it removes the folder. Raises ProblemError: 429 while another one is being
        made, 409 with the command's own words where it cannot be made.
        """
        if not self._busy.acquire(blocking=False):
            text = "Another report or export is being made: try again in a few seconds."
            raise ProblemError(429, "busy", text, {"Retry-After": _AGAIN_S})
        folder = Path(tempfile.mkdtemp(prefix="autospine-"))
        try:
            return _written(command, case_dir, folder / name)
        except BaseException:
            shutil.rmtree(folder, ignore_errors=True)
            raise
        finally:
            self._busy.release()


def _written(command: str, case_dir: Path, target: Path) -> Path:
    words = autospine(command, str(case_dir), "--out", str(target))
    nice = shutil.which("nice")
    try:
        done = subprocess.run(
            [*([nice] if nice else []), *words],
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            timeout=_PATIENCE_S,
            check=False,
        )
    except subprocess.TimeoutExpired:
        text = f"The {command} was not made within {_PATIENCE_S:.0f} s."
        raise ProblemError(503, "no_answer", text) from None
    if done.returncode != 0 or not target.is_file():
        last = (done.stderr.strip().splitlines() or ["it said nothing"])[-1]
        raise ProblemError(409, f"no_{command}", last.removeprefix(_FAILED))
    return target
