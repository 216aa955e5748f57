"""A serial line with faults: loss, bit flips, duplicates, truncation, delay, garbage, unplugging.

`FaultyDirection` is one direction, pure and in any time: bytes go in at an instant, and come out
later, damaged as the seed says. Faults strike what stands between two zero bytes, which is a frame
of the bridge's protocol. `NullModem` joins two pseudo-terminals by two such directions in real
time; as a process: `python -m simulator.serial_line --near PATH --far PATH [--loss P] ...`.
"""

import argparse
import contextlib
import heapq
import json
import os
import random
import select
import signal
import sys
import threading
import time
import tty
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path

IDLE_WAIT_S = 0.05


@dataclass(frozen=True)
class LineFaults:
    """Chances a frame, 0 to 1; `delay_max_s` is the longest of the delays that `delay` strikes.

    Delayed frames are overtaken by later ones: that is the reordering.
    """

    loss: float = 0.0
    bit_flip: float = 0.0
    duplicate: float = 0.0
    truncate: float = 0.0
    garbage: float = 0.0
    delay: float = 0.0
    delay_max_s: float = 0.3
    latency_s: float = 0.0

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            limit = 60.0 if field.name.endswith("_s") else 1.0
            if not 0.0 <= value <= limit:
                raise ValueError(f"line fault {field.name}: {value} is not in 0..{limit:g}")


class FaultyDirection:
    """One direction of the line."""

    def __init__(self, faults: LineFaults, rng: random.Random, byte_s: float = 0.0) -> None:
        self.faults = faults
        self.connected = True
        self.frames = self.frames_hit = 0
        self._rng = rng
        self._byte_s = byte_s
        self._partial = bytearray()
        self._queue: list[tuple[float, int, bytes]] = []
        self._count = 0
        self._wire_free_s = 0.0
        self._against: FaultyDirection | None = None
        self.collisions = 0

    def share_wire_with(self, other: "FaultyDirection") -> None:
        """Half duplex: who talks while the other talks destroys both frames. Needs `byte_s`."""
        self._against, other._against = other, self

    def send(self, data: bytes, now_s: float) -> None:
        self._partial += data
        *frames, rest = bytes(self._partial).split(b"\0")
        self._partial = bytearray(rest)
        for frame in frames:
            self._send_frame(frame, now_s)

    def _send_frame(self, frame: bytes, now_s: float) -> None:
        if not frame:
            return
        begins_s = max(self._wire_free_s, now_s)
        self._wire_free_s = begins_s + (len(frame) + 2) * self._byte_s
        self.frames += 1
        if self._against is not None and self._against._destroyed_from(begins_s):
            self.collisions += 1
            self.frames_hit += 1
            return
        faults, rng = self.faults, self._rng
        if not self.connected or rng.random() < faults.loss:
            self.frames_hit += 1
            return
        copies = 2 if rng.random() < faults.duplicate else 1
        for _ in range(copies):
            at_s = self._wire_free_s + faults.latency_s
            if rng.random() < faults.delay:
                at_s += rng.uniform(0.0, faults.delay_max_s)
            self._put(at_s, b"\0" + self._damaged(frame) + b"\0")
        if rng.random() < faults.garbage:
            self._put(now_s, rng.randbytes(rng.randint(1, 40)))

    def _destroyed_from(self, at_s: float) -> bool:
        """Whether a frame of ours is on the wire at `at_s`; if so, it does not arrive."""
        if at_s >= self._wire_free_s:
            return False
        on_the_wire = [entry for entry in self._queue if entry[0] >= self._wire_free_s]
        for entry in on_the_wire:
            self._queue.remove(entry)
        heapq.heapify(self._queue)
        return True

    def _damaged(self, frame: bytes) -> bytes:
        faults, rng = self.faults, self._rng
        damaged = bytearray(frame)
        if rng.random() < faults.bit_flip:
            for _ in range(rng.choice((1, 1, 1, 2, 3, 8))):
                damaged[rng.randrange(len(damaged))] ^= 1 << rng.randrange(8)
        if rng.random() < faults.truncate:
            del damaged[rng.randrange(len(damaged)) :]
        self.frames_hit += bytes(damaged) != frame
        return bytes(damaged)

    def _put(self, at_s: float, data: bytes) -> None:
        self._count += 1
        heapq.heappush(self._queue, (at_s, self._count, data))

    def take_due(self, now_s: float) -> bytes:
        """What has arrived at the other end by `now_s`."""
        due = bytearray()
        while self._queue and self._queue[0][0] <= now_s:
            due += heapq.heappop(self._queue)[2]
        return bytes(due)

    @property
    def next_s(self) -> float | None:
        """When something arrives next, or None."""
        return self._queue[0][0] if self._queue else None

    def clear(self) -> None:
        """What is on the way is lost (the line was unplugged)."""
        self._queue.clear()
        self._partial.clear()


