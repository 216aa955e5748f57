"""A commissioning as it goes on: slices come, presses are written down, nothing is lost.

Everything lies in one folder: the slices as they were received, and one line for each press and
series. Somebody who breaks off goes on later with what is there.
"""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dicom_listener.inbox import Inbox, read_envelope
from dicom_listener.metrics import ListenerMetrics
from dicom_listener.process import intake_rules, open_scp
from dicom_slice.eligibility import why_not_usable
from dicom_slice.header import read_header
from dicom_slice.pixels import magnitude_pixels
from dicom_slice.reasons import UnusableError
from dicom_slice.times import TimeFrame
from room_config.load import Config
from service.commissioning.evidence import Press, Reception, ScannedSeries, one_series

_LOG = "presses.jsonl"


@dataclass(frozen=True)
class Step:
    """One series that is asked for."""

    number: int
    reversed_readout: bool


class Session:
    """Owns the folder and, while it is entered, the listener's port."""

    def __init__(self, config: Config, folder: Path) -> None:
        self._rules = intake_rules(config)
        self._log = folder / _LOG
        folder.mkdir(parents=True, exist_ok=True)
        self._inbox = Inbox(folder / "inbox")
        self._read: dict[Path, Reception | None] = {}
        self._scp = open_scp(config.listener, self._inbox, ListenerMetrics(), lambda path: None)
        self.port = self._scp.port

    def __enter__(self) -> Session:
        self._scp.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._scp.stop()

    def steps(self, n_series: int, *, reversed_too: bool) -> Iterator[Step]:
        """What is still to be scanned, after what an earlier run has."""
        done = {line["number"] for line in self._lines() if line["kind"] == "series"}
        for number in range(1, n_series + 1 + reversed_too):
            if number not in done:
                yield Step(number, reversed_readout=number > n_series)

    def came_since(self, press: Press) -> list[Reception]:
        """Usable slices of series that no earlier step has, received since a press."""
        used = self._used()
        return [
            reception
            for path in self._inbox.files()
            if (reception := self._reception(path)) is not None
            and reception.received_s >= press.at_s
            and reception.header.series_instance_uid not in used
        ]

    def keep(self, step: Step, started: Press, ended: Press) -> ScannedSeries:
        """Write down a series that is complete. Raises CommissioningError (`one_series`)."""
        came = self.came_since(started)
        try:
            series = one_series(came, started, ended, reversed_readout=step.reversed_readout)
        finally:
            # what came now is not taken for what comes next, whether it was good or not
            uids = sorted({r.header.series_instance_uid for r in came})
            self._write({"kind": "seen", "uids": uids})
        self._write(
            {
                "kind": "series",
                "number": step.number,
                "uid": came[0].header.series_instance_uid,
                "started_s": started.at_s,
                "ended_s": ended.at_s,
                "reversed_readout": step.reversed_readout,
            }
        )
        return series

    def series(self) -> list[ScannedSeries]:
        """All that were kept, of this run and of earlier ones."""
        receptions = [r for path in self._inbox.files() if (r := self._reception(path))]
        kept = []
        for line in self._lines():
            if line["kind"] != "series":
                continue
            own = [r for r in receptions if r.header.series_instance_uid == line["uid"]]
            started, ended = Press("start", line["started_s"]), Press("end", line["ended_s"])
            kept.append(one_series(own, started, ended, reversed_readout=line["reversed_readout"]))
        return kept

    def digest(self) -> str:
        """SHA-256 over the presses and the slices: what the findings rest on."""
        total = hashlib.sha256(self._log.read_bytes())
        for path in self._inbox.files():
            total.update(read_envelope(path)[0].sha256.encode())
        return total.hexdigest()

    def _used(self) -> set[str]:
        return {uid for line in self._lines() if line["kind"] == "seen" for uid in line["uids"]}

    def _lines(self) -> list[dict[str, Any]]:
        if not self._log.exists():
            return []
        return [json.loads(line) for line in self._log.read_text().splitlines()]

    def _write(self, line: dict[str, Any]) -> None:
        with self._log.open("a") as file:
            file.write(json.dumps({**line, "at_s": time.time()}) + "\n")

    def _reception(self, path: Path) -> Reception | None:
        """None where the file is no slice that could be used."""
        if path not in self._read:
            self._read[path] = self._reception_of(path)
        return self._read[path]

    def _reception_of(self, path: Path) -> Reception | None:
        envelope, _ = read_envelope(path)
        try:
            headers = read_header(path, TimeFrame(self._rules.zone, envelope.received_s))
            usable = [h for h in headers if why_not_usable(h, self._rules.slices) is None]
            if not usable:
                return None
            pixels = magnitude_pixels(path, usable[0].frame)
        except UnusableError:
            return None
        return Reception(usable[0], pixels, envelope.received_s)
