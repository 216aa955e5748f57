"""`autospine service` and `autospine worker`: one process each."""

from __future__ import annotations

import os
import resource
import signal
import socket
import sys
import threading
from pathlib import Path
from typing import Annotated

import structlog
import typer
import uvicorn

from case_record.cases import Cases
from case_record.presence import Sole
from room_config.load import Config, ConfigError, load_config
from room_config.networks import with_mapped
from room_config.shell import announce, configure_logs, on_parent_gone
from service.cli.room_checks import LOOPBACK, open_to_others

ConfigOption = Annotated[Path, typer.Option("--config", help="The room's TOML file.")]
ParentOption = Annotated[
    bool, typer.Option("--exit-with-parent", help="Exit when standard input is closed.")
]
FAILED = 3
_LET_GO_S = 3.0
_SWITCH_INTERVAL_S = 0.0002


def service(config: ConfigOption, exit_with_parent: ParentOption = False) -> None:
    """Page, API, procedures and planning."""
    configure_logs()
    room = load_config(config)
    cases = Cases(*room.room.folders)
    with Sole(cases.home, "service"):
        _serve(room, cases, exit_with_parent)


def _serve(room: Config, cases: Cases, exit_with_parent: bool) -> None:
    from service.room.control import ControlLoop
    from service.slicer.server import OpenIgtLinkServer, bind_openigtlink
    from service.web.app import create_app
    from service.web.connections import PatientProtocol

    check_device(room.service.bridge_link)
    listening = bind(room)
    host, port = listening.getsockname()[:2]
    scheme = "http" if room.service.tls_certificate is None else "https"
    url = f"{scheme}://{f'[{host}]' if ':' in host else host}:{port}"
    ready: dict[str, object] = {"url": url}
    followers = bind_openigtlink(room.openigtlink)
    if followers is not None:
        ready["openigtlink"] = "{}:{}".format(*followers.getsockname()[:2])

    def scene(loop: ControlLoop) -> OpenIgtLinkServer:
        assert followers is not None
        return OpenIgtLinkServer(room, cases, loop, followers)

    failed = threading.Event()

    def end_failed() -> None:
        # ended, so that it is started again; by force if others do not let go of it in time
        failed.set()
        server.should_exit = True
        threading.Timer(_LET_GO_S, os._exit, (FAILED,)).start()

    app = create_app(
        room,
        announce=lambda: announce(ready),
        scene=None if followers is None else scene,
        on_failure=end_failed,
    )
    most_files = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
    resource.setrlimit(resource.RLIMIT_NOFILE, (most_files, most_files))
    # the control loop must not wait long for the interpreter while a page is being served
    sys.setswitchinterval(_SWITCH_INTERVAL_S)
    server = uvicorn.Server(
        uvicorn.Config(
            app,
            http=PatientProtocol,
            log_level="warning",
            access_log=False,
            server_header=False,
            timeout_graceful_shutdown=1,
            proxy_headers=True,
            forwarded_allow_ips=with_mapped(room.service.trusted_proxies),
            ssl_certfile=room.service.tls_certificate,
            ssl_keyfile=room.service.tls_key,
        )
    )
    _check_tls(server)
    if exit_with_parent:
        on_parent_gone(lambda: setattr(server, "should_exit", True))
    server.run(sockets=[listening])
    if failed.is_set():
        os._exit(FAILED)


def _check_tls(server: uvicorn.Server) -> None:
    """ConfigError instead of a traceback where certificate or key cannot be used."""
    try:
        server.config.load()
    except OSError as error:  # ssl.SSLError is one
        raise ConfigError(f"service.tls_certificate, service.tls_key: {error}") from None


def worker(config: ConfigOption, exit_with_parent: ParentOption = False) -> None:
    """Localize and reconstruct."""
    from sr_engine.worker import serve

    configure_logs()
    room = load_config(config)
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    if exit_with_parent:
        on_parent_gone(stop.set)
    announce({})
    serve(room, stop.is_set)


def bind(room: Config) -> socket.socket:
    """Return the listening socket of the page; ConfigError if that cannot be."""
    host, port = room.service.host, room.service.port
    if refused := list(open_to_others(room)):
        raise ConfigError(refused[0])
    listening = socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET)
    listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    if host not in LOOPBACK and room.service.tls_certificate is None:
        structlog.get_logger().warning("tokens are sent unencrypted: set service.tls_certificate")
    try:
        listening.bind((host, port))
        # now, not when uvicorn comes to it: who reads the ready line may connect at once
        listening.listen()
    except OSError as error:
        listening.close()
        raise ConfigError(f"service port {host}:{port}: {error.strerror}") from None
    return listening


def check_device(link: str) -> None:
    """ConfigError if the line to the bridge is a device that does not exist."""
    if "://" not in link and not Path(link).exists():
        raise ConfigError(f"key service.bridge_link: no device {link}")
