"""Counters of the room for Prometheus, read from the published state when asked."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Protocol

from prometheus_client.core import GaugeMetricFamily
from prometheus_client.registry import Collector

from service.room.control import ControlLoop
from service.room.link import RoomLink
from service.web.event_stream import Broadcast


class Receivers(Protocol):
    """Who counts the connected receivers of the scene."""

    @property
    def receivers(self) -> int: ...

    @property
    def passed_over(self) -> Mapping[str, int]: ...


class RoomMetrics(Collector):
    def __init__(
        self,
        loop: ControlLoop,
        link: RoomLink,
        broadcast: Broadcast,
        receivers: Receivers | None,
    ) -> None:
        self._loop = loop
        self._link = link
        self._broadcast = broadcast
        self._receivers = receivers

    def collect(self) -> Iterator[GaugeMetricFamily]:
        state = self._loop.state
        yield GaugeMetricFamily(
            "autospine_robot_linked", "1 while the bridge answers.", value=float(state.robot.linked)
        )
        yield GaugeMetricFamily(
            "autospine_viewers", "Open event streams.", value=float(self._broadcast.viewers)
        )
        yield GaugeMetricFamily(
            "autospine_openigtlink_receivers",
            "Connected receivers of the scene.",
            value=float(0 if self._receivers is None else self._receivers.receivers),
        )
        passed_over = GaugeMetricFamily(
            "autospine_openigtlink_passed_over",
            "Messages from peers that were ignored.",
            labels=["reason"],
        )
        for reason, count in (
            {} if self._receivers is None else self._receivers.passed_over
        ).items():
            passed_over.add_metric([reason], count)
        yield passed_over
        yield from self._controllers()
        parts = GaugeMetricFamily(
            "autospine_process_up", "1 while a process of the room works.", labels=["process"]
        )
        for process in state.processes:
            parts.add_metric([process.name], float(process.condition == "up"))
        yield parts
        slices = GaugeMetricFamily("autospine_slices", "Slices by state.", labels=["state"])
        for name, count in state.slices.items():
            slices.add_metric([name], count)
        yield slices
        counters = self._link.client.counters
        for name in ("frames_sent", "frames_received", "frames_bad", "frames_resent"):
            yield GaugeMetricFamily(
                f"autospine_link_{name}",
                "Frames on the line to the bridge.",
                value=float(getattr(counters, name)),
            )
        if counters.round_trip_s is not None:
            yield GaugeMetricFamily(
                "autospine_link_round_trip_seconds",
                "Smoothed round trip on the line.",
                value=counters.round_trip_s,
            )

    def _controllers(self) -> Iterator[GaugeMetricFamily]:
        """What the boards of the axes measure of themselves."""
        status = self._link.status
        supply = GaugeMetricFamily(
            "autospine_motor_supply_volts", "48 V supply at the controller.", labels=["axis"]
        )
        board = GaugeMetricFamily(
            "autospine_motor_board_celsius", "Temperature of the controller.", labels=["axis"]
        )
        if status is not None:
            for axis, millivolts in status.supply_mv.items():
                supply.add_metric([axis], millivolts / 1000)
            for axis, celsius in status.board_celsius.items():
                board.add_metric([axis], celsius)
        yield supply
        yield board
