"""The whole bench as real processes: camera, listener, worker, service, bridge, emulated motors."""

from collections.abc import Iterator
from pathlib import Path

import httpx
import numpy as np
import pytest
from virtual_bench import BenchDemoRoom, BenchOperator, BenchTruth

from case_record.record import CaseRecord
from service.client import RoomClient
from simulator.config import parse_virtual_room
from simulator.demo.room import DemoOptions
from simulator.truth_client import TruthAddress

# the virtual camera is rendered on this computer, which has other things to do
LATENCY_S = 0.6


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[BenchDemoRoom]:
    room = BenchDemoRoom(DemoOptions(tmp_path / "bench", seed=3), latency_s=LATENCY_S)
    try:
        room.start()
        yield room
    finally:
        room.end()


def punctures(room: BenchDemoRoom, count: int) -> list[tuple[float, float]]:
    """(true error, reported error + 2.45 sigma) in mm of each puncture."""
    truth = TruthAddress("127.0.0.1", room.truth_port)
    operator = BenchOperator(
        RoomClient(room.url, by="tester"),
        parse_virtual_room(room.virtual_table),
        truth,
        room.virtual_dir / "punctures.jsonl",
        room.options.seed,
    )
    operator.bench_truth = BenchTruth(room.lens_file)
    try:
        operator.run(count, lambda _: None, room.check)
    finally:
        operator.close()
    return [
        (one.true_error_mm, one.estimated_error_mm + 2.45 * one.sigma_mm)
        for one in operator.results
    ]


def test_a_case_at_the_bench_comes_to_ready_where_it_says(bench):
    """Motors, serial line, MJPEG, DICOM and HTTP are real; READY within the paper's tolerance."""
    preview = httpx.get(bench.preview_url + "state.json", timeout=60).json()
    assert preview["circles"] == 1
    assert httpx.get(bench.preview_url, timeout=60).text.startswith("<!doctype html>")
    (result,) = punctures(bench, 1)
    assert result[0] < 0.15
    with CaseRecord(bench.folder) as record:
        record.verify_events()
        used = [row for row in record.slices() if row.state == "assigned"]
        assert len(used) >= 5
        assert {row.header["kind"] for row in used} == {"camera"}


@pytest.mark.soak
def test_fifty_punctures_at_the_bench_are_where_they_are_said_to_be(bench):
    results = np.array(punctures(bench, 50))
    inside = results[:, 0] <= results[:, 1]
    print(f"true error mm: median {np.median(results[:, 0]):.3f}, inside {inside.mean():.0%}")
    assert inside.mean() >= 0.9
    assert np.median(results[:, 0]) < 0.06
