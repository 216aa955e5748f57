"""HTML of the report: tables, figures, how numbers and instants are written; and its style."""

from __future__ import annotations

import base64
import html
import io
from collections.abc import Iterable, Sequence
from datetime import UTC, datetime
from typing import Any

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

STYLE = """
body { font: 15px/1.45 system-ui, sans-serif; margin: 2rem auto; max-width: 62rem;
  padding: 0 1rem; color: #222 }
h1 { font-size: 1.5rem } h2 { font-size: 1.15rem; margin-top: 2rem; break-after: avoid }
table { border-collapse: collapse; overflow-wrap: anywhere }
td, th { padding: .2rem .7rem; border-bottom: 1px solid #ddd; vertical-align: top }
th { text-align: left; font-weight: 600 } img { max-width: 100%; break-inside: avoid }
thead { display: table-header-group } tr { break-inside: avoid }
.warning { background: #fff3cd; padding: .5rem .8rem }
@page { size: A4; margin: 15mm }
@media print {
  body { margin: 0; max-width: none; font-size: 10px } td, th { padding: .1rem .35rem }
}
"""


def html_table(heads: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    first = "".join(f"<th>{html.escape(head)}</th>" for head in heads)
    lines = [
        "<tr>" + "".join(f"<td>{html.escape(str(cell))}</td>" for cell in row) + "</tr>"
        for row in rows
    ]
    head = f"<thead><tr>{first}</tr></thead>" if any(heads) else ""
    return f"<table>{head}{''.join(lines)}</table>" if lines else "<p>None.</p>"


def new_figure(width: float, height: float) -> tuple[Figure, Any]:
    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure, figure.add_subplot()


def image_tag(figure: Figure, text: str) -> str:
    stream = io.BytesIO()
    figure.savefig(stream, format="png", dpi=110)
    data = base64.b64encode(stream.getvalue()).decode("ascii")
    return f'<img alt="{html.escape(text)}" src="data:image/png;base64,{data}">'


def number_text(value: Any, factor: float = 1.0, digits: int = 1) -> str:
    return "" if value is None else f"{float(value) * factor:.{digits}f}"


def time_text(instant_s: float) -> str:
    return datetime.fromtimestamp(instant_s, UTC).strftime("%Y-%m-%d %H:%M:%S UTC")
