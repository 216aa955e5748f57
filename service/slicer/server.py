"""Serves the room's scene over OpenIGTLink, and hears what peers say.

Runs in the service's event loop. While nobody is connected nothing is done. Peers get the whole
scene when they connect and then what has changed; one that is slow misses what was replaced in the
meantime, one that takes nothing for seconds is let go. There is no login in the protocol: who may
connect is told by address, and what a peer may ask for stands in `answers`.
"""

from __future__ import annotations

import asyncio
import contextlib
import ipaddress
import socket
from collections import Counter
from collections.abc import Callable
from typing import Any, TypeVar

import structlog

from case_record.cases import Cases
from case_record.record import CaseRecord
from room_config.load import Config, ConfigError
from room_config.networks import address_of
from room_config.openigtlink import OpenIgtLinkConfig
from service.room.commands.allowance import Allowances
from service.room.control import STALE_S, ControlLoop
from service.room.state import RoomState
from service.slicer.peer import Peer
from service.slicer.pose import CURRENT_POSITION, Pose, pose_message, pose_of
from service.slicer.scene import Images, Scene, scene_of, stale

Found = TypeVar("Found")
_LOOK_S = 0.05
_STATUS_EVERY_S = 1.0
_TRIES = 3

log = structlog.get_logger("openigtlink")


def bind_openigtlink(config: OpenIgtLinkConfig) -> socket.socket | None:
    """The listening socket, or None where it is off; ConfigError if that cannot be."""
    if config.port is None:
        return None
    family = socket.AF_INET6 if ":" in config.host else socket.AF_INET
    listening = socket.socket(family)
    listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listening.bind((config.host, config.port))
        listening.listen()
    except OSError as error:
        listening.close()
        where = f"openigtlink port {config.host}:{config.port}"
        raise ConfigError(f"{where}: {error.strerror}") from None
    return listening


class OpenIgtLinkServer:
    """`start` it in the server's event loop, `close` it at the end."""

    def __init__(
        self, config: Config, cases: Cases, loop: ControlLoop, listening: socket.socket
    ) -> None:
        self._listening = listening
        self._config = config
        self._cases = cases
        self._loop = loop
        self._own = config.openigtlink
        self.inwards = self._own.inwards
        self.allowances = Allowances()
        self._networks = [ipaddress.ip_network(text) for text in self._own.peer_networks]
        self._images = Images()
        self._peers: set[Peer] = set()
        self._passed_over: Counter[str] = Counter()
        self.scene: Scene = {}
        self._server: asyncio.Server | None = None
        self._watching: asyncio.Task[None] | None = None

    async def start(self) -> None:
        self._server = await asyncio.start_server(self._serve, sock=self._listening)
        self._watching = asyncio.create_task(self._watch())

    async def close(self) -> None:
        if self._server is None or self._watching is None:
            return
        self._server.close()
        self._watching.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await self._watching

    @property
    def receivers(self) -> int:
        return len(self._peers)

    @property
    def passed_over(self) -> Counter[str]:
        """Messages of all peers since the start that were not heeded, by reason."""
        return sum((peer.passed_over for peer in self._peers), self._passed_over)

    # The room, as peers see it

    @property
    def state(self) -> RoomState:
        """Of now: what the room no longer says is not what it does."""
        state = self._loop.state
        return stale(state) if self._loop.state_age_s > STALE_S else state

    def stop(self, by: str, *, emergency: bool) -> int:
        return self._loop.stop(by, emergency=emergency)

    def stop_outcome(self) -> str:
        return self._loop.stop_outcome()

    def stop_answered(self, number: int) -> None:
        self._loop.stop_answered(number)

    def call(self, name: str, arguments: dict[str, Any]) -> Any:
        return self._loop.call(name, arguments)

    def pose(self) -> Pose | None:
        """Reads the record: not for the event loop's thread."""
        return self._from_record(self._pose, None)

    async def _watch(self) -> None:
        revision, told_s = -1, 0.0
        now_s = asyncio.get_running_loop().time
        while True:
            await asyncio.sleep(_LOOK_S)
            state = self.state
            due = now_s() - told_s >= _STATUS_EVERY_S  # that the room lives
            if not self._peers or not (due or state.revision != revision):
                continue
            told_s = now_s()
            images = await asyncio.to_thread(self._from_record, self._images.of, {})
            images = images or self._images.of(self.state, None)
            state, pose = await self._state_and_pose()
            revision = state.revision
            place = {CURRENT_POSITION: pose_message(pose, state.at_s)}
            self.scene = scene_of(state, self._config.service.guide) | place | images
            for peer in list(self._peers):
                peer.look(state)

    async def _state_and_pose(self) -> tuple[RoomState, Pose | None]:
        """Of one moment: a pose that was worked out while the room changed is not that of now.

        What holds now is shown with it; where the room does not rest, no pose is known.
        """
        for _ in range(_TRIES):
            before = self.state
            pose = await asyncio.to_thread(self.pose)
            now = self.state
            if (now.revision, now.robot.linked) == (before.revision, before.robot.linked):
                return now, pose
        return self.state, None

    def _pose(self, state: RoomState, record: CaseRecord | None) -> Pose | None:
        return pose_of(state, record, self._config, self._loop.now)

    def _from_record(
        self, look: Callable[[RoomState, CaseRecord | None], Found], otherwise: Found
    ) -> Found:
        state = self.state
        try:
            if not state.case_uid:
                return look(state, None)
            with CaseRecord(self._cases.required()) as record:
                case = record.case()
                is_same = case is not None and case.case_uid == state.case_uid
                return look(state, record if is_same else None)
        except Exception as error:
            log.warning("scene without images and pose", reason=str(error))
            return otherwise

    # One peer

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        host, port = writer.get_extra_info("peername")[:2]
        name = f"{host}:{port}"
        reason = self._why_not(str(host))
        if reason:
            log.warning("peer refused", peer=name, reason=reason)
            writer.close()
            return
        peer = Peer(name, self, reader, writer)
        self._peers.add(peer)
        log.info("peer connected", peer=name)
        try:
            await peer.run()
        finally:
            self._peers.discard(peer)
            self._passed_over += peer.passed_over
            log.info("peer gone", peer=name)
            peer.hang_up()

    def _why_not(self, host: str) -> str:
        if self._networks and not any(address_of(host) in network for network in self._networks):
            return "its address is not in openigtlink.peer_networks"
        if self.receivers >= self._own.max_receivers:
            return f"{self.receivers} are already connected"
        return ""
