"""Corrections by hand are read, refused in words, and reach the trial."""

from __future__ import annotations

from pathlib import Path

import pytest

from vinetrack.core.problems import ExperimentError
from vinetrack.core.records import Correction
from vinetrack.experiment.folder import corrections_text, read_corrections, read_experiment

SHEET = "trial,video,track,diameter_mm,thickness_um,length_mm,pressure_kPa,yield_pressure_kPa,capture_fps\n"
ROWS = "a,a.mp4,,12,100,140,24,3,1000\nb,,b.csv,12,100,140,24,3,\n"


def write(folder: Path, text: str) -> Path:
    (folder / "trials.csv").write_text(SHEET + ROWS)
    (folder / "corrections.csv").write_text(text)
    return folder


def test_corrections_reach_their_trial(tmp_path: Path) -> None:
    write(tmp_path, "trial,frame,action,edge_px\na,12,move,310.5\na,3,drop,\na,40,confirm,\n")
    trial = read_experiment(tmp_path).trial("a")
    assert [(one.frame, one.action) for one in trial.corrections] == [(3, "drop"), (12, "move"), (40, "confirm")]
    assert trial.corrections[1].edge_px == 310.5


def test_what_is_written_is_read_back(tmp_path: Path) -> None:
    given = {"a": (Correction(3, "drop"), Correction(12, "move", 310.5))}
    (tmp_path / "corrections.csv").write_text(corrections_text(given))
    found, problems = read_corrections(tmp_path)
    assert problems == []
    assert corrections_text(found) == corrections_text(given)


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("a,3,remove,", "is not an action: write move, drop or confirm"),
        ("a,3.5,drop,", "is not a frame number"),
        ("a,-1,drop,", "is not a frame number"),
        ("a,3,move,", "is blank"),
        ("a,three,drop,", "is not a number"),
        ("a,3,drop,\na,3,confirm,", "is corrected twice"),
    ],
)
def test_a_line_that_makes_no_sense_stops_with_its_place(tmp_path: Path, line: str, words: str) -> None:
    write(tmp_path, f"trial,frame,action,edge_px\n{line}\n")
    with pytest.raises(ExperimentError, match=words) as stopped:
        read_experiment(tmp_path)
    assert "corrections.csv line" in str(stopped.value)


def test_corrections_of_a_track_and_of_a_stranger_are_ignored_with_a_warning(tmp_path: Path) -> None:
    experiment = read_experiment(write(tmp_path, "trial,frame,action,edge_px\nb,3,drop,\nzz,3,drop,\n"))
    words = [problem.message for problem in experiment.problems if problem.file == "corrections.csv"]
    assert words == [
        "is not a recording; its corrections are ignored",
        "is not in the sheet; its corrections are ignored",
    ]
