"""Orders: everything that changes something. Each names who asked, and is carried out once."""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import APIRouter, Depends, Header, Request, Response

from service.access import Identity
from service.bodies import (
    AnswerBody,
    Ask,
    AssignmentBody,
    CaseBody,
    ClockBody,
    HoldBody,
    JogBody,
    PointBody,
    ProcedureBody,
    PunctureBody,
    ReasonBody,
    Started,
    StopBody,
    TargetBody,
    TargetHereBody,
)
from service.control import ControlLoop
from service.once import Once
from service.problems import responses
from service.routes_record import Id

Key = Annotated[
    str | None,
    Header(
        alias="Idempotency-Key",
        min_length=1,
        max_length=128,
        description="A command sent again under the same key is not carried out again.",
    ),
]
_REFUSALS = responses(400, 401, 403, 409, 413, 422, 429, 503)
_WITH_ID = responses(400, 401, 403, 404, 409, 413, 422, 429, 503)


def identity_of(request: Request) -> Identity:
    """Who asks, as the gate found out."""
    identity: Identity = request.state.identity
    return identity


Caller = Annotated[Identity, Depends(identity_of)]


class Orders:
    """Hands orders to the control loop under the name of whoever is logged in."""

    def __init__(self, loop: ControlLoop) -> None:
        self._loop = loop
        self._once = Once()

    def carry_out(
        self, caller: Identity, key: str | None, name: str, body: Ask, **path: Any
    ) -> Any:
        """Carry out a command of the control loop; `body` and `path` are its arguments."""
        arguments = {**body.model_dump(), **path, "by": who(caller, body.by)}
        what = f"{name} {body.model_dump_json()} {path}"
        return self._once.carry_out(
            caller.name, key, what, lambda: self._loop.call(name, arguments)
        )


def who(caller: Identity, claimed: str) -> str:
    """The name that is recorded: a token's own name wins over what the body says."""
    return caller.name or claimed


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


def command_router(loop: ControlLoop) -> APIRouter:
    """Robot and procedure."""
    router = APIRouter()
    orders = Orders(loop)

    @router.post("/api/v1/reset", tags=["robot"], status_code=204, responses=_REFUSALS)
    def reset(body: Ask, caller: Caller, key: Key = None) -> None:
        """Clear a latched stop, take the positions as they stand, and arm.

        Controllers that count from zero again are taken to stand where they were last recorded.
        """
        orders.carry_out(caller, key, "reset", body)

    @router.post("/api/v1/jog", tags=["robot"], status_code=202, responses=_REFUSALS)
    def jog(body: JogBody, caller: Caller, key: Key = None) -> Started:
        """Move one axis by hand; only while no procedure runs and motion is not locked."""
        return Started(procedure_id=orders.carry_out(caller, key, "jog", body))

    @router.post("/api/v1/calibration", tags=["procedure"], status_code=202, responses=_REFUSALS)
    def calibration(body: ProcedureBody, caller: Caller, key: Key = None) -> Started:
        """Start the calibration."""
        return Started(procedure_id=orders.carry_out(caller, key, "start_calibration", body))

    @router.put("/api/v1/target", tags=["procedure"], status_code=204, responses=_REFUSALS)
    def target(body: TargetBody, caller: Caller, key: Key = None) -> None:
        """Set where the fiducial is to be, patient mm (LPS)."""
        orders.carry_out(caller, key, "set_target", body)

    @router.post(
        "/api/v1/target/withdraw", tags=["procedure"], status_code=204, responses=_REFUSALS
    )
    def withdraw_target(body: Ask, caller: Caller, key: Key = None) -> None:
        """Withdraw the target; nothing is approached until another one is set."""
        orders.carry_out(caller, key, "withdraw_target", body)

    @router.post("/api/v1/target/here", tags=["procedure"], status_code=202, responses=_REFUSALS)
    def target_here(body: TargetHereBody, caller: Caller, key: Key = None) -> Started:
        """Look as closely as the tolerance asks for: where the fiducial is becomes the target."""
        return Started(procedure_id=orders.carry_out(caller, key, "record_target", body))

    @router.post(
        "/api/v1/targets/{number}/choose", tags=["procedure"], status_code=204, responses=_REFUSALS
    )
    def choose_target(number: Id, body: Ask, caller: Caller, key: Key = None) -> None:
        """Take a target of this case again."""
        orders.carry_out(caller, key, "choose_target", body, number=number)

    @router.put("/api/v1/entry", tags=["procedure"], status_code=204, responses=_REFUSALS)
    def entry(body: PointBody, caller: Caller, key: Key = None) -> None:
        """Set the planned skin point, patient mm (LPS)."""
        orders.carry_out(caller, key, "set_entry", body)

    @router.post("/api/v1/approach", tags=["procedure"], status_code=202, responses=_REFUSALS)
    def approach(body: ProcedureBody, caller: Caller, key: Key = None) -> Started:
        """Start the approach to the target."""
        return Started(procedure_id=orders.carry_out(caller, key, "start_approach", body))

    @router.post("/api/v1/answer", tags=["procedure"], status_code=204, responses=_REFUSALS)
    def answer(body: AnswerBody, caller: Caller, key: Key = None) -> None:
        """Answer the open question, for instance CONFIRM MOVE; void if anything has changed."""
        orders.carry_out(caller, key, "answer", body)

    @router.post("/api/v1/abort", tags=["procedure"], status_code=204, responses=_REFUSALS)
    def abort(body: Ask, caller: Caller, key: Key = None) -> None:
        """End the running procedure; the robot stays where it is."""
        orders.carry_out(caller, key, "abort", body)

    @router.post("/api/v1/puncture", tags=["procedure"], status_code=204, responses=_REFUSALS)
    def puncture(body: PunctureBody, caller: Caller, key: Key = None) -> None:
        """Record the puncture."""
        orders.carry_out(caller, key, "puncture", body)

    @router.post("/api/v1/lock", tags=["procedure"], status_code=204, responses=_REFUSALS)
    def lock(body: Ask, caller: Caller, key: Key = None) -> None:
        """The needle is going in: lock motion by hand (READY locks it by itself)."""
        orders.carry_out(caller, key, "lock_motion", body)

    @router.post("/api/v1/needle-out", tags=["procedure"], status_code=204, responses=_REFUSALS)
    def needle_out(body: Ask, caller: Caller, key: Key = None) -> None:
        """The needle is out: unlock motion."""
        orders.carry_out(caller, key, "needle_out", body)

    return router


