"""Runs that were killed, and runs that live: whose lock is taken away, and what is left behind."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from vinetrack.core.problems import ExperimentError
from vinetrack.pipeline.run_stage import RunPaths, run_chain
from vinetrack.pipeline.workflow import OWNER_FILE, begin_run, executes_nothing

ROOT = Path(__file__).parents[2]
BEGIN = """
import os, sys, time
from pathlib import Path
from vinetrack.pipeline.workflow import begin_run
begin_run(Path("results/vines"), Path("vines"), Path.cwd(), print)
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
    """Begin a run on the same results; what it says."""
    lines: list[str] = []
    begin_run(folder / "results" / "vines", folder / "vines", folder, lines.append)
    return lines


def test_the_lock_of_a_killed_run_is_taken_away_and_said(tmp_path: Path, other_run: subprocess.Popen[str]) -> None:
    other_run.kill()
    other_run.wait()
    (line,) = begin(tmp_path)
    assert f"lock of an interrupted run (process {other_run.pid})" in line
    assert not (tmp_path / ".snakemake" / "locks" / "0.output.lock").exists()


def test_the_lock_of_a_run_on_other_results_stays(tmp_path: Path, other_run: subprocess.Popen[str]) -> None:
    other_run.kill()
    other_run.wait()
    begin(tmp_path)
    assert (tmp_path / ".snakemake" / "locks" / "1.output.lock").exists()


def test_a_run_that_was_killed_and_not_yet_waited_for_is_dead(tmp_path: Path, other_run: subprocess.Popen[str]) -> None:
    other_run.kill()
    time.sleep(0.2)
    assert len(begin(tmp_path)) == 1


def test_a_run_that_lives_is_named_and_keeps_its_lock(tmp_path: Path, other_run: subprocess.Popen[str]) -> None:
    with pytest.raises(ExperimentError, match=f"is being written by another run, process {other_run.pid}, started at"):
        begin(tmp_path)
    assert (tmp_path / ".snakemake" / "locks" / "0.output.lock").exists()


def test_vinetrack_run_refuses_before_it_touches_the_log(tmp_path: Path, other_run: subprocess.Popen[str]) -> None:
    results = tmp_path / "results" / "vines"
    with pytest.raises(ExperimentError, match=f"process {other_run.pid}"):
        run_chain(RunPaths(tmp_path / "vines", results), 1, print)
    assert not (results / "logs").exists()


def test_a_process_number_given_to_another_program_is_not_the_run(tmp_path: Path) -> None:
    entry = tmp_path / "results" / "vines" / OWNER_FILE
    begin(tmp_path)
    content = json.loads(entry.read_text()) | {"pid": os.getppid(), "started_s": 1e9}
    entry.write_text(json.dumps(content))
    begin(tmp_path)
    assert json.loads(entry.read_text())["pid"] == os.getpid()


def test_a_run_that_ends_in_another_folder_leaves_no_entry(tmp_path: Path) -> None:
    """Snakemake with --directory is back where it was called when its process ends."""
    short = "\n".join(BEGIN.splitlines()[:5]) + '\nassert Path("results/vines/.run.json").is_file()\nos.chdir(os.sep)'
    subprocess.run([sys.executable, "-c", short], cwd=tmp_path, env=os.environ | {"PYTHONPATH": str(ROOT)}, check=True)
    assert not (tmp_path / "results" / "vines" / OWNER_FILE).exists()


def test_a_run_on_another_computer_counts_as_alive(tmp_path: Path) -> None:
    entry = tmp_path / "results" / "vines" / OWNER_FILE
    begin(tmp_path)
    entry.write_text(json.dumps(json.loads(entry.read_text()) | {"pid": 1, "host": "elsewhere"}))
    with pytest.raises(ExperimentError, match=rf"on the computer elsewhere.*delete .*{OWNER_FILE}"):
        begin(tmp_path)


def test_files_that_were_never_finished_are_cleared_and_no_others(tmp_path: Path) -> None:
    tracks, experiment = tmp_path / "results" / "vines" / "tracks", tmp_path / "vines"
    tracks.mkdir(parents=True)
    experiment.mkdir()
    open_file = f".tmp-{'0f' * 16}.csv"
    for path in (tracks / open_file, tracks / ".part-a.mp4", tracks / ".tmp-mine", experiment / open_file):
        path.touch()
    os.utime(experiment / open_file, (1e9, 1e9))
    (experiment / f".tmp-{'1e' * 16}.csv").touch()
    begin(tmp_path)
    assert [path.name for path in tracks.iterdir()] == [".tmp-mine"]
    assert [path.name for path in experiment.iterdir()] == [f".tmp-{'1e' * 16}.csv"]  # may be a save going on


@pytest.mark.parametrize("option", ["-n", "-np", "--dry-run", "--unlock", "--report=a.html", "--list-rules"])
def test_where_nothing_is_run_nothing_is_begun(option: str) -> None:
    assert executes_nothing(["--cores", "2", option])


def test_a_run_is_no_look() -> None:
    assert not executes_nothing(
        ["--cores", "2", "--config", "experiment=n", "--rerun-incomplete", "--quiet", "rules", "host"]
    )
