"""A second way in: slices that a scanner's console writes to a share (`[listener] watch_dir`).

A file is taken once it is whole: it has kept its size for a while and reads to its last byte. It
goes into the same inbox as what comes by C-STORE, with the instant at which we first saw it at that
size, for its acquisition had ended by then. The share itself is only read. What was taken is
remembered by its hash, so that a restart takes nothing twice.
"""

import errno
import io
import math
import os
import stat
import struct
import threading
import time
import warnings
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import structlog
from pydicom import dcmread
from pydicom.dataset import FileDataset

from dicom_listener.inbox import Envelope, Inbox, sha256_of
from dicom_slice.quirks import MR_CLASSES

SENDER = "watch_dir"
_PART10_HEAD = 144  # preamble, DICM, and the element with the length of the meta group
_UNDEFINED = 0xFFFFFFFF
# what is seen so long after the look before, or was changed so long ago, may have lain there
_LOOK_GAP_S = 2.0
_OLD_S = 300.0
_UNFINISHED = (".part", ".tmp", ".partial", ".filepart", ".crdownload")

log = structlog.get_logger("listener")


class NotWholeError(ValueError):
    """The file is no whole DICOM file, or not yet."""


@dataclass(frozen=True)
class Seen:
    """A file as it was at one look: it is looked at again until it keeps still.

    is_fresh: it was not there, or not yet like this, at the look just before.
    """

    size_bytes: int
    changed_ns: int
    since_s: float
    since_monotonic_s: float
    is_fresh: bool


class DropFolder:
    """Owns the thread that looks at the folder. `on_stored(path)` is called for each new slice."""

    def __init__(
        self,
        folder: Path,
        taken_file: Path,
        inbox: Inbox,
        on_stored: Callable[[Path], None],
        *,
        max_object_bytes: int = 2**29,
        look_s: float = 0.2,
        still_s: float = 0.5,
        unfinished_alarm_s: float = 60.0,
    ) -> None:
        self.alarms: deque[tuple[str, str]] = deque(maxlen=1000)
        self._folder, self._inbox, self._on_stored = folder, inbox, on_stored
        self._taken_file = taken_file
        self._taken = set(taken_file.read_text().split()) if taken_file.exists() else set()
        self._max_object_bytes = max_object_bytes
        self._look_s, self._still_s = look_s, still_s
        self._unfinished_alarm_s = unfinished_alarm_s
        self._seen: dict[str, Seen] = {}
        self._done: dict[str, tuple[int, int]] = {}  # name: size and change of what is dealt with
        self._troubled: set[str] = set()  # that could not be taken, and were reported
        self._is_there = True
        self._looked_s = -math.inf  # when the last look began that saw the folder, monotonic
        self._stopped = threading.Event()
        self._thread = threading.Thread(target=self._run, name="watch_dir", daemon=True)

    def start(self) -> None:
        self._thread.start()

    def stop(self) -> None:
        self._stopped.set()
        self._thread.join(timeout=5)  # a share that hangs keeps nobody from ending

    def _run(self) -> None:
        while not self._stopped.wait(self._look_s):
            try:
                self.look()
            except Exception:  # whatever lies there, the others are looked at in the next round
                log.exception("watch_dir")

    def look(self) -> None:
        """One round over the folder: take what is whole, remember what may become so."""
        began_s = time.monotonic()
        try:
            found = dict(self._files())
        except OSError as error:
            if self._is_there:
                self._alarm(
                    "watch_dir_gone", f"{self._folder}: {error.strerror}; C-STORE still works"
                )
            self._is_there = False
            return
        if not self._is_there:
            log.info("watch_dir is available again", folder=str(self._folder))
        self._is_there = True
        for name in self._seen.keys() - found.keys():
            del self._seen[name]
            self._troubled.discard(name)
        for name, (size, changed_ns) in found.items():
            if self._done.get(name) != (size, changed_ns):
                self._consider(name, size, changed_ns)
        self._looked_s = began_s

    def _files(self) -> Iterator[tuple[str, tuple[int, int]]]:
        """(name relative to the folder, (size, time of change)) of all that may be slices."""
        if not self._folder.is_dir():
            raise FileNotFoundError(2, "no such folder")
        for folder, _, names in os.walk(self._folder, onerror=_raise):
            for name in names:
                if name.startswith(".") or name.lower().endswith(_UNFINISHED):
                    continue
                path = Path(folder) / name
                try:
                    status = path.stat()
                except OSError:  # renamed in this moment, a link to nowhere, or locked
                    continue
                if not stat.S_ISREG(status.st_mode):  # reading a pipe would wait for ever
                    continue
                yield str(path.relative_to(self._folder)), (status.st_size, status.st_mtime_ns)

    def _consider(self, name: str, size: int, changed_ns: int) -> None:
        seen = self._seen.get(name)
        if seen is None or (seen.size_bytes, seen.changed_ns) != (size, changed_ns):
            self._seen[name] = self._first_seen(size, changed_ns)
            return
        still_s = time.monotonic() - seen.since_monotonic_s
        if still_s < self._still_s:
            return
        if size > self._max_object_bytes:
            self._alarm("watch_dir_refused", f"{name}: {size} bytes are over the limit")
        else:
            try:
                self._take(name, seen)
            except NotWholeError as error:
                if still_s < self._unfinished_alarm_s:
                    return
                text = f"{name}: incomplete for {still_s:.0f} s ({error}); it is not used"
                self._alarm("watch_dir_refused", text)
            except OSError as error:  # locked by the console, or no room: it may go in a while
                if name not in self._troubled:
                    self._troubled.add(name)
                    text = f"{name}: {error.strerror or error}; will be retried"
                    self._alarm("watch_dir_refused", text)
                return
        self._troubled.discard(name)
        self._done[name] = size, changed_ns
        del self._seen[name]

    def _first_seen(self, size: int, changed_ns: int) -> Seen:
        now_s, now_monotonic_s = time.time(), time.monotonic()
        is_recent = now_s - changed_ns * 1e-9 < _OLD_S
        is_fresh = is_recent and now_monotonic_s - self._looked_s < _LOOK_GAP_S
        return Seen(size, changed_ns, now_s, now_monotonic_s, is_fresh)

    def _take(self, name: str, seen: Seen) -> None:
        raw = self._read(name)
        data_set, body = whole_file(raw)
        digest = sha256_of(body)
        if digest in self._taken:
            return
        envelope = Envelope(
            calling_ae_title=SENDER,
            called_ae_title="",
            peer_address="",
            peer_port=0,
            received_s=seen.since_s,
            received_monotonic_s=seen.since_monotonic_s,
            transfer_syntax_uid=str(data_set.file_meta.TransferSyntaxUID),
            sop_class_uid=str(data_set.get("SOPClassUID", "")),
            sop_instance_uid=str(data_set.get("SOPInstanceUID", "")),
            sha256=digest,
            size_bytes=len(body),
            is_fresh=seen.is_fresh,
        )
        path = self._inbox.store(body, envelope)
        self._taken.add(digest)
        with self._taken_file.open("a") as file:
            file.write(digest + "\n")
        self._on_stored(path)

    def _read(self, name: str) -> bytes:
        """A file that has become a pipe since it was looked at must not keep the thread either."""
        descriptor = os.open(self._folder / name, os.O_RDONLY | os.O_NONBLOCK)
        with open(descriptor, "rb") as file:
            if not stat.S_ISREG(os.fstat(descriptor).st_mode):
                raise OSError(errno.EINVAL, "not a regular file")
            return file.read()

    def _alarm(self, kind: str, text: str) -> None:
        self.alarms.append((kind, text))
        log.warning(kind, text=text)


