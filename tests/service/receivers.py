"""Real C-STORE receivers on loopback, and the outbox's own process."""

from __future__ import annotations

import contextlib
import os
import shutil
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from pydicom.dataset import Dataset
from pydicom.uid import ExplicitVRLittleEndian, ImplicitVRLittleEndian
from pynetdicom import AE, evt
from pynetdicom.sop_class import (
    Comprehensive3DSRStorage,
    GrayscaleSoftcopyPresentationStateStorage,
    MRImageStorage,
)

from room_config.load import Config
from service.dicom_out.outbox_process import serve

SOP_CLASSES = (
    MRImageStorage,
    Comprehensive3DSRStorage,
    GrayscaleSoftcopyPresentationStateStorage,
)
ARCHIVE = "ARCHIVE"


def needs_program(name: str) -> pytest.MarkDecorator:
    return pytest.mark.skipif(shutil.which(name) is None, reason=f"{name} is not installed")


class Receiver:
    """What a pynetdicom receiver was sent, in order: encoded data sets by SOP Instance UID."""

    def __init__(self) -> None:
        self.received: list[tuple[str, bytes]] = []
        self.answer: Callable[[int], int | Dataset] = lambda number: 0x0000
        self.port = 0
        self.breaks_on: str | None = None

    def store(self, event: Any) -> int | Dataset:
        number = len(self.received)
        encoded = event.encoded_dataset(include_meta=False)
        self.received.append((str(event.request.AffectedSOPInstanceUID), encoded))
        if self.uids[number] == self.breaks_on:
            event.assoc.dul.socket.close()  # as a receiver that crashes over it
        return self.answer(number)

    def again(self, number: int) -> bool:
        """Whether this one had been sent before."""
        return self.uids[number] in self.uids[:number]

    @property
    def uids(self) -> list[str]:
        return [uid for uid, _ in self.received]


@contextmanager
def receiving(
    port: int = 0,
    sop_classes: tuple[Any, ...] = SOP_CLASSES,
    tls: Any = None,
    implicit_only: bool = False,
    require_called_aet: bool = False,
) -> Iterator[Receiver]:
    """A pynetdicom receiver on loopback."""
    receiver = Receiver()
    entity = AE(ARCHIVE)
    entity.require_called_aet = require_called_aet
    explicit = [] if implicit_only else [ExplicitVRLittleEndian]
    for sop_class in sop_classes:
        entity.add_supported_context(sop_class, [*explicit, ImplicitVRLittleEndian])
    handlers: list[Any] = [(evt.EVT_C_STORE, receiver.store)]
    server = entity.start_server(
        ("127.0.0.1", port), block=False, evt_handlers=handlers, ssl_context=tls
    )
    receiver.port = server.server_address[1]
    try:
        yield receiver
    finally:
        server.shutdown()


@contextmanager
def storescp(folder: Path, *options: str) -> Iterator[int]:
    """DCMTK's receiver; what it is sent lies in `folder`. Yields its port."""
    folder.mkdir(exist_ok=True)
    port = free_port()
    words = ["storescp", "-aet", ARCHIVE, "-od", str(folder), *options, str(port)]
    process = subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        wait_until(lambda: _answers(port))
        yield port
    finally:
        process.terminate()
        process.wait()


def _answers(port: int) -> bool:
    with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", port), 1.0):
        return True
    return False


def free_port() -> int:
    with socket.socket() as sock:
        sock.bind(("127.0.0.1", 0))
        return int(sock.getsockname()[1])


def wait_until(condition: Callable[[], object], timeout_s: float = 150.0) -> None:
    deadline_s = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < deadline_s, f"not so within {timeout_s:.0f} s"
        time.sleep(0.02)


def room(case_dir: Path, *destinations: dict[str, Any], **outputs: Any) -> Config:
    """The configuration of a room that sends to these destinations, and soon tries again."""
    sent_to = [{"host": "127.0.0.1", "ae_title": ARCHIVE, **one} for one in destinations]
    waits = {"retry_s": 0.1, "longest_retry_s": 0.3, "alarm_after_s": 0.0}
    return Config.model_validate(
        {
            "room": {"name": "test room", "case_dir": str(case_dir)},
            "service": {"bridge_link": "/dev/null"},
            "outputs": {**waits, **outputs, "destination": sent_to},
        }
    )


class OutboxProcess:
    """As the service starts it."""

    def __init__(self, config: Config, log: Path) -> None:
        with log.open("ab") as errors:
            self.process = subprocess.Popen(
                [sys.executable, "-m", "service.dicom_out.outbox_process"],
                stdin=subprocess.PIPE,
                stderr=errors,
                env={**os.environ, "OMP_NUM_THREADS": "1"},
            )
        assert self.process.stdin is not None
        self.process.stdin.write(config.model_dump_json().encode() + b"\n")
        self.process.stdin.flush()

    def kill(self) -> None:
        """As `kill -9` does."""
        self.process.kill()
        self.end()

    def end(self) -> int:
        """As the end of the service does."""
        assert self.process.stdin is not None
        with contextlib.suppress(OSError):
            self.process.stdin.close()
        return self.process.wait()


@contextmanager
def running_outbox(config: Config) -> Iterator[None]:
    """The outbox's own main loop in a thread; a process takes seconds to load its libraries."""
    stop = threading.Event()
    failures: list[BaseException] = []

    def run() -> None:
        try:
            serve(config, stop)
        except BaseException as error:
            failures.append(error)

    thread = threading.Thread(target=run, name="outbox")
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join(60.0)
    assert not failures
    assert not thread.is_alive()


@contextmanager
def held_back(receiver: Receiver) -> Iterator[threading.Event]:
    """The receiver's answer to its first object waits until the event is set."""
    go = threading.Event()

    def answer(number: int) -> int:
        if number == 0:
            go.wait(120.0)
        return 0x0000

    receiver.answer = answer
    try:
        yield go
    finally:
        go.set()
