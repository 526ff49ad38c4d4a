"""Experiment folders that cannot be read at all: everything is said at once."""

from __future__ import annotations

from pathlib import Path

import pytest
from hand_sheet import GOOD, HEADER, stopped, two_vines, write

from vinetrack.experiment.folder import read_experiment


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return two_vines(tmp_path)


@pytest.mark.parametrize("column", ["trial", "diameter_mm", "thickness_um", "length_mm", "yield_pressure_kPa"])
def test_a_missing_column_stops_the_experiment_with_one_problem(folder: Path, column: str) -> None:
    cells = [line.split(",") for line in GOOD.splitlines()]
    drop = cells[0].index(column)
    write(folder, "\n".join(",".join(cell for i, cell in enumerate(row) if i != drop) for row in cells))
    errors = [problem for problem in stopped(folder) if problem.column == column]
    assert len(errors) == 1
    assert "is missing" in str(errors[0])


def test_a_sheet_without_recordings_is_refused(folder: Path) -> None:
    write(folder, "trial,diameter_mm\na,24\n")
    assert any("neither a column video nor a column track" in str(problem) for problem in stopped(folder))


def test_a_name_used_twice_stops_the_experiment(folder: Path) -> None:
    write(folder, GOOD.replace("\nb,", "\na,"))
    (problem,) = stopped(folder)
    assert (problem.line, problem.message) == (3, "is also the name of line 2")


def test_a_sheet_without_rows_is_refused(folder: Path) -> None:
    assert "has no rows" in str(stopped(write(folder, HEADER + "\n"))[0])


def test_all_problems_of_sheet_and_settings_come_at_once(folder: Path) -> None:
    write(folder, GOOD.replace(",28,", ",28000,").replace("\nb,", "\na,"), "strikt: true\ntail_slack: none\n")
    found = stopped(folder)
    assert {(problem.file, problem.column) for problem in found} == {
        ("experiment.yaml", "strikt"),
        ("experiment.yaml", "tail_slack"),
        ("trials.csv", "trial"),
        ("trials.csv", "pressure_kPa"),
    }


def test_broken_settings_bring_no_false_alarms_about_the_sheet(folder: Path) -> None:
    write(folder, "trial,track,pressure_kPa\na,a.csv,\n", "diameter_mm: 24\nlength_mm: [\n")
    assert {problem.file for problem in stopped(folder)} == {"experiment.yaml"}


@pytest.mark.parametrize(
    "settings",
    [
        "calibration: {kind: checkerboard, image: ../a.png, squares: [5, 5], square_mm: 5}",
        "effects: [/home/me/drag.py]",
    ],
)
def test_paths_in_the_settings_stay_inside(folder: Path, settings: str) -> None:
    (problem,) = stopped(write(folder, GOOD, settings))
    assert problem.file == "experiment.yaml"


def test_a_folder_that_is_none_is_named(folder: Path) -> None:
    assert "does not exist" in str(stopped(folder / "none")[0])
    assert "is a file, not a folder" in str(stopped(folder / "trials.csv")[0])


def test_an_empty_folder_names_what_was_expected(tmp_path: Path) -> None:
    (problem,) = stopped(tmp_path)
    assert "the folder is empty; expected a folder with trials.csv" in str(problem)


@pytest.mark.parametrize(
    ("name", "remedy"), [("Trials.csv", "rename Trials.csv"), ("trials.xlsx", "save trials.xlsx as trials.csv")]
)
def test_a_sheet_of_nearly_the_right_name_is_pointed_at(tmp_path: Path, name: str, remedy: str) -> None:
    (tmp_path / name).write_text(GOOD)
    (problem,) = stopped(tmp_path)
    assert remedy in problem.remedy


def test_an_unquoted_decimal_comma_is_explained(folder: Path) -> None:
    experiment = read_experiment(write(folder, GOOD.replace("14,3,", "14,5,3,0")))
    assert "decimal commas" in experiment.failed["b"]
