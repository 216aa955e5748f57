"""Frames with known truth as DICOM files and a table of displacements, for `autospine locate`.

    python tests/service/frames_to_dicom.py FRAMES.npz FOLDER [COUNT]

writes FOLDER/template (COUNT files, 9 by default, and table.csv), FOLDER/frames (the others) and
FOLDER/truth.csv.
"""

import csv
import sys
from pathlib import Path

import numpy as np
from pydicom.dataset import Dataset, FileMetaDataset
from pydicom.uid import ExplicitVRLittleEndian, MRImageStorage, generate_uid


def dataset_of(pixels: np.ndarray, spacing_mm: tuple[float, float] = (1.0, 1.0)) -> Dataset:
    """An MR slice of unsigned 16-bit magnitudes (rows, cols)."""
    dataset = Dataset()
    dataset.file_meta = FileMetaDataset()
    dataset.file_meta.TransferSyntaxUID = ExplicitVRLittleEndian
    dataset.file_meta.MediaStorageSOPClassUID = dataset.SOPClassUID = MRImageStorage
    dataset.file_meta.MediaStorageSOPInstanceUID = dataset.SOPInstanceUID = generate_uid()
    dataset.StudyInstanceUID, dataset.SeriesInstanceUID = "1.2.826.0.1.2", "1.2.826.0.1.3"
    dataset.FrameOfReferenceUID = "1.2.826.0.1.4"
    dataset.Modality, dataset.ImageType = "MR", ["ORIGINAL", "PRIMARY", "M", "NONE"]
    dataset.PatientName, dataset.PatientID = "Phantom", "0"
    dataset.ImagePositionPatient, dataset.ImageOrientationPatient = [0, 0, 0], [1, 0, 0, 0, 1, 0]
    dataset.PixelSpacing, dataset.SliceThickness = list(spacing_mm), 3.0
    dataset.Rows, dataset.Columns = pixels.shape
    dataset.SamplesPerPixel, dataset.PhotometricInterpretation = 1, "MONOCHROME2"
    dataset.BitsAllocated, dataset.BitsStored, dataset.HighBit = 16, 16, 15
    dataset.PixelRepresentation = 0
    dataset.PixelData = np.clip(np.rint(pixels), 0, 65535).astype("<u2").tobytes()
    return dataset


def write_frames(
    frames: np.ndarray, centres_px: np.ndarray, folder: Path, count: int = 9
) -> tuple[Path, Path]:
    """Write frames (M, rows, cols); return the first ones' table and the others' folder."""
    template, others = folder / "template", folder / "frames"
    template.mkdir(parents=True)
    others.mkdir()
    table = template / "table.csv"
    with table.open("w", newline="") as file, (folder / "truth.csv").open("w", newline="") as all_:
        rows, truth = csv.writer(file), csv.writer(all_)
        rows.writerow(("file", "row_px", "col_px"))
        truth.writerow(("file", "row_px", "col_px"))
        for number, (frame, centre) in enumerate(zip(frames, centres_px, strict=True)):
            name = f"{number:03d}.dcm"
            here = template if number < count else others
            dataset_of(frame).save_as(here / name, enforce_file_format=True)
            truth.writerow((name, *(float(x) for x in centre)))
            if number < count:
                rows.writerow((name, *(float(x) for x in centre - centres_px[0])))
    return table, others


if __name__ == "__main__":
    with np.load(sys.argv[1]) as data:
        n = int(sys.argv[3]) if len(sys.argv) > 3 else 9
        print(*write_frames(data["frames"], data["centre_px"], Path(sys.argv[2]), n))
