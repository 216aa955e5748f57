"""Coded concepts of the measurement report: the standard's where it has them, else ours.

Ours are of the private scheme 99AUTOSPINE; what each means stands in its meaning.
"""

from __future__ import annotations

from highdicom.sr import CodedConcept
from pydicom.dataset import Dataset
from pydicom.sr.codedict import codes

from service.dicom_out.identity import MAKER

SCHEME = "99AUTOSPINE"
_LONGEST_CODE = 16


def own(value: str, meaning: str) -> CodedConcept:
    return CodedConcept(value, SCHEME, meaning)


MILLIMETRE = codes.UCUM.Millimeter
NO_UNIT = codes.UCUM.NoUnits
SLICES = CodedConcept("{slices}", "UCUM", "slices")
MOVES = CodedConcept("{moves}", "UCUM", "moves")

RADIUS = codes.SCT.Radius
STANDARD_DEVIATION = codes.SCT.StandardDeviation
COMMENT = codes.DCM.Comment
REPORT_TITLE = codes.DCM.ImagingMeasurementReport
PROCEDURE = codes.SCT.ImagingGuidance
FIDUCIAL = own("fiducial", "Fiducial on the needle guide")

CENTRE = (
    own("centre-x", "Centre of the fiducial, x (towards the patient's left)"),
    own("centre-y", "Centre of the fiducial, y (towards the patient's back)"),
    own("centre-z", "Centre of the fiducial, z (towards the patient's head)"),
)
CENTRE_ALONG = (
    own("centre-row", "Centre of the fiducial, down the rows"),
    own("centre-col", "Centre of the fiducial, along the columns"),
)
SNR = own("snr", "Contrast of the fiducial over noise")
CHI_SQUARED = own("chi2", "Chi squared per degree of freedom of the fit")
FRAMES = own("frames", "Number of slices measured")
MOVES_MADE = own("iterations", "Number of moves of the approach")
DISTANCE = {
    "fiducial": own("target-distance", "Distance of the fiducial to its target in the slice"),
    "tip": own("tip-distance", "Distance of the needle tip to its target in the slice"),
}
PROBABILITY = own("p-within", "Probability that the distance is below the tolerance")
TOLERANCE = own("tolerance", "Tolerance of the distance to the target")
DEPTH = own("insertion-depth", "Insertion depth from guide face to needle tip")
TARGET_AT = (
    own("must-be-row", "Target of the fiducial, down the rows, from the centre"),
    own("must-be-col", "Target of the fiducial, along the columns, from the centre"),
)
_METHODS = {
    "ml": "Maximum-likelihood fit of the imaged fiducial to all slices",
    "template": "Maximum-likelihood fit of the fiducial's own image to all slices",
    "outline": "Middle of the outline of a compact object",
    "sr": "Circle found in the super-resolution image",
    "bicubic": "Circle found in the bicubic interpolation of one slice",
    "base": "Circle found in one slice as acquired",
}


def method(name: str) -> CodedConcept:
    return own(f"method-{name}"[:_LONGEST_CODE], _METHODS.get(name, f"Method {name}"))


def scheme_identification() -> Dataset:
    """An item of CodingSchemeIdentificationSequence: whose scheme ours is."""
    item = Dataset()
    item.CodingSchemeDesignator = SCHEME
    item.CodingSchemeName = f"Private codes of {MAKER}"
    item.CodingSchemeResponsibleOrganization = MAKER
    return item
