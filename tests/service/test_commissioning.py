"""A site is commissioned: what is found holds the truth, and what is written keeps days right."""

import random
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from virtual_commissioning import Truth, VirtualTechnologist

from case_record.record import CaseRecord
from room_config.imaging import ImagingConfig
from room_config.load import load_config
from service.commissioning.acceptance import as_toml, items_of, room_keys
from service.commissioning.clocks import find_clock
from service.commissioning.evidence import CommissioningError, Press, one_series
from service.commissioning.imaging import find_imaging
from service.commissioning.motion import jacobian_items, jacobian_of_case
from service.commissioning.report import Signature, verdict_of, write_html, write_pdf
from service.procedure.calibration import Calibration
from service.procedure.estimate import FiducialEstimate
from service.procedure.jacobian import ImageJacobian
from service.procedure.plane import ImagePlane

IMAGING = ImagingConfig(start_region_px=(30, 30, 98, 98))
ROOM = '[room]\nname = "a site"\ncase_dir = "case"\n[service]\nbridge_link = "/dev/null"\n'


def delays(usual_s: float, dice: random.Random):
    return lambda: usual_s * dice.uniform(0.8, 1.2)


SITES = [(0.2, 40.0), (5.0, -40.0), (20.0, 40.0), (60.0, -40.0)]
WINDOWS = ("flat", "hamming", "fermi")


@pytest.mark.parametrize(
    ("site", "window", "polarity"),
    [
        (SITES[0], "flat", 1),
        (SITES[1], "hamming", -1),
        (SITES[3], "fermi", -1),
        *(
            pytest.param(site, window, polarity, marks=pytest.mark.soak)
            for site in SITES
            for window in WINDOWS
            for polarity in (1, -1)
        ),
    ],
)
def test_a_commissioning_finds_each_within_its_stated_uncertainty(tmp_path, site, window, polarity):
    usual_s, offset_s = site
    dice = random.Random(f"{usual_s} {window} {polarity}")
    truth = Truth(offset_s, delays(usual_s, dice), window, polarity)
    session = VirtualTechnologist(truth, dice).session()
    clock, imaging = find_clock(session), find_imaging(session, IMAGING)
    assert abs(clock.offset_s - offset_s) <= clock.uncertainty_s
    assert clock.promptness.least_s <= 0.8 * usual_s
    assert clock.promptness.most_s >= 1.2 * usual_s
    assert imaging.psf is not None
    assert imaging.psf.kind == window
    assert imaging.polarity == polarity
    assert abs(abs(imaging.oil_shift_px) - imaging.oil_expected_px) < 5 * imaging.oil_sigma_px
    assert 0.7 < imaging.template_chi2 < 1.5
    # a sphere of 4 mm, averaged over a slice of 3 mm
    assert 3.7 < imaging.radius_mm < 4.05
    items = items_of(clock, imaging)
    assert verdict_of(items) == "Accepted"
    room = tmp_path / "room.toml"
    room.write_text(ROOM + as_toml(room_keys(clock, imaging), "a test"))
    config = load_config(room, {})
    assert config.listener.prompt_delay_s >= 1.2 * usual_s
    assert config.imaging.readout_polarity == polarity
    assert config.imaging.point_spread.kind == window


@pytest.fixture(scope="module")
def session():
    dice = random.Random(1)
    return VirtualTechnologist(Truth(12.0, delays(2.0, dice)), dice).session()


def test_times_that_are_not_true_are_found_out_and_nothing_is_written_of_the_clock(session):
    late = [
        replace(s, started=Press("start", s.started.at_s + 8.0)) if n == 2 else s
        for n, s in enumerate(session)
    ]
    clock = find_clock(late)
    assert clock.untruthful_s > 4.0
    imaging = find_imaging(session, IMAGING)
    assert "Acquisition times" in verdict_of(items_of(clock, imaging))
    assert "listener" not in room_keys(clock, imaging)


def test_without_the_second_readout_the_polarity_is_not_known(session):
    imaging = find_imaging(session[:-1], IMAGING)
    assert imaging.polarity == 0
    assert "readout direction reversed" in imaging.template_problem
    assert "readout_polarity" not in room_keys(find_clock(session), imaging).get("imaging", {})


def test_two_series_at_once_and_none_at_all_are_each_one_line(session):
    mixed = [*session[0].receptions, *session[1].receptions]
    with pytest.raises(
        CommissioningError, match="slices of 2 series arrived between two key presses"
    ):
        one_series(mixed, session[0].started, session[1].ended)
    with pytest.raises(CommissioningError, match="no slice arrived"):
        one_series([], session[0].started, session[0].ended)


def test_a_slice_without_the_fiducial_says_so(session):
    nothing = [replace(s, receptions=tuple(
        replace(r, pixels=0 * r.pixels + 5.0) for r in s.receptions)) for s in session]  # fmt: skip
    with pytest.raises(CommissioningError, match="fiducial was not found"):
        find_imaging(nothing, IMAGING)


def test_the_report_says_what_was_found_with_its_limits_and_who_signs(tmp_path, session):
    items = items_of(find_clock(session), find_imaging(session, IMAGING))
    signature = Signature("A. Technologist", 1.8e9, "ab" * 32)
    write_html(tmp_path / "a.html", "site <1>", items, signature)
    write_pdf(tmp_path / "a.pdf", "site <1>", items, signature)
    page = (tmp_path / "a.html").read_text()
    assert "Acceptance of site &lt;1&gt;" in page
    assert "signed by A. Technologist, 2027-01-15" in page
    assert "ab" * 32 in page
    assert all(item.value.replace("<", "&lt;") in page for item in items)
    assert (tmp_path / "a.pdf").read_bytes().startswith(b"%PDF")


def test_what_is_written_is_toml(session):
    keys = room_keys(find_clock(session), find_imaging(session, IMAGING))
    read = tomllib.loads(as_toml(keys, "measured on a day"))
    assert read["listener"]["prompt_delay_s"] >= 2.4
    assert read["imaging"]["point_spread"]["kind"] == "flat"


JACOBIAN = ImageJacobian(
    ("xt", "yt"),
    np.array([[0.1, 0.1, 0.98, 0.96], [1.02, 1.0, -0.1, -0.1]]),
    np.diag([0.01**2] * 8),
)


def calibrated_case(folder: Path, jacobian: ImageJacobian) -> Path:
    with CaseRecord(folder, create=True) as record:
        number = record.begin_procedure("calibration", {})
        plane = ImagePlane((0.0, 0.0, -1.0), (1.0, 0.0, 0.0), (1.0, 1.0))
        seen = FiducialEstimate({"xt": 0, "yt": 0}, np.zeros(2), np.eye(2))
        found = Calibration(jacobian, seen, plane, 1).to_json()
        record.end_procedure(number, "done", found)
    return folder


def test_the_image_jacobian_of_a_calibrated_case_is_part_of_the_acceptance(tmp_path):
    found = jacobian_of_case(calibrated_case(tmp_path / "case", JACOBIAN))
    xt, yt = jacobian_items(found, "case")
    assert xt.value == "1.025 ± 0.010 mm per mm out, 1.005 ± 0.010 back"
    assert (xt.passed, yt.passed) == (True, True)
    half = ImageJacobian(JACOBIAN.axes, JACOBIAN.columns / 2, JACOBIAN.covariance)
    assert "Image Jacobian" in verdict_of(jacobian_items(half, "case"))
    CaseRecord(tmp_path / "other", create=True).close()
    with pytest.raises(CommissioningError, match="no valid calibration"):
        jacobian_of_case(tmp_path / "other")
