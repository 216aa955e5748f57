"""The engineer's commands that need a bridge: a running one, or the same inside this process."""

import argparse
import contextlib
import json
import math
import secrets
import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from pathlib import Path

from robot_bridge.client.client import (
    BridgeClient,
    BridgeError,
    BridgeStatus,
    LinkLostError,
    MoveOutcome,
)
from robot_bridge.daemon.config import BridgeConfig
from robot_bridge.engineer import sessions
from robot_bridge.engineer.at_motors import drives_directly, stop_motors, what_boards_say
from robot_bridge.engineer.terminal import CouldNotError, UsageError, axis_named, confirm, show
from robot_bridge.protocol.framing import encode_stop
from robot_bridge.protocol.phases import WorkPhase
from robot_bridge.protocol.transport import SerialTransport, TransportError

STATUS_FILE_FRESH_S = 3.0
STOP_WAIT_S = 5.0
SHOUTS = 10
JOG_MAX_MM = 5.0


@contextlib.contextmanager
def connected(args: argparse.Namespace, config: BridgeConfig) -> Iterator[BridgeClient]:
    """A client with an open session, to a running bridge or to one inside this process."""
    with contextlib.ExitStack() as stack:
        if args.direct:
            client = stack.enter_context(sessions.bridge_inside(config))
        else:
            client = _client_on_the_line(args, config)
        try:
            client.open(args.timeout)
            if args.at:
                _declare(client, args.at, args.by)
            yield client
        finally:
            client.close()


def _client_on_the_line(args: argparse.Namespace, config: BridgeConfig) -> BridgeClient:
    url = args.link or config.service_link
    if url is None:
        raise UsageError(
            f"{args.config}: bridge.service_link: is missing; give the line with --link, or talk "
            "to the motors with --direct"
        )
    return sessions.client_on_the_line(config, url)


# --- looking ----------------------------------------------------------------------------------


def show_status(args: argparse.Namespace, config: BridgeConfig) -> None:
    """The daemon's own report if it runs on this computer, else by a session."""
    if not (args.direct or args.link):
        health = _fresh_health(config.status_file)
        if health is not None:
            show(args, health)
            return
    of_boards = what_boards_say(config) if args.direct else {}
    with connected(args, config) as client:
        show(args, _status_fields(client.status) | of_boards)


def _fresh_health(path: Path) -> dict[str, object] | None:
    try:
        health = json.loads(path.read_text(encoding="utf-8"))
        fresh = time.time() - float(health["t"]) < STATUS_FILE_FRESH_S
        whereabouts = ("positions_um", "certain_axes", "remembered_um", "bound_um")
        health["positions_um"] = _positions(*(health[name] for name in whereabouts))
    except (OSError, ValueError, KeyError, TypeError):
        return None
    return health if fresh and health.get("exit_reason") is None else None


def _status_fields(status: BridgeStatus) -> dict[str, object]:
    return {
        "phase": status.phase.value,
        "armed": status.armed,
        "stopped": status.stopped,
        "stop_reason": status.stop_reason,
        "stop_count": status.stop_count,
        "insertion_locked": status.insertion_locked,
        "moving": status.moving,
        "parked": status.parked,
        "positions_um": _positions(
            status.positions_um, status.certain_axes, status.remembered_um, status.bound_um
        ),
        "position_certain": status.position_certain,
        "fault": status.fault,
        "last_command": status.command_id,
        "last_command_state": status.command_state.value if status.command_state else None,
    }


def _positions(
    counted_um: Mapping[str, int],
    certain_axes: Collection[str],
    remembered_um: Mapping[str, int],
    bound_um: Mapping[str, int],
) -> dict[str, object]:
    """What is not known is not shown as a number."""
    shown: dict[str, object] = {}
    for axis, at_um in counted_um.items():
        if axis in certain_axes:
            shown[axis] = at_um
        elif axis in remembered_um:
            shown[axis] = f"unknown, assumed {remembered_um[axis]} +- {bound_um[axis]}"
        else:
            shown[axis] = "unknown"
    return shown


# --- moving -----------------------------------------------------------------------------------


def jog(args: argparse.Namespace, config: BridgeConfig) -> None:
    axis_named(config, args.axis)
    if not 0 < abs(args.mm) <= JOG_MAX_MM:  # NaN fails this too
        raise UsageError(f"a jog must be more than 0 and at most {JOG_MAX_MM} mm, not {args.mm}")
    with connected(args, config) as client:
        setpoints_um = dict(client.status.positions_um)
        setpoints_um[args.axis] += round(args.mm * 1000)
        known = args.axis in client.status.certain_axes
        to = f" to {setpoints_um[args.axis]} um" if known else ""
        confirm(args, f"move {args.axis} by {args.mm:+g} mm{to}")
        outcome = _while_armed(
            args, client, lambda: client.move(_command_id("jog"), setpoints_um, None)
        )
        _report(args, outcome, client.status)


def home(args: argparse.Namespace, config: BridgeConfig) -> None:
    with connected(args, config) as client:
        for name in args.axes:
            axis_named(config, name)
        axes = ", ".join(args.axes) or "every axis"
        confirm(args, f"drive {axes} to its reference, up to the end of the travel")
        outcome = _while_armed(
            args, client, lambda: client.home(_command_id("home"), args.by, args.axes)
        )
        _report(args, outcome, client.status)


