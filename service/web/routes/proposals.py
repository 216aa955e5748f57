"""What planning stations propose: taken over or refused by the operator."""

from __future__ import annotations

from fastapi import APIRouter

from service.web.orders import REFUSALS_WITH_ID, Caller, Key, Orders
from service.web.pagination import Id
from service.web.schemas import ReasonBody, TakeBody


def proposal_router(orders: Orders) -> APIRouter:
    """The state shows what is proposed; here it is decided."""
    router = APIRouter(prefix="/api/v1/proposals", tags=["procedure"], responses=REFUSALS_WITH_ID)

    @router.post("/{number}/take", status_code=204)
    def take(number: Id, body: TakeBody, caller: Caller, key: Key = None) -> None:
        """Make a proposed target (and entry point) the one to go to."""
        orders.carry_out(caller, key, "take_proposal", body, number=number)

    @router.post("/{number}/refuse", status_code=204)
    def refuse(number: Id, body: ReasonBody, caller: Caller, key: Key = None) -> None:
        """Say no to a proposal; its sender is told why."""
        orders.carry_out(caller, key, "refuse_proposal", body, number=number)

    return router
