"""What a sheet says of specimens, days and the order of trials, and what `check` warns of."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hand_sheet import HEADER, TRACK, write

from vinetrack.experiment.folder import check_experiment, order_pressure_correlation, read_experiment, trial_order

PRESSURES = (20, 20, 24, 24, 28, 28, 32, 32, 36, 36)


def written(folder: Path, columns: str = "", cells: tuple[str, ...] = ("",) * 10, rows: tuple[int, ...] = ()) -> Path:
    """Ten trials of one vine at five pressures, in the order of `rows`."""
    folder.mkdir(exist_ok=True)
    (folder / "a.csv").write_text(TRACK)
    lines = [f"t{i},a.csv,24,200,280,{PRESSURES[i]},3,{cells[i]}" for i in rows or range(10)]
    return write(folder, f"{HEADER}{columns}\n" + "\n".join(lines) + "\n")


def words(folder: Path, column: str) -> list[str]:
    return [str(problem) for problem in check_experiment(folder) if problem.column == column]


def test_the_columns_reach_the_trial(tmp_path: Path) -> None:
    cells = tuple(f",tube {i % 2},monday,{10 - i}" for i in range(10))
    experiment = read_experiment(written(tmp_path / "x", ",specimen,day,order", cells))
    assert [(one.specimen, one.day, one.order) for one in experiment.trials[:2]] == [
        ("tube 0", "monday", 10.0),
        ("tube 1", "monday", 9.0),
    ]
    ranks, stated = trial_order(experiment.trials)
    assert stated
    assert ranks.tolist() == list(range(9, -1, -1))
    assert len({trial.condition for trial in experiment.trials}) == 5, "they are replicates all the same"


def test_rows_are_the_order_where_the_sheet_has_none(tmp_path: Path) -> None:
    trials = read_experiment(written(tmp_path / "x")).trials
    ranks, stated = trial_order(trials)
    assert not stated
    assert ranks.tolist() == list(range(10))
    assert order_pressure_correlation(trials) == pytest.approx(0.985, abs=0.005)


@pytest.mark.parametrize(("column", "said"), [("", "is blank"), (",order", "follows the pressure")])
def test_check_warns_of_an_order_that_follows_the_pressure(tmp_path: Path, column: str, said: str) -> None:
    cells = tuple(f",{i + 1}" if column else "" for i in range(10))
    (warning,) = words(written(tmp_path / "x", column, cells), "order")
    assert warning.startswith("warning")
    assert said in warning
    assert "repeat six of them in random order" in warning


def test_check_is_content_with_random_order(tmp_path: Path) -> None:
    order = np.random.default_rng(1).permutation(10) + 1
    assert not words(written(tmp_path / "x", ",order", tuple(f",{i}" for i in order)), "order")


def test_check_warns_of_a_specimen_for_each_condition(tmp_path: Path) -> None:
    alone = written(tmp_path / "x", ",specimen", tuple(f",{PRESSURES[i]}" for i in range(10)))
    (warning,) = words(alone, "specimen")
    assert "differs for every condition" in warning
    mixed = written(tmp_path / "y", ",specimen", tuple(f",{i % 2}" for i in range(10)))
    assert not words(mixed, "specimen")


def test_an_order_that_is_no_number_is_refused(tmp_path: Path) -> None:
    folder = written(tmp_path / "x", ",order", ("last",) * 10)
    assert "is not a number" in str(check_experiment(folder)[0])
