"""`autospine study numerical` as a user runs it: real processes, real files, a real cluster."""

import csv
import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


def _study(*arguments: str, timeout_s: float = 200.0) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "studies", *arguments],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=timeout_s,
        check=False,
        env={**os.environ, "COLUMNS": "140"},
    )


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> tuple[dict[str, object], Path]:
    folder = tmp_path_factory.mktemp("study") / "new" / "folder"
    arguments = ("--trials", "12", "--map-trials", "2", "--seed", "5", "--json")
    done = _study("numerical", *arguments, "--out", str(folder))
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    return json.loads(done.stdout), folder


def test_json_gives_each_method_with_its_mean_error(written: tuple[dict, Path]) -> None:
    result, _ = written
    methods = {entry["method"]: entry for entry in result["methods"]}
    assert list(methods) == ["base", "bicubic", "sr", "ml1", "ml"]
    for entry in methods.values():
        assert 0.0 < entry["mean_error_px"] < 0.5
        assert entry["trials"] == 12
    assert methods["sr"]["paper_mean_error_px"] == 0.066
    assert methods["ml"]["bound_mean_error_px"] == pytest.approx(
        methods["ml1"]["bound_mean_error_px"] / 2
    )
    assert {"blur", "noise", "circle radius"} <= set(result["not_in_the_paper"])
    assert len(result["map"]) == 36
    assert {(t["first"], t["second"]) for t in result["f_tests"]} >= {("base", "sr"), ("sr", "ml")}


def test_tables_and_figures_are_written(written: tuple[dict, Path]) -> None:
    result, folder = written
    names = {Path(file).name for file in result["files"]}
    assert names == {
        "numerical_trials.csv",
        "numerical_map.csv",
        "numerical_scatter.png",
        "numerical_scatter.svg",
        "numerical_map.png",
        "numerical_map.svg",
    }
    for name in names:
        assert (folder / name).stat().st_size > 1000
    with (folder / "numerical_trials.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 12 * 7
    ours = [row for row in rows if row["method"] == "ml"]
    errors = [abs(float(row["col_px"]) - float(row["true_col_px"])) for row in ours]
    assert max(errors) < 0.1
    assert (folder / "numerical_scatter.png").read_bytes().startswith(b"\x89PNG")
    assert "<svg" in (folder / "numerical_scatter.svg").read_text(encoding="utf-8")[:1000]


def test_the_table_stands_beside_the_papers_numbers_and_says_what_was_chosen() -> None:
    done = _study("numerical", "--trials", "5", "--map-trials", "0")
    assert done.returncode == 0, done.stderr
    for text in ("0.156", "0.135", "0.066", "Not given in the paper", "F-test", "sensitivity 0.85"):
        assert text in done.stdout
    assert done.stderr == ""


@pytest.fixture(scope="module")
def scheduler() -> Iterator[str]:
    """Two worker processes on loopback, as a user would start them."""
    code = (
        "from distributed import LocalCluster\n"
        "if __name__ == '__main__':\n"
        "    with LocalCluster(n_workers=2, threads_per_worker=1, processes=True,\n"
        "                      host='127.0.0.1', dashboard_address=None) as cluster:\n"
        "        print(cluster.scheduler_address, flush=True)\n"
        "        input()\n"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", code],
        cwd=ROOT,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
        env={**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"},
    )
    assert process.stdout is not None
    address = process.stdout.readline().strip()
    assert address.startswith("tcp://127.0.0.1:")
    yield address
    process.communicate("\n", timeout=60)


def test_a_cluster_of_two_processes_gives_the_same_numbers(scheduler: str) -> None:
    arguments = ("numerical", "--trials", "12", "--map-trials", "0", "--seed", "6", "--json")
    runs = [_study(*arguments), _study(*arguments, "--scheduler", scheduler)]
    for run in runs:
        assert run.returncode == 0, run.stderr
    alone, there = (json.loads(run.stdout) for run in runs)
    assert len(there["methods"]) == 5
    assert there == alone


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--trials", "1"], "--trials is 1"),
        (["--map-trials", "1"], "--map-trials is 1"),
        (["--seed", "-3"], "--seed is -3"),
        (["--radius", "nan"], "--radius is nan"),
        (["--snr", "0"], "--snr is 0"),
        (["--blur", "-1"], "--blur is -1"),
        (["--sensitivity", "1.5"], "sensitivity is 1.5"),
        (["--shift-set", "spiral"], "unknown shift set 'spiral'"),
        (["--out", __file__], "File exists"),
        (["--scheduler", "nonsense://"], "no Dask scheduler at 'nonsense://'"),
    ],
)
def test_bad_input_is_one_line_on_stderr_and_exit_code_2(
    arguments: list[str], message: str
) -> None:
    done = _study("numerical", *arguments)
    assert done.returncode == 2
    assert message in done.stderr
    assert len(done.stderr.splitlines()) == 1
    assert done.stdout == ""
