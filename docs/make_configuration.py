"""Writes docs/configuration.md from the configuration models: `python docs/make_configuration.py`."""

from __future__ import annotations

from pathlib import Path
from typing import Any, get_args

from pydantic import BaseModel
from pydantic_core import PydanticUndefined

from room_config.imaging import PointSpreadConfig
from room_config.load import Config
from room_config.outputs import Destination
from room_config.service import AccessToken, GuideConfig
from simulator.config import VirtualRoom

HERE = Path(__file__).parent
_HEAD = """# Configuration

One TOML file a room (`examples/room.toml` is one). It is strict: an unknown, misspelt or missing
key is an error that names the file and the key. Units are in the key names.
`autospine check-config FILE` checks a file without starting anything.

An environment variable overrides a key: `AUTOSPINE_LISTENER__PORT=11112` is `port` in `[listener]`
(for containers). Secrets are hashes or file names, never values that a log could show.

This page is written by `python docs/make_configuration.py` from the models themselves.
"""
_BRIDGE = """
## `[bridge]` and `[[bridge.axis]]`

Read by the daemon in the scanner room (`robot_bridge/daemon/config.py`), which has few dependencies and
checks the table itself. Travel limits deliberately have no default.

| key | default | meaning |
| --- | --- | --- |
| `link` | none | Serial device or pyserial URL of the line to the service; not needed on a bench. |
| `link_baud` | 115200 | Speed of that line. |
| `state_dir` | required | Folder of the journal, relative to the file; must survive a restart. |
| `status_file` | `state_dir`/bridge_status.json | Health, rewritten as the bridge runs. |
| `heartbeat_s`, `deadman_s` | 0.2, 1.0 | Silence from the service for longer than the deadman stops all motion. |
| `motion_timeout_s` | 120 | A motion that lasts longer is stopped; `check-config` says if homing needs more. |
| `motion_poll_s` | 0.02 | How often the controllers are polled during a motion. |
| `controller_baud`, `controller_timeout_s` | 115200, 0.1 | The line to the controllers. |
| `controller_response_delay_us` | 20 | Their pause before a response; longer behind a fibre converter. |
| `park_after_move` | false | Park the drives after every move (a powered drive costs SNR). |
| `guardian` | true | A second process that stops the motors if the daemon is killed. |
| `capture_file` | none | Every byte to and from the controllers. |
| `service_link` | none | The service's end of the line, for `autospine robot`; else `[service] bridge_link`. |
| axis `name` | required | `xt`, `yt` (top stage), `xb`, `yb` (bottom stage). |
| axis `controller`, `address` | required | Serial device (`/dev/serial/by-id/...`) and address. |
| axis `serial_number` | none | Of the board (Y42); absent: the one that answers first is remembered. |
| axis `drive` | required | `open_loop` (steps) or `closed_loop` (encoder). |
| axis `travel_min_mm`, `travel_max_mm` | required | Both ends allowed. |
| axis `sign` | required | 1 or -1: whether the position increases when the controller runs forward. |
| axis `speed_hz` | 400 | wfm-steps per second, capped by the controller's own limit. |
| axis `step_um_forward`, `step_um_reverse` | required open loop | From `autospine robot calibrate-steps`. |
| axis `step_error` | 0.05 | Relative error of these; the bound of a counted position grows by it. |
| axis `approach_um` | 0 | Overshoot so that every position is reached from the same side. |
| axis `tolerance_um` | 20 | An axis this close to its setpoint counts as there and is not moved. |
| axis `counts_per_mm`, `tolerance_counts`, `encoder_type` | closed loop | The encoder; type is Y13. |
| axis `encoder_direction` | flash | Y6, from `autospine robot find-encoder`. |
| axis `home_mm` | none | Where the reference lies. |
| axis `home_to` | `end` | `end` (limit switch or mechanical end) or `index` of the encoder. |
| axis `limit_switches` | flash | Y2: 0 none, 1 active high, 2 active low. |
| axis `ramp_up_hz_per_ms`, `overshoot_model`, `waveform` | 20, 3, `delta` | Y9, Y12, `delta` or `rhomb`. |
| axis `estop_input` | none | Input 0 or 3 of the board: low means that the emergency stop is pressed. |
"""

GUIDE_TEXT = (
    "A robot with two stages and a fiducial in each of two slices: needle line and tip are steered, "
    "with four axes, to an entry and a target point. Positions are along the slice normal (patient y "
    "of coronal slices), distances along the guide from the lower ball joint."
)


def render() -> str:
    """Return the whole page."""
    parts = [_HEAD]
    for name, field in Config.model_fields.items():
        for model in get_args(field.annotation) or (field.annotation,):
            if isinstance(model, type) and issubclass(model, BaseModel):
                parts.append(f"\n## `[{name}]`\n\n{_table(model)}")
    parts.append(f"\n## `[imaging.point_spread]`\n\n{_table(PointSpreadConfig)}")
    parts.append(f"\n## `[service.guide]`\n\n{GUIDE_TEXT}\n\n{_table(GuideConfig)}")
    parts.append(f"\n## `[[service.token]]`\n\n{_table(AccessToken)}")
    parts.append(f"\n## `[[outputs.destination]]`\n\n{_table(Destination)}")
    parts.append(_BRIDGE)
    parts.append(
        "\n## `[virtual]`\n\nThe virtual room, for `autospine demo` and `autospine scanner`; its keys "
        "are described where they are defined, in `simulator/config.py`. Top-level keys: "
        + ", ".join(f"`{key}`" for key in VirtualRoom.model_fields)
        + ".\n"
    )
    return "".join(parts)


def _table(model: type[BaseModel]) -> str:
    rows = ["| key | default | meaning |", "| --- | --- | --- |"]
    for name, field in model.model_fields.items():
        meaning = " ".join((field.description or "").split())
        rows.append(f"| `{name}` | {_default(field)} | {meaning} |")
    return "\n".join(rows) + "\n"


def _default(field: Any) -> str:
    if field.is_required():
        return "required"
    value = field.default
    if value is PydanticUndefined:
        value = field.default_factory()
    return "none" if value in (None, "", (), []) else f"`{value}`"


if __name__ == "__main__":
    (HERE / "configuration.md").write_text(render(), encoding="utf-8")
