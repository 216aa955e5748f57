"""Orders to procedures: begin one, answer what it asks, end it; puncture and insertion lock."""

from __future__ import annotations

from fastapi import APIRouter

from service.web.orders import REFUSALS, REFUSALS_WITH_ID, Caller, Key, Orders
from service.web.schemas import AnswerBody, Ask, HoldBody, ProcedureBody, PunctureBody, Started


def procedure_router(orders: Orders) -> APIRouter:
    """Calibration, approach, puncture, and the lock while the needle is in."""
    router = APIRouter(prefix="/api/v1", tags=["procedure"], responses=REFUSALS)

    @router.post("/calibration", status_code=202)
    def calibration(body: ProcedureBody, caller: Caller, key: Key = None) -> Started:
        """Start the calibration."""
        return Started(procedure_id=orders.carry_out(caller, key, "start_calibration", body))

    @router.post("/approach", status_code=202)
    def approach(body: ProcedureBody, caller: Caller, key: Key = None) -> Started:
        """Start the approach to the target."""
        return Started(procedure_id=orders.carry_out(caller, key, "start_approach", body))

    @router.post("/acquisition", status_code=204, responses=REFUSALS_WITH_ID)
    def acquisition(body: HoldBody, caller: Caller, key: Key = None) -> None:
        """The slices of a hold were acquired (rooms where the operator confirms acquisitions)."""
        orders.carry_out(caller, key, "confirm_acquisition", body)

    @router.post("/answer", status_code=204)
    def answer(body: AnswerBody, caller: Caller, key: Key = None) -> None:
        """Answer the open question, for instance CONFIRM MOVE; void if anything has changed."""
        orders.carry_out(caller, key, "answer", body)

    @router.post("/abort", status_code=204)
    def abort(body: Ask, caller: Caller, key: Key = None) -> None:
        """End the running procedure; the robot stays where it is."""
        orders.carry_out(caller, key, "abort", body)

    @router.post("/puncture", status_code=204)
    def puncture(body: PunctureBody, caller: Caller, key: Key = None) -> None:
        """Record the puncture."""
        orders.carry_out(caller, key, "puncture", body)

    @router.post("/lock", status_code=204)
    def lock(body: Ask, caller: Caller, key: Key = None) -> None:
        """The needle is going in: lock motion by hand (READY locks it by itself)."""
        orders.carry_out(caller, key, "lock_motion", body)

    @router.post("/needle-out", status_code=204)
    def needle_out(body: Ask, caller: Caller, key: Key = None) -> None:
        """The needle is out: unlock motion."""
        orders.carry_out(caller, key, "needle_out", body)

    return router
