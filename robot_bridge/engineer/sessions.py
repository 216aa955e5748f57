"""How the engineer's commands get at the motors: by the line, by a bridge inside, or by hand.

Whoever is not the daemon takes the daemon's place: `bridge_inside` and `bench` hold the journal,
whose lock keeps a daemon and them apart, and both run under a guardian.
"""

import contextlib
import socket
import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from robot_bridge.__main__ import make_guardian, make_motors
from robot_bridge.client.client import BridgeClient
from robot_bridge.daemon.config import BridgeConfig
from robot_bridge.daemon.journal import Journal
from robot_bridge.daemon.main import Daemon
from robot_bridge.daemon.motors import MotorError
from robot_bridge.pmd.driver import PmdMotors
from robot_bridge.protocol.transport import DescriptorTransport

NAME = "engineer"


def client_on_the_line(config: BridgeConfig, url: str) -> BridgeClient:
    """For a running bridge; not open yet."""
    return BridgeClient(
        url,
        name=NAME,
        baud=config.link_baud,
        heartbeat_s=config.heartbeat_s,
        deadman_s=config.deadman_s,
    )


@contextlib.contextmanager
def bridge_inside(config: BridgeConfig) -> Iterator[BridgeClient]:
    """The same bridge as the daemon's, in a thread, and a client for it; not open yet."""
    with bench(config) as (motors, journal):
        near, far = socket.socketpair()
        daemon = Daemon(
            replace(config, guardian=False),  # the bench has one
            motors,
            journal,
            open_transport=lambda: DescriptorTransport(far),
        )
        thread = threading.Thread(target=daemon.run, name="bridge")
        thread.start()
        try:
            yield BridgeClient(
                "the bridge inside",
                name=NAME,
                heartbeat_s=config.heartbeat_s,
                deadman_s=config.deadman_s,
                open_transport=lambda: DescriptorTransport(near),
            )
        finally:
            daemon.leave("the engineer's command is done")
            thread.join()
            near.close()


@contextlib.contextmanager
def bench(
    config: BridgeConfig, capture_file: Path | None = None
) -> Iterator[tuple[PmdMotors, Journal]]:
    """Open motors and the journal, under a guardian; everything stands at the end.

    Raises JournalError (also if a bridge is running) and MotorError.
    """
    guardian = make_guardian(config) if config.guardian else None
    try:
        journal = Journal(config.state_dir)
        try:
            motors = make_motors(replace(config, capture_file=capture_file or config.capture_file))
            try:
                motors.know_boards(journal.boards)
                motors.open()
                yield motors, journal
            finally:
                with contextlib.suppress(MotorError):
                    motors.stop()
                motors.close()
        finally:
            journal.close()
    finally:
        if guardian is not None:
            guardian.dismiss()
