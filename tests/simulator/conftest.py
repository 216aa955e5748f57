"""Fixtures: the neighbours of a virtual scanner, and the scanner itself in a thread."""

import json
import socketserver
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest
from neighbours import Page, Receiver, Running, Stages, Start

from simulator.config import parse_virtual_room
from simulator.scan_operator import operate


@pytest.fixture
def stages() -> Iterator[Stages]:
    truth = Stages()

    class Handler(socketserver.StreamRequestHandler):
        def handle(self) -> None:
            for line in self.rfile:
                answer = truth.answer(line.decode().strip())
                self.wfile.write(json.dumps(answer).encode() + b"\n")

    with socketserver.ThreadingTCPServer(("127.0.0.1", 0), Handler) as server:
        server.daemon_threads = True
        truth.port = server.server_address[1]
        yield from _serving(server, truth)


@pytest.fixture
def page() -> Iterator[Page]:
    page = Page()

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            found = self.path == "/api/v1/state"
            body = json.dumps(page.state).encode()
            self.send_response(page.status if found else 404)
            self.send_header("Content-Type", "application/json")
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)
            page.answered += 1

        def log_message(self, format: str, *args: Any) -> None:
            pass

    with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        page.url = f"http://127.0.0.1:{server.server_address[1]}"
        yield from _serving(server, page)


def _serving(server: socketserver.BaseServer, value: Any) -> Iterator[Any]:
    thread = threading.Thread(target=server.serve_forever, args=(0.02,), daemon=True)
    thread.start()
    try:
        yield value
    finally:
        server.shutdown()
        thread.join()


@pytest.fixture(scope="session")
def _receiver() -> Iterator[Receiver]:
    receiver = Receiver()
    server = receiver.start()
    yield receiver
    server.shutdown()


@pytest.fixture
def receiver(_receiver: Receiver) -> Receiver:
    """One server for the whole session (its shutdown takes half a second), emptied each time."""
    for kept in (_receiver.arrived, _receiver.arrived_at_s, _receiver.statuses):
        kept.clear()
    return _receiver


@pytest.fixture
def start(tmp_path: Path, stages: Stages, page: Page, receiver: Receiver) -> Iterator[Start]:
    stop, threads = threading.Event(), []

    def start(scanner: dict[str, Any] | None = None, **room: Any) -> Running:
        table = {
            "service_url": page.url,
            "listener_port": receiver.port,
            "motors_truth_port": stages.port,
            "truth_file": str(tmp_path / "truth.jsonl"),
            "acquisition_s": 0.05,
            "reconstruction_s": 0.03,
            "poll_s": 0.01,
            "retry_s": 0.1,
            **(scanner or {}),
        }
        running = Running(parse_virtual_room({**room, "scanner": table}))
        thread = threading.Thread(target=operate, args=(running.room, stop, running.notes.append))
        thread.start()
        threads.append(thread)
        return running

    yield start
    stop.set()
    for thread in threads:
        thread.join(timeout=60)
        assert not thread.is_alive(), "the scanner stops when it is told to"
