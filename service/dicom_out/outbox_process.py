"""The outbox: a process of its own beside the service, which starts it where there is somebody to
send to. `python -m service.dicom_out.outbox_process` reads the configuration as one JSON line on
standard input and ends when that is closed.

The main thread makes outputs (highdicom, numpy) and queues them; each destination has a thread of
its own, so that none of them waits for another one.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
from collections.abc import Callable
from itertools import chain
from pathlib import Path

import structlog

from case_record.cases import Cases
from case_record.connection import FILE_NAME
from case_record.presence import Presence, Sole
from case_record.record import CaseRecord, CaseRecordError
from room_config.load import Config
from room_config.shell import configure_logs, on_parent_gone
from service.dicom_out.errors import OutputError
from service.dicom_out.make import Output, make_output, outputs_to_send, plans_to_send
from service.dicom_out.outbox_sender import Sender
from service.dicom_out.outbox_store import PRESENCE, OutboxStore, cases_with_open_deliveries

_LOOK_S = 0.25
_AGAIN_S = 10.0
_END_S = 2.0
_PATIENCE_S = 30.0
_NICENESS = 5
log = structlog.get_logger()


class Maker:
    """Finds in the record what is to be sent, makes it and queues it."""

    def __init__(self, config: Config, record: CaseRecord, store: OutboxStore) -> None:
        self._record, self._store = record, store
        self._kinds = {one.name: one.kinds for one in config.outputs.destination}
        self._known = store.known()
        self._seen = (-1, -1)
        self._again_s = 0.0
        self._after = 0

    def look(self, beat: Callable[[], None]) -> None:
        """Make whatever is new, with a `beat` before each; what the disk did not take is tried
        again after a while.
        """
        now = self._record.change_count()
        if now == self._seen or time.monotonic() < self._again_s:
            return
        settled = self._settled_measurement()
        new = chain(outputs_to_send(self._record, self._after), plans_to_send(self._record))
        wanted = [one for one in new if one.name not in self._known]
        for output in wanted:
            beat()
            takers = [name for name, kinds in self._kinds.items() if output.kind in kinds]
            if takers and not self._make(output, takers):
                self._again_s = time.monotonic() + _AGAIN_S
                return
            self._known.add(output.name)
        self._seen, self._after = now, settled

    def has_seen_all(self) -> bool:
        """Whether the record has nothing that was not looked at."""
        return self._record.change_count() == self._seen

    def _settled_measurement(self) -> int:
        """Up to this one all have ended: they need not be looked at again."""
        last = self._record.last_measurement()  # before those that are open: none slips through
        requested = self._record.requested_measurements()
        newest = last.measurement_id if last else 0
        return min([newest, *(row.measurement_id - 1 for row in requested)])

    def _make(self, output: Output, takers: list[str]) -> bool:
        """False where it may succeed later."""
        uid = problem = ""
        try:
            uid = sop_instance_uid(make_output(self._record, output))
        except (OutputError, CaseRecordError, FileNotFoundError) as error:
            problem = str(error)
        except OSError as error:
            log.error("output not written", output=output.name, why=str(error))
            return False
        except Exception as error:  # one that cannot be made must not keep the others
            log.exception("output not made", output=output.name)
            problem = f"{type(error).__name__}: {error}"
        self._store.add(output.name, output.kind, uid, takers, problem)
        return True


def sop_instance_uid(path: os.PathLike[str]) -> str:
    import pydicom

    return str(pydicom.dcmread(path, specific_tags=["SOPInstanceUID"]).SOPInstanceUID)


class CaseOutbox:
    """The outputs of one case: made and sent until none is left to send. Close it in the end."""

    def __init__(self, config: Config, case_dir: Path) -> None:
        self._record = CaseRecord(case_dir)
        self._store = OutboxStore(case_dir)
        self._store.prepare({one.name: one.kinds for one in config.outputs.destination})
        self._maker = Maker(config, self._record, self._store)
        self._senders = [
            Sender(case_dir, one, config.outputs) for one in config.outputs.destination
        ]
        for sender in self._senders:
            sender.start()

    def look(self, beat: Callable[[], None]) -> None:
        """Make what is new."""
        self._maker.look(beat)

    def is_alive(self) -> bool:
        return all(sender.is_alive() for sender in self._senders)

    def is_done(self) -> bool:
        """Whether all that there is was made, and is stored everywhere."""
        return self._maker.has_seen_all() and not self._store.has_open_deliveries()

    def close(self) -> None:
        for sender in self._senders:
            sender.stop(_END_S)
        self._store.close()
        self._record.close()


def serve(config: Config, stop: threading.Event) -> None:
    """Make and send until `stop`: of the open case, and of those before it what is left."""
    cases = Cases(*config.room.folders)
    outboxes: dict[Path, CaseOutbox] = {}
    with (
        Sole(cases.home, PRESENCE, patience_s=_PATIENCE_S),
        Presence(cases.home, PRESENCE) as presence,
    ):
        waiting = [] if cases.only is not None else cases_with_open_deliveries(cases)
        try:
            while not stop.wait(_LOOK_S):
                presence.beat()
                now = cases.open
                for folder in {*waiting, *([] if now is None else [now])} - outboxes.keys():
                    if (folder / FILE_NAME).is_file():  # else the service is about to begin it
                        outboxes[folder] = CaseOutbox(config, folder)
                waiting.clear()
                for folder, outbox in list(outboxes.items()):
                    outbox.look(presence.beat)
                    if not outbox.is_alive():
                        return
                    if folder != now and outbox.is_done():
                        outboxes.pop(folder).close()
        finally:
            for outbox in outboxes.values():
                outbox.close()


def main() -> int:
    configure_logs()
    os.nice(_NICENESS)
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    config = Config.model_validate_json(_first_line())
    on_parent_gone(stop.set)
    try:
        serve(config, stop)
    except CaseRecordError as error:
        log.error("outbox ended", why=str(error))
        return 2
    return 0 if stop.is_set() else 3


def _first_line() -> bytes:
    """Read by hand: nothing beyond the line may be taken into a buffer."""
    line = bytearray()
    while not line.endswith(b"\n"):
        piece = os.read(0, 1)
        if not piece:
            break
        line += piece
    return bytes(line)


if __name__ == "__main__":
    code = main()
    sys.stderr.flush()
    # at once: pynetdicom's threads may wait for a destination that keeps silent
    os._exit(code)
