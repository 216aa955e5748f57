"""The C-STORE and C-ECHO service: bytes from the network into the inbox, then the answer.

Success is answered after the slice is durable and for no other reason. Everything else is answered
with a failure status and a comment that says why, and leaves a log line.
"""

import ipaddress
import os
import ssl
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import structlog
from pydicom.dataset import Dataset
from pynetdicom import AE, _config, evt
from pynetdicom.association import Association
from pynetdicom.dimse_primitives import C_CANCEL, C_STORE
from pynetdicom.events import Event
from pynetdicom.sop_class import StorageCommitmentPushModel

from dicom_listener import inbox as inbox_module
from dicom_listener.inbox import Envelope, Inbox, InboxError, sha256_of
from dicom_listener.metrics import ListenerMetrics
from dicom_listener.negotiation import (
    NegotiationReport,
    add_contexts,
    as_storage,
    contexts_for,
    rejection_text,
    report_of,
)
from dicom_listener.network.bounded_socket import BoundedSocket
from dicom_listener.network.commitment import Commitment
from dicom_listener.network.endings import Ending, ending_of, who_of
from dicom_listener.network.services import Refusal, refused_request
from dicom_listener.network.store_request import (
    UnanswerableError,
    mend_store_request,
    uid_sent_under,
)
from dicom_listener.transport import PromptServer, keep_tracebacks
from dicom_slice.preflight import NoDataSetError, peek
from room_config.networks import address_of

SUCCESS = 0x0000
OUT_OF_RESOURCES = 0xA700
DOES_NOT_MATCH_SOP_CLASS = 0xA900
CANNOT_UNDERSTAND = 0xC000
_COMMENT_CHARACTERS = 64  # Error Comment (0000,0902) is an LO
_REPORTS_KEPT = 50
_SAID_AGAIN_AFTER_S = 60.0

log = structlog.get_logger("listener")

keep_tracebacks()
# pynetdicom's own accounts of messages fail on what is odd, and keep our handlers from it
_config.LOG_HANDLER_LEVEL = "none"


@dataclass(frozen=True)
class ScpRules:
    """Who may talk to us, how much, and for how long they may keep silent."""

    host: str = "127.0.0.1"
    port: int = 0
    ae_title: str = "AUTOSPINE"
    require_called_ae_title: bool = True
    calling_ae_titles: tuple[str, ...] = ()  # () = any
    peer_networks: tuple[str, ...] = ()  # () = any; addresses or CIDR networks
    any_storage_class: bool = True
    max_associations: int = 16
    acse_timeout_s: float = 10.0
    dimse_timeout_s: float = 30.0
    network_timeout_s: float = 900.0
    max_pdu_bytes: int = 1024 * 1024
    max_object_bytes: int = 512 * 1024 * 1024
    negotiated_pdu_bytes: int = 256 * 1024


