"""`make docs`: the site builds without a warning, formulas are MathML, nothing is fetched."""

import importlib.util
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    if importlib.util.find_spec("mkdocs") is None:
        pytest.skip("needs mkdocs (the extra `docs`)")
    target = tmp_path_factory.mktemp("site")
    built = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", target],
        cwd=ROOT, capture_output=True, text=True, check=False,
        env={**os.environ, "NO_MKDOCS_2_WARNING": "1"},
    )  # fmt: skip
    assert built.returncode == 0, built.stderr
    assert "WARNING" not in built.stderr
    return target


def test_formulas_are_shown_without_a_script(site):
    page = (site / "mathematics.html").read_text()
    assert page.count("<math") > 10
    assert "arithmatex" not in page


def test_the_reference_explains_each_argument(site):
    page = (site / "reference" / "sr_engine.html").read_text()
    assert "<code>shifts_px</code>: (N, 2)" in page


def test_nothing_is_fetched_from_elsewhere(site):
    for page in site.rglob("*.html"):
        for address in re.findall(r'(?:src|<link[^>]*href)="(https?:[^"]+)"', page.read_text()):
            pytest.fail(f"{page.relative_to(site)} fetches {address}")
