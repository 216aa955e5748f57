"""What is wrong in the room now, and what to do about it."""

from __future__ import annotations

import os
from pathlib import Path

from robot_bridge.protocol.phases import WorkPhase
from service.room.alarm_list import TO_DO, Condition
from service.room.prompt import plain_words
from service.room.state import RoomState

HANGS = "is not responding"

# a procedure that the operator ended is no alarm
_CHOSEN = frozenset({"rejected"})
_AFTER_FAILURE = {
    "prediction_missed": "Check whether something pushed the guide, then calibrate again.",
    "identity": "Check the slice position and that the slice shows the fiducial, then calibrate.",
    "not_converged": "Start the approach again; if it fails again, calibrate.",
    "target_out_of_reach": "Set another target, or reposition the robot and calibrate.",
    "other_place": "Set the target again on the new slices; calibrate again if asked.",
    "other_protocol": "Start again with these slices, or go back to the previous scan protocol.",
    "plane_changed": "Scan with the slice orientation used for calibration, then start again.",
    "calibration": "Check that every axis moves the guide, then calibrate again.",
    "plan_void": "Start the approach again: it will measure and plan again.",
}


def conditions(state: RoomState) -> list[Condition]:
    """What is wrong now, most urgent first; each with what to do about it."""
    robot = state.robot
    found = []
    if not robot.linked:
        found.append(
            Condition(
                "no_link",
                "alarm",
                f"No link to the robot: {robot.problem}",
                "Check the serial line and the computer in the scanner room.",
            )
        )
    if robot.linked and robot.fault:
        found.append(
            Condition(
                "fault", "alarm", f"Motor fault: {robot.fault}", "Check the motors, then re-arm."
            )
        )
    if robot.linked and robot.phase == WorkPhase.EMERGENCY:
        text = f"EMERGENCY ({plain_words(robot.stop_reason)}): drives parked"
        what = "Attend to the patient and the needle. Re-arm when it is safe, then measure again."
        found.append(Condition("emergency", "alarm", text, what))
    elif robot.linked and robot.stopped:
        text = f"The robot is stopped ({plain_words(robot.stop_reason)})"
        found.append(Condition("stopped", "alarm", text, "Re-arm when it is safe."))
    if robot.linked and not robot.position_certain:
        text = "The robot's position is uncertain"
        found.append(
            Condition(
                "position",
                "warning",
                text,
                "Confirm where the stages stand, then measure.",
            )
        )
    if state.ready_lost is not None:
        text = f"READY was lost: {state.ready_lost.text}"
        what = (
            "Confirm that the needle is withdrawn, then start the approach: it will measure again."
        )
        found.append(Condition("ready_lost", "alarm", text, what))
    if state.target_lost is not None:
        text = f"The target is void: {state.target_lost.text}"
        found.append(Condition("target_void", "alarm", text, "Pick the target on the new slices."))
    if state.last_failure is not None and state.last_failure not in _CHOSEN:
        what = _AFTER_FAILURE.get(state.last_failure, "See the reason, then start again.")
        text = state.last_outcome[:1].upper() + state.last_outcome[1:].replace("_", " ")
        found.append(Condition("procedure_failed", "alarm", text, what))
    for process in state.processes:
        if process.condition == "down" or process.detail == HANGS:
            text = f"The {process.name} {process.detail}"
            found.append(
                Condition(f"{process.name}_lost", "alarm", text, f"Restart the {process.name}.")
            )
    if state.measurement is not None and state.measurement.state == "failed":
        text = f"Measurement failed: {state.measurement.reason}"
        found.append(Condition("measurement", "warning", text, "Acquire the slice again."))
    return found


def disk_refuses(case_dir: Path, min_free_mib: int) -> list[Condition]:
    """A disk on which the listener can store no slice; an alarm of its own could not be recorded.

    Raises OSError if the folder is gone.
    """
    disk = os.statvfs(case_dir)
    if disk.f_flag & os.ST_RDONLY:
        text = "The case's disk is read-only: slices are refused"
    elif disk.f_bavail * disk.f_frsize < min_free_mib * 2**20:
        text = f"The case's disk has less than {min_free_mib} MiB free: slices are refused"
    else:
        return []
    return [Condition("disk_refuses", "alarm", text, TO_DO["disk_low"])]
