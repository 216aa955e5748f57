"""The API as a program sees it: a small typed client on httpx.

Every refusal is a `RefusedByServiceError` with the problem's code and text; a service that does not
answer is a `ServiceGoneError`. Orders carry an idempotency key, so one that is sent again because
its answer was lost is not carried out twice.
"""

from __future__ import annotations

import json
import ssl
import uuid
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Literal, TypeVar
from urllib.parse import quote

import httpx
from pydantic import BaseModel, TypeAdapter, ValidationError

from service.room.state import RoomState
from service.room.summaries import CaseSummary, KnownTarget, MeasurementBody
from service.web.schemas import (
    CaseBegun,
    EventBody,
    Health,
    ReachBody,
    SessionBody,
    SliceBody,
    Started,
)

_TIMEOUT_S = 35.0
_STOP_TIMEOUT_S = 2.0
_LONG_TIMEOUT_S = 600.0
_SILENT_S = 5.0
_UNAVAILABLE = 503
Model = TypeVar("Model", bound=BaseModel)


class ServiceGoneError(Exception):
    """The service does not answer; the text names its address and why."""


class RefusedByServiceError(Exception):
    """The service refused; `code` is for programs, the text says what to do."""

    def __init__(self, status: int, code: str, detail: str) -> None:
        super().__init__(detail)
        self.status = status
        self.code = code


@dataclass(frozen=True)
class LiveMessage:
    """One message of the event stream: `state`, `record` or `beat`; event_id of `record` only."""

    kind: str
    body: Mapping[str, Any]
    event_id: int | None = None


