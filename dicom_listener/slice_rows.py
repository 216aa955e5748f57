"""Slices to and from what the case record keeps of them."""

from collections.abc import Mapping
from dataclasses import MISSING, asdict, fields
from typing import Any

from case_record.rows import NewSlice
from dicom_listener.assign import ARRIVAL, Assigned, Decision, Pending
from dicom_listener.inbox import Envelope
from dicom_slice.geometry import SliceGeometry
from dicom_slice.header import Rescale, Slice
from dicom_slice.quirks import Kind
from dicom_slice.reasons import SetAside
from dicom_slice.times import AcquisitionInterval


def header_for_record(slice_: Slice) -> dict[str, Any]:
    """Plain JSON values of a header."""
    return asdict(slice_)


def slice_from_record(header: Mapping[str, Any]) -> Slice:
    """The `Slice` whose header the record keeps. Raises KeyError where it keeps none."""
    # a record of before does not have what was added since
    wanted = [one.name for one in fields(Slice) if one.name in header or one.default is MISSING]
    values = {name: header[name] for name in wanted}
    geometry, interval = values["geometry"], values["interval"]
    values["geometry"] = None if geometry is None else _geometry(geometry)
    values["interval"] = None if interval is None else AcquisitionInterval(**interval)
    values["rescale"] = Rescale(**values["rescale"])
    values["kind"] = Kind(values["kind"])
    for name in ("shape", "image_type", "warnings"):
        if name in values:
            values[name] = tuple(values[name])
    return Slice(**values)


def _geometry(values: Mapping[str, Any]) -> SliceGeometry:
    return SliceGeometry(**{name: tuple(value) for name, value in values.items()})


def row_of(
    slice_: Slice,
    envelope: Envelope,
    path: str,
    decision: Decision | SetAside,
    *,
    arrival_mode: bool = False,
) -> NewSlice:
    """The row of one frame, assigned or not. In arrival mode every one is marked so."""
    state, hold_id, code, text = outcome_of(decision)
    assigned = decision if isinstance(decision, Assigned) else None
    return NewSlice(
        sop_instance_uid=envelope.sop_instance_uid,
        frame=slice_.frame,
        sha256=envelope.sha256,
        path=path,
        state=state,
        hold_id=hold_id,
        reason_code=code,
        reason=text,
        received_s=envelope.received_s,
        received_monotonic_s=envelope.received_monotonic_s,
        acquired_from_s=assigned.acquired_from_s if assigned else None,
        acquired_to_s=assigned.acquired_to_s if assigned else None,
        time_source=ARRIVAL if arrival_mode else _time_source(decision, slice_.interval),
        header={**header_for_record(slice_), "envelope": asdict(envelope)},
    )


def row_without_header(envelope: Envelope, path: str, reason: SetAside) -> NewSlice:
    """The row of a file from which no header could be read."""
    return NewSlice(
        sop_instance_uid=envelope.sop_instance_uid,
        frame=0,
        sha256=envelope.sha256,
        path=path,
        state="quarantined",
        hold_id=None,
        reason_code=str(reason.code),
        reason=reason.text,
        received_s=envelope.received_s,
        received_monotonic_s=envelope.received_monotonic_s,
        acquired_from_s=None,
        acquired_to_s=None,
        time_source="",
        header={"envelope": asdict(envelope)},
    )


def outcome_of(decision: Decision | SetAside) -> tuple[str, int | None, str, str]:
    """(state, hold_id, reason code, reason) as the record words them."""
    if isinstance(decision, Assigned):
        return "assigned", decision.hold_id, "", ""
    state = "pending" if isinstance(decision, Pending) else "quarantined"
    return state, None, str(decision.code), decision.text


def _time_source(decision: Decision | SetAside, interval: AcquisitionInterval | None) -> str:
    if isinstance(decision, Assigned):
        return decision.time_source
    return "" if interval is None else interval.source
