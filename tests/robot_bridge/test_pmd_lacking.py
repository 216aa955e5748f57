"""A board that does not answer everything: it is said, and what it does answer is still checked."""

import re

import pytest
from pmd_bench import Bench

from robot_bridge.daemon.motors import MotorError
from robot_bridge.emulator.commands import Answer

OPTIONAL = [r"\?", "H", "N", "B", "Y0", "Y30", "Y42", "Y44", "U2", "U3"]


def bench(**changes: object) -> Bench:
    return Bench(names=("xt",), declare=False, **changes)


def answers(made: Bench, pattern: str, instead: str | None) -> None:
    """What the board says to questions like that; None: nothing."""
    real = made.bus._reply

    def reply(shown: str, answer: Answer, delimiter: int, at_s: float) -> None:
        if not re.fullmatch(f"({pattern})(:.*)?", answer.text):
            real(shown, answer, delimiter, at_s)
        elif instead is not None:
            body = answer.text.partition(":")[0]
            real(shown, Answer(instead.replace("BODY", body), False), delimiter, at_s)

    made.bus._reply = reply


EVERYTHING = "|".join(OPTIONAL)
LACKING = [
    *[("closed_loop", pattern, None) for pattern in OPTIONAL],
    *[
        (drive, EVERYTHING, said)
        for drive in ("open_loop", "closed_loop")
        for said in (None, "_??_BODY", "BODY:!")
    ],
]


@pytest.mark.parametrize(("drive", "pattern", "said"), LACKING)
def test_what_a_board_need_not_tell_is_a_warning(drive: str, pattern: str, said: str | None):
    """Refused, not understood, or not answered at all."""
    made = bench(drive=drive)
    answers(made, pattern, said)
    status = made.restart()
    assert status.fault is None
    made.motors.declare_position({"xt": 0})
    assert made.move(1500).reached
    assert made.truth_um() == pytest.approx(1500, abs=2)
    assert made.rest(6.0).fault is None
    asked = pattern.replace("\\", "").split("|")
    warnings = "\n".join(made.motors.poll().warnings)
    assert all(f"'{what}'" in warnings for what in asked if what != "Y30")


def test_a_board_that_answers_nothing_at_all_is_a_fault():
    made = bench()
    answers(made, ".*", None)
    with pytest.raises(MotorError, match="did not answer") as caught:
        made.restart()
    assert caught.value.code == "no_answer"


def test_what_a_board_has_answered_before_it_can_answer():
    """Silence then is the line's, and the length of a run must be known."""
    made = bench(drive="open_loop")
    made.motors.declare_position({"xt": 0})
    assert made.move(1500).reached
    answers(made, "Y0", None)
    assert made.move(3000).fault == "no_answer"
    assert made.truth_um() == pytest.approx(1500, abs=2)


def changed_before_a_move(made: Bench) -> None:
    made.motors.declare_position({"xt": 0})
    made.board.settings.store(4, 2000)  # a limit at 200 um
    status = made.move(1000)
    assert status.fault == "setting"
    assert "Y4 reads 2000" in status.fault_text
    assert made.truth_um() == 0


@pytest.mark.parametrize("said", [None, "_??_BODY", "BODY:!"])
def test_settings_are_verified_one_by_one_where_they_are_not_told_together(said: str | None):
    made = bench()
    answers(made, "Y30", said)
    made.restart()
    changed_before_a_move(made)


@pytest.mark.parametrize("said", [None, "_??_BODY", "BODY:!"])
def test_one_setting_that_cannot_be_read_leaves_the_others_verified(said: str | None):
    made = bench()
    answers(made, "Y30|Y7", said)
    status = made.restart()
    assert any("'Y7'" in warning and "read back" in warning for warning in status.warnings)
    changed_before_a_move(made)


def test_a_setting_that_does_not_take_is_found_although_another_cannot_be_read():
    made = bench()
    answers(made, "Y30|Y7", None)
    made.board.settings.store(4, 5)
    real = made.board.settings.store
    made.board.settings.store = lambda number, value: None if number == 4 else real(number, value)
    with pytest.raises(MotorError, match="Y4 reads 5 after it was set"):
        made.restart()


def test_a_command_that_cannot_be_formed_is_a_fault_of_its_axis():
    made = bench(counts_per_mm=1e8, travel_max_um=30_000)
    made.motors.declare_position({"xt": 0})
    made.motors._axes["xt"].proven = True
    status = made.move(25_000)  # 2.5e9 counts do not fit into 32 bits
    assert status.fault == "bad_command"
    assert "axis xt" in status.fault_text
    assert "32-bit" in status.fault_text
    assert made.truth_um() == 0
