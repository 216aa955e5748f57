"""What the bridge must know after a crash: commands begun and ended, latched stops, the lock.

One line an entry, JSON behind its CRC-32, only ever appended. Entries that decide about motion are
on the disk (fsync) before `append` returns. A torn last line is what a crash leaves and is cut off;
damage anywhere else is a JournalError, because an id forgotten is a motion repeated.
"""

import fcntl
import json
import os
import zlib
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from robot_bridge.daemon.whereabouts import Stand, stand_from_entry
from robot_bridge.protocol.messages import Code, CommandState

FILE_NAME = "bridge_journal.jsonl"


class JournalError(Exception):
    """The journal cannot be read, written or trusted; the text names the file."""


@dataclass(frozen=True)
class CommandRecord:
    """One command: what it asked, and how it stands."""

    command_id: str
    what: str
    setpoints_um: Mapping[str, int]
    measurement_id: str | None
    based_on_motion: str
    state: CommandState = CommandState.ACCEPTED
    code: str = Code.OK
    text: str = ""
    readback_um: Mapping[str, int] = field(default_factory=dict)
    axes: tuple[str, ...] = ()  # of a homing; none: all

    def asks_the_same(self, other: "CommandRecord") -> bool:
        mine = (self.what, dict(self.setpoints_um), self.measurement_id, self.axes)
        return mine == (other.what, dict(other.setpoints_um), other.measurement_id, other.axes)


def _line(entry: Mapping[str, Any]) -> bytes:
    text = json.dumps(entry, separators=(",", ":"), ensure_ascii=True).encode()
    return b"%08x " % zlib.crc32(text) + text + b"\n"


def _entry(line: bytes) -> dict[str, Any]:
    """Raises ValueError if the line is not a whole entry."""
    if len(line) < 10 or int(line[:8], 16) != zlib.crc32(line[9:]):
        raise ValueError("checksum")
    entry = json.loads(line[9:])
    if not isinstance(entry, dict):
        raise ValueError("not an entry")
    return entry


@dataclass(frozen=True)
class LatchedStop:
    """The newest stop: its number, why, and whether it still waits for an operator's re-arm."""

    number: int = 0
    code: str = ""
    emergency: bool = False
    latched: bool = False


