"""The reconstruction benchmark runs, and what it measures has the growth that is claimed."""

import json
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]


def test_the_benchmark_measures_a_fast_closed_form_that_grows_as_claimed(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "benchmarks/reconstruct.py", "--quick", "--json", "--out", str(tmp_path)],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=200,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    head = found["head_to_head"]
    assert head["paper_iterations"] == 100
    assert head["ibp_100_over_fourier"] >= 50
    assert head["fourier"]["rms_error"] < head["ibp_100"]["rms_error"]
    # n log n and linear are slopes of 1; small sizes are dominated by what does not grow.
    assert 0.6 < found["exponents"]["time_over_n_log_n"] < 1.35
    assert 0.6 < found["exponents"]["time_over_frames"] < 1.35
    for file in found["files"]:
        assert Path(file).stat().st_size > 1000
