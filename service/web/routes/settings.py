"""Settings of the present case."""

from __future__ import annotations

from fastapi import APIRouter

from service.web.orders import REFUSALS, Caller, Key, Orders
from service.web.schemas import SettingsBody


def settings_router(orders: Orders) -> APIRouter:
    router = APIRouter(prefix="/api/v1", tags=["procedure"], responses=REFUSALS)

    @router.put("/settings", status_code=204)
    def settings(body: SettingsBody, caller: Caller, key: Key = None) -> None:
        """Strategy and goal of this case from its next procedure on, within the room's bounds."""
        orders.carry_out(caller, key, "change_settings", body)

    return router
