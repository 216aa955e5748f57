"""Each example does what its first lines say."""

import json
import re
import subprocess
import sys
from pathlib import Path

from real_slices import SMALL_SET

EXAMPLES = Path(__file__).parents[2] / "examples"


def run(name: str, *words: object) -> str:
    command = [sys.executable, EXAMPLES / name, *map(str, words)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_localize_prints_centre_and_sigma_of_the_vials_of_a_real_slice():
    said = run("localize.py", SMALL_SET / "hazen" / "nist_T2_site3_ge_plate4" / "Z815")
    rows = re.findall(r"row ([\d.]+) ± ([\d.]+) px, col ([\d.]+) ± ([\d.]+) px", said)
    assert len(rows) >= 14
    assert all(float(sigma) < 0.2 for row in rows for sigma in row[1::2])


def test_a_strategy_of_ones_own_is_tried_beside_the_default():
    said = run("own_strategy.py")
    rows = dict(re.findall(r"(\w+): mean true error ([\d.]+) mm", said))
    assert rows.keys() == {"mine", "adaptive"}
    assert all(float(error_mm) < 0.2 for error_mm in rows.values())


def test_the_notebook_runs_from_frames_to_an_honest_displacement():
    import matplotlib

    matplotlib.use("Agg")
    notebook = json.loads((EXAMPLES / "template.ipynb").read_text())
    names: dict[str, object] = {}
    for cell in notebook["cells"]:
        if cell["cell_type"] == "code":
            exec("".join(cell["source"]), names)
    assert names["mean_error_px"] < 0.02
    assert 1.2 < names["nees"] < 2.8
