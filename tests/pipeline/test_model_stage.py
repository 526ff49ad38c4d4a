"""Stages on results folders: the model in use, power of a sheet that nobody has filmed, and the paper's numbers."""

import json
import shutil
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
from commanded import fit_law, run, succeed
from explorer_campaign import ROUGH_FIGURES, make_results
from lsoda_vine import small_campaign
from test_pipeline import MODEL_HEADERS

from vinetrack.core.records import Track, Trial, plain_track
from vinetrack.experiment.folder import read_experiment
from vinetrack.figures.registry import figures_of
from vinetrack.laboratory import campaigns
from vinetrack.pipeline import planning_stage
from vinetrack.pipeline.analysis import _deviate
from vinetrack.pipeline.planning_stage import PowerRequest, power_of_target
from vinetrack.pipeline.workflow import STAGES
from vinetrack.results import Results, measured_trials, read_json, read_result

TRAJECTORY_HEADER = "trial,time_s,lead_position_m,model_position_m,replicates_mean_m,replicates_sigma_m\n"
SHEET = "trial,track,diameter_mm,thickness_um,length_mm,pressure_kPa,yield_pressure_kPa\n"


def write_experiment(folder: Path, pairs: Iterable[tuple[Trial, Track]], angles_deg: Sequence[int] = ()) -> Path:
    """The tracks of trials, and their sheet."""
    campaigns.write_experiment([SimpleNamespace(stated=trial, track=track) for trial, track in pairs], folder)
    if angles_deg:
        pd.read_csv(folder / "trials.csv").assign(growth_angle_deg=angles_deg).to_csv(
            folder / "trials.csv", index=False
        )
    return folder


def test_a_campaign_is_fitted_and_written_with_its_numbers_and_their_errors(tmp_path):
    """Two vines, four pressures, two replicates, n = 0.4, and one broken track."""
    pairs, results = small_campaign(seed=21)[0], Results(tmp_path / "results")
    torn = replace(pairs[0][0], name="torn"), plain_track(np.zeros(1), np.zeros(1))
    experiment = write_experiment(tmp_path / "vines", [*pairs, torn])
    make_results(experiment, results.folder)
    for name, header in MODEL_HEADERS.items():
        assert (results.folder / name).read_text(encoding="utf-8").startswith(header)
    content = read_json(results.fit)
    assert content["refused"] is None
    assert {"spreads", "noise_m", "messages", "warnings", "covariance"} <= set(content)
    assert len(content["trials"]) == 16
    assert {"parameter", "value", "sigma", "low_95", "high_95"} <= set(content["numbers"][0])
    compared = read_result(results.folder / "comparison.csv")
    assert set(compared["model"]) == {"pressure_drive+gravity+eversion_damping+yield_pressure"}
    trajectories = {path.stem: path.read_text() for path in (results.folder / "comparison").iterdir()}
    assert len(compared) == 8
    assert trajectories.keys() == set(compared["condition"])
    assert all(text.startswith(TRAJECTORY_HEADER) for text in trajectories.values())
    check = read_result(results.folder / "model_check.csv")
    assert check["n_trajectory"].tolist() == [check["n_trajectory"].iloc[0]] * 2
    assert (check["z"] < 4).all()

    pairs = measured_trials(read_experiment(experiment), results)
    assert "torn" not in {trial.name for trial, _ in pairs}
    by_hand = pd.read_csv(experiment / "tracks" / f"{pairs[0][0].name}.csv")
    np.testing.assert_array_equal(pairs[0][1].lead_position_m, by_hand["position_m"].to_numpy())


def test_a_pressure_measured_along_comes_back_with_the_track(tmp_path):
    time_s = np.arange(20) / 1000
    brought = {"time_s": time_s, "position_m": time_s / 10, "pressure_kPa": 20 - 100 * time_s}
    pd.DataFrame(brought).to_csv(tmp_path / "a.csv", index=False)
    (tmp_path / "trials.csv").write_text(SHEET + "a,a.csv,12,100,300,20,3\n")
    succeed("trials", tmp_path, tmp_path / "results")
    ((_, track),) = measured_trials(read_experiment(tmp_path), Results(tmp_path / "results"))
    assert track.lead_position_systematic_m is None
    assert track.pressure_Pa is not None
    np.testing.assert_allclose(track.pressure_Pa, 1e3 * brought["pressure_kPa"])


# A recording whose axis is not that of the others fails when the trials are gathered, and enters no fit.
@pytest.fixture(scope="module")
def tracked(tmp_path_factory):
    """Five trials filmed level and two filmed straight down, analysed."""
    folder = tmp_path_factory.mktemp("askew")
    pairs = [(replace(trial, name=f"t{k}"), track) for k, (trial, track) in enumerate(small_campaign(seed=23)[0][:7])]
    experiment = write_experiment(folder / "vines", pairs, [90] * 5 + [0] * 2)
    succeed("trials", experiment, folder / "results", "--settings", ROUGH_FIGURES)
    return experiment, folder / "results"


