"""The line by other ways than a pseudo-terminal, and lines that are not there."""

import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from bridge_room import AXES, bridge_room

from robot_bridge.client.client import BridgeClient, LinkLostError
from robot_bridge.protocol.phases import WorkPhase
from robot_bridge.protocol.transport import DescriptorTransport, SerialTransport, TransportError


class TcpRelay:
    """Two serial-to-Ethernet servers back to back: what one client writes, the other reads."""

    def __init__(self) -> None:
        self._servers = [socket.create_server(("127.0.0.1", 0)) for _ in range(2)]
        self.urls = [f"socket://127.0.0.1:{s.getsockname()[1]}" for s in self._servers]
        self._clients: list[socket.socket] = []
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def _serve(self) -> None:
        self._clients = [server.accept()[0] for server in self._servers]
        other = threading.Thread(target=self._carry, args=(1, 0), daemon=True)
        other.start()
        self._carry(0, 1)
        other.join()

    def _carry(self, source: int, sink: int) -> None:
        try:
            while data := self._clients[source].recv(4096):
                self._clients[sink].sendall(data)
        except OSError:
            return

    def cut(self) -> None:
        for client in self._clients:
            client.shutdown(socket.SHUT_RDWR)
            client.close()

    def close(self) -> None:
        self._thread.join(10)
        for server in self._servers:
            server.close()


@pytest.fixture
def relay() -> Iterator[TcpRelay]:
    relay = TcpRelay()
    yield relay
    relay.close()


def test_the_line_may_be_two_serial_servers_on_the_network(tmp_path: Path, relay: TcpRelay):
    with bridge_room(tmp_path) as room:
        text = room.config_file.read_text().replace(room.line.near, relay.urls[0])
        room.config_file.write_text(text)
        room.start_daemon()
        client = BridgeClient(relay.urls[1], heartbeat_s=0.1)
        client.open(15.0)
        client.declare_position(dict.fromkeys(AXES, 0), "test")
        client.set_phase(WorkPhase.MANUAL, "test")
        client.arm("test")
        assert client.move("a", dict.fromkeys(AXES, 400), None).done
        relay.cut()
        with pytest.raises(LinkLostError):
            client.pump(3.0)
        time.sleep(0.3)
        assert not room.controllers.moving
        client.close()


@pytest.mark.parametrize("url", ["/dev/no-such-line", "socket://127.0.0.1:1", "nonsense://x"])
def test_a_line_that_cannot_be_opened_is_named(url: str):
    with pytest.raises(TransportError, match="cannot be opened") as caught:
        SerialTransport(url, 115200)
    assert url in str(caught.value)
    with pytest.raises(LinkLostError, match="no answer from a bridge"):
        BridgeClient(url).open(0.1)


def test_the_end_of_the_other_side_is_a_transport_error():
    near, far = socket.socketpair()
    line = DescriptorTransport(near)
    far.sendall(b"abc")
    assert line.read(0.1) == b"abc"
    assert line.read(0.01) == b""
    far.close()
    with pytest.raises(TransportError, match="disconnected"):
        line.read(0.1)
    with pytest.raises(TransportError, match="disconnected"):
        line.write(b"abc")
    line.close()


def test_a_line_that_is_ended_takes_its_links_along_but_no_others(tmp_path: Path):
    """A link that stays would lead to whatever gets that terminal next."""
    ends = [tmp_path / "near", tmp_path / "far"]
    words = ("-m", "simulator.serial_line", "--near", ends[0], "--far", ends[1])
    with subprocess.Popen([sys.executable, *words], stdout=subprocess.PIPE) as line:
        assert line.stdout is not None
        line.stdout.readline()
        assert all(end.is_symlink() for end in ends)
        ends[1].unlink()
        ends[1].symlink_to("/dev/null")
        line.send_signal(signal.SIGTERM)
        assert line.wait(5.0) == 0
    assert [end.is_symlink() for end in ends] == [False, True]
