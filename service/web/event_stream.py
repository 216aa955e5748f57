"""Server-sent events: the state when it changes, each new event of the record, and often a beat.

One thread watches the control loop and encodes once; the viewers only pass bytes on and have no
timers of their own, so that many of them cost little. `id:` is the record's event id; a client that
comes back with Last-Event-ID gets every event since, and the present state.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import threading
import time
from collections import deque
from collections.abc import AsyncIterator

import structlog

from case_record.cases import Cases
from case_record.record import CaseRecord
from case_record.rows import Event
from room_config.load import Config
from service.room.control import ControlLoop

_WATCH_S = 0.01
_LEAST_BETWEEN_STATES_S = 0.04
_FOR_EACH_VIEWER_S = 0.004
MOST_VIEWERS = 100
_BEAT_S = 0.3
_AGAIN_S = 1.0
_KEPT_EVENTS = 1000
_EVENTS_AT_ONCE = 100


class Broadcast:
    """`start` it in the server's event loop, `close` it at the end; each viewer gets `follow`."""

    def __init__(self, config: Config, loop: ControlLoop) -> None:
        self._cases = Cases(*config.room.folders)
        self._loop = loop
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._watch, name="broadcast", daemon=True)
        self._server: asyncio.AbstractEventLoop | None = None
        self._state_message = b""
        self._beat_message = b""
        self._told_s = 0.0
        self._events: deque[tuple[int, bytes]] = deque(maxlen=_KEPT_EVENTS)
        self._newest_id = 0
        self._folder = self._told_folder = loop.state.case_folder
        self._turn = asyncio.Event()
        self._looking_back = asyncio.Lock()
        self.viewers = 0

    def start(self) -> None:
        self._server = asyncio.get_running_loop()
        self._thread.start()

    def close(self) -> None:
        self._closing.set()
        self._thread.join(timeout=5.0)

    # In the broadcast's own thread

    def _watch(self) -> None:
        while not self._closing.is_set():
            try:
                self._watch_record()
            except Exception as error:  # whatever it is, the screens must go on being told
                structlog.get_logger().exception("event stream", error=str(error))
                with contextlib.suppress(Exception):
                    self._beat_if_due()
                self._closing.wait(_AGAIN_S)

    def _watch_record(self) -> None:
        """Tell what happens in one case, or while none is open."""
        folder = self._loop.state.case_folder
        if folder != self._folder:
            self._folder, self._newest_id = folder, 0
        if folder is None:
            self._watch_states(folder, None)
            return
        with CaseRecord(self._cases.folder_of(folder)) as record:
            if not self._newest_id:
                self._newest_id = max(0, record.last_event_id() - _KEPT_EVENTS)
            self._watch_states(folder, record)

    def _watch_states(self, folder: str | None, record: CaseRecord | None) -> None:
        revision = -1
        while not self._closing.wait(_WATCH_S):
            state = self._loop.state
            if state.case_folder != folder:
                return
            if state.revision == revision:
                self._beat_if_due()
                continue
            revision = state.revision
            events = []
            if record is not None and state.event_id > self._newest_id:
                events = record.events(self._newest_id)
                self._newest_id = events[-1].event_id if events else self._newest_id
            messages = [(event.event_id, _event_message(event)) for event in events]
            self._tell(_state_message(state.model_dump_json()), messages)
            # many viewers cost no more than a few: each is told less often
            self._closing.wait(_LEAST_BETWEEN_STATES_S + self.viewers * _FOR_EACH_VIEWER_S)

    def _beat_if_due(self) -> None:
        """Tells how old the state is: a control loop that hangs is noticed on every screen."""
        if time.monotonic() - self._told_s < _BEAT_S:
            return
        loop = self._loop
        told = {
            "at_s": loop.state.at_s,
            "now_s": time.time(),
            "clock_s": round(time.monotonic(), 3),
            "age_s": round(loop.state_age_s, 3),
        }
        body = json.dumps(told)
        self._tell(None, [], f"event: beat\ndata: {body}\n\n".encode())

    def _tell(
        self, state: bytes | None, messages: list[tuple[int, bytes]], beat: bytes = b""
    ) -> None:
        assert self._server is not None
        self._told_s = time.monotonic()
        with contextlib.suppress(RuntimeError):  # the server's loop has ended
            self._server.call_soon_threadsafe(self._publish, self._folder, state, messages, beat)

    # In the server's event loop

    def _publish(
        self,
        folder: str | None,
        state: bytes | None,
        messages: list[tuple[int, bytes]],
        beat: bytes,
    ) -> None:
        if folder != self._told_folder:  # nothing of one case is told in the next
            self._told_folder = folder
            self._events.clear()
        if state is not None:
            self._state_message = state
        self._beat_message = beat
        self._events.extend(messages)
        turn, self._turn = self._turn, asyncio.Event()
        turn.set()

    async def follow(self, after_id: int) -> AsyncIterator[bytes]:
        """Yield messages for one viewer: what it missed since an event id, and what comes."""
        self.viewers += 1
        try:
            yield b"retry: 500\n\n"
            folder, reached_id = self._told_folder, after_id
            async for text, newest_id in self._missed(after_id):
                reached_id = newest_id
                yield text
            text, reached_id = self._kept_since(reached_id)
            yield text + _state_message(self._loop.state.model_dump_json())
            shown, beaten = self._state_message, self._beat_message
            while True:
                turn = self._turn
                if self._told_folder != folder:  # the numbers of another case begin anew
                    folder, reached_id = self._told_folder, 0
                if self._events and not self._keeps_all_since(reached_id):  # it dawdles
                    async for text, newest_id in self._missed(reached_id):
                        reached_id = newest_id
                        yield text
                text, reached_id = self._kept_since(reached_id)
                if shown is not self._state_message:
                    shown = self._state_message
                    text += shown
                if beaten is not self._beat_message:
                    beaten = self._beat_message
                    text += beaten
                if text:
                    yield text
                # the turn was taken before the text: what comes in between is not waited for
                await turn.wait()
        finally:
            self.viewers -= 1

    def _kept_since(self, after_id: int) -> tuple[bytes, int]:
        """What is kept after an id; nothing where something in between is not: it is `_missed`."""
        if not self._keeps_all_since(after_id) or self._events[-1][0] <= after_id:
            return b"", after_id
        new: list[bytes] = []
        for event_id, message in reversed(self._events):
            if event_id <= after_id:
                break
            new.append(message)
        return b"".join(reversed(new)), self._events[-1][0]

    def _keeps_all_since(self, after_id: int) -> bool:
        return bool(self._events) and after_id + 1 >= self._events[0][0]

    async def _missed(self, after_id: int) -> AsyncIterator[tuple[bytes, int]]:
        """What is not kept any more of the events after an id, and the id that it goes up to.

        One viewer at a time and a little at a time: where many come at once and want all of a long
        case, the control loop must still get at the interpreter.
        """
        while not self._keeps_all_since(after_id):
            async with self._looking_back:
                text, newest_id = await asyncio.to_thread(self._recorded, after_id)
            if newest_id == after_id:
                return
            after_id = newest_id
            yield text, after_id

    def _recorded(self, after_id: int) -> tuple[bytes, int]:
        folder = self._told_folder
        if folder is None or not self._loop.state.case_uid:
            return b"", after_id
        with CaseRecord(self._cases.folder_of(folder)) as record:
            events = record.events(after_id, _EVENTS_AT_ONCE)
        if not events:
            return b"", after_id
        return b"".join(map(_event_message, events)), events[-1].event_id


def _state_message(text: str) -> bytes:
    return f"event: state\ndata: {text}\n\n".encode()


def _event_message(event: Event) -> bytes:
    body = {k: getattr(event, k) for k in ("event_id", "wall_s", "source", "who", "kind", "body")}
    return f"id: {event.event_id}\nevent: record\ndata: {json.dumps(body)}\n\n".encode()