def whole_file(raw: bytes) -> tuple[FileDataset, bytes]:
    """The data set of a DICOM file, and its encoded bytes. Raises NotWholeError."""
    if len(raw) < _PART10_HEAD or raw[128:132] != b"DICM":
        raise NotWholeError("it does not start like a DICOM file")
    if raw[132:140] != struct.pack("<HH2sH", 2, 0, b"UL", 4):
        raise NotWholeError("its meta group does not give its length")
    start = _PART10_HEAD + struct.unpack_from("<L", raw, 140)[0]
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            data_set = dcmread(io.BytesIO(raw))
            tags = list(data_set.keys())  # not the elements themselves: those would be decoded
            cut_off = [tag for tag in tags if _is_cut_off(data_set.get_item(tag))]
            sop_class = str(data_set.get("SOPClassUID", ""))
            _ = data_set.file_meta.TransferSyntaxUID
    except Exception as error:  # a file cut off anywhere fails in any way
        raise NotWholeError(str(error).splitlines()[0][:80] or type(error).__name__) from None
    if cut_off:
        raise NotWholeError(f"{cut_off[0]} is cut off")
    if "PixelData" not in data_set and (sop_class in MR_CLASSES or "Rows" in data_set):
        raise NotWholeError("the pixels are missing")
    if not sop_class:
        raise NotWholeError("it does not say what kind of object it is")
    return data_set, raw[start:]


def _is_cut_off(element: Any) -> bool:
    """Whether an element, as it was read and not decoded yet, has fewer bytes than it says."""
    length, value = getattr(element, "length", None), element.value
    if length is None or length == _UNDEFINED or not isinstance(value, bytes):
        return False
    return len(value) < length


def _raise(error: OSError) -> None:
    raise error
