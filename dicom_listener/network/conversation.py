"""What a sender says after it has connected, PDU by PDU: whether it is its turn to say that.

pynetdicom takes what it can use and ends at the rest, mostly without a reason. So it hears only
what has passed here. Layout and order: PS3.8 sections 9.2 and 9.3, PS3.7 sections 6.3 and 9.3.
"""

import struct
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum, auto

ASSOCIATE_RQ, ASSOCIATE_AC, ASSOCIATE_RJ, P_DATA, RELEASE_RQ, RELEASE_RP, ABORT = range(1, 8)
PDU_NAMES = {
    ASSOCIATE_RQ: "an association request",
    ASSOCIATE_AC: "an acceptance of an association",
    ASSOCIATE_RJ: "a rejection of an association",
    P_DATA: "a message",
    RELEASE_RQ: "a release",
    RELEASE_RP: "an answer to a release",
    ABORT: "an abort",
}
C_STORE, C_ECHO, N_EVENT_REPORT, N_ACTION, C_CANCEL = 0x0001, 0x0030, 0x0100, 0x0130, 0x0FFF
N_SERVICES_FROM = N_EVENT_REPORT
_RESPONSE = 0x8000
_COMMAND_NAMES = {
    C_STORE: "C-STORE",
    0x0010: "C-GET",
    0x0020: "C-FIND",
    0x0021: "C-MOVE",
    C_ECHO: "C-ECHO",
    N_EVENT_REPORT: "N-EVENT-REPORT",
    0x0110: "N-GET",
    0x0120: "N-SET",
    N_ACTION: "N-ACTION",
    0x0140: "N-CREATE",
    0x0150: "N-DELETE",
    C_CANCEL: "C-CANCEL",
}
_NO_DATA_SET = 0x0101
_AFFECTED_CLASS, _REQUESTED_CLASS, _FIELD, _DATA_SET_TYPE = 0x0002, 0x0003, 0x0100, 0x0800
_ANSWERED = 0x0120  # message ID being responded to
_LONGEST_COMMAND = 64 * 1024


class BreachError(Exception):
    """The association cannot stand; kind: a code for the counter; the text says why."""

    def __init__(self, kind: str, why: str) -> None:
        super().__init__(why)
        self.kind = kind


class Phase(Enum):
    """Of an association, as the one who was asked for it sees it."""

    SILENT = auto()
    ASKED = auto()
    OPEN = auto()
    RELEASING = auto()
    OVER = auto()


def check_turn(kind: int, phase: Phase) -> None:
    """Raises BreachError where a PDU of this kind may not come now."""
    if phase is Phase.OVER or kind == ABORT:
        return
    name = PDU_NAMES.get(kind)
    if name is None:
        raise BreachError("unreadable", f"an unknown kind of PDU (0x{kind:02X})")
    if kind == ASSOCIATE_RQ:
        if phase is not Phase.SILENT:
            raise BreachError("out_of_turn", "a second association request")
    elif phase is Phase.SILENT:
        raise BreachError("out_of_turn", f"{name} before any association request")
    elif kind in (ASSOCIATE_AC, ASSOCIATE_RJ, RELEASE_RP):
        raise BreachError("out_of_turn", f"{name} without a request")
    elif phase is Phase.ASKED:
        raise BreachError("out_of_turn", f"{name} before the association was accepted")
    elif phase is Phase.RELEASING:
        raise BreachError("out_of_turn", f"{name} after the request for a release")


@dataclass(frozen=True)
class Command:
    """The command of one message, as far as it decides whether it is served.

    answers: the ID of the message that a response is to.
    """

    field: int
    sop_class: str
    context: int
    has_data_set: bool
    answers: int | None = None

    @property
    def is_response(self) -> bool:
        return bool(self.field & _RESPONSE)

    @property
    def is_report_response(self) -> bool:
        """Whether it answers a report that we sent."""
        return self.field == N_EVENT_REPORT | _RESPONSE

    @property
    def is_known(self) -> bool:
        return self.field & ~_RESPONSE in _COMMAND_NAMES

    @property
    def name(self) -> str:
        """As in "a C-STORE"; starts with its article."""
        known = _COMMAND_NAMES.get(self.field & ~_RESPONSE)
        if known is None:
            return f"an unknown command (0x{self.field:04X})"
        article = "an" if known.startswith("N") else "a"
        return f"{article} {known}{' response' if self.field & _RESPONSE else ''}"


