"""DICOM outputs of the case, and how far they are on their way to their destinations."""

from __future__ import annotations

import sys
import threading
from pathlib import Path
from typing import Annotated, Any, Literal

from fastapi import APIRouter, Query
from fastapi.responses import FileResponse
from pydantic import BaseModel

from room_config.load import Config
from service.dicom_out.content import (
    finding_of_arrival,
    finding_of_measurement,
    finding_of_puncture,
)
from service.dicom_out.make import FOLDER, Kind, Output
from service.dicom_out.outbox_store import FILE_NAME, STATES, OutboxStore, State
from service.room.images import ImageMissingError
from service.web.of_case import AskedCase, OfCase
from service.web.own_process import run_elsewhere
from service.web.pagination import ERRORS, Id
from service.web.problems import ProblemError, responses

_PATIENCE_S = 180.0
_TURN_S = 20.0
_DICOM: dict[int | str, dict[str, Any]] = {
    **responses(401, 404, 409, 422, 429, 503),
    200: {
        "description": "The DICOM object",
        "content": {"application/dicom": {"schema": {"type": "string", "format": "binary"}}},
    },
}
_FIND = {
    "measurement": finding_of_measurement,
    "approach": finding_of_arrival,
    "puncture": finding_of_puncture,
}


class DestinationBody(BaseModel):
    """A destination; failing_since_s null: it answered when it was last tried, or was not tried."""

    name: str
    host: str
    port: int
    ae_title: str
    kinds: list[Kind]
    failing_since_s: float | None
    reason: str
    last_sent_s: float | None
    counts: dict[State, int]


class DeliveryBody(BaseModel):
    """One output on its way to one destination."""

    name: str
    kind: Kind
    sop_instance_uid: str
    destination: str
    state: State
    attempts: int
    reason: str
    changed_s: float


class OutboxBody(BaseModel):
    destinations: list[DestinationBody]
    deliveries: list[DeliveryBody]


def outbox_router(config: Config) -> APIRouter:
    router = APIRouter(tags=["outputs"])

    @router.get("/api/v1/outbox", responses=ERRORS)
    def outbox(
        case: OfCase,
        state: Annotated[State | None, Query(description="Only deliveries in this state.")] = None,
        limit: Annotated[int, Query(ge=1, le=1000)] = 200,
    ) -> OutboxBody:
        """Every destination and what became of the outputs there, the newest first."""
        return _outbox(config, case, state, limit)

    return router


def _outbox(config: Config, case: AskedCase, state: State | None, limit: int) -> OutboxBody:
    lines, counts, deliveries = {}, {}, []
    if (case.folder / FOLDER / FILE_NAME).is_file():
        with OutboxStore(case.folder) as store:
            lines, counts = store.lines(), store.counts()
            deliveries = [DeliveryBody(**vars(one)) for one in store.deliveries(limit, state)]
    destinations = []
    for one in config.outputs.destination:
        line = lines.get(one.name)
        destinations.append(
            DestinationBody(
                name=one.name,
                host=one.host,
                port=one.port,
                ae_title=one.ae_title,
                kinds=list(one.kinds),
                failing_since_s=line.failing_since_s if line else None,
                reason=line.reason if line else "",
                last_sent_s=line.last_sent_s if line else None,
                counts={state: counts.get((one.name, state), 0) for state in STATES},
            )
        )
    return OutboxBody(destinations=destinations, deliveries=deliveries)


def output_router() -> APIRouter:
    router = APIRouter(tags=["outputs"])
    desk = _Desk()

    @router.get(
        "/api/v1/measurements/{measurement_id}/{kind}.dcm",
        response_class=FileResponse,
        responses=_DICOM,
    )
    def of_measurement(
        measurement_id: Id, kind: Literal["image", "report", "presentation"], case: OfCase
    ) -> FileResponse:
        """Derived MR image, measurement report (SR), or presentation state of a measurement."""
        return desk.hand_out(case, Output("measurement", measurement_id, kind))

    @router.get(
        "/api/v1/approaches/{procedure_id}/{kind}.dcm",
        response_class=FileResponse,
        responses=_DICOM,
    )
    def of_approach(
        procedure_id: Id, kind: Literal["report", "presentation"], case: OfCase
    ) -> FileResponse:
        """Measurement report or presentation state of the READY at the end of an approach."""
        return desk.hand_out(case, Output("approach", procedure_id, kind))

    @router.get(
        "/api/v1/punctures/{event_id}/{kind}.dcm", response_class=FileResponse, responses=_DICOM
    )
    def of_puncture(
        event_id: Id, kind: Literal["report", "presentation"], case: OfCase
    ) -> FileResponse:
        """Measurement report or presentation state of a puncture, by the id of its event."""
        return desk.hand_out(case, Output("puncture", event_id, kind))

    return router


class _Desk:
    """Hands out outputs; those that were not made yet are made one at a time, elsewhere."""

    def __init__(self) -> None:
        self._turn = threading.Lock()

    def hand_out(self, case: AskedCase, output: Output) -> FileResponse:
        path = output.path(case.folder)
        if not self._is_there(case, output, path):
            self._make(case, output)
        return FileResponse(
            path,
            media_type="application/dicom",
            filename=path.name,
            headers={"Cache-Control": "private, no-cache"},
        )

    def _is_there(self, case: AskedCase, output: Output, path: Path) -> bool:
        """CaseRecordError or ImageMissingError (404) before a process is started for nothing."""
        with case.record() as record:
            if path.is_file() and record.is_sealed(f"{path.parent.name}/{path.name}"):
                return True
            found = _FIND[output.subject](record, output.number)
        if output.kind == "image" and not found.result.get("reconstruction"):
            raise ImageMissingError(f"measurement {output.number} has no reconstruction")
        return False

    def _make(self, case: AskedCase, output: Output) -> None:
        if not self._turn.acquire(timeout=_TURN_S):
            text = "Other DICOM objects are being made: try again in a few seconds."
            raise ProblemError(429, "busy", text, {"Retry-After": "5"})
        try:
            _made_elsewhere(case, output)
        finally:
            self._turn.release()


def _made_elsewhere(case: AskedCase, output: Output) -> None:
    """highdicom takes its time to load."""
    words = [sys.executable, "-m", "service.dicom_out.make", str(case.folder), output.name]
    failure = run_elsewhere(words, output.name, _PATIENCE_S)
    if failure is not None:
        raise ProblemError(409, "no_output", f"{output.name} cannot be made: {failure}")