class Journal:
    """The open journal of one bridge; a second bridge on the same folder is refused."""

    def __init__(self, folder: Path, sync: Callable[[int], None] = os.fsync) -> None:
        self.path = folder / FILE_NAME
        self.commands: dict[str, CommandRecord] = {}
        self.measurements_used: set[str] = set()
        self.insertion_locked = False
        self.stop = LatchedStop()
        self.settled: dict[str, Stand] = {}  # as each axis stood, certain, after its last motion
        self.stands: dict[str, Stand] = {}  # as it may stand now, if that one came to no end
        self.boards: dict[str, str] = {}  # the serial number of the board that drives each axis
        self._sync = sync
        try:
            folder.mkdir(parents=True, exist_ok=True)
            is_new = not self.path.exists()
            self._fd = os.open(self.path, os.O_RDWR | os.O_CREAT | os.O_APPEND | os.O_CLOEXEC)
        except OSError as error:
            raise JournalError(f"{self.path}: cannot be opened: {error.strerror}") from error
        try:
            self._lock()
            self._load()
            if is_new:
                _sync_folder(folder, sync)
        except BaseException:
            os.close(self._fd)
            raise

    def _lock(self) -> None:
        try:
            fcntl.flock(self._fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise JournalError(f"{self.path}: another bridge is using it") from error

    def _load(self) -> None:
        data = self.path.read_bytes()
        good_end = data.rfind(b"\n") + 1
        for number, line in enumerate(data[:good_end].splitlines(), start=1):
            try:
                self._apply(_entry(line))
            except (ValueError, KeyError, TypeError) as error:
                raise JournalError(
                    f"{self.path}: line {number} is damaged ({error}); "
                    "keep the file for inspection and start with a new state_dir"
                ) from error
        if good_end < len(data):
            os.ftruncate(self._fd, good_end)

    def _apply(self, entry: Mapping[str, Any]) -> None:
        kind = entry["kind"]
        if kind == "begin":
            record = CommandRecord(
                entry["id"], entry["what"], entry["setpoints_um"], entry["measurement_id"],
                entry["based_on_motion"], axes=tuple(entry.get("axes", ())),
            )  # fmt: skip
            self.commands[record.command_id] = record
            if entry["accepted"] and record.measurement_id is not None:
                self.measurements_used.add(record.measurement_id)
        elif kind == "end":
            self.commands[entry["id"]] = replace(
                self.commands[entry["id"]],
                state=CommandState(entry["state"]),
                code=entry["code"],
                text=entry["text"],
                readback_um=entry["readback_um"],
            )
        elif kind in ("stand", "going"):
            self.stands = {a: stand_from_entry(e) for a, e in entry["axes"].items()}
            if kind == "stand":
                certain = entry.get("certain", self.stands)  # older journals do not say
                self.settled = {a: self.stands[a] for a in certain if a in self.stands}
            else:  # an axis that homes stands nowhere that is known
                self.settled = {a: s for a, s in self.settled.items() if a in self.stands}
        elif kind == "boards":
            self.boards |= entry["boards"]
        elif kind == "lock":
            self.insertion_locked = bool(entry["locked"])
        elif kind == "stop":
            self.stop = LatchedStop(entry["number"], entry["code"], entry["emergency"], True)
        elif kind == "rearm":
            self.stop = replace(self.stop, latched=False)

    def begin(
        self, record: CommandRecord, wall_s: float, stands: Mapping[str, Stand] | None = None
    ) -> None:
        """A command is accepted and may move from now on. Durable. Raises JournalError.

        stands: what is known of the axes if nothing more is heard of it; None: as before.
        """
        entries = [_begin_entry(record, wall_s, accepted=True)]
        if stands is not None:
            entries.append(_stand_entry(stands, wall_s, "going"))
        self._append(*entries)

    def end(
        self,
        record: CommandRecord,
        wall_s: float,
        stands: Mapping[str, Stand] | None = None,
        certain: Collection[str] = (),
    ) -> None:
        """A command that began has ended. Durable. Raises JournalError."""
        entries = [_end_entry(record, wall_s)]
        if stands is not None:
            entries.append(_stand_entry(stands, wall_s, "stand", certain))
        self._append(*entries)

    def keep_stands(
        self, stands: Mapping[str, Stand], wall_s: float, certain: Collection[str]
    ) -> None:
        """The axes were declared, corrected, moved otherwise or lost; `certain`: the count of
        these may be believed after a restart. Durable. Raises JournalError.
        """
        self._append(_stand_entry(stands, wall_s, "stand", certain))

    def tie_boards(self, boards: Mapping[str, str], wall_s: float) -> None:
        """These boards drive these axes. Durable. Raises JournalError."""
        self._append({"kind": "boards", "t": wall_s, "boards": dict(boards)})

    def refuse(self, record: CommandRecord, wall_s: float) -> None:
        """A command was refused and will not move, ever. Durable. Raises JournalError."""
        self._append(_begin_entry(record, wall_s, accepted=False), _end_entry(record, wall_s))

    def lock(self, locked: bool, by: str, wall_s: float) -> None:
        """Durable. Raises JournalError."""
        self._append({"kind": "lock", "t": wall_s, "locked": locked, "by": by})

    def latch_stop(self, stop: LatchedStop, text: str, wall_s: float) -> None:
        """Durable. Raises JournalError (the stop itself must not depend on it)."""
        self._append(
            {
                "kind": "stop", "t": wall_s, "number": stop.number, "code": stop.code,
                "emergency": stop.emergency, "text": text,
            }
        )  # fmt: skip

    def rearm(self, by: str, wall_s: float) -> None:
        """Durable. Raises JournalError, and then the stop stays latched."""
        self._append({"kind": "rearm", "t": wall_s, "number": self.stop.number, "by": by})

    def note(self, what: str, wall_s: float, **details: Any) -> None:
        """Anything else worth knowing afterwards. In the file, not necessarily on the disk yet."""
        self._append({"kind": "note", "t": wall_s, "what": what, **details}, durable=False)

    def _append(self, *entries: Mapping[str, Any], durable: bool = True) -> None:
        data = b"".join(_line(entry) for entry in entries)
        size_before = -1
        try:
            size_before = os.fstat(self._fd).st_size
            if os.write(self._fd, data) != len(data):
                raise OSError(28, "No space left on device")
            if durable:
                self._sync(self._fd)
        except OSError as error:
            if size_before >= 0:
                self._cut(size_before)
            raise JournalError(f"{self.path}: cannot be written: {error.strerror}") from error
        for entry in entries:
            self._apply(entry)

    def _cut(self, size: int) -> None:
        """Take back a half-written line, so that the next one does not continue it."""
        try:
            os.ftruncate(self._fd, size)
        except OSError as error:
            raise JournalError(f"{self.path}: cannot be repaired: {error.strerror}") from error

    def unfinished(self) -> list[CommandRecord]:
        return [record for record in self.commands.values() if not record.state.final]

    def close(self) -> None:
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1


def _begin_entry(record: CommandRecord, wall_s: float, *, accepted: bool) -> dict[str, Any]:
    return {
        "kind": "begin", "t": wall_s, "id": record.command_id, "what": record.what,
        "setpoints_um": dict(record.setpoints_um), "measurement_id": record.measurement_id,
        "based_on_motion": record.based_on_motion, "accepted": accepted,
        "axes": list(record.axes),
    }  # fmt: skip


def _stand_entry(
    stands: Mapping[str, Stand], wall_s: float, kind: str, certain: Collection[str] = ()
) -> dict[str, Any]:
    return {
        "kind": kind, "t": wall_s, "axes": {a: stand.as_entry() for a, stand in stands.items()},
        "certain": sorted(certain),
    }  # fmt: skip


def _end_entry(record: CommandRecord, wall_s: float) -> dict[str, Any]:
    return {
        "kind": "end", "t": wall_s, "id": record.command_id, "state": record.state.value,
        "code": str(record.code), "text": record.text, "readback_um": dict(record.readback_um),
    }  # fmt: skip


def _sync_folder(folder: Path, sync: Callable[[int], None]) -> None:
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        sync(descriptor)
    finally:
        os.close(descriptor)
