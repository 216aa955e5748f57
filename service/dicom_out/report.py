"""A measurement, a READY or a puncture as a measurement report: TID 1500, Comprehensive 3D SR.

The centre stands in it twice: as numbers, which are exact, and as a 3-D point in the frame of
reference (SCOORD3D, 32-bit floats) for viewers that show where it is.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from highdicom.sr import (
    AlgorithmIdentification,
    CodedConcept,
    Comprehensive3DSR,
    CoordinatesForMeasurement3D,
    DeviceObserverIdentifyingAttributes,
    Measurement,
    MeasurementReport,
    MeasurementsAndQualitativeEvaluations,
    ObservationContext,
    ObserverContext,
    SourceImageForMeasurementGroup,
    TextContentItem,
    TrackingIdentifier,
)
from pydicom.dataset import Dataset
from pydicom.sequence import Sequence as DicomSequence
from pydicom.sr.codedict import codes

from service.dicom_out import codes as concept
from service.dicom_out.content import Distance, ReportContent
from service.dicom_out.identity import (
    MAKER,
    RESEARCH,
    SERIES_NUMBERS,
    output_uid,
    series_uid,
    software_version,
    stamp,
    subject_of,
)
from service.dicom_out.image import has_image, image_of
from service.dicom_out.source import frame_of_reference, source_of

_DIGITS = 6


def report_of(finding: ReportContent) -> Dataset:
    """The report; the same for the same record."""
    evidence = [source_of(finding, index) for index in range(len(finding.files))]
    if has_image(finding):
        evidence.append(image_of(finding))
    first = evidence[0]
    place = frame_of_reference(first)
    subject, number = subject_of(finding)
    content = _content(finding, evidence, place)
    made = Comprehensive3DSR(
        evidence=evidence,
        content=content[0],
        series_instance_uid=series_uid(finding, "report", first, subject, str(number)),
        series_number=SERIES_NUMBERS["report"],
        sop_instance_uid=output_uid(finding, f"{subject}-{number}-report"),
        # measurements, approaches and punctures are numbered each by themselves
        instance_number=10 * number + ("measurement", "approach", "puncture").index(subject),
        manufacturer=MAKER,
        is_complete=True,
        is_final=False,
    )
    stamp(made, finding, "report", f"AutoSPINe {subject} {number} (research, not a medical device)")
    made.CodingSchemeIdentificationSequence = DicomSequence([concept.scheme_identification()])
    return made


def _content(finding: ReportContent, evidence: list[Dataset], place: str) -> MeasurementReport:
    """place: UID of the frame of reference."""
    device = DeviceObserverIdentifyingAttributes(
        uid=output_uid(finding, "device"),
        name=MAKER,
        manufacturer_name=MAKER,
        model_name=f"{MAKER} {software_version()}",
    )
    observer = ObserverContext(
        observer_type=codes.DCM.Device, observer_identifying_attributes=device
    )
    return MeasurementReport(
        observation_context=ObservationContext(observer_device_context=observer),
        procedure_reported=concept.PROCEDURE,
        imaging_measurements=[_group(finding, evidence, place)],
        title=concept.REPORT_TITLE,
        referenced_images=evidence,
    )


def _group(
    finding: ReportContent, evidence: list[Dataset], place: str
) -> MeasurementsAndQualitativeEvaluations:
    subject, number = subject_of(finding)
    group = MeasurementsAndQualitativeEvaluations(
        tracking_identifier=TrackingIdentifier(
            uid=output_uid(finding, "fiducial"), identifier=f"fiducial, {subject} {number}"
        ),
        finding_type=concept.FIDUCIAL,
        method=concept.method(finding.measurement.method),
        algorithm_id=AlgorithmIdentification(name=MAKER, version=software_version()),
        measurements=[
            *_centre(finding, place),
            *_quality(finding),
            *_target(finding),
        ],
        source_images=[
            SourceImageForMeasurementGroup(str(one.SOPClassUID), str(one.SOPInstanceUID))
            for one in evidence
        ],
    )
    group[0].ContentSequence.append(
        TextContentItem(
            name=concept.COMMENT, value=comment_of(finding), relationship_type="CONTAINS"
        )
    )
    return group


def _centre(finding: ReportContent, place: str) -> Iterator[Measurement]:
    centre_mm = np.array(finding.result["patient_mm"], dtype=float)
    point = CoordinatesForMeasurement3D("POINT", centre_mm[None, :], place)
    for name, value in zip(concept.CENTRE, centre_mm, strict=True):
        yield _number(name, value, concept.MILLIMETRE, referenced_coordinates=[point])
    sigmas_mm = np.sqrt(np.diag(np.array(finding.result["covariance_mm2"])))
    for name, value in zip(concept.CENTRE_ALONG, sigmas_mm, strict=True):
        yield _number(name, value, concept.MILLIMETRE, derivation=concept.STANDARD_DEVIATION)
    circle = CoordinatesForMeasurement3D("ELLIPSE", _circle(finding), place)
    yield _number(
        concept.RADIUS, finding.radius_mm, concept.MILLIMETRE, referenced_coordinates=[circle]
    )


def _circle(finding: ReportContent) -> np.ndarray:
    """(4, 3): ends of two diameters, patient mm."""
    geometry = finding.geometry
    along, down = np.array(geometry.col_direction), np.array(geometry.row_direction)
    arms = finding.radius_mm * np.array([along, -along, down, -down])
    return np.asarray(np.array(finding.result["patient_mm"]) + arms)


def _quality(finding: ReportContent) -> Iterator[Measurement]:
    yield _number(concept.FRAMES, finding.result["n_frames"], concept.SLICES)
    yield _number(concept.SNR, finding.result["snr"], concept.NO_UNIT)
    yield _number(concept.CHI_SQUARED, finding.result["chi2_per_dof"], concept.NO_UNIT)


def _target(finding: ReportContent) -> Iterator[Measurement]:
    """What is known of the target: how far it is, how sure that is, how deep the needle went."""
    displacement_mm = finding.displacement_mm
    if displacement_mm is not None:
        for name, value in zip(concept.TARGET_AT, displacement_mm, strict=True):
            yield _number(name, value, concept.MILLIMETRE)
    if finding.distance is not None:
        yield from _distance(finding.distance)
    if finding.arrival is not None:
        moves = (finding.arrival.result or {})["iterations"]
        yield _number(concept.MOVES_MADE, moves, concept.MOVES)
    depth_mm = finding.puncture.body["insertion_depth_mm"] if finding.puncture else None
    if depth_mm is not None:
        yield _number(concept.DEPTH, depth_mm, concept.MILLIMETRE)


def _distance(distance: Distance) -> Iterator[Measurement]:
    name = concept.DISTANCE[distance.of]
    yield _number(name, distance.error_mm, concept.MILLIMETRE)
    sigma = concept.STANDARD_DEVIATION
    yield _number(name, distance.sigma_mm, concept.MILLIMETRE, derivation=sigma)
    if distance.tolerance_mm is not None and distance.probability is not None:
        yield _number(concept.TOLERANCE, distance.tolerance_mm, concept.MILLIMETRE)
        yield _number(concept.PROBABILITY, distance.probability, concept.NO_UNIT)


def _number(name: CodedConcept, value: float, unit: CodedConcept, **more: Any) -> Measurement:
    """Micrometres are the sixth digit of a metre: nanometres are enough."""
    return Measurement(name=name, value=round(float(value), _DIGITS), unit=unit, **more)


def comment_of(finding: ReportContent) -> str:
    """What it is about, in words."""
    subject, number = subject_of(finding)
    about = {
        "measurement": f"Measurement {number} of the fiducial on the needle guide.",
        "approach": "The needle guide stood at its target when READY was said "
        f"(approach {number}).",
        "puncture": f"A puncture was made (event {number}"
        + (f", recorded by {finding.puncture.who})." if finding.puncture else ")."),
    }[subject]
    return f"{RESEARCH} {about} Made by {MAKER} {software_version()}."
