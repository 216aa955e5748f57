"""The configuration is strict, and its errors name the file and the key in one line."""

from pathlib import Path

import pytest

from room_config.load import ConfigError, load_config
from sr_engine.psf import Psf

MINIMAL = """
[room]
name = "test room"
case_dir = "case"

[service]
bridge_link = "/dev/ttyUSB0"
"""


def config_file(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "room.toml"
    path.write_text(text)
    return path


def test_relative_case_folder_is_relative_to_the_file(tmp_path):
    config = load_config(config_file(tmp_path, MINIMAL), {})
    assert config.room.case_dir == tmp_path / "case"


def test_the_environment_overrides_the_file(tmp_path):
    environment = {"AUTOSPINE_LISTENER__PORT": "104", "AUTOSPINE_ROOM__CASE_DIR": "/data/case"}
    config = load_config(config_file(tmp_path, MINIMAL), environment)
    assert config.listener.port == 104
    assert config.room.case_dir == Path("/data/case")


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (MINIMAL.replace('name = "test room"', ""), "missing key room.name"),
        (MINIMAL.replace("case_dir", "cases_dir").replace('"case"', "7"), "key room.cases_dir"),
        (MINIMAL.replace('case_dir = "case"', ""), "key room: .*cases_dir is missing"),
        (
            MINIMAL.replace("[service]", 'cases_dir = "cases"\n[service]'),
            "key room: .*cases_dir and case_dir exclude each other",
        ),
        (MINIMAL + "tolerance_m = 1", "unknown key service.tolerance_m .*tolerance_mm"),
        (MINIMAL + "tolerance_mm = -1", "key service.tolerance_mm: .*got -1"),
        (MINIMAL + "tolerance_mm = nan", "key service.tolerance_mm"),
        (MINIMAL + "[listner]\nport = 1", "unknown key listner .*listener"),
        (MINIMAL + "tolerance_mm =", "not valid TOML"),
        (
            MINIMAL + "[imaging.point_spread]\nkind = 'fermi'\nparameters = [0.9]",
            "key imaging.point_spread: .*fermi takes 2 parameters, got 1",
        ),
        (
            MINIMAL + "[imaging.point_spread]\nkind = 'sinc'",
            "key imaging.point_spread.kind: .*'hamming'",
        ),
        (
            MINIMAL + "[imaging.point_spread]\nkind = 'flat'\nacquired = [1.5, 1.0]",
            "key imaging.point_spread.acquired.0: .*got 1.5",
        ),
    ],
)
def test_a_wrong_key_is_named_with_its_file(tmp_path, text, expected):
    with pytest.raises(ConfigError, match=expected) as caught:
        load_config(config_file(tmp_path, text), {})
    assert "room.toml" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(ConfigError, match=r"nothing\.toml"):
        load_config(tmp_path / "nothing.toml", {})


@pytest.mark.parametrize("kind", ["flat", "hamming", "fermi", "elliptical"])
def test_every_configurable_point_spread_is_one_of_the_engines(tmp_path, kind):
    text = MINIMAL + f"[imaging.point_spread]\nkind = '{kind}'"
    configured = load_config(config_file(tmp_path, text), {}).imaging.point_spread
    assert Psf(configured.kind, configured.parameters, configured.acquired).kind == kind
