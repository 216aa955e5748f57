"""By which protocol a slice shows the fiducial's oil where it does, beside the anatomy's water."""

from collections.abc import Mapping
from typing import Any

_NUMBERS = {
    "pixel_bandwidth_hz": "pixel bandwidth",
    "imaging_frequency_mhz": "imaging frequency",
}
_ENCODING = "phase_encoding_direction"
_SAME_SHARE = 1e-3


def other_protocol(mine: Mapping[str, Any], others: Mapping[str, Any]) -> str:
    """What shows oil elsewhere in the others' slices than in mine; empty if nothing does.

    Both: the header of a slice as the case record keeps it.
    """
    for key, name in _NUMBERS.items():
        a, b = mine.get(key), others.get(key)
        if a is None or b is None:
            if a is not b:
                return f"a {name} where the others have none"
        elif not abs(a - b) <= _SAME_SHARE * abs(a):
            return f"a different {name} ({b:g} instead of {a:g})"
    was, now = (header.get(_ENCODING) or "unknown" for header in (mine, others))
    return "" if was == now else f"a different phase encoding direction ({now} instead of {was})"
