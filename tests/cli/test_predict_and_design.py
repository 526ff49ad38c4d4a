"""`vinetrack predict` and `vinetrack design`: numbers, files, refusals."""

import json
import math

import pandas as pd
import pytest
from commanded import run, succeed
from lsoda_vine import N_TRUE, small_campaign
from own_effect import write_effect

import vinetrack as vt
from vinetrack.core.tables import write_json
from vinetrack.inference.fit_summary import summary_of
from vinetrack.pipeline.predict_stage import PredictionRequest, read_basis, read_range
from vinetrack.planning.prediction import CURVE_COLUMNS

# `vinetrack predict`: what it says, what it writes, and how it refuses.
FAST = ("--diameter-mm", 25, "--thickness-um", 100, "--length-mm", 400, "--pressure-kPa", 62)
SHEET = "trial,diameter_mm,thickness_um,length_mm,pressure_kPa,yield_pressure_kPa,payload_g\n"
FEW = ("--samples", 60)


def row(output: str, begins: str) -> list[str]:
    """Cells of the line that begins so."""
    line = next(line for line in output.splitlines() if line.strip().startswith(begins))
    return [cell.strip() for cell in line.split("  ") if cell.strip()]


def test_the_fast_vine_in_a_table_with_units_in_files_and_from_python(tmp_path):
    files = [tmp_path / name for name in ("a.png", "a.csv", "a.json")]
    output = succeed("predict", *FAST, *FEW, "--figure", files[0], "--csv", files[1], "--json", files[2])
    assert "25 mm × 100 µm × 400 mm at 62 kPa, no payload, growing straight down" in output
    assert row(output, "B ")[-1] == "guess: 6.44 (t/200 µm)(D/24 mm)^0.75"
    _, at, median, band, unit = row(output, "speed of the leading edge")
    assert (at, unit) == ("0.95", "m/s")
    low, high = (float(text) for text in band.split(" to "))
    assert low < float(median) < high

    assert files[0].read_bytes().startswith(b"\x89PNG")
    table = pd.read_csv(files[1])
    assert tuple(table.columns) == CURVE_COLUMNS
    assert (table["time_low_90_s"] <= table["time_s"]).all()
    assert (table["lead_velocity_m_s"] * 2).to_numpy() == pytest.approx(table["tail_velocity_m_s"].to_numpy())
    (entry,) = json.loads(files[2].read_text())
    assert {one["name"] for one in entry["quantities"]} >= {"speed of the leading edge", "tension of the tail"}

    trial = vt.planned_trial({"diameter_mm": "25", "thickness_um": "100", "length_mm": "400", "pressure_kPa": "62"})
    prediction = vt.predict_vine(vt.predictive_inputs(trial.trials[0]), samples=60)
    assert float(median) == pytest.approx(prediction.final.median, rel=0.01)
    assert math.isnan(prediction["hoop stress PD/2t"].y_over_L)


def test_numbers_that_are_given_have_no_error_unless_one_is_given():
    output = run("predict", *FAST, "--B", 3.3, "--n", 0.37, *FEW).output
    assert row(output, "n ")[2] == "–"
    output = run("predict", *FAST, "--B", 3.3, "--B-error", 10, "--n", 0.37, "--n-error", 0.02, *FEW).output
    assert " to " in row(output, "n ")[2]
    assert "B is given to 10 %" in output


def test_a_sheet_is_a_row_a_condition(tmp_path):
    (tmp_path / "trials.csv").write_text(SHEET + "a,24,200,280,14,3,0\nb,24,200,280,14,3,0\nc,24,200,280,28,3,35.6\n")
    output = run("predict", tmp_path, *FEW, "--figure", tmp_path / "a.svg").output
    assert row(output, "24mm-200um-280mm_14kPa_0g")[1] == "0.95"
    assert row(output, "24mm-200um-280mm_28kPa_35.6g")[1] == "1"
    assert len([line for line in output.splitlines() if line.startswith("24mm-200um-280mm_14kPa_0g")]) == 1
    assert "uncertainties included" in output


