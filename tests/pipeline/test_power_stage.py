"""`vinetrack power` on a sheet that nobody has filmed."""

from pathlib import Path

import pandas as pd
import pytest
from commanded import succeed

from vinetrack.diagnosis.campaign_power import SimulatedDiagnosis
from vinetrack.pipeline import power_stage
from vinetrack.pipeline.power_stage import PowerRequest, power_of_target

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
