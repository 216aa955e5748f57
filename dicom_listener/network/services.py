"""Which messages are served: C-STORE, C-ECHO and, where it was accepted, Storage Commitment."""

from collections.abc import Mapping

from pydicom.uid import UID
from pynetdicom.service_class import ServiceClass
from pynetdicom.sop_class import StorageCommitmentPushModel, uid_to_service_class

from dicom_listener.negotiation import is_storage
from dicom_listener.network.conversation import (
    C_CANCEL,
    C_ECHO,
    C_STORE,
    N_ACTION,
    Command,
)


def why_not_served(command: Command, accepted: Mapping[int, str]) -> str:
    """Why this message is not served; empty where it is.

    accepted: number of each accepted presentation context -> its abstract syntax.
    """
    if command.is_response:
        return f"{command.name} without a request"
    abstract_syntax = accepted.get(command.context)
    if abstract_syntax is None:
        return f"{command.name} on presentation context {command.context}, which was not accepted"
    if command.field == C_STORE:
        return _why_not_stored(command, set(accepted.values()))
    commitment = str(StorageCommitmentPushModel)
    if command.field == N_ACTION and {command.sop_class, abstract_syntax} == {commitment}:
        return ""
    if command.field in (C_ECHO, C_CANCEL):
        return ""
    return f"{command.name}, which is not offered here"


def _why_not_stored(command: Command, accepted: set[str]) -> str:
    uid = UID(command.sop_class)
    if not uid:
        return "a C-STORE without a SOP class"
    if not is_storage(uid):
        return f"a C-STORE of {uid.name[:64]}, an object type that is not stored here"
    if uid not in accepted and uid_to_service_class(uid) is ServiceClass:
        return f"a C-STORE of {uid.name[:64]}, which was not proposed"
    return ""