@pytest.mark.slow
def test_a_fit_is_believed_with_its_numbers_and_an_effect_of_an_experiments_own_comes_with_it(tmp_path):
    """The fit of two vines grown by scipy, seed 31."""
    results, experiment = tmp_path / "results", tmp_path / "mine"
    content = summary_of(vt.fit(vt.base_model(), small_campaign(seed=31)[0])).to_json()
    write_json(results / "fit.json", content)
    vine = ("--diameter-mm", 24, "--thickness-um", 200, "--length-mm", 280, "--pressure-kPa", 25)
    output = run("predict", *vine, "--fit", results, *FEW).output
    assert float(row(output, "n ")[1]) == pytest.approx(N_TRUE, abs=0.02)
    assert float(row(output, "B ")[1]) == pytest.approx(6.4, rel=0.06)
    assert "guess" not in output

    experiment.mkdir()
    write_effect(experiment)
    (experiment / "experiment.yaml").write_text("effects: [spring_line.py]\n")
    write_json(results / "fit.json", content | {"model": [*content["model"], "spring_line"]})
    write_json(results / "provenance.json", {"experiment": experiment.as_posix()})
    values = dict(zip((name[2:].replace("-", "_") for name in FAST[::2]), map(str, FAST[1::2]), strict=True))
    (inputs,) = read_basis(PredictionRequest(cells=values, results=results)).inputs
    assert inputs.model.names[-1] == "spring_line"
    write_json(results / "provenance.json", {"experiment": (tmp_path / "gone").as_posix()})
    assert run("predict", *FAST, "--fit", results).exit_code == 1


# `vinetrack design …`: what it says, what it writes, and how it refuses.
INJECTOR = ("--diameter-mm", 2.5, "--length-mm", 12.5, "--pressure-kPa", 48, "--chamber-l", 0.003534)
FASTEST = ("vine", "--pressure-kPa", 62, "--burst-fraction", 1, "--samples", 60)


def test_the_fast_vine_is_found_and_its_choice_of_film_is_open(tmp_path):
    assert read_range("diameter_mm", "5:25") == (0.005, 0.025)
    output = succeed("design", *FASTEST, "--figure", tmp_path / "a.svg")
    film, diameter, length, pressure, hoop, *_ = row(output, "100")
    assert (film, diameter, length, pressure, hoop) == ("100", "25", "400", "62", "7.75")
    assert (tmp_path / "a.svg").read_text().startswith("<?xml")


def test_the_answers_of_both_designs_are_numbers_in_json(tmp_path):
    said = run("design", "reservoir", *INJECTOR, "--json", tmp_path / "r.json", "--figure", tmp_path / "a.png").output
    assert "sweeps 0.0614 mL" in said
    assert (tmp_path / "a.png").exists()
    asked = next(e for e in json.loads((tmp_path / "r.json").read_text())["chambers"] if e["chamber"] == "asked about")
    assert asked["volume_l"] == pytest.approx(0.003534)
    assert list(asked["loss_of_gauge_pressure"].values()) == pytest.approx([0.053, 0.074], abs=5e-4)
    run("design", *FASTEST, "--json", tmp_path / "v.json")
    best = json.loads((tmp_path / "v.json").read_text())["films"][0]
    assert (best["thickness_um"], best["diameter_mm"]) == pytest.approx((100, 25), rel=0.01)
    speed = best["final_speed_m_s"]
    assert speed["low_90"] < speed["median"] < speed["high_90"]


MISSING_OR_WRONG = (
    ("predict", "--diameter-mm", 25),
    ("predict", *FAST[:-1], 62000),
    *(("predict", *FAST, "--effect", name) for name in ("air_drg", "reservoir_depletion")),
    ("predict", *FAST, "--fit", "nowhere"),
    ("predict", *FAST, "--figure", "a.doc"),
    ("predict", *FAST, "--chamber-l", 0),
    ("predict", *FAST, "--tail-slack", "loose"),
    ("design", "vine"),
    ("design", "vine", "--pressure-kPa", 62000),
    ("design", "vine", "--pressure-kPa", 2, "--yield-pressure-kPa", 3),
    ("design", "vine", "--pressure-kPa", 62, "--burst-fraction", 0.05, "--diameter-mm", 25, "--yield-pressure-kPa", 30),
    *(("design", "vine", "--pressure-kPa", 62, "--diameter-mm", text) for text in ("25:5", "5:15:25", "5000")),
    *(("design", "vine", "--pressure-kPa", 62, "--films-um", text) for text in ("2000", "thin", ",")),
    ("design", "vine", "--pressure-kPa", 62, "--effect", "reservoir_depletion"),
    ("design", "reservoir", "--diameter-mm", 25),
    ("design", "reservoir", *INJECTOR, "--thickness-um", 50, "--effect", "inlet_loss"),
)


@pytest.mark.slow
@pytest.mark.parametrize("arguments", MISSING_OR_WRONG)
def test_what_is_missing_or_wrong_is_refused_with_an_exit_code(arguments):
    done = run(*arguments)
    assert done.exit_code == (2 if "loose" in arguments else 1)
    assert "Traceback" not in done.output
    assert "internal error of the program" not in done.output
