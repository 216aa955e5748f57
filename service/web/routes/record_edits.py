"""What the operator tells the record: clocks, case, slices. Nothing moves by it."""

from __future__ import annotations

from fastapi import APIRouter

from service.web.orders import REFUSALS, REFUSALS_WITH_ID, Caller, Key, Orders
from service.web.pagination import Id
from service.web.schemas import AssignmentBody, CaseBody, ClockBody, ReasonBody


def clerk_router(orders: Orders) -> APIRouter:
    """Decisions and remarks of the operator."""
    router = APIRouter(prefix="/api/v1", tags=["record"], responses=REFUSALS)

    @router.put("/clock", status_code=204)
    def clock(body: ClockBody, caller: Caller, key: Key = None) -> None:
        """The two clocks were compared: slices are assigned by this from now on."""
        orders.carry_out(caller, key, "compare_clocks", body)

    @router.post("/clock/reset", status_code=204)
    def clock_reset(body: ReasonBody, caller: Caller, key: Key = None) -> None:
        """Forget what was known of the scanner's clock, after it was set or an alarm said so.

        Slices wait until the clocks are compared (PUT /api/v1/clock), and what comes soon after may
        have been acquired before: let the scanner send first what it still holds back.
        """
        orders.carry_out(caller, key, "forget_clock", body)

    @router.put("/case", status_code=204)
    def case(body: CaseBody, caller: Caller, key: Key = None) -> None:
        """Write down what the case is called, who operates, and a note."""
        orders.carry_out(caller, key, "describe_case", body)

    @router.post("/slices/{slice_id}/assignment", status_code=204, responses=REFUSALS_WITH_ID)
    def assignment(slice_id: Id, body: AssignmentBody, caller: Caller, key: Key = None) -> None:
        """Overrule the listener about one slice."""
        orders.carry_out(caller, key, "assign_slice", body, slice_id=slice_id)

    @router.post("/holds/{hold_id}/give-up", status_code=204, responses=REFUSALS_WITH_ID)
    def give_up(hold_id: Id, body: ReasonBody, caller: Caller, key: Key = None) -> None:
        """No more slices will come of this hold: none was acquired that is still on its way.

        Without this, as many acquisitions as it lacks are set aside before one is believed again.
        """
        orders.carry_out(caller, key, "give_up_slices", body, hold_id=hold_id)

    return router
