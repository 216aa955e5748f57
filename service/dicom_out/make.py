"""The DICOM outputs of a case: each is made once, under a name and UIDs that follow from what it
is about, and lies in the case's folder from then on.

Who asks a second time, or after a crash, gets the same bytes; and had those been lost, the same
UIDs: to send an output twice is harmless. `python -m service.dicom_out.make CASE NAME` makes one in
a process of its own (highdicom takes its time to load, and the control loop needs the interpreter).
"""

from __future__ import annotations

import copy
import io
import os
import re
import sys
import tempfile
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from case_record.connection import is_older
from case_record.record import CaseRecord, CaseRecordError
from service.dicom_out.errors import OutputError

if TYPE_CHECKING:
    from pydicom.dataset import Dataset

from service.dicom_out.content import ReportContent, arrivals_said_ready, plan_events

FOLDER = "outputs"
Kind = Literal["image", "report", "presentation", "plan"]
Subject = Literal["measurement", "approach", "puncture", "plan"]
_AT_ONCE = 200
_NAME = re.compile(
    r"(measurement|approach|puncture|plan)-([1-9][0-9]{0,15})-(image|report|presentation|plan)"
)


@dataclass(frozen=True)
class Output:
    """`number` is the id of the measurement, of the approach (its READY), or of the event: of a
    puncture, or by which the plan changed (subject and kind `plan`).
    """

    subject: Subject
    number: int
    kind: Kind

    @property
    def name(self) -> str:
        return f"{self.subject}-{self.number}-{self.kind}"

    def path(self, case_dir: Path) -> Path:
        return case_dir / FOLDER / f"{self.name}.dcm"


def output_of(name: str) -> Output:
    """Raises OutputError for what is no name of an output."""
    found = _NAME.fullmatch(name)
    if found is None:
        raise OutputError(
            f"{name!r} is not an output; expected SUBJECT-NUMBER-KIND, such as approach-5-report"
        )
    subject, number, kind = found.groups()
    if (subject == "plan") != (kind == "plan"):
        raise OutputError(f"{name!r} is not an output; a plan is plan-NUMBER-plan")
    return Output(subject, int(number), kind)  # type: ignore[arg-type]


def outputs_to_send(record: CaseRecord, after_measurement: int = 0) -> Iterator[Output]:
    """What is sent unasked: reconstructions, reports of every READY and puncture."""
    while rows := record.page_of_measurements(
        after_id=after_measurement, limit=_AT_ONCE, newest=False
    ):
        for row in rows:
            if (row.result or {}).get("reconstruction"):
                yield Output("measurement", row.measurement_id, "image")
        after_measurement = rows[-1].measurement_id
    for procedure_id in arrivals_said_ready(record):
        yield Output("approach", procedure_id, "report")
        yield Output("approach", procedure_id, "presentation")
    for event in record.events_of_kind("puncture"):
        yield Output("puncture", event.event_id, "report")


def plans_to_send(record: CaseRecord) -> Iterator[Output]:
    """Target and entry point, whenever they changed: for whoever asks for them."""
    for event in plan_events(record):
        yield Output("plan", event.event_id, "plan")


def make_output(record: CaseRecord, output: Output) -> Path:
    """Return the file of the output, made now unless it lies there; durable when this returns.

    The record swears to what was made; what it does not swear to is made again. Raises OutputError,
    CaseRecordError (TamperedError for a file that was changed), OSError.
    """
    path = output.path(record.case_dir)
    name = str(path.relative_to(record.case_dir))
    if path.is_file() and record.is_sealed(name):
        return path
    try:
        content = encoded(_dataset(record, output))
    except OutputError:
        raise
    except KeyError as error:
        raise OutputError(f"{output.name}: the record has no {error}") from error
    except (AttributeError, TypeError, ValueError) as error:
        # so highdicom and pydicom say that a source's header cannot be used
        raise OutputError(f"{output.name}: {error}") from error
    if not record.read_only:
        record.seal_file(name, content)
    _write(path, content)
    return path


def encoded(dataset: Dataset) -> bytes:
    """In the slices' character set; where that lacks a letter, of the operator say, in UTF-8."""
    # a name keeps the bytes of its first encoding, right or wrong: each try has names of its own
    content, lacks_letters = _saved(copy.deepcopy(dataset))
    if not lacks_letters:
        return content
    from service.dicom_out.source import in_other_charset

    in_other_charset(dataset, "ISO_IR 192")
    content, _ = _saved(dataset)
    return content


def _saved(dataset: Dataset) -> tuple[bytes, bool]:
    """The file, and whether its character set lacks a letter."""
    buffer = io.BytesIO()
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        dataset.save_as(buffer, enforce_file_format=True)
    return buffer.getvalue(), any("Failed to encode" in str(one.message) for one in said)


def _dataset(record: CaseRecord, output: Output) -> Dataset:
    if output.kind == "plan":
        from service.dicom_out.plan_object import plan_of

        return plan_of(record, output.number)
    return dataset_of(_finding(record, output), output)


def dataset_of(finding: ReportContent, output: Output) -> Dataset:
    """The DICOM object of an output; the same for the same record."""
    from service.dicom_out.image import image_of

    if output.kind == "image":
        return image_of(finding)
    if output.kind == "presentation":
        from service.dicom_out.presentation import presentation_of

        return presentation_of(finding)
    from service.dicom_out.report import report_of

    return report_of(finding)


def _finding(record: CaseRecord, output: Output) -> ReportContent:
    from service.dicom_out.content import (
        finding_of_arrival,
        finding_of_measurement,
        finding_of_puncture,
    )

    find = {
        "measurement": finding_of_measurement,
        "approach": finding_of_arrival,
        "puncture": finding_of_puncture,
    }[output.subject]
    return find(record, output.number)


def _write(path: Path, content: bytes) -> None:
    """Whole and on disk, or not there; who comes at the same time writes the same."""
    path.parent.mkdir(exist_ok=True, mode=0o700)
    number, part = tempfile.mkstemp(prefix=f"{path.stem}-", suffix=".part", dir=path.parent)
    try:
        with os.fdopen(number, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(part, path)
    except BaseException:
        os.unlink(part)
        raise
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)


def main(words: list[str]) -> int:
    """Make one output; the last line on standard error says why not."""
    case_dir, name = words
    try:
        with CaseRecord(Path(case_dir), read_only=is_older(Path(case_dir))) as record:
            print(make_output(record, output_of(name)))
    except (OutputError, CaseRecordError, OSError) as error:
        print(error, file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
