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

import structlog

from case_record.cases import Cases
from case_record.connection import FILE_NAME
from case_record.presence import Presence, Sole
from case_record.record import CaseRecord, CaseRecordError
from room_config.load import Config
from room_config.shell import configure_logs, on_parent_gone
from service.dicom_out.errors import OutputError
from service.dicom_out.make import Output, make_output, outputs_to_send
from service.dicom_out.outbox_sender import Sender
from service.dicom_out.outbox_store import OutboxStore

PRESENCE = "outbox"
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

    def look(self) -> None:
        """Make whatever is new; what the disk did not take is tried again after a while."""
        now = self._record.change_count()
        if now == self._seen or time.monotonic() < self._again_s:
            return
        settled = self._settled_measurement()
        new = outputs_to_send(self._record, self._after)
        wanted = [one for one in new if one.name not in self._known]
        for output in wanted:
            takers = [name for name, kinds in self._kinds.items() if output.kind in kinds]
            if takers and not self._make(output, takers):
                self._again_s = time.monotonic() + _AGAIN_S
                return
            self._known.add(output.name)
        self._seen, self._after = now, settled

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


def serve(config: Config, stop: threading.Event) -> None:
    """Make and send until `stop`."""
    case_dir = Cases(*config.room.folders).required()
    kinds = {one.name: one.kinds for one in config.outputs.destination}
    while not (case_dir / FILE_NAME).is_file():  # the service is about to begin the case
        if stop.wait(_LOOK_S):
            return
    with (
        Sole(case_dir, PRESENCE, patience_s=_PATIENCE_S),
        Presence(case_dir, PRESENCE) as presence,
        CaseRecord(case_dir) as record,
        OutboxStore(case_dir) as store,
    ):
        store.prepare(kinds)
        maker = Maker(config, record, store)
        senders = [Sender(case_dir, one, config.outputs) for one in config.outputs.destination]
        for sender in senders:
            sender.start()
        while not stop.wait(_LOOK_S) and all(sender.is_alive() for sender in senders):
            presence.beat()
            maker.look()
        for sender in senders:
            sender.stop(_END_S)


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
