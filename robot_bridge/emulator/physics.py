"""What an emulated controller needs to know of the motor and stage behind it."""

from typing import Protocol

from robot_bridge.pmd.protocol import MICROSTEPS_PER_STEP


class StagePhysics(Protocol):
    """A motor with its stage. Positive microsteps are the controller's forward direction."""

    @property
    def position_um(self) -> float:
        """Where the stage truly stands."""
        ...

    def begin_run(self) -> None:
        """A new motion begins (scatter from move to move is drawn here)."""
        ...

    def drive(self, microsteps: int, frequency_hz: float) -> None:
        """The waveform has advanced by that many microsteps at that rate."""
        ...

    def park(self) -> None: ...

    def unpark(self) -> None: ...

    def displace(self, distance_um: float) -> None:
        """Something else than the motor moved the stage (slip)."""
        ...

    def read_encoder_um(self) -> float | None:
        """What a position encoder sees; None if none is fitted."""
        ...


class IdealStage:
    """Every step has the same length; nothing scatters. For an emulator that stands alone."""

    def __init__(
        self, step_length_um: float = 4.5, position_um: float = 0.0, has_encoder: bool = True
    ) -> None:
        self._step_length_um = step_length_um
        self._position_um = position_um
        self._has_encoder = has_encoder

    @property
    def position_um(self) -> float:
        return self._position_um

    def begin_run(self) -> None:
        pass

    def drive(self, microsteps: int, frequency_hz: float) -> None:
        self._position_um += microsteps / MICROSTEPS_PER_STEP * self._step_length_um

    def park(self) -> None:
        pass

    def unpark(self) -> None:
        pass

    def displace(self, distance_um: float) -> None:
        self._position_um += distance_um

    def read_encoder_um(self) -> float | None:
        return self._position_um if self._has_encoder else None
