"""Commands over a line with every fault and restarts of both sides: no harm, and agreement."""

import json
import tempfile
from pathlib import Path

import pytest
from campaign import Campaign, again_asked_moves_nothing
from hypothesis import given, settings
from hypothesis import strategies as st

SEEDS = (1, 2, 3)
SHORT_COMMANDS = 600
LONG_COMMANDS = 100_000
COMMANDS_A_SEED = 2_000


def run(folder: Path, seed: int, commands: int) -> Campaign:
    campaign = Campaign(folder, seed)
    findings = campaign.run(commands)
    assert sum(findings.harm.values()) == 0, (seed, findings)
    assert findings.commands >= commands
    assert again_asked_moves_nothing(campaign, sample=min(50, commands))
    campaign.room.close()
    return campaign


@pytest.mark.parametrize("seed", SEEDS)
def test_no_fault_of_line_or_process_moves_wrongly_or_twice(tmp_path: Path, seed: int):
    campaign = run(tmp_path, seed, SHORT_COMMANDS)
    findings = campaign.findings
    # The campaign proves nothing unless it really did all this.
    assert findings.states["DONE"] > SHORT_COMMANDS / 2, findings
    assert {"REFUSED", "STOPPED", "FAILED"} <= set(findings.states), findings
    assert findings.events["link lost"] > 3, findings
    assert campaign.room.restarts > 5
    assert campaign.room.to_bridge.frames_hit > 100
    assert len(campaign.room.stops_delivered) > 5


@settings(max_examples=12)
@given(seed=st.integers(0, 2**32 - 1))
def test_no_seed_finds_harm(seed: int):
    """Whatever the seed; hypothesis keeps the one that fails."""
    with tempfile.TemporaryDirectory() as folder:
        findings = run(Path(folder), seed, 50).findings
        assert set(findings.harm.values()) == {0}
        assert sum(findings.states.values()) >= 50


@pytest.mark.parametrize("baud", [115200, 57600])
def test_on_one_pair_of_wires_with_collisions_and_echoes_it_still_works(tmp_path: Path, baud: int):
    campaign = Campaign(tmp_path, seed=baud)
    campaign.room.make_half_duplex(byte_s=10 / baud)
    findings = campaign.run(300)
    assert sum(findings.harm.values()) == 0, findings
    assert findings.states["DONE"] > 200, findings
    room = campaign.room
    assert room.to_bridge.collisions + room.to_service.collisions > 0
    assert campaign.client.counters.own_echoes > 0
    room.close()


@pytest.mark.soak
def test_no_harm_in_a_hundred_thousand_commands(tmp_path: Path):
    total: dict[str, int] = {}
    commands = 0
    for seed in range(1000, 1000 + LONG_COMMANDS // COMMANDS_A_SEED):
        folder = tmp_path / str(seed)
        findings = run(folder, seed, COMMANDS_A_SEED).findings
        commands += findings.commands
        for counter in (findings.states, findings.events):
            for name, count in counter.items():
                total[name] = total.get(name, 0) + count
        print(json.dumps({"seed": seed, "commands": commands, **findings.harm}), flush=True)
    print(json.dumps(total))
    assert commands >= LONG_COMMANDS
