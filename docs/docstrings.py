"""Our docstrings for the documentation site: a line `name: what it is` becomes a row of a list."""

import re

import griffe

_ROW = re.compile(r"^((?:[a-z_]\w*(?:, )?)+): (?=\S)")


def as_markdown(text: str) -> str:
    """Rows that begin with names and a colon, and the lines that go on with them, as a list."""
    lines, inside = [], False
    for line in text.splitlines():
        if found := _ROW.match(line):
            if not inside:
                lines.append("")
            names = ", ".join(f"`{name}`" for name in found.group(1).split(", "))
            lines.append(f"- {names}: {line[found.end() :]}")
            inside = True
        else:
            inside = inside and bool(line.strip())
            lines.append(f"  {line.strip()}" if inside else line)
    return "\n".join(lines)


class Rows(griffe.Extension):
    def on_object(self, *, obj: griffe.Object, **_: object) -> None:
        if obj.docstring is not None:
            obj.docstring.value = as_markdown(obj.docstring.value)
