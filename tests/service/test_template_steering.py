"""Steering by the fiducial's own image: an oval one with a cannula's void, which is no disc."""

from dataclasses import replace

import numpy as np
import pytest
from offline_arguments import GATE, approach_arguments, beside, calibration_arguments

from case_record.record import CaseRecord
from dicom_listener.operator_actions import reassign
from service.cli.replay import replay_measurements, replay_procedure
from service.procedure.approach import approach
from service.procedure.calibration import BY_DISC, FoundBy, calibrate
from service.procedure.fiducials import ONE_FIDUCIAL
from service.procedure.observe import ProcedureFailedError, see
from service.procedure.recording import RecordingArguments, record_place
from service.procedure.registry import APPROACH, CALIBRATION
from service.procedure.registry import approach_arguments as recorded_approach
from service.procedure.registry import calibration_arguments as recorded_calibration
from service.procedure.targets import Target, common_part_mm
from simulator.config import CANNULATED, Fiducial, SliceProtocol, VirtualRoom
from simulator.stage_physics import StageParameters
from sr_engine.errors import TemplateError
from sr_engine.request import UnusableSlicesError
from sr_engine.views import Templates
from sr_engine.worker import view_of
from studies.offline_room import MrImaging, OfflineRoom
from studies.recorded_room import RecordedRoom

BY_TEMPLATE = calibration_arguments(localization="template")
REGION_PX = (30.0, 30.0, 98.0, 98.0)
PROTOCOL = SliceProtocol(snr=20.0)


def cannulated(protocol=PROTOCOL, **shape):
    return VirtualRoom(fiducials=(Fiducial(**{**CANNULATED, **shape}),), protocol=protocol)


def offline(seed, room=None, **options):
    stages = StageParameters(scatter=0.002)
    imaging = MrImaging(room or cannulated())
    return OfflineRoom(imaging, stages, seed, region_px=REGION_PX, **options)


def test_what_is_no_disc_is_calibrated_steered_and_placed_truly():
    misses, sigmas = [], []
    for seed in range(6):
        room = offline(seed)
        start = room.run(calibrate(BY_TEMPLATE))
        assert len(start.found_by.template_of(0)) == 4
        before = room.true_plane_mm
        there = room.run(record_place(RecordingArguments(sigma_mm=0.012, gate=GATE), start))
        first_mm, target_mm = room.true_plane_mm, there.calibration.estimate.plane_mm
        assert np.array_equal(before, first_mm)
        away = room.run(
            approach(approach_arguments(beside(there.calibration, 3.4, -2.2)), there.calibration)
        )
        back = room.run(approach(approach_arguments(target_mm), away.calibration))
        misses.append(room.true_plane_mm - first_mm)
        sigmas.append(back.sigma_mm)
        absolute = room.true_plane_mm - back.calibration.estimate.plane_mm
        assert np.all(np.abs(absolute) < 4 * np.array(start.found_by.systematic_mm) + 0.03)
    assert np.max(np.hypot(*np.transpose(misses))) < 0.1
    assert max(sigmas) < 0.03


@pytest.mark.parametrize("shape", [{}, {"radius_mm": 5.0}])
def test_without_a_template_it_is_found_as_a_ring_about_a_void(shape):
    for seed in (1, 4, 5):
        room = offline(seed, cannulated(**shape))
        by_disc = room.run(calibrate(calibration_arguments()))
        assert by_disc.found_by == BY_DISC
        apart = room.true_plane_mm - by_disc.estimate.plane_mm
        assert apart @ np.linalg.solve(by_disc.estimate.covariance_mm2, apart) < 18  # 1e-4


def other_bandwidth(room):
    protocol = PROTOCOL.model_copy(update={"bandwidth_hz_px": 130.0})
    room.imaging = MrImaging(cannulated(protocol, radius_mm=5.0))
    room._protocol = protocol


@pytest.fixture
def recorded(tmp_path):
    with CaseRecord(tmp_path, create=True) as record:
        room = RecordedRoom(
            record, MrImaging(cannulated(radius_mm=5.0)), StageParameters(), 3, region_px=REGION_PX
        )
        yield room


def test_the_record_alone_says_what_template_a_case_was_steered_by(recorded):
    start = recorded.run_recorded(CALIBRATION, recorded_calibration(BY_TEMPLATE))
    told = approach_arguments(beside(start, 2.0, 1.0), systematic_mm=(0.01, 0.01))
    arrival = recorded.run_recorded(APPROACH, recorded_approach(told, start))
    assert arrival.calibration.found_by == start.found_by
    rows = recorded.record.measurements("done")
    assert [row.result["method"] for row in rows[4:]] == ["template"] * (len(rows) - 4)
    assert [len(row.request.get("template", ())) for row in rows] == [0] * 4 + [4] * (len(rows) - 4)
    for row in rows[4:]:
        known = row.result["template"]
        assert [view["measurement_id"] for view in known["views"]] == [1, 2, 3, 4]
        # what is common to all places is no part of how sure one is against another
        own, common = row.result["sigma_px"], row.result["systematic_mm"]
        assert max(own) < min(common)
    # nothing is kept beside the record: who learns the template anew gets the same
    assert {row.difference_mm for row in replay_measurements(recorded.record, None)} == {0.0}
    assert all(
        replay_procedure(recorded.record, one).agrees for one in recorded.record.procedures()
    )


