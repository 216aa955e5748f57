"""Why an association ended: one line for every ending that is no release.

pynetdicom ends associations by itself (what it cannot read, idle ones, resets) and says nothing. So
whoever sees something first writes it down at the connection, and when the association's thread
ends, however it does, the account is made from that.
"""

from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Ending:
    """kind: a code for the counter; text: one line with peer and reason."""

    kind: str
    text: str

    @property
    def is_release(self) -> bool:
        return self.kind == "released"


def ending_of(association: Any) -> Ending | None:
    """The account of an association that ends; None where it was given, or refused, before."""
    sock = association.dul.socket
    if association.is_rejected or sock.is_accounted_for:
        return None
    sock.is_accounted_for = True
    who = who_of(association)
    lost = _lost(sock)
    if association.is_released:
        return Ending("unfinished" if lost else "released", f"{who}: released{lost}")
    kind, why = sock.why_ended or _by_state(association)
    return Ending(kind, f"{who}: {why}{lost if association.requestor.primitive else ''}")


def _lost(sock: Any) -> str:
    """What ends with the association: the slice that it would have been is missed."""
    if sock.unfinished_bytes > 0:
        return f", in the middle of a message ({sock.unfinished_bytes} bytes of it had arrived)"
    return ", before its message was answered" if sock.unanswered else ""


def _by_state(association: Any) -> tuple[str, str]:
    if association.requestor.primitive is None:
        return "no_request", "no association request arrived"
    if association.is_aborted or association._sent_abort:
        return "aborted_by_us", "ended by us"
    return "broken", "the connection was lost"


def who_of(association: Any) -> str:
    """The peer, in words."""
    request = association.requestor.primitive
    peer = association.requestor.address
    if request is None:
        return f"connection of {peer}"
    return f"association of {str(request.calling_ae_title).strip()!r} ({peer})"