class NullModem:
    """Two pseudo-terminals joined by a faulty line; `near` and `far` are what to open."""

    def __init__(
        self,
        faults: LineFaults | None = None,
        *,
        seed: int = 0,
        baud: int = 115200,
        near_link: Path | None = None,
        far_link: Path | None = None,
    ) -> None:
        faults = faults or LineFaults()
        self._masters: list[int] = []
        self._slaves: list[int] = []
        for _ in range(2):
            master, slave = os.openpty()
            tty.setraw(slave)
            os.set_blocking(master, False)
            self._masters.append(master)
            self._slaves.append(slave)  # held open, so that either side may come and go
        self.near, self.far = (os.ttyname(slave) for slave in self._slaves)
        self._links = {
            link: name
            for link, name in ((near_link, self.near), (far_link, self.far))
            if link is not None
        }
        for link, name in self._links.items():
            _point(link, name)
        byte_s = 10 / baud
        self.directions = [
            FaultyDirection(faults, random.Random(f"{seed}:{index}"), byte_s) for index in range(2)
        ]
        self._wake_read, self._wake_write = os.pipe()
        self._running = False
        self._thread: threading.Thread | None = None

    def set_faults(self, faults: LineFaults) -> None:
        for direction in self.directions:
            direction.faults = faults

    def unplug(self) -> None:
        for direction in self.directions:
            direction.connected = False
            direction.clear()

    def plug_in(self) -> None:
        for direction in self.directions:
            direction.connected = True

    def serve(self) -> None:
        """Carry bytes until `close` is called."""
        self._running = True
        while self._running:
            waits = [d.next_s for d in self.directions if d.next_s is not None]
            wait_s = min([w - time.monotonic() for w in waits], default=IDLE_WAIT_S)
            watched = [*self._masters, self._wake_read]
            ready, _, _ = select.select(watched, [], [], min(max(wait_s, 0.0), IDLE_WAIT_S))
            self._carry(ready)

    def _carry(self, ready: Sequence[int]) -> None:
        for index, direction in enumerate(self.directions):
            if self._masters[index] in ready:
                direction.send(os.read(self._masters[index], 65536), time.monotonic())
            due = direction.take_due(time.monotonic())
            if due:
                self._deliver(self._masters[1 - index], due)

    def _deliver(self, master: int, data: bytes) -> None:
        try:
            os.write(master, data)
        except BlockingIOError:
            return  # nobody reads there: a real line loses the bytes as well

    def start(self) -> "NullModem":
        self._thread = threading.Thread(target=self.serve, name="null-modem", daemon=True)
        self._thread.start()
        return self

    def close(self) -> None:
        self._running = False
        os.write(self._wake_write, b"x")
        if self._thread is not None:
            self._thread.join()
        for link, name in self._links.items():
            with contextlib.suppress(OSError):  # another line may have taken it over
                if os.readlink(link) == name:
                    link.unlink()
        for descriptor in (*self._masters, *self._slaves, self._wake_read, self._wake_write):
            os.close(descriptor)

    def __enter__(self) -> "NullModem":
        return self.start()

    def __exit__(self, *exception: object) -> None:
        self.close()


def _point(link: Path, name: str) -> None:
    if link.exists() and not link.is_symlink():
        raise FileExistsError(f"{link} exists and is not a link to a pseudo-terminal")
    fresh = link.with_name(f".{link.name}.{os.getpid()}")
    fresh.symlink_to(name)
    fresh.replace(link)


def _end_with_parent() -> None:
    while os.read(0, 4096):
        pass
    os._exit(0)  # nothing to save: a line has no state


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m simulator.serial_line", description=__doc__)
    parser.add_argument("--near", type=Path, required=True, help="link to one end's terminal")
    parser.add_argument("--far", type=Path, required=True, help="link to the other end's terminal")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--baud", type=int, default=115200)
    for field in fields(LineFaults):
        name = "--" + field.name.replace("_", "-")
        parser.add_argument(name, type=float, default=field.default)
    parser.add_argument("--exit-with-parent", action="store_true", help="end with standard input")
    args = parser.parse_args(argv)
    try:
        faults = LineFaults(**{f.name: getattr(args, f.name) for f in fields(LineFaults)})
        modem = NullModem(
            faults, seed=args.seed, baud=args.baud, near_link=args.near, far_link=args.far
        )
    except (ValueError, OSError) as error:
        print(f"serial_line: {error}", file=sys.stderr)
        return 2
    if args.exit_with_parent:
        threading.Thread(target=_end_with_parent, daemon=True).start()
    with contextlib.closing(modem), contextlib.suppress(KeyboardInterrupt):
        signal.signal(signal.SIGTERM, signal.default_int_handler)
        print(json.dumps({"ready": True, "near": str(args.near), "far": str(args.far)}), flush=True)
        modem.serve()
    return 0


if __name__ == "__main__":
    sys.exit(main())
