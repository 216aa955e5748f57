"""Anything that an engineer may type, in any order, with faults in between; the truth is the judge.

Whatever was typed: an axis that it did not name stays, nothing leaves the travel, what is called
certain is where it is said to be, and every refusal is one clear line.
"""

import os
import random
from pathlib import Path

import pytest
from bench_rig import Bench, bench

NAMES = ("xt", "yt", "xb", "yb")
NEAR_MM = 0.06  # an axis's tolerance, its approach and the parking
SWITCHES_MM = 20.0
NONSENSE = ("nan", "inf", "1e9", "", "0", "-0", "5.0001", "--5", "1,5", "xt", "0x1", "1e-9")
FAULTS = ("limit_reverse", "limit_forward", "encoder_frozen", "overheat", "supply_lost", "dead")


class Session:
    def __init__(self, room: Bench, rng: random.Random, drives: dict[str, str]) -> None:
        self.room, self.rng, self.drives = room, rng, drives
        self.names = list(drives)
        self.offset_mm = dict.fromkeys(self.names, 0.0)  # of the coordinates: what homing defines
        self.typed: list[str] = []

    def truth_mm(self) -> dict[str, float]:
        by_address = self.room.truth_mm()
        return {name: by_address[str(n)] for n, name in enumerate(self.names, 1)}

    def story(self) -> str:
        return "\n".join(self.typed)

    # --- what happens -------------------------------------------------------------------------

    def tell(self, request: str) -> None:
        self.typed.append(f"# {request}")
        assert "error" not in self.room.tell(request), self.story()

    def disturb(self) -> None:
        axis = self.rng.choice(self.names)
        address = self.names.index(axis) + 1
        fault = self.rng.choice(FAULTS)
        self.rng.choice(
            (
                lambda: self.tell(f"power-cycle {address}"),
                lambda: self.tell(f"fault {address} {fault} on"),
                lambda: self.tell(f"line drop_replies {self.rng.randint(1, 9)}"),
                lambda: self.tell(f"line garble_commands {self.rng.randint(1, 3)}"),
                lambda: self.tell(f"line garble_replies {self.rng.randint(1, 5)}"),
            )
        )()

    def mend(self) -> None:
        for address in range(1, len(self.names) + 1):
            for fault in FAULTS:
                self.room.tell(f"fault {address} {fault} off")
        for name in ("drop_replies", "garble_commands", "garble_replies"):
            self.room.tell(f"line {name} 0")
        self.typed.append("# all is well again")

    # --- what is typed ------------------------------------------------------------------------

    def number(self, reach_mm: float) -> str:
        if self.rng.random() < 0.15:
            return self.rng.choice(NONSENSE)
        return f"{self.rng.uniform(-reach_mm, reach_mm):.3f}"

    def measured(self, axis: str) -> str:
        """What a gauge says, in the coordinates that homing has defined, if it has."""
        at_mm = self.truth_mm()[axis] - self.offset_mm[axis] + self.rng.uniform(-0.01, 0.01)
        if self.rng.random() < 0.1:
            return f"{axis}={self.rng.choice(('nan', 'inf', '', '12,3', '1e7'))}"
        return f"{axis}={at_mm:.3f}" + self.rng.choice(("", "+-0.02"))

    def words(self) -> list[str]:
        axis = self.rng.choice(self.names) if self.rng.random() < 0.95 else "zz"
        at = []
        for name in self.names:
            if self.rng.random() < 0.5:
                at += ["--at", self.measured(name)]
        return self.rng.choice(
            (
                [*at, "jog", axis, self.number(5)],
                [*at, "jog", axis, self.number(5)],
                [*at, "jog", axis, self.number(1)],
                ["declare", self.measured(self.rng.choice(self.names))],
                ["home", axis],
                ["rearm"],
                ["status"],
                ["stop"] if self.rng.random() < 0.7 else ["stop", "--emergency"],
                ["drives", self.rng.choice(("on", "off"))],
                ["calibrate-steps", axis, "--steps", self.rng.choice(("50", "0", "99999", "x"))],
                ["find-encoder", axis],
            )
        )

    def moves(self, words: list[str]) -> set[str]:
        named = {"jog", "home", "calibrate-steps", "find-encoder"} & set(words)
        return {name for name in self.names if named and name in words}

    def type(self, words: list[str]) -> tuple[int, dict]:
        self.typed.append("autospine robot " + " ".join(words))
        config = str(self.room.folder / "bench.toml")
        try:
            code, fields, said = self.room.robot("--config", config, "--direct", *words)
        except SystemExit as usage:  # argparse: not even a command
            code, fields, said = int(usage.code or 0), {}, "usage"
        assert code in (0, 2, 3), self.story()
        assert "Traceback" not in said, self.story()
        assert code == 0 or said.strip(), self.story()
        return code, fields

    # --- the judge ----------------------------------------------------------------------------

    def one(self) -> None:
        before_mm, words = self.truth_mm(), self.words()
        code, fields = self.type(words)
        after_mm = self.truth_mm()
        asked = self.moves(words)
        for name in self.names:
            gone_mm = after_mm[name] - before_mm[name]
            assert name in asked or abs(gone_mm) <= NEAR_MM, f"{name}: {gone_mm}\n{self.story()}"
            assert abs(after_mm[name]) <= SWITCHES_MM + NEAR_MM, self.story()
        if code == 0 and "jog" in words:
            wanted_mm = float(words[words.index("jog") + 2])
            gone_mm = after_mm[words[words.index("jog") + 1]] - before_mm[asked.copy().pop()]
            assert abs(gone_mm - wanted_mm) <= NEAR_MM, self.story()
        if code == 0 and "home" in words:
            told_mm = fields["readback_um"][words[1]] / 1000
            self.offset_mm[words[1]] = after_mm[words[1]] - told_mm
            assert abs(self.offset_mm[words[1]]) < 0.1, self.story()

    def check_status(self) -> None:
        code, fields = self.type(["status"])
        if code != 0:
            return
        for name, said in fields["positions_um"].items():
            if isinstance(said, int):  # unknown is a text
                off_mm = said / 1000 + self.offset_mm[name] - self.truth_mm()[name]
                assert abs(off_mm) <= NEAR_MM, f"{name} {off_mm}\n{self.story()}"


def session(folder: Path, seed: int, commands: int) -> None:
    rng = random.Random(seed)
    names = NAMES[: rng.choice((1, 2, 4))]
    drives = {name: rng.choice(("closed_loop", "open_loop")) for name in names}
    with bench(folder, ",".join(str(n) for n in range(1, len(names) + 1))) as room:
        room.write_file(drives, "guardian = false\n")
        typing = Session(room, rng, drives)
        for number in range(commands):
            if rng.random() < 0.15:
                typing.disturb()
            typing.one()
            if number % 5 == 4:
                typing.mend()
                typing.check_status()


def test_whatever_is_typed_the_truth_agrees(tmp_path: Path):
    session(tmp_path, 3, 10)


@pytest.mark.soak
def test_long_sessions_of_anything(tmp_path: Path):
    first_seed = int(os.environ.get("SEED", "100"))
    for seed in range(first_seed, first_seed + int(os.environ.get("SESSIONS", "30"))):
        (tmp_path / str(seed)).mkdir()
        session(tmp_path / str(seed), seed, 40)
