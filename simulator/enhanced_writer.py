"""The same slice as an Enhanced MR Image of one frame, as newer scanners send it."""

from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydicom.dataset import Dataset
from pydicom.sequence import Sequence
from pydicom.uid import EnhancedMRImageStorage

from dicom_slice.geometry import SliceGeometry
from simulator.config import ScannerSettings, SliceProtocol
from simulator.dicom_writer import (
    AcquisitionStamp,
    Series,
    Study,
    file_meta_of,
    local_time,
    write_mr_image,
)

# What a classic image says for the whole image and an enhanced one says frame by frame.
_PER_FRAME = (
    *("ImagePositionPatient", "ImageOrientationPatient", "PixelSpacing", "SliceThickness"),
    *("SpacingBetweenSlices", "SliceLocation", "RepetitionTime", "EchoTime", "FlipAngle"),
    *("ScanningSequence", "SequenceVariant", "ScanOptions", "MRAcquisitionType", "SequenceName"),
    *("NumberOfAverages", "EchoTrainLength", "EchoNumbers", "ImagingFrequency", "ImagedNucleus"),
    *("PixelBandwidth", "NumberOfPhaseEncodingSteps", "InPlanePhaseEncodingDirection"),
    *("AcquisitionMatrix", "PercentSampling", "PercentPhaseFieldOfView", "ReceiveCoilName"),
    *("TransmitCoilName", "WindowCenter", "WindowWidth", "AcquisitionDate", "AcquisitionTime"),
    *("SmallestImagePixelValue", "LargestImagePixelValue", "RescaleSlope", "RescaleIntercept"),
    *("RescaleType", "MagneticFieldStrength"),
)
_FILTERS = {"flat": "NONE", "hamming": "HAMMING", "fermi": "FERMI", "elliptical": "NONE"}
_FLAVOURS = {"LOCALIZER": "LOCALIZER"}
_DEFAULT_FLAVOUR = "OTHER"


def write_enhanced_mr_image(
    pixels: NDArray[np.float64],
    geometry: SliceGeometry,
    *,
    protocol: SliceProtocol,
    scanner: ScannerSettings,
    study: Study,
    series: Series,
    stamp: AcquisitionStamp,
    sop_instance_uid: str | None = None,
) -> Dataset:
    """As `write_mr_image`; times and geometry are in the functional groups."""
    dataset = write_mr_image(
        pixels,
        geometry,
        protocol=protocol,
        scanner=scanner,
        study=study,
        series=series,
        stamp=stamp,
        sop_instance_uid=sop_instance_uid,
    )
    classic = {keyword: dataset.get(keyword) for keyword in _PER_FRAME}
    for keyword in _PER_FRAME:
        if keyword in dataset:
            delattr(dataset, keyword)
    is_phase = "P" in series.image_type
    frame_type = _frame_type(series, is_phase)
    _add_image_level(dataset, frame_type, protocol, stamp, scanner)
    _add_dimensions(dataset, study)
    dataset.SharedFunctionalGroupsSequence = Sequence(
        [_shared_groups(classic, geometry, protocol, is_phase)]
    )
    dataset.PerFrameFunctionalGroupsSequence = Sequence(
        [_frame_groups(classic, frame_type, stamp, scanner)]
    )
    dataset.SOPClassUID = EnhancedMRImageStorage
    dataset.file_meta = file_meta_of(dataset)
    return dataset


def _item(**elements: Any) -> Sequence:
    """A sequence of one item."""
    item = Dataset()
    for keyword, value in elements.items():
        setattr(item, keyword, value)
    return Sequence([item])


def _frame_type(series: Series, is_phase: bool) -> dict[str, Any]:
    flavour = next((_FLAVOURS[v] for v in series.image_type if v in _FLAVOURS), _DEFAULT_FLAVOUR)
    return {
        "value": ["ORIGINAL", "PRIMARY", flavour, "NONE"],
        "component": "PHASE" if is_phase else "MAGNITUDE",
    }


def _describe_frame_type(frame_type: dict[str, Any]) -> dict[str, Any]:
    return {
        "PixelPresentation": "MONOCHROME",
        "VolumetricProperties": "VOLUME",
        "VolumeBasedCalculationTechnique": "NONE",
        "ComplexImageComponent": frame_type["component"],
        "AcquisitionContrast": "T1",
    }


def _add_image_level(
    dataset: Dataset,
    frame_type: dict[str, Any],
    protocol: SliceProtocol,
    stamp: AcquisitionStamp,
    scanner: ScannerSettings,
) -> None:
    started = local_time(stamp.started_s, scanner)
    dataset.ImageType = frame_type["value"]
    for keyword, value in _describe_frame_type(frame_type).items():
        setattr(dataset, keyword, value)
    dataset.NumberOfFrames = 1
    dataset.AcquisitionDateTime = started.strftime("%Y%m%d%H%M%S.%f")
    dataset.AcquisitionDuration = stamp.duration_s
    dataset.ContentQualification = "RESEARCH"
    dataset.ResonantNucleus = "1H"
    dataset.KSpaceFiltering = _FILTERS[protocol.window]
    dataset.MagneticFieldStrength = protocol.field_t
    dataset.ApplicableSafetyStandardAgency = "IEC"
    dataset.PulseSequenceName = "*fl2d1"
    dataset.MRAcquisitionType = "2D"
    dataset.EchoPulseSequence = "GRADIENT"
    dataset.MultiPlanarExcitation = "NO"
    dataset.PhaseContrast = "NO"
    dataset.TimeOfFlightContrast = "NO"
    dataset.SteadyStatePulseSequence = "NONE"
    dataset.EchoPlanarPulseSequence = "NO"
    dataset.SpectrallySelectedSuppression = "NONE"
    dataset.OversamplingPhase = "NONE"
    dataset.SaturationRecovery = "NO"
    dataset.GeometryOfKSpaceTraversal = "RECTILINEAR"
    dataset.RectilinearPhaseEncodeReordering = "LINEAR"
    dataset.SegmentedKSpaceTraversal = "SINGLE"
    dataset.NumberOfKSpaceTrajectories = 1
    dataset.BurnedInAnnotation = "NO"
    dataset.LossyImageCompression = "00"
    dataset.PresentationLUTShape = "IDENTITY"
    dataset.AcquisitionContextSequence = Sequence()


