"""The bridge as a process: one loop that reads the line, ticks the bridge and writes the answers.

Every way out of the loop (signal, end of the parent, lost guardian, exception) goes through the
same shutdown: stop, wait for standstill, journal, close. Its steps are shielded from each other.
"""

import json
import logging
import os
import secrets
import select
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path

from robot_bridge.daemon.bridge import Bridge
from robot_bridge.daemon.bridge_settings import BridgeSettings
from robot_bridge.daemon.config import AxisConfig, BridgeConfig
from robot_bridge.daemon.guardian import Guardian
from robot_bridge.daemon.journal import Journal, JournalError
from robot_bridge.daemon.motors import MotorError, Motors
from robot_bridge.daemon.whereabouts import RUN_SIGMAS, Growth
from robot_bridge.protocol.messages import Code
from robot_bridge.protocol.transport import SerialTransport, Transport, TransportError

log = logging.getLogger("robot_bridge")

IDLE_WAIT_S = 0.02
MOTION_WAIT_S = 0.004
REOPEN_S = 0.25
HEALTH_S = 0.5
STANDSTILL_WAIT_S = 1.5
SOFTWARE = "autospine-bridge 0.1.0"


class StartError(Exception):
    """The bridge could not start: device, journal or motors; one line."""


class Daemon:
    """Owns the line, the bridge and the shutdown. Motors and journal come in open."""

    def __init__(
        self,
        config: BridgeConfig,
        motors: Motors,
        journal: Journal,
        *,
        guardian: Guardian | None = None,
        open_transport: Callable[[], Transport] | None = None,
        parent_fd: int | None = None,
    ) -> None:
        self.config = config
        self.exit_reason: str | None = None
        self._motors = motors
        self._journal = journal
        self._guardian = guardian
        self._parent_fd = parent_fd
        self._open_transport = open_transport or (
            lambda: SerialTransport(config.link, config.link_baud)
        )
        self._transport: Transport | None = None
        self._reopen_s = 0.0
        self._health_s = 0.0
        self.bridge = Bridge(
            settings_of(config),
            motors,
            journal,
            boot_id=secrets.token_hex(8),
            new_session=lambda: secrets.randbelow(2**32 - 1) + 1,
            clock=time.monotonic,
            wall_clock=time.time,
        )

    def leave(self, reason: str) -> None:
        """Ask the loop to end; may be called from a signal handler or another thread."""
        self.exit_reason = self.exit_reason or reason

    def run(self) -> None:
        """Until something says to leave. Motors stand when it returns, however it returns."""
        try:
            while self.exit_reason is None:
                self._turn()
        except Exception as error:
            self.exit_reason = f"internal error: {type(error).__name__}: {error}"
            log.exception("internal_error")
            raise
        finally:
            self._shut_down()

    # --- one turn -----------------------------------------------------------------------------

    def _turn(self) -> None:
        data = self._read()
        if data:
            self.bridge.receive(data)
        self.bridge.tick()
        self._write(self.bridge.take_output())
        self._watch_others()
        self._report_health()

    def _read(self) -> bytes:
        wait_s = MOTION_WAIT_S if self.bridge.moving else IDLE_WAIT_S
        if self._transport is None and not self._try_to_open():
            time.sleep(wait_s)
            return b""
        assert self._transport is not None
        try:
            return self._transport.read(wait_s)
        except TransportError as error:
            self._lose_line(error)
            return b""

    def _write(self, data: bytes) -> None:
        if not data or self._transport is None:
            return
        try:
            self._transport.write(data)
        except TransportError as error:
            self._lose_line(error)

    def _try_to_open(self) -> bool:
        now_s = time.monotonic()
        if now_s < self._reopen_s:
            return False
        self._reopen_s = now_s + REOPEN_S
        try:
            self._transport = self._open_transport()
        except TransportError:
            return False
        log.info("line_open", extra={"fields": {"link": self.config.link}})
        return True

    def _lose_line(self, error: TransportError) -> None:
        log.warning("line_lost", extra={"fields": {"error": str(error)}})
        if self.bridge.armed or self.bridge.moving:
            self.bridge.stop_for(Code.LINK_LOST, str(error))
        transport, self._transport = self._transport, None
        if transport is not None:
            _shielded("close_line", transport.close)

    def _watch_others(self) -> None:
        if self._guardian is not None:
            self._guardian.beat()
            if self._guardian.lost:
                self.bridge.stop_for(Code.GUARDIAN_LOST, "the guardian process died")
                self.leave("guardian lost")
        if self._parent_fd is not None and _at_end(self._parent_fd):
            self.leave("parent gone")

    # --- health -------------------------------------------------------------------------------

    def _report_health(self) -> None:
        now_s = time.monotonic()
        if now_s - self._health_s < HEALTH_S:
            return
        self._health_s = now_s
        _shielded("health", lambda: write_health(self.config.status_file, self.health()))

    def health(self) -> dict[str, object]:
        bridge = self.bridge
        status = bridge.status()
        return {
            "t": time.time(),
            "pid": os.getpid(),
            "software": SOFTWARE,
            "boot_id": bridge.boot_id,
            "line_open": self._transport is not None,
            "session": bridge.end.session is not None,
            "heard_s_ago": round(bridge.heard_s_ago, 3),
            "phase": status.phase,
            "armed": status.armed,
            "stopped": status.stopped,
            "stop_reason": status.stop_reason,
            "stop_count": status.stop_count,
            "insertion_locked": status.insertion_locked,
            "moving": status.moving,
            "positions_um": status.positions_um,
            "position_certain": status.position_certain,
            "certain_axes": list(status.certain_axes),
            "bound_um": status.bound_um,
            "remembered_um": status.remembered_um,
            "correction_um": status.correction_um,
            "motions": status.motions,
            "last_motion": status.last_motion,
            "boards": dict(bridge.motors.status.boards),
            "supply": {a: dict(s) for a, s in bridge.motors.status.supply.items()},
            "warnings": list(bridge.motors.status.warnings),
            "fault": status.fault,
            "frames": bridge.end.counters.as_dict(),
            "refused": dict(bridge.refused),
            "commands": dict(bridge.commands_done),
            "guardian_pid": self._guardian.pid if self._guardian else None,
            "exit_reason": self.exit_reason,
        }

    # --- the way out --------------------------------------------------------------------------

    def _shut_down(self) -> None:
        log.info("shutting_down", extra={"fields": {"reason": self.exit_reason}})
        _shielded("shut_down", self.bridge.shut_down)
        _shielded("standstill", self._await_standstill)
        _shielded("stop", self._motors.stop)
        _shielded("last_words", lambda: self._write(self.bridge.take_output()))
        _shielded("close_motors", self._motors.close)
        _shielded("health", lambda: write_health(self.config.status_file, self.health()))
        _shielded("close_journal", self._journal.close)
        if self._transport is not None:
            _shielded("close_line", self._transport.close)
        if self._guardian is not None:
            _shielded("dismiss_guardian", self._guardian.dismiss)

    def _await_standstill(self) -> None:
        until_s = time.monotonic() + STANDSTILL_WAIT_S
        while self.bridge.moving and time.monotonic() < until_s:
            self.bridge.tick()
            time.sleep(MOTION_WAIT_S)


