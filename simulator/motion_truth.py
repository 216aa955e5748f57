"""What truly happened to the stages: samples in time, and every motion that began.

Pure bookkeeping; times are seconds since the epoch, positions millimetres by axis.
"""

from bisect import bisect_right
from collections.abc import Mapping
from dataclasses import dataclass

MAX_SAMPLES = 500_000
COMMANDED = frozenset({"run", "target", "index", "script"})
UNPROMPTED = "unprompted"  # moved, and no command of the controller had begun it


@dataclass
class Motion:
    """`cause`: what the command was (COMMANDED), "park" or "unpark" (a small shift), or
    "unprompted"."""

    axis: str
    cause: str
    t_start: float
    from_mm: float
    to_mm: float
    t_end: float | None = None

    def as_dict(self) -> dict[str, object]:
        return {
            "axis": self.axis,
            "cause": self.cause,
            "t_start": self.t_start,
            "t_end": self.t_end,
            "from_mm": self.from_mm,
            "to_mm": self.to_mm,
        }


class MotionTruth:
    def __init__(self, positions_mm: Mapping[str, float], now_s: float) -> None:
        self._times: list[float] = [now_s]
        self._samples: list[dict[str, float]] = [dict(positions_mm)]
        self.motions: list[Motion] = []
        self._open: dict[str, Motion] = {}

    @property
    def positions_mm(self) -> dict[str, float]:
        return dict(self._samples[-1])

    def begin(self, axis: str, cause: str, now_s: float) -> None:
        """A command begins a motion of the axis; an unfinished one ends here."""
        self.end(axis, now_s)
        at_mm = self._samples[-1][axis]
        self._open[axis] = Motion(axis, cause, now_s, at_mm, at_mm)
        self.motions.append(self._open[axis])

    def end(self, axis: str, now_s: float) -> None:
        motion = self._open.pop(axis, None)
        if motion is not None:
            motion.t_end = now_s
            motion.to_mm = self._samples[-1][axis]

    def observe(self, positions_mm: Mapping[str, float], now_s: float) -> bool:
        """Note where the stages are; True if any has moved since the last look."""
        before = self._samples[-1]
        changed = [axis for axis, mm in positions_mm.items() if mm != before[axis]]
        if not changed:
            return False
        self._append(dict(positions_mm), now_s)
        for axis in changed:
            if axis in self._open:
                self._open[axis].to_mm = positions_mm[axis]
            else:
                at_mm, to_mm = before[axis], positions_mm[axis]
                self.motions.append(Motion(axis, UNPROMPTED, now_s, at_mm, to_mm, now_s))
        return True

    def _append(self, positions_mm: dict[str, float], now_s: float) -> None:
        if len(self._times) >= MAX_SAMPLES:
            del self._times[: MAX_SAMPLES // 2]
            del self._samples[: MAX_SAMPLES // 2]
        self._times.append(max(now_s, self._times[-1]))  # the clock may be set back
        self._samples.append(positions_mm)

    @property
    def last_change_s(self) -> float:
        return self._times[-1]

    def history(self, t0_s: float, t1_s: float) -> dict[str, object]:
        """Where the stages stood at `t0_s`, and each change within the interval."""
        times, positions = self._times, self._samples
        first, last = bisect_right(times, t0_s), bisect_right(times, t1_s)
        start = max(0, min(first - 1, len(times) - 1))
        samples = [[times[i], positions[i]] for i in range(first, last)]
        return {
            "t0": t0_s,
            "t1": t1_s,
            "known": t0_s >= times[0],  # the record reaches back to t0
            "start_mm": positions[start],
            "moved": bool(samples),
            "samples": samples,
        }
