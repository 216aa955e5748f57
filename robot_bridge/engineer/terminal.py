"""What the engineer's commands say and ask at the terminal, and how they give up."""

import argparse
import contextlib
import json
import sys
from collections.abc import Mapping

from robot_bridge.daemon.config import AxisConfig, BridgeConfig


class UsageError(Exception):
    """The command cannot be carried out as it was given; one line."""


class CouldNotError(Exception):
    """It was tried and did not work; one line."""


def show(args: argparse.Namespace, fields: dict[str, object]) -> None:
    if args.json:
        print(json.dumps(fields))
        return
    for name, value in fields.items():
        lines = (
            [_said(part) for part in value] if isinstance(value, list | tuple) else [_said(value)]
        )
        print(f"{name:20} " + ("\n" + " " * 21).join(lines or ["-"]))


def _said(value: object) -> str:
    """Of a field, for people: no brackets and quotes; programs ask for --json."""
    if isinstance(value, Mapping):
        parts = ((name, _said(part), isinstance(part, Mapping)) for name, part in value.items())
        said = ", ".join(
            f"{name} ({part})" if deep else f"{name} {part}" for name, part, deep in parts
        )
        return said or "-"
    if isinstance(value, bool):
        return "yes" if value else "no"
    return "-" if value in (None, "") else str(value)


def confirm(args: argparse.Namespace, what: str) -> None:
    if args.yes:
        return
    if not sys.stdin.isatty():
        raise UsageError(f"about to {what}: confirm with --yes")
    if input(f"About to {what}. Needle out, hands clear? [y/N] ").strip().lower() != "y":
        raise CouldNotError("not confirmed; nothing moved")


def ask_for_um(what: str) -> float:
    if not sys.stdin.isatty():
        raise UsageError("without an encoder you measure the axis yourself: run this on a terminal")
    while True:
        with contextlib.suppress(ValueError):
            return float(input(f"{what}: gauge reading along the axis, mm: ")) * 1000.0


def axis_named(config: BridgeConfig, name: str) -> AxisConfig:
    for axis in config.axes:
        if axis.name == name:
            return axis
    raise UsageError(f"axis {name!r} is not one of {', '.join(a.name for a in config.axes)}")
