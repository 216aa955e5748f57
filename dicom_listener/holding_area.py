"""The listener's end of the room's holding area: files go in with a reason, and come out.

What waits there came when no case was open, or belongs to another one, or cannot be told. Nothing
of it is lost, and nothing of it is in anybody's case.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from case_record.cases import Cases
from case_record.holding import Held, Holding, move_file
from dicom_listener.inbox import Envelope, NotFromInboxError, read_envelope
from dicom_slice.header import Slice
from dicom_slice.patient import Identity, identity_of
from dicom_slice.reasons import Reason, SetAside

INBOX = "inbox"
NO_CASE = SetAside(Reason.NO_CASE, "no case was open when it arrived")


@dataclass(frozen=True)
class Arrival:
    """A file as it was received, and whom it shows."""

    path: Path
    envelope: Envelope
    identity: Identity
    description: str = ""

    @classmethod
    def of_file(
        cls, path: Path, envelope: Envelope, slices: Sequence[Slice | None] = ()
    ) -> Arrival:
        first = next((one for one in slices if one is not None), None)
        if first is None:
            return cls(path, envelope, identity_of(path))
        return cls(path, envelope, first.identity, first.series_description)


class HoldingArea:
    """Use it in one thread."""

    def __init__(self, cases: Cases) -> None:
        self.holding = Holding(cases.home)
        self._repair()

    def close(self) -> None:
        self.holding.close()

    def keep(self, arrival: Arrival, why: SetAside) -> None:
        """Move the file in. OSError, sqlite3.Error: it lies where it was."""
        path, envelope, whose = arrival.path, arrival.envelope, arrival.identity
        target = self.holding.folder / path.name
        if path != target:
            if self.holding.has(envelope.sha256, envelope.sop_instance_uid):
                path.unlink()
                return
            move_file(path, target)
        self.holding.add(
            Held(
                name=path.name,
                sop_instance_uid=envelope.sop_instance_uid,
                sha256=envelope.sha256,
                received_s=envelope.received_s,
                code=str(why.code),
                reason=why.text,
                patient=whose.patient,
                study=whose.study,
                frame_of_reference=whose.frame_of_reference,
                description=arrival.description,
            )
        )

    def give(self, path: Path, folder: Path) -> None:
        """Move a file on, into a folder. OSError: it lies where it was."""
        if path.parent == folder:
            return
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        move_file(path, folder / path.name)
        if path.parent == self.holding.folder:
            self.holding.remove(path.name)

    def paths_of(self, study: str) -> list[Path]:
        """The files of a study that wait, oldest first."""
        return [self.holding.folder / held.name for held in self.holding.all(study)]

    def _repair(self) -> None:
        """After a crash: a file without its row gets one, a row without its file goes."""
        known = {held.name for held in self.holding.all()}
        there = {path.name: path for path in self.holding.folder.glob("*.dcm")}
        for name in known - there.keys():
            self.holding.remove(name)
        for name in sorted(there.keys() - known):
            try:
                envelope, _ = read_envelope(there[name])
            except NotFromInboxError:
                continue
            self.keep(Arrival.of_file(there[name], envelope), NO_CASE)
