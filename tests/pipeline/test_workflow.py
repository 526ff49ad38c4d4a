"""What the Snakefile is told, `vinetrack run`, whose lock is whose, and workers that end with their parent."""

from __future__ import annotations

import json
import os
import shlex
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from lsoda_vine import grown_position, vine_trial

from vinetrack.core.problems import ExperimentError
from vinetrack.pipeline import workflow
from vinetrack.pipeline.run_stage import RunError, RunPaths, check_before_run, run_chain, run_lines, run_paths
from vinetrack.pipeline.tracks_stage import map_trials, map_unordered
from vinetrack.pipeline.workflow import (
    begin_run,
    claim_results,
    command_for_results,
    executes_nothing,
    make_plan,
    shell_prefix,
)

# What the Snakefile is told before anything runs.


ROOT = Path(__file__).parents[2]
SHEET = "trial,track,diameter_mm,thickness_um,length_mm,pressure_kPa,yield_pressure_kPa,use\n"


def experiment(folder: Path, rows: str = "a,a.csv,12,100,300,20,3,\nb,a.csv,12,100,300,20,3,no\n") -> Path:
    folder.mkdir(parents=True)
    (folder / "trials.csv").write_text(SHEET + rows)
    (folder / "a.csv").write_text("time_s,position_m\n" + "".join(f"{i / 1000},{i / 1e4}\n" for i in range(20)))
    return folder


@pytest.mark.parametrize("shown", ["{}", "{}/", "{}/."])
def test_results_are_named_after_the_last_part_of_the_path(tmp_path: Path, shown: str) -> None:
    folder = experiment(tmp_path / "week 3" / "vines")
    plan = make_plan({"experiment": shown.format(folder)}, tmp_path)
    assert plan.results == Path("results/vines")


def test_a_folder_whose_name_is_a_number_is_a_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    experiment(tmp_path / "2024")
    monkeypatch.chdir(tmp_path)
    assert make_plan({"experiment": 2024}, tmp_path).results == Path("results/2024")


def test_trials_left_out_get_no_files_and_failed_ones_do(tmp_path: Path) -> None:
    rows = "a,a.csv,12,100,300,20,3,\nb,a.csv,12,100,300,20,3,no\nc,a.csv,12,100,300,9999,3,\n"
    plan = make_plan({"experiment": str(experiment(tmp_path / "v", rows))}, tmp_path)
    assert plan.trials == ("a", "c")


def test_inputs_are_the_sheet_and_every_track_there_is(tmp_path: Path) -> None:
    rows = "a,a.csv,12,100,300,20,3,\nb,gone.csv,12,100,300,20,3,\n"
    folder = experiment(tmp_path / "v", rows)
    assert make_plan({"experiment": str(folder)}, tmp_path).inputs == (folder / "trials.csv", folder / "a.csv")


def test_the_shipped_demonstration_is_found_wherever_snakemake_is_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    experiment(tmp_path / "house" / "data" / "demo")
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    plan = make_plan({"experiment": "data/demo"}, tmp_path / "house")
    assert plan.ground_truth
    assert plan.ground_truth.name == "demo.yaml"
    assert plan.results == Path("results/demo")
    assert plan.measurements == [str(tmp_path / "house" / "data" / "demo" / "a.csv")]


def test_every_shipped_experiment_has_its_own_ground_truth(tmp_path: Path) -> None:
    for name in ("demo", "paper"):
        plan = make_plan({"experiment": f"data/{name}", "results": str(tmp_path)}, ROOT)
        assert plan.ground_truth == ROOT / "vinetrack" / "laboratory" / f"{name}.yaml"
        assert plan.published is (name == "paper")
        assert all(Path(path).parent.name in ("videos", "calibration", "tracks") for path in plan.measurements)