def _add_dimensions(dataset: Dataset, study: Study) -> None:
    organization = study.dimension_organization_uid
    dataset.DimensionOrganizationSequence = _item(DimensionOrganizationUID=organization)
    dataset.DimensionIndexSequence = _item(
        DimensionOrganizationUID=organization,
        DimensionIndexPointer=0x00209057,  # InStackPositionNumber
        FunctionalGroupPointer=0x00209111,  # FrameContentSequence
    )


def _shared_groups(
    classic: dict[str, Any], geometry: SliceGeometry, protocol: SliceProtocol, is_phase: bool
) -> Dataset:
    rows, cols = geometry.shape
    steps, frequency = (rows, cols) if protocol.phase_encoding == "COL" else (cols, rows)
    shared = Dataset()
    shared.PixelMeasuresSequence = _item(
        PixelSpacing=classic["PixelSpacing"],
        SliceThickness=classic["SliceThickness"],
        SpacingBetweenSlices=classic["SpacingBetweenSlices"],
    )
    shared.PlaneOrientationSequence = _item(
        ImageOrientationPatient=classic["ImageOrientationPatient"]
    )
    shared.FrameAnatomySequence = _item(
        FrameLaterality="U",
        AnatomicRegionSequence=_item(
            CodeValue="421060004", CodingSchemeDesignator="SCT", CodeMeaning="Spine"
        ),
    )
    shared.PixelValueTransformationSequence = _item(
        RescaleIntercept=classic["RescaleIntercept"] if is_phase else "0",
        RescaleSlope=classic["RescaleSlope"] if is_phase else "1",
        RescaleType="US",
    )
    shared.FrameVOILUTSequence = _item(
        WindowCenter=classic["WindowCenter"], WindowWidth=classic["WindowWidth"]
    )
    shared.MRTimingAndRelatedParametersSequence = _item(
        RepetitionTime=classic["RepetitionTime"],
        FlipAngle=classic["FlipAngle"],
        EchoTrainLength=1,
        RFEchoTrainLength=0,
        GradientEchoTrainLength=1,
        GradientOutputType="DB_DT",
        GradientOutput=20.0,
        OperatingModeSequence=_item(OperatingModeType="GRADIENT", OperatingMode="IEC_NORMAL"),
        SpecificAbsorptionRateSequence=_item(
            SpecificAbsorptionRateDefinition="IEC_WHOLE_BODY", SpecificAbsorptionRateValue=0.1
        ),
    )
    shared.MRFOVGeometrySequence = _item(
        InPlanePhaseEncodingDirection="COLUMN" if protocol.phase_encoding == "COL" else "ROW",
        MRAcquisitionFrequencyEncodingSteps=frequency,
        MRAcquisitionPhaseEncodingStepsInPlane=steps,
        PercentSampling=classic["PercentSampling"],
        PercentPhaseFieldOfView=classic["PercentPhaseFieldOfView"],
    )
    shared.MREchoSequence = _item(EffectiveEchoTime=protocol.echo_time_ms)
    shared.MRModifierSequence = _item(
        InversionRecovery="NO",
        FlowCompensation="NONE",
        Spoiling="RF_AND_GRADIENT",
        T2Preparation="NO",
        SpectrallySelectedExcitation="NONE",
        SpatialPresaturation="NONE",
        PartialFourier="NO",
        ParallelAcquisition="NO",
    )
    shared.MRImagingModifierSequence = _item(
        MagnetizationTransfer="NONE",
        BloodSignalNulling="NO",
        Tagging="NONE",
        TransmitterFrequency=protocol.imaging_frequency_mhz,
        PixelBandwidth=classic["PixelBandwidth"],
    )
    shared.MRReceiveCoilSequence = _item(
        ReceiveCoilName="Spine",
        ReceiveCoilManufacturerName="",
        ReceiveCoilType="SURFACE",
        QuadratureReceiveCoil="NO",
    )
    shared.MRTransmitCoilSequence = _item(
        TransmitCoilName="Body", TransmitCoilManufacturerName="", TransmitCoilType="BODY"
    )
    shared.MRAveragesSequence = _item(NumberOfAverages=1)
    return shared


def _frame_groups(
    classic: dict[str, Any],
    frame_type: dict[str, Any],
    stamp: AcquisitionStamp,
    scanner: ScannerSettings,
) -> Dataset:
    started = local_time(stamp.started_s, scanner)
    middle = local_time(stamp.started_s + stamp.duration_s / 2, scanner)
    frame = Dataset()
    frame.FrameContentSequence = _item(
        FrameAcquisitionNumber=stamp.acquisition_number,
        FrameReferenceDateTime=middle.strftime("%Y%m%d%H%M%S.%f"),
        FrameAcquisitionDateTime=started.strftime("%Y%m%d%H%M%S.%f"),
        FrameAcquisitionDuration=1000.0 * stamp.duration_s,
        StackID="1",
        InStackPositionNumber=1,
        DimensionIndexValues=1,
    )
    frame.PlanePositionSequence = _item(ImagePositionPatient=classic["ImagePositionPatient"])
    frame.MRImageFrameTypeSequence = _item(
        FrameType=frame_type["value"], **_describe_frame_type(frame_type)
    )
    return frame
