"""What the Snakefile is told, `vinetrack run`, and whose lock is whose."""

import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from hand_sheet import one_vine
from test_pipeline import write_campaign

import vinetrack.results as origin
from vinetrack.cli import main as commands
from vinetrack.core.problems import ExperimentError, UserError
from vinetrack.core.tables import write_csv, write_json
from vinetrack.diagnosis.result import Diagnosis
from vinetrack.inference.fit_data import pairs_of
from vinetrack.pipeline import workflow
from vinetrack.pipeline.workflow import STAGES
from vinetrack.results import TRIALS_COLUMNS, Results, table_of
from vinetrack.tracks.frame_timing import ends_short, longer_than_stated

ROOT = Path(__file__).parents[2]
SHEET = "trial,track,diameter_mm,thickness_um,length_mm,pressure_kPa,yield_pressure_kPa,use\n"


def experiment(folder: Path, rows: str = "a,a.csv,12,100,300,20,3,\nb,a.csv,12,100,300,20,3,no\n") -> Path:
    return one_vine(folder, rows, ",use")


def planned(folder: Path, **config: object) -> workflow.WorkflowPlan:
    return workflow.make_plan({"experiment": str(folder), **config}, folder.parent)


def test_trials_left_out_get_no_files_and_failed_ones_do_and_every_input_counts(tmp_path):
    rows = "a,a.csv,12,100,300,20,3,\nb,a.csv,12,100,300,20,3,no\nc,gone.csv,12,100,300,9999,3,\n"
    folder = experiment(tmp_path / "v", rows)
    assert planned(folder).trials == ("a", "c")
    states = [planned(folder).state, planned(folder).state]
    # A module that an own effect may import is an input too, and so is a name that Snakemake would take for a pattern.
    (folder / "experiment.yaml").write_text("effects: [brush.py]\n")
    for name in ("brush.py", "beside.py"):
        (folder / name).write_text("")
        states.append(planned(folder).state)
    (folder / "a.csv").rename(folder / "a{1}.csv")
    (folder / "trials.csv").write_text(SHEET + rows.replace("a.csv", "a{1}.csv"))
    states.append(planned(folder).state)
    assert planned(folder).trials == ("a", "c")
    os.utime(folder / "a{1}.csv", (1, 1))
    states.append(planned(folder).state)
    os.utime(folder / "trials.csv", (1, 1))
    states.append(planned(folder).state)
    assert [states.index(state) for state in states] == [0, 0, 2, 3, 4, 5, 6]


def test_shipped_experiments_are_found_from_anywhere(tmp_path, monkeypatch):
    experiment(tmp_path / "house" / "data" / "demo")
    monkeypatch.chdir(tmp_path)
    plan = workflow.make_plan({"experiment": "data/demo"}, tmp_path / "house")
    assert plan.ground_truth
    assert (plan.ground_truth.name, plan.results) == ("demo.yaml", Path("results/demo"))
    assert plan.files("<measurements>") == [str(tmp_path / "house" / "data" / "demo" / "a.csv")]
    for name in ("demo", "paper"):
        plan = workflow.make_plan({"experiment": f"data/{name}", "results": str(tmp_path)}, ROOT)
        assert plan.ground_truth == ROOT / "vinetrack" / "laboratory" / f"{name}.yaml"
        folders = {Path(path).parent.name for path in plan.files("<measurements>")}
        assert folders <= {"videos", "calibration", "tracks"}


def test_a_stage_depends_on_its_own_settings_alone(tmp_path):
    folder = experiment(tmp_path / "v")
    before, after = planned(folder), planned(folder, damping={"seed": 99})
    changed = {name for name, stage in STAGES.items() if before.settings_of(stage) != after.settings_of(stage)}
    assert changed == {"model", "report"}


def test_a_folder_that_snakemake_cannot_name_is_refused_by_check_at_once(tmp_path):
    for name in ("a{b}", "<b>x"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "trials.csv").write_text("trial\n")
        assert "Snakemake cannot handle" in workflow.check_folder(tmp_path / name).problems[0].message
    assert workflow.path_problems(tmp_path / "b>x&amp; 'q\" ü $(x)") == []


