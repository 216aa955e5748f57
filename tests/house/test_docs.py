"""The documentation says what the code says."""

import ast
import importlib.util
import re
import tomllib
from pathlib import Path

import pytest
from real_slices import DICOM, IS_LARGE_SET

from room_config.load import load_config

ROOT = Path(__file__).parents[2]


def test_the_configuration_page_is_the_one_that_the_models_give():
    spec = importlib.util.spec_from_file_location(
        "make_configuration", ROOT / "docs" / "make_configuration.py"
    )
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    page = (ROOT / "docs" / "configuration.md").read_text()
    assert page == module.render(), "run: python docs/make_configuration.py"


def test_the_example_room_is_valid():
    load_config(ROOT / "examples" / "room.toml", {})


def names_defined() -> set[str]:
    found: set[str] = set()
    for path in ROOT.glob("[a-z]*/**/*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
                found.add(node.name)
    return found


def test_every_function_that_the_code_flow_names_exists():
    text = (ROOT / "docs" / "code_flow.md").read_text()
    named = {
        name.split(".")[-1].removesuffix("()")
        for name in re.findall(r"`([A-Za-z_.]+(?:\(\))?)`", text)
        if name.endswith("()")
    }
    assert len(named) > 20
    assert named - names_defined() == set()


@pytest.mark.parametrize("page", ["README.md", "docs/code_flow.md", "docs/configuration.md"])
def test_links_and_pictures_of_the_pages_exist(page):
    path = ROOT / page
    for target in re.findall(r"\]\(([^)#]+)[^)]*\)", path.read_text()):
        if "://" not in target:
            assert (path.parent / target).exists(), target


def test_the_distribution_carries_every_package():
    table = tomllib.loads((ROOT / "pyproject.toml").read_text())
    packages = set(table["tool"]["hatch"]["build"]["targets"]["wheel"]["packages"])
    on_disk = {p.parent.name for p in ROOT.glob("[a-z]*/__init__.py")} - {"tests", "benchmarks"}
    assert packages == on_disk


@pytest.mark.skipif(not IS_LARGE_SET, reason="made from the large set of real slices")
def test_the_page_of_vendors_is_what_the_real_files_give():
    spec = importlib.util.spec_from_file_location("make_vendors", ROOT / "docs" / "make_vendors.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    page = (ROOT / "docs" / "vendors.md").read_text()
    assert page == module.render(DICOM), "run: python docs/make_vendors.py"
