"""One serial line with controllers on it: one transaction at a time, never blocking for long.

A *procedure* is a generator: it yields a Command (and receives the Reply, or has a PmdError thrown
in) or a Pause (and receives None). Several procedures share the line in turns, one transaction
each, so that several axes move at once while `step` returns within its budget.
"""

import time
from collections import deque
from collections.abc import Callable, Generator
from dataclasses import dataclass, replace
from typing import Protocol

from robot_bridge.pmd.protocol import (
    Command,
    LineReader,
    PmdError,
    PmdNoValueError,
    PmdTimeoutError,
    Reply,
    match_reply,
)

TRIES = 3


class Port(Protocol):
    """The part of pyserial's port that is used here; `read` waits at most a few milliseconds."""

    def read(self, size: int = 1, /) -> bytes: ...

    def write(self, data: bytes, /) -> int | None: ...

    def reset_input_buffer(self) -> None: ...

    def close(self) -> None: ...


@dataclass(frozen=True)
class Pause:
    """Do nothing for this procedure for a while; others go on."""

    seconds: float


Procedure = Generator[Command | Pause, Reply | None, None]


class Task:
    """A procedure under way. `error` is set when it ended by an error that it did not handle."""

    def __init__(self, procedure: Procedure, name: str) -> None:
        self.procedure, self.name = procedure, name
        self.done = False
        self.error: PmdError | None = None
        self.ready_s = 0.0
        self.wish: Command | None = None  # to be sent next

    def resume(self, reply: Reply | None, now_s: float) -> None:
        self._advance(lambda: self.procedure.send(reply), now_s)

    def fail(self, error: PmdError, now_s: float) -> None:
        self._advance(lambda: self.procedure.throw(error), now_s)

    def _advance(self, go: Callable[[], Command | Pause], now_s: float) -> None:
        self.wish = None
        try:
            wanted = go()
        except StopIteration:
            self.done = True
        except PmdError as error:
            self.done, self.error = True, error
        else:
            if isinstance(wanted, Command):
                self.wish = wanted
            else:
                self.ready_s = now_s + wanted.seconds

    def cancel(self) -> None:
        self.procedure.close()
        self.done, self.wish = True, None


@dataclass
class _Transaction:
    task: Task
    command: Command
    deadline_s: float
    tries_left: int
    echo_due: bool  # a copy of our own bytes comes first
    retried: bool
    copied: bool = False  # a bare copy of the command has come
    heard: bool = False  # something has come, but no answer to this
    misses: int = 0  # earlier tries in which the same happened


class PmdLine:
    """Owns the port. `own_echo` becomes true when the adapter is seen to loop our bytes back."""

    def __init__(
        self, port: Port, timeout_s: float, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._port, self.timeout_s, self._clock = port, timeout_s, clock
        self._reader = LineReader()
        self._tasks: deque[Task] = deque()
        self._current: _Transaction | None = None
        self.own_echo = False
        self.transactions = self.retries = self.chatter_lines = 0

    @property
    def bad_lines(self) -> int:
        return self._reader.bad_lines

    def start(self, procedure: Procedure, name: str) -> Task:
        task = Task(procedure, name)
        task.resume(None, self._clock())
        if not task.done:
            self._tasks.append(task)
        return task

    def cancel_all(self) -> None:
        for task in self._tasks:
            task.cancel()
        self._tasks.clear()
        self._current = None

    @property
    def idle(self) -> bool:
        return not self._tasks

    def write_now(self, data: bytes) -> None:
        """Bytes ahead of everything (stop); what was under way is given up first."""
        self.cancel_all()
        self._port.write(data)

    def run(self, procedure: Procedure, name: str, deadline_s: float) -> None:
        """Run to the end, blocking. Raises the procedure's PmdError, or PmdTimeoutError."""
        task = self.start(procedure, name)
        while not task.done:
            if self._clock() >= deadline_s:
                self.cancel_all()
                raise PmdTimeoutError(f"{name} did not end in time")
            self.step(0.02)
        if task.error is not None:
            raise task.error

    def step(self, budget_s: float) -> None:
        """Work on the tasks for at most about `budget_s`; returns at once if none can go on.

        Raises OSError (pyserial's SerialException is one) if the port itself fails.
        """
        until_s = self._clock() + budget_s
        while True:
            if self._current is None and not self._begin_next():
                return
            self._listen()
            if self._clock() >= until_s:
                return

    def _begin_next(self) -> bool:
        now_s = self._clock()
        for _ in range(len(self._tasks)):
            task = self._tasks[0]
            self._tasks.rotate(-1)
            if task.wish is None and now_s >= task.ready_s:
                self._resume(task, None)
            if task.wish is not None:
                self._send(task, task.wish, TRIES if task.wish.repeatable else 1)
                return True
        return False

    def _resume(self, task: Task, reply: Reply | None) -> None:
        task.resume(reply, self._clock())
        self._drop_if_done(task)

    def _drop_if_done(self, task: Task) -> None:
        if task.done and task in self._tasks:
            self._tasks.remove(task)

    def _send(self, task: Task, command: Command, tries: int, misses: int = 0) -> None:
        self._port.reset_input_buffer()
        self._reader.clear()
        deadline_s = self._clock() + self.timeout_s
        retried = tries < TRIES and command.repeatable
        self._current = _Transaction(
            task, command, deadline_s, tries - 1, self.own_echo, retried, misses=misses
        )
        self.transactions += 1
        self._port.write(command.line)

    def _listen(self) -> None:
        for line in self._reader.feed(self._port.read(256)):
            if self._current is not None:
                self._take_line(self._current, line)
        if self._current is not None and self._clock() >= self._current.deadline_s:
            self._timed_out(self._current)

    def _take_line(self, current: _Transaction, line: str) -> None:
        if line == current.command.text and (current.echo_due or current.command.reads):
            # A bare copy of a question: the adapter's echo, if an answer follows.
            current.echo_due = False
            current.copied = current.heard = True
            return
        try:
            reply = match_reply(current.command, line)
        except PmdError as error:
            self._current = None
            current.task.fail(error, self._clock())
            self._drop_if_done(current.task)
            return
        if reply is None:
            self.chatter_lines += 1
            current.heard = True
            return
        self._current = None
        self.own_echo = self.own_echo or (current.copied and current.command.reads)
        self._resume(current.task, replace(reply, retried=current.retried))

    def _timed_out(self, current: _Transaction) -> None:
        self._current = None
        # An adapter that echoes is heard whether or not the board says anything.
        misses = current.misses + (current.heard and not self.own_echo)
        if current.tries_left > 0:
            self.retries += 1
            self._send(current.task, current.command, current.tries_left, misses)
            return
        said = f"; {self._reader.pending!r} came" if self._reader.pending else ""
        unknown = current.command.repeatable and misses == TRIES
        error = (PmdNoValueError if unknown else PmdTimeoutError)(
            f"controller {current.command.address} did not answer '{current.command.text}' "
            f"within {self.timeout_s * 1000:.0f} ms{said}"
        )
        current.task.fail(error, self._clock())
        self._drop_if_done(current.task)
