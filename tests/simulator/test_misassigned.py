"""The record's assignment of slices, held against the scanner's truth."""

from dataclasses import replace

import pytest
from neighbours import Page, Receiver, Stages, Start

from case_record.rows import SliceRow
from simulator.misassigned import misassigned, read_truth

ROW = SliceRow(
    sop_instance_uid="",
    frame=0,
    sha256="",
    path="",
    state="assigned",
    hold_id=1,
    reason_code="",
    reason="",
    received_s=0.0,
    received_monotonic_s=0.0,
    acquired_from_s=None,
    acquired_to_s=None,
    time_source="",
    header={},
    decided_by="",
)


def test_only_what_was_asked_for_at_that_hold_with_the_robot_at_rest_is_rightly_assigned(
    start: Start, stages: Stages, page: Page, receiver: Receiver
) -> None:
    running = start({"acquisition_s": 0.5}, faults=["extra_series"], fault_probability=1.0)
    page.ask_for("r1", hold_id=1)
    receiver.wait_for(6)
    stages.go(30.0, xt=30.0, yt=0.0)
    page.ask_for("r2", hold_id=2)
    receiver.wait_for(12)
    still, moving = (line["sop_instance_uid"] for line in running.truth())
    extra = running.truth("extra")[0]["sop_instance_uid"]
    truth = read_truth(running.truth_file)
    assert len(truth) == 12
    wrong = {
        (still, 2): "acquired for hold 1",
        (moving, 2): "the stages moved by",
        (extra, 1): "extra series",
        ("1.2.3", 1): "nobody acquired it",
    }
    for (uid, hold_id), why in wrong.items():
        (found,) = misassigned([replace(ROW, sop_instance_uid=uid, hold_id=hold_id)], truth)
        assert why in found.why
    right = replace(ROW, sop_instance_uid=still)
    aside = replace(ROW, sop_instance_uid=moving, state="quarantined", hold_id=None)
    assert misassigned([right, aside], truth) == []


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_extra_series_come_before_or_after_the_slice_itself(
    start: Start, page: Page, receiver: Receiver, seed: int
) -> None:
    running = start(faults=["extra_series"], fault_probability=1.0, seed=seed)
    page.ask_for("r1", count=4)
    arrived = receiver.wait_for(24)
    asked = {line["sop_instance_uid"] for line in running.truth()}
    places = [n % 6 for n, dataset in enumerate(arrived) if dataset.SOPInstanceUID in asked]
    assert len(set(places)) > 1
