"""What page and API say of the scanner's clock is what the listener makes of the same record."""

import itertools
import time
from pathlib import Path

import pytest

from case_record.cases import Cases
from case_record.record import CaseRecord
from dicom_listener.process import intake_rules
from dicom_listener.scanner_clocks import (
    CLOCK_COMPARED,
    CLOCK_DOUBTED,
    CLOCK_FORGOTTEN,
    ScannerClocks,
)
from room_config.load import Config, load_config
from service.room.cases.life import begin
from service.room.scanner_clock import clock_update, clock_was_set, note_step

TEXT = "the scanner's clock is at least 3.0 s ahead of the comparison"
KINDS = (CLOCK_COMPARED, CLOCK_DOUBTED, CLOCK_FORGOTTEN)
DOUBTED = f"Doubted: compare again (A scanner: {TEXT}). Until then slices are pending."


def configured(folder: Path, **listener: str) -> Config:
    keys = "\n".join(f"{key} = {value}" for key, value in listener.items())
    path = folder / "room.toml"
    path.write_text(
        f'[room]\nname = "t"\ncase_dir = "case"\n[listener]\n{keys}\n'
        '[service]\nbridge_link = "/dev/null"\n'
    )
    return load_config(path, {})


def say(record: CaseRecord, kind: str) -> None:
    now_s = time.time()
    bodies = {
        CLOCK_COMPARED: {"offset_s": 1.0, "uncertainty_s": 0.1, "at_s": now_s},
        CLOCK_DOUBTED: {"scanner": "A scanner", "text": TEXT, "is_certain": True, "at_s": now_s},
        CLOCK_FORGOTTEN: {"why": "it was set"},
    }
    record.append_event(kind, bodies[kind], source="test")


@pytest.mark.parametrize("filed", ["", "before", "after"])
def test_a_doubt_is_shown_exactly_while_the_listener_has_it(tmp_path, filed):
    keys = filed_at(time.time() + (3600 if filed == "after" else -3600)) if filed else {}
    config = configured(tmp_path, **keys)
    rules = intake_rules(config)
    shown = set()
    with CaseRecord(tmp_path / "case", create=True) as record:
        clocks = ScannerClocks(rules.clock, rules.comparison)
        for kind in itertools.chain(*itertools.product(KINDS, repeat=3)):
            say(record, kind)
            event = record.last_event(kind)
            clocks.heed(kind, event.body, event.wall_s)
            state = clock_update(config, record, time.time())
            known, shown_clock = clocks.comparison, state["clock"]
            assert (shown_clock and shown_clock.offset_s) == (known and known.offset_s)
            is_doubted = bool(clocks.doubts)
            assert bool(state["clock_doubted"]) == is_doubted
            assert (state["clock_implies"] == DOUBTED) == is_doubted
            codes = [alarm.code for alarm in clock_was_set(config, record)]
            assert ("clock_doubted" in codes) == is_doubted
            shown.add(is_doubted)
    assert shown == ({False} if filed == "after" else {True, False})


def filed_at(made_s: float) -> dict[str, str]:
    at = time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime(made_s))
    return {"clock_offset_s": "0.5", "clock_uncertainty_s": "0.1", "clock_compared_at": at}


def test_the_newer_of_the_files_comparison_and_the_records_is_shown(tmp_path):
    now_s = time.time()
    config = configured(tmp_path, **filed_at(now_s - 60))
    with CaseRecord(tmp_path / "case", create=True) as record:
        for at_s, shown_s in ((now_s - 120, 0.5), (now_s - 30, 1.0)):
            body = {"offset_s": 1.0, "uncertainty_s": 0.1, "at_s": at_s}
            record.append_event(CLOCK_COMPARED, body, source="test")
            assert clock_update(config, record, now_s)["clock"].offset_s == shown_s


def test_after_this_computer_was_set_back_the_file_is_not_newer_than_it_is(tmp_path):
    config = configured(tmp_path, **filed_at(time.time() + 1800))  # by the clock before
    rules = intake_rules(config)
    with CaseRecord(tmp_path / "case", create=True) as record:
        clocks = ScannerClocks(rules.clock, rules.comparison)
        note_step(record, -3600.0)
        say(record, CLOCK_COMPARED)
        for kind, shown_s in ((CLOCK_FORGOTTEN, None), (CLOCK_COMPARED, 1.0)):
            event = record.last_event(kind)
            clocks.heed(kind, event.body, event.wall_s)
            assert (clocks.comparison and clocks.comparison.offset_s) == shown_s
        assert clock_update(config, record, time.time())["clock"].offset_s == 1.0


def test_that_this_computer_was_set_back_comes_along_into_every_later_case(tmp_path, monkeypatch):
    now_s = time.time()
    config = configured(tmp_path, **filed_at(now_s + 43200))
    cases = Cases(tmp_path / "cases")
    with CaseRecord(begin(cases, "t", "me", {})) as record:
        note_step(record, -86400.0)
        monkeypatch.setattr(time, "time", lambda: now_s + 7200)
        say(record, CLOCK_COMPARED)
    begin(cases, "t", "me", {})
    with CaseRecord(begin(cases, "t", "me", {})) as record:
        assert clock_update(config, record, time.time())["clock"].offset_s == 1.0