def test_check_names_a_copied_track_and_one_that_is_longer_than_its_vine(tmp_path):
    """Tracks of 300 mm of vines of 400 mm; the last vine is 250 mm long."""
    time_s = np.arange(200) / 1000
    for name, seed in (("a", 1), ("b", 2), ("c", 1), ("d", 3)):
        noise_m = 1e-4 * np.random.default_rng(seed).standard_normal(200)
        position_m = np.maximum(time_s - 0.05, 0) * 2 + noise_m
        pd.DataFrame({"time_s": time_s, "position_m": position_m}).to_csv(tmp_path / f"{name}.csv", index=False)
    rows = [f"{name},{name}.csv,24,200,{250 if name == 'd' else 400},20,3,50:90\n" for name in "abcd"]
    header = "trial,track,diameter_mm,thickness_um,length_mm,pressure_kPa,yield_pressure_kPa,steady\n"
    (tmp_path / "trials.csv").write_text(header + "".join(rows), encoding="utf-8")
    problems = workflow.check_folder(tmp_path).problems
    assert [(one.trial, one.severity) for one in problems if one.code == "not_measured"] == [("c", "warning")]
    assert [one.trial for one in problems if one.code == "window"] == [*"abcd"]  # typed in milliseconds
    assert [one.column for one in problems if one.code == "longer_than_stated"] == ["length_mm"]
    facts = longer_than_stated(pairs_of(tmp_path)[0]).facts
    assert (facts["count"], facts["name"], facts["length_m"]) == (1, "d", 0.25)
    assert facts["travel_m"] == pytest.approx(0.295, abs=0.005)
    ended = [(trial, track.flagged(np.arange(150, 200), "after_end")) for trial, track in pairs_of(tmp_path)[0]]
    assert ends_short(ended).facts["travel_m"] == pytest.approx(0.245, abs=0.01)
    assert not ends_short(ended[:2] + ended[3:])  # two of a vine of 400 mm, one that is as long as it is
    assert not ends_short((replace(trial, frames_used=(0, 150)), track) for trial, track in ended)  # not at rest there


def test_a_check_of_the_same_files_is_made_once_and_one_that_finds_an_error_each_time(tmp_path, monkeypatch):
    made: list[Path] = []
    check = workflow.check_folder
    monkeypatch.setattr(workflow, "check_folder", lambda folder, keep: made.append(folder) or check(folder, keep))
    sound = experiment(tmp_path / "sound", "a,a.csv,12,100,300,20,3,\n")
    faulty = experiment(tmp_path / "faulty", "a,a.csv,12,100,300,20,3,\nb,gone.csv,12,100,300,20,3,\n")
    said: list[list[str]] = []
    for folder in (sound, sound, faulty, faulty):
        workflow.check_before_run(folder, tmp_path / "results" / folder.name, (lines := list[str]()).append)
        said.append(lines)
    assert made == [sound, faulty, faulty]
    assert said[0] == said[1]
    os.utime(sound / "a.csv", (1, 1))
    workflow.check_before_run(sound, tmp_path / "results" / "sound", print)
    assert made[-1] == sound


def test_many_trials_are_shared_out_over_jobs_and_a_few_are_one(tmp_path):
    names = [f"t{i}" for i in range(2 * workflow.TRIALS_PER_JOB + 1)]
    plan = planned(experiment(tmp_path / "v", "".join(f"{name},{name}.csv,12,100,300,20,3,\n" for name in names)))
    assert [name for name in plan.jobs if name.startswith("trials")] == ["trials_1", "trials_2", "trials_3"]
    parts = [part for stage, _, part in plan.jobs.values() if stage == "trials"]
    assert [name for part in parts for name in part] == names
    assert [path for part in parts for path in plan.files("<trials>", part)] == plan.files("<trials>")
    assert [*planned(experiment(tmp_path / "w")).jobs] == ["trials", "model", "report"]


# `vinetrack run`: the chain from anywhere, its progress, its last lines, and whose results a folder holds.
def test_results_lie_where_snakemake_puts_them_or_as_told(tmp_path, monkeypatch):
    folder = experiment(tmp_path / "week" / "my vines")
    monkeypatch.chdir(tmp_path)
    results = tmp_path / workflow.make_plan({"experiment": folder}, tmp_path).results
    assert workflow.run_paths(folder, None) == (folder, results)
    assert workflow.run_paths(folder, tmp_path / "out")[1] == tmp_path / "out" / "my vines"
    given, command = folder.relative_to(tmp_path), "vinetrack run 'week/my vines'"
    for base, options in ((None, ""), (Path("out"), " --results out")):
        _, results = workflow.run_paths(given, base)
        for there in (results, Path(os.path.relpath(results))):
            assert workflow.command_for_results(given, there) == command + options
    elsewhere = workflow.command_for_results(given, Path("results/other"))
    assert elsewhere.endswith("/pipeline/Snakefile --cores 2 --config 'experiment=week/my vines' results=results/other")


