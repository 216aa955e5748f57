"""What the demo shows in a terminal: one line of progress, a live table, the final table."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich.console import Console, Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from simulator.demo.operator import Operator, PunctureResult


class DemoScreen:
    """On a terminal a live table; in a pipe one line for each thing that changes."""

    def __init__(self, console: Console, folder: Path) -> None:
        self._console = console
        self._folder = folder
        self._live: Live | None = None
        self._last = ""

    def __enter__(self) -> DemoScreen:
        if self._console.is_terminal:
            self._live = Live(console=self._console, refresh_per_second=8, transient=True)
            self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._live is not None:
            self._live.stop()
            self._live = None

    def note(self, text: str) -> None:
        self._console.print(Text(text, style="dim"), highlight=False, soft_wrap=True)

    def show(self, state: dict[str, Any], operator: Operator) -> None:
        """Show the newest state and the punctures so far."""
        now = f"{state['robot']['phase']:<15} {state['prompt']}"
        if self._live is not None:
            table = final_table(operator.results, None) if operator.results else Text("")
            self._live.update(Group(table, Text(now)))
        elif now != self._last:
            self._console.print(Text(now), highlight=False, soft_wrap=True)
        self._last = now


def final_table(results: Sequence[PunctureResult], unintended: int | None) -> Table:
    """Every puncture with the true error beside the estimated one."""
    caption = "virtual room: physics and images are simulated, the truth is known"
    if unintended is not None:
        caption = f"unintended motions: {unintended}; {caption}"
    table = Table(title="AutoSPINe demo", caption=caption)
    names = ("puncture", "true error", "estimated", "σ", "iterations", "frames", "scan")
    for name in names:
        table.add_column(name, justify="right")
    for number, result in enumerate(results, start=1):
        table.add_row(
            str(number),
            f"{result.true_error_mm:.3f} mm",
            f"{result.estimated_error_mm:.3f} mm",
            f"{result.sigma_mm:.3f} mm",
            str(result.iterations),
            str(result.frames),
            f"{result.scan_s:.1f} s",
        )
    return table
