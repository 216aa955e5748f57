"""`autospine listener --check`: try once, on this machine, what a procedure will rely on."""

import os
import tempfile
import time
from contextlib import ExitStack
from pathlib import Path

from pynetdicom import AE

from case_record.cases import Cases
from dicom_listener.association_fix import mended
from dicom_listener.inbox import Envelope, Inbox, is_whole, sha256_of
from dicom_listener.metrics import ListenerMetrics
from dicom_listener.negotiation import VERIFICATION
from dicom_listener.process import PortError, inbox_folder, intake_rules, open_scp
from room_config.load import Config

_MIB = 2**20
_CLOCK_AGREES_S = 0.05

Result = tuple[str, bool, str]


def self_check(config: Config) -> list[Result]:
    """Return (what, passed, in words). Raises ConfigError where the configuration is no good."""
    intake_rules(config)
    folder = inbox_folder(Cases(*config.room.folders).home)
    return [_disk(config, folder), _write(folder), _clock(), _echo(config)]


def _disk(config: Config, folder: Path) -> Result:
    there = next(path for path in (folder, *folder.parents) if path.exists())
    free_mib = os.statvfs(there).f_bavail * os.statvfs(there).f_frsize // _MIB
    wanted_mib = 2 * config.listener.min_free_mib
    return "disk", free_mib >= wanted_mib, f"{free_mib} MiB free, alarm below {wanted_mib} MiB"


def _write(folder: Path) -> Result:
    """Store and read back a data set beside the inbox, with the inbox's own code."""
    data_set = os.urandom(100_000)
    envelope = Envelope("CHECK", "CHECK", "127.0.0.1", 0, 0.0, 0.0, "", "", "", "", len(data_set))
    envelope = Envelope(**{**vars(envelope), "sha256": sha256_of(data_set)})
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=folder, prefix=".check-") as place:
            inbox = Inbox(Path(place))
            began_s = time.perf_counter()
            path = inbox.store(data_set, envelope)
            took_ms = (time.perf_counter() - began_s) * 1e3
            whole = is_whole(path)
    except OSError as error:
        return "write", False, f"{folder}: {error}"
    return "write", whole, f"100 kB durable in {took_ms:.1f} ms"


def _clock() -> Result:
    """The wall clock must run as the monotonic one does: a step means that it is being set."""
    wall_s, monotonic_s = time.time(), time.monotonic()
    time.sleep(0.2)
    step_s = (time.time() - wall_s) - (time.monotonic() - monotonic_s)
    zone = time.strftime("%Z %z")
    return "clock", abs(step_s) < _CLOCK_AGREES_S, f"steady to {abs(step_s) * 1e3:.1f} ms ({zone})"


def _echo(config: Config) -> Result:
    """Serve on the configured port and send ourselves a C-ECHO; or to the listener that runs."""
    with tempfile.TemporaryDirectory() as place, ExitStack() as stack:
        inbox = Inbox(Path(place))
        who = ""
        try:
            scp = open_scp(config.listener, inbox, ListenerMetrics(), lambda path: None)
        except PortError:
            port, who = config.listener.port, "by the process that has the port: "
        else:
            scp.start()
            stack.callback(scp.stop)
            port = scp.port
        if config.listener.tls_certificate is not None:
            state = "is in use" if who else "is free"
            return "echo", True, f"port {port} {state} (TLS: not tried from here)"
        return _echo_to(config, port, who)


def _echo_to(config: Config, port: int, who: str) -> Result:
    titles = config.listener.calling_ae_titles
    ae = AE(titles[0] if titles else "CHECK")
    ae.add_requested_context(VERIFICATION)
    host = {"0.0.0.0": "127.0.0.1", "::": "::1"}.get(config.listener.host, config.listener.host)
    association = mended(ae.associate(host, port, ae_title=config.listener.ae_title))
    if not association.is_established:
        return "echo", False, f"{who}no association on port {port}"
    status = association.send_c_echo()
    association.release()
    return "echo", status.get("Status") == 0, f"{who}C-ECHO answered on port {port}"
