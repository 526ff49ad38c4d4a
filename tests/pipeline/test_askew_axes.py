"""A recording whose axis is not that of the others fails when the trials are gathered, and enters no fit."""

from __future__ import annotations

import csv
import json
import shutil
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest
from lsoda_vine import small_campaign
from typer.testing import CliRunner

from vinetrack.cli.main import app
from vinetrack.experiment.folder import read_experiment
from vinetrack.pipeline.model_stage import measured_trials
from vinetrack.results.folder_layout import Results

SHEET = "trial,track,diameter_mm,thickness_um,length_mm,pressure_kPa,yield_pressure_kPa,growth_angle_deg\n"
LEVEL, DOOR, DOWN = ((10.0, 50.0), (300.0, 52.0)), ((40.0, 90.0), (200.0, 30.0)), ((60.0, 5.0), (62.0, 200.0))


def run(*arguments: object) -> None:
    done = CliRunner().invoke(app, [str(argument) for argument in arguments], catch_exceptions=False)
    assert done.exit_code == 0, done.output


@pytest.fixture(scope="module")
def tracked(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Five trials filmed level and two filmed straight down, analysed; the axes are those of `write_axes`."""
    folder = tmp_path_factory.mktemp("askew")
    experiment, results = folder / "vines", folder / "results"
    (experiment / "tracks").mkdir(parents=True)
    rows = [SHEET]
    for k, (trial, track) in enumerate(small_campaign(seed=23)[0][:7]):
        columns = np.column_stack([track.time_s, track.lead_position_m])
        path = experiment / "tracks" / f"t{k}.csv"
        np.savetxt(path, columns, delimiter=",", header="time_s,position_m", comments="")
        sizes = f"{1e3 * trial.diameter_m:g},{1e6 * trial.thickness_m:g},{1e3 * trial.length_m:g}"
        rows.append(f"t{k},tracks/t{k}.csv,{sizes},{trial.pressure_Pa / 1e3:g},3,{90 if k < 5 else 0}\n")
    (experiment / "trials.csv").write_text("".join(rows))
    run("tracks", experiment, results)
    return experiment, results


def gathered(
    tracked: tuple[Path, Path], folder: Path, axes: Mapping[str, Mapping[str, object]]
) -> tuple[dict[str, tuple[str, str]], set[str]]:
    """Status and reason by trial where recordings had these axes, and the trials that a fit gets."""
    experiment, results = tracked
    shutil.copytree(results, folder)
    for name, axis in axes.items():
        path = Results(folder).analysed(name)
        path.write_text(json.dumps(json.loads(path.read_text()) | {"axis": axis}))
    run("gather", experiment, folder)
    with (folder / "trials.csv").open() as file:
        states = {row["trial"]: (row["status"], row["reason"]) for row in csv.DictReader(file)}
    pairs, _ = measured_trials(read_experiment(experiment), Results(folder))
    return states, {trial.name for trial, _ in pairs}


def along(ends: tuple[tuple[float, float], tuple[float, float]], **more: object) -> dict[str, object]:
    return {"from_px": ends[0], "to_px": ends[1], "width_px": 20.0, **more}


def test_one_along_a_door_fails_with_its_remedy_and_enters_no_fit(tracked: tuple[Path, Path], tmp_path: Path) -> None:
    axes = {f"t{k}": along(LEVEL) for k in range(5)} | {"t2": along(DOOR)}
    states, fitted = gathered(tracked, tmp_path / "results", axes)
    assert states["t2"][0] == "failed"
    assert "askew to that of 4 other recordings" in states["t2"][1]
    assert "column `axis`" in states["t2"][1]
    assert all(states[name][0] != "failed" for name in states if name != "t2")
    assert fitted == set(states) - {"t2"}
    with (tmp_path / "results" / "damping_points.csv").open() as file:
        assert "t2" not in {row["trial"] for row in csv.DictReader(file)}


def test_a_curve_where_others_are_straight_fails(tracked: tuple[Path, Path], tmp_path: Path) -> None:
    axes = {f"t{k}": along(LEVEL) for k in range(5)} | {"t4": along(LEVEL, via_px=[(150.0, 80.0)])}
    states, _ = gathered(tracked, tmp_path / "results", axes)
    assert [name for name, (status, _) in states.items() if status == "failed"] == ["t4"]


def test_vines_that_grow_another_way_and_axes_that_no_majority_shares_are_left_alone(
    tracked: tuple[Path, Path], tmp_path: Path
) -> None:
    downward = {f"t{k}": along(LEVEL if k < 5 else DOWN) for k in range(7)}
    states, fitted = gathered(tracked, tmp_path / "down", downward)
    assert fitted == set(states)
    undecided = {f"t{k}": along((LEVEL, DOOR)[k % 2]) for k in range(4)}
    states, fitted = gathered(tracked, tmp_path / "undecided", undecided)
    assert fitted == set(states)
