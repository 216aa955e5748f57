"""Runs a procedure step by step, records every outcome, and after a crash replays what it has.

A fresh generator is fed the recorded outcomes and so stands where the old one stood. A step that
was sent but has no outcome is carried out again; moves carry the same command id as before, and
the bridge answers those it knows from its journal.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import MISSING, fields
from typing import TypeVar

from case_record.record import CaseRecord
from case_record.rows import Step as RecordedStep
from service.procedure.steps import (
    MoveTo,
    Outcome,
    ProcedureSteps,
    Step,
    outcome_from_json,
    outcome_to_json,
    step_to_json,
)

Result = TypeVar("Result")
Execute = Callable[[Step, str], Outcome]


class ReplayMismatchError(Exception):
    """The recorded steps are not those that this program would take."""


def command_id(case_uid: str, procedure_id: int, number: int) -> str:
    """The id of a step's move: unique for ever, and the same again after a crash."""
    return f"{case_uid}/{procedure_id}/{number}"


def measurement_name(case_uid: str, measurement_id: int) -> str:
    """What the bridge calls a measurement: its journal goes on where a new case counts anew."""
    return f"{case_uid}/{measurement_id}"


def run_procedure(
    record: CaseRecord,
    procedure_id: int,
    procedure: ProcedureSteps[Result],
    execute: Execute,
    case_uid: str,
) -> Result:
    """Return what the procedure returns. What `execute` or the procedure raises comes through."""
    number = 0
    try:
        step = next(procedure)
        while True:
            outcome = _carry_out(record, procedure_id, number, step, execute, case_uid)
            step = procedure.send(outcome)
            number += 1
    except StopIteration as finished:
        result: Result = finished.value
        return result
    finally:
        procedure.close()


def same_step(known: RecordedStep, step: Step) -> bool:
    """True if the recorded step is this one; what a program before did not know has its default."""
    kind, body = step_to_json(step)
    defaults = {one.name: one.default for one in fields(step) if one.default is not MISSING}
    if isinstance(step, MoveTo):  # a program before took the phase from the purpose
        defaults["phase"] = step.phase
    recorded = json.loads(json.dumps({**defaults, **known.body}))
    return known.kind == kind and recorded == json.loads(json.dumps(body))


def _carry_out(
    record: CaseRecord,
    procedure_id: int,
    number: int,
    step: Step,
    execute: Execute,
    case_uid: str,
) -> Outcome:
    kind, body = step_to_json(step)
    known = record.send_step(procedure_id, number, kind, body)
    if not same_step(known, step):
        raise ReplayMismatchError(
            f"step {number} of procedure {procedure_id} is recorded as {known.kind}, but this "
            f"version of the program would take {kind}; start the procedure again"
        )
    if known.outcome is not None:
        return outcome_from_json(kind, known.outcome)
    outcome = execute(step, command_id(case_uid, procedure_id, number))
    record.end_step(procedure_id, number, outcome_to_json(outcome))
    # what the procedure sees now is what it would see in a replay, to the last bit
    recorded = json.loads(json.dumps(outcome_to_json(outcome)))
    return outcome_from_json(kind, recorded)
