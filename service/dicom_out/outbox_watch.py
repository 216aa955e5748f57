"""The service's side of the outbox: keeps its process alive, and says how the destinations do."""

from __future__ import annotations

import contextlib
import sqlite3
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import structlog
from prometheus_client.core import GaugeMetricFamily
from prometheus_client.registry import Collector

from case_record.cases import Cases
from case_record.presence import Hanging
from room_config.load import Config
from service.dicom_out.outbox_store import (
    PRESENCE,
    STATES,
    DestinationLine,
    OutboxStore,
    cases_with_open_deliveries,
)
from service.room.alarm_list import Condition

_LOOK_S = 0.5
_RESTART_S = 1.0
_LONGEST_RESTART_S = 60.0
_STABLE_S = 60.0
_END_S = 5.0
_HUNG_S = 60.0
log = structlog.get_logger()


class OutboxWatch(Collector):
    """`start` it, `close` it. Does nothing at all where no destination is configured."""

    def __init__(self, config: Config) -> None:
        self._config = config
        self._cases = Cases(*config.room.folders)
        self._names = [one.name for one in config.outputs.destination]
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="outbox", daemon=True)
        self._conditions: tuple[Condition, ...] = ()
        self._folders: set[Path] = set()
        self._lines: dict[str, DestinationLine] = {}
        self._counts: dict[tuple[str, str], int] = {}

    def start(self) -> None:
        if self._names:
            self._thread.start()

    def close(self) -> None:
        self._closing.set()
        if self._thread.is_alive():
            self._thread.join(timeout=2 * _END_S)

    def conditions(self) -> Sequence[Condition]:
        """What is wrong now; as of a moment ago, and never waited for."""
        return self._conditions

    def collect(self) -> Iterator[GaugeMetricFamily]:
        outputs = GaugeMetricFamily(
            "autospine_outbox_outputs", "Outputs by state.", labels=["destination", "state"]
        )
        reached = GaugeMetricFamily(
            "autospine_outbox_reached",
            "1 unless the last attempt to reach the destination failed.",
            labels=["destination"],
        )
        for name in self._names:
            for state in STATES:
                outputs.add_metric([name, state], self._counts.get((name, state), 0))
            line = self._lines.get(name)
            reached.add_metric([name], float(line is None or line.failing_since_s is None))
        yield outputs
        yield reached

    # In the watch's own thread

    def _run(self) -> None:
        with contextlib.suppress(sqlite3.Error, OSError):
            self._folders.update(cases_with_open_deliveries(self._cases))
        child = _Child(self._config)
        hanging = Hanging(self._cases.home, "outbox-watch", _HUNG_S)
        try:
            while not self._closing.wait(_LOOK_S):
                try:
                    if hanging.look([PRESENCE]):
                        child.kill()
                    child.keep_alive()
                    with contextlib.suppress(sqlite3.Error, OSError):  # looked at again soon
                        self._look()
                    self._conditions = tuple(self._what_is_wrong(child.problem))
                except Exception:  # the thread must not end: the outbox would not come again
                    log.exception("outbox watch")
        finally:
            child.end()
            hanging.close()

    def _look(self) -> None:
        """At the open case, and at those before it of which something is still to be sent."""
        lines: dict[str, DestinationLine] = {}
        counts: Counter[tuple[str, str]] = Counter()
        now = self._cases.open
        for folder in {*self._folders, now} - {None}:
            if folder is None or not folder.is_dir():
                continue
            with OutboxStore(folder) as store:
                counts.update(store.counts())
                for name, line in store.lines().items():
                    if name not in lines or line.failing_since_s is not None:
                        lines[name] = line
                done = not store.has_open_deliveries()
            (self._folders.discard if done and folder != now else self._folders.add)(folder)
        self._lines, self._counts = lines, dict(counts)

    def _what_is_wrong(self, problem: str) -> Iterable[Condition]:
        if problem:
            yield Condition("outbox_lost", "warning", problem, "See the service's log.")
        for name in self._names:
            line = self._lines.get(name)
            since_s = None if line is None else line.failing_since_s
            if line and since_s and time.time() - since_s > self._config.outputs.alarm_after_s:
                text = f"Cannot send to {name}: {line.reason}"
                what = "Check the destination and the network. Retrying until it succeeds."
                yield Condition(f"destination_{name}", "warning", text, what)
            refused = self._counts.get((name, "refused"), 0)
            if refused:
                text = f"{name} refused {refused} of our DICOM objects"
                what = "See the outbox for the reasons. Sending is retried at intervals."
                yield Condition(f"refused_{name}", "warning", text, what)
        if any(self._counts.get((name, "not_made"), 0) for name in self._names):
            text = "A DICOM object could not be made"
            what = "See the outbox for the reason."
            yield Condition("output_not_made", "warning", text, what)


class _Child:
    """The outbox's process; started again when it ends, later and later."""

    def __init__(self, config: Config) -> None:
        self._config = config
        self._process: subprocess.Popen[bytes] | None = None
        self._started_s = 0.0
        self._wait_s = 0.0
        self.problem = ""

    def keep_alive(self) -> None:
        now_s = time.monotonic()
        if self._process is not None:
            code = self._process.poll()
            if code is None:
                if now_s > self._started_s + _STABLE_S:
                    self._wait_s, self.problem = 0.0, ""
                return
            self._forget()
            self._wait_s = min(max(_RESTART_S, 2 * self._wait_s), _LONGEST_RESTART_S)
            self.problem = f"The outbox ended with {code}; restarting it"
            log.error("the outbox ended", code=code, again_s=self._wait_s)
            self._started_s = now_s
        if now_s >= self._started_s + self._wait_s:
            self._start()

    def _start(self) -> None:
        self._started_s = time.monotonic()
        self._process = subprocess.Popen(
            [sys.executable, "-m", "service.dicom_out.outbox_process"],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            # a Ctrl-C on the terminal is for the service, which ends the outbox itself
            start_new_session=True,
        )
        assert self._process.stdin is not None
        with contextlib.suppress(OSError):  # it has ended already: seen at the next look
            self._process.stdin.write(self._config.model_dump_json().encode() + b"\n")
            self._process.stdin.flush()

    def kill(self) -> None:
        """It runs and does nothing any more; seen as ended at the next look."""
        log.error("the outbox hangs: killed")
        if self._process is not None:
            self._process.kill()
            self._process.wait()

    def _forget(self) -> None:
        if self._process is not None and self._process.stdin is not None:
            with contextlib.suppress(OSError):
                self._process.stdin.close()
        self._process = None

    def end(self) -> None:
        """Close its standard input, which ends it, and wait for that."""
        process = self._process
        self._forget()
        if process is None:
            return
        try:
            process.wait(_END_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
