"""Runs that were killed, and runs that live: whose lock is taken away, and what is left behind."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from vinetrack.core.problems import ExperimentError
from vinetrack.pipeline.run_stage import RunPaths, run_chain
from vinetrack.pipeline.workflow import begin_run, executes_nothing

ROOT = Path(__file__).parents[2]
BEGIN = """
import time
from pathlib import Path
from vinetrack.pipeline.workflow import begin_run
lock = begin_run(Path("results/vines"), Path("vines"), Path.cwd(), print)
Path(".snakemake/locks").mkdir(parents=True)
Path(".snakemake/locks/0.output.lock").write_text("results/vines/trials.csv\\n")
Path(".snakemake/locks/1.output.lock").write_text("results/vines_else/trials.csv\\n")
print("begun", flush=True)
time.sleep(60)
"""


@pytest.fixture
def other_run(tmp_path: Path):
    """Another process that has begun a run on `results/vines` and locked it."""
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-c", BEGIN]
    with subprocess.Popen(command, cwd=tmp_path, env=environment, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "begun\n"
        yield process
        process.kill()


def begin(folder: Path) -> list[str]:
    """Begin a run on the same results and end it; what it says."""
    lines: list[str] = []
    begin_run(folder / "results" / "vines", folder / "vines", folder, lines.append).release()
    return lines


def test_the_locks_of_a_killed_run_are_taken_away_but_not_those_of_other_results(
    tmp_path: Path, other_run: subprocess.Popen[str]
) -> None:
    other_run.kill()
    other_run.wait()
    assert len(begin(tmp_path)) == 1
    assert [path.name for path in (tmp_path / ".snakemake" / "locks").iterdir()] == ["1.output.lock"]
    assert begin(tmp_path) == []


def test_a_run_that_lives_is_named_and_keeps_its_lock(tmp_path: Path, other_run: subprocess.Popen[str]) -> None:
    paths = RunPaths(tmp_path / "vines", tmp_path / "results" / "vines")
    for start in (lambda: begin(tmp_path), lambda: run_chain(paths, 1, print)):
        with pytest.raises(ExperimentError, match=f"process {other_run.pid}"):
            start()
    assert (tmp_path / ".snakemake" / "locks" / "0.output.lock").exists()
    assert not (tmp_path / "results" / "vines" / "logs").exists()


def test_files_that_were_never_finished_are_cleared_but_not_those_that_another_command_may_write_now(
    tmp_path: Path,
) -> None:
    folders = tmp_path / "results" / "vines" / "tracks", tmp_path / "vines"
    for folder in folders:
        folder.mkdir(parents=True)
        for name in (f".tmp-{'0f' * 16}.csv", ".part-a.mp4", ".tmp-mine", f".tmp-{'1e' * 16}.csv"):
            (folder / name).touch()
            if "1e" not in name:
                os.utime(folder / name, (1e9, 1e9))
    begin(tmp_path)
    for folder in folders:
        assert sorted(path.name for path in folder.iterdir()) == [f".tmp-{'1e' * 16}.csv", ".tmp-mine"]


@pytest.mark.parametrize("option", ["-n", "-np", "--dry-run", "--unlock", "--report=a.html", "--list-rules", "-nq"])
def test_where_nothing_is_run_nothing_is_begun(option: str) -> None:
    assert executes_nothing(["--cores", "2", option])


@pytest.mark.parametrize(
    "options", ["-call", "-c2 -call", "--cores 2 --config experiment=n --rerun-incomplete --quiet rules host"]
)
def test_a_run_is_no_look(options: str) -> None:
    assert not executes_nothing(options.split())
