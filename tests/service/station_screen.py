"""What a planning station shows, beside what the page shows."""

from __future__ import annotations

import time

import numpy as np
import pytest
from openigtlink_station import Station

from service.client import RoomClient
from service.room.state import RoomState
from service.slicer.messages import TO_RAS


def beside(state: RoomState, right_mm: float) -> tuple[float, float, float]:
    """A place beside the fiducial, LPS."""
    assert state.measurement is not None
    assert state.measurement.patient_mm is not None
    x, y, z = state.measurement.patient_mm
    return x + right_mm, y, z


def ras(place: tuple[float, float, float]) -> str:
    return " ".join(f"{value:.4f}" for value in np.array(place) * TO_RAS)


def shown_points(screen: Station, device: str) -> dict[str, tuple[float, ...]]:
    """LPS by name."""
    shown = screen.shown(device)
    listed = [] if shown is None else shown["points"]
    return {point["name"]: tuple((np.array(point["ras"]) * TO_RAS).tolist()) for point in listed}


def differences(screen: Station, state: RoomState) -> list[str]:
    """What a screen shows and the page does not, of a room with one fiducial."""
    robot, still = state.robot, state.robot.linked and not state.robot.moving
    seen = {
        one.measurement_id: one.patient_mm
        for one in (state.measurement, state.other_fiducial)
        if still and one is not None and one.lost is None
    }
    made = state.reconstruction
    points_now = {
        "Targets": {"target": state.target_patient_mm, "entry": state.entry_patient_mm},
        "Fiducials": dict(zip(["fiducial"], seen.values(), strict=False)),
    }
    there_now = {
        "NeedleGuide": state.ready and state.guide,
        "Slice": state.slice is not None,
        "SuperResolution": made is not None and made.measurement_id in seen,
    }
    wrong = []
    for device, listed in points_now.items():
        wanted = {name: place for name, place in listed.items() if place is not None}
        shown = shown_points(screen, device)
        same = set(shown) == set(wanted) and all(
            shown[name] == pytest.approx(place, abs=1e-3) for name, place in wanted.items()
        )
        wrong += [] if same else [f"{device} {shown}, not {wanted}"]
    for device, there in there_now.items():
        if (screen.shown(device) is not None) != there:
            wrong.append(f"{device}: {there} on the page")
    status = screen.shown("AutoSPINe") or {"code": 0, "name": "", "text": ""}
    could = robot.armed and not robot.stopped and robot.position_certain
    said = [text.encode("ascii", "ignore") for text in (status["text"], state.prompt)]
    name = "READY" if state.ready else state.procedure or robot.phase
    if (status["code"] in (1, 14)) != could or status["name"] != name or said[0] != said[1]:
        wrong.append(f"{status}, not {name}: {state.prompt}")
    return wrong


def assert_shows_what_the_page_shows(screen: Station, client: RoomClient) -> None:
    """Within a second."""
    deadline_s = time.monotonic() + 1.0
    while wrong := differences(screen, client.state()):
        assert time.monotonic() < deadline_s, wrong
        time.sleep(0.02)
