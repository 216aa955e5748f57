"""Orders to the robot itself: STOP, re-arm, jog."""

from __future__ import annotations

import asyncio
import time

from fastapi import APIRouter, Request, Response
from fastapi.responses import HTMLResponse, JSONResponse

from service.room.control import ControlLoop
from service.web.orders import REFUSALS, Caller, Key, Orders, who
from service.web.problems import responses
from service.web.schemas import JogBody, ResetBody, Started, StopAnswer, StopBody

STOP_WORDS = {
    "stopped": "Stopped.",
    "on_its_way": "STOP is on its way: the robot has not stopped yet.",
    "not_delivered": "STOP was NOT DELIVERED – USE THE STOP SWITCH at the robot.",
}
_STOP_PATIENCE_S, _STOP_LOOK_S = 0.7, 0.01
_STOP_EXAMPLE = {"by": "Olga", "emergency": False}


def stop_router(loop: ControlLoop) -> APIRouter:
    """STOP: handled in the server's own loop, behind no queue, with any body or none."""
    router = APIRouter(tags=["robot"])

    @router.post(
        "/api/v1/stop",
        status_code=202,
        response_model=StopAnswer,
        responses=responses(401, 413),
        openapi_extra={
            "requestBody": {
                "required": False,
                "description": "Optional: `by`, and `emergency` to park the drives as well. "
                "An unreadable body never holds back the STOP.",
                "content": {"application/json": {"schema": {}, "example": _STOP_EXAMPLE}},
            }
        },
    )
    async def stop(request: Request, caller: Caller) -> Response:
        """Stop the robot at once; latched until re-armed. Viewers may do this too.

        The answer says what became of it, within a second: `stopped`, `on_its_way` (the bridge has
        it, the robot has not stopped yet) or `not_delivered`: use the stop switch at the robot. The
        service goes on trying. Orders that were asked for before this answer are void.
        """
        body = _stop_body(await request.body())
        number = loop.stop(who(caller, body.by), emergency=body.emergency)
        try:
            outcome = await _outcome_of_stop(loop)
        finally:
            loop.stop_answered(number)
        if "text/html" in request.headers.get("accept", ""):
            return HTMLResponse(_stop_page(outcome), status_code=202)
        return JSONResponse({"outcome": outcome}, status_code=202)

    return router


async def _outcome_of_stop(loop: ControlLoop) -> str:
    """What became of a STOP that was just sent; waits a little for it to arrive."""
    until_s = time.monotonic() + _STOP_PATIENCE_S
    while (outcome := loop.stop_outcome()) != "stopped" and time.monotonic() < until_s:
        await asyncio.sleep(_STOP_LOOK_S)
    return outcome


def _stop_page(outcome: str) -> str:
    """For a browser in which the page's scripts do not run: its STOP button is a form."""
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8"><title>STOP</title></head>'
        f'<body><h1>{STOP_WORDS[outcome]}</h1><p><a href="/">Back to the page</a></p></body></html>'
    )


def _stop_body(text: bytes) -> StopBody:
    """What can be understood of the body; whatever it is, it does not keep the STOP back."""
    try:
        return StopBody.model_validate_json(text)
    except ValueError:
        return StopBody()


def robot_router(orders: Orders) -> APIRouter:
    """The robot itself, by hand."""
    router = APIRouter(prefix="/api/v1", tags=["robot"], responses=REFUSALS)

    @router.post("/reset", status_code=204)
    def reset(body: ResetBody, caller: Caller, key: Key = None) -> None:
        """Clear a latched stop, and arm.

        Where the robot's position is not certain (a bridge or controllers that were restarted), it
        is refused until `positions_um` says where the stages stand; the refusal, and robot.taken_um
        in the state, say where they are taken to stand, and from what.
        """
        orders.carry_out(caller, key, "reset", body)

    @router.post("/jog", status_code=202)
    def jog(body: JogBody, caller: Caller, key: Key = None) -> Started:
        """Move one axis by hand; only while no procedure runs and motion is not locked."""
        return Started(procedure_id=orders.carry_out(caller, key, "jog", body))

    return router
