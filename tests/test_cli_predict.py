"""`vinetrack predict`: what it says, what it writes, and how it refuses."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pandas as pd
import pytest
from click.testing import Result
from lsoda_vine import N_TRUE, small_campaign
from typer.testing import CliRunner

import vinetrack as vt
from vinetrack.cli.main import app
from vinetrack.core.tables import write_json
from vinetrack.inference.fit_summary import summary_of
from vinetrack.pipeline.predict_stage import PredictionRequest, inputs_of, read_basis
from vinetrack.planning.prediction import CURVE_COLUMNS

FAST = ("--diameter-mm", 25, "--thickness-um", 100, "--length-mm", 400, "--pressure-kPa", 62)
SHEET = "trial,diameter_mm,thickness_um,length_mm,pressure_kPa,yield_pressure_kPa,payload_g\n"
FEW = ("--samples", 60)


def run(*arguments: object) -> Result:
    return CliRunner().invoke(app, [str(argument) for argument in arguments], catch_exceptions=False)


def row(output: str, begins: str) -> list[str]:
    """Cells of the line that begins so."""
    line = next(line for line in output.splitlines() if line.startswith(begins))
    return [cell.strip() for cell in line.split("  ") if cell.strip()]


@pytest.fixture(scope="module")
def fitted(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A results folder with the fit of two vines grown by scipy, seed 31."""
    folder = tmp_path_factory.mktemp("results") / "vines"
    found = vt.fit(vt.base_model(), small_campaign(seed=31)[0])
    write_json(folder / "fit.json", summary_of(found).to_json())
    return folder


def test_the_fast_vine_in_a_table_with_units() -> None:
    output = run("predict", *FAST, *FEW).output
    assert "25 mm × 100 µm × 400 mm at 62 kPa, no payload, growing straight down" in output
    assert row(output, "B ")[-1] == "guess: 6.44 (t/200 µm)(D/24 mm)^0.75"
    name, at, median, band, unit = row(output, "speed of the leading edge")
    assert (name, at, unit) == ("speed of the leading edge", "0.95", "m/s")
    low, high = (float(text) for text in band.split(" to "))
    assert low < float(median) < high
    assert "guess of P_y" in output
    assert "! the vine is about to burst" in output


def test_every_final_speed_says_where_it_was_taken() -> None:
    assert row(run("predict", *FAST, *FEW, "--final-at-fraction", 0.8).output, "speed of the leading edge")[1] == "0.8"


def test_a_payload_has_an_ejection_speed() -> None:
    output = run("predict", *FAST, "--payload-g", 10, *FEW).output
    assert row(output, "ejection speed of the payload")[1] == "1"


def test_numbers_that_are_given_have_no_error_unless_one_is_given() -> None:
    output = run("predict", *FAST, "--B", 3.3, "--n", 0.37, *FEW).output
    assert row(output, "n ")[2] == "–"
    output = run("predict", *FAST, "--B", 3.3, "--B-error", 10, "--n", 0.37, "--n-error", 0.02, *FEW).output
    assert " to " in row(output, "n ")[2]
    assert "B is given to 10 %" in output


def test_curves_figure_and_everything_are_written(tmp_path: Path) -> None:
    files = [tmp_path / name for name in ("a.png", "a.csv", "a.json")]
    done = run("predict", *FAST, *FEW, "--figure", files[0], "--csv", files[1], "--json", files[2])
    assert done.exit_code == 0, done.output
    assert files[0].read_bytes().startswith(b"\x89PNG")
    table = pd.read_csv(files[1])
    assert tuple(table.columns) == CURVE_COLUMNS
    assert (table["time_low_90_s"] <= table["time_s"]).all()
    assert (table["lead_velocity_m_s"] * 2).to_numpy() == pytest.approx(table["tail_velocity_m_s"].to_numpy())
    (entry,) = json.loads(files[2].read_text())
    assert {one["name"] for one in entry["quantities"]} >= {"speed of the leading edge", "tension of the tail"}


def test_a_sheet_is_a_row_a_condition(tmp_path: Path) -> None:
    (tmp_path / "trials.csv").write_text(SHEET + "a,24,200,280,14,3,0\nb,24,200,280,14,3,0\nc,24,200,280,28,3,35.6\n")
    output = run("predict", tmp_path, *FEW, "--figure", tmp_path / "a.svg").output
    assert row(output, "24mm-200um-280mm_14kPa_0g")[1] == "0.95"
    assert row(output, "24mm-200um-280mm_28kPa_35.6g")[1] == "1"
    assert len([line for line in output.splitlines() if line.startswith("24mm-200um-280mm_14kPa_0g")]) == 1
    assert "uncertainties included" in output


