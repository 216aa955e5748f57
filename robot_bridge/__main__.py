"""`python -m robot_bridge --config FILE`: the bridge daemon, with the bridge's own packages only.

Exit codes: 0 it was asked to end, 2 bad configuration, 3 it could not run (device, motors).
"""

import argparse
import logging
import sys
from collections.abc import Sequence
from pathlib import Path

from robot_bridge.daemon.config import BridgeConfig, ConfigError, load_bridge_config
from robot_bridge.daemon.guardian import Guardian, StopOrder
from robot_bridge.daemon.main import JsonLines, StartError, run_bridge
from robot_bridge.pmd.driver import PmdMotors
from robot_bridge.pmd.protocol import emergency_stop_bytes

EXIT_DONE, EXIT_BAD_INPUT, EXIT_COULD_NOT = 0, 2, 3


def make_motors(config: BridgeConfig, *, exclusive: bool = True) -> PmdMotors:
    """exclusive: hold the ports alone; only a stop asks for less."""
    return PmdMotors(
        config.axes,
        baud=config.controller_baud,
        timeout_s=config.controller_timeout_s,
        response_delay_us=config.controller_response_delay_us,
        park_after_move=config.park_after_move,
        capture_file=config.capture_file,
        exclusive=exclusive,
    )


def stop_orders(config: BridgeConfig) -> list[StopOrder]:
    """What the guardian writes to each controller port."""
    addresses: dict[str, list[int]] = {}
    for axis in config.axes:
        addresses.setdefault(axis.controller, []).append(axis.address)
    return [
        StopOrder(url, config.controller_baud, (emergency_stop_bytes(on_it),))
        for url, on_it in addresses.items()
    ]


def make_guardian(config: BridgeConfig) -> Guardian:
    return Guardian(stop_orders(config), silent_s=config.deadman_s)


def log_json_lines() -> None:
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(JsonLines())
    root = logging.getLogger("robot_bridge")
    root.addHandler(handler)
    root.setLevel(logging.INFO)
    root.propagate = False


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="autospine bridge", description=__doc__)
    parser.add_argument("--config", type=Path, required=True, help="the room's TOML file")
    parser.add_argument(
        "--exit-with-parent", action="store_true", help="end when standard input closes"
    )
    args = parser.parse_args(argv)
    try:
        config = load_bridge_config(args.config)
    except ConfigError as error:
        print(f"autospine bridge: {error}", file=sys.stderr)
        return EXIT_BAD_INPUT
    log_json_lines()
    try:
        reason = run_bridge(
            config, make_motors, make_guardian, exit_with_parent=args.exit_with_parent
        )
    except StartError as error:
        print(f"autospine bridge: {error}", file=sys.stderr)
        return EXIT_COULD_NOT
    except Exception as error:
        print(f"autospine bridge: {type(error).__name__}: {error}", file=sys.stderr)
        return EXIT_COULD_NOT
    return EXIT_COULD_NOT if reason == "guardian lost" else EXIT_DONE


if __name__ == "__main__":
    sys.exit(main())
