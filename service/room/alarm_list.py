"""The alarm list: what is wrong now and since when, and what the listener raised lately."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass

from case_record.record import CaseRecord
from service.room.state import AlarmState

_SHOWN_S = 300.0
_MOST_RAISED = 20
_SEE_LOG = "See the log of the process that raised this alarm."
# what to do about what the listener raises, by its code
TO_DO = {
    "association_ended": "Check the cable and the scanner; send again what did not arrive.",
    "association_rejected": "Check AE titles and addresses at the scanner and in the room's file.",
    "clock_drift": "Compare the scanner clock again, then acquire the slices again.",
    "clock_jump": "Compare the scanner clock again, then acquire the slices again.",
    "commitment_unreported": "Check commitment_reports_to in the room's file; the slices are safe.",
    "contexts_refused": "Set the scanner to send uncompressed MR Image Storage.",
    "disk_low": "Free space on the disk that holds the case folder.",
    "foreign_file": "Inspect the file in the inbox and remove it.",
    "intake_failed": "Acquire the slice again; see the listener's log.",
    "late_or_clock_jump": "Compare the scanner clock again, then acquire the slices again.",
    "many_slices_wait": "Send only what is asked for; compare the clocks.",
    "message_ignored": "Nothing is lost; see what the scanner sends besides slices.",
    "not_offered": "Nothing is lost; the scanner asked for a service that is not offered.",
    "oversize": "Check what the scanner is sending: no slice is that large.",
    "plan_refused": "Correct the plan at the workstation and send it again.",
    "plans_too_many": "Check that the proposal shown is the plan that is meant.",
    "push_delay_unlike_measured": "Compare the clocks; if it persists, commission the site again.",
    "same_uid_other_bytes": "Acquire the slice again; check which systems send to this listener.",
    "sends_ahead": "Nothing is lost. Set the scanner to wait for each answer, if it can.",
    "slice_refused": "Send or acquire the slice again.",
    "unfinished_files": "Nothing is lost: the scanner was never told that they had arrived. Send "
    "them again.",
    "watch_dir_gone": "Restore the share; until then send by C-STORE.",
    "watch_dir_refused": "Export the file again.",
    "wrong_duration": "Acquire the slice again; report the value to the scanner's vendor.",
}


@dataclass(frozen=True)
class Condition:
    """Something that is wrong for as long as it is reported. severity: `alarm` or `warning`."""

    code: str
    severity: str
    text: str
    what_to_do: str


class AlarmBook:
    """Remembers since when each condition has stood, and reads the record's alarm events once."""

    def __init__(self) -> None:
        self._since_s: dict[str, float] = {}
        self._seen_event_id = -1
        self._raised: list[AlarmState] = []

    def update(self, conditions: Sequence[Condition], record: CaseRecord) -> list[AlarmState]:
        """Return the alarms of now: standing conditions first, then what was raised lately."""
        now_s = time.time()
        self._since_s = {c.code: self._since_s.get(c.code, now_s) for c in conditions}
        standing = [
            AlarmState(
                code=c.code,
                severity=c.severity,
                text=c.text,
                what_to_do=c.what_to_do,
                since_s=self._since_s[c.code],
            )
            for c in conditions
        ]
        return [*standing, *self._raised_lately(record, now_s)]

    def _raised_lately(self, record: CaseRecord, now_s: float) -> list[AlarmState]:
        newest = record.last_event_id()
        if newest != self._seen_event_id:
            for event in record.events_of_kind("alarm", after_id=self._seen_event_id):
                self._raised.append(
                    AlarmState(
                        code=str(event.body["alarm"]),
                        severity="warning",
                        text=str(event.body["text"]),
                        what_to_do=TO_DO.get(str(event.body["alarm"]), _SEE_LOG),
                        since_s=event.wall_s,
                    )
                )
            self._seen_event_id = newest
        self._raised = [a for a in self._raised if a.since_s > now_s - _SHOWN_S][-_MOST_RAISED:]
        return self._raised[::-1]
