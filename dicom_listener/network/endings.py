"""Why an association ended: one line for every ending that is no release.

pynetdicom ends associations by itself (what it cannot read, idle ones, resets) and says nothing. So
whoever sees something first writes it down at the connection, and when the association's thread
ends, however it does, the account is made from that.
"""

from dataclasses import dataclass
from typing import Any

# more than this of a message was there: the slice that it would have been is missed
_BEGUN_BYTES = 16


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
    who = _who(association)
    if association.is_released:
        return Ending("released", f"{who}: released")
    kind, why = sock.why_ended or _by_state(association)
    if association.requestor.primitive is not None and sock.unfinished_bytes > _BEGUN_BYTES:
        why += f", in the middle of a message ({sock.unfinished_bytes} bytes of it had arrived)"
    return Ending(kind, f"{who}: {why}")


def _by_state(association: Any) -> tuple[str, str]:
    if association.requestor.primitive is None:
        return "no_request", "no association request arrived"
    if association.is_aborted or association._sent_abort:
        return "aborted_by_us", "ended by us"
    return "broken", "the connection was lost"


def _who(association: Any) -> str:
    request = association.requestor.primitive
    peer = association.requestor.address
    if request is None:
        return f"connection of {peer}"
    return f"association of {str(request.calling_ae_title).strip()!r} ({peer})"
