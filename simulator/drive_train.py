"""Between motors and stages: what a robot is that was put together wrong, or is worn.

Axes that are swapped, reversed, out of scale, coupled or loose; and play. The motors know nothing
of it. Positions in mm by axis.
"""

from collections.abc import Mapping, Sequence

Positions = Mapping[str, float]


class DriveTrain:
    """shares: by axis, how far its stage goes for each mm that each axis's motor drives.

    play_mm: by axis; of a motion that reverses, so much is lost.
    """

    def __init__(self, axes: Sequence[str]) -> None:
        self._axes = tuple(axes)
        self.shares = {axis: [float(axis == other) for other in axes] for axis in axes}
        self.play_mm = dict.fromkeys(axes, 0.0)
        self._gap_mm = dict.fromkeys(axes, 0.0)
        self._stood_mm: Positions = {}

    def stands_at(self, positions_mm: Positions) -> None:
        """From here on the motors are watched."""
        self._stood_mm = positions_mm

    def astray_mm(self, positions_mm: Positions) -> dict[str, float]:
        """How far each stage goes wrong while the motors bring it to these positions."""
        if not self._stood_mm:
            return {}
        driven = [positions_mm[axis] - self._stood_mm[axis] for axis in self._axes]
        if not any(driven):
            return {}
        return {
            axis: self._made_mm(axis, driven) - mm
            for axis, mm in zip(self._axes, driven, strict=True)
        }

    def _made_mm(self, axis: str, driven: Sequence[float]) -> float:
        wanted = sum(share * mm for share, mm in zip(self.shares[axis], driven, strict=True))
        play, gap = self.play_mm[axis], self._gap_mm[axis]
        self._gap_mm[axis] = min(max(gap + wanted, 0.0), play)
        return wanted - (self._gap_mm[axis] - gap)
