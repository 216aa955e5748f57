"""Every boundary of every process, and an error of each class at it, while a case runs.

What fails ends alone: afterwards the case comes to READY or says why not, and no process has ended.
"""

import importlib
import json
import os
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pytest
from attended_room import AttendedRoom, arm, calibrated, running_room, wait_for

from service.client import RefusedByServiceError, RoomClient, ServiceGoneError
from service.room.state import RoomState

INJECTED = Path(__file__).with_name("injected")
ERRORS = ("LinAlgError", "OSError", "TypeError", "OperationalError")
BOUNDARIES = {
    "worker": (
        "case_record.record:CaseRecord.requested_measurements",
        "sr_engine.worker:gather_frames",
        "sr_engine.worker:PointSpreads.of",
        "sr_engine.worker:localize_request",
        "sr_engine.worker:describe_result",
        "case_record.record:CaseRecord.finish_measurement",
    ),
    "listener": (
        "dicom_listener.intake:Intake.take",
        "dicom_listener.intake:Intake._read",
        "dicom_listener.intake:Intake._assign",
        "dicom_listener.intake:Intake.look_at_record",
        "case_record.record:CaseRecord.add_slice",
        "dicom_slice.decode_guard:DecodeGuard.check",
        "dicom_listener.process:Tending.turn",
    ),
    "service": (
        "service.room.control:build_procedure",
        "service.room.execution:Execution.execute",
        "service.room.execution:Execution._settled",
        "service.room.execution:Execution._wait_for_slices",
        "service.room.execution:Execution._measure",
        "service.room.state_view:Describer.describe",
        "service.room.control:result_to_json",
        "service.room.commands.commands:Commands.carry_out",
        "service.room.commands.commands:Commands.keep_ready",
        "robot_bridge.client.client:BridgeClient.move",
        "robot_bridge.client.client:BridgeClient.pump",
        "case_record.record:CaseRecord.send_step",
        "case_record.record:CaseRecord.end_step",
        "case_record.record:CaseRecord.send_move",
        "case_record.record:CaseRecord.end_procedure",
        "case_record.record:CaseRecord.events",
        "service.web.event_stream:_state_message",
    ),
}
ALL = [(process, where) for process, places in BOUNDARIES.items() for where in places]
# one error at each boundary, each class in turn; `make soak` tries every class at every boundary
EACH_ONCE = [(p, w, ERRORS[n % len(ERRORS)]) for n, (p, w) in enumerate(ALL)]
EVERY = [(p, w, error) for p, w in ALL for error in ERRORS]
STEPS_MM = ((0.6, 0.5), (-0.5, -0.4), (0.3, 0.6), (-0.6, 0.2))


class Injected:
    """A room in whose processes errors can be raised."""

    def __init__(self, room: AttendedRoom, client: RoomClient, order: Path) -> None:
        self.room, self.client, self._order = room, client, order
        self._turn = 0
        found = calibrated(client).measurement
        assert found is not None
        assert found.patient_mm is not None
        self._base_mm = found.patient_mm

    def inject(self, process: str, where: str, error: str) -> None:
        done = self._order.with_suffix(".done")
        done.unlink(missing_ok=True)
        part = self._order.with_suffix(".part")
        part.write_text(json.dumps({"process": process, "where": where, "error": error}))
        part.rename(self._order)

    @property
    def was_raised(self) -> bool:
        return not self._order.exists()

    def approach(self) -> RoomState:
        """To the next place; how it ended."""
        row_mm, col_mm = STEPS_MM[self._turn % len(STEPS_MM)]
        self._turn += 1
        x, y, z = self._base_mm
        client = self.client
        self._order_it(client.needle_out)
        wait_for(client.state, lambda s: not s.robot.insertion_locked)
        self._order_it(lambda: arm(client))
        self._order_it(lambda: client.set_target((x + col_mm, y, z + row_mm)))
        began = self._order_it(client.start_approach)
        if began is None:
            return client.state()
        return wait_for(client.state, self._is_over, 180.0)

    def _order_it(self, order):
        """An order that met the error is given once more, as a person would."""
        for _ in range(20):
            try:
                return order()
            except (RefusedByServiceError, ServiceGoneError) as error:
                if getattr(error, "code", "") == "not_armed":  # the link was lost since
                    with suppress(RefusedByServiceError, ServiceGoneError):
                        arm(self.client)
                time.sleep(0.3)
        return None

    def _is_over(self, state: RoomState) -> bool:
        self.assert_alive()
        if state.question is not None:
            choice = next(c for c in ("confirm", "rescan") if c in state.question.choices)
            self._answer(state.question.question_id, choice)
        elif state.robot.linked and (state.robot.stopped or not state.robot.armed):
            self._order_it(self.client.reset)
        return state.procedure is None

    def _answer(self, question_id: str, choice: str) -> None:
        try:
            self.client.answer(question_id, choice)
        except (RefusedByServiceError, ServiceGoneError):
            return  # it is asked again

    def assert_alive(self) -> None:
        for child in self.room.family.children.values():
            assert child.process.poll() is None, child.describe_end()


@pytest.fixture(scope="module")
def injected(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Injected]:
    folder = tmp_path_factory.mktemp("injected")
    order = folder / "order.json"
    order.with_name("boundaries.txt").write_text("\n".join({where for _, where in ALL}))
    with pytest.MonkeyPatch.context() as patch:
        path = os.pathsep.join(filter(None, (str(INJECTED), os.environ.get("PYTHONPATH"))))
        patch.setenv("PYTHONPATH", path)
        patch.setenv("AUTOSPINE_INJECT", str(order))
        with running_room(folder / "room") as room, RoomClient(room.url, by="t") as client:
            yield Injected(room, client, order)


def test_the_boundaries_are_there() -> None:
    for _, where in ALL:
        module, _, place = where.partition(":")
        found = importlib.import_module(module)
        for name in place.split("."):
            found = getattr(found, name)
        assert callable(found), where


def try_it(injected: Injected, process: str, where: str, error: str) -> None:
    injected.inject(process, where, error)
    state = injected.approach()
    assert injected.was_raised, f"{where} was never reached"
    injected.assert_alive()
    assert state.ready or state.ready_lost or state.last_outcome.startswith("approach"), state
    if not state.ready:  # it says why
        assert state.last_outcome != "approach done" or state.ready_lost, state.last_outcome


def test_an_error_at_a_boundary_ends_nothing_but_what_it_is_in(injected: Injected) -> None:
    for process, where, error in EACH_ONCE[::4]:
        try_it(injected, process, where, error)
    last = injected.approach()
    assert last.ready or injected.approach().ready, last.last_outcome


@pytest.mark.soak
@pytest.mark.parametrize(("process", "where", "error"), EVERY)
def test_every_error_at_every_boundary(
    injected: Injected, process: str, where: str, error: str
) -> None:
    try_it(injected, process, where, error)
