"""The command line: exit codes, sentences, no tracebacks."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from click.testing import Result
from typer.testing import CliRunner

import vinetrack
from vinetrack.cli.main import app

SHEET = "trial,track,diameter_mm,thickness_um,length_mm,pressure_kPa,yield_pressure_kPa\n"
TRACK = "time_s,position_m\n" + "".join(f"{i / 1000},{i / 1e4}\n" for i in range(20))


def run(*arguments: object) -> Result:
    return CliRunner().invoke(app, [str(argument) for argument in arguments], catch_exceptions=False)


def experiment(folder: Path, rows: str = "a,a.csv,12,100,300,20,3\n") -> Path:
    folder.mkdir()
    (folder / "trials.csv").write_text(SHEET + rows)
    (folder / "a.csv").write_text(TRACK)
    return folder


def test_version_is_that_of_the_package() -> None:
    assert run("--version").output == f"vinetrack {vinetrack.__version__}\n"


def test_a_page_ends_without_waiting_for_its_thread() -> None:
    program = (
        "import atexit, sys, threading, time; atexit.register(print, 'waited')\n"
        "threading.Thread(target=time.sleep, args=(60,), daemon=True, name='vinetrack-fit').start()\n"
        "from vinetrack.cli.main import main; sys.argv = ['vinetrack', '--version']; main()"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60, check=False)
    assert (done.returncode, done.stdout) == (0, f"vinetrack {vinetrack.__version__}\n")


def test_check_of_a_sound_experiment_exits_with_0(tmp_path: Path) -> None:
    done = run("check", experiment(tmp_path / "v"))
    assert done.exit_code == 0
    assert "no problems found" in done.output


def test_check_of_a_warning_alone_exits_with_0(tmp_path: Path) -> None:
    folder = experiment(tmp_path / "v")
    (folder / "trials.csv").write_text(SHEET.replace("trial,", "trial,colour,") + "a,red,a.csv,12,100,300,20,3\n")
    done = run("check", folder)
    assert done.exit_code == 0
    assert "colour" in done.output


def test_check_of_any_error_exits_with_1_and_names_file_trial_and_column(tmp_path: Path) -> None:
    done = run("check", experiment(tmp_path / "v", "a,a.csv,12,100,300,9999,3\n"))
    assert done.exit_code == 1
    assert all(word in done.output for word in ("trials.csv", "trial a", "pressure_kPa", "9999"))


def test_check_says_two_hundred_problems_in_twenty_lines(tmp_path: Path) -> None:
    rows = "".join(f"t{i},a.csv,12,100,300,{9000 + i},3\n" for i in range(200))
    done = run("check", experiment(tmp_path / "v", rows))
    assert done.exit_code == 1
    assert len(done.output.splitlines()) <= 20


def test_check_says_a_problem_that_two_hundred_trials_share_once(tmp_path: Path) -> None:
    rows = "".join(f"t{i},a.csv,12,100,300,9999,3\n" for i in range(200))
    done = run("check", experiment(tmp_path / "v", rows))
    assert done.exit_code == 1
    assert "t0 and 199 more" in done.output
    assert len(done.output.splitlines()) == 2


def test_check_of_a_missing_folder_suggests_one(tmp_path: Path) -> None:
    experiment(tmp_path / "vines")
    done = run("check", tmp_path / "vinse")
    assert done.exit_code == 1
    assert "did you mean" in done.output


def test_effects_lists_every_effect_with_its_formula_and_units() -> None:
    from vinetrack.effects import catalogue

    output = run("effects").output
    for effect in catalogue().values():
        assert effect.name in output
        assert effect.formula in output
    assert "N·(s/m)ⁿ" in output


def test_a_stage_without_its_input_says_what_to_run(tmp_path: Path) -> None:
    done = run("damping", tmp_path)
    assert done.exit_code == 1
    assert "damping_points.csv does not exist: run the stage that writes it" in done.output


def test_settings_that_are_no_json_are_refused(tmp_path: Path) -> None:
    done = run("damping", tmp_path, "--settings", "seed=3")
    assert done.exit_code == 2
    assert "is not JSON" in done.output


def test_a_setting_out_of_bounds_is_one_line(tmp_path: Path) -> None:
    done = run("damping", tmp_path, "--settings", '{"damping": {"resamples": 3}}')
    assert done.exit_code == 1
    assert "damping.resamples" in done.output
    assert len(done.output.strip().splitlines()) == 1


def test_a_fault_of_the_program_is_one_sentence_and_its_traceback_is_in_the_log(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def break_down(*_: object) -> None:
        raise RuntimeError("the bottom fell out")

    monkeypatch.setattr("vinetrack.pipeline.tracks_stage.fit_law", break_down)
    done = run("damping", tmp_path, "--log", tmp_path / "logs" / "d.log")
    assert done.exit_code == 1
    assert "Traceback" not in done.output
    assert f"the traceback is in {tmp_path / 'logs' / 'd.log'}" in done.output
    assert "RuntimeError: the bottom fell out" in (tmp_path / "logs" / "d.log").read_text()


def test_one_unforeseen_fault_fails_its_trial_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def break_down(*_: object) -> None:
        raise ZeroDivisionError("unforeseen")

    monkeypatch.setattr("vinetrack.kinematics.summary.summarise_trial", break_down)
    folder = experiment(tmp_path / "v")
    done = run("tracks", folder, tmp_path / "r", "--log", tmp_path / "t.log")
    assert done.exit_code == 0
    assert "a: could not be analysed" in done.output
    assert "1 trials, 1 failed" in run("gather", folder, tmp_path / "r").output
    assert "ZeroDivisionError: unforeseen" in (tmp_path / "t.log").read_text()
    assert "an internal error of the program" in (tmp_path / "r" / "trials.csv").read_text()
