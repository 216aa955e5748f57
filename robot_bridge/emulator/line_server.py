"""Requests of one line, answers of one line, over TCP on the loopback; no threads."""

import contextlib
import socket
from collections.abc import Callable, Sequence

MAX_REQUEST_BYTES = 4096
SEND_TIMEOUT_S = 1.0


class LineServer:
    """Serves any number of clients from its owner's loop: `descriptors`, then `serve(ready)`."""

    def __init__(self, port: int, answer: Callable[[str], str]) -> None:
        self._listener = socket.create_server(("127.0.0.1", port))
        self._listener.setblocking(False)
        self._answer = answer
        self._clients: dict[int, tuple[socket.socket, bytearray]] = {}

    @property
    def port(self) -> int:
        return int(self._listener.getsockname()[1])

    def descriptors(self) -> list[int]:
        return [self._listener.fileno(), *self._clients]

    def serve(self, ready: Sequence[int]) -> None:
        if self._listener.fileno() in ready:
            with contextlib.suppress(BlockingIOError, ConnectionError):
                client, _ = self._listener.accept()
                client.settimeout(SEND_TIMEOUT_S)
                self._clients[client.fileno()] = (client, bytearray())
        for descriptor in [d for d in ready if d in self._clients]:
            self._serve_client(descriptor)

    def _serve_client(self, descriptor: int) -> None:
        client, pending = self._clients[descriptor]
        try:
            received = client.recv(4096)
            pending += received
            while b"\n" in pending:
                line, _, rest = bytes(pending).partition(b"\n")
                pending[:] = rest
                request = line.decode("utf-8", "replace").strip()
                if request:
                    client.sendall(self._answer(request).encode("utf-8") + b"\n")
        except OSError:
            received = b""
        if not received or len(pending) > MAX_REQUEST_BYTES:
            client.close()
            del self._clients[descriptor]

    def close(self) -> None:
        for client, _ in self._clients.values():
            client.close()
        self._clients = {}
        self._listener.close()
