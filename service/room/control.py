"""The control loop: the one thread that owns the bridge session, the procedure and its record.

HTTP handlers never touch the robot: they put a command into the loop's queue and wait for its
answer. The exception is STOP, which `BridgeClient.request_stop` sends from any thread at once. The
heartbeats that keep the bridge's deadman quiet leave only from this loop.
"""

from __future__ import annotations

import contextlib
import queue
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import structlog

from case_record.cases import Cases, CasesError
from case_record.presence import Presence
from case_record.record import CaseRecord, CaseRecordError, RecordUnavailableError
from case_record.rows import Procedure
from room_config.load import Config
from service.procedure.approach import Arrival
from service.procedure.calibration import Calibration
from service.procedure.observe import ProcedureFailedError
from service.procedure.recording import Place
from service.procedure.registry import build_procedure, result_to_json
from service.procedure.runner import ReplayMismatchError, run_procedure
from service.procedure.scan_frame import frame_of
from service.procedure.steps import Outcome, Step
from service.procedure.targets import ENTRY_SET, TARGET_SET
from service.room.alarm_list import Condition
from service.room.cases.between import BetweenCases
from service.room.cases.life import CaseLife, is_finished, set_at_rest
from service.room.commands.commands import Commands
from service.room.conditions import conditions
from service.room.context import RoomContext, now_of
from service.room.counts.correct import correct_counts
from service.room.execution import Execution, ProcedureAbortedError
from service.room.integrity import doubt_of, doubt_of_arrival
from service.room.link import RoomLink
from service.room.refusal import ConflictError
from service.room.scanner_clock import ClockWatch, note_step
from service.room.state import RoomState
from service.room.state_view import Describer, ProcessLook, describe_robot
from service.room.stop_latch import StopLatch
from service.room.trouble import RECORD_FAULTS, Trouble, held
from service.room.validity import Now

