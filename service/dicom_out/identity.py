"""What all DICOM outputs have in common: UIDs that follow from the case, instants, the maker."""

from __future__ import annotations

from datetime import datetime
from importlib.metadata import version

from pydicom.dataset import Dataset
from pydicom.uid import UID, generate_uid

from service.dicom_out.content import ReportContent

MAKER = "AutoSPINe Navigator"
RESEARCH = "Research software, not a medical device. Not for diagnosis."
SERIES_NUMBERS = {"image": 9001, "report": 9002, "presentation": 9003, "plan": 9004}
_DESCRIPTION_CHARACTERS = 64


def software_version() -> str:
    return version("autospine")


def output_uid(finding: ReportContent, *words: str) -> UID:
    """The same for the same words in the same case, everywhere and always."""
    return generate_uid(entropy_srcs=[finding.case_uid, *words])


def series_uid(finding: ReportContent, kind: str, dataset: Dataset, *words: str) -> UID:
    """One series a kind, study, frame of reference, and whatever else is the series'."""
    study, frame = str(dataset.StudyInstanceUID), str(dataset.get("FrameOfReferenceUID", ""))
    return output_uid(finding, "series", kind, study, frame, software_version(), *words)


def subject_of(finding: ReportContent) -> tuple[str, int]:
    """What it is about: a puncture, a READY, or a measurement, and its number."""
    if finding.puncture is not None:
        return "puncture", finding.puncture.event_id
    if finding.arrival is not None:
        return "approach", finding.arrival.procedure_id
    return "measurement", finding.measurement.measurement_id


def instant_s(finding: ReportContent) -> float:
    """When what it is about happened, wall clock."""
    if finding.puncture is not None:
        return finding.puncture.wall_s
    if finding.arrival is not None and finding.arrival.ended_s is not None:
        return finding.arrival.ended_s
    return finding.measurement.finished_s or finding.measurement.requested_s


def stamp(dataset: Dataset, finding: ReportContent, kind: str, description: str) -> None:
    """Instants, series and equipment; whatever the clock said while the object was made.

    A report is a series of its own, with its own instant and description (which is what archives
    list). Objects of other kinds share a series, so that what is the series' is the case's.
    """
    made = datetime.fromtimestamp(instant_s(finding))
    begun = made if kind == "report" else datetime.fromtimestamp(finding.case_created_s)
    for name, at in (("Series", begun), ("Content", made), ("InstanceCreation", made)):
        setattr(dataset, f"{name}Date", at.strftime("%Y%m%d"))
        setattr(dataset, f"{name}Time", at.strftime("%H%M%S.%f"))
    for equipment in dataset.get("ContributingEquipmentSequence") or ():
        if "ContributionDateTime" in equipment:
            equipment.ContributionDateTime = made.strftime("%Y%m%d%H%M%S.%f")
    dataset.SeriesNumber = SERIES_NUMBERS[kind]
    if kind == "report":
        dataset.SeriesNumber = 10_000 * SERIES_NUMBERS[kind] + int(dataset.InstanceNumber)
    dataset.SeriesDescription = description[:_DESCRIPTION_CHARACTERS]
    dataset.Manufacturer = MAKER
    dataset.ManufacturerModelName = MAKER
    dataset.SoftwareVersions = software_version()
