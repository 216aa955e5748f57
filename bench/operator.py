"""The bench in the place of a scanner: acquires what the service asks for, sends it by C-STORE."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field

import httpx
from pydicom.uid import SecondaryCaptureImageStorage, generate_uid

from bench.config import BenchRoom, CameraError
from bench.slice_writer import BenchAcquisition, BenchStudy, write_bench_slice
from bench.slices import BenchCamera, BenchSlice
from bench.source import FrameSource
from simulator.outbox import Delivery, Outbox
from simulator.scan_operator import read_request, say_once_in_a_row
from simulator.scanner import AcquisitionRequest

Note = Callable[[str], None]


@dataclass(frozen=True)
class Route:
    """To the room's listener."""

    ae_title: str
    listener_host: str
    listener_port: int
    listener_ae_title: str
    retry_s: float
    retries: int


@dataclass
class BenchOperator:
    """Owns the numbering of a session at the bench."""

    room: BenchRoom
    camera: BenchCamera
    outbox: Outbox
    note: Note
    study: BenchStudy = field(init=False)
    acquisitions: int = 0
    series: int = 0

    def __post_init__(self) -> None:
        self.study = BenchStudy.new(time.time(), self.room.camera.ae_title)

    def serve(self, request: AcquisitionRequest, source: FrameSource) -> None:
        """Acquire the slices that were asked for, one series; raises CameraError."""
        self.series += 1
        series_uid = generate_uid()
        for instance in range(1, request.count + 1):
            taken = self.camera.acquire(source, time.time())
            self.note(self.camera.complaint_about(self.camera.circles_in(taken)))
            self.acquisitions += 1
            self._send(taken, series_uid, instance)

    def _send(self, taken: BenchSlice, series_uid: str, instance: int) -> None:
        acquisition = BenchAcquisition(
            series_uid=series_uid,
            series_number=self.series,
            instance_number=instance,
            acquisition_number=self.acquisitions,
            from_s=taken.from_s,
            to_s=taken.to_s,
            averages=taken.averages,
        )
        config = self.room.camera
        dataset = write_bench_slice(
            taken.pixels, config.pixel_mm, self.study, acquisition, f"bench {config.colour}"
        )
        self.outbox.push(dataset, time.monotonic())


def operate_bench(
    room: BenchRoom,
    camera: BenchCamera,
    source: FrameSource,
    stop: threading.Event,
    note: Note,
    token: str = "",
    ready: Callable[[], None] = lambda: None,
) -> None:
    """Serve the room until `stop` is set. Raises CameraError when the camera has ended for good."""
    config = room.camera
    route = Route(
        config.ae_title,
        config.listener_host,
        room.listener_port,
        room.listener_ae_title,
        config.retry_s,
        config.retries,
    )
    say = say_once_in_a_row(note)

    def report(delivery: Delivery) -> None:
        if not delivery.sent:
            note(f"a slice could not be delivered: {delivery.reason}")

    headers = {"Authorization": f"Bearer {token}"} if token else {}
    with (
        httpx.Client(timeout=2.0, trust_env=False, headers=headers) as http,
        Outbox(route, report, [SecondaryCaptureImageStorage]) as outbox,
    ):
        operator = BenchOperator(room, camera, outbox, say)
        served: set[str] = set()
        ready()
        while not stop.wait(config.poll_s):
            try:
                source.check()
                request = read_request(http, config.service_url)
                if request is not None and request.request_id not in served:
                    operator.serve(request, source)
                    served.add(request.request_id)
            except (httpx.HTTPError, httpx.InvalidURL, ValueError) as error:
                say(f"{config.service_url}: {error}")
            except CameraError as error:
                if source.has_ended:
                    raise
                say(str(error))