def field_named(name: str) -> int:
    """Of a request, as in `C-STORE`. KeyError where there is none."""
    return {known: number for number, known in _COMMAND_NAMES.items()}[name]


class Conversation:
    """Of one association. why_not_served: of a command that nothing can answer; else empty."""

    def __init__(self, why_not_served: Callable[[Command], str]) -> None:
        self._why_not_served = why_not_served
        self._command_bytes = bytearray()
        self._command: Command | None = None  # whose data set is to come
        self._context: int | None = None  # of the message that has begun

    def take(self, body: memoryview) -> bool:
        """A whole PDU with parts of messages; return whether a message is whole with it.

        Raises BreachError where the association must end.
        """
        if not body:
            raise BreachError("unreadable", "a PDU for a message with nothing in it")
        at, is_whole = 0, False
        while at < len(body):
            if is_whole:
                raise BreachError("out_of_turn", "two messages in one PDU")
            end, context, flags = _part_at(body, at)
            is_whole = self._fragment(context, flags, body[at + 6 : end])
            at = end
        return is_whole

    def _fragment(self, context: int, flags: int, data: memoryview) -> bool:
        """One part of a message; return whether it was the last."""
        is_command, is_last = bool(flags & 1), bool(flags & 2)
        if self._context is not None and context != self._context:
            raise BreachError("out_of_turn", "one message on two presentation contexts")
        if is_command:
            if self._command is not None:
                name = self._command.name
                raise BreachError(
                    "out_of_turn", f"a command before the data set of {name} was complete"
                )
            self._context = context
            self._command_bytes += data
            if len(self._command_bytes) > _LONGEST_COMMAND:
                raise BreachError("unreadable", "an unterminated command")
            if is_last:
                self._command = self._whole_command(context)
        elif self._command is None:
            before = "in the middle of its command" if self._context else "without a command"
            raise BreachError("out_of_turn", f"a data set {before}")
        is_over = is_last and not (is_command and self._command and self._command.has_data_set)
        if is_over:
            self._command, self._context = None, None
        return is_over

    def _whole_command(self, context: int) -> Command:
        command = read_command(bytes(self._command_bytes), context)
        self._command_bytes.clear()
        why = self._why_not_served(command)
        if why:
            raise BreachError("not_offered", why)
        return command


def _part_at(body: memoryview, at: int) -> tuple[int, int, int]:
    """(end, presentation context, message control header) of the part that begins at a byte."""
    if at + 6 <= len(body):
        size, context, flags = struct.unpack_from(">LBB", body, at)
        if size >= 2 and at + 4 + size <= len(body):
            return at + 4 + size, context, flags
    raise BreachError("unreadable", "a part of a message that does not fit its PDU")


def read_command(encoded: bytes, context: int) -> Command:
    """A command set (always Implicit VR Little Endian). Raises BreachError."""
    values: dict[int, bytes] = {}
    at = 0
    while at < len(encoded):
        head = encoded[at : at + 8].ljust(8, b"\xff")
        group, number, size = struct.unpack("<HHL", head)
        end = at + 8 + size
        if group != 0 or end > len(encoded):
            raise BreachError("unreadable", "an unreadable command")
        values[number] = encoded[at + 8 : end]
        at = end
    field, data_set_type = values.get(_FIELD, b""), values.get(_DATA_SET_TYPE, b"")
    if len(field) != 2 or len(data_set_type) != 2:
        raise BreachError(
            "unreadable", "a command that does not say what it is, or whether a data set follows"
        )
    sop_class = values.get(_AFFECTED_CLASS, b"") or values.get(_REQUESTED_CLASS, b"")
    return Command(
        int.from_bytes(field, "little"),
        sop_class.rstrip(b"\0 ").decode("ascii", "replace"),
        context,
        int.from_bytes(data_set_type, "little") != _NO_DATA_SET,
        int.from_bytes(values[_ANSWERED], "little") if _ANSWERED in values else None,
    )