class Scp:
    """Owns the listening port. `on_stored(path)` is called after each answerable slice."""

    def __init__(
        self,
        rules: ScpRules,
        inbox: Inbox,
        metrics: ListenerMetrics,
        on_stored: Callable[[Path], None],
        tls: ssl.SSLContext | None = None,
        commitment: Commitment | None = None,
    ) -> None:
        self._rules = rules
        self._inbox = inbox
        self._metrics = metrics
        self._on_stored = on_stored
        self._commitment = commitment
        self._networks = [ipaddress.ip_network(net, strict=False) for net in rules.peer_networks]
        self.reports: deque[NegotiationReport] = deque(maxlen=_REPORTS_KEPT)
        self.alarms: deque[tuple[str, str]] = deque(maxlen=1000)
        self._said_s: dict[tuple[str, str], float] = {}
        self._is_stopping = False
        self._ae = self._application_entity()
        self._server: PromptServer = self._ae.make_server(
            (rules.host, rules.port),
            ssl_context=tls,
            evt_handlers=[
                (evt.EVT_REQUESTED, self._on_requested),
                (evt.EVT_ACCEPTED, self._on_accepted),
                (evt.EVT_REJECTED, self._on_rejected),
                (evt.EVT_C_ECHO, self._on_echo),
                (evt.EVT_C_STORE, self._on_store),
                (evt.EVT_DIMSE_RECV, self._on_message),
                (evt.EVT_SOP_COMMON, self._on_common_extended),
                (evt.EVT_N_ACTION, self._on_action),
            ],
            server_class=self._server_class(),
        )
        self._thread = threading.Thread(
            target=self._server.serve_forever, kwargs={"poll_interval": 0.1}, name="listen"
        )

    @property
    def port(self) -> int:
        return int(self._server.server_address[1])

    @property
    def is_listening(self) -> bool:
        return self._thread.is_alive()

    def start(self) -> None:
        self._thread.start()

    def stop(self) -> None:
        """Stop listening and end every association; idempotent."""
        self._is_stopping = True
        if self._thread.is_alive():
            self._server.shutdown()
            self._thread.join()
        for association in self._server.active_associations:
            association.abort()

    @property
    def open_associations(self) -> int:
        return len(self._server.active_associations)

    def _application_entity(self) -> AE:
        rules = self._rules
        ae = AE(rules.ae_title)
        ae.implementation_class_uid = inbox_module.IMPLEMENTATION_CLASS_UID
        ae.implementation_version_name = inbox_module.IMPLEMENTATION_VERSION_NAME
        ae.maximum_associations = rules.max_associations
        ae.acse_timeout = rules.acse_timeout_s
        ae.dimse_timeout = rules.dimse_timeout_s
        ae.network_timeout = rules.network_timeout_s
        ae.maximum_pdu_size = rules.negotiated_pdu_bytes
        add_contexts(ae, any_storage_class=rules.any_storage_class)
        if self._commitment is not None:
            self._commitment.on_unreported = lambda text: self._alarm("commitment_unreported", text)
            ae.add_supported_context(StorageCommitmentPushModel, scu_role=True, scp_role=True)
        return ae

    def _server_class(self) -> type[PromptServer]:
        """The server with this room's limits: pynetdicom makes the instance itself."""
        rules = self._rules
        bounds = {
            "max_pdu_bytes": rules.max_pdu_bytes,
            # one over the limit is still read to its end, so that it can be answered
            "max_message_bytes": 2 * rules.max_object_bytes,
            "pdu_deadline_s": rules.dimse_timeout_s,
            "on_refused": staticmethod(lambda why: self._alarm("oversize", why)),
            "on_sends_ahead": staticmethod(self._on_sends_ahead),
        }
        settings = {
            "socket_class": type("RoomSocket", (BoundedSocket,), bounds),
            "network_timeout_s": rules.network_timeout_s,
            "message_timeout_s": rules.dimse_timeout_s,
            "first_byte_timeout_s": rules.acse_timeout_s,
            "most_unopened": 4 * rules.max_associations,
            "most_associations": rules.max_associations,
            "is_known": staticmethod(self._is_known),
            "on_dropped": staticmethod(self._on_dropped),
            "on_no_request": staticmethod(self._on_no_request),
            "on_ended": staticmethod(self._on_ended),
            "on_not_offered": staticmethod(self._on_not_offered),
        }
        return type("RoomServer", (PromptServer,), settings)

    # Associations

    def _on_ended(self, association: Association) -> None:
        ending = ending_of(association)
        if ending is not None:
            self._tell(ending, association.requestor.port)

    def _tell(self, ending: Ending, port: int | None = None) -> None:
        if self._is_stopping:
            return
        self._metrics.endings.labels(ending.kind).inc()
        if ending.is_release:
            log.debug("association ended", text=ending.text)
        else:
            self._metrics.alarms.labels("association_ended").inc()
            log.warning("association_ended", text=ending.text, port=port)
            if self._is_news("association_ended", ending.text):
                self.alarms.append(("association_ended", ending.text))

    def _on_no_request(self, peer: str, why: str) -> None:
        self._metrics.dropped.inc()
        self._tell(Ending("no_request", f"connection of {peer}: {why}"))

    def _on_dropped(self, peer: str, why: str) -> None:
        self._metrics.dropped.inc()
        log.debug("connection dropped", peer=peer, why=why)

    def _on_requested(self, event: Event) -> None:
        refusal = self._why_refused(event.assoc)
        if refusal is None:
            self._add_contexts(event.assoc)
            return
        code, why = refusal
        event.assoc.acse.send_reject(*code)
        self._reject(report_of(event.assoc, why))
        event.assoc.kill()

    def _add_contexts(self, association: Association) -> None:
        """Private and retired kinds are stored, too: the transfer must not stop at them."""
        if not self._rules.any_storage_class:
            return
        acceptor = association.acceptor
        more = contexts_for(_proposed(association), acceptor.supported_contexts)
        if more:
            acceptor.supported_contexts = [*acceptor.supported_contexts, *more]

    def _on_common_extended(self, event: Event) -> dict[Any, Any]:
        return {**as_storage(_proposed(event.assoc)), **event.items}

    def _is_known(self, peer: str) -> bool:
        """Whether the address may send; one that cannot be told may not keep others out either."""
        if not self._networks:
            return True
        try:
            address = address_of(peer)
        except ValueError:
            return False
        return any(address in network for network in self._networks)

    def _why_refused(self, association: Any) -> tuple[tuple[int, int, int], str] | None:
        request = association.requestor.primitive
        calling, called = request.calling_ae_title.strip(), request.called_ae_title.strip()
        if self._rules.require_called_ae_title and called != self._rules.ae_title.strip():
            return (1, 1, 7), f"called AE title {called!r} is not ours ({self._rules.ae_title})"
        if self._rules.calling_ae_titles and calling not in self._rules.calling_ae_titles:
            return (1, 1, 3), f"calling AE title {calling!r} is not on the list"
        address = address_of(association.requestor.address)
        if self._networks and not any(address in network for network in self._networks):
            return (1, 1, 1), f"address {address} is not on the list"
        return None

    def _on_accepted(self, event: Event) -> None:
        report = report_of(event.assoc)
        self._metrics.associations.labels("accepted").inc()
        self.reports.append(report)
        text = str(report).replace("\n", "; ")
        if report.matters:
            self._say("contexts_refused", report.matters)
        if self._is_news("association", text):
            log.info("association", text=text)

    def _on_rejected(self, event: Event) -> None:
        code = event.assoc.acceptor.primitive
        why = rejection_text(code.result, code.result_source, code.diagnostic)
        self._reject(report_of(event.assoc, why))

    def _reject(self, report: NegotiationReport) -> None:
        self._metrics.associations.labels("rejected").inc()
        self.reports.append(report)
        self._alarm("association_rejected", str(report).replace("\n", "; "))

    # Messages

    def _on_message(self, event: Event) -> None:
        """Before pynetdicom makes anything of it, in its thread."""
        association, message = event.assoc, event.message
        sock = association.dul.socket
        try:
            number = message.context_id
            context = association._accepted_cx.get(number)
            syntax = str(context.transfer_syntax[0]) if context else ""
            mend_store_request(message, syntax)
            primitive = message.message_to_primitive()
            if isinstance(primitive, C_CANCEL):
                sock.message_done()
                text = f"{who_of(association)}: a C-CANCEL; there is nothing to cancel"
                self._alarm("message_ignored", text)
            elif primitive.is_valid_response:
                sock.message_done()
                sock.speaking.heard(primitive)
            elif not (
                primitive.is_valid_request or refused_request(association, primitive, number)
            ):
                raise UnanswerableError("its message ID, SOP class or status is missing")
        except Exception as error:
            sock.message_done()
            sock.note_ending("unreadable", f"an unreadable message: {error}")
            association.dul.event_queue.put("Evt19")

    def _on_echo(self, event: Event) -> int:
        self._metrics.echoes.inc()
        event.assoc.dul.socket.message_done()
        return SUCCESS

    def _on_action(self, event: Event) -> tuple[int, None]:
        event.assoc.dul.socket.message_done()
        if self._commitment is None:
            return CANNOT_UNDERSTAND, None
        who = str(event.assoc.requestor.ae_title).strip()
        speaking, context = event.assoc.dul.socket.speaking, event.context

        def tell(kind: int, report: Dataset) -> str:
            return str(speaking.report(kind, report, context))

        asked = event.action_information
        status = self._commitment.answer(who, event.action_type, asked, tell)
        self._metrics.commitments.labels(f"{status:04X}").inc()
        return status, None

    def _on_not_offered(self, association: Association, message: Any, refusal: Refusal) -> None:
        text = f"{who_of(association)}: {refusal.why}; answered 0x{refusal.status:04X}"
        if isinstance(message, C_STORE):
            self._metrics.refused.labels(f"{refusal.status:04X}").inc()
            self._alarm("slice_refused", text)
        else:
            self._alarm("not_offered", text)

    def _on_sends_ahead(self, association: Association) -> None:
        text = f"{who_of(association)}: it sends on without waiting for answers, and is slowed down"
        self._alarm("sends_ahead", text)

    def _on_store(self, event: Event) -> Dataset | int:
        began_s = event.assoc.dul.socket.message_done()
        try:
            status, comment = self._store(event)
        except Exception as error:  # the sender must get an answer, whatever went wrong
            log.exception("store failed")
            status, comment = CANNOT_UNDERSTAND, f"internal error: {type(error).__name__}"
        if status == SUCCESS:
            if began_s is not None:
                self._metrics.store_seconds.observe(time.monotonic() - began_s)
            return SUCCESS
        self._metrics.refused.labels(f"{status:04X}").inc()
        self._alarm("slice_refused", f"0x{status:04X}: {comment}")
        return _failure(status, comment)

    def _store(self, event: Event) -> tuple[int, str]:
        received_s, received_monotonic_s = time.time(), time.monotonic()
        data_set = event.encoded_dataset(include_meta=False)
        if len(data_set) > self._rules.max_object_bytes:
            limit_mib = self._rules.max_object_bytes // 2**20
            return OUT_OF_RESOURCES, f"object larger than the limit of {limit_mib} MiB"
        request, association = event.request, event.assoc
        sop_class = str(request.AffectedSOPClassUID or "")
        transfer_syntax = str(event.context.transfer_syntax)
        try:
            peeked = peek(data_set, transfer_syntax)
        except NoDataSetError as error:
            return CANNOT_UNDERSTAND, str(error)
        if peeked.sop_class_uid and peeked.sop_class_uid != sop_class:
            return DOES_NOT_MATCH_SOP_CLASS, "the data set has a different SOP class"
        envelope = Envelope(
            calling_ae_title=str(association.requestor.ae_title).strip(),
            called_ae_title=str(association.acceptor.ae_title).strip(),
            peer_address=str(association.requestor.address),
            peer_port=int(association.requestor.port),
            received_s=received_s,
            received_monotonic_s=received_monotonic_s,
            transfer_syntax_uid=transfer_syntax,
            sop_class_uid=sop_class,
            sop_instance_uid=uid_sent_under(request.AffectedSOPInstanceUID, peeked),
            sha256=sha256_of(data_set),
            size_bytes=len(data_set),
        )
        try:
            path = self._inbox.store(data_set, envelope)
        except InboxError as error:
            return OUT_OF_RESOURCES, str(error)
        self._metrics.stored.inc()
        self._metrics.stored_bytes.inc(len(data_set))
        self._on_stored(path)
        return SUCCESS, ""

    def _alarm(self, kind: str, text: str) -> None:
        self._metrics.alarms.labels(kind).inc()
        self._say(kind, text)

    def _say(self, kind: str, text: str) -> None:
        """Log it, and hand it to the record; the same words again only after a while."""
        if self._is_news(kind, text):
            self.alarms.append((kind, text))
            log.warning(kind, text=text)

    def _is_news(self, kind: str, text: str) -> bool:
        now_s = time.monotonic()
        if now_s - self._said_s.get((kind, text), -_SAID_AGAIN_AFTER_S) < _SAID_AGAIN_AFTER_S:
            return False
        if len(self._said_s) > _REPORTS_KEPT:
            self._said_s.clear()
        self._said_s[kind, text] = now_s
        return True


def _proposed(association: Association) -> list[Any]:
    return list(association.requestor.primitive.presentation_context_definition_list)


def _failure(status: int, comment: str) -> Dataset:
    answer = Dataset()
    answer.Status = status
    answer.ErrorComment = comment.encode("ascii", "replace").decode()[:_COMMENT_CHARACTERS]
    return answer


def tls_context(certificate: Path, key: Path, authority: Path) -> ssl.SSLContext:
    """Mutual TLS: we show `certificate`, the peer must show one signed by `authority`."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.minimum_version = ssl.TLSVersion.TLSv1_2
    context.load_cert_chain(os.fspath(certificate), os.fspath(key))
    context.load_verify_locations(cafile=os.fspath(authority))
    context.verify_mode = ssl.CERT_REQUIRED
    return context