def test_slices_of_another_protocol_are_not_fitted_by_it_and_said_to_be(recorded):
    start = recorded.run_recorded(CALIBRATION, recorded_calibration(BY_TEMPLATE))
    other_bandwidth(recorded)
    expected, templates = GATE.around(start.estimate), start.found_by.templates
    (seen,) = recorded.run(see(ONE_FIDUCIAL, "ml", expected, templates, fresh=True)).measured
    assert seen.method == "ml"
    result = recorded.record.last_measurement("done").result
    assert "a different pixel bandwidth (130 instead of 260)" in result["why_no_template"]
    assert "calibrate again" in result["why_no_template"]
    # what disc and template mean by the middle may differ: that is in its covariance
    assert np.all(np.diag(seen.covariance_mm2) > np.square(start.found_by.systematic_mm))


def test_a_template_that_lacks_a_slice_since_says_which_measurement_and_what_to_do(recorded):
    recorded.run_recorded(CALIBRATION, recorded_calibration(calibration_arguments()))
    row = recorded.record.measurements("done")[0]
    for slice_id in row.result["slice_ids"]:
        reassign(recorded.record, slice_id, None, "Olga", "a doubtful one")
    why = f"measurement {row.measurement_id}, .* has since been set aside: calibrate again"
    with pytest.raises(UnusableSlicesError, match=why):
        view_of(recorded.record, row.measurement_id)


def test_a_cameras_images_make_no_template(recorded):
    recorded.run_recorded(CALIBRATION, recorded_calibration(calibration_arguments()))
    rows = recorded.record.measurements("done")
    views = [view_of(recorded.record, row.measurement_id) for row in rows]
    assert Templates().of(views, (2.5, 6.5)).template.n_frames == len(views)

    def by_camera(view):
        slices = tuple(
            replace(s, header={**s.header, "kind": "camera"}) for s in view.frames.slices
        )
        return replace(view, frames=replace(view.frames, slices=slices))

    with pytest.raises(TemplateError, match="camera"):
        Templates().of([by_camera(view) for view in views], (2.5, 6.5))


def test_another_thing_in_its_place_is_refused_by_name_with_what_to_do():
    room = offline(2, answer=lambda question: "abort")
    start = room.run(calibrate(BY_TEMPLATE))
    # the cannula has slipped out, and the fiducial is full of air
    room.imaging = MrImaging(
        VirtualRoom(fiducials=(Fiducial(radius_mm=5.5, cannula_mm=9.0),), protocol=PROTOCOL)
    )
    expected, templates = GATE.around(start.estimate), start.found_by.templates
    with pytest.raises(ProcedureFailedError, match="calibrate again") as refused:
        room.run(see(ONE_FIDUCIAL, "ml", expected, templates, fresh=True))
    assert refused.value.code == "template-mismatch"


def test_of_the_absolute_centre_counts_what_the_targets_kind_says():
    now = FoundBy(((1, 2, 3, 4),), (0.03, 0.04), (0.006, 0.008))
    before = FoundBy(((7, 8, 9, 10),), (0.03, 0.04), (0.008, 0.006))
    start = replace(offline(0).run(calibrate(BY_TEMPLATE)), found_by=now)
    here, clicked = Target(1, (0, 0, 0), found_by=now), Target(2, (0, 0, 0))
    assert common_part_mm(here, start) == common_part_mm(clicked, start) == ()
    assert common_part_mm(replace(clicked, in_water=True), start) == (0.03, 0.04)
    assert common_part_mm(replace(here, found_by=before), start) == pytest.approx((0.01, 0.01))
    assert common_part_mm(replace(here, found_by=BY_DISC), start) == (0.03, 0.04)
    told = approach_arguments((0.0, 0.0), systematic_mm=(0.03, 0.04))
    judged = told.as_judged(start.estimate).covariance_mm2 - start.estimate.covariance_mm2
    assert np.allclose(judged, np.diag([0.0009, 0.0016]))
    # 0.06 mm cannot be said of a place in tissue with that, 0.1 mm can
    assert "known only to 0.040 mm" in told.why_never_sure()
    wider = replace(told, tolerance_mm=0.1)
    assert wider.why_never_sure() == ""
