"""Wheel and source distribution: built, installed in an empty environment, and they work there."""

import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def distributions(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("dist")
    for kind in ("wheel", "sdist"):
        words = [sys.executable, "-m", "hatchling", "build", "-t", kind, "-d", str(folder)]
        done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
    return folder


def test_the_wheel_works_in_an_empty_environment(distributions, tmp_path):
    """Only what the wheel carries is ours there; the dependencies are those of this environment."""
    (wheel,) = distributions.glob("*.whl")
    place = tmp_path / "site"
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(place)
        names = archive.namelist()
    assert {"service/page/index.html", "bench/preview.html", "service/py.typed"} <= set(names)
    assert not [name for name in names if name.startswith("tests/")]
    script = "\n".join(
        [
            "import sys",
            f"ours = lambda p: p.startswith({str(ROOT)!r}) and 'site-packages' not in p",
            f"sys.path[:] = [{str(place)!r}, *(p for p in sys.path if not ours(p))]",
            "import service.cli.main as main",
            f"assert main.__file__.startswith({str(place)!r}), main.__file__",
            "main.main(['check-config', sys.argv[1]])",
        ]
    )
    words = [sys.executable, "-c", script, str(ROOT / "examples" / "room.toml")]
    done = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "configuration OK" in done.stdout


def test_the_source_distribution_can_be_built_and_tested_from(distributions):
    (sdist,) = distributions.glob("*.tar.gz")
    with tarfile.open(sdist) as archive:
        names = {name.split("/", 1)[-1] for name in archive.getnames()}
    assert {"Makefile", "requirements.lock", "CHANGELOG.md", "tests/conftest.py"} <= names
    assert not [name for name in names if "__pycache__" in name]
