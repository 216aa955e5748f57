"""Orders to the robot itself: STOP, re-arm, jog."""

from __future__ import annotations

from fastapi import APIRouter, Request, Response

from service.room.control import ControlLoop
from service.web.orders import REFUSALS, Caller, Key, Orders, who
from service.web.problems import responses
from service.web.schemas import Ask, JogBody, Started, StopBody

_STOP_EXAMPLE = {"by": "Olga", "emergency": False}


def stop_router(loop: ControlLoop) -> APIRouter:
    """STOP: handled in the server's own loop, behind no queue, with any body or none."""
    router = APIRouter(tags=["robot"])

    @router.post(
        "/api/v1/stop",
        status_code=202,
        response_class=Response,
        responses=responses(401, 413),
        openapi_extra={
            "requestBody": {
                "required": False,
                "description": "Optional: `by`, and `emergency` to park the drives as well. "
                "Whatever cannot be understood does not keep the STOP back.",
                "content": {"application/json": {"schema": {}, "example": _STOP_EXAMPLE}},
            }
        },
    )
    async def stop(request: Request, caller: Caller) -> Response:
        """Stop the robot at once; latched until re-armed. Viewers may do this too."""
        body = _stop_body(await request.body())
        loop.stop(who(caller, body.by), emergency=body.emergency)
        return Response(status_code=202)

    return router


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
    def reset(body: Ask, caller: Caller, key: Key = None) -> None:
        """Clear a latched stop, take the positions as they stand, and arm.

        Controllers that count from zero again are taken to stand where they were last recorded.
        """
        orders.carry_out(caller, key, "reset", body)

    @router.post("/jog", status_code=202)
    def jog(body: JogBody, caller: Caller, key: Key = None) -> Started:
        """Move one axis by hand; only while no procedure runs and motion is not locked."""
        return Started(procedure_id=orders.carry_out(caller, key, "jog", body))

    return router
