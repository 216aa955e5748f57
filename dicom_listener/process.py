"""The listener's process: wires service, inbox, intake and metrics; runs until told to stop."""

import sqlite3
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from queue import Empty, SimpleQueue
from zoneinfo import ZoneInfo, ZoneInfoNotFoundError

import structlog

from case_record.attempts import MOST_DEATHS, Attempts
from case_record.cases import Cases
from case_record.holding import FOLDER as HOLDING
from case_record.presence import Presence, Sole
from case_record.record import CaseRecord, CaseRecordError
from dicom_listener.assign import AssignRules
from dicom_listener.clock_offset import ClockRules, Comparison
from dicom_listener.holding_area import INBOX
from dicom_listener.inbox import Inbox
from dicom_listener.intake import IntakeRules
from dicom_listener.metrics import ListenerMetrics
from dicom_listener.network.commitment import Commitment, KeptInstances
from dicom_listener.network.drop_folder import DropFolder
from dicom_listener.promptness import Promptness
from dicom_listener.reception import Reception
from dicom_listener.retention import remove_old
from dicom_listener.scp import Scp, ScpRules, tls_context
from dicom_slice.eligibility import SliceRules
from room_config.listener import ListenerConfig
from room_config.load import Config, ConfigError

_POLL_S = 0.02
_TAKING_S = 0.5
_DISK_S = 10.0
_REMOVAL_S = 600.0  # it reads every row
_RECORD_RETRY_S = 1.0
_MIB = 2**20

log = structlog.get_logger("listener")


@dataclass(frozen=True)
class Ready:
    """What a supervisor wants to know: the ports that were bound."""

    port: int
    metrics_port: int | None
    ae_title: str


class ListeningEndedError(RuntimeError):
    """Nothing is received any more: the process ends, so that it is started again."""


class PortError(ConfigError):
    """The port cannot be bound: most often another process has it."""


def inbox_folder(home: Path) -> Path:
    return home / INBOX


def scp_rules(config: ListenerConfig) -> ScpRules:
    return ScpRules(
        host=config.host,
        port=config.port,
        ae_title=config.ae_title,
        require_called_ae_title=config.require_called_ae_title,
        calling_ae_titles=config.calling_ae_titles,
        peer_networks=config.peer_networks,
        any_storage_class=config.any_storage_class,
        max_associations=config.max_associations,
        acse_timeout_s=config.acse_timeout_s,
        dimse_timeout_s=config.dimse_timeout_s,
        network_timeout_s=config.network_timeout_s,
        max_object_bytes=config.max_object_mib * _MIB,
    )


def intake_rules(config: Config) -> IntakeRules:
    listener = config.listener
    return IntakeRules(
        slices=SliceRules(
            coronal_tolerance_deg=config.imaging.coronal_tolerance_deg,
            allow_derived=listener.allow_derived,
            allow_camera=listener.camera_slices,
            distortion_corrected=config.imaging.distortion_corrected,
        ),
        assign=AssignRules(
            guard_s=listener.guard_s,
            late_limit_s=listener.late_limit_s,
            arrival_mode=listener.arrival_mode,
        ),
        clock=ClockRules(
            promptness=_promptness(listener),
            longest_acquisition_s=listener.longest_acquisition_s,
            late_limit_s=listener.late_limit_s,
            unseen_steps=listener.clock_may_be_set,
            comparison_valid_s=60 * listener.comparison_valid_min,
        ),
        zone=_zone(listener.scanner_time_zone),
        comparison=_comparison(listener),
    )


def _promptness(listener: ListenerConfig) -> Promptness | None:
    if listener.prompt_delay_s is None:
        return None
    return Promptness(listener.least_delay_s, listener.prompt_delay_s)


def _comparison(listener: ListenerConfig) -> Comparison | None:
    """As the room's file states it, made when the file says (`load_config` sees to that)."""
    if listener.clock_offset_s is None or listener.clock_compared_at is None:
        return None
    return Comparison(
        listener.clock_offset_s,
        listener.clock_uncertainty_s,
        listener.clock_compared_at.timestamp(),
    )