def settings_of(config: BridgeConfig) -> BridgeSettings:
    return BridgeSettings(
        axes=tuple(axis.travel for axis in config.axes),
        deadman_s=config.deadman_s,
        motion_timeout_s=config.motion_timeout_s,
        motion_poll_s=config.motion_poll_s,
        software=SOFTWARE,
        growth={axis.name: growth_of(axis) for axis in config.axes},
    )


def growth_of(axis: AxisConfig) -> Growth:
    counted = axis.drive == "open_loop"
    return Growth(
        step_error=axis.step_error if counted else 0.0,
        run_um=RUN_SIGMAS * axis.tolerance_um if counted else 0.0,
        approach_um=axis.approach_um,
        tolerance_um=axis.tolerance_um,
    )


def write_health(path: Path, health: dict[str, object]) -> None:
    """One line of JSON, replaced as a whole."""
    part = path.with_name(path.name + ".part")
    part.write_text(json.dumps(health, separators=(",", ":")) + "\n", encoding="utf-8")
    part.replace(path)


def _shielded(step: str, do: Callable[[], object]) -> None:
    """Do one step of the way out; its failure is logged and never keeps the next from happening."""
    try:
        do()
    except Exception as error:
        log.error("step_failed", extra={"fields": {"step": step, "error": str(error)}})


def _at_end(descriptor: int) -> bool:
    ready, _, _ = select.select([descriptor], [], [], 0)
    return bool(ready) and os.read(descriptor, 4096) == b""


class JsonLines(logging.Formatter):
    """Structured logs: one JSON object a line."""

    def format(self, record: logging.LogRecord) -> str:
        entry = {
            "t": round(record.created, 6),
            "level": record.levelname.lower(),
            "event": record.getMessage(),
            **getattr(record, "fields", {}),
        }
        if record.exc_info:
            entry["traceback"] = self.formatException(record.exc_info)
        return json.dumps(entry, default=str)


def run_bridge(
    config: BridgeConfig,
    make_motors: Callable[[BridgeConfig], Motors],
    make_guardian: Callable[[BridgeConfig], Guardian],
    *,
    exit_with_parent: bool = False,
) -> str:
    """The whole life of `python -m robot_bridge`; returns why it ended. Raises StartError."""
    if not config.link:
        raise StartError(
            "bridge.link is missing: it is the line to the service (on a bench, use --direct)"
        )
    guardian = make_guardian(config) if config.guardian else None
    try:
        daemon = _start(config, make_motors, guardian, exit_with_parent)
    except BaseException:
        if guardian is not None:
            guardian.dismiss()
        raise
    for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
        signal.signal(number, lambda received, frame: daemon.leave(f"signal {received}"))
    log.info("ready", extra={"fields": {"boot_id": daemon.bridge.boot_id, "link": config.link}})
    daemon.run()
    return daemon.exit_reason or ""


def _start(
    config: BridgeConfig,
    make_motors: Callable[[BridgeConfig], Motors],
    guardian: Guardian | None,
    exit_with_parent: bool,
) -> Daemon:
    try:
        config.status_file.parent.mkdir(parents=True, exist_ok=True)
        journal = Journal(config.state_dir)
    except JournalError as error:
        raise StartError(str(error)) from error
    except OSError as error:
        raise StartError(f"{config.status_file}: cannot be written: {error.strerror}") from error
    motors = make_motors(config)
    try:
        motors.know_boards(journal.boards)
        motors.open()
        return Daemon(
            config,
            motors,
            journal,
            guardian=guardian,
            parent_fd=sys.stdin.fileno() if exit_with_parent else None,
        )
    except BaseException as error:
        _shielded("stop", motors.stop)
        _shielded("close_motors", motors.close)
        journal.close()
        if isinstance(error, MotorError | JournalError):
            raise StartError(str(error)) from error
        raise
