"""One daemon for the tests of a file that leave it alive."""

from collections.abc import Iterator

import pytest
from bridge_room import BridgeRoom, bridge_room

from simulator.serial_line import LineFaults


@pytest.fixture(scope="module")
def _room_of_the_file(tmp_path_factory: pytest.TempPathFactory) -> Iterator[BridgeRoom]:
    with bridge_room(tmp_path_factory.mktemp("room")) as room:
        room.start_daemon()
        yield room


@pytest.fixture
def shared_room(
    _room_of_the_file: BridgeRoom, request: pytest.FixtureRequest
) -> Iterator[BridgeRoom]:
    """A room with a running daemon, which the test must leave running. Clients are closed."""
    room = _room_of_the_file
    room.test = request.node.name
    yield room
    room.close_clients()
    room.outcomes.clear()
    room.line.plug_in()
    room.line.set_faults(LineFaults())
    assert room.daemons[0].poll() is None, room.log
