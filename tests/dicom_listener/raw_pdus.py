"""DICOM PDUs byte by byte, as odd devices send them."""

import io
import socket
import struct

from pydicom.dataset import Dataset
from pydicom.filewriter import dcmwrite

from dicom_slice.quirks import MR_IMAGE

EXPLICIT = b"1.2.840.10008.1.2.1"


def item(kind: int, body: bytes) -> bytes:
    return struct.pack(">BBH", kind, 0, len(body)) + body


def context(number: int, abstract: str = MR_IMAGE, syntax: bytes = EXPLICIT) -> bytes:
    body = bytes([number, 0, 0, 0]) + item(0x30, abstract.encode()) + item(0x40, syntax)
    return item(0x20, body)


def associate(
    *,
    called: bytes = b"AUTOSPINE",
    calling: bytes = b"SCANNER",
    contexts: bytes = context(1),
    user: bytes = item(0x52, b"1.2.3") + item(0x55, b"TEST"),
) -> bytes:
    body = struct.pack(">HH", 1, 0) + called.ljust(16) + calling.ljust(16) + bytes(32)
    body += item(0x10, b"1.2.840.10008.3.1.1.1") + contexts
    body += item(0x50, item(0x51, struct.pack(">L", 16384)) + user)
    return struct.pack(">BBL", 1, 0, len(body)) + body


def pdu(kind: int, body: bytes = bytes(4)) -> bytes:
    return struct.pack(">BBL", kind, 0, len(body)) + body


RELEASE = struct.pack(">BBL", 5, 0, 4) + bytes(4)
ABORT = struct.pack(">BBL", 7, 0, 4) + bytes(4)


def element(number: int, value: bytes) -> bytes:
    value += b"\0" * (len(value) % 2)
    return struct.pack("<HHL", 0, number, len(value)) + value


def store_command(uid: str, *, priority: int = 0) -> bytes:
    fields = element(0x0002, MR_IMAGE.encode()) + element(0x0100, struct.pack("<H", 1))
    fields += element(0x0110, struct.pack("<H", 1)) + element(0x0700, struct.pack("<H", priority))
    fields += element(0x0800, struct.pack("<H", 0)) + element(0x1000, uid.encode())
    return element(0, struct.pack("<L", len(fields))) + fields


def command(
    field: int, *, sop_class: str = MR_IMAGE, has_data: bool = False, number: int = 1
) -> bytes:
    """A command of any kind; its class as the affected one. number: the message's, or answered."""
    fields = element(0x0002, sop_class.encode()) + element(0x0100, struct.pack("<H", field))
    is_about_another = field & 0x8000 or field == 0x0FFF
    fields += element(0x0120 if is_about_another else 0x0110, struct.pack("<H", number))
    fields += element(0x0700, b"\0\0") + element(0x0800, b"\0\0" if has_data else b"\1\1")
    if field & 0x8000:
        fields += element(0x0900, b"\0\0")
    fields += element(0x1000, b"1.2.3")
    return element(0, struct.pack("<L", len(fields))) + fields


def p_data(flags: int, data: bytes, number: int = 1) -> bytes:
    value = struct.pack(">LBB", len(data) + 2, number, flags) + data
    return struct.pack(">BBL", 4, 0, len(value)) + value


def encoded(data_set: Dataset) -> bytes:
    """The data set alone, in Explicit VR Little Endian."""
    bare = Dataset(data_set)
    file = io.BytesIO()
    dcmwrite(file, bare, implicit_vr=False, little_endian=True)
    return file.getvalue()


def answer(sock: socket.socket) -> tuple[int, bytes]:
    """(PDU type, body); (0, b"") where the connection was closed instead."""
    head = sock.recv(6, socket.MSG_WAITALL)
    if len(head) < 6:
        return 0, b""
    kind, _, size = struct.unpack(">BBL", head)
    return kind, sock.recv(size, socket.MSG_WAITALL)


def command_of(body: bytes) -> int:
    """The kind of command in a P-DATA body."""
    at = body.index(struct.pack("<HHL", 0, 0x0100, 2))
    return int(struct.unpack_from("<H", body, at + 8)[0])


def status_of(body: bytes) -> int:
    """The status in the P-DATA body of a C-STORE response."""
    at = body.index(struct.pack("<HHL", 0, 0x0900, 2))
    return int(struct.unpack_from("<H", body, at + 8)[0])
