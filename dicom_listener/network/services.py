"""Which messages are served: C-STORE, C-ECHO and, where it was accepted, Storage Commitment."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from pydicom.uid import UID
from pynetdicom.service_class import ServiceClass
from pynetdicom.sop_class import StorageCommitmentPushModel, uid_to_service_class

from dicom_listener.negotiation import VERIFICATION, is_storage
from dicom_listener.network.conversation import (
    C_CANCEL,
    C_ECHO,
    C_STORE,
    N_ACTION,
    N_SERVICES_FROM,
    Command,
    field_named,
)

_CLASS_NOT_SUPPORTED, _UNRECOGNIZED_OPERATION = 0x0122, 0x0211  # PS3.7 annex C


@dataclass(frozen=True)
class Refusal:
    """Why a message is not served. status: it is answered so; None: nothing can answer it."""

    why: str
    status: int | None = None


def refusal_of(command: Command, accepted: Mapping[int, str]) -> Refusal | None:
    """None where the message is served.

    accepted: number of each accepted presentation context -> its abstract syntax.
    """
    if command.is_response:
        return Refusal(f"{command.name} without a request")
    abstract_syntax = accepted.get(command.context)
    if abstract_syntax is None:
        why = f"{command.name} on presentation context {command.context}, which was not accepted"
        return Refusal(why)
    if command.field == C_STORE:
        return _refused_store(command, set(accepted.values()))
    commitment = str(StorageCommitmentPushModel)
    if command.field == N_ACTION and {command.sop_class, abstract_syntax} == {commitment}:
        return None
    if command.field == C_CANCEL:
        return None
    if command.field == C_ECHO:
        return None if command.sop_class == VERIFICATION else _of_another_class(command)
    why = f"{command.name}, which is not offered here"
    if not command.is_known:
        return Refusal(why)
    is_composite = command.field < N_SERVICES_FROM
    return Refusal(why, _CLASS_NOT_SUPPORTED if is_composite else _UNRECOGNIZED_OPERATION)


def _of_another_class(command: Command) -> Refusal:
    name = UID(command.sop_class).name[:64] or "no SOP class"
    return Refusal(f"{command.name} of {name}", _CLASS_NOT_SUPPORTED)


def _refused_store(command: Command, accepted: set[str]) -> Refusal | None:
    uid = UID(command.sop_class)
    if not uid:
        return Refusal("a C-STORE without a SOP class")
    if not is_storage(uid):
        why = f"a C-STORE of {uid.name[:64]}, an object type that is not stored here"
        return Refusal(why, _CLASS_NOT_SUPPORTED)
    if uid not in accepted and uid_to_service_class(uid) is ServiceClass:
        why = f"a C-STORE of {uid.name[:64]}, which was not proposed"
        return Refusal(why, _CLASS_NOT_SUPPORTED)
    return None


def accepted_by(association: Any) -> dict[int, str]:
    """Number of each accepted presentation context -> its abstract syntax."""
    contexts = association._accepted_cx.items()
    return {number: str(context.abstract_syntax) for number, context in contexts}


def refused_request(association: Any, message: Any, context: int) -> Refusal | None:
    """Why a request, one of pynetdicom's DIMSE primitives, is to be answered with a refusal."""
    if message.MessageID is None or message.MessageIDBeingRespondedTo is not None:
        return None
    sop_class = getattr(message, "AffectedSOPClassUID", None)
    sop_class = sop_class or getattr(message, "RequestedSOPClassUID", None)
    field = field_named(type(message).__name__.replace("_", "-"))
    command = Command(field, str(sop_class or ""), context, has_data_set=False)
    refusal = refusal_of(command, accepted_by(association))
    return refusal if refusal is not None and refusal.status is not None else None