def along(x0: float, y0: float, x1: float, y1: float, **more: object) -> dict[str, object]:
    return {"from_px": (x0, y0), "to_px": (x1, y1), "width_px": 20.0, **more}


LEVEL, DOOR, DOWN = along(10, 50, 300, 52), along(40, 90, 200, 30), along(60, 5, 62, 200)
FIVE = {f"t{k}": LEVEL for k in range(5)}


@pytest.mark.parametrize(
    ("axes", "failed"),
    [
        (FIVE | {"t2": DOOR, "t4": LEVEL | {"via_px": [(150.0, 80.0)]}}, {"t2", "t4"}),  # one askew, and a curve
        (FIVE | {"t5": DOWN, "t6": DOWN}, set()),  # another way of growth
    ],
)
def test_a_recording_along_another_axis_than_most_fails_and_enters_no_fit(tracked, tmp_path, axes, failed):
    experiment, results = tracked[0], Results(shutil.copytree(tracked[1], tmp_path / "results"))
    for name, axis in axes.items():
        path = results.analysed(name)
        path.write_text(json.dumps(json.loads(path.read_text()) | {"axis": axis}))
    fit_law(experiment, results.folder)
    rows = pd.read_csv(results.folder / "trials.csv").set_index("trial")
    assert set(rows.index[rows["status"] == "failed"]) == failed
    assert all("column `axis`" in rows.loc[name, "reason"] for name in failed)
    pairs = measured_trials(read_experiment(experiment), results)
    assert {trial.name for trial, _ in pairs} == set(rows.index) - failed
    assert not failed & set(pd.read_csv(results.folder / "damping_points.csv")["trial"])


PLANNED = (
    "trial,diameter_mm,thickness_um,length_mm,pressure_kPa,yield_pressure_kPa\n"
    "a1,24,200,200,14,3\na2,24,200,200,14,3\nb1,24,200,200,34,3\nb2,24,200,200,34,3\n"
)
SETTINGS = "candidates: [leak, air_drag, payload_drag]\n"


def planned(folder: Path, more: str = "") -> Path:
    (folder / "trials.csv").write_text(PLANNED)
    (folder / "experiment.yaml").write_text(SETTINGS + more)
    return folder


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return planned(tmp_path_factory.mktemp("planned"))


def test_a_sheet_without_recordings_says_what_was_guessed(folder):
    power = power_of_target(PowerRequest(folder, noise_mm=0.2))
    origins = {entry.name: (entry.value, entry.origin) for entry in power.inputs}
    assert power.n_trials == 4
    assert origins["noise of a position"] == ("0.2 mm, correlation 0.00", "stated")
    assert origins["spread of B from trial to trial"][1].startswith("guess")
    assert origins["frame rate"][1] == "guess"
    assert origins["systematic error of positions"] == ("0.08 mm", "guess: positions by a scale, lens uncorrected")
    assert [entry.effect for entry in power.effects] == ["leak", "air_drag"]
    assert list(power.not_testable) == ["payload_drag"]


def test_a_plan_counts_the_systematic_error_that_its_recordings_will_have(folder):
    uncorrected = power_of_target(PowerRequest(folder))
    corrected = power_of_target(PowerRequest(folder, systematic_mm=0.0))
    assert ("0 mm", "stated") in {(entry.value, entry.origin) for entry in corrected.inputs}
    for name in ("leak", "air_drag"):
        assert corrected[name].size_at(0.9) < 0.9 * uncorrected[name].size_at(0.9)


@pytest.mark.slow
def test_the_trials_to_add_are_printed_and_written_as_rows_of_the_sheet(folder, tmp_path):
    planned(tmp_path, "limits: {pressure_kPa: 14:40, new_vines: no}\n")
    now = power_of_target(PowerRequest(folder))["leak"]
    rows, size = tmp_path / "more.csv", f"leak={0.7 * now.size_at(0.9):.4g}"
    assert "of campaigns" in succeed("power", tmp_path, size, "--reach", "0.9", "--sheet", rows)
    assert all(run("power", tmp_path, f"leak={wrong}").exit_code == 1 for wrong in ("-1", "0", "inf", "x"))
    pd.concat([pd.read_csv(folder / "trials.csv"), pd.read_csv(rows)]).to_csv(tmp_path / "trials.csv", index=False)
    again = power_of_target(PowerRequest(tmp_path))["leak"]
    assert again.probability_at(0.7 * now.size_at(0.9)) > 0.88


