"""The cases of a room: the folder in which they lie, and which of them is open.

A room has one case folder after the other below `cases_dir`; a file there names the one that is
open, replaced as a whole, so that a crash leaves either the old word or the new one. A room that
names a single `case_dir` has that one case, open for ever. Every process asks here which case to
work on, as often as it looks for work.
"""

from __future__ import annotations

import contextlib
import os
import time
from pathlib import Path

from case_record.connection import FILE_NAME, CaseRecordError

OPEN_FILE = "open-case"
_FOLDER_MODE = 0o700


class NoCaseError(CaseRecordError):
    """No case is open; the text says what to do."""


class CasesError(CaseRecordError):
    """The cases of the room cannot be read or changed as asked; the text names the folder."""


class Cases:
    """One of the two folders is given. Safe for any number of processes; one of them changes it."""

    def __init__(self, cases_dir: Path | None, case_dir: Path | None = None) -> None:
        if (cases_dir is None) == (case_dir is None):
            raise CasesError("a room has either a cases_dir or a case_dir")
        self.only = case_dir
        self._home = cases_dir
        self._stamp: tuple[int, int, int] | None = None
        self._open: Path | None = None

    @property
    def home(self) -> Path:
        """The room's own folder: locks, logs and what belongs to no case lie here."""
        folder = self._home or self.only
        assert folder is not None
        return folder

    @property
    def open(self) -> Path | None:
        """The folder of the open case, or None. Cheap enough for every look at the record."""
        if self.only is not None:
            return self.only
        stamp = _stamp(self.home / OPEN_FILE)
        if stamp != self._stamp:
            self._open = None if stamp is None else self._read_open()
            self._stamp = stamp
        return self._open

    def required(self) -> Path:
        """As `open`; NoCaseError where no case is open."""
        folder = self.open
        if folder is None:
            raise NoCaseError("No case is open: start one (New case).")
        return folder

    def named(self, name: str | None) -> Path:
        """The folder of the open case (None), or of the one with this name. CaseRecordError.

        Only names of folders that are there and hold a record lead anywhere: no path gets through.
        """
        if name is None:
            return self.required()
        for folder in self.folders():
            if folder.name == name:
                return folder
        raise CaseRecordError(f"There is no case {name!r} in this room's folder of cases.")

    def folder_of(self, name: str) -> Path:
        """Where a case of this name lies, or would."""
        return self.only if self.only is not None else self.home / name

    def folders(self) -> list[Path]:
        """Every case folder of the room, in the order of their names."""
        above = self.only.parent if self.only is not None else self.home
        found = {path.parent for path in above.glob(f"*/{FILE_NAME}")}
        return sorted(found if self.open is None else {*found, self.open})

    # What the service does, and no other process

    def make_folder(self) -> Path:
        """A new, empty case folder, named after now. CasesError where it cannot be made."""
        self._refuse_if_only_one()
        name = time.strftime("%Y%m%d-%H%M%S")
        number = 0
        while True:
            folder = self.home / (f"{name}-{number}" if number else name)
            try:
                self.home.mkdir(parents=True, exist_ok=True, mode=_FOLDER_MODE)
                folder.mkdir(mode=_FOLDER_MODE)
            except OSError as error:
                if not folder.exists():
                    raise CasesError(f"{folder}: cannot be created ({error.strerror})") from error
                number += 1
            else:
                return folder

    def check_may_change(self) -> None:
        """CasesError where the room has a single case, which is always open."""
        self._refuse_if_only_one()

    def set_open(self, folder: Path | None) -> None:
        """From now on this case is open, or none. CasesError where that cannot be written."""
        self._refuse_if_only_one()
        path = self.home / OPEN_FILE
        part = path.with_suffix(".part")
        try:
            _write_synced(part, f"{folder.name}\n" if folder else "\n")
            os.replace(part, path)
            _sync_folder(self.home)
        except OSError as error:
            with contextlib.suppress(OSError):
                part.unlink()
            raise CasesError(f"{path}: cannot be written ({error.strerror})") from error

    def _refuse_if_only_one(self) -> None:
        if self.only is not None:
            raise CasesError(
                "This room's file names a single case_dir, so its case is always open. Use "
                "cases_dir to start and finish cases on the page."
            )

    def _read_open(self) -> Path | None:
        try:
            name = (self.home / OPEN_FILE).read_text(encoding="utf-8").strip()
        except FileNotFoundError:
            return None
        except (OSError, UnicodeDecodeError) as error:
            raise CasesError(f"{self.home / OPEN_FILE}: cannot be read ({error})") from error
        if not name:
            return None
        if Path(name).name != name or name in (".", ".."):
            raise CasesError(f"{self.home / OPEN_FILE}: {name[:80]!r} is not a folder name")
        return self.home / name


def _stamp(path: Path) -> tuple[int, int, int] | None:
    try:
        found = path.stat()
    except OSError:
        return None
    return found.st_mtime_ns, found.st_ino, found.st_size


def _write_synced(path: Path, text: str) -> None:
    with path.open("w", encoding="utf-8") as file:
        file.write(text)
        file.flush()
        os.fsync(file.fileno())


def _sync_folder(folder: Path) -> None:
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
