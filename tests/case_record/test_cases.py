"""The cases of a room: which one is open, and what a crash in between leaves."""

import pytest

from case_record.cases import OPEN_FILE, Cases, CasesError, NoCaseError
from case_record.record import CaseRecord, CaseRecordError


def begun(cases: Cases):
    folder = cases.make_folder()
    with CaseRecord(folder, create=True) as record:
        record.start_case("room", 0)
    cases.set_open(folder)
    return folder


def test_a_room_that_names_one_folder_has_one_case_for_ever(tmp_path):
    cases = Cases(None, tmp_path / "case")
    assert cases.open == cases.home == cases.required() == tmp_path / "case"
    for change in (cases.make_folder, lambda: cases.set_open(None)):
        with pytest.raises(CasesError, match="cases_dir"):
            change()


@pytest.mark.parametrize("folders", [(None, None), ("a", "b")])
def test_it_is_one_of_the_two_and_never_both(tmp_path, folders):
    with pytest.raises(CasesError, match="either a cases_dir or a case_dir"):
        Cases(*(None if name is None else tmp_path / name for name in folders))


def test_another_process_sees_at_its_next_look_which_case_is_open(tmp_path):
    ours, theirs = Cases(tmp_path / "cases"), Cases(tmp_path / "cases")
    assert theirs.open is None
    with pytest.raises(NoCaseError, match="New case"):
        theirs.required()
    for _ in range(5):
        folder = begun(ours)
        assert theirs.open == folder
        assert theirs.named(None) == folder
        ours.set_open(None)
        assert theirs.open is None
    assert len(theirs.folders()) == 5
    assert len({path.name for path in theirs.folders()}) == 5


def test_old_cases_are_found_by_name_and_no_path_gets_through(tmp_path):
    cases = Cases(tmp_path / "cases")
    folder = begun(cases)
    (tmp_path / "elsewhere").mkdir()
    with CaseRecord(tmp_path / "elsewhere", create=True):
        pass
    assert cases.named(folder.name) == folder
    for name in ("../elsewhere", str(tmp_path / "elsewhere"), ".", "", "no such"):
        with pytest.raises(CaseRecordError, match="no case"):
            cases.named(name)


@pytest.mark.parametrize("word", ["../elsewhere\n", "..\n", "/etc\n"])
def test_a_word_that_is_no_folders_name_opens_nothing(tmp_path, word):
    (tmp_path / OPEN_FILE).write_text(word)
    with pytest.raises(CasesError, match="not a folder name"):
        _ = Cases(tmp_path).open


def test_what_a_crash_leaves_half_written_is_not_read(tmp_path):
    cases = Cases(tmp_path)
    folder = begun(cases)
    (tmp_path / OPEN_FILE).with_suffix(".part").write_text("20")
    assert Cases(tmp_path).open == folder


def test_a_folder_that_cannot_be_written_is_named(tmp_path):
    (tmp_path / "file").write_text("not a folder")
    with pytest.raises(CasesError, match=r"file.*cannot be created"):
        Cases(tmp_path / "file").make_folder()