_TICK_S = 0.01
_HOLD_TICK_S = 0.02
_TRIED_AGAIN_S = 0.5
_SAID_AGAIN_S = 60.0
# while another has the record locked for longer, the loop holds: it must not be kept from the link
_BUSY_TIMEOUT_S = 0.5
# a published state that is older is not what the room is doing now: nobody may be shown it as such
STALE_S = 1.0
NOTE_STOP = "note_stop"
_PUBLISH_EVERY_S = 0.1
_LEAST_BETWEEN_STATES_S = 0.02
_PATIENCE_S = 30.0
# what may be done while the robot moves; all else waits for standstill and is refused meanwhile
_WHILE_MOVING = frozenset(
    {
        NOTE_STOP,
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
# answered when the case that is open then is shown
_CHANGES_CASE = frozenset({"begin_case", "finish_case", "reopen_case"})
# the safe direction, and what is only written down: never too late, and not void after a STOP
_ALWAYS = frozenset({"note_stop", "abort", "lock_motion", "describe_case", "compare_clocks"})
OLDEST_ORDER_S = 3.0
log = structlog.get_logger()


@dataclass(frozen=True, eq=False)
class _Asked:
    """A command of `Commands` by name, when it was asked for (monotonic), where its answer goes."""

    name: str
    arguments: dict[str, Any]
    future: Future[Any]
    asked_s: float


class ControlLoop:
    """Start it with `start`, ask it with `call`, end it with `close`."""

    def __init__(
        self,
        config: Config,
        link: RoomLink,
        others_wrong: Callable[[], Sequence[Condition]] = tuple,
        on_failure: Callable[[], None] = lambda: None,
    ) -> None:
        """others_wrong: what else is an alarm now; must answer at once.

        on_failure: called, in the loop's thread, when the loop has ended by itself.
        """
        self._config = config
        self._cases = Cases(*config.room.folders)
        self._processes = ProcessLook(self._cases.home)
        self._clock = ClockWatch(self._cases.home)
        self._unusable: Path | None = None
        self._problem = ""
        self._owed: list[tuple[Future[Any], Any]] = []
        self._link = link
        self._others_wrong = others_wrong
        self._link.client.while_moving = self._while_moving
        self._queue: queue.Queue[_Asked] = queue.Queue()
        self._published_change = (0, 0)
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="control", daemon=True)
        self._published_at_s = time.monotonic()
        self._state = RoomState.initial(config)
        self._failure: BaseException | None = None
        self._on_failure = on_failure
        self._trouble = Trouble()
        self._doubts: dict[Path, str] = {}
        self._failed_at: tuple[int, str] | None = None
        self._said_s = -_SAID_AGAIN_S
        self._commands: Commands | BetweenCases | None = None
        self._presence: Presence | None = None
        self._stops = StopLatch()

    @property
    def state(self) -> RoomState:
        """The newest published state; safe to read from any thread."""
        return self._state

    @property
    def now(self) -> Now:
        """How things stand beside the record; safe to read from any thread."""
        return now_of(self._config, self._link)

    @property
    def state_age_s(self) -> float:
        """How long ago it was published, by a clock that nobody sets."""
        return time.monotonic() - self._published_at_s

    @property
    def failure(self) -> BaseException | None:
        """Why the loop ended by itself, if it did. The bridge then stops by its deadman."""
        return self._failure

    def start(self) -> None:
        self._thread.start()

    def close(self) -> None:
        self._closing.set()
        self._thread.join(timeout=10.0)

    def call(self, name: str, arguments: Mapping[str, Any], asked_s: float | None = None) -> Any:
        """Carry out a command of `Commands` in the loop's thread and return what it returns.

        asked_s: when it was asked for, monotonic clock (default: now). Raises what the command
        raises, ConflictError if it is too old or STOP was pressed since, and TimeoutError if the
        loop did not come to it; it is then not carried out later either.
        """
        if self._failure is not None:
            raise ConflictError("control_loop", f"The control loop ended: {self._failure}")
        asked_s = time.monotonic() if asked_s is None else asked_s
        asked = _Asked(name, dict(arguments), Future(), asked_s)
        self._queue.put(asked)
        try:
            return asked.future.result(timeout=_PATIENCE_S)
        except TimeoutError:
            if asked.future.cancel():
                raise
            return asked.future.result(timeout=_PATIENCE_S)

    def stop(self, by: str, *, emergency: bool = False) -> int:
        """Stop the robot now, from any thread; the procedure that runs is aborted.

        Return the number of this STOP: until `stop_answered` says that whoever pressed it was told
        what became of it, every order that moves or unlocks is void.
        """
        number = self._stops.press()
        self._link.client.request_stop(emergency=emergency)
        arguments = {"by": by, "emergency": emergency}
        self._queue.put(_Asked(NOTE_STOP, arguments, Future(), time.monotonic()))
        return number

    def stop_answered(self, number: int) -> None:
        """See `stop`."""
        self._stops.answer(number)

    def stop_outcome(self) -> str:
        """What became of the last STOP: `stopped`, `on_its_way` or `not_delivered` (yet)."""
        if not self._link.client.stop_acknowledged:
            return "not_delivered"
        robot = self._state.robot
        return "stopped" if robot.linked and robot.stopped and not robot.moving else "on_its_way"

    # From here on everything runs in the loop's own thread

    def _run(self) -> None:
        try:
            while not self._closing.is_set():
                self._work_until_it_fails()
        except BaseException as error:
            self._failure = error
            log.exception("control loop ended")
            self._link.client.request_stop()
        finally:
            self._link.client.close()
            self._commands = None
            if self._presence is not None:
                self._presence.close()
            if self._failure is not None:
                self._on_failure()

    def _work_until_it_fails(self) -> None:
        try:
            folder = self._folder_to_serve()
            if folder is None:
                self._wait_for_case()
                return
            with self._opened(folder) as record:
                self._serve(record)
        except (_Closing, _UnusableError):
            return
        except Exception as error:
            if self._trouble.begin(error):
                log.exception("the control loop is suspended")
            self._hold()

    def _folder_to_serve(self) -> Path | None:
        """The open case's; None if there is none, or it cannot be used (`_problem`)."""
        try:
            folder = self._cases.open
        except CasesError as error:
            self._problem = f"{error}."
            return None
        if folder != self._unusable:
            self._unusable, self._problem = None, ""
        return folder if self._unusable is None else None

    def _opened(self, folder: Path) -> CaseRecord:
        """The record of the open case, or it is unusable: that ends the case and not the room."""
        only = self._cases.only is not None
        try:
            return CaseRecord(folder, create=only, busy_timeout_s=_BUSY_TIMEOUT_S)
        except RecordUnavailableError:
            raise
        except CaseRecordError as error:
            if only:
                raise
            log.error("the open case cannot be used", folder=str(folder), why=str(error))
            self._unusable = folder
            self._problem = f"Case {folder.name} cannot be used: {error}."
            raise _UnusableError from error

    def _serve(self, record: CaseRecord) -> None:
        case = record.start_case(self._config.room.name, seed=0)
        if self._cases.only is None and is_finished(record):
            self._cases.set_open(None)  # a crash came in between
            return
        if record.case_dir not in self._doubts:
            self._doubts[record.case_dir] = doubt_of(record)
        record.doubt = self._doubts[record.case_dir]
        self._trouble.settle(record)
        life = CaseLife(self._cases, record, time.time())
        if life.asks:
            set_at_rest(record)
        execution = Execution(self._config, record, self._link, self._tick)
        room = RoomContext(self._config, record, self._link, execution, self._stops)
        self._record, self._execution = record, execution
        if self._clock.is_news_to(record):
            note_step(record, self._clock.stepped_s)
        self._describer = Describer(self._config, record, self._link, life, self._wrong)
        self._commands = Commands(room, life)
        self._publish()
        while self._cases.open == record.case_dir:
            self._tick()
            running = record.running_procedure()
            if running is not None:
                self._run_one(running, case.case_uid)
        self._commands = None

    def _wait_for_case(self) -> None:
        """No case is open: keep the link, answer STOP, until somebody begins one."""
        between = BetweenCases(self._config, self._cases, self._problem)
        self._commands = between
        shown_s = 0.0
        while self._folder_to_serve() is None:
            if self._closing.is_set():
                raise _Closing
            if time.monotonic() - shown_s > _PUBLISH_EVERY_S:
                shown_s = time.monotonic()
                self._publish_between(between)
            self._answer_queue()
            self._link.pump(_TICK_S)
        self._commands = None

    def _publish_between(self, between: BetweenCases) -> None:
        self._clock.look()
        robot = describe_robot(self._link, self._state.robot)
        processes = self._processes.processes()

        def wrong(state: RoomState) -> list[Condition]:
            return [*between.conditions(), *conditions(state), *self._others_wrong()]

        self._show(between.describe(self._state, robot, processes, wrong, time.time()))

    def _wrong(self) -> Sequence[Condition]:
        """What else is wrong than the state shows."""
        if not self._record.doubt:
            return self._others_wrong()
        what = "Do not rely on it. Keep the folder as it is and start a new case."
        changed = Condition("record_changed", "alarm", self._record.doubt, what)
        return [changed, *self._others_wrong()]

    def _hold(self) -> None:
        """For a while: keep the link, show what is wrong, refuse orders; then it is tried again."""
        if isinstance(self._commands, Commands) and self._execution.aborting is not None:
            self._trouble.abort = self._execution.aborting
        self._commands = None
        until_s = time.monotonic() + _TRIED_AGAIN_S
        while time.monotonic() < until_s and not self._closing.is_set():
            self._refuse_queue()
            self._publish_held(self._trouble.condition(), self._trouble.since_s)
            self._link.pump(_HOLD_TICK_S)

    def _run_one(self, running: Procedure, case_uid: str) -> None:
        """Run a procedure to its end; what it raises ends it and nothing else.

        Where the record is at fault it stays `running` and goes on from there, as after a crash.
        """
        calls = 0

        def execute(step: Step, command_id: str) -> Outcome:
            nonlocal calls
            calls += 1
            return self._execution.execute(step, command_id)

        try:
            procedure = build_procedure(running)
            number = running.procedure_id
            result = run_procedure(self._record, number, procedure, execute, case_uid)
        except _Closing:
            raise  # the procedure stays `running`: the next start goes on with it
        except ProcedureAbortedError as error:
            self._end_procedure(running, "aborted", str(error))
        except ProcedureFailedError as error:
            self._end_procedure(running, "failed", str(error), error.code)
        except ReplayMismatchError as error:
            self._end_procedure(running, "failed", str(error))
        except RECORD_FAULTS as error:
            # the record could be written in between, and yet: then it is not the record's fault
            before, self._failed_at = self._failed_at, (running.procedure_id, str(error))
            if before != self._failed_at or calls > 1:
                raise
            self._fail_by_program(running, error)
        except Exception as error:
            self._fail_by_program(running, error)
        else:
            try:
                self._finish_procedure(running, result)
            except RECORD_FAULTS:
                raise
            except Exception as error:
                self._fail_by_program(running, error)
        self._execution.clear()
        self._keep_ready()  # READY is not shown before motion is locked
        self._publish()

    def _fail_by_program(self, running: Procedure, error: Exception) -> None:
        log.exception("procedure failed", procedure=running.name)
        text = f"internal error ({type(error).__name__}: {error}); see the log"
        self._end_procedure(running, "failed", text)

    def _end_procedure(self, running: Procedure, state: str, reason: str, code: str = "") -> None:
        body = {"procedure_id": running.procedure_id, "name": running.name, "reason": reason}
        result = {"reason": reason, "code": code}
        with self._record.transaction():
            self._record.end_procedure(running.procedure_id, state, result)
            self._record.append_event(f"procedure_{state}", body, source="service")

    def _finish_procedure(self, running: Procedure, result: Any) -> None:
        body = {"procedure_id": running.procedure_id, "name": running.name}
        if isinstance(result, Arrival) and not self._record.doubt:
            doubt = doubt_of_arrival(self._record, running.procedure_id, result.measurement_id)
            self._doubts[self._record.case_dir] = self._record.doubt = doubt
        with self._record.transaction():
            self._record.end_procedure(running.procedure_id, "done", result_to_json(result))
            if isinstance(result, Place):
                self._make_target(running, result)
            self._record.append_event("procedure_done", body, source="service")
        known = getattr(result, "calibration", result)
        if isinstance(known, Calibration):
            correct_counts(self._record, self._link, known)

    def _make_target(self, recorded: Procedure, place: Place) -> None:
        """The place that was recorded is the target from now on; a needle's line has an entry."""
        who = recorded.arguments["by"]
        if place.needle is not None:
            entry = {
                "patient_mm": list(place.needle.joint_mm),
                "procedure_id": recorded.procedure_id,
            }
            self._record.append_event(ENTRY_SET, entry, source="service", who=who)
        measurement = self._record.measurement(place.calibration.measurement_id)
        body = {
            "patient_mm": place.target_mm(measurement.result or {}),
            "label": recorded.arguments["label"],
            "in_water": False,
            "procedure_id": recorded.procedure_id,
            "sigma_mm": place.sigma_mm,
            "found_by": place.calibration.found_by.to_json(),
        }
        frame = frame_of(self._record, measurement)
        if frame is not None:
            body["scan_frame"] = frame.to_json()
        self._record.append_event(TARGET_SET, body, source="service", who=who)

    def _tick(self) -> None:
        """Serve the bridge and the queue once; called in every wait of every step."""
        if self._closing.is_set():
            raise _Closing
        self._answer_queue()
        if self._publish_if_due():
            if self._clock.look():
                note_step(self._record, self._clock.stepped_s)
            self._keep_ready()
            if self._commands is not None:
                self._commands.look_for_plans()
        # last: what the waiting step looks at next is fresh, and screens do not delay a decision
        self._link.pump(_TICK_S)

    def _keep_ready(self) -> None:
        if self._commands is not None:
            self._commands.keep_ready()

    def _while_moving(self) -> None:
        """Called by the link again and again while it waits for the end of a motion."""
        self._answer_queue(moving=True)
        self._publish_if_due()

    def _answer_queue(self, *, moving: bool = False) -> None:
        while self._commands is not None and not self._owed:
            try:
                asked = self._queue.get_nowait()
            except queue.Empty:
                return
            try:
                self._answer(self._commands, asked, moving)
            except RECORD_FAULTS:
                if asked.name == NOTE_STOP:
                    self._trouble.owe_stop(**asked.arguments)
                raise

    def _refuse_queue(self) -> None:
        """While the loop holds: a STOP is owed to the record, all else is refused."""
        while True:
            try:
                asked = self._queue.get_nowait()
            except queue.Empty:
                return
            if not asked.future.set_running_or_notify_cancel():
                continue
            if asked.name == NOTE_STOP:
                self._trouble.owe_stop(**asked.arguments)
                asked.future.set_result(None)
            else:
                asked.future.set_exception(self._trouble.refusal())

    def _answer(self, commands: Commands | BetweenCases, asked: _Asked, moving: bool) -> None:
        """Carry out what was asked; the state that shows it is published before the answer.

        Raises where the record is at fault, after whoever asked was told.
        """
        if not asked.future.set_running_or_notify_cancel():
            return  # whoever asked has given up waiting: not carried out
        try:
            self._check(asked, moving)
            result = commands.carry_out(asked.name, asked.arguments)
            log.info("command", command=asked.name, by=asked.arguments.get("by"))
            if asked.name in _CHANGES_CASE:
                self._owed.append((asked.future, result))
                return
            if isinstance(commands, Commands):
                if not moving:
                    self._keep_ready()
                self._publish()
            asked.future.set_result(result)
        except (ConflictError, CaseRecordError) as error:
            log.info("refused", command=asked.name, by=asked.arguments.get("by"), why=str(error))
            asked.future.set_exception(error)
        except Exception as error:
            log.exception("command failed", command=asked.name)
            asked.future.set_exception(error)
            if isinstance(error, RECORD_FAULTS):
                raise

    def _check(self, asked: _Asked, moving: bool) -> None:
        """Raise ConflictError for an order that may not be carried out now, or not any more."""
        if asked.name not in _ALWAYS and self._stops.voids(asked.asked_s):
            text = (
                "STOP was pressed after this was requested, so it was not carried out. Ask again."
            )
            raise ConflictError("void_after_stop", text)
        age_s = time.monotonic() - asked.asked_s
        if asked.name not in _ALWAYS and not age_s <= OLDEST_ORDER_S:
            text = f"This was requested {age_s:.1f} s ago, so it was not carried out. Ask again."
            raise ConflictError("stale_order", text)
        if moving and asked.name not in _WHILE_MOVING:
            raise ConflictError(
                "moving", "The robot is moving: wait until it stops, or press STOP."
            )

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
        self._published_change = self._record.change_count()
        try:
            state = self._describer.describe(self._execution, self._state)
        except RECORD_FAULTS:
            raise
        except Exception as error:
            wrong = f"Cannot report the state ({type(error).__name__}: {error})"
            self._publish_held(Condition("state", "alarm", wrong, "See the log."), time.time())
            if time.monotonic() - self._said_s > _SAID_AGAIN_S:
                self._said_s = time.monotonic()
                log.exception("state")
            return
        self._show(state)

    def _publish_held(self, wrong: Condition, since_s: float) -> None:
        robot = describe_robot(self._link, self._state.robot)
        self._show(held(self._state, robot, wrong, since_s))

    def _show(self, state: RoomState) -> None:
        self._beat()
        self._published_at_s = time.monotonic()
        self._state = state
        if self._owed and (state.case_folder is None) == (self._folder_to_serve() is None):
            while self._owed:
                future, result = self._owed.pop()
                future.set_result(result)

    def _beat(self) -> None:
        """Whoever supervises the service sees that this loop turns."""
        with contextlib.suppress(OSError):  # a disk that takes nothing
            self._presence = self._presence or Presence(self._cases.home, "service")
            self._presence.beat()


class _UnusableError(Exception):
    """The case that is named as open cannot be used; nothing in it was changed."""


class _Closing(Exception):
    """The loop is asked to end; what runs stays as it is recorded."""
