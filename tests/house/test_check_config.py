"""`check-config` finds what the room would refuse at its start."""

import subprocess
from pathlib import Path

import pytest

from room_config.shell import autospine

EXAMPLE = Path(__file__).parents[2] / "examples" / "room.toml"


def checked(path: Path) -> subprocess.CompletedProcess[str]:
    words = autospine("check-config", str(path))
    return subprocess.run(words, capture_output=True, text=True, check=False)


def assert_refused(path: Path, *words: str) -> None:
    """In one line and with one code, whoever is asked."""
    done = checked(path)
    assert done.returncode == 2, done.stdout + done.stderr
    assert len(done.stderr.strip().splitlines()) == 1
    assert all(word in done.stderr for word in words), done.stderr
    started = subprocess.run(
        autospine("up", "--config", str(path)), capture_output=True, text=True, timeout=120
    )
    assert (started.returncode, started.stderr) == (2, done.stderr)


def test_the_example_is_accepted():
    done = checked(EXAMPLE)
    assert done.returncode == 0, done.stderr
    assert "configuration OK" in done.stdout


@pytest.mark.parametrize(
    ("section", "line", "words"),
    [
        ("service", 'host = "0.0.0.0"', ("service.host", "token")),
        ("listener", 'peer_networks = ["10.0.0.0/33"]', ("listener.peer_networks", "10.0.0.0/33")),
        ("service", 'axes = ["xt", "zz"]', ("service.axes", "'zz'", "xt")),
        ("service", "calibration_move_mm = 4000.0", ("calibration_move_mm", "travel of xt")),
        ("service", "settle_s = 0.0", ("service.settle_s", "guard")),
        (
            "service",
            'tls_certificate = "/nowhere.pem"\ntls_key = "/nowhere.key"',
            ("service.tls_certificate", "No such file"),
        ),
    ],
)
def test_what_would_be_refused_at_the_start_is_one_line_and_code_2(tmp_path, section, line, words):
    keys = {part.split(" = ")[0] for part in line.splitlines()}
    kept, inside = [], ""
    for text in EXAMPLE.read_text().splitlines():
        inside = text.strip("[]") if text.startswith("[") else inside
        if inside == section and text.split(" = ")[0].strip() in keys:
            continue
        kept.append(text)
        if text == f"[{section}]":
            kept.append(line)
    path = tmp_path / "room.toml"
    path.write_text("\n".join(kept))
    assert_refused(path, *words)


@pytest.mark.parametrize(
    ("table", "words"),
    [
        ("foo = 3", ("camera.foo",)),
        ("", ("calling_ae_titles", "'BENCHCAMERA'", "listener.camera_slices")),
    ],
)
def test_a_camera_that_would_not_be_heard_is_named(tmp_path, table, words):
    path = tmp_path / "room.toml"
    path.write_text(f'{EXAMPLE.read_text()}\n[camera]\nsource = "0"\n{table}\n')
    assert_refused(path, *words)
