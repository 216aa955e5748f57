"""Serves the room's scene over OpenIGTLink: any number of receivers, nothing is taken from them.

Runs in the service's event loop. While nobody is connected nothing is done. Receivers get the
whole scene when they connect and then what has changed; one that is slow misses what was replaced
in the meantime, one that takes nothing for seconds is let go. There is no login in the protocol:
who may connect is told by address.
"""

from __future__ import annotations

import asyncio
import contextlib
import ipaddress
import socket
from pathlib import Path

import structlog

from case_record.record import CaseRecord
from room_config.load import ConfigError
from room_config.networks import address_of
from room_config.openigtlink import OpenIgtLinkConfig
from room_config.service import GuideConfig
from service.room.control import STALE_S, ControlLoop
from service.room.state import RoomState
from service.slicer.messages import Message
from service.slicer.scene import Images, Scene, scene_of, stale_scene

_LOOK_S = 0.05
_STATUS_EVERY_S = 1.0
_PATIENCE_S = 5.0
_READ_BYTES = 65536

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
        self,
        config: OpenIgtLinkConfig,
        case_dir: Path,
        loop: ControlLoop,
        listening: socket.socket,
        guide: GuideConfig | None = None,
    ) -> None:
        """guide: of a room with two fiducials."""
        self._listening = listening
        self._config = config
        self._case_dir = case_dir
        self._loop = loop
        self._networks = [ipaddress.ip_network(text) for text in config.peer_networks]
        self._guide = guide
        self._images = Images()
        self._scene: Scene = {}
        self._changed = asyncio.Condition()
        self._server: asyncio.Server | None = None
        self._watching: asyncio.Task[None] | None = None
        self.receivers = 0

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

    # What there is to send

    async def _watch(self) -> None:
        revision, told_s = -1, 0.0
        now_s = asyncio.get_running_loop().time
        while True:
            await asyncio.sleep(_LOOK_S)
            state = self._loop.state
            due = now_s() - told_s >= _STATUS_EVERY_S  # that the room lives
            if not self.receivers or not (due or state.revision != revision):
                continue
            revision, told_s = state.revision, now_s()
            # what the room no longer says is not sent as what it does now
            is_stale = self._loop.state_age_s > STALE_S
            scene = stale_scene(state) if is_stale else scene_of(state, self._guide)
            try:
                scene |= await asyncio.to_thread(self._images_of, state)
            except Exception as error:
                log.warning("scene without images", reason=str(error))
            async with self._changed:
                self._scene = scene
                self._changed.notify_all()

    def _images_of(self, state: RoomState) -> Scene:
        if not state.case_uid:
            return self._images.of(state, None)
        with CaseRecord(self._case_dir) as record:
            return self._images.of(state, record)

    # One receiver

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        peer = str(writer.get_extra_info("peername")[0])
        reason = self._why_not(peer)
        if reason:
            log.warning("receiver refused", peer=peer, reason=reason)
            writer.close()
            return
        self.receivers += 1
        log.info("receiver connected", peer=peer)
        sending = asyncio.create_task(self._send(writer))
        gone = asyncio.create_task(_read_to_end(reader))
        try:
            await asyncio.wait({sending, gone}, return_when=asyncio.FIRST_COMPLETED)
        finally:
            for task in (sending, gone):
                task.cancel()
            await asyncio.gather(sending, gone, return_exceptions=True)
            self.receivers -= 1
            log.info("receiver gone", peer=peer)
            writer.transport.abort()

    def _why_not(self, peer: str) -> str:
        if self._networks and not any(address_of(peer) in network for network in self._networks):
            return "its address is not in openigtlink.peer_networks"
        if self.receivers >= self._config.max_receivers:
            return f"{self.receivers} are connected already"
        return ""

    async def _send(self, writer: asyncio.StreamWriter) -> None:
        sent: Scene = {}
        while True:
            async with self._changed:
                await self._changed.wait()
                scene = self._scene
            for device, message in scene.items():
                if _is_news(message, sent.get(device)):
                    writer.write(message.encoded(_version_for(message)))
                    await asyncio.wait_for(writer.drain(), _PATIENCE_S)
            sent = scene


def _is_news(message: Message, sent: Message | None) -> bool:
    """Whether a receiver lacks it; that time went on is news for STATUS and images only."""
    if message.kind in ("STATUS", "IMAGE"):
        return message.kind == "STATUS" or message != sent
    if sent is None:
        return message.kind == "POINT" or not message.withdraws
    return (message.content, message.meta) != (sent.content, sent.meta)


def _version_for(message: Message) -> int:
    """All read version 1; that something ended can be said in version 2 only."""
    return 2 if message.withdraws else 1


async def _read_to_end(reader: asyncio.StreamReader) -> None:
    """Until the receiver hangs up; whatever it says is not heeded."""
    while await reader.read(_READ_BYTES):
        pass
