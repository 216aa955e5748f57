"""Commands to the robot: stop, re-arm, jog, and the insertion lock."""

from __future__ import annotations

from collections.abc import Mapping

from robot_bridge.client.client import BridgeError, BridgeStatus
from service.procedure.initial_estimate import POSITION_DECLARED
from service.procedure.plan import PlanRefusedError, check_travel
from service.procedure.registry import JOG
from service.room.context import RoomContext
from service.room.going_on import ARMED
from service.room.refusal import ConflictError
from service.room.robot.whereabouts import in_words, taken_to_stand
from service.room.validity import NEEDLE_OUT


class RobotCommands:
    """What may be asked of the robot itself."""

    def __init__(self, room: RoomContext) -> None:
        self._room = room

    def reset(self, by: str, positions_um: Mapping[str, int] | None = None) -> None:
        """Clear a latched stop, and arm.

        positions_um: where the operator says that the axes stand whose position is not certain.
        Nobody else says so: without it a robot that may stand anywhere is not armed.
        """
        status = self._room.linked()
        pressed = self._room.stops.pressed
        try:
            if not status.position_certain:
                self._declare(status, by, positions_um)
            if status.stopped:
                self._room.link.client.rearm(by)
            elif not status.armed:
                self._room.link.client.arm(by)
        except BridgeError as error:
            raise ConflictError("robot_refused", str(error)) from error
        self._room.stops.release(pressed)
        if not (status.armed and status.position_certain):
            self._room.note(ARMED, by, {})

    def _declare(self, status: BridgeStatus, by: str, said_um: Mapping[str, int] | None) -> None:
        """What the operator said of the axes that are not certain; where that is only what the
        bridge remembers, it is known no better than that. Raises BridgeError.
        """
        taken = taken_to_stand(status)
        if said_um is None or said_um.keys() != taken.keys():
            raise ConflictError(
                "position_unconfirmed",
                f"{in_words(taken)} The robot is not armed until someone confirms these "
                "positions or gives the right ones (positions_um).",
            )
        counted_um = {axis: status.positions_um.get(axis, 0) for axis in taken}
        within_um = {
            axis: one.within_um
            for axis, one in taken.items()
            if one.within_um is not None and said_um[axis] == one.at_um
        }
        self._room.link.client.declare_position(dict(said_um), by, within_um)
        body = {"positions_um": dict(said_um), "counted_um": counted_um, "within_um": within_um}
        self._room.note(POSITION_DECLARED, by, body)

    def note_stop(self, by: str, emergency: bool) -> None:
        """STOP was sent already: record it and end the procedure."""
        self._room.note("emergency" if emergency else "stop", by, {})
        self._room.abort(f"STOP by {by}")

    def jog(self, axis: str, distance_um: int, by: str) -> int:
        """Move one axis by hand; returns the id of the procedure that does it."""
        self._room.check_may_start()
        status = self._room.linked()
        travel = self._room.travel()
        if axis not in travel or axis not in status.positions_um:
            raise ConflictError("unknown_axis", f"The robot has no axis {axis!r}.")
        if axis not in status.certain_axes:
            raise ConflictError("position_uncertain", "Check the robot's position and re-arm.")
        setpoint_um = status.positions_um[axis] + distance_um
        try:
            check_travel({axis: setpoint_um}, travel)
        except PlanRefusedError as error:
            raise ConflictError("out_of_travel", f"Not moved: {error}.") from error
        setpoints_um = {**status.positions_um, axis: setpoint_um}
        return self._room.begin(JOG, {"setpoints_um": setpoints_um}, by)

    def lock_motion(self, by: str) -> None:
        """The needle is going in: no motion until the operator says that it is out."""
        self._room.linked()
        if self._room.record.running_procedure() is not None:
            raise ConflictError("busy", "A procedure is running: end it before locking motion.")
        try:
            self._room.link.client.set_insertion_lock(True, by)
        except BridgeError as error:
            raise ConflictError("robot_refused", str(error)) from error
        self._room.note("insertion_locked", by, {})

    def needle_out(self, by: str) -> None:
        """The needle is out: unlock motion."""
        status = self._room.linked()
        self._room.note(NEEDLE_OUT, by, {})
        if not status.insertion_locked:
            return
        try:
            self._room.link.client.set_insertion_lock(False, by)
        except BridgeError as error:
            raise ConflictError("robot_refused", str(error)) from error
