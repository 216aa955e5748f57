"""C-STORE of outputs to one destination: one attempt each, and what its answer means."""

from __future__ import annotations

import os
import ssl
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from enum import Enum
from pathlib import Path

import pydicom
from pydicom.errors import InvalidDicomError
from pydicom.uid import ExplicitVRLittleEndian, ImplicitVRLittleEndian
from pynetdicom import AE
from pynetdicom.association import Association
from pynetdicom.sop_class import (
    Comprehensive3DSRStorage,
    GrayscaleSoftcopyPresentationStateStorage,
    MRImageStorage,
    SpatialFiducialsStorage,
)

from dicom_listener.association_fix import mended
from room_config.outputs import Destination

_SOP_CLASSES = (
    MRImageStorage,
    Comprehensive3DSRStorage,
    GrayscaleSoftcopyPresentationStateStorage,
    SpatialFiducialsStorage,
)
_TRANSFER_SYNTAXES = [ExplicitVRLittleEndian, ImplicitVRLittleEndian]
_DUPLICATE = 0x0111


class Outcome(Enum):
    STORED = "stored"
    LATER = "later"
    REFUSED = "refused"


@dataclass(frozen=True)
class Attempt:
    name: str
    outcome: Outcome
    reason: str = ""


class UnreachableError(Exception):
    """No association with the destination: it is not there, or does not want one with us."""


def send(
    destination: Destination, timeout_s: float, files: Iterable[tuple[str, Path]]
) -> Iterator[Attempt]:
    """Send (name, file) pairs in one association; ends early where that breaks.

    Raises UnreachableError if there is no association at all.
    """
    association = _associate(destination, timeout_s)
    try:
        for name, file in files:
            yield _store(association, name, file)
            if not association.is_established:
                return
    finally:
        if association.is_established:
            association.release()


def _associate(destination: Destination, timeout_s: float) -> Association:
    entity = AE(ae_title=destination.calling_ae_title)
    entity.acse_timeout = entity.dimse_timeout = timeout_s
    entity.network_timeout = entity.connection_timeout = timeout_s
    for sop_class in _SOP_CLASSES:
        entity.add_requested_context(sop_class, _TRANSFER_SYNTAXES)
    try:
        association = mended(
            entity.associate(
                destination.host,
                destination.port,
                ae_title=destination.ae_title,
                tls_args=_tls(destination),
            )
        )
    except (OSError, RuntimeError) as error:
        raise UnreachableError(str(error)) from error
    if not association.is_established:
        raise UnreachableError(_why_not(association))
    return association


def _tls(destination: Destination) -> tuple[ssl.SSLContext, str] | None:
    """Mutual TLS: we show our certificate, the destination one that its authority signed."""
    certificate, key = destination.tls_certificate, destination.tls_key
    if certificate is None or key is None or destination.tls_authority is None:
        return None
    context = ssl.create_default_context(cafile=os.fspath(destination.tls_authority))
    context.minimum_version = ssl.TLSVersion.TLSv1_2
    context.load_cert_chain(os.fspath(certificate), os.fspath(key))
    return context, destination.tls_name or destination.host


def _why_not(association: Association) -> str:
    if association.is_rejected:
        answer = association.acceptor.primitive
        return f"association rejected: {answer.reason_str if answer else 'no reason given'}"
    if association.acceptor.primitive is not None:
        return "association aborted: none of our object types is accepted"
    return "no response"


def _store(association: Association, name: str, file: Path) -> Attempt:
    try:
        dataset = pydicom.dcmread(file)
    except (OSError, InvalidDicomError) as error:
        return Attempt(name, Outcome.REFUSED, f"its file cannot be read: {error}")
    sop_class = dataset.SOPClassUID
    if not any(context.abstract_syntax == sop_class for context in association.accepted_contexts):
        return Attempt(name, Outcome.REFUSED, f"{sop_class.name} is not accepted there")
    try:
        answer = association.send_c_store(dataset)
    except (ValueError, RuntimeError) as error:
        return Attempt(name, Outcome.LATER, str(error))
    if "Status" not in answer:
        return Attempt(name, Outcome.LATER, "no response: the association was broken or timed out")
    return _judge(name, int(answer.Status), str(answer.get("ErrorComment", "") or ""))


def _judge(name: str, status: int, comment: str) -> Attempt:
    """PS3.4 B.2.3: stored (also with a warning), out of resources, or not wanted."""
    if status in (0x0000, _DUPLICATE) or status & 0xF000 == 0xB000:
        return Attempt(name, Outcome.STORED)
    reason = f"status 0x{status:04X} {comment}".strip()
    later = status & 0xFF00 == 0xA700
    return Attempt(name, Outcome.LATER if later else Outcome.REFUSED, reason)
