"""The model in use on a results folder: columns, refusals, tracks read back, recordings along another axis."""

from __future__ import annotations

import csv
import json
import shutil
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from commanded import succeed
from lsoda_vine import small_campaign

from vinetrack.core.records import Track, Trial, plain_track
from vinetrack.experiment.folder import read_experiment
from vinetrack.experiment.settings import run_settings
from vinetrack.pipeline.model_stage import fit_model
from vinetrack.pipeline.stages import Job
from vinetrack.results.folder_layout import Results, measured_trials, read_json, read_result, read_stored_track

# The model in use on a results folder: exact columns, what a refused fit leaves, and tracks read back.


COMPARISON_HEADER = (
    "model,condition,rms_position_m,rms_final_velocity_m_s,replicate_floor_m,ratio,worst_at_s,worst_at_m,"
    "replicate_floor_sigma_m"
)
CHECK_HEADER = "vine,n_steady,n_trajectory,B_steady,B_trajectory,z"
AUDIT_HEADER = (
    "trial,condition,term,size,force_N,share_of_drive,shift_m,time_s,lead_position_m,y_over_L,slack_from_s,note"
)
TRAJECTORY_HEADER = "trial,time_s,lead_position_m,model_position_m,replicates_mean_m,replicates_sigma_m"
SHEET = "trial,track,diameter_mm,thickness_um,length_mm,pressure_kPa,yield_pressure_kPa\n"


def write_experiment(folder: Path, pairs: Iterable[tuple[Trial, Track]], angles_deg: Sequence[int] = ()) -> Path:
    """The tracks of trials, and their sheet."""
    (folder / "tracks").mkdir(parents=True)
    rows = []
    for trial, track in pairs:
        table = pd.DataFrame({"time_s": track.time_s, "position_m": track.lead_position_m})
        table.to_csv(folder / "tracks" / f"{trial.name}.csv", index=False)
        sizes = (1e3 * trial.diameter_m, 1e6 * trial.thickness_m, 1e3 * trial.length_m, trial.pressure_Pa / 1e3)
        rows.append([trial.name, f"tracks/{trial.name}.csv", *(f"{size:g}" for size in sizes), "3"])
    sheet = pd.DataFrame(rows, columns=SHEET.strip().split(","))
    (sheet.assign(growth_angle_deg=angles_deg) if angles_deg else sheet).to_csv(folder / "trials.csv", index=False)
    return folder


def analysed(experiment: Path, results: Path) -> Path:
    for stage in ("trials", "damping"):
        succeed(stage, experiment, results, "--settings", '{"damping": {"resamples": 200}}')
    return results


