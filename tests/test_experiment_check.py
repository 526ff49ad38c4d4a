"""`check_experiment`: tracks opened, videos handed on, and how problems are listed."""

from __future__ import annotations

from pathlib import Path

import pytest
from hand_sheet import GOOD, HEADER, TRACK, two_vines, write

from vinetrack.core.problems import Problem, format_problems
from vinetrack.core.records import Trial
from vinetrack.experiment.folder import Experiment, check_experiment, read_experiment


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return two_vines(tmp_path)


def test_check_reads_every_track(folder: Path) -> None:
    (folder / "b.csv").write_text("time_s,position_m\n0,0\n1,1\n")
    (problem,) = check_experiment(folder)
    assert (problem.trial, problem.line, problem.column, problem.value) == ("b", 3, "track", "b.csv")
    assert "has 2 points: at least 5 are needed" in str(problem)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (None, "does not exist"),
        ("time_s,position_m\n" + "1,1\n" * 6, "line 3, column time_s: time does not increase"),
        (TRACK.replace("0.0001", "oops"), "is not a number"),
        ("time_s,position_m,pressure_kPa\n" + "".join(f"{i},{i},28000\n" for i in range(6)), "looks like Pa"),
    ],
)
def test_check_names_what_is_wrong_with_a_track(folder: Path, content: str | None, words: str) -> None:
    (folder / "b.csv").unlink()
    if content is not None:
        (folder / "b.csv").write_text(content)
    (problem,) = check_experiment(folder)
    assert problem.severity == "error"
    assert words in str(problem)


def test_check_holds_the_spacing_against_the_rate_of_capture(folder: Path) -> None:
    sheet = f"{HEADER},capture_fps\na,a.csv,24,200,280,28,3,,1000\nb,b.csv,24,200,280,28,3,,240\n"
    (problem,) = check_experiment(write(folder, sheet))
    assert (problem.severity, problem.trial) == ("warning", "b")
    assert "0.24 frames" in problem.message


def test_check_suspects_millimetres_taken_for_metres(folder: Path) -> None:
    (folder / "a.csv").write_text("time_s,position_m\n" + "".join(f"{i / 1000},{10 * i}\n" for i in range(20)))
    (problem,) = check_experiment(folder)
    assert "are its positions in metres?" in problem.message


def test_check_suspects_psi_in_a_trace(folder: Path) -> None:
    (folder / "p.csv").write_text("time_s,pressure_kPa\n0,4.06\n1,4\n")
    (problem,) = check_experiment(write(folder, f"{HEADER},pressure_trace\na,a.csv,24,200,280,28,3,,p.csv\n"))
    assert "the sheet says 28 kPa" in problem.message


def test_check_looks_at_videos_and_calls_who_can_open_them(folder: Path) -> None:
    (folder / "a.mp4").write_bytes(b"film")
    (folder / "b.mp4").write_bytes(b"")
    rows = "".join(f"{name},{name}.mp4,24,200,280,28,3,\n" for name in "abc")
    write(folder, f"{HEADER.replace('track', 'video')}\n{rows}", "capture_fps: 1000\n")
    opened: list[str] = []

    def open_videos(experiment: Experiment, trials: list[Trial]) -> list[Problem]:
        opened.extend(f"{experiment.name}/{trial.name}" for trial in trials)
        return [Problem(message="cannot be decoded", column="video", trial="a"), Problem(message="no scale", file="x")]

    found = check_experiment(folder, open_videos)
    assert opened == ["my-vines/a"]
    assert [(problem.file, problem.line, problem.trial, problem.message) for problem in found] == [
        ("trials.csv", 3, "b", "is an empty file"),
        ("trials.csv", 4, "c", "does not exist"),
        ("trials.csv", 2, "a", "cannot be decoded"),
        ("x", 0, "", "no scale"),
    ]


def test_a_misspelt_video_is_answered_with_the_file_that_no_trial_uses(folder: Path) -> None:
    for name in ("d12_24kPa_1.mp4", "d12_24kPa_2.MP4", "notes.txt"):
        (folder / name).write_bytes(b"film")
    rows = "a,d12_24kPa_1.mp4,24,200,280,28,3,\nb,d12_24kP_2.mp4,24,200,280,28,3,\nc,other.avi,24,200,280,28,3,\n"
    write(folder, f"{HEADER.replace('track', 'video')}\n{rows}", "capture_fps: 1000\n")
    remedies = {problem.trial: problem.remedy for problem in check_experiment(folder) if problem.trial}
    assert remedies == {
        "b": "did you mean d12_24kPa_2.MP4?",
        "c": "check the path and its upper and lower case",
    }