def _zone(name: str) -> ZoneInfo | None:
    if not name:
        return None
    try:
        return ZoneInfo(name)
    except (ZoneInfoNotFoundError, ValueError):
        raise ConfigError(f"listener.scanner_time_zone: unknown time zone {name!r}") from None


def open_scp(
    config: ListenerConfig,
    inbox: Inbox,
    metrics: ListenerMetrics,
    on_stored: Callable[[Path], None],
    commitment: Commitment | None = None,
) -> Scp:
    """The service, bound to its port. Raises ConfigError where port, list or key is no good."""
    tls = None
    if config.tls_certificate and config.tls_key and config.tls_authority:
        try:
            tls = tls_context(config.tls_certificate, config.tls_key, config.tls_authority)
        except OSError as error:
            raise ConfigError(f"listener.tls_*: certificates cannot be used ({error})") from None
    try:
        return Scp(scp_rules(config), inbox, metrics, on_stored, tls, commitment)
    except ValueError as error:
        raise ConfigError(f"listener: {error}") from None
    except OSError as error:
        where = f"{config.host}:{config.port}"
        raise PortError(f"listener.port: cannot listen on {where} ({error.strerror})") from None


def _commitment(config: ListenerConfig, cases: Cases) -> Commitment | None:
    """None where files are removed after a while: what is not kept is not promised."""
    if config.retention_days:
        return None

    def folders() -> list[Path]:
        home = inbox_folder(cases.home)
        inboxes = [inbox_folder(folder) for folder in cases.folders()]
        return [home, cases.home / HOLDING, *(one for one in inboxes if one != home)]

    places = {
        title: (place.rpartition(":")[0], int(place.rpartition(":")[2]))
        for title, place in config.commitment_reports_to.items()
    }
    return Commitment(KeptInstances(folders), config.ae_title, places)


def run(config: Config, stop: threading.Event, on_ready: Callable[[Ready], None]) -> None:
    """Serve until `stop` is set. Raises ConfigError and CaseRecordError before it is ready."""
    received: SimpleQueue[Path] = SimpleQueue()
    metrics = ListenerMetrics()
    with ExitStack() as stack:
        cases = Cases(*config.room.folders)
        stack.enter_context(Sole(cases.home, "listener"))
        if cases.only is not None:
            CaseRecord(cases.only, create=True).close()
        inbox = Inbox(
            inbox_folder(cases.home),
            min_free_bytes=config.listener.min_free_mib * _MIB,
        )
        rules = intake_rules(config)
        commitment = _commitment(config.listener, cases)
        scp = open_scp(config.listener, inbox, metrics, received.put, commitment)
        stack.callback(scp.stop)
        discarded = inbox.discard_unfinished()
        metrics.show("associations_open", "Open associations", lambda: scp.open_associations)
        metrics.show("inbox_waiting", "Files not yet in the record", received.qsize)
        metrics.show("disk_free_bytes", "Free disk below the inbox", inbox.free_bytes)
        metrics_port = None
        if config.listener.metrics_port is not None:
            metrics_port, stop_metrics = metrics.serve(config.listener.metrics_port)
            stack.callback(stop_metrics)
        scp.start()
        ways_in: list[Scp | DropFolder] = [scp]
        if config.listener.watch_dir is not None:
            drop_folder = DropFolder(
                config.listener.watch_dir,
                cases.home / "watch_dir.taken",
                inbox,
                received.put,
                max_object_bytes=config.listener.max_object_mib * _MIB,
            )
            stack.callback(drop_folder.stop)
            drop_folder.start()
            ways_in.append(drop_folder)
        on_ready(Ready(scp.port, metrics_port, config.listener.ae_title))
        # Receiving needs no memory of the case: a long record must not keep a scanner waiting.
        reception = Reception(cases, inbox, rules, metrics)
        stack.callback(reception.close)
        reception.follow()
        if discarded:
            text = f"{discarded} unanswered files from an earlier run"
            reception.alarm("unfinished_files", text)
        log.info("serving", port=scp.port, left_over=_requeue(reception, received))
        presence = stack.enter_context(Presence(cases.home, "listener"))
        retention_s = config.listener.retention_days * 86400
        tending = Tending(inbox, reception, retention_s)
        attempts = stack.enter_context(Attempts(cases.home, "listener"))
        _loop(reception, scp, ways_in, tending, received, stop, presence, attempts)


