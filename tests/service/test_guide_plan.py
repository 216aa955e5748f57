"""What four-axis procedures are told, from the room's configuration and the case's points."""

import pytest
from test_guide import APART, LOWER, PLANE, UPPER, make_room
from test_guide import calibration_arguments as guide_calibration

from room_config.load import Config, ConfigError, load_config
from service.procedure.arguments import approach_of, calibration_of, geometry_of
from service.procedure.calibration import calibrate
from service.procedure.plan import PlanRefusedError, Travel
from service.procedure.targets import Target, TargetError

ROOM = """
[room]
name = "four axes"
case_dir = "case"

[imaging]
readout_polarity = 1

[service]
bridge_link = "/dev/ttyUSB0"

[service.guide]
upper_plane_mm = 58.0
lower_plane_mm = -2.0
upper_fiducial_mm = 48.0
lower_fiducial_mm = 14.0
upper_slice_mm = 46.0
lower_slice_mm = 12.0
"""
TRAVEL = {axis: Travel(-20_000, 20_000) for axis in ("xt", "yt", "xb", "yb")}
HEADER = {
    "imaging_frequency_mhz": 123.2,
    "pixel_bandwidth_hz": 260.0,
    "phase_encoding_direction": "COL",
}


def configured(tmp_path, text: str = ROOM) -> Config:
    path = tmp_path / "room.toml"
    path.write_text(text)
    return load_config(path, {})


@pytest.fixture(scope="module")
def start():
    return make_room(2).run(calibrate(guide_calibration()))


def test_the_configuration_becomes_the_geometry_of_the_procedures(tmp_path):
    guide = configured(tmp_path).service.guide
    geometry = geometry_of(guide)
    assert (geometry.upper_along_mm, geometry.lower_along_mm) == (UPPER, LOWER)
    assert geometry.joints_apart_mm == APART
    assert geometry.slice_positions_mm == (46.0, 12.0)


def test_a_calibration_starts_in_the_middle_of_the_travel(tmp_path):
    config = configured(tmp_path)
    travel = {**TRAVEL, "xb": Travel(-10_000, 16_000)}
    arguments = calibration_of(config, config.service.guide, travel, 1)
    assert arguments.origin_um == {"xt": 0, "yt": 0, "xb": 3000, "yb": 0}
    assert arguments.move_um == 6000
    short = {**TRAVEL, "xb": Travel(-1000, 7000)}
    assert calibration_of(config, config.service.guide, short, 1).origin_um["xb"] == 1000
    with pytest.raises(PlanRefusedError, match="axis yb"):
        calibration_of(config, config.service.guide, {**TRAVEL, "yb": Travel(0, 4000)}, 1)
    two = {axis: TRAVEL[axis] for axis in ("xt", "yt")}
    with pytest.raises(PlanRefusedError, match="axis xb has no travel limits"):
        calibration_of(config, config.service.guide, two, 1)


def test_the_tip_is_judged_at_the_target(tmp_path, start):
    config = configured(tmp_path)
    entry, target = (6.0, -22.0, -19.0), Target(1, (6.0, -82.0, -19.0))
    arguments = approach_of(config, config.service.guide, TRAVEL, start, entry, target, {}, 1)
    assert arguments.geometry.tip_beyond_mm == pytest.approx(80.0)
    upper, lower = arguments.target_mm[:2], arguments.target_mm[2:]
    assert upper == pytest.approx(lower)  # an upright needle: both fiducials above the target
    assert lower == pytest.approx(PLANE.from_patient((6.0, 12.0, -19.0)))


def test_a_target_in_tissue_shifts_both_fiducials_alike(tmp_path, start):
    config = configured(tmp_path)
    entry, at = (6.0, -22.0, -19.0), (9.0, -82.0, -22.0)
    oil, water = (
        approach_of(
            *(config, config.service.guide, TRAVEL, start, entry),
            Target(1, at, in_water=in_water),
            HEADER,
            1,
        )
        for in_water in (False, True)
    )
    shift_mm = 3.4 * 123.2 / 260.0
    moved = [b - a for a, b in zip(oil.target_mm, water.target_mm, strict=True)]
    assert moved == pytest.approx([0.0, shift_mm, 0.0, shift_mm])


@pytest.mark.parametrize(
    ("entry", "at", "said"),
    [
        ((6.0, -22.0, -19.0), (6.0, -140.0, -19.0), r"138\.0 mm below .* reaches 120 mm"),
        ((6.0, -22.0, -19.0), (6.0, 5.0, -19.0), r"7\.0 mm above the lower plane"),
        ((6.0, -22.0, -19.0), (6.0, -22.0, -19.0), "do not define a line"),
    ],
)
def test_a_target_that_no_needle_of_this_guide_reaches_is_refused(tmp_path, start, entry, at, said):
    config = configured(tmp_path)
    with pytest.raises(TargetError, match=said):
        approach_of(config, config.service.guide, TRAVEL, start, entry, Target(1, at), HEADER, 1)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("upper_plane_mm = 58.0", "upper_plane_mm = -2.0", "must differ"),
        ("upper_fiducial_mm = 48.0", "upper_fiducial_mm = 14.0", "above lower_fiducial_mm"),
        ("upper_slice_mm = 46.0", "upper_slice_mm = 12.0", "lower_slice_mm must differ"),
        ("upper_slice_mm = 46.0", "upper_slice_mm = 2.0", "on the same side of lower_slice_mm"),
        ("upper_slice_mm = 46.0", 'axes = ["xt", "yt", "xt", "yb"]\nupper_slice_mm = 46.0', "four"),
        ("upper_slice_mm = 46.0", "", "missing key service.guide.upper_slice_mm"),
    ],
)
def test_a_guide_that_cannot_be_is_named_by_its_key(tmp_path, old, new, said):
    with pytest.raises(ConfigError, match=said) as caught:
        configured(tmp_path, ROOM.replace(old, new))
    assert "\n" not in str(caught.value)