class RoomClient:
    """Talks to one service; use it as a context manager.

    url: as people type it, with the path prefix if a proxy has one. ca: PEM file of the authority
    that signed the service's certificate, where the system does not know it.
    """

    def __init__(
        self, url: str, *, token: str = "", by: str = "operator", ca: str | Path | None = None
    ) -> None:
        headers = {"Authorization": f"Bearer {token}"} if token else {}
        self.url = url
        self._by = by
        self._http = httpx.Client(
            base_url=url, headers=headers, timeout=_TIMEOUT_S, verify=_verification(ca)
        )

    def close(self) -> None:
        self._http.close()

    def __enter__(self) -> RoomClient:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        at: TracebackType | None,
    ) -> None:
        self.close()

    # Looking

    def state(self) -> RoomState:
        """What the room is doing now; ServiceGoneError while the service does not know it."""
        try:
            return self._get("/api/v1/state", RoomState)
        except RefusedByServiceError as error:
            if error.status == _UNAVAILABLE:
                raise ServiceGoneError(f"{self.url}: {error}") from error
            raise

    def session(self) -> SessionBody:
        """Who this client is to the service."""
        return self._get("/api/v1/session", SessionBody)

    def events(self, after: int = 0, limit: int = 1000, case: str | None = None) -> list[EventBody]:
        """What happened after an event id, oldest first; in a case by its folder's name."""
        of_case = {} if case is None else {"case": case}
        return self._list("/api/v1/events", EventBody, after=after, limit=limit, **of_case)

    def slices(
        self,
        after: int = 0,
        limit: int = 1000,
        state: Literal["assigned", "pending", "quarantined"] | None = None,
        *,
        newest: bool = False,
    ) -> list[SliceBody]:
        """One page of slices; `newest`: backwards from the newest (or from before `after`)."""
        wanted = {} if state is None else {"state": state}
        page = {"after": after, "limit": limit, "newest": newest}
        return self._list("/api/v1/slices", SliceBody, **page, **wanted)

    def slice(self, slice_id: int) -> SliceBody:
        return self._get(f"/api/v1/slices/{slice_id}", SliceBody)

    def measurements(self, after: int = 0, limit: int = 1000) -> list[MeasurementBody]:
        return self._list("/api/v1/measurements", MeasurementBody, after=after, limit=limit)

    def cases(self) -> list[CaseSummary]:
        """The case folders beside the present one, newest first."""
        return self._list("/api/v1/cases", CaseSummary)

    def health(self) -> Health:
        """Every part of the room; also where the service itself says that it is not well."""
        try:
            answer = self._http.get("/healthz")
            return Health.model_validate_json(answer.text)
        except httpx.TransportError as error:
            raise self._gone(error) from error
        except ValidationError:
            raise _refusal(answer) from None

    def metric(self, name: str) -> float:
        """One of the counters of /metrics that has no labels; KeyError if there is none."""
        for line in self._ask("GET", "/metrics").text.splitlines():
            said, _, value = line.partition(" ")
            if said == name:
                return float(value)
        raise KeyError(name)

    def report(self, case: str | None = None) -> str:
        """The report of a case (by the name of its folder; None: the present one) as HTML."""
        return self._ask("GET", "/api/v1/report", **_of_case(case)).text

    def export(self, case: str | None = None) -> bytes:
        """A case as one zip of DICOM, JSON lines and images."""
        return self._ask("GET", "/api/v1/export", **_of_case(case)).content

    def measurement_png(self, measurement_id: int, scale: int = 1) -> bytes:
        path = f"/api/v1/measurements/{measurement_id}/image.png"
        return self._ask("GET", path, params={"scale": scale}).content

    def slice_png(self, slice_id: int, scale: int = 1) -> bytes:
        path = f"/api/v1/slices/{slice_id}/image.png"
        return self._ask("GET", path, params={"scale": scale}).content

    def slice_dicom(self, slice_id: int) -> bytes:
        """The DICOM file, bit for bit as it was received."""
        return self._ask("GET", f"/api/v1/slices/{slice_id}/image.dcm").content

    def live(self, after: int = 0) -> Iterator[LiveMessage]:
        """Follow the event stream from an event id on; ServiceGoneError when it ends."""
        timeout = httpx.Timeout(_TIMEOUT_S, read=_SILENT_S)
        headers = {"Last-Event-ID": str(after)} if after else {}
        try:
            with self._http.stream(
                "GET", "/api/v1/events/live", headers=headers, timeout=timeout
            ) as stream:
                if stream.status_code != httpx.codes.OK:
                    stream.read()
                    raise _refusal(stream)
                yield from _messages(stream.iter_lines())
        except httpx.TransportError as error:
            raise self._gone(error) from error
        raise ServiceGoneError(f"{self.url}: the event stream ended")

    # Orders

    def stop(self, *, emergency: bool = False) -> None:
        """STOP. Returns when the service has put it onto the line."""
        body = {"by": self._by, "emergency": emergency}
        self._ask("POST", "/api/v1/stop", json=body, timeout=_STOP_TIMEOUT_S)

    def reset(self, positions_um: Mapping[str, int] | None = None) -> None:
        """Clear a latched stop, and arm.

        positions_um: where axes stand whose position is not certain; robot.taken_um of the state,
        or better.
        """
        self._order("POST", "/api/v1/reset", positions_um=dict(positions_um or {}) or None)

    def start_calibration(self, *, guide: bool | None = None) -> int:
        """guide: with both fiducials and four axes; None: as the room is configured."""
        return self._start("/api/v1/calibration", guide=guide)

    def set_target(
        self, patient_mm: Sequence[float], *, label: str = "", in_water: bool = False
    ) -> None:
        """Where the fiducial is to be, LPS mm; in_water: a place in tissue."""
        fields = {"patient_mm": list(patient_mm), "label": label, "in_water": in_water}
        self._order("PUT", "/api/v1/target", **fields)

    def reach(self, patient_mm: Sequence[float], *, in_water: bool = False) -> ReachBody:
        """Whether a point could be the target; nothing is changed."""
        fields = {"patient_mm": list(patient_mm), "in_water": in_water}
        answer = self._order("POST", "/api/v1/target/reach", **fields)
        return ReachBody.model_validate_json(answer.text)

    def withdraw_target(self) -> None:
        """There is no target any more until another one is set."""
        self._order("POST", "/api/v1/target/withdraw")

    def record_target(self, label: str = "") -> int:
        """The place where the fiducial is now becomes the target."""
        return self._start("/api/v1/target/here", label=label)

    def targets(self) -> list[KnownTarget]:
        """Every target of the case."""
        return self._list("/api/v1/targets", KnownTarget)

    def choose_target(self, number: int) -> None:
        self._order("POST", f"/api/v1/targets/{number}/choose")

    def take_proposal(self, number: int, *, in_water: bool, label: str = "") -> None:
        """Make what a planning station proposes the target; in_water: a place in tissue."""
        path = f"/api/v1/proposals/{number}/take"
        self._order("POST", path, in_water=in_water, label=label)

    def refuse_proposal(self, number: int, why: str = "") -> None:
        """Say no to what a planning station proposes; it is told why."""
        self._order("POST", f"/api/v1/proposals/{number}/refuse", why=why)

    def set_entry(self, patient_mm: Sequence[float]) -> None:
        self._order("PUT", "/api/v1/entry", patient_mm=list(patient_mm))

    def change_settings(
        self, *, strategy: str, tolerance_mm: float, confidence: float, most_slices: int
    ) -> None:
        """Of this case, from its next procedure on; `state().belief` says what may be set."""
        self._order(
            "PUT",
            "/api/v1/settings",
            strategy=strategy,
            tolerance_mm=tolerance_mm,
            confidence=confidence,
            most_slices=most_slices,
        )

    def start_approach(self, *, guide: bool | None = None) -> int:
        """guide: to the line from entry to target; None: as the room is configured."""
        return self._start("/api/v1/approach", guide=guide)

    def jog(self, axis: str, distance_um: int) -> int:
        return self._start("/api/v1/jog", axis=axis, distance_um=distance_um)

    def answer(self, question_id: str, choice: str, plan_id: str | None = None) -> None:
        self._order(
            "POST", "/api/v1/answer", question_id=question_id, choice=choice, plan_id=plan_id
        )

    def abort(self) -> None:
        self._order("POST", "/api/v1/abort")

    def record_puncture(self, insertion_depth_mm: float | None = None) -> None:
        self._order("POST", "/api/v1/puncture", insertion_depth_mm=insertion_depth_mm)

    def lock_motion(self) -> None:
        self._order("POST", "/api/v1/lock")

    def needle_out(self) -> None:
        self._order("POST", "/api/v1/needle-out")

    def compare_clocks(self, offset_s: float, uncertainty_s: float) -> None:
        """The room's clock minus the scanner's, compared just now."""
        self._order("PUT", "/api/v1/clock", offset_s=offset_s, uncertainty_s=uncertainty_s)

    def forget_clock(self, why: str = "") -> None:
        """The scanner's clock was set: slices wait until the clocks are compared."""
        self._order("POST", "/api/v1/clock/reset", why=why)

    def give_up_slices(self, hold_id: int, why: str = "") -> None:
        """No more slices will come of this hold."""
        self._order("POST", f"/api/v1/holds/{hold_id}/give-up", why=why)

    def begin_case(self, label: str = "", operator: str = "", note: str = "") -> str:
        """Return the name of the new case's folder."""
        answer = self._order("POST", "/api/v1/cases", label=label, operator=operator, note=note)
        return CaseBegun.model_validate_json(answer.text).folder

    def finish_case(self, *, park: bool = False) -> str:
        """Return the name of the finished case's folder. park: the drives as well."""
        answer = self._order("POST", "/api/v1/case/finish", park=park)
        return CaseBegun.model_validate_json(answer.text).folder

    def continue_case(self) -> None:
        """Go on with a case that was left open on another day."""
        self._order("POST", "/api/v1/case/continue")

    def reopen_case(self, folder: str) -> None:
        self._order("POST", f"/api/v1/cases/{quote(folder, safe='')}/reopen")

    def take_slices(self, study: str) -> None:
        """The slices of a study that wait in the holding area belong to the open case."""
        self._order("POST", "/api/v1/holding/take", study=study)

    def accept_frame_of_reference(self) -> None:
        """The table was moved: the new frame of reference counts from now on."""
        self._order("POST", "/api/v1/case/frame-of-reference")

    def describe_case(self, label: str, operator: str = "", note: str = "") -> None:
        self._order("PUT", "/api/v1/case", label=label, operator=operator, note=note)

    def confirm_acquisition(self, hold_id: int) -> None:
        """The slices of a hold were acquired (rooms in arrival mode)."""
        self._order("POST", "/api/v1/acquisition", hold_id=hold_id)

    def assign_slice(self, slice_id: int, hold_id: int | None, why: str = "") -> None:
        path = f"/api/v1/slices/{slice_id}/assignment"
        self._order("POST", path, hold_id=hold_id, why=why)

    # Inside

    def _start(self, path: str, **fields: Any) -> int:
        return Started.model_validate_json(self._order("POST", path, **fields).text).procedure_id

    def _order(self, method: str, path: str, **fields: Any) -> httpx.Response:
        key = {"Idempotency-Key": uuid.uuid4().hex}
        body = {"by": self._by, **fields}
        try:
            return self._ask(method, path, json=body, headers=key)
        except ServiceGoneError:
            return self._ask(method, path, json=body, headers=key)

    def _get(self, path: str, model: type[Model]) -> Model:
        return model.model_validate_json(self._ask("GET", path).text)

    def _list(self, path: str, model: type[Model], **params: Any) -> list[Model]:
        return TypeAdapter(list[model]).validate_json(  # type: ignore[valid-type]
            self._ask("GET", path, params=params).text
        )

    def _ask(self, method: str, path: str, **options: Any) -> httpx.Response:
        try:
            answer = self._http.request(method, path, **options)
        except httpx.TransportError as error:
            raise self._gone(error) from error
        if answer.is_error:
            raise _refusal(answer)
        return answer

    def _gone(self, error: httpx.TransportError) -> ServiceGoneError:
        return ServiceGoneError(f"{self.url}: {str(error) or type(error).__name__}")


