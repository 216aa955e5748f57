"""A virtual room: phantom, scanner that pushes real DICOM, stage physics."""
