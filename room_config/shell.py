"""What every process of the control room does alike around its work.

It logs to standard error, says on standard output that it is ready, and ends with its parent.
"""

from __future__ import annotations

import contextlib
import json
import logging
import os
import sys
import threading
from collections.abc import Callable
from typing import TextIO, cast

import structlog


def configure_logs(least_level: int = logging.NOTSET) -> None:
    """Text on a terminal, one JSON object a line elsewhere; nothing below `least_level`."""
    renderer: structlog.typing.Processor = (
        structlog.dev.ConsoleRenderer()
        if sys.stderr.isatty()
        else structlog.processors.JSONRenderer()
    )
    structlog.configure(
        processors=[
            structlog.processors.add_log_level,
            structlog.processors.TimeStamper(fmt="iso"),
            structlog.processors.format_exc_info,
            renderer,
        ],
        wrapper_class=structlog.make_filtering_bound_logger(least_level),
        logger_factory=structlog.PrintLoggerFactory(cast(TextIO, Unfailing(sys.stderr))),
        cache_logger_on_first_use=True,
    )


class Unfailing:
    """A stream to log to: a line that a full disk does not take is lost, and nothing else is."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def write(self, text: str) -> int:
        with contextlib.suppress(OSError):
            return self._stream.write(text)
        return len(text)

    def flush(self) -> None:
        with contextlib.suppress(OSError):
            self._stream.flush()


def announce(facts: dict[str, object]) -> None:
    """Print the one line by which a supervisor knows that the process is ready."""
    print(json.dumps({"ready": True, **facts}), flush=True)


def on_parent_gone(end: Callable[[], object]) -> None:
    """Call `end` when standard input is closed: whoever started this process is no more."""

    def wait() -> None:
        # not sys.stdin: a thread inside its lock would break the interpreter's own exit
        with contextlib.suppress(OSError):
            while os.read(0, 4096):
                pass
        structlog.get_logger().info("the parent process has ended: exiting")
        end()

    threading.Thread(target=wait, name="parent", daemon=True).start()


def autospine(*words: str) -> list[str]:
    """Return the command line of a subcommand in this same environment."""
    return [sys.executable, "-m", "service.cli.main", *words]
