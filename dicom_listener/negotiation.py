"""Which presentation contexts we accept, and a readable account of what was negotiated."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from pydicom.pixels import get_decoder
from pydicom.uid import (
    UID,
    DeflatedExplicitVRLittleEndian,
    ExplicitVRBigEndian,
    ExplicitVRLittleEndian,
    ImplicitVRLittleEndian,
)
from pynetdicom import AE, AllStoragePresentationContexts
from pynetdicom.association import Association
from pynetdicom.pdu_primitives import SOPClassCommonExtendedNegotiation
from pynetdicom.presentation import PresentationContext, build_context
from pynetdicom.service_class import ServiceClass, StorageServiceClass
from pynetdicom.sop_class import uid_to_service_class

from dicom_slice.quirks import MR_CLASSES

VERIFICATION = "1.2.840.10008.1.1"
_UNCOMPRESSED = (
    ExplicitVRLittleEndian,
    ImplicitVRLittleEndian,
    DeflatedExplicitVRLittleEndian,
    ExplicitVRBigEndian,
)
_COMPRESSED = (
    "1.2.840.10008.1.2.5",  # RLE Lossless
    "1.2.840.10008.1.2.4.57",  # JPEG Lossless
    "1.2.840.10008.1.2.4.70",  # JPEG Lossless, selection value 1
    "1.2.840.10008.1.2.4.80",  # JPEG-LS Lossless
    "1.2.840.10008.1.2.4.90",  # JPEG 2000 Lossless
    "1.2.840.10008.1.2.4.201",  # HTJ2K Lossless
    "1.2.840.10008.1.2.4.202",  # HTJ2K Lossless RPCL
    "1.2.840.10008.1.2.4.81",  # JPEG-LS Near-lossless
    "1.2.840.10008.1.2.4.91",  # JPEG 2000
    "1.2.840.10008.1.2.4.203",  # HTJ2K
    "1.2.840.10008.1.2.4.50",  # JPEG Baseline
    "1.2.840.10008.1.2.4.51",  # JPEG Extended
)
_RESULTS = {
    1: "refused by us",
    2: "refused, no reason",
    3: "refused: this kind of object is not stored here",
    4: "refused: none of these encodings can be decoded here",
}
_MOST_NAMED = 4
_REJECTIONS = {
    (1, 1, 1): "no reason given",
    (1, 1, 3): "calling AE title not recognised",
    (1, 1, 7): "called AE title not recognised",
    (2, 3, 2): "too many associations",
}


def decodable_syntaxes() -> list[str]:
    """Transfer syntaxes that we can decode, in the order in which we prefer them."""
    compressed = [uid for uid in _COMPRESSED if get_decoder(UID(uid)).is_available]
    return [*map(str, _UNCOMPRESSED), *compressed]


def add_contexts(ae: AE, *, any_storage_class: bool) -> None:
    """Tell the AE what it accepts: C-ECHO, MR images, and by switch every storage class."""
    syntaxes = decodable_syntaxes()
    ae.add_supported_context(VERIFICATION)
    classes = set(MR_CLASSES)
    if any_storage_class:
        classes |= {str(context.abstract_syntax) for context in AllStoragePresentationContexts}
    for uid in sorted(classes):
        ae.add_supported_context(uid, syntaxes)


def is_storage(abstract_syntax: str) -> bool:
    """Whether it is a kind of object, for all that anybody knows: private ones, retired ones."""
    uid = UID(abstract_syntax)
    known = uid_to_service_class(uid)
    if known is not ServiceClass:
        return issubclass(known, StorageServiceClass)
    is_in_dictionary = uid.name != uid
    return not is_in_dictionary or "Storage" in uid.name


def contexts_for(
    proposed: Sequence[PresentationContext], supported: Sequence[PresentationContext]
) -> list[PresentationContext]:
    """Contexts beside the supported ones for the kinds of objects that nobody has listed."""
    listed = {str(context.abstract_syntax) for context in supported}
    unlisted = {str(context.abstract_syntax) for context in proposed} - listed
    return [
        build_context(uid, decodable_syntaxes()) for uid in sorted(filter(is_storage, unlisted))
    ]


def as_storage(
    proposed: Sequence[PresentationContext],
) -> dict[UID, SOPClassCommonExtendedNegotiation]:
    """What tells pynetdicom that messages of a class that it does not know are to be stored."""
    items = {}
    for context in proposed:
        uid = UID(str(context.abstract_syntax))
        if is_storage(uid) and uid_to_service_class(uid) is ServiceClass:
            item = items[uid] = SOPClassCommonExtendedNegotiation()
            item.sop_class_uid = uid
            item.service_class_uid = UID(StorageServiceClass.uid)
    return items


@dataclass(frozen=True)
class NegotiationReport:
    """Who asked for what, and what we said.

    matters: in a line, what of the refused a person must know of: kinds of MR images that cannot be
    sent in any way. Scanners propose dozens of kinds of objects; most are none of this room's.
    """

    calling_ae_title: str
    called_ae_title: str
    peer: str
    accepted: bool
    lines: tuple[str, ...]
    matters: str = ""

    def __str__(self) -> str:
        verdict = "accepted" if self.accepted else "rejected"
        head = f"association of {self.calling_ae_title!r} ({self.peer}) to "
        return "\n".join([f"{head}{self.called_ae_title!r}: {verdict}", *self.lines])


def report_of(association: Association, why_rejected: str = "") -> NegotiationReport:
    """Return the account of an association that was just accepted or rejected."""
    request = association.requestor.primitive
    accepted = {context.context_id: context for context in association.accepted_contexts}
    refused = {context.context_id: context for context in association.rejected_contexts}
    lines: Sequence[str]
    if why_rejected:
        lines = (why_rejected,)
    else:
        lines = [
            _line(context, accepted.get(context.context_id), refused.get(context.context_id))
            for context in request.presentation_context_definition_list
        ]
        lines += [f"  {remark}" for remark in getattr(association.dul.socket, "remarks", ())]
    calling, peer = str(request.calling_ae_title).strip(), str(association.requestor.address)
    proposed = request.presentation_context_definition_list
    lost = [] if why_rejected else _lost_kinds(proposed, accepted, refused)
    return NegotiationReport(
        calling_ae_title=calling,
        called_ae_title=str(request.called_ae_title).strip(),
        peer=peer,
        accepted=not why_rejected,
        lines=tuple(lines),
        matters=f"{calling!r} ({peer}) cannot send {'; '.join(lost)}" if lost else "",
    )


def _lost_kinds(
    proposed: Sequence[PresentationContext],
    accepted: Mapping[int, PresentationContext],
    refused: Mapping[int, PresentationContext],
) -> list[str]:
    """Kinds of MR images of which no context was accepted, and why."""
    kinds: dict[str, list[PresentationContext]] = {}
    for context in proposed:
        kinds.setdefault(str(context.abstract_syntax), []).append(context)
    lost = []
    for uid, contexts in kinds.items():
        if uid not in MR_CLASSES or any(c.context_id in accepted for c in contexts):
            continue
        names = sorted({UID(s).name for c in contexts for s in c.transfer_syntax})
        more = f" and {len(names) - _MOST_NAMED} more" if len(names) > _MOST_NAMED else ""
        answer = refused.get(contexts[0].context_id)
        why = _RESULTS.get(answer.result if answer else 2, "refused")
        lost.append(f"{UID(uid).name} in {', '.join(names[:_MOST_NAMED])}{more}: {why}")
    return lost


def _line(
    proposed: PresentationContext,
    accepted: PresentationContext | None,
    refused: PresentationContext | None,
) -> str:
    names = ", ".join(UID(uid).name for uid in proposed.transfer_syntax)
    what = f"{UID(proposed.abstract_syntax).name} in {names}"
    if accepted is not None:
        return f"  {what}: accepted in {UID(accepted.transfer_syntax[0]).name}"
    return f"  {what}: {_RESULTS.get(refused.result if refused else 2, 'refused')}"


def rejection_text(result: int, source: int, diagnostic: int) -> str:
    return _REJECTIONS.get((result, source, diagnostic), "rejected")
