"""By whose order a procedure moves: given as the robot stood, and good only while it stands so.

After a stop, a lost link or a restart nothing that was asked for before moves anything again: not
by re-arming, only by a new order ("go on"). Whatever was re-armed since had been interrupted,
whether anybody was looking at the robot while it was or not.
"""

from __future__ import annotations

from typing import Any

from case_record.record import CaseRecord
from robot_bridge.client.client import BridgeStatus

ARMED = "armed"
GO_ON = "go_on"
WENT_ON = "went_on"


class Permitted:
    """The bridge as it stood when somebody ordered the procedure that runs, or to go on with it."""

    def __init__(self, record: CaseRecord) -> None:
        self._record = record
        self._given: dict[str, Any] | None = None
        self._given_by = 0  # the event by which it was given
        self._interrupted = False

    def facts(self, status: BridgeStatus) -> dict[str, Any]:
        """What an order is given on: which run of the bridge, and after which of its stops."""
        return {"boot_id": status.boot_id, "stop_count": status.stop_count}

    def recall(self) -> None:
        """Know the order again by which the running procedure moves, after a restart as well."""
        if self._given is not None:
            return
        running = self._record.running_procedure()
        if running is None:
            return
        begun = self._record.last_event(f"{running.name}_started")
        went_on = self._record.last_event(WENT_ON)
        given = went_on if went_on is not None and went_on.seq > running.begun_seq else begun
        body = {} if given is None else given.body
        self._given = {name: body.get(name) for name in ("boot_id", "stop_count")}
        self._given_by = 0 if given is None else given.event_id

    def give(self, command_id: str, status: BridgeStatus, who: str, source: str) -> None:
        """Somebody says to go on, as the robot stands now."""
        self._given = self.facts(status)
        body = {"command_id": command_id, **self._given}
        self._given_by = self._record.append_event(WENT_ON, body, source=source, who=who)
        self._interrupted = False

    def confirm(self, status: BridgeStatus) -> None:
        """Somebody confirms the move that was asked about, as the robot stands now."""
        self._given, self._given_by = self.facts(status), self._record.last_event_id()
        self._interrupted = False

    def interrupt(self) -> None:
        """The robot was stopped, disarmed or out of reach."""
        self._interrupted = True

    def covers(self, status: BridgeStatus) -> bool:
        """Whether that order still stands."""
        armed = self._record.last_event(ARMED)
        armed_since = armed is not None and armed.event_id > self._given_by
        return not (self._interrupted or armed_since) and self._given == self.facts(status)

    def forget(self) -> None:
        self._given = None
        self._interrupted = False