def test_a_recording_that_no_row_names_is_named(folder: Path) -> None:
    burst = [f"burst/{i}.png" for i in range(5)]
    for name in ("a.mp4", "left.mov", "day 2/extra.avi", "calibration/board.mp4", "target.mp4", *burst):
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_bytes(b"film")
    rows = "a,./a.mp4,24,200,280,28,3,,\nb,left.mov,24,200,280,28,3,,no\n"
    target = "calibration: {kind: checkerboard, image: target.mp4, squares: [5, 5], square_mm: 5}\n"
    write(folder, f"{HEADER.replace('track', 'video')},use\n{rows}", "capture_fps: 1000\n" + target)
    (problem,) = check_experiment(folder)
    assert (problem.severity, problem.file, problem.column) == ("warning", "trials.csv", "video")
    assert problem.message.endswith(" burst, day 2/extra.avi")
    more = "c,burst/0.png,24,200,280,28,3,,\nd,day 2/extra.avi,24,200,280,28,3,,\n"
    write(folder, f"{HEADER.replace('track', 'video')},use\n{rows}{more}")
    assert check_experiment(folder) == []


def test_a_value_that_stands_in_the_settings_alone_is_faulted_there_and_once(folder: Path) -> None:
    for name in "ab":
        (folder / f"{name}.mp4").write_bytes(b"film")
    rows = "".join(f"{name},{name}.mp4,24,200,280,28,3,\n" for name in "ab")
    write(folder, f"{HEADER.replace('track', 'video')}\n{rows}", "capture_fps: 60\n")

    def slow(_experiment: Experiment, trials: list[Trial]) -> list[Problem]:
        return [Problem(message="is the rate of playback", column="capture_fps", trial=trial.name) for trial in trials]

    found = check_experiment(folder, slow)
    assert [(problem.file, problem.line, problem.trial) for problem in found] == [
        ("experiment.yaml", 0, "a"),
        ("experiment.yaml", 0, "b"),
    ]
    assert format_problems(found) == ["error: experiment.yaml, trial a and 1 more: capture_fps is the rate of playback"]


def test_what_was_measured_otherwise_on_every_trial_is_said_once() -> None:
    def seen(trial: str, width_mm: float, remedy: str = "check the scale") -> Problem:
        message = f"differs: the tube is {width_mm} mm wide"
        return Problem(message=message, column="diameter_mm", trial=trial, remedy=remedy, of_a_measurement=True)

    assert format_problems([seen("a", 2.38), seen("b", 2.41), seen("c", 2.38, "check it")]) == [
        "error: trial a and 1 more: diameter_mm differs: the tube is 2.38 mm wide: check the scale",
        "error: trial c: diameter_mm differs: the tube is 2.38 mm wide: check it",
    ]


def test_check_finds_a_missing_calibration_picture(folder: Path) -> None:
    write(folder, GOOD, "calibration: {kind: checkerboard, image: c.png, squares: [5, 5], square_mm: 5}\n")
    (problem,) = check_experiment(folder)
    assert (problem.file, problem.column, problem.message) == ("experiment.yaml", "calibration.image", "does not exist")


def test_check_returns_the_problems_of_an_experiment_that_cannot_be_read(tmp_path: Path) -> None:
    assert len(check_experiment(tmp_path / "none")) == 1


def test_twenty_lines_at_most_and_the_last_says_how_many_more() -> None:
    many = [Problem(message="is odd", column=f"c{i}", severity="warning") for i in range(30)]
    lines = format_problems([*many, Problem(message="is wrong")])
    assert len(lines) == 20
    assert lines[0] == "error: is wrong"
    assert lines[-1] == "… and 12 more (0 errors, 12 warnings)"
    assert len(format_problems(many[:20])) == 20


def test_a_cell_cannot_forge_lines_of_the_report(folder: Path) -> None:
    sheet = f'{HEADER}\na,a.csv,24,200,280,"2\nerror: all is lost",3,\n'
    (line,) = format_problems(read_experiment(write(folder, sheet)).problems)
    assert "\n" not in line
