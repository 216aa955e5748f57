"""The [bridge] table: everything that is wrong is one line that names file and key."""

import tomllib
from pathlib import Path

import pytest

from robot_bridge.daemon.config import ConfigError, bridge_config_from_table, load_bridge_config

GOOD = """
[bridge]
link = "/dev/ttyUSB0"
state_dir = "state"

[[bridge.axis]]
name = "xt"
controller = "/dev/ttyUSB1"
address = 1
drive = "closed_loop"
travel_min_mm = -12.3456
travel_max_mm = 0.0299
sign = -1
counts_per_mm = 78.74

[[bridge.axis]]
name = "yt"
controller = "/dev/ttyUSB1"
address = 2
drive = "open_loop"
travel_min_mm = -10
travel_max_mm = 10
sign = 1
step_um_forward = 4.4
step_um_reverse = 4.6
"""


def load(text: str):
    return bridge_config_from_table(tomllib.loads(text)["bridge"], "room.toml")


def test_a_good_table_is_read_and_travel_is_rounded_inwards():
    config = load(GOOD)
    assert config.deadman_s == 1.0
    assert (config.axes[0].travel_min_um, config.axes[0].travel_max_um) == (-12345, 29)
    assert (config.axes[1].travel_min_um, config.axes[1].travel_max_um) == (-10_000, 10_000)
    assert config.axes[1].step_um_reverse == 4.6


BAD = [
    ("state_dir", "statedir", r"bridge\.state_dir: is missing"),
    ('state_dir = "state"', 'state_dir = "state"\nheart_beat_s = 1', r"heart_beat_s: is not a kn"),
    ('link = "/dev/ttyUSB0"', "link = 7", r"bridge\.link: 7 is not text"),
    ('state_dir = "state"', 'state_dir = "state"\ndeadman_s = nan', r"deadman_s: nan is not"),
    ('state_dir = "state"', 'state_dir = "state"\ndeadman_s = true', r"deadman_s: True is not"),
    (
        'state_dir = "state"',
        'state_dir = "state"\ndeadman_s = 0.5',
        r"three heartbeats",
    ),
    ('state_dir = "state"', 'state_dir = "state"\nlink_baud = 1.5e5', r"link_baud: 150000.0 is no"),
    ("travel_max_mm = 0.0299", "travel_max_mm = nan", r"axis\[0\] \(xt\)\.travel_max_mm: nan"),
    ("travel_max_mm = 0.0299", "travel_max_mm = -13", r"\(xt\)\.travel_max_mm: -13 is not above"),
    ("travel_max_mm = 0.0299", "travel_max_mm = inf", r"travel_max_mm: inf is not a number"),
    ("travel_min_mm = -10\n", "", r"axis\[1\] \(yt\)\.travel_min_mm: is missing"),
    ("sign = -1", "sign = 0", r"\(xt\)\.sign: must be 1 or -1"),
    ("sign = -1", "sign = 2", r"\(xt\)\.sign: 2 is not a number from -1 to 1"),
    ("address = 2", "address = 1", r"'yt' and 'xt' have the same address 1 on /dev/ttyUSB1"),
    ("address = 2", "address = 127", r"\(yt\)\.address: 127 is not"),
    ('name = "yt"', 'name = "xt"', r"the name 'xt' appears twice"),
    ('drive = "open_loop"', 'drive = "open"', r"'open' is not one of open_loop, closed_loop"),
    ("step_um_reverse = 4.6", "", r"\(yt\)\.step_um_reverse: is missing"),
    ("step_um_reverse = 4.6", "step_um_reverse = -4.6", r"step_um_reverse: -4.6 is not"),
    ("counts_per_mm = 78.74", "", r"\(xt\)\.counts_per_mm: is missing"),
    ("counts_per_mm = 78.74", "counts_per_mm = 0", r"counts_per_mm: 0 is not a number"),
    ("counts_per_mm = 78.74", "counts_per_mm = 78.74\ncolour = 1", r"\(xt\)\.colour: is not a kn"),
    ("counts_per_mm = 78.74", "counts_per_mm = 78.74\nhome_mm = 1", r"home_mm: 1 is not a number"),
]


@pytest.mark.parametrize(("old", "new", "message"), BAD, ids=[message for *_, message in BAD])
def test_a_bad_table_is_refused_with_the_key_by_name(old: str, new: str, message: str):
    assert old in GOOD
    with pytest.raises(ConfigError, match=message) as caught:
        load(GOOD.replace(old, new, 1))
    assert "\n" not in str(caught.value)


def test_homing_needs_more_time_the_more_axes_share_a_slow_bus():
    first, second = GOOD.split("[[bridge.axis]]")[1:]
    first = first.replace("travel_min_mm = -12.3456", "travel_min_mm = -40\nhome_mm = -40")
    alone = f"{GOOD.split('[[bridge.axis]]')[0]}[[bridge.axis]]{first}"
    config = load(alone)
    asked_s = config.axes[0].homing_s(1)
    timeout = f"motion_timeout_s = {asked_s + 0.1:.1f}\n"
    load(alone.replace("[bridge]\n", f"[bridge]\n{timeout}"))
    both = f"{alone}[[bridge.axis]]{second}".replace("[bridge]\n", f"[bridge]\n{timeout}")
    with pytest.raises(ConfigError, match=r"homing of 'xt' may take .* with 2 axes on its port"):
        load(both)


@pytest.mark.parametrize("table", [[], 7, None, {"link": "a", "state_dir": "b", "axis": [7]}])
def test_a_table_that_is_none_is_a_config_error(table):
    with pytest.raises(ConfigError, match=r"room\.toml"):
        bridge_config_from_table(table, "room.toml")


def test_a_file_that_is_missing_broken_or_without_the_table_is_named(tmp_path: Path):
    file = tmp_path / "room.toml"
    with pytest.raises(ConfigError, match=r"room\.toml: cannot be read: No such file"):
        load_bridge_config(file)
    file.write_text("[bridge\n")
    with pytest.raises(ConfigError, match=r"room\.toml: is not TOML"):
        load_bridge_config(file)
    file.write_bytes(b"\xff\xfe")
    with pytest.raises(ConfigError, match=r"room\.toml: is not TOML"):
        load_bridge_config(file)
    file.write_text("[service]\n")
    with pytest.raises(ConfigError, match=r"the table \[bridge\] is missing"):
        load_bridge_config(file)
    file.write_text(GOOD)
    assert load_bridge_config(file).link == "/dev/ttyUSB0"


def test_the_services_own_end_of_the_line_is_found_in_the_same_file(tmp_path: Path):
    file = tmp_path / "room.toml"
    file.write_text(GOOD)
    assert load_bridge_config(file).service_link is None
    file.write_text(GOOD + '[service]\nbridge_link = "/dev/ttyS9"\n')
    assert load_bridge_config(file).service_link == "/dev/ttyS9"
    text = GOOD.replace("[bridge]", '[bridge]\nservice_link = "/dev/ttyS8"')
    file.write_text(text + '[service]\nbridge_link = "/dev/ttyS9"\n')
    assert load_bridge_config(file).service_link == "/dev/ttyS8"