def test_experiments_of_one_name_never_share_results_and_one_that_has_moved_keeps_its_own(tmp_path):
    first, second = (experiment(tmp_path / week / "vines") for week in ("monday", "friday"))
    origin.begin_run(tmp_path / "out" / "vines", first).release()
    with pytest.raises(ExperimentError) as refused:
        workflow.run_paths(second, tmp_path / "out")
    assert all(str(folder) in str(refused.value) for folder in (first, second))
    with pytest.raises(ExperimentError):
        planned(second, results=str(tmp_path / "out" / "vines"))
    assert workflow.run_paths(first, tmp_path / "out")[0] == first
    moved = first.rename(tmp_path / "else") / "."
    assert planned(moved, results=str(tmp_path / "out" / "vines")).trials == ("a",)


@pytest.mark.slow
def test_a_run_that_fails_says_why_whatever_its_folder_is_called(tmp_path):
    experiment(tmp_path / "vines: ü & 'q'")
    folder = experiment(tmp_path / "vines: ü & 'q' #2 $(x);")
    paths = folder, tmp_path / "out" / folder.name
    wrong = experiment(tmp_path / "v", "a,a.csv,12,100,300,9999,3,\n"), tmp_path
    with pytest.raises(ExperimentError, match="pressure_kPa"):
        workflow.check_before_run(*wrong, print)
    (folder / "trials.csv").write_text("nothing\n")
    with pytest.raises(UserError, match="trial"):
        workflow.run_chain(*paths, 1, print)
    assert (paths[1] / "logs" / "run.log").is_file()


@pytest.mark.parametrize(
    ("statuses", "failed"), [("ok failed ok left_out", False), ("failed ok failed left_out", True)]
)
def test_a_run_of_which_most_trials_failed_ends_with_the_reason_as_a_failure(tmp_path, statuses, failed):
    rows = [{"trial": f"t{k}", "status": status, "reason": "why"} for k, status in enumerate(statuses.split())]
    write_csv(Results(tmp_path).trials, table_of(TRIALS_COLUMNS, rows))
    lines, is_failure = commands._run_lines(tmp_path)
    assert is_failure == failed
    told = f"{statuses.count('failed')} of 3 trials failed, t{statuses.split().index('failed')}"
    assert lines[-failed].startswith(f"{'error: ' * failed}{told}")


def test_a_run_without_a_verdict_has_failed(tmp_path):
    write_csv(Results(tmp_path).trials, table_of(TRIALS_COLUMNS, [{"trial": "a", "status": "warning"}]))
    write_json(Results(tmp_path).diagnosis, Diagnosis(rounds=(), effects=(), explanation="why").to_json())
    lines, is_failure = commands._run_lines(tmp_path)
    assert is_failure
    assert lines[-1].startswith("error: why")


@pytest.mark.slow
@pytest.mark.pipeline
def test_the_whole_chain_runs_from_anywhere_and_ends_with_the_verdict(tmp_path):
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
    assert [line.partition(":")[0] for line in lines if line.partition(":")[0] in STAGES] == list(STAGES)
    assert commands._run_lines(results)[0][-1] == lines[-1]
    assert sorted(path.name for path in elsewhere.iterdir()) == ["out"]


# Runs that were killed, and runs that live: whose lock is taken, and what is left behind.
BEGIN = """
import time
from pathlib import Path
from vinetrack.results import begin_run
lock = begin_run(Path("results/vines"), Path("vines"))
print("begun", flush=True)
time.sleep(60)
"""


def test_a_run_that_lives_is_named_and_one_that_was_killed_is_not_in_the_way(tmp_path):
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-c", BEGIN]
    paths = tmp_path / "vines", tmp_path / "results" / "vines"
    with subprocess.Popen(command, cwd=tmp_path, env=environment, stdout=subprocess.PIPE, text=True) as other:
        assert other.stdout is not None
        assert other.stdout.readline() == "begun\n"
        with pytest.raises(ExperimentError, match=f"process {other.pid}"):
            origin.begin_run(paths[1], paths[0])
        with pytest.raises(ExperimentError, match=f"process {other.pid}"):
            workflow.check_before_run(*paths, print)
        other.kill()
    assert not (paths[1] / "logs").exists()
    origin.begin_run(paths[1], paths[0]).release()


def test_files_never_finished_are_cleared_but_not_those_that_may_be_written_now(tmp_path):
    folders = tmp_path / "results" / "vines" / "tracks", tmp_path / "vines"
    for folder in folders:
        folder.mkdir(parents=True)
        for name in (f".tmp-{'0f' * 16}.csv", f".tmp-{'2a' * 16}.mp4", ".tmp-mine", f".tmp-{'1e' * 16}.csv"):
            (folder / name).touch()
            if "1e" not in name:
                os.utime(folder / name, (1e9, 1e9))
    origin.begin_run(tmp_path / "results" / "vines", tmp_path / "vines").release()
    for folder in folders:
        assert sorted(path.name for path in folder.iterdir()) == [f".tmp-{'1e' * 16}.csv", ".tmp-mine"]