@pytest.fixture(scope="module")
def campaign(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Experiment and results folder: two vines, four pressures, two replicates, and one broken track."""
    folder = tmp_path_factory.mktemp("campaign")
    pairs = small_campaign(seed=21)[0]
    torn = replace(pairs[0][0], name="torn"), plain_track(np.zeros(1), np.zeros(1))
    experiment = write_experiment(folder / "vines", [*pairs, torn])
    results = analysed(experiment, folder / "results")
    fit_model(Job(read_experiment(experiment), results, run_settings({})))
    return experiment, results


def header(path: Path) -> str:
    return path.read_text(encoding="utf-8").splitlines()[0]


def test_headers_are_exactly_those_people_rely_on(campaign: tuple[Path, Path]) -> None:
    _, results = campaign
    assert header(results / "comparison.csv") == COMPARISON_HEADER
    assert header(results / "model_check.csv") == CHECK_HEADER
    assert header(results / "audit.csv") == AUDIT_HEADER
    assert {header(path) for path in (results / "comparison").iterdir()} == {TRAJECTORY_HEADER}


def test_every_condition_has_a_row_and_its_trajectories(campaign: tuple[Path, Path]) -> None:
    _, results = campaign
    with (results / "comparison.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 8
    assert {row["model"] for row in rows} == {"pressure_drive+gravity+eversion_damping+yield_pressure"}
    assert {path.stem for path in (results / "comparison").iterdir()} == {row["condition"] for row in rows}


def test_the_fit_is_written_with_its_numbers_and_their_errors(campaign: tuple[Path, Path]) -> None:
    content = read_json(campaign[1] / "fit.json")
    n = next(entry for entry in content["numbers"] if entry["parameter"] == "eversion_damping.n")
    assert content["refused"] is None
    assert n["low_95"] < n["value"] < n["high_95"]
    assert abs(n["value"] - 0.4) < 4 * n["sigma"]
    assert {"spreads", "noise_m", "messages", "warnings", "covariance", "trials"} <= set(content)
    assert len(content["trials"]) == 16


def test_steady_windows_and_trajectories_agree_on_the_model_the_tracks_were_grown_with(
    campaign: tuple[Path, Path],
) -> None:
    check = read_result(campaign[1] / "model_check.csv")
    assert len(check) == 2
    assert check["n_trajectory"].iloc[0] == check["n_trajectory"].iloc[1]
    assert (check["z"] < 4).all()


def test_compare_prints_a_finished_folder_aligned_and_with_units(campaign: tuple[Path, Path]) -> None:
    _, results = campaign
    lines = succeed("compare", results).splitlines()
    assert lines[2].split() == ["mm", "mm", "m/s", "ms", "mm"]
    assert lines[3].startswith("24mm-200um-280mm_12kPa_0g ")
    assert len({len(line) for line in lines[3:11]}) == 1


def test_tracks_are_read_back_as_they_were_written(campaign: tuple[Path, Path]) -> None:
    experiment, results = campaign
    pairs, kinematics = measured_trials(read_experiment(experiment), Results(results))
    names = [trial.name for trial, _ in pairs]
    assert "torn" not in names
    assert list(kinematics) == names
    by_hand = pd.read_csv(experiment / "tracks" / f"{names[0]}.csv")
    np.testing.assert_array_equal(pairs[0][1].lead_position_m, by_hand["position_m"].to_numpy())


def test_a_pressure_measured_along_comes_back_with_the_track(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text(
        "time_s,position_m,pressure_kPa\n" + "".join(f"{i / 1000},{i / 1e4},{20 - i / 10}\n" for i in range(20))
    )
    (tmp_path / "trials.csv").write_text(SHEET + "a,a.csv,12,100,300,20,3\n")
    trial = read_experiment(tmp_path).trial("a")
    time_s = np.arange(20) / 1000
    table = pd.DataFrame({"frame": range(20), "time_s": time_s, "edge_px": np.nan, "lead_position_m": time_s / 10})
    track = read_stored_track(
        trial, table.assign(lead_position_sigma_m=np.nan, flag="", lead_position_systematic_m=np.nan)
    )
    assert track.pressure_Pa is not None
    np.testing.assert_allclose(track.pressure_Pa, 1e3 * (20 - np.arange(20) / 10))


def refused(experiment: Path, results: Path) -> str:
    """The reason in `fit.json`, once every table has its header alone."""
    content, _ = fit_model(Job(read_experiment(experiment), results, run_settings({})))
    assert (results / "comparison.csv").read_text() == COMPARISON_HEADER + "\n"
    assert (results / "model_check.csv").read_text() == CHECK_HEADER + "\n"
    assert (results / "audit.csv").read_text() == AUDIT_HEADER + "\n"
    assert not list((results / "comparison").iterdir())
    assert json.loads((results / "fit.json").read_text()) == content
    return str(content["refused"])


def test_where_all_trials_failed_the_run_goes_on_and_says_so(tmp_path: Path) -> None:
    experiment = tmp_path / "vines"
    experiment.mkdir()
    (experiment / "a.csv").write_text("time_s,position_m\n0,0\n")
    (experiment / "trials.csv").write_text(SHEET + "a,a.csv,12,100,300,20,3\n")
    results = analysed(experiment, tmp_path / "results")
    assert refused(experiment, results).startswith("No trial can be fitted")


@pytest.mark.slow
def test_of_bodies_that_fall_by_gravity_alone_the_fit_says_g(tmp_path: Path) -> None:
    """Three balls let go, filmed at 240 frames a second with 0.2 mm of noise; g = 9.80665."""
    experiment = tmp_path / "balls"
    experiment.mkdir()
    draw = np.random.default_rng(21)
    sheet = ["trial,track,diameter_mm,pressure_kPa,yield_pressure_kPa,payload_g\n"]
    for name in ("a", "b", "c"):
        time_s = np.arange(120) / 240
        fallen_m = 0.5 * 9.80665 * np.maximum(time_s - 0.0513, 0) ** 2 + 2e-4 * draw.standard_normal(120)
        pd.DataFrame({"time_s": time_s, "position_m": fallen_m}).to_csv(experiment / f"{name}.csv", index=False)
        sheet.append(f"{name},{name}.csv,40,0,0,2.7\n")
    (experiment / "trials.csv").write_text("".join(sheet))
    (experiment / "experiment.yaml").write_text("travel_ratio: 1\nmodel: [gravity]\n")
    results = analysed(experiment, tmp_path / "results")
    content, _ = fit_model(Job(read_experiment(experiment), results, run_settings({})))
    (g,) = content["numbers"]
    assert abs(g["value"] - 9.80665) < 4 * g["sigma"] < 0.04
    (row,) = read_result(results / "comparison.csv").itertuples()
    assert row.rms_position_m == pytest.approx(2e-4, rel=0.15)
    assert row.ratio == pytest.approx(1.0, abs=0.15)


# A recording whose axis is not that of the others fails when the trials are gathered, and enters no fit.


LEVEL, DOOR, DOWN = ((10.0, 50.0), (300.0, 52.0)), ((40.0, 90.0), (200.0, 30.0)), ((60.0, 5.0), (62.0, 200.0))


@pytest.fixture(scope="module")
def tracked(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Five trials filmed level and two filmed straight down, analysed; the axes are those of `write_axes`."""
    folder = tmp_path_factory.mktemp("askew")
    pairs = [(replace(trial, name=f"t{k}"), track) for k, (trial, track) in enumerate(small_campaign(seed=23)[0][:7])]
    experiment = write_experiment(folder / "vines", pairs, [90] * 5 + [0] * 2)
    results = folder / "results"
    succeed("trials", experiment, results)
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
    succeed("damping", experiment, folder)
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
