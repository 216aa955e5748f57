"""One connected peer: what it says is heeded and answered, what changes in the scene is sent to it.

STOP is heeded where it is read. Everything else waits in a short queue and is worked off at a
measured pace, so that a flood of messages costs the room neither time nor record.
"""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections import Counter, deque
from typing import Any, Protocol

import structlog

from service.room.commands.allowance import Allowances
from service.room.proposals import OPENIGTLINK, Plan, Verdict
from service.room.refusal import ConflictError
from service.room.state import RoomState
from service.slicer.answers import (
    Answer,
    acknowledge,
    answer,
    concerns_us,
    decision_of,
    not_looked_at,
    registered,
    verdict_of,
)
from service.slicer.messages import STATUS_NOT_READY, Message, status
from service.slicer.pose import Pose
from service.slicer.reading import Received, Stream, stop_word
from service.slicer.scene import Scene, status_of

_PATIENCE_S = 5.0
_READ_BYTES = 16384
_HALF_A_MESSAGE_S = 2.0
_MOST_WAITING = 64
_MOST_REPLIES = 256
_BETWEEN_ANSWERS_S = 0.01
_FLOOD_TOLD_S = 1.0
_STOP_AGAIN_S = 0.1
_STOPPED_WITHIN_S = 0.7
_NOT_STOPPED = {
    "on_its_way": ("on its way", "STOP is on its way: the robot has not stopped yet"),
    "not_delivered": ("not delivered", "NOT DELIVERED: use the stop switch at the robot"),
}
_LOOK_S = 0.02

log = structlog.get_logger("openigtlink")


class Room(Protocol):
    """What peers may see and ask of the room."""

    inwards: bool
    allowances: Allowances

    @property
    def state(self) -> RoomState: ...

    @property
    def scene(self) -> Scene: ...

    def pose(self) -> Pose | None: ...

    def stop(self, by: str, *, emergency: bool) -> int: ...

    def stop_outcome(self) -> str: ...

    def stop_answered(self, number: int) -> None: ...

    def call(self, name: str, arguments: dict[str, Any]) -> Any: ...


