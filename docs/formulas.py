"""Formulas of the documentation site as MathML: no script, nothing fetched from elsewhere."""

import html
import re

from latex2mathml.converter import convert

_FORMULA = re.compile(
    r'<(span|div) class="arithmatex">\\([(\[])(.*?)\\[)\]]</\1>',
    re.S,
)


def on_page_content(content: str, **_: object) -> str:
    def mathml(found: re.Match[str]) -> str:
        display = "block" if found.group(2) == "[" else "inline"
        return convert(html.unescape(found.group(3)), display=display)

    return _FORMULA.sub(mathml, content)
