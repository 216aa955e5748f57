"""Seeing one command through, from its request to its final state."""

from collections.abc import Callable
from dataclasses import replace

from robot_bridge.client.client_values import BridgeStatus, MoveOutcome
from robot_bridge.client.session import Session
from robot_bridge.protocol import messages
from robot_bridge.protocol.messages import (
    Code,
    CommandState,
)
from robot_bridge.protocol.packing import MessageError

OnState = Callable[[CommandState, BridgeStatus], None]


def see_through(
    session: Session,
    request: messages.Move | messages.Home,
    pump: Callable[[float], None],
    on_state: OnState | None,
) -> MoveOutcome:
    """Ask for the command and block until it has ended; `pump` is what lets time pass meanwhile.

    Returns the final outcome, refusals included. Raises LinkLostError.
    """
    command_id = request.command_id
    try:
        answer = session.request(request)
    except MessageError as error:
        return refused(command_id, Code.MALFORMED, str(error))
    outcome = _answered(command_id, answer)
    with session.in_haste():
        session.refresh()
        while not outcome.state.final:
            before = outcome.state
            pump(0.01)
            outcome = _told(session, outcome)
            if on_state is not None and outcome.state != before:
                on_state(outcome.state, session.status)
    if session.status.last_motion == command_id:
        session.known_motion = command_id
    return outcome


def refused(command_id: str, code: str, text: str) -> MoveOutcome:
    return MoveOutcome(command_id, CommandState.REFUSED, code, text, {})


def _answered(command_id: str, answer: messages.Answer) -> MoveOutcome:
    state = CommandState(answer.state) if answer.state else CommandState.REFUSED
    return MoveOutcome(command_id, state, answer.code, answer.text, answer.readback_um)


def _told(session: Session, so_far: MoveOutcome) -> MoveOutcome:
    """How the command stands by the newest status, which may still tell of another one."""
    status = session.status
    if status.command_id != so_far.command_id or status.command_state is None:
        return replace(so_far, code=Code.OK, text="", readback_um={})
    return MoveOutcome(
        so_far.command_id,
        status.command_state,
        status.command_code,
        status.command_text,
        session.command_readback_um,
    )
