"""The model in use on a results folder: columns, refusals, tracks read back, recordings along another axis."""

import json
import shutil
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from commanded import succeed
from lsoda_vine import small_campaign
from test_pipeline import MODEL_HEADERS

from vinetrack.core.records import Track, Trial, plain_track
from vinetrack.experiment.folder import read_experiment
from vinetrack.experiment.settings import run_settings
from vinetrack.pipeline.model_stage import fit_model
from vinetrack.pipeline.stages import Job
from vinetrack.results.folder_layout import Results, measured_trials, read_json, read_result, read_stored_track

TRAJECTORY_HEADER = "trial,time_s,lead_position_m,model_position_m,replicates_mean_m,replicates_sigma_m\n"
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


def fitted(experiment: Path, results: Path) -> dict:
    """What the stage of the model writes, once those before it have run."""
    for stage in ("trials", "damping"):
        succeed(stage, experiment, results, "--settings", '{"damping": {"resamples": 200}}')
    fit_model(Job(read_experiment(experiment), results, run_settings({})))
    for name, header in MODEL_HEADERS.items():
        assert (results / name).read_text(encoding="utf-8").startswith(header)
    return read_json(results / "fit.json")


def test_a_campaign_is_fitted_and_written_with_its_numbers_and_their_errors(tmp_path):
    """Two vines, four pressures, two replicates, n = 0.4, and one broken track."""
    pairs, results = small_campaign(seed=21)[0], Results(tmp_path / "results")
    torn = replace(pairs[0][0], name="torn"), plain_track(np.zeros(1), np.zeros(1))
    experiment = write_experiment(tmp_path / "vines", [*pairs, torn])
    content = fitted(experiment, results.folder)
    assert content["refused"] is None
    assert {"spreads", "noise_m", "messages", "warnings", "covariance"} <= set(content)
    assert len(content["trials"]) == 16
    n = next(entry for entry in content["numbers"] if entry["parameter"] == "eversion_damping.n")
    assert n["low_95"] < n["value"] < n["high_95"]
    assert abs(n["value"] - 0.4) < 4 * n["sigma"]

    compared = read_result(results.folder / "comparison.csv")
    assert set(compared["model"]) == {"pressure_drive+gravity+eversion_damping+yield_pressure"}
    trajectories = {path.stem: path.read_text() for path in (results.folder / "comparison").iterdir()}
    assert len(compared) == 8
    assert trajectories.keys() == set(compared["condition"])
    assert all(text.startswith(TRAJECTORY_HEADER) for text in trajectories.values())
    check = read_result(results.folder / "model_check.csv")
    assert check["n_trajectory"].tolist() == [check["n_trajectory"].iloc[0]] * 2
    assert (check["z"] < 4).all()

    pairs, kinematics = measured_trials(read_experiment(experiment), results)
    assert [trial.name for trial, _ in pairs] == list(kinematics)
    assert "torn" not in kinematics
    by_hand = pd.read_csv(experiment / "tracks" / f"{pairs[0][0].name}.csv")
    np.testing.assert_array_equal(pairs[0][1].lead_position_m, by_hand["position_m"].to_numpy())


def test_a_pressure_measured_along_comes_back_with_the_track(tmp_path):
    time_s = np.arange(20) / 1000
    brought = {"time_s": time_s, "position_m": time_s / 10, "pressure_kPa": 20 - 100 * time_s}
    pd.DataFrame(brought).to_csv(tmp_path / "a.csv", index=False)
    (tmp_path / "trials.csv").write_text(SHEET + "a,a.csv,12,100,300,20,3\n")
    table = pd.DataFrame({"frame": range(20), "time_s": time_s, "edge_px": np.nan, "lead_position_m": time_s / 10})
    table = table.assign(lead_position_sigma_m=np.nan, flag="", lead_position_systematic_m=np.nan)
    track = read_stored_track(read_experiment(tmp_path).trial("a"), table)
    assert track.pressure_Pa is not None
    np.testing.assert_allclose(track.pressure_Pa, 1e3 * brought["pressure_kPa"])


# A recording whose axis is not that of the others fails when the trials are gathered, and enters no fit.
@pytest.fixture(scope="module")
def tracked(tmp_path_factory):
    """Five trials filmed level and two filmed straight down, analysed."""
    folder = tmp_path_factory.mktemp("askew")
    pairs = [(replace(trial, name=f"t{k}"), track) for k, (trial, track) in enumerate(small_campaign(seed=23)[0][:7])]
    experiment = write_experiment(folder / "vines", pairs, [90] * 5 + [0] * 2)
    succeed("trials", experiment, folder / "results")
    return experiment, folder / "results"


def along(x0: float, y0: float, x1: float, y1: float, **more: object) -> dict[str, object]:
    return {"from_px": (x0, y0), "to_px": (x1, y1), "width_px": 20.0, **more}


LEVEL, DOOR, DOWN = along(10, 50, 300, 52), along(40, 90, 200, 30), along(60, 5, 62, 200)
FIVE = {f"t{k}": LEVEL for k in range(5)}


@pytest.mark.parametrize(
    ("axes", "failed"),
    [
        (FIVE | {"t2": DOOR}, {"t2"}),
        (FIVE | {"t4": LEVEL | {"via_px": [(150.0, 80.0)]}}, {"t4"}),  # a curve
        (FIVE | {"t5": DOWN, "t6": DOWN}, set()),  # another way of growth
        ({"t0": LEVEL, "t1": DOOR, "t2": LEVEL, "t3": DOOR}, set()),  # no majority
    ],
)
def test_a_recording_along_another_axis_than_most_fails_and_enters_no_fit(tracked, tmp_path, axes, failed):
    experiment, results = tracked[0], Results(shutil.copytree(tracked[1], tmp_path / "results"))
    for name, axis in axes.items():
        path = results.analysed(name)
        path.write_text(json.dumps(json.loads(path.read_text()) | {"axis": axis}))
    succeed("damping", experiment, results.folder)
    rows = pd.read_csv(results.folder / "trials.csv").set_index("trial")
    assert set(rows.index[rows["status"] == "failed"]) == failed
    assert all("column `axis`" in rows.loc[name, "reason"] for name in failed)
    pairs, _ = measured_trials(read_experiment(experiment), results)
    assert {trial.name for trial, _ in pairs} == set(rows.index) - failed
    assert not failed & set(pd.read_csv(results.folder / "damping_points.csv")["trial"])
