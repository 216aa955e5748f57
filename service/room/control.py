"""The control loop: the one thread that owns the bridge session, the procedure and its record.

HTTP handlers never touch the robot: they put a command into the loop's queue and wait for its
answer. The exception is STOP, which `BridgeClient.request_stop` sends from any thread at once. The
heartbeats that keep the bridge's deadman quiet leave only from this loop.
"""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from dataclasses import dataclass
from typing import Any

import structlog

from case_record.record import CaseRecord, CaseRecordError
from case_record.rows import Procedure
from room_config.load import Config
from service.procedure.guide_recording import GuidePlace
from service.procedure.recording import Place
from service.procedure.registry import build_procedure, result_to_json
from service.procedure.runner import ReplayMismatchError, run_procedure
from service.procedure.sensing import ProcedureFailedError
from service.procedure.targets import ENTRY_SET, TARGET_SET
from service.room.alarms import Condition
from service.room.commands import Commands
from service.room.context import Room
from service.room.describe import Describer
from service.room.execution import Execution, ProcedureAbortedError
from service.room.link import RoomLink
from service.room.readiness import ConflictError
from service.room.state import RoomState

_TICK_S = 0.002
_PUBLISH_EVERY_S = 0.1
_LEAST_BETWEEN_STATES_S = 0.02
_PATIENCE_S = 30.0
# what may be done while the robot moves; all else waits for standstill and is refused meanwhile
_WHILE_MOVING = frozenset(
    {
        "note_stop",
        "abort",
        "answer",  # no question is open then: refused as stale
        "describe_case",
        "assign_slice",
        "confirm_acquisition",
        "give_up_slices",
        "set_entry",
        "propose",
        "refuse_proposal",
        "note_registration",
    }
)
log = structlog.get_logger()


@dataclass(frozen=True, eq=False)
class _Asked:
    """A command of `Commands` by name, and where its answer goes."""

    name: str
    arguments: dict[str, Any]
    future: Future[Any]


