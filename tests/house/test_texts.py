"""The texts that people read use the words of docs/vocabulary.md: `python docs/list_texts.py`."""

import importlib.util
import re
from pathlib import Path

import pytest

from service.room.alarm_list import TO_DO

ROOT = Path(__file__).parents[2]
# a word that was given up in favour of another one, and that one
INSTEAD = {
    r"\banew\b": "again",
    r"\bany more\b": "no longer",
    r"\bnobody there\b": "no response",
    r"\bsaid nothing\b": "no output",
    r"\b(?:is|are) there (?:already|twice)\b": "already exists, appears twice",
    r"\bbroken off\b": "interrupted",
    r"\bgive(?:n)? (?:it |them )?up\b": "stop waiting, closed",
    r"\btaken over\b": "accepted",
    r"\bgo on with\b": "continue",
    r"\bbegin (?:a|the|another) case\b": "start a case",
    r"\b(?:somebody|everybody)\b": "someone, everyone",
    r"\b(?:is|are|no) rejected slices?\b": "set aside",
}


@pytest.fixture(scope="module")
def texts() -> list[tuple[Path, int, str]]:
    spec = importlib.util.spec_from_file_location("list_texts", ROOT / "docs" / "list_texts.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return list(module.texts())


def test_every_kind_of_text_is_in_the_list(texts):
    listed = {(str(path), text) for path, _, text in texts}
    for path, text in (
        ("service/room/prompt.py", "READY: make the puncture."),
        (
            "service/room/prompt.py",
            "Stopped ({plain_words(status.stop_reason)}). Re-arm to continue.",
        ),
        ("service/room/alarm_list.py", "Send or acquire the slice again."),
        ("service/page/texts.js", "Needle withdrawn – unlock motion"),
        ("service/page/index.html", "Emergency: stop and park the drives"),
        ("room_config/listener.py", "Largest object that is stored."),
        ("robot_bridge/engineer/main.py", "move without asking"),
    ):
        assert (path, text) in listed


@pytest.mark.parametrize("word", INSTEAD)
def test_a_word_that_was_given_up_does_not_come_back(texts, word):
    found = [
        f"{path}:{line}: {text}"
        for path, line, text in texts
        if re.search(word, text, re.IGNORECASE)
    ]
    assert not found, f"say {INSTEAD[word]!r}"


def test_what_the_listener_raises_comes_with_what_to_do():
    raised = re.compile(r'alarms?(?:\.append\()?\(+\s*"([a-z_]+)"')
    kinds = {
        kind
        for path in (ROOT / "dicom_listener").rglob("*.py")
        for kind in raised.findall(path.read_text())
    }
    assert {"clock_jump", "watch_dir_gone", "many_slices_wait"} <= kinds
    assert kinds <= TO_DO.keys()
