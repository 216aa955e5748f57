"""What the report says of the case as people see it: who, what was punctured, by which settings."""

from __future__ import annotations

from collections.abc import Iterable
from importlib.metadata import version

from case_record.record import CaseRecord
from case_record.rows import Event
from service.cli.report_html import html_table, number_text, time_text
from service.procedure.registry import APPROACHES
from service.procedure.targets import Target, all_targets
from service.room.belief.goal import SETTINGS_CHANGED

_LISTENER = "listener"


def case_table(record: CaseRecord) -> Iterable[str]:
    """Case, operator, note, when, and the program."""
    case, described = record.case(), record.last_event("case_described")
    words = described.body if described else {}
    yield "<h2>Case</h2>"
    yield html_table(
        ("", ""),
        [
            ("name", words.get("label", "")),
            ("operator", words.get("operator", "")),
            ("note", words.get("note", "")),
            ("room", case.name if case else ""),
            ("begun", time_text(case.created_s) if case else ""),
            ("identifier", case.case_uid if case else ""),
            ("report made with", f"AutoSPINe Navigator {version('autospine')}"),
        ],
    )


def punctures(record: CaseRecord) -> Iterable[str]:
    """Each puncture: when, by whom, at which target, how deep, and how far off by what is known."""
    targets = {target.number: target for target in all_targets(record)}
    rows = [
        _puncture(record, event, targets, place)
        for place, event in enumerate(record.events_of_kind("puncture"), start=1)
    ]
    yield "<h2>Punctures</h2>"
    yield html_table(
        ("", "time", "by", "target", "patient mm (LPS)", "depth mm", "distance mm", "σ mm"), rows
    )


def _puncture(
    record: CaseRecord, event: Event, targets: dict[int, Target], place: int
) -> tuple[object, ...]:
    approach = record.procedure(int(event.body["procedure_id"]))
    target = targets.get(approach.arguments.get("target", 0))
    where = "" if target is None else " ".join(f"{x:.2f}" for x in target.patient_mm)
    name = "" if target is None else target.label or str(target.number)
    return (
        place,
        time_text(event.wall_s),
        event.who,
        f"{name} (in tissue)" if target is not None and target.in_water else name,
        where,
        number_text(event.body.get("insertion_depth_mm")),
        number_text(event.body.get("error_mm"), 1, 3),
        number_text(event.body.get("sigma_mm"), 1, 3),
    )


def settings(record: CaseRecord) -> Iterable[str]:
    """By what each approach was judged, and what the operator changed."""
    rows = []
    for row in record.procedures():
        told = row.arguments.get("arguments", {})
        if row.name in APPROACHES:
            rows.append(
                (
                    row.procedure_id,
                    told.get("strategy", "adaptive"),
                    number_text(told.get("tolerance_mm"), 1, 3),
                    number_text(told.get("confidence"), 100, 1),
                    told.get("most_frames", ""),
                    told.get("max_iterations", ""),
                    "yes" if told.get("confirm_moves") else "no",
                )
            )
    yield "<h2>Settings</h2>"
    heads = ("approach", "strategy", "tolerance mm", "confidence %", "most slices", "most moves")
    yield html_table((*heads, "each move confirmed"), rows)
    changed = [
        (time_text(e.wall_s), e.who, ", ".join(f"{k} {v}" for k, v in sorted(e.body.items())))
        for e in record.events_of_kind(SETTINGS_CHANGED)
    ]
    if changed:
        yield "<p>Changed on the page:</p>"
        yield html_table(("time", "by", "settings of the case from then on"), changed)


def assigned_by_hand(record: CaseRecord) -> Iterable[str]:
    """Slices about which a person decided, not the listener."""
    rows = [
        (
            row.slice_id,
            time_text(row.received_s),
            f"used at hold {row.hold_id}" if row.state == "assigned" else "set aside",
            row.decided_by,
            row.reason,
        )
        for row in record.slices()
        if row.decided_by != _LISTENER
    ]
    yield "<h2>Slices assigned by hand</h2>"
    yield html_table(("slice", "received", "decision", "by", "reason"), rows)