def test_what_is_wrong_is_printed_and_the_process_ends(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stopped:
        workflow.make_plan_or_exit({"experiment": str(tmp_path / "gone")}, tmp_path)
    assert stopped.value.code == 1
    assert "gone: does not exist" in capsys.readouterr().err


def test_a_stage_depends_on_its_own_settings_alone(tmp_path: Path) -> None:
    folder = str(experiment(tmp_path / "v"))
    before = make_plan({"experiment": folder}, tmp_path)
    after = make_plan({"experiment": folder, "damping": {"seed": 99}}, tmp_path)
    assert before.stage_settings("steady") == after.stage_settings("steady")
    assert before.stage_settings("damping") != after.stage_settings("damping")


def test_clips_are_made_of_recordings_alone_and_only_where_they_are_wanted(tmp_path: Path) -> None:
    folder = experiment(tmp_path / "v")
    assert make_plan({"experiment": str(folder)}, tmp_path).clips == []
    (folder / "a.mp4").write_bytes(b"film")
    (folder / "trials.csv").write_text(SHEET.replace("track", "video,capture_fps") + "a,a.mp4,1000,12,100,300,20,3,\n")
    assert make_plan({"experiment": str(folder)}, tmp_path).clips == ["results/v/overlays"]
    assert make_plan({"experiment": str(folder), "overlays": {"of": "none"}}, tmp_path).clips == []


def test_a_track_with_a_brace_in_its_name_is_analysed_and_watched_by_its_time(tmp_path: Path) -> None:
    folder = experiment(tmp_path / "v", "a,a{1}.csv,12,100,300,20,3,\n")
    (folder / "a.csv").rename(folder / "a{1}.csv")
    before = make_plan({"experiment": str(folder)}, tmp_path)
    assert before.trials == ("a",)
    assert before.inputs == (folder / "trials.csv",)
    os.utime(folder / "a{1}.csv", (1, 1))
    assert make_plan({"experiment": str(folder)}, tmp_path).unwatched != before.unwatched


def test_programs_of_this_python_come_first_without_an_environment_activated() -> None:
    import sys

    path = shell_prefix().split("PATH=", 1)[1].split(":", 1)[0]
    assert shlex.split(path) == [str(Path(sys.executable).parent)]


def test_a_recording_depends_on_its_own_file_the_sheets_and_the_target(tmp_path: Path) -> None:
    folder = tmp_path / "v"
    folder.mkdir()
    (folder / "trials.csv").write_text(
        "trial,video,diameter_mm,thickness_um,length_mm,pressure_kPa,yield_pressure_kPa\n"
        "a,a.mp4,12,100,300,20,3\nb,b.mp4,12,100,300,20,3\n"
    )
    (folder / "experiment.yaml").write_text(
        "capture_fps: 1000\ncalibration: {kind: checkerboard, image: c.png, squares: [5, 5], square_mm: 5}\n"
    )
    for name in ("a.mp4", "c.png"):
        (folder / name).write_bytes(b"x")
    plan = make_plan({"experiment": str(folder)}, tmp_path)
    shared = tuple(str(folder / name) for name in ("trials.csv", "experiment.yaml", "c.png"))
    assert plan.filmed == {"a": (*shared, str(folder / "a.mp4")), "b": shared}
    assert plan.tracked == ()
    assert plan.track_files(plan.trials) == []


@pytest.mark.parametrize("name", ["a{b}", "<b>x"])
def test_a_folder_that_snakemake_cannot_name_is_refused_by_check_at_once(tmp_path: Path, name: str) -> None:
    from vinetrack.pipeline.run_stage import check_folder

    (tmp_path / name).mkdir()
    (tmp_path / name / "trials.csv").write_text("trial\n")
    reasons = [problem.message for problem in check_folder(tmp_path / name).problems]
    assert reasons[0] == "has braces or a word in < > in its path, which Snakemake cannot handle"


def test_a_folder_with_marks_blanks_and_quotes_is_no_pattern(tmp_path: Path) -> None:
    from vinetrack.pipeline.workflow import path_problems

    assert path_problems(tmp_path / "b>x&amp; 'q\" ü $(x)") == []


def test_many_trials_are_shared_out_over_jobs_and_a_few_are_one(tmp_path: Path) -> None:
    names = [f"t{i}" for i in range(2 * workflow.TRIALS_PER_JOB + 1)]
    rows = "".join(f"{name},{name}.csv,12,100,300,20,3,\n" for name in names)
    folder = experiment(tmp_path / "v", rows)
    (folder / "t1.csv").write_bytes((folder / "a.csv").read_bytes())
    plan = make_plan({"experiment": str(folder)}, tmp_path)
    parts = plan.parts("tracks", plan.tracked)
    assert list(parts) == ["tracks_1", "tracks_2", "tracks_3"]
    assert [name for part in parts.values() for name in part] == names
    assert plan.track_files(parts["tracks_1"]) == [(folder / "t1.csv").as_posix()]
    assert plan.track_files(parts["tracks_2"]) == []
    assert plan.parts("tracks", names[:3]) == {"tracks": names[:3]}
    assert plan.parts("tracks", []) == {}


def test_a_module_that_an_own_effect_may_import_is_an_input_too(tmp_path: Path) -> None:
    folder = experiment(tmp_path / "v")
    (folder / "experiment.yaml").write_text("effects: [brush.py]\n")
    for name in ("brush.py", "beside.py"):
        (folder / name).write_text("")
    effects = make_plan({"experiment": str(folder)}, tmp_path).own_effects
    assert effects == [(folder / name).as_posix() for name in ("brush.py", "beside.py")]


def test_the_report_always_has_the_figures_that_it_holds(tmp_path: Path) -> None:
    folder = str(experiment(tmp_path / "v"))
    formats = make_plan({"experiment": folder, "figures": {"formats": ["png"]}}, tmp_path).settings.figures.formats
    assert formats == ("png", "svg")


# `vinetrack run`: the chain from anywhere, its progress, its last lines, and whose results a folder holds.


SHEET_STAGE = "trial,track,diameter_mm,thickness_um,length_mm,pressure_kPa,yield_pressure_kPa,growth_angle_deg\n"


def experiment_stage(folder: Path, rows: str = "a,a.csv,12,100,300,20,3,0\n") -> Path:
    folder.mkdir(parents=True)
    (folder / "trials.csv").write_text(SHEET_STAGE + rows)
    (folder / "a.csv").write_text("time_s,position_m\n" + "".join(f"{i / 1000},{i / 1e4}\n" for i in range(20)))
    return folder


def test_results_lie_where_snakemake_puts_them_or_under_the_folder_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = experiment_stage(tmp_path / "week" / "vines")
    monkeypatch.chdir(tmp_path)
    assert run_paths(folder, None) == RunPaths(folder, tmp_path / make_plan({"experiment": folder}, tmp_path).results)
    assert run_paths(folder, tmp_path / "out").results == tmp_path / "out" / "vines"


def test_the_command_that_renews_results_writes_them_where_they_are(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = experiment_stage(tmp_path / "week" / "my vines")
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


def test_experiments_of_one_name_never_share_results(tmp_path: Path) -> None:
    first, second = (experiment_stage(tmp_path / week / "vines") for week in ("monday", "friday"))
    claim_results(tmp_path / "out" / "vines", first)
    with pytest.raises(ExperimentError) as refused:
        run_paths(second, tmp_path / "out")
    assert str(first) in str(refused.value)
    assert str(second) in str(refused.value)
    with pytest.raises(ExperimentError):
        make_plan({"experiment": str(second), "results": str(tmp_path / "out" / "vines")}, tmp_path)
    assert run_paths(first, tmp_path / "out").experiment == first


def test_an_experiment_that_has_moved_keeps_its_results(tmp_path: Path) -> None:
    first = experiment_stage(tmp_path / "vines")
    claim_results(tmp_path / "out" / "vines", first)
    moved = first.rename(tmp_path / "else")
    moved = moved.rename(tmp_path / "new") / "."
    assert make_plan({"experiment": str(moved), "results": str(tmp_path / "out" / "vines")}, tmp_path).trials == ("a",)


def test_a_sheet_of_errors_alone_stops_before_any_work(tmp_path: Path) -> None:
    with pytest.raises(ExperimentError, match="pressure_kPa"):
        check_before_run(experiment_stage(tmp_path / "v", "a,a.csv,12,100,300,9999,3,0\n"), print)


def test_a_run_that_fails_says_why_whatever_its_folder_is_called(tmp_path: Path) -> None:
    experiment_stage(tmp_path / "vines: ü & 'q'")
    folder = experiment_stage(tmp_path / "vines: ü & 'q' #2 $(x);")
    paths = RunPaths(folder, tmp_path / "out" / folder.name)
    (folder / "trials.csv").write_text("nothing\n")
    with pytest.raises(RunError, match="trial"):
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
    (folder / "trials.csv").write_text(SHEET_STAGE + "".join(rows))
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


# Runs that were killed, and runs that live: whose lock is taken away, and what is left behind.


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


# Workers of a pool: they answer in order, and end with the process that started them, however it ends.


PARENT = """
import os, sys, time
from vinetrack.pipeline.tracks_stage import map_unordered, map_trials

def task(number):
    os.write(1, b"%d\\n" % os.getpid())  # at once: two that print mix their lines
    time.sleep(0.02 if number < 4 else 600)

for _ in {share}(task, range(8), 2{label}):
    pass
"""


def square(number: int) -> int:
    return number**2


def test_answers_come_in_the_order_of_their_arguments() -> None:
    assert list(map_trials(square, range(20), 2, "squares")) == [k**2 for k in range(20)]
    assert sorted(map_unordered(square, range(20), 2)) == [k**2 for k in range(20)]


@pytest.mark.skipif(not Path("/proc").exists(), reason="which processes are there is read from /proc")
@pytest.mark.parametrize(("share", "label"), [("map_trials", ", 'tasks'"), ("map_unordered", "")])
def test_workers_of_a_killed_run_end_too(share: str, label: str, tmp_path: Path) -> None:
    script = tmp_path / "parent.py"
    script.write_text(PARENT.format(share=share, label=label))
    workers: set[int] = set()
    with subprocess.Popen([sys.executable, str(script)], stdout=subprocess.PIPE, text=True) as parent:
        assert parent.stdout is not None
        while len(workers) < 2:
            workers.add(int(parent.stdout.readline()))
        parent.send_signal(signal.SIGKILL)
    ends = time.monotonic() + 60
    while any(map(_is_alive, workers)) and time.monotonic() < ends:
        time.sleep(0.05)
    assert not any(map(_is_alive, workers))


def _is_alive(process: int) -> bool:
    """Whether a process is there, and not only waiting to be counted."""
    try:
        os.kill(process, 0)
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except (ProcessLookupError, FileNotFoundError):
        return False
