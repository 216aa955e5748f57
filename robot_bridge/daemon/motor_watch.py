"""The motors as the bridge holds them: their newest status, and stops that are seen through."""

from collections.abc import Callable
from dataclasses import replace

from robot_bridge.daemon.motors import MotorError, Motors

STOP_AGAIN_S = 0.1
PARK_AGAIN_S = 1.0


class MotorWatch:
    """`status` is what the last poll said. Nothing here decides; a failed stop is tried again."""

    def __init__(self, motors: Motors, clock: Callable[[], float]) -> None:
        self.motors = motors
        self.status = motors.poll()
        self.stop_unconfirmed = False
        self._clock = clock
        self._polled_s = self._stopped_s = self._parked_s = clock()

    def poll_if_due(self, period_s: float) -> bool:
        """Whether the status is new."""
        now_s = self._clock()
        if now_s - self._polled_s < period_s:
            return False
        self._polled_s = now_s
        self.poll()
        return True

    def poll(self) -> None:
        try:
            self.status = self.motors.poll()
        except MotorError as error:  # the driver's promise is broken; believe the worst
            self.status = replace(
                self.status, certain_axes=frozenset(), fault=error.code, fault_text=error.text
            )

    def begun(self) -> None:
        """A motion begins now: the next status is due a period from here."""
        self._polled_s = self._clock()

    def stop(self) -> None:
        self._stopped_s = self._clock()
        try:
            self.motors.stop()
            self.stop_unconfirmed = False
        except MotorError:
            self.stop_unconfirmed = True

    def stop_again_if_due(self) -> None:
        if self._clock() - self._stopped_s > STOP_AGAIN_S:
            self.stop()

    def park(self) -> str | None:
        """Begin to park. Returns what went wrong, if anything."""
        self._parked_s = self._clock()
        try:
            self.motors.park()
        except MotorError as error:
            return str(error)
        return None

    def park_again_if_due(self) -> None:
        """A stop that came after the parking began has cut it short."""
        if not self.status.parked and self._clock() - self._parked_s > PARK_AGAIN_S:
            self.park()

    def clear_fault(self) -> None:
        """Faults that a stop ends are ended; one whose cause lasts comes back at once."""
        if self.status.fault is not None:
            self.stop()
            self.poll()