def test_simulated_campaigns_are_counted_beside_the_prediction(folder, monkeypatch):
    asked_for: list[tuple[str, int]] = []

    def answered(_tests: object, effect: str, _values: object, seed: int) -> tuple[str, bool]:
        asked_for.append((effect, seed))
        return ("leak", True) if effect and seed % 2 else ("", False)

    monkeypatch.setattr(planning_stage.linear_power, "simulated_diagnosis", answered)
    nothing, leak = power_of_target(PowerRequest(folder, ("leak=0.01",), simulate=3)).simulated
    assert asked_for == [("", 1), ("", 2), ("", 3), ("leak", 1), ("leak", 2), ("leak", 3)]
    assert (nothing.count, nothing.campaigns) == (0, 3)
    assert (leak.count, leak.value, leak.named) == (2, pytest.approx(0.01), (("leak", 2),))


ROOT = Path(__file__).parents[2]
CHOSEN = (
    *(f"R{scale}_{kPa}kPa_1" for scale, kPa in ((1, "15p1"), (1, "19p4"), (1, "23p7"), (2, "12p7"), (2, "19p1"))),
    *(f"R{scale}_{kPa}kPa_1" for scale, kPa in ((2, "15p9"), (3, "17p3"), (3, "21"), (3, "24p7"), (4, "17"))),
    *("R4_19p7kPa_1", "R4_22p4kPa_1", "fig4_28kPa_1", "fig4_28kPa_2", "fig5_10g_41kPa_1", "fig5_50g_41kPa_1"),
)
PAPER_TABLES = "departures motions means positions pressures speeds speed_curves"
PAPER_HEADER = "row,where,quantity,setting,unit,published,as_printed,ours,ours_low_95,ours_high_95,mark,how,beside"


@pytest.mark.slow
def test_tables_and_figures_are_there_what_was_grown_is_answered_and_what_was_not_is_blank(tmp_path):
    experiment, results = tmp_path / "part", tmp_path / "results"
    trials = [trial for trial in read_experiment(ROOT / "data" / "paper").trials if trial.name in CHOSEN]
    assert len(trials) == len(CHOSEN)
    nature = campaigns.read_ground_truth(ROOT / "vinetrack" / "laboratory" / "paper.yaml")
    settings = "chamber_l: 3.7\npublished: simulated\ncandidates: [air_drag]\n"
    campaigns.write_experiment(campaigns.grow(trials, nature), experiment, settings)
    settings = ("--settings", '{"damping": {"resamples": 100}, "figures": {"formats": ["svg"], "dpi": 60}}')
    for stage in STAGES:
        said = succeed(stage, experiment, results, *settings)
    assert "not checkable" in said
    assert (results / "paper.csv").read_text(encoding="utf-8").splitlines()[0] == PAPER_HEADER
    for name in ("paper", *(f"paper_{one}" for one in PAPER_TABLES.split())):
        assert len(pd.read_csv(results / f"{name}.csv")) > 0, name
    for name in figures_of("paper"):
        assert "<svg" in (results / "figures" / f"{name}.svg").read_text(encoding="utf-8"), name

    rows = pd.read_csv(results / "paper.csv").set_index("row")
    assert rows.loc["n_both_axes", "ours"] == pytest.approx(0.37, abs=0.04)
    assert rows.loc["B_R4", "ours"] == pytest.approx(6.44, rel=0.05)
    assert 0 < rows.loc["position_rms_28kPa", "ours"] < 1.5
    assert 0 < rows.loc["final_speed_rms_41kPa", "ours"] < 0.5
    blank = ["position_rms_7kPa", "fast_vine_measured", "efficiency_power_of_wall"]
    assert rows.loc[blank, "ours"].isna().all()
    assert "9.52" in rows.loc["position_rms_7kPa", "beside"]  # what departures would cause needs no trial
    positions = pd.read_csv(results / "paper_positions.csv")
    assert positions["pressure_kPa"].tolist() == [28.0]
    assert rows.loc["position_rms_28kPa", "ours"] == pytest.approx(100 * positions["rms_mean_m"].iloc[0])


def test_the_difference_of_two_parameters_is_given_as_a_normal_deviate():
    # χ² with two degrees of freedom exceeds 5.9915 in 5 % of cases, a single number 1.96 standard errors as often.
    assert _deviate(np.array([np.sqrt(5.991465), 0.0]), np.eye(2)) == pytest.approx(1.959964, abs=1e-4)
    assert _deviate(np.zeros(2), np.eye(2)) == pytest.approx(0.0, abs=1e-9)
    # Far out both tails fall like exp(−s/2).
    assert _deviate(np.array([40.0, 0.0]), np.eye(2)) == pytest.approx(39.9, abs=0.15)
