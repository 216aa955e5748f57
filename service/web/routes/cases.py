"""Cases begin, end, are gone on with; what waits in the holding area is taken into one."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter
from fastapi import Path as PathParameter

from service.room.control import ControlLoop
from service.room.state import HeldState
from service.web.orders import REFUSALS, REFUSALS_WITH_ID, Caller, Key, Orders
from service.web.pagination import ERRORS
from service.web.papers import Papers
from service.web.schemas import Ask, CaseBegun, CaseBody, FinishBody, StudyBody

Folder = Annotated[
    str,
    PathParameter(
        min_length=1, max_length=255, description="A folder name as listed by /api/v1/cases."
    ),
]


def case_router(loop: ControlLoop, orders: Orders, papers: Papers) -> APIRouter:
    router = APIRouter(prefix="/api/v1", tags=["cases"])

    @router.post("/cases", status_code=201, responses=REFUSALS)
    def begin(body: CaseBody, caller: Caller, key: Key = None) -> CaseBegun:
        """Begin a case: listener, worker, service and outbox work on it from now on."""
        return CaseBegun(folder=orders.carry_out(caller, key, "begin_case", body))

    @router.post("/case/finish", responses=REFUSALS)
    def finish(body: FinishBody, caller: Caller, key: Key = None) -> CaseBegun:
        """Finish the open case: the robot is disarmed, nothing of the case changes any more.

        The needle must be out, and no procedure may run. Report and export are written into the
        case's folder; until they are there, /api/v1/cases says so.
        """
        folder = orders.carry_out(caller, key, "finish_case", body)
        papers.wanted(folder)
        return CaseBegun(folder=folder)

    @router.post("/case/continue", status_code=204, responses=REFUSALS)
    def go_on(body: Ask, caller: Caller, key: Key = None) -> None:
        """Go on with a case that was left open on another day."""
        orders.carry_out(caller, key, "continue_case", body)

    @router.post("/cases/{folder}/reopen", responses=REFUSALS_WITH_ID)
    def open_again(folder: Folder, body: Ask, caller: Caller, key: Key = None) -> CaseBegun:
        """Open a finished case again; it is calibrated anew before anything is approached."""
        return CaseBegun(folder=orders.carry_out(caller, key, "reopen_case", body, folder=folder))

    @router.post("/case/frame-of-reference", status_code=204, responses=REFUSALS)
    def frame(body: Ask, caller: Caller, key: Key = None) -> None:
        """The table was moved: the new frame of reference counts, all that rested on it is void."""
        orders.carry_out(caller, key, "accept_frame_of_reference", body)

    @router.get("/holding", responses=ERRORS)
    async def holding() -> list[HeldState]:
        """What waits outside of the open case, and why."""
        return loop.state.holding

    @router.post("/holding/take", status_code=204, responses=REFUSALS)
    def take(body: StudyBody, caller: Caller, key: Key = None) -> None:
        """The slices of a study that wait belong to the open case."""
        orders.carry_out(caller, key, "take_slices", body)

    return router
