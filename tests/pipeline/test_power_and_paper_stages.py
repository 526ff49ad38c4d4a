"""`vinetrack power` on a sheet that nobody has filmed; `vinetrack paper` on a small part of its campaign."""

from pathlib import Path

import pandas as pd
import pytest
from commanded import run, succeed

from vinetrack.diagnosis.campaign_power import SimulatedDiagnosis
from vinetrack.experiment.folder import read_experiment
from vinetrack.figures.registry import figures_of
from vinetrack.laboratory.tracks import grow, read_ground_truth, write_experiment
from vinetrack.pipeline import power_stage
from vinetrack.pipeline.power_stage import PowerRequest, power_of_target
from vinetrack.pipeline.workflow import PAPER_TABLES

SHEET = (
    "trial,diameter_mm,thickness_um,length_mm,pressure_kPa,yield_pressure_kPa\n"
    "a1,24,200,200,14,3\na2,24,200,200,14,3\nb1,24,200,200,34,3\nb2,24,200,200,34,3\n"
)
SETTINGS = "candidates: [leak, air_drag, payload_drag]\n"


def planned(folder: Path, more: str = "") -> Path:
    (folder / "trials.csv").write_text(SHEET)
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
    assert "of campaigns" in succeed("power", tmp_path, "--effect", size, "--reach", "0.9", "--sheet", rows)
    pd.concat([pd.read_csv(folder / "trials.csv"), pd.read_csv(rows)]).to_csv(tmp_path / "trials.csv", index=False)
    again = power_of_target(PowerRequest(tmp_path))["leak"]
    assert again.probability_at(0.7 * now.size_at(0.9)) > 0.88


def test_simulated_campaigns_are_counted_beside_the_prediction(folder, monkeypatch):
    asked_for: list[tuple[str, int]] = []

    def answered(_design: object, effect: str, _values: object, seed: int) -> SimulatedDiagnosis:
        asked_for.append((effect, seed))
        verdict, names = ("missing", ("leak",)) if effect and seed % 2 else ("adequate", ())
        return SimulatedDiagnosis(effect, verdict, names)

    monkeypatch.setattr(power_stage, "simulated_diagnosis", answered)
    nothing, leak = power_of_target(PowerRequest(folder, ("leak=0.01",), simulate=3)).simulated
    assert asked_for == [("", 1), ("", 2), ("", 3), ("leak", 1), ("leak", 2), ("leak", 3)]
    assert (nothing.alarms.count, nothing.alarms.campaigns) == (0, 3)
    assert (leak.detections.count, leak.value, leak.named) == (2, pytest.approx(0.01), (("leak", 2),))


@pytest.mark.slow
def test_the_trials_that_would_reveal_most_are_recommended(tmp_path):
    power = power_of_target(
        PowerRequest(planned(tmp_path, "limits: {pressure_kPa: 14:40, trials: 2}\n"), recommend=True)
    )
    assert power.recommended is not None
    assert sum(trial["replicates"] for trial in power.to_json()["recommended_trials"]) == 2
    assert any(power.recommended.then[name].size_at(0.9) < power[name].size_at(0.9) for name in ("leak", "air_drag"))


ROOT = Path(__file__).parents[2]
CHOSEN = (
    *(f"R{scale}_{kPa}kPa_1" for scale, kPa in ((1, "15p1"), (1, "19p4"), (1, "23p7"), (2, "12p7"), (2, "19p1"))),
    *(f"R{scale}_{kPa}kPa_1" for scale, kPa in ((2, "15p9"), (3, "17p3"), (3, "21"), (3, "24p7"), (4, "17"))),
    *("R4_19p7kPa_1", "R4_22p4kPa_1", "fig4_28kPa_1", "fig4_28kPa_2", "fig5_10g_41kPa_1", "fig5_50g_41kPa_1"),
)
HEADER = (
    "row,where,quantity,setting,unit,published,as_printed,ours,ours_low_95,ours_high_95,mark,how,beside"  # the contract
)


@pytest.mark.slow
def test_tables_and_figures_are_there_what_was_grown_is_answered_and_what_was_not_is_blank(tmp_path):
    experiment, results = tmp_path / "part", tmp_path / "results"
    trials = [trial for trial in read_experiment(ROOT / "data" / "paper").trials if trial.name in CHOSEN]
    assert len(trials) == len(CHOSEN)
    nature = read_ground_truth(ROOT / "vinetrack" / "laboratory" / "paper.yaml")
    write_experiment(grow(trials, nature), experiment, "chamber_l: 3.7\npublished: simulated\ncandidates: [air_drag]\n")
    missed = run("paper", experiment, results)
    assert missed.exit_code == 1
    assert "does not exist" in missed.output
    settings = ("--settings", '{"damping": {"resamples": 100}, "figures": {"formats": ["svg"], "dpi": 60}}')
    for stage in ("trials", "damping", "model", "paper"):
        said = succeed(stage, experiment, results, *settings)
    assert "not checkable" in said
    assert (results / "paper.csv").read_text(encoding="utf-8").splitlines()[0] == HEADER
    for name in PAPER_TABLES:
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