def _loop(
    reception: Reception,
    scp: Scp,
    ways_in: Sequence[Scp | DropFolder],
    tending: "Tending",
    received: "SimpleQueue[Path]",
    stop: threading.Event,
    presence: Presence,
    attempts: Attempts,
) -> None:
    while not stop.is_set():
        presence.beat()
        if not scp.is_listening:
            raise ListeningEndedError("the listening thread has ended")
        try:
            if reception.follow():
                _requeue(reception, received)
            _take_received(reception, received, attempts, presence)
            reception.turn()
            for way_in in ways_in:
                while way_in.alarms:
                    reception.note_alarm(*way_in.alarms.popleft())
            tending.turn()
        except (CaseRecordError, sqlite3.Error, OSError) as error:
            # The slices are safe in the inbox: tried again until the record can be written.
            log.error("the case record cannot be written", error=str(error))
            stop.wait(_RECORD_RETRY_S)
            _requeue(reception, received)
        except Exception:  # receiving and storing go on, whatever the rest of the loop meets
            log.exception("the listener's loop")
            stop.wait(_RECORD_RETRY_S)


class Tending:
    """What is looked after now and then, in the listener's own loop: disk and retention."""

    def __init__(self, inbox: Inbox, reception: Reception, retention_s: float) -> None:
        self._inbox, self._reception = inbox, reception
        self._retention_s = retention_s
        self._disk_at_s = self._removal_at_s = 0.0
        self._was_low = False

    def turn(self) -> None:
        now_s = time.monotonic()
        if now_s >= self._disk_at_s:
            self._disk_at_s = now_s + _DISK_S
            self._look_at_disk()
        if now_s >= self._removal_at_s:
            self._removal_at_s = now_s + _REMOVAL_S
            if self._reception.record is not None:
                remove_old(self._reception.record, self._retention_s, time.time())

    def _look_at_disk(self) -> None:
        """Alarm, once, before the disk is so full that slices are refused."""
        free_bytes = self._inbox.free_bytes()
        is_low = free_bytes < 2 * self._inbox.min_free_bytes
        if is_low and not self._was_low:
            self._reception.alarm("disk_low", f"{free_bytes // _MIB} MiB free")
        self._was_low = is_low


def _requeue(reception: Reception, received: "SimpleQueue[Path]") -> int:
    """What has not found its place yet, anew; return how many they are."""
    left_over = reception.left_over()
    for path in left_over:
        received.put(path)
    return len(left_over)


def _take_received(
    reception: Reception, received: "SimpleQueue[Path]", attempts: Attempts, presence: Presence
) -> None:
    """Wait for at most one poll, then take what is there; a flood does not stop the loop."""
    until_s = time.monotonic() + _TAKING_S
    try:
        path = received.get(timeout=_POLL_S)
        while True:
            _take(reception, path, attempts)
            presence.beat()
            if time.monotonic() > until_s:
                return
            path = received.get_nowait()
    except Empty:
        return


def _take(reception: Reception, path: Path, attempts: Attempts) -> None:
    """One file; one over which the listener was killed again and again is not read any more."""
    deaths = attempts.deaths(path.name)
    if deaths >= MOST_DEATHS:
        reception.set_aside(path, f"the listener ended {deaths} times while it read this file")
        attempts.forget(path.name)
        return
    with attempts.at(path.name):
        reception.take(path)
