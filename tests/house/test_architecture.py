"""The folders tell the architecture: no import cycle, no warren, and a page that says what is."""

import ast
import re
import tomllib
from collections import Counter
from pathlib import Path

ROOT = Path(__file__).parents[2]
PACKAGES = tuple(sorted(p.parent.name for p in ROOT.glob("[a-z]*/__init__.py")))
MOST_MODULES_IN_A_FOLDER = 25


def module_files() -> dict[str, Path]:
    files = {}
    for package in PACKAGES:
        for path in (ROOT / package).rglob("*.py"):
            parts = path.relative_to(ROOT).with_suffix("").parts
            files[".".join(parts).removesuffix(".__init__")] = path
    return files


def imports_between(files: dict[str, Path]) -> dict[str, set[str]]:
    """Module -> modules of ours that it imports anywhere, inside functions too."""
    found: dict[str, set[str]] = {name: set() for name in files}
    for name, path in files.items():
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Import):
                wanted = {alias.name for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.module:
                inner = {f"{node.module}.{alias.name}" for alias in node.names}
                wanted = {one if one in files else node.module for one in inner}
            else:
                continue
            found[name] |= wanted & files.keys()
    return found


def test_no_modules_import_each_other_in_a_circle():
    left = imports_between(module_files())
    while leaves := {name for name, needs in left.items() if not needs & left.keys()}:
        left = {name: needs for name, needs in left.items() if name not in leaves}
    # what is left imports, or is imported by, a circle
    while roots := left.keys() - set().union(*left.values(), set()):
        left = {name: needs for name, needs in left.items() if name not in roots}
    assert sorted(left) == []


def test_no_folder_is_a_warren():
    counts = Counter(path.parent for path in module_files().values() if path.stem != "__init__")
    assert {str(f): n for f, n in counts.items() if n > MOST_MODULES_IN_A_FOLDER} == {}


def contracts() -> dict[str, list[str]]:
    table = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]
    return {
        (c.get("containers") or ["house"])[0]: c["layers"]
        for c in table["contracts"]
        if c["type"] == "layers"
    }


def test_no_two_files_of_the_tests_have_one_name():
    """They are imported by name alone: of two, whichever comes first would serve both."""
    names = Counter(path.name for path in (ROOT / "tests").rglob("*.py"))
    assert [n for n, count in names.items() if count > 1 and n != "conftest.py"] == []


def test_the_architecture_page_names_the_floors_that_import_linter_keeps():
    page = (ROOT / "docs" / "architecture.md").read_text()
    house = re.findall(r"^\| (\d) \| `(\w+)` \|", page, re.M)
    layers = contracts()["house"]
    expected = [
        (len(layers) - depth, name.strip())
        for depth, layer in enumerate(layers)
        for name in layer.split("|")
    ]
    assert sorted((int(floor), name) for floor, name in house) == sorted(expected)
    assert {name for _, name in house} == set(PACKAGES)
    for package in ("service", "robot_bridge"):
        section = page.split(f"Inside `{package}`")[1].split("\n## ")[0].split("\nInside")[0]
        named = re.findall(r"^\| `(\w+)` \|", section, re.M)
        floors = [part.strip() for layer in contracts()[package] for part in layer.split("|")]
        assert named == floors
        assert len(contracts()[package]) <= 7


def test_every_place_that_the_architecture_page_names_exists():
    page = (ROOT / "docs" / "architecture.md").read_text()
    named = {name for name in re.findall(r"`([\w/.]+/[\w.]*)`", page)}
    assert len(named) > 10
    assert [name for name in sorted(named) if not (ROOT / name).exists()] == [
        "web/routes"
    ]  # below `service`