def test_options_of_the_vine_beside_a_sheet_are_refused(tmp_path: Path) -> None:
    (tmp_path / "trials.csv").write_text(SHEET + "a,24,200,280,14,3,0\n")
    done = run("predict", tmp_path, "--payload-g", 5)
    assert done.exit_code == 1
    assert "--payload-g '5' is given in addition to a sheet: write it in the sheet" in done.output


def test_a_fit_is_believed_with_its_numbers(fitted: Path) -> None:
    vine = ("--diameter-mm", 24, "--thickness-um", 200, "--length-mm", 280, "--pressure-kPa", 25)
    output = run("predict", *vine, "--fit", fitted, *FEW).output
    assert float(row(output, "n ")[1]) == pytest.approx(N_TRUE, abs=0.02)
    assert float(row(output, "B ")[1]) == pytest.approx(6.4, rel=0.06)
    assert f"B, n, P_y of {fitted.as_posix()}, with their covariance" in output
    assert "guess" not in output


def test_a_vine_that_the_fit_does_not_know_is_said_to_be_guessed(fitted: Path) -> None:
    output = run("predict", *FAST, "--fit", fitted, *FEW).output
    assert "no vine of" in output
    assert "scaled from 18mm-150um-210mm" in output


def test_an_effect_of_an_experiments_own_comes_with_its_fit(fitted: Path, tmp_path: Path) -> None:
    own = Path(__file__).parents[1] / "docs" / "own_effect.md"
    code = own.read_text().split("```python\n")[1].split("```")[0]
    experiment, results = tmp_path / "mine", tmp_path / "results"
    experiment.mkdir()
    (experiment / "spring_line.py").write_text(code)
    (experiment / "experiment.yaml").write_text("effects: [spring_line.py]\n")
    content = json.loads((fitted / "fit.json").read_text())
    content["model"].append("spring_line")
    write_json(results / "fit.json", content)
    write_json(results / "provenance.json", {"experiment": experiment.as_posix()})
    values = dict(zip((name[2:].replace("-", "_") for name in FAST[::2]), map(str, FAST[1::2]), strict=True))
    (inputs,) = inputs_of(read_basis(PredictionRequest(cells=values, results=results)))
    assert inputs.model.names[-1] == "spring_line"
    write_json(results / "provenance.json", {"experiment": (tmp_path / "gone").as_posix()})
    done = run("predict", *FAST, "--fit", results)
    assert done.exit_code == 1
    assert "spring_line, an effect of its experiment, which is no longer in" in done.output


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--diameter-mm", 25), "--thickness-um is missing"),
        ((*FAST[:-1], 62000), "62000 Pa is 62 kPa"),
        ((*FAST, "--effect", "air_drg"), "Did you mean 'air_drag'"),
        (
            (*FAST, "--effect", "reservoir_depletion"),
            "reservoir_depletion needs it: give it as --chamber-l",
        ),
        ((*FAST, "--fit", "nowhere"), "nowhere/fit.json does not exist"),
        ((*FAST, "--figure", "a.doc"), "end it in one of .png, .svg, .pdf"),
        ((*FAST, "--chamber-l", 0), "--chamber-l '0' is not above 0 litres"),
    ],
)
def test_refusals_are_sentences(arguments: tuple[object, ...], words: str) -> None:
    done = run("predict", *arguments)
    assert done.exit_code == 1
    assert words in done.output
    assert "Traceback" not in done.output


def test_an_unknown_way_of_the_tail_is_refused() -> None:
    done = run("predict", *FAST, "--tail-slack", "loose")
    assert done.exit_code == 2
    assert "neither taut nor free" in done.output


def test_a_vine_that_never_gets_there_says_never() -> None:
    output = run("predict", *FAST[:-1], 1, "--yield-pressure-kPa", 3, *FEW).output
    assert row(output, "time to get there")[2] == "never"
    assert "lies below the yield pressure" in output


def test_python_predicts_what_the_command_does() -> None:
    trial = vt.planned_trial({"diameter_mm": "25", "thickness_um": "100", "length_mm": "400", "pressure_kPa": "62"})
    prediction = vt.predict_vine(vt.predictive_inputs(trial.trials[0]), samples=60)
    shown = row(run("predict", *FAST, *FEW).output, "speed of the leading edge")[2]
    assert float(shown) == pytest.approx(prediction.final.median, rel=0.01)
    assert math.isnan(prediction["hoop stress PD/2t"].y_over_L)
