"""The round objects in DICOM files: centre ± σ in pixels, and where that is in the patient.

The first ± is what noise does; the one behind it what the shape does, where it is no disc.

python examples/localize.py PATH…  [--radius-mm 3,12]
"""

import argparse
from pathlib import Path

import numpy as np

from dicom_slice.read import dicom_files, read_frames
from dicom_slice.reasons import UnusableError
from sr_engine.errors import EngineError
from sr_engine.locate import locate_all

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("path", type=Path, nargs="+")
parser.add_argument("--radius-mm", default="3,12")
arguments = parser.parse_args()
smallest_mm, largest_mm = map(float, arguments.radius_mm.split(","))

try:
    frames = [(file, *one) for file in dicom_files(arguments.path) for one in read_frames(file)]
except UnusableError as error:
    raise SystemExit(str(error)) from None
for file, header, pixels in frames:
    pixel_mm = header.geometry.spacing_mm[0]
    try:
        found = locate_all(pixels, (smallest_mm / pixel_mm, largest_mm / pixel_mm))
    except EngineError as error:
        print(f"{file.name}: {error}")
        continue
    for one in found:
        row, col = one.centre_px
        noise_row, noise_col = np.sqrt(np.diag(one.covariance_px2))
        x, y, z = header.geometry.patient_from_pixel(one.centre_px)
        print(
            f"{file.name}: row {row:.3f} ± {noise_row:.3f} px, "
            f"col {col:.3f} ± {noise_col:.3f} px (its shape: "
            f"± {max(one.systematic_px):.3f} px), at ({x:.2f}, {y:.2f}, {z:.2f}) mm"
        )
