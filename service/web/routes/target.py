"""Orders that say where the needle is to go: target and entry point."""

from __future__ import annotations

from fastapi import APIRouter

from service.web.orders import REFUSALS, Caller, Key, Orders
from service.web.pagination import Id
from service.web.schemas import (
    Ask,
    PointBody,
    ReachAsk,
    ReachBody,
    Started,
    TargetBody,
    TargetHereBody,
)


def target_router(orders: Orders) -> APIRouter:
    """Target and entry point."""
    router = APIRouter(prefix="/api/v1", tags=["procedure"], responses=REFUSALS)

    @router.put("/target", status_code=204)
    def target(body: TargetBody, caller: Caller, key: Key = None) -> None:
        """Set where the fiducial is to be, patient mm (LPS)."""
        orders.carry_out(caller, key, "set_target", body)

    @router.post("/target/reach")
    def reach(body: ReachAsk, caller: Caller) -> ReachBody:
        """Whether a point could be the target, by what an approach would work out now."""
        verdict, text = orders.carry_out(caller, None, "reach", body)
        return ReachBody(verdict=verdict, text=text)

    @router.post("/target/withdraw", status_code=204)
    def withdraw_target(body: Ask, caller: Caller, key: Key = None) -> None:
        """Withdraw the target; nothing is approached until another one is set."""
        orders.carry_out(caller, key, "withdraw_target", body)

    @router.post("/target/here", status_code=202)
    def target_here(body: TargetHereBody, caller: Caller, key: Key = None) -> Started:
        """Look as closely as the tolerance asks for: where the fiducial is becomes the target."""
        return Started(procedure_id=orders.carry_out(caller, key, "record_target", body))

    @router.post("/targets/{number}/choose", status_code=204)
    def choose_target(number: Id, body: Ask, caller: Caller, key: Key = None) -> None:
        """Take a target of this case again."""
        orders.carry_out(caller, key, "choose_target", body, number=number)

    @router.put("/entry", status_code=204)
    def entry(body: PointBody, caller: Caller, key: Key = None) -> None:
        """Set the planned skin point, patient mm (LPS)."""
        orders.carry_out(caller, key, "set_entry", body)

    return router
