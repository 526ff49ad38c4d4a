"""What the Snakefile is told before anything runs."""

from __future__ import annotations

import os
import shlex
from pathlib import Path

import pytest

from vinetrack.core.problems import ExperimentError
from vinetrack.pipeline import workflow
from vinetrack.pipeline.workflow import find_experiment, make_plan, shell_prefix

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


def test_results_go_where_the_command_line_says(tmp_path: Path) -> None:
    plan = make_plan({"experiment": str(experiment(tmp_path / "v")), "results": "else/where"}, tmp_path)
    assert plan.results == Path("else/where")


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


def test_another_experiment_is_none_of_the_laboratory(tmp_path: Path) -> None:
    experiment(tmp_path / "data" / "demo")
    assert make_plan({"experiment": str(experiment(tmp_path / "v"))}, tmp_path).ground_truth is None


def test_every_shipped_experiment_has_its_own_ground_truth(tmp_path: Path) -> None:
    for name in ("demo", "paper"):
        plan = make_plan({"experiment": f"data/{name}", "results": str(tmp_path)}, ROOT)
        assert plan.ground_truth == ROOT / "vinetrack" / "laboratory" / f"{name}.yaml"
        assert plan.published is (name == "paper")
        assert all(Path(path).parent.name in ("videos", "calibration", "tracks") for path in plan.measurements)


def test_a_missing_folder_names_the_one_that_was_probably_meant(tmp_path: Path) -> None:
    (tmp_path / "spring_campaign").mkdir()
    with pytest.raises(ExperimentError, match=r"did you mean .*spring_campaign\?"):
        find_experiment(tmp_path / "sprin_campaign")


def test_a_missing_folder_without_a_likeness_names_the_experiments_there_are(tmp_path: Path) -> None:
    experiment(tmp_path / "vines")
    with pytest.raises(ExperimentError, match=r"existing experiments are .*vines"):
        find_experiment(tmp_path / "zzz" / "deep")


def test_an_unknown_setting_is_refused_with_the_nearest(tmp_path: Path) -> None:
    with pytest.raises(ExperimentError, match=r"dampng is not a setting.*damping"):
        make_plan({"experiment": str(experiment(tmp_path / "v")), "dampng": {}}, tmp_path)


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


def test_a_folder_that_snakemake_would_take_for_a_wildcard_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ExperimentError, match=r"has braces .* in its path.*rename the folder"):
        make_plan({"experiment": str(experiment(tmp_path / "v{1}"))}, tmp_path)


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


def test_the_last_line_is_silent_about_a_report_older_than_its_sheet(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = experiment(tmp_path / "v")
    plan = make_plan({"experiment": str(folder), "results": str(tmp_path / "r")}, tmp_path)
    plan.results.mkdir()
    report = plan.results / "report.html"
    report.write_text("")
    workflow._print_report_path(plan)
    assert capsys.readouterr().out == f"Report: {report}\n"
    os.utime(folder / "trials.csv", (report.stat().st_mtime + 5,) * 2)
    workflow._print_report_path(plan)
    assert capsys.readouterr().out == ""


def test_a_slash_at_the_end_of_the_path_changes_no_stage(tmp_path: Path) -> None:
    folder = str(experiment(tmp_path / "v"))
    with_slash, without = (make_plan({"experiment": path}, tmp_path) for path in (folder + "/", folder))
    assert with_slash.stage_settings() == without.stage_settings()
    assert (with_slash.experiment, with_slash.results) == (without.experiment, without.results)


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


def test_a_users_own_effect_is_an_input_of_the_run(tmp_path: Path) -> None:
    folder = experiment(tmp_path / "v")
    (folder / "experiment.yaml").write_text("effects: [brush.py]\n")
    (folder / "brush.py").write_text("")
    assert make_plan({"experiment": str(folder)}, tmp_path).own_effects == [(folder / "brush.py").as_posix()]


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