def _command_id(what: str) -> str:
    return f"engineer-{what}-{time.strftime('%Y%m%dT%H%M%S', time.gmtime())}-{secrets.token_hex(4)}"


def _while_armed(
    args: argparse.Namespace, client: BridgeClient, do: Callable[[], MoveOutcome]
) -> MoveOutcome:
    client.set_phase(WorkPhase.MANUAL, args.by)
    client.arm(args.by)
    try:
        return do()
    except KeyboardInterrupt:
        client.request_stop()
        _await_acknowledgement(client)
        raise
    finally:
        with contextlib.suppress(BridgeError):
            client.disarm(args.by)


def _report(args: argparse.Namespace, outcome: MoveOutcome, status: BridgeStatus) -> None:
    fields: dict[str, object] = {
        "state": outcome.state.value,
        "code": outcome.code,
        "text": outcome.text,
        "readback_um": _positions(
            outcome.readback_um, status.certain_axes, status.remembered_um, status.bound_um
        ),
    }
    show(args, fields)
    if not outcome.done:
        raise CouldNotError(f"{outcome.state.value} ({outcome.code}): {outcome.text}")


# --- stopping ---------------------------------------------------------------------------------


def stop(args: argparse.Namespace, config: BridgeConfig) -> None:
    if args.direct:
        show(args, stop_motors(args, config))
        return
    client = _client_on_the_line(args, config)
    nonce = secrets.randbits(32)
    _shout_stop(args.link or str(config.service_link), config.link_baud, args.emergency, nonce)
    try:
        client.request_stop(emergency=args.emergency, nonce=nonce)
        client.open(args.timeout)
        _await_acknowledgement(client)
        show(args, _status_fields(client.status))
    except LinkLostError as error:
        raise CouldNotError(
            f"STOP was sent {SHOUTS} times, but no acknowledgement was received ({error})"
        ) from error
    finally:
        client.close()


def _shout_stop(url: str, baud: int, emergency: bool, nonce: int) -> None:
    """Before anything else, session or not, and even if another program has the line."""
    line = SerialTransport(url, baud, exclusive=False)
    try:
        frame = encode_stop(nonce, emergency)
        for _ in range(SHOUTS):
            line.write(frame)
            time.sleep(0.01)
    except TransportError:
        return  # the client says what is wrong with the line
    finally:
        line.close()


def _await_acknowledgement(client: BridgeClient) -> None:
    until_s = time.monotonic() + STOP_WAIT_S
    while not client.stop_acknowledged:
        if time.monotonic() > until_s:
            raise CouldNotError(f"STOP was not acknowledged within {STOP_WAIT_S:g} s")
        client.pump(0.02)
    client.pump(0.1)


def rearm(args: argparse.Namespace, config: BridgeConfig) -> None:
    """Clear the latched stop. Nothing stays armed: the session ends with the command."""
    with connected(args, config) as client:
        reason = client.status.stop_reason
        if client.status.stopped:
            confirm(args, f"clear stop {client.status.stop_count} ({reason})")
        client.rearm(args.by)
        client.disarm(args.by)
        show(args, _status_fields(client.status))


def drives(args: argparse.Namespace, config: BridgeConfig) -> None:
    """Power of the motors off (for imaging) or on."""
    if args.direct:
        drives_directly(args, config)
        return
    with connected(args, config) as client:
        client.set_drives(args.power == "on", args.by)
        until_s = time.monotonic() + STOP_WAIT_S
        while client.status.parked is (args.power == "on"):
            if time.monotonic() > until_s:
                raise CouldNotError(f"the drives are not {args.power} after {STOP_WAIT_S:g} s")
            client.pump(0.02)
        show(args, _status_fields(client.status))


# --- where the robot stands -------------------------------------------------------------------


def declare(args: argparse.Namespace, config: BridgeConfig) -> None:
    with connected(args, config) as client:
        _declare(client, args.positions, args.by)
        show(args, _status_fields(client.status))


def _declare(client: BridgeClient, texts: Sequence[str], by: str) -> None:
    """Texts like "xt=1.5" or, to within a tenth of a millimetre, "xt=1.5+-0.1"; nothing else."""
    positions_um, within_um = {}, {}
    for text in texts:
        axis, _, mm = text.partition("=")
        if axis not in client.status.positions_um:
            known = ", ".join(client.status.positions_um)
            raise UsageError(f"{text!r}: {axis!r} is not one of {known}")
        at_mm, _, within_mm = mm.partition("+-")
        positions_um[axis] = _um_from_text(text, at_mm)
        if within_mm:
            within_um[axis] = abs(_um_from_text(text, within_mm))
    client.declare_position(positions_um, by, within_um)


def _um_from_text(text: str, mm: str) -> int:
    try:
        value = float(mm)
    except ValueError:
        value = math.nan
    if not abs(value) <= 1000.0:
        raise UsageError(f"{text!r}: use AXIS=MM")
    return round(value * 1000)
