"""Bad DICOM by the thousand: real and made files, cut, padded and overwritten. Seeds are kept."""

import random
from pathlib import Path

from made_slices import mr_data_set
from real_slices import DICOM

# One of each encoding and layout; a few kilobytes each where there is a choice.
SOURCES = (
    "pydicom/mr_small/MR_small.dcm",
    "pydicom/mr_small/MR_small_implicit.dcm",
    "pydicom/mr_small/MR_small_bigendian.dcm",
    "pydicom/mr_small/MR_small_RLE.dcm",
    "pydicom/mr_small/MR_small_jp2klossless.dcm",
    "pydicom/mr_small/MR_small_jpeg_ls_lossless.dcm",
    "pydicom-data/emri/emri_small.dcm",
    "pydicom-data/emri/emri_small_RLE.dcm",
    "pydicom-data/emri/emri_small_jpeg_2k_lossless.dcm",
    "dicom2nifti/hdr/jpegll.dcm",
    "dicom2nifti/hdr/hyperfine_enh.dcm",
    "dcm_qa_uih/vframe/00000001.dcm",
    "pydicom/odd/test-SR.dcm",
    "pydicom/odd/image_dfl.dcm",
)


def sources(folder: Path) -> list[bytes]:
    """Bytes of the files to mangle: the real ones where they are there, and one of our own."""
    made = folder / "made.dcm"
    mr_data_set().save_as(made, enforce_file_format=True)
    real = [DICOM / name for name in SOURCES if (DICOM / name).is_file()]
    return [made.read_bytes(), *(path.read_bytes() for path in real)]


def mangled(whole: bytes, seed: int) -> bytes:
    """The same bytes with a few things wrong, always the same for a seed."""
    dice = random.Random(seed)
    data = bytearray(whole)
    for _ in range(dice.choice((1, 1, 2, 5, 20))):
        _spoil(data, dice)
    return bytes(data)


def _spoil(data: bytearray, dice: random.Random) -> None:
    if not data:
        return
    # headers are short and pixels are long: most of the damage goes where the headers are
    end = min(len(data), dice.choice((200, 600, 2000, len(data))))
    at = dice.randrange(end)
    what = dice.randrange(7)
    if what == 0:
        del data[at:]
    elif what == 1:
        data[at] = dice.randrange(256)
    elif what == 2:
        data[at : at + 4] = dice.choice((b"\xff\xff\xff\xff", b"\0\0\0\0", b"\xff\xff\xff\x7f"))
    elif what == 3:
        del data[at : at + dice.choice((1, 2, 8, 100))]
    elif what == 4:
        data[at:at] = dice.randbytes(dice.choice((1, 2, 8, 100)))
    elif what == 5:
        other = dice.randrange(end)
        data[at : at + 16] = data[other : other + 16]
    else:
        data[at] ^= 1 << dice.randrange(8)
