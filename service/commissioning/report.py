"""The acceptance as a page (HTML) and as a document (PDF), with who signs for it."""

from __future__ import annotations

import html
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from matplotlib.backends.backend_pdf import PdfPages
from matplotlib.figure import Figure

from service.commissioning.acceptance import Item

_STYLE = (
    "body{font:15px/1.45 system-ui,sans-serif;margin:2rem auto;max-width:60rem}"
    "td,th{padding:.2rem .7rem;border-bottom:1px solid #ddd;text-align:left}.no{color:#b00020}"
)
_PASSED = {True: "passed", False: "NOT PASSED", None: ""}
_ROWS_A_PAGE = 24


@dataclass(frozen=True)
class Signature:
    """Who measured, when (UTC), and the SHA-256 of the evidence that the findings rest on."""

    who: str
    at_s: float
    evidence_sha256: str

    def __str__(self) -> str:
        when = datetime.fromtimestamp(self.at_s, UTC).strftime("%Y-%m-%d %H:%M UTC")
        return (
            f"Measured and signed by {self.who}, {when}. Evidence: SHA-256 {self.evidence_sha256}"
        )


def verdict_of(items: Sequence[Item]) -> str:
    failed = [item.what for item in items if item.passed is False]
    return "Accepted" if not failed else f"Not accepted: {'; '.join(failed)}"


def write_html(path: Path, site: str, items: Sequence[Item], signature: Signature) -> None:
    rows = "".join(
        f'<tr class="{"no" if item.passed is False else ""}">'
        + "".join(
            f"<td>{html.escape(text)}</td>"
            for text in (item.what, item.value, item.limit, _PASSED[item.passed])
        )
        + "</tr>"
        for item in items
    )
    path.write_text(
        f"<!doctype html><meta charset=utf-8><title>Acceptance of {html.escape(site)}</title>"
        f"<style>{_STYLE}</style><h1>Acceptance of {html.escape(site)}</h1>"
        f"<p><strong>{html.escape(verdict_of(items))}</strong></p>"
        f"<table><tr><th>what<th>found<th>limit<th></tr>{rows}</table>"
        f"<p>{html.escape(str(signature))}</p>"
        "<p>Research software, not a medical device.</p>",
        encoding="utf-8",
    )


def write_pdf(path: Path, site: str, items: Sequence[Item], signature: Signature) -> None:
    with PdfPages(path) as pages:
        for first in range(0, len(items), _ROWS_A_PAGE):
            figure = Figure(figsize=(8.27, 11.69))
            figure.text(0.08, 0.95, f"Acceptance of {site}", size=16)
            figure.text(0.08, 0.925, verdict_of(items), size=10, wrap=True)
            for row, item in enumerate(items[first : first + _ROWS_A_PAGE]):
                y = 0.89 - 0.034 * row
                colour = "#b00020" if item.passed is False else "black"
                figure.text(0.08, y, item.what, size=8, color=colour)
                words = f"{item.value}   [{item.limit}]   {_PASSED[item.passed]}"
                figure.text(0.1, y - 0.014, words, size=8, color=colour)
            figure.text(0.08, 0.05, str(signature), size=6)
            figure.text(0.08, 0.03, "Research software, not a medical device.", size=6)
            pages.savefig(figure)
