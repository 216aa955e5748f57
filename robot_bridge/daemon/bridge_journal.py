"""The bridge's use of its journal: entries are dated, and a full disk keeps no stop from happening.

Entries that permit something raise JournalError when they cannot be written; those that tell of
what has happened anyway (a stop, a note) are counted as missing instead.
"""

from collections import Counter
from collections.abc import Callable, Collection, Mapping
from dataclasses import replace

from robot_bridge.daemon.journal import CommandRecord, Journal, JournalError, LatchedStop
from robot_bridge.daemon.whereabouts import Stand
from robot_bridge.protocol.messages import Code, CommandState


class BridgeJournal:
    def __init__(
        self, journal: Journal, wall_clock: Callable[[], float], refused: Counter[str]
    ) -> None:
        """`refused` counts, under Code.JOURNAL, the entries that could not be written."""
        self._journal = journal
        self._wall_clock = wall_clock
        self._refused = refused

    # What it knows

    @property
    def insertion_locked(self) -> bool:
        return self._journal.insertion_locked

    def known(self, command_id: str) -> CommandRecord | None:
        return self._journal.commands.get(command_id)

    def measurement_used(self, measurement_id: str | None) -> bool:
        return measurement_id in self._journal.measurements_used

    # What must be written before it holds

    def begin(self, record: CommandRecord, stands: Mapping[str, Stand]) -> None:
        self._journal.begin(record, self._wall_clock(), stands)

    def end(
        self,
        record: CommandRecord,
        stands: Mapping[str, Stand] | None = None,
        certain: Collection[str] = (),
    ) -> None:
        self._journal.end(record, self._wall_clock(), stands, certain)

    def keep_stands(self, stands: Mapping[str, Stand], certain: Collection[str]) -> None:
        self._journal.keep_stands(stands, self._wall_clock(), certain)

    def tie_boards(self, boards: Mapping[str, str]) -> None:
        """Boards that were not known yet; those that were stay what they were."""
        new = {axis: b for axis, b in boards.items() if b and axis not in self._journal.boards}
        if new:
            self._journal.tie_boards(new, self._wall_clock())

    def refuse(self, record: CommandRecord) -> None:
        self._journal.refuse(record, self._wall_clock())

    def rearm(self, by: str) -> None:
        self._journal.rearm(by, self._wall_clock())

    def lock(self, locked: bool, by: str) -> None:
        self._journal.lock(locked, by, self._wall_clock())

    # What holds all the same

    def latch_stop(self, stop: LatchedStop, text: str) -> None:
        try:
            self._journal.latch_stop(stop, text, self._wall_clock())
        except JournalError:
            self._refused[Code.JOURNAL.value] += 1  # it is latched all the same, until a restart

    def keep_lost(self, stands: Mapping[str, Stand], certain: Collection[str]) -> None:
        try:
            self.keep_stands(stands, certain)
        except JournalError:
            self._refused[Code.JOURNAL.value] += 1

    def note(self, what: str, **details: object) -> None:
        # A note that cannot be written must not keep a stop from happening.
        try:
            self._journal.note(what, self._wall_clock(), **details)
        except JournalError:
            self._refused[Code.JOURNAL.value] += 1

    def hold_unwritten(self, record: CommandRecord) -> None:
        """How a command ended whose end could not be written: known until a restart."""
        self._journal.commands[record.command_id] = record

    # After a restart

    def close_old_commands(self) -> None:
        """What the last run left unfinished will never be done: say so, for ever."""
        for record in self._journal.unfinished():
            text = "the bridge restarted before the command ended; the position is uncertain"
            ended = replace(
                record, state=CommandState.FAILED, code=Code.BRIDGE_RESTARTED.value, text=text
            )
            self.end(ended)