def _verification(ca: str | Path | None) -> ssl.SSLContext | bool:
    """How to check the service's certificate; OSError that names the file if it cannot be read."""
    if ca is None:
        return True
    try:
        return ssl.create_default_context(cafile=str(ca))
    except OSError as error:  # ssl.SSLError is one
        raise OSError(f"{ca}: no certificate authority could be read from it ({error})") from error


def _of_case(case: str | None) -> dict[str, Any]:
    params = {} if case is None else {"case": case}
    return {"params": params, "timeout": _LONG_TIMEOUT_S}


def _refusal(answer: httpx.Response) -> RefusedByServiceError:
    try:
        problem = answer.json()
        return RefusedByServiceError(answer.status_code, problem["title"], problem["detail"])
    except (ValueError, KeyError, TypeError):
        return RefusedByServiceError(answer.status_code, "http_error", answer.reason_phrase)


def _messages(lines: Iterator[str]) -> Iterator[LiveMessage]:
    fields: dict[str, str] = {}
    for line in lines:
        if line:
            name, _, value = line.partition(":")
            fields[name] = value.removeprefix(" ")
        elif "event" in fields:
            event_id = int(fields["id"]) if "id" in fields else None
            yield LiveMessage(fields["event"], json.loads(fields["data"]), event_id)
            fields = {}
        else:
            fields = {}
