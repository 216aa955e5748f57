"""Many open event streams; as a script, the process that reads them.

    python benchmarks/_viewers.py http://127.0.0.1:PORT COUNT

obeys the words `in ID` (from that event on, as a page does) and `out` on standard input.
"""

import asyncio
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from service.client import RoomClient

_PATIENCE_S = 300.0
_LOOK_EVERY_S = 0.02


@dataclass(frozen=True)
class Viewers:
    """They come in and leave when told to."""

    process: subprocess.Popen[str]
    client: RoomClient
    count: int

    def come_in(self) -> None:
        self._tell(f"in {self.client.state().event_id}", self.count)

    def leave(self) -> None:
        self._tell("out", 0)

    def _tell(self, word: str, wanted: int) -> None:
        """Returns when the service itself counts as many open streams as are wanted."""
        assert self.process.stdin is not None
        self.process.stdin.write(word + "\n")
        deadline_s = time.monotonic() + _PATIENCE_S
        while self.client.metric("autospine_viewers") != wanted:
            if time.monotonic() > deadline_s:
                raise SystemExit(f"{wanted} viewers did not come about")
            time.sleep(_LOOK_EVERY_S)


@contextmanager
def viewers(client: RoomClient, count: int) -> Iterator[Viewers]:
    """In a process of their own, so that reading costs the room's processes nothing."""
    words = [sys.executable, __file__, client.url, str(count)]
    with subprocess.Popen(words, stdin=subprocess.PIPE, text=True, bufsize=1) as process:
        try:
            yield Viewers(process, client, count)
        finally:
            process.terminate()


async def view(url: str, count: int) -> None:
    """Obey the words `in ID` and `out` on standard input."""
    host, port = url.removeprefix("http://").split(":")
    readers: list[asyncio.Task[None]] = []
    while word := (await asyncio.to_thread(sys.stdin.readline)).strip():
        if word.startswith("in ") and not readers:
            after = int(word.removeprefix("in "))
            readers = [asyncio.create_task(_read(host, int(port), after)) for _ in range(count)]
        elif word == "out":
            for reader in readers:
                reader.cancel()
            readers = []


async def _read(host: str, port: int, after: int) -> None:
    reader, writer = await asyncio.open_connection(host, port)
    try:
        path = f"/api/v1/events/live?after={after}"
        writer.write(f"GET {path} HTTP/1.1\r\nHost: {host}:{port}\r\n\r\n".encode())
        while await reader.read(65536):
            pass
    finally:
        writer.close()


if __name__ == "__main__":
    asyncio.run(view(sys.argv[1], int(sys.argv[2])))
