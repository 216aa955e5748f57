"""Report and export of a case, each made by its own command: packing a case takes seconds."""

from __future__ import annotations

import shutil
import tempfile
import threading
from pathlib import Path

from room_config.shell import autospine
from service.web.own_process import run_elsewhere
from service.web.problems import ProblemError

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
            text = "Another report or export is in progress: try again in a few seconds."
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
    failure = run_elsewhere(words, f"The {command}", _PATIENCE_S)
    if failure is None and not target.is_file():
        failure = "no output"
    if failure is not None:
        raise ProblemError(409, f"no_{command}", failure.removeprefix(_FAILED))
    return target
