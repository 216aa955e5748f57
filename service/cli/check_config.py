"""`autospine check-config FILE`: every key of a room's file checked, nothing started."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from robot_bridge.daemon.config import ConfigError as BridgeConfigError
from robot_bridge.daemon.config import bridge_config_from_table
from room_config.load import ConfigError, load_config
from service.cli.room_checks import problems_of

app = typer.Typer(add_completion=False)


@app.command()
def check_config(file: Annotated[Path, typer.Argument(help="The room's TOML file.")]) -> None:
    """Check a room's configuration."""
    config = load_config(file)
    bridge = None
    if config.bridge:
        try:
            bridge = bridge_config_from_table(config.bridge, str(file))
        except BridgeConfigError as error:
            raise ConfigError(str(error)) from None
    if problems := problems_of(config, bridge):
        raise ConfigError(f"{file}: {'; '.join(problems)}")
    scope = "bridge included" if bridge else "no [bridge] in this file"
    print(f"{file}: configuration OK: room {config.room.name!r}, {scope}")