class Peer:
    """`run` it until it hangs up or takes nothing any more."""

    def __init__(
        self, name: str, room: Room, reader: asyncio.StreamReader, writer: asyncio.StreamWriter
    ) -> None:
        """name: who it is for the record, address and port."""
        self._host = name.rpartition(":")[0]
        self.name = name
        self._room = room
        self._reader, self._writer = reader, writer
        self._stream = Stream()
        self._version: int | None = None
        self._waiting: asyncio.Queue[Received] = asyncio.Queue(_MOST_WAITING)
        self._replies: deque[Message] = deque(maxlen=_MOST_REPLIES)
        self._wake = asyncio.Event()
        self._sent: Scene = {}
        self._mine: dict[tuple[str, int], bool] = {}  # whether the room has shown its case
        self._stopped_at_s = self._flood_told_s = -1e9
        self._telling: set[asyncio.Task[None]] = set()
        self._dropped: Counter[str] = Counter()
        self._logged = 0

    @property
    def passed_over(self) -> Counter[str]:
        """What it said and was not heeded, by reason."""
        return self._stream.faults + self._dropped

    async def run(self) -> None:
        tasks = [asyncio.create_task(work()) for work in (self._send, self._read, self._work)]
        try:
            await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        finally:
            everything = [*tasks, *self._telling]
            for task in everything:
                task.cancel()
            ended = await asyncio.gather(*everything, return_exceptions=True)
            for reason in ended:
                if isinstance(reason, Exception) and not isinstance(reason, OSError):
                    log.error("peer disconnected", peer=self.name, exc_info=reason)

    def look(self, state: RoomState) -> None:
        """There is a new scene; say what became of this peer's proposals. Their numbers begin anew
        in each case.
        """
        for one in state.proposals:
            mine = (state.case_uid, one.number)
            if mine in self._mine and one.state != "open":
                del self._mine[mine]
                if one.state != "joined":  # the answer to the other half has said so
                    self._decided(one.number, one.state, one.by, one.reason)
        for (case_uid, number), was_shown in list(self._mine.items()):
            if case_uid == state.case_uid:
                self._mine[case_uid, number] = True
            elif was_shown:
                del self._mine[case_uid, number]
                self._decided(number, "withdrawn", "", "its case has ended")
        self._wake.set()

    def _decided(self, number: int, state_word: str, by: str, reason: str) -> None:
        self._replies.append(decision_of(number, state_word, by, reason, time.time()))

    # What it says

    async def _read(self) -> None:
        front, since_s = -1, 0.0
        while True:
            patience_s = _HALF_A_MESSAGE_S if self._stream.is_waiting else None
            try:
                data = await asyncio.wait_for(self._reader.read(_READ_BYTES), patience_s)
            except TimeoutError:
                messages = self._stream.give_up()
            else:
                if not data:
                    return
                messages = self._stream.feed(data)
            now_s = time.monotonic()
            if self._stream.front != front:
                front, since_s = self._stream.front, now_s
            elif self._stream.is_waiting and now_s - since_s > _HALF_A_MESSAGE_S:
                messages += self._stream.resume()
                since_s = now_s
            for message in messages:
                self._note_version(message.version)
                word = stop_word(message)
                if word:
                    self._stop(message, word)
            for message in messages:
                if not stop_word(message):
                    self._put(message)
            self._log_faults()
            await asyncio.sleep(_BETWEEN_ANSWERS_S)

    def _note_version(self, version: int) -> None:
        if version != self._version:
            self._version = version
            self._sent = {}  # what could not be said in the other version is said now
            self._wake.set()

    def _put(self, message: Received) -> None:
        """What is not for the robot, a tracker's stream say, keeps nothing waiting."""
        if not concerns_us(message):
            return
        try:
            self._waiting.put_nowait(message)
        except asyncio.QueueFull:
            self._dropped["flood"] += 1
            now_s = time.monotonic()
            if now_s - self._flood_told_s > _FLOOD_TOLD_S:
                self._flood_told_s = now_s
                self._reply(not_looked_at(message, self._room.state.at_s))

    def _log_faults(self) -> None:
        """When the first comes, and whenever their number has doubled."""
        number = self.passed_over.total()
        if number >= max(1, 2 * self._logged):
            self._logged = number
            log.warning("messages ignored", peer=self.name, **self.passed_over)

    def _stop(self, message: Received, word: str) -> None:
        now_s = time.monotonic()
        if now_s - self._stopped_at_s > _STOP_AGAIN_S:
            number = self._room.stop(f"OpenIGTLink {self.name}", emergency=word == "EMERGENCY")
            self._stopped_at_s = now_s
            log.warning("stop", peer=self.name, word=word)
            task = asyncio.create_task(self._tell_stop(word, number))
            self._telling.add(task)
            task.add_done_callback(self._telling.discard)
        self._reply(acknowledge(message, self._room.state))

    async def _tell_stop(self, word: str, number: int) -> None:
        """What became of a STOP, within a second."""
        until_s = time.monotonic() + _STOPPED_WITHIN_S
        try:
            while (outcome := self._room.stop_outcome()) != "stopped":
                if time.monotonic() > until_s:
                    break
                await asyncio.sleep(_LOOK_S)
        finally:
            self._room.stop_answered(number)
        state = self._room.state
        if outcome == "stopped":
            self._reply(status_of(state, word))
            return
        name, text = _NOT_STOPPED[outcome]
        self._reply(status(word, state.at_s, STATUS_NOT_READY, name, text))

    async def _work(self) -> None:
        while True:
            message = await self._waiting.get()
            said = await asyncio.to_thread(self._answer, message)
            self._reply(*said.replies)
            if said.plan is not None:
                await self._propose(said.plan)
            if said.registration is not None:
                arguments = {"name": message.device, "matrix": said.registration}
                verdict = await self._ask("note_registration", arguments)
                self._reply(registered(verdict, self._room.state.at_s))
            await asyncio.sleep(_BETWEEN_ANSWERS_S)

    def _answer(self, message: Received) -> Answer:
        room = self._room
        return answer(message, room.state, room.pose, self.name, room.inwards)

    async def _propose(self, plan: Plan) -> None:
        verdict = await self._ask("propose", {"plan": plan})
        if verdict.number is not None:
            self._mine[verdict.case_uid, verdict.number] = False
        self._reply(*verdict_of(plan, verdict, self._room.state))
        self.look(self._room.state)  # it may have been decided by now

    async def _ask(self, name: str, arguments: dict[str, Any]) -> Verdict:
        """Put it to the room; a room that cannot now says so."""
        if not self._room.allowances.of(self._host, name).take():
            self._dropped["too many"] += 1
            return Verdict("too_many", f"too many from {self._host}: at most one per second")
        arguments = {**arguments, "by": f"{OPENIGTLINK} {self.name}"}
        try:
            said = await asyncio.to_thread(self._room.call, name, arguments)
        except Exception as error:  # a peer must not end the service, whatever the room is at
            log.warning("not recorded", peer=self.name, what=name, reason=str(error))
            code = error.code if isinstance(error, ConflictError) else "not_recorded"
            return Verdict(code, f"not recorded: {error}")
        return said if isinstance(said, Verdict) else Verdict("recorded", "")

    def _reply(self, *messages: Message) -> None:
        self._replies.extend(messages)
        self._wake.set()

    # What it is shown

    async def _send(self) -> None:
        while True:
            await self._wake.wait()
            self._wake.clear()
            while self._replies:
                await self._write(self._replies.popleft())
            for device in list(self._room.scene):
                # the newest of each: the scene may have changed while another was being written
                message, sent = self._room.scene[device], self._sent
                if _is_news(message, sent.get(device), self._version):
                    await self._write(message)
                    sent[device] = message  # forgotten if it turned to the other version meanwhile
                while self._replies:
                    await self._write(self._replies.popleft())

    async def _write(self, message: Message) -> None:
        # all read version 1; that something ended can be said in version 2 only
        version = self._version or (2 if message.withdraws else 1)
        encoded = message.encoded(version)
        if message.kind == "IMAGE":
            encoded = await asyncio.to_thread(message.encoded, version)
        self._writer.write(encoded)
        await asyncio.wait_for(self._writer.drain(), _PATIENCE_S)

    def hang_up(self) -> None:
        with contextlib.suppress(OSError):
            self._writer.transport.abort()


def _is_news(message: Message, sent: Message | None, version: int | None) -> bool:
    """Whether a peer lacks it; that time went on is news for STATUS and images only."""
    if message.kind == "STATUS":
        return True
    if sent is None:
        # before it says which version it reads, a peer is not told of an end of nothing
        return version == 2 or message.kind == "POINT" or not message.withdraws
    if message.kind == "IMAGE":
        return message != sent
    return (message.content, message.meta) != (sent.content, sent.meta)
