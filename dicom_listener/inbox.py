"""The durable inbox: what was answered Success is in here, bit for bit, after any crash.

A slice is one DICOM Part 10 file. The data set bytes are those received; who sent them, when and
how stands in the file's own meta group (Private Information), so that one fsync covers both. File
names are made of our clock, a counter and the hash: no value from the network reaches a path.
"""

import contextlib
import hashlib
import itertools
import json
import os
import shutil
import struct
import threading
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

# An arbitrary UUID-derived root (DICOM PS3.5 B.2); it marks files that this inbox wrote.
IMPLEMENTATION_CLASS_UID = "2.25.157163391470461237480519391205764862117"
IMPLEMENTATION_VERSION_NAME = "AUTOSPINE_1"
PRIVATE_CREATOR_UID = IMPLEMENTATION_CLASS_UID + ".1"
_PREAMBLE = bytes(128) + b"DICM"
_LONG_VRS = (b"OB", b"UN")


class InboxError(OSError):
    """The slice could not be made durable; the text says why, with numbers."""


class InboxFullError(InboxError):
    """Too little disk is left to promise anything."""


class NotFromInboxError(ValueError):
    """The file does not carry the envelope that this inbox writes."""


@dataclass(frozen=True)
class Envelope:
    """How a data set came to us. Instants: our wall clock (s since the epoch) and monotonic.

    is_fresh: it came at that instant; a file may have lain in the drop folder before.
    """

    calling_ae_title: str
    called_ae_title: str
    peer_address: str
    peer_port: int
    received_s: float
    received_monotonic_s: float
    transfer_syntax_uid: str
    sop_class_uid: str
    sop_instance_uid: str
    sha256: str
    size_bytes: int
    is_fresh: bool = True


def sha256_of(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


class Inbox:
    """One folder. Safe for any number of threads of one process."""

    def __init__(self, folder: Path, *, min_free_bytes: int = 0) -> None:
        self.folder = folder
        self.min_free_bytes = min_free_bytes
        self._counter = itertools.count()
        self._lock = threading.Lock()
        _make_durably(folder)

    def free_bytes(self) -> int:
        return shutil.disk_usage(self.folder).free

    def store(self, data_set: bytes, envelope: Envelope) -> Path:
        """Make one received data set durable; it is on disk, under its final name, on return.

        Raises InboxFullError or InboxError, and then nothing of it is left behind.
        """
        final = self.folder / f"{self._next_name()}-{envelope.sha256[:16]}.dcm"
        part = final.with_suffix(".part")
        try:
            self._check_free(len(data_set))
            _write_synced(part, part10_head(envelope), data_set)
            part.rename(final)
            _sync_folder(self.folder)
        except InboxFullError:
            raise
        except OSError as error:
            for path in (part, final):
                with contextlib.suppress(OSError):
                    path.unlink()
            raise InboxError(f"cannot write: {error.strerror or error} ({final})") from error
        return final

    def _check_free(self, wanted_bytes: int) -> None:
        free = self.free_bytes()
        if not free - wanted_bytes >= self.min_free_bytes:
            raise InboxFullError(
                f"disk low: {free // 2**20} MiB free, {self.min_free_bytes // 2**20} MiB are kept "
                f"in reserve ({self.folder})"
            )

    def discard_unfinished(self) -> int:
        """Remove what a crash left half-written (never answered Success); return how many."""
        parts = list(self.folder.glob("*.part"))
        for part in parts:
            part.unlink()
        return len(parts)

    def files(self) -> list[Path]:
        """Everything received and kept, oldest first."""
        return sorted(self.folder.glob("*.dcm"))

    def _next_name(self) -> str:
        with self._lock:
            return f"{time.time_ns():020d}-{next(self._counter):06d}"


def _write_synced(path: Path, *pieces: bytes) -> None:
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    try:
        remaining = b"".join(pieces)
        while remaining:
            remaining = remaining[os.write(descriptor, remaining) :]
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _make_durably(folder: Path) -> None:
    """Make a folder and those above it that are missing; their names outlive a power cut."""
    missing = [path for path in (folder, *folder.parents) if not path.is_dir()]
    for path in reversed(missing or [folder]):
        path.mkdir(exist_ok=True, mode=0o700)
        with contextlib.suppress(PermissionError):  # not ours to open, so not made by us either
            _sync_folder(path.parent)


def _sync_folder(folder: Path) -> None:
    """Make the names in a folder durable."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def part10_head(envelope: Envelope) -> bytes:
    """Preamble and file meta group (always explicit little endian, DICOM PS3.10 section 7.1)."""
    private = json.dumps(asdict(envelope), separators=(",", ":")).encode()
    elements = b"".join(
        (
            _element(0x0001, b"OB", b"\x00\x01"),
            _element(0x0002, b"UI", envelope.sop_class_uid.encode()),
            _element(0x0003, b"UI", envelope.sop_instance_uid.encode()),
            _element(0x0010, b"UI", envelope.transfer_syntax_uid.encode()),
            _element(0x0012, b"UI", IMPLEMENTATION_CLASS_UID.encode()),
            _element(0x0013, b"SH", IMPLEMENTATION_VERSION_NAME.encode()),
            _element(0x0016, b"AE", envelope.calling_ae_title.encode("ascii", "replace")),
            _element(0x0100, b"UI", PRIVATE_CREATOR_UID.encode()),
            _element(0x0102, b"OB", private),
        )
    )
    return _PREAMBLE + _element(0x0000, b"UL", struct.pack("<L", len(elements))) + elements


def _element(number: int, vr: bytes, value: bytes) -> bytes:
    if len(value) % 2:
        value += b"\x00" if vr in (b"UI", b"OB") else b" "
    if vr in _LONG_VRS:
        return struct.pack("<HH2sHL", 2, number, vr, 0, len(value)) + value
    return struct.pack("<HH2sH", 2, number, vr, len(value)) + value


def read_envelope(path: Path) -> tuple[Envelope, int]:
    """Return the envelope of an inbox file and the offset at which the data set begins."""
    with path.open("rb") as file:
        head = file.read(4096)
    if not head.startswith(_PREAMBLE):
        raise NotFromInboxError(f"{path.name}: not written by this inbox")
    try:
        meta_end = 144 + struct.unpack_from("<L", head, 140)[0]
        values = dict(_elements(head[144:meta_end]))
        if values[0x0100].rstrip(b"\x00") != PRIVATE_CREATOR_UID.encode():
            raise NotFromInboxError(f"{path.name}: not written by this inbox")
        return Envelope(**json.loads(values[0x0102].rstrip(b"\x00"))), meta_end
    except (KeyError, struct.error, ValueError, TypeError) as error:
        raise NotFromInboxError(f"{path.name}: damaged envelope ({error})") from error


def _elements(meta: bytes) -> Iterator[tuple[int, bytes]]:
    at = 0
    while at < len(meta):
        _, number, vr, length = struct.unpack_from("<HH2sH", meta, at)
        at += 8
        if vr in _LONG_VRS:
            (length,) = struct.unpack_from("<L", meta, at)
            at += 4
        yield number, meta[at : at + length]
        at += length


def is_whole(path: Path) -> bool:
    """True where the data set in an inbox file is, bit for bit, the one that was received."""
    envelope, _ = read_envelope(path)
    return sha256_of(data_set_bytes(path)) == envelope.sha256


def data_set_bytes(path: Path) -> bytes:
    """The data set of an inbox file, exactly as it was received."""
    _, start = read_envelope(path)
    return path.read_bytes()[start:]
