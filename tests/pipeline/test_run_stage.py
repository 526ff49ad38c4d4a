"""`vinetrack run`: the chain from anywhere, its progress, its last lines, and whose results a folder holds."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from lsoda_vine import grown_position, vine_trial

from vinetrack.core.problems import ExperimentError
from vinetrack.pipeline import run_stage
from vinetrack.pipeline.run_stage import RunError, RunPaths, check_before_run, run_chain, run_lines, run_paths
from vinetrack.pipeline.workflow import claim_results, command_for_results, make_plan

SHEET = "trial,track,diameter_mm,thickness_um,length_mm,pressure_kPa,yield_pressure_kPa,growth_angle_deg\n"


def experiment(folder: Path, rows: str = "a,a.csv,12,100,300,20,3,0\n") -> Path:
    folder.mkdir(parents=True)
    (folder / "trials.csv").write_text(SHEET + rows)
    (folder / "a.csv").write_text("time_s,position_m\n" + "".join(f"{i / 1000},{i / 1e4}\n" for i in range(20)))
    return folder


def test_results_lie_where_snakemake_puts_them_or_under_the_folder_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = experiment(tmp_path / "week" / "vines")
    monkeypatch.chdir(tmp_path)
    assert run_paths(folder, None) == RunPaths(folder, tmp_path / make_plan({"experiment": folder}, tmp_path).results)
    assert run_paths(folder, tmp_path / "out").results == tmp_path / "out" / "vines"


def test_the_command_that_renews_results_writes_them_where_they_are(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = experiment(tmp_path / "week" / "my vines")
    monkeypatch.chdir(tmp_path)
    given = folder.relative_to(tmp_path)
    for base, command in (
        (None, "vinetrack run 'week/my vines'"),
        (Path("out"), "vinetrack run 'week/my vines' --results out"),
    ):
        results = run_paths(given, base).results
        assert command_for_results(given, results) == command
        assert command_for_results(given, Path(os.path.relpath(results))) == command
    elsewhere = command_for_results(given, Path("results/other"))
    assert elsewhere == "snakemake --config 'experiment=week/my vines' results=results/other"


def test_the_folder_one_is_in_has_a_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = experiment(tmp_path / "vines")
    monkeypatch.chdir(folder)
    assert run_paths(Path(), None) == RunPaths(folder, folder / "results" / "vines")


def test_experiments_of_one_name_never_share_results(tmp_path: Path) -> None:
    first, second = (experiment(tmp_path / week / "vines") for week in ("monday", "friday"))
    claim_results(tmp_path / "out" / "vines", first)
    with pytest.raises(ExperimentError) as refused:
        run_paths(second, tmp_path / "out")
    assert str(first) in str(refused.value)
    assert str(second) in str(refused.value)
    with pytest.raises(ExperimentError, match="holds the results of"):
        make_plan({"experiment": str(second), "results": str(tmp_path / "out" / "vines")}, tmp_path)
    assert run_paths(first, tmp_path / "out").experiment == first


def test_an_experiment_that_has_moved_keeps_its_results(tmp_path: Path) -> None:
    first = experiment(tmp_path / "vines")
    claim_results(tmp_path / "out" / "vines", first)
    moved = first.rename(tmp_path / "else")
    moved = moved.rename(tmp_path / "new") / "."
    assert make_plan({"experiment": str(moved), "results": str(tmp_path / "out" / "vines")}, tmp_path).trials == ("a",)


def test_a_sheet_of_errors_alone_stops_before_any_work(tmp_path: Path) -> None:
    with pytest.raises(ExperimentError, match="pressure_kPa"):
        check_before_run(experiment(tmp_path / "v", "a,a.csv,12,100,300,9999,3,0\n"), print)


def test_a_single_faulty_trial_is_said_and_the_rest_go_on(tmp_path: Path) -> None:
    lines: list[str] = []
    rows = "a,a.csv,12,100,300,20,3,0\nb,a.csv,12,100,300,9999,3,0\n"
    check_before_run(experiment(tmp_path / "v", rows), lines.append)
    assert any("trial b" in line and line.startswith("error") for line in lines)


def test_progress_is_a_line_a_step_and_a_failure_names_stage_and_reason() -> None:
    printed = [
        "Building DAG of jobs...", "job   count", "[Sat Nov 21 00:48:40 2026]", "Finished jobid: 3 (Rule: recording)",
        "1 of 9 steps (11%) done", "Finished jobid: 4 (Rule: recording)", "2 of 9 steps (22%) done",
        "tracks: the disk is full", "Error in rule model:", "    log: /out/logs/model.log (check log file(s))",
    ]  # fmt: skip
    said: list[str] = []
    failed, words = run_stage._follow(iter(printed), said.append)
    assert said == ["step 1 of 9 done: recordings tracked", "step 2 of 9 done: 2 recordings tracked"]
    assert failed == {"model": "/out/logs/model.log"}
    assert words == ["tracks: the disk is full"]


def test_a_stage_shared_out_over_jobs_says_which_part_is_done() -> None:
    printed = [
        "Finished jobid: 3 (Rule: tracks_2)", "1 of 9 steps (11%) done",
        "Finished jobid: 4 (Rule: trial_figures_10)", "2 of 9 steps (22%) done",
    ]  # fmt: skip
    said: list[str] = []
    run_stage._follow(iter(printed), said.append)
    assert said == [
        "step 1 of 9 done: tracks analysed, part 2",
        "step 2 of 9 done: figures of the trials drawn, part 10",
    ]


def test_a_run_that_fails_says_why_whatever_its_folder_is_called(tmp_path: Path) -> None:
    experiment(tmp_path / "vines: ü & 'q'")
    folder = experiment(tmp_path / "vines: ü & 'q' #2 $(x);")
    paths = RunPaths(folder, tmp_path / "out" / folder.name)
    (folder / "trials.csv").write_text("nothing\n")
    with pytest.raises(RunError, match="trial is missing"):
        run_chain(paths, 1, print)
    assert (paths.results / "logs" / "run.log").is_file()


def write_campaign(folder: Path) -> None:
    """Three pressures of a horizontal vine of 12 mm as scipy grows it, seen to 0.1 mm."""
    folder.mkdir()
    rows, draw = [], np.random.default_rng(5)
    for kPa in (20, 30, 40):
        trial = vine_trial("", kPa, 12.0, length_m=0.3, growth_angle_rad=np.pi / 2)
        time = np.arange(0, 0.2, 0.001)
        position = grown_position(trial, time - 0.02, 1.83, 0.37)
        time, position = time[np.isfinite(position)], position[np.isfinite(position)]
        position = position + draw.normal(0, 1e-4, len(time))
        lines = [f"{t:.4f},{y:.6f}" for t, y in zip(time, position, strict=True)]
        (folder / f"p{kPa}.csv").write_text("\n".join(["time_s,position_m", *lines, ""]))
        rows.append(f"p{kPa},p{kPa}.csv,12,100,300,{kPa},3,90\n")
    (folder / "trials.csv").write_text(SHEET + "".join(rows))
    (folder / "experiment.yaml").write_text("candidates: [tail_friction]\n")


@pytest.mark.slow
@pytest.mark.pipeline
def test_the_whole_chain_runs_from_anywhere_and_ends_with_the_verdict(tmp_path: Path) -> None:
    write_campaign(tmp_path / "my vines")
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    code = "from vinetrack.cli.main import main; main()"
    done = subprocess.run(
        [sys.executable, "-c", code, "run", str(tmp_path / "my vines"), "--cores", "2", "--results", "out"],
        cwd=elsewhere, env={**os.environ, "PATH": os.defpath}, capture_output=True, text=True, check=False, timeout=300,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    results = elsewhere / "out" / "my vines"
    lines = done.stdout.strip().splitlines()
    verdict = json.loads((results / "diagnosis.json").read_text())["verdict"]
    assert lines[-1].startswith(f"{verdict}: ")
    assert f"Report: {results / 'report.html'}" in lines
    assert any(line.endswith("model fitted") for line in lines)
    assert run_lines(results)[-1] == lines[-1]
    assert sorted(path.name for path in elsewhere.iterdir()) == ["out"]