class ControlLoop:
    """Start it with `start`, ask it with `call`, end it with `close`."""

    def __init__(
        self,
        config: Config,
        link: RoomLink,
        others_wrong: Callable[[], Sequence[Condition]] = tuple,
    ) -> None:
        """others_wrong: what else is an alarm now; must answer at once."""
        self._config = config
        self._link = link
        self._others_wrong = others_wrong
        self._link.client.while_moving = self._while_moving
        self._queue: queue.Queue[_Asked] = queue.Queue()
        self._published_change = (0, 0)
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="control", daemon=True)
        self._published_at_s = 0.0
        self._state = RoomState.initial(config)
        self._failure: BaseException | None = None
        self._commands: Commands | None = None

    @property
    def state(self) -> RoomState:
        """The newest published state; safe to read from any thread."""
        return self._state

    @property
    def failure(self) -> BaseException | None:
        """Why the loop ended by itself, if it did. The bridge then stops by its deadman."""
        return self._failure

    def start(self) -> None:
        self._thread.start()

    def close(self) -> None:
        self._closing.set()
        self._thread.join(timeout=10.0)

    def call(self, name: str, arguments: Mapping[str, Any]) -> Any:
        """Carry out a command of `Commands` in the loop's thread and return what it returns.

        Raises what the command raises, and TimeoutError if the loop did not come to it; it is then
        not carried out later either.
        """
        if self._failure is not None:
            raise ConflictError("control_loop", f"The control loop ended: {self._failure}")
        asked = _Asked(name, dict(arguments), Future())
        self._queue.put(asked)
        try:
            return asked.future.result(timeout=_PATIENCE_S)
        except TimeoutError:
            if asked.future.cancel():
                raise
            return asked.future.result(timeout=_PATIENCE_S)

    def stop(self, by: str, *, emergency: bool = False) -> None:
        """Stop the robot now, from any thread; the procedure that runs is aborted."""
        self._link.client.request_stop(emergency=emergency)
        self._queue.put(_Asked("note_stop", {"by": by, "emergency": emergency}, Future()))

    # From here on everything runs in the loop's own thread

    def _run(self) -> None:
        try:
            with CaseRecord(self._config.room.case_dir, create=True) as record:
                self._serve(record)
        except _Closing:
            pass
        except BaseException as error:
            self._failure = error
            log.exception("control loop ended")
            self._link.client.request_stop()
        finally:
            self._link.client.close()

    def _serve(self, record: CaseRecord) -> None:
        case = record.start_case(self._config.room.name, seed=0)
        execution = Execution(self._config, record, self._link, self._tick)
        self._commands = Commands(Room(self._config, record, self._link, execution))
        self._record, self._execution = record, execution
        self._describer = Describer(self._config, record, self._link, self._others_wrong)
        while not self._closing.is_set():
            self._tick()
            running = record.running_procedure()
            if running is not None:
                self._run_one(running.procedure_id, case.case_uid)

    def _run_one(self, procedure_id: int, case_uid: str) -> None:
        record, execution = self._record, self._execution
        running = record.running_procedure()
        assert running is not None
        source = {"procedure_id": procedure_id, "name": running.name}
        try:
            procedure = build_procedure(running)
            result = run_procedure(record, procedure_id, procedure, execution.execute, case_uid)
        except _Closing:
            return  # the procedure stays `running`: the next start goes on with it
        except (ProcedureFailedError, ProcedureAbortedError, ReplayMismatchError) as error:
            state = "aborted" if isinstance(error, ProcedureAbortedError) else "failed"
            with record.transaction():
                record.end_procedure(procedure_id, state, {"reason": str(error)})
                record.append_event(
                    f"procedure_{state}", {**source, "reason": str(error)}, source="service"
                )
        else:
            with record.transaction():
                record.end_procedure(procedure_id, "done", result_to_json(result))
                if isinstance(result, Place | GuidePlace):
                    self._make_target(running, result)
                record.append_event("procedure_done", source, source="service")
        finally:
            execution.clear()
        self._publish()

    def _make_target(self, recorded: Procedure, place: Place | GuidePlace) -> None:
        """The place that was recorded is the target from now on; a needle's line has an entry."""
        who = recorded.arguments["by"]
        if isinstance(place, GuidePlace):
            entry = {"patient_mm": place.joint_mm, "procedure_id": recorded.procedure_id}
            self._record.append_event(ENTRY_SET, entry, source="service", who=who)
            patient_mm = place.tip_mm
        else:
            found = self._record.measurement(place.calibration.measurement_id).result or {}
            patient_mm = place.patient_mm(found)
        body = {
            "patient_mm": patient_mm,
            "label": recorded.arguments["label"],
            "in_water": False,
            "procedure_id": recorded.procedure_id,
            "sigma_mm": place.to_json()["sigma_mm"],
        }
        self._record.append_event(TARGET_SET, body, source="service", who=who)

    def _tick(self) -> None:
        """Serve the bridge and the queue once; called in every wait of every step."""
        if self._closing.is_set():
            raise _Closing
        self._answer_queue()
        if self._publish_if_due() and self._commands is not None:
            self._commands.keep_lock()
        # last: what the waiting step looks at next is fresh, and screens do not delay a decision
        self._link.pump(_TICK_S)

    def _while_moving(self) -> None:
        """Called by the link again and again while it waits for the end of a motion."""
        self._answer_queue(moving=True)
        self._publish_if_due()

    def _answer_queue(self, *, moving: bool = False) -> None:
        while self._commands is not None:
            try:
                asked = self._queue.get_nowait()
            except queue.Empty:
                return
            _answer(self._commands, asked, moving, self._publish)

    def _publish_if_due(self) -> bool:
        """Publish when something was recorded, and every now and then; whether it was done."""
        since_s = time.monotonic() - self._published_at_s
        if since_s < _LEAST_BETWEEN_STATES_S:
            return False
        changed = self._record.change_count() != self._published_change
        if changed or since_s > _PUBLISH_EVERY_S:
            self._publish()
            return True
        return False

    def _publish(self) -> None:
        self._published_at_s = time.monotonic()
        self._published_change = self._record.change_count()
        self._state = self._describer.describe(self._execution, self._state)


class _Closing(Exception):
    """The loop is asked to end; what runs stays as it is recorded."""


def _answer(commands: Commands, asked: _Asked, moving: bool, publish: Callable[[], None]) -> None:
    """Carry out what was asked; the state that shows it is published before the answer is given."""
    if not asked.future.set_running_or_notify_cancel():
        return  # whoever asked has given up waiting: not carried out
    try:
        if moving and asked.name not in _WHILE_MOVING:
            raise ConflictError("moving", "The robot moves: wait until it stands, or press STOP.")
        result = commands.carry_out(asked.name, asked.arguments)
        log.info("command", command=asked.name, by=asked.arguments.get("by"))
        publish()
        asked.future.set_result(result)
    except (ConflictError, CaseRecordError) as error:
        log.info("refused", command=asked.name, by=asked.arguments.get("by"), why=str(error))
        asked.future.set_exception(error)
    except Exception as error:
        log.exception("command failed", command=asked.name)
        asked.future.set_exception(error)
