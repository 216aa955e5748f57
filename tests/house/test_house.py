"""The house itself: imports go downwards, the code is formatted, typed and free of lint."""

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
BIN = Path(sys.executable).parent

CHECKS = {
    "imports go downwards": ["lint-imports"],
    "no lint": ["ruff", "check", "--no-cache", "."],
    "formatted": ["ruff", "format", "--no-cache", "--check", "."],
    "typed": ["mypy"],
}


@pytest.mark.parametrize("name", CHECKS)
def test_the_house_is_in_order(name):
    program, *words = CHECKS[name]
    result = subprocess.run(
        [BIN / program, *words], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert result.returncode == 0, result.stdout + result.stderr


def test_no_mark_of_an_unfinished_merge_is_left():
    words = ["git", "grep", "-nE", "^(<{7}|>{7}) ", "--", "."]
    found = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=False)
    assert found.stdout == ""
