"""Procedures in the offline room: the room's physics and the real engine, nobody waits."""

from collections.abc import Callable, Iterator

import pytest
from attended_room import AttendedRoom, running_room
from offline_arguments import calibration_arguments

from service.calibration import Calibration, calibrate
from service.client import RoomClient
from simulator.config import VirtualRoom
from simulator.stage_physics import StageParameters
from studies.offline_room import MrImaging, OfflineRoom


@pytest.fixture
def make_room() -> Callable[..., OfflineRoom]:
    def make(seed: int = 0, stages: StageParameters | None = None, **options) -> OfflineRoom:
        return OfflineRoom(MrImaging(VirtualRoom()), stages or StageParameters(), seed, **options)

    return make


@pytest.fixture
def calibrated(make_room) -> tuple[OfflineRoom, Calibration]:
    room = make_room(seed=3)
    return room, room.run(calibrate(calibration_arguments()))


@pytest.fixture(scope="session")
def room(tmp_path_factory: pytest.TempPathFactory) -> Iterator[AttendedRoom]:
    """One whole virtual room, all its processes, for the tests of API and page."""
    with running_room(tmp_path_factory.mktemp("room")) as running:
        yield running


@pytest.fixture
def client(room: AttendedRoom) -> Iterator[RoomClient]:
    with RoomClient(room.url, by="tester") as talking:
        yield talking
