"""Who operates the virtual scanner: reads off the service what is to be acquired, and does it."""

import contextlib
import threading
from collections.abc import Callable, Mapping
from dataclasses import asdict
from pathlib import Path

import httpx
from pydantic import ValidationError

from simulator.config import ScannerSettings, VirtualRoom, VirtualRoomError
from simulator.outbox import Delivery, Outbox
from simulator.scanner import AcquisitionRequest, Note, VirtualScanner
from simulator.truth_client import TruthError
from simulator.truth_file import TruthFile

TOKEN_VARIABLE = "AUTOSPINE_TOKEN"


def read_token(settings: ScannerSettings, environment: Mapping[str, str]) -> str:
    """The token for the service, or '' where none is needed; VirtualRoomError if not readable."""
    if environment.get(TOKEN_VARIABLE):
        return environment[TOKEN_VARIABLE].strip()
    if not settings.token_file:
        return ""
    try:
        token = Path(settings.token_file).read_text(encoding="ascii").strip()
    except (OSError, UnicodeDecodeError) as error:
        why = getattr(error, "strerror", None) or "not text"
        raise VirtualRoomError(
            f"virtual.scanner.token_file: {settings.token_file}: cannot be read ({why})"
        ) from None
    if not token:
        raise VirtualRoomError(f"virtual.scanner.token_file: {settings.token_file} is empty")
    return token


def read_request(http: httpx.Client, service_url: str) -> AcquisitionRequest | None:
    """What the service asks for now. Raises httpx.HTTPError or ValueError (not understood)."""
    answer = http.get(f"{service_url.rstrip('/')}/api/v1/state")
    answer.raise_for_status()
    state = answer.json()
    if not isinstance(state, dict) or "acquisition_request" not in state:
        raise ValueError("the state has no field 'acquisition_request'")
    if state["acquisition_request"] is None:
        return None
    try:
        wanted = {**state["acquisition_request"], "case_uid": state.get("case_uid", "")}
        return AcquisitionRequest.model_validate(wanted)
    except TypeError:
        raise ValueError("acquisition_request is not an object") from None
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        key = ".".join(str(part) for part in first["loc"])
        raise ValueError(f"acquisition_request.{key}: {first['msg']}") from None


def operate(
    room: VirtualRoom,
    stop: threading.Event,
    note: Note,
    ready: Callable[[], None] = lambda: None,
    token: str = "",
) -> None:
    """Play the scanner and its operator until `stop` is set; `ready` is called once it begins.

    token: of the service, where it asks for one.

    Raises VirtualRoomError if the room has no scanner or the truth file cannot be written.
    """
    if room.scanner is None:
        raise VirtualRoomError("virtual.scanner: missing table")
    settings = room.scanner
    with contextlib.closing(TruthFile(Path(settings.truth_file))) as truth:
        report = _reporter(truth, note)
        say = say_once_in_a_row(note)
        headers = {"Authorization": f"Bearer {token}"} if token else {}
        with (
            httpx.Client(timeout=2.0, trust_env=False, headers=headers) as http,
            Outbox(settings, report) as outbox,
        ):
            scanner = VirtualScanner(room, truth, outbox, say)
            ready()
            served: set[str] = set()
            while not stop.wait(settings.poll_s):
                try:
                    _operate_once(scanner, read_request(http, settings.service_url), served, stop)
                    say("")
                except TruthError as error:
                    say(str(error))
                except (httpx.HTTPError, httpx.InvalidURL, ValueError) as error:
                    say(f"{settings.service_url}: {error}")


def _operate_once(
    scanner: VirtualScanner,
    request: AcquisitionRequest | None,
    served: set[str],
    stop: threading.Event,
) -> None:
    if request is not None and request.request_id not in served:
        scanner.serve(request, stop)
        served.add(request.request_id)
    else:
        scanner.scan_if_moving(stop)
    scanner.release_held_back()


def _reporter(truth: TruthFile, note: Note) -> Callable[[Delivery], None]:
    def report(delivery: Delivery) -> None:
        truth.write("delivery", **asdict(delivery))
        if not delivery.sent:
            note(f"{delivery.sop_instance_uid} could not be delivered: {delivery.reason}")

    return report


def say_once_in_a_row(note: Note) -> Note:
    """The same line is said once, until something else has been said; '' says nothing."""
    last = ""

    def say(line: str) -> None:
        nonlocal last
        if line and line != last:
            note(line)
        last = line

    return say
