"""Lists every text that a person may read: `python docs/list_texts.py [PACKAGE…]`.

Prompts, alarms, refusals, errors, help, reports and configuration keys stand where they are used;
the page's own texts stand in service/page/texts.js. docs/vocabulary.md has the words.
"""

from __future__ import annotations

import ast
import re
import sys
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parent.parent
PACKAGES = (
    "service",
    "robot_bridge",
    "dicom_listener",
    "dicom_slice",
    "sr_engine",
    "case_record",
    "room_config",
    "simulator",
    "bench",
    "studies",
)
_SQL = re.compile(r"\s*(?:SELECT|CREATE|INSERT|UPDATE|PRAGMA|DELETE)\b")
_WORD = re.compile(r"[^\W\d_]{2,}")
_PAGE = (
    ("service/page/texts.js", re.compile(r'"((?:[^"\\]|\\.)+)"|`((?:[^`\\]|\\.)+)`')),
    ("service/page/index.html", re.compile(r'>([^<>]+)<|(?:aria-label|title)="([^"]+)"')),
)
_FEWEST_WORDS = 3


def texts(packages: tuple[str, ...] = PACKAGES) -> Iterator[tuple[Path, int, str]]:
    """File, line and text; what is filled in stands in braces."""
    for package in packages:
        for path in sorted((ROOT / package).rglob("*.py")):
            for line, text in sorted(_in_python(path.read_text())):
                if _is_sentence(text):
                    yield path.relative_to(ROOT), line, " ".join(text.split())
    for name, pattern in _PAGE if "service" in packages else ():
        for line, code in enumerate((ROOT / name).read_text().splitlines(), 1):
            for found in pattern.finditer(code):
                if _WORD.search(text := found.group(1) or found.group(2)):
                    yield Path(name), line, text.strip()


def _in_python(code: str) -> Iterator[tuple[int, str]]:
    tree = ast.parse(code)
    skipped = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    for node in ast.walk(tree):
        if isinstance(node, ast.JoinedStr):
            parts = [part for part in node.values if isinstance(part, ast.Constant)]
            skipped.update(map(id, parts))
            yield node.lineno, "".join(map(_part, node.values))
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and id(node) not in skipped:
            yield node.lineno, node.value if isinstance(node.value, str) else ""


def _part(value: ast.expr) -> str:
    if isinstance(value, ast.Constant):
        return str(value.value)
    assert isinstance(value, ast.FormattedValue)
    return "{" + ast.unparse(value.value) + "}"


def _is_sentence(text: str) -> bool:
    wordy = len(_WORD.findall(text)) >= _FEWEST_WORDS and " " in text.strip()
    return wordy and not _SQL.match(text)


if __name__ == "__main__":
    before = None
    for path, line, text in texts(tuple(sys.argv[1:]) or PACKAGES):
        if path != before:
            print(f"\n## {path}")
        before = path
        print(f"{line}: {text}")
