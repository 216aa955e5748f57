"""From delays that were seen to what may be believed of those to come."""

from collections.abc import Sequence

from dicom_listener.clock import Promptness

FEWEST_DELAYS = 20
_MARGIN_S = 0.1


class TooFewDelaysError(ValueError):
    """So few slices say nothing of the latest one."""


def promptness_of(delays_s: Sequence[float]) -> Promptness:
    """Bounds for the delay of a slice, from those of `FEWEST_DELAYS` or more (seconds).

    The range seen is widened by half of itself at both ends: of the next slice, 20 delays bound
    the range alone with a probability of 19/21.
    """
    if len(delays_s) < FEWEST_DELAYS:
        raise TooFewDelaysError(f"{len(delays_s)} delays; at least {FEWEST_DELAYS} are needed")
    least_s, most_s = min(delays_s), max(delays_s)
    margin_s = (most_s - least_s) / 2 + _MARGIN_S
    return Promptness(max(0.0, least_s - margin_s), most_s + margin_s)