def clerk_router(loop: ControlLoop) -> APIRouter:
    """What the operator tells the record: clocks, case, slices."""
    router = APIRouter()
    orders = Orders(loop)

    @router.put("/api/v1/clock", tags=["record"], status_code=204, responses=_REFUSALS)
    def clock(body: ClockBody, caller: Caller, key: Key = None) -> None:
        """The two clocks were compared: slices are assigned by this from now on."""
        orders.carry_out(caller, key, "compare_clocks", body)

    @router.post("/api/v1/clock/reset", tags=["record"], status_code=204, responses=_REFUSALS)
    def clock_reset(body: ReasonBody, caller: Caller, key: Key = None) -> None:
        """Forget what was known of the scanner's clock, after it was set or an alarm said so.

        The next slice shows the clock anew, so it must come promptly: first let the scanner send
        what it still holds back. A comparison (PUT /api/v1/clock) is better where it can be made.
        """
        orders.carry_out(caller, key, "forget_clock", body)

    @router.put("/api/v1/case", tags=["record"], status_code=204, responses=_REFUSALS)
    def case(body: CaseBody, caller: Caller, key: Key = None) -> None:
        """Write down what the case is called, who operates, and a note."""
        orders.carry_out(caller, key, "describe_case", body)

    @router.post(
        "/api/v1/slices/{slice_id}/assignment",
        tags=["record"],
        status_code=204,
        responses=_WITH_ID,
    )
    def assignment(slice_id: Id, body: AssignmentBody, caller: Caller, key: Key = None) -> None:
        """Overrule the listener about one slice."""
        orders.carry_out(caller, key, "assign_slice", body, slice_id=slice_id)

    @router.post(
        "/api/v1/holds/{hold_id}/give-up", tags=["record"], status_code=204, responses=_WITH_ID
    )
    def give_up(hold_id: Id, body: ReasonBody, caller: Caller, key: Key = None) -> None:
        """No more slices will come of this hold: none was acquired that is still on its way.

        Without this, as many acquisitions as it lacks are set aside before one is believed again.
        """
        orders.carry_out(caller, key, "give_up_slices", body, hold_id=hold_id)

    @router.post("/api/v1/acquisition", tags=["procedure"], status_code=204, responses=_WITH_ID)
    def acquisition(body: HoldBody, caller: Caller, key: Key = None) -> None:
        """The slices of a hold were acquired (rooms where the operator confirms acquisitions)."""
        orders.carry_out(caller, key, "confirm_acquisition", body)

    return router
