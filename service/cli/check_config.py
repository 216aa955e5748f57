"""`autospine check-config FILE`: every key of a room's file checked, nothing started."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from service.cli.room_checks import checked_room

app = typer.Typer(add_completion=False)


@app.command()
def check_config(file: Annotated[Path, typer.Argument(help="The room's TOML file.")]) -> None:
    """Check a room's configuration."""
    config, bridge = checked_room(file)
    scope = "bridge included" if bridge else "no [bridge] in this file"
    print(f"{file}: configuration OK: room {config.room.name!r}, {scope}")
