"""Work that takes processor time, done by a command of its own beside the service.

In the service's process it would compete with the control loop for the interpreter.
"""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Sequence

from service.web.problems import ProblemError


def run_elsewhere(words: Sequence[str], what: str, patience_s: float) -> str | None:
    """Run a command at low priority; None if it succeeded, else the last line that it said.

    Raises ProblemError (503), which names `what`, if it has not ended within patience_s.
    """
    nice = shutil.which("nice")
    try:
        done = subprocess.run(
            [*([nice] if nice else []), *words],
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            timeout=patience_s,
            check=False,
        )
    except subprocess.TimeoutExpired:
        text = f"{what} was not finished within {patience_s:.0f} s."
        raise ProblemError(503, "no_answer", text) from None
    if done.returncode == 0:
        return None
    return (done.stderr.strip().splitlines() or ["no output"])[-1]
