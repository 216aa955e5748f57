"""What senders put into the command of a C-STORE, made readable for pynetdicom."""

from typing import Any

from dicom_slice.preflight import NoDataSetError, Peeked, peek

_C_STORE_RQ = 0x0001
_LONGEST_UID = 64
_MEDIUM = 0
_PRIORITIES = (0, 1, 2)


class UnanswerableError(ValueError):
    """No answer can be given to this message; the text says why."""


def mend_store_request(message: Any, transfer_syntax: str) -> None:
    """Put right a C-STORE request in place: priority, and the SOP Instance UID in the command.

    message: a pynetdicom DIMSEMessage that was received whole. A UID over 64 characters is cut, as
    DCMTK does; one that is missing is taken from the data set. Raises UnanswerableError where
    neither has one.
    """
    command = message.command_set
    if command.get("CommandField") != _C_STORE_RQ:
        return
    if command.get("Priority") not in _PRIORITIES:
        command.Priority = _MEDIUM
    uid = str(command.get("AffectedSOPInstanceUID") or "")
    if not uid:
        uid = _uid_in_data_set(message.data_set.getvalue(), transfer_syntax)
        if not uid:
            raise UnanswerableError("a C-STORE without a SOP Instance UID")
    command.AffectedSOPInstanceUID = uid[:_LONGEST_UID]
    for name in ("MoveOriginatorApplicationEntityTitle", "MoveOriginatorMessageID"):
        if name in command:  # who asked another node to send it: of no use here
            del command[name]


def uid_sent_under(in_command: str | None, peeked: Peeked) -> str:
    """The SOP Instance UID of the command, whole where it had been cut for pynetdicom."""
    uid = str(in_command or "")
    is_cut = len(uid) == _LONGEST_UID and peeked.sop_instance_uid.startswith(uid)
    return peeked.sop_instance_uid if is_cut else uid


def _uid_in_data_set(data_set: bytes, transfer_syntax: str) -> str:
    try:
        return peek(data_set, transfer_syntax).sop_instance_uid
    except NoDataSetError:
        return ""
