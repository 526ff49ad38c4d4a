"""`vinetrack diagnose` and `vinetrack add` from a folder of tracks to files and sentences."""

from __future__ import annotations

import csv
import json
import re
from pathlib import Path

import pytest
from explorer_campaign import FEW_CANDIDATES
from hidden_truth import sheet
from typer.testing import CliRunner

from vinetrack.cli.main import app
from vinetrack.diagnosis import propose as fits
from vinetrack.diagnosis.propose import add
from vinetrack.laboratory.tracks import BASE, GroundTruth, damping_values, grow, write_experiment
from vinetrack.pipeline.workflow import command_for_results

LADDER = (
    "model,added,rms_in_sample_m,rms_left_out_m,rms_highest_pressure_m,floor_m,excess_left_out_m,floor_sigma_m,partial"
)


def run(*arguments: str | Path) -> tuple[int, str]:
    done = CliRunner().invoke(app, [str(one) for one in arguments])
    return done.exit_code, done.output


@pytest.fixture(scope="module")
def experiment(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("hidden") / "campaign"
    trials = sheet()[6:]  # one vine at three pressures, twice each
    nature = GroundTruth(
        effects=(*BASE, "reservoir_depletion"),
        values={**damping_values(trials), "reservoir_depletion.gamma": 1.2},
        damping_scatter=0.02,
        pressure_scatter=0.005,
        seed=7200,
    )
    write_experiment(grow(trials, nature), folder, "chamber_l: 3.7\n" + FEW_CANDIDATES)
    return folder


@pytest.fixture(scope="module")
def results(experiment: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("out") / "campaign"
    for stage in (("tracks",), ("gather",), ("model",)):
        if stage == ("model",):
            assert run("damping", folder)[0] == 0
        code, output = run(*stage, experiment, folder)
        assert code == 0, output
    assert run("diagnosis", experiment, folder)[0] == 0
    (folder / "provenance.json").write_text(json.dumps({"experiment": str(experiment)}))
    return folder


def test_straight_from_a_folder_of_tracks_to_one_file_and_no_other(experiment: Path, tmp_path: Path) -> None:
    before = sorted(experiment.rglob("*"))
    code, output = run("diagnose", experiment, "--json", tmp_path / "answer.json")
    assert code == 0, output
    assert output.startswith("missing: reservoir_depletion is missing")
    answer = json.loads((tmp_path / "answer.json").read_text())
    assert answer["effects"] == ["reservoir_depletion"]
    assert answer["final_verdict"] == "adequate"
    assert [path.name for path in tmp_path.iterdir()] == ["answer.json"]
    assert sorted(experiment.rglob("*")) == before


def test_the_stage_writes_the_contract(results: Path) -> None:
    answer = json.loads((results / "diagnosis.json").read_text())
    assert answer["verdict"] == "missing"
    assert {"effects", "answer_set", "explanation", "rounds", "final_verdict", "parameters", "cosines", "drift"} <= set(
        answer
    )
    assert "next_experiment" in answer
    with (results / "ladder.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert (results / "ladder.csv").read_text().splitlines()[0] == LADDER
    assert [row["added"] for row in rows] == ["", "reservoir_depletion"]
    assert float(rows[1]["rms_left_out_m"]) < 0.5 * float(rows[0]["rms_left_out_m"])


def test_every_trial_has_what_both_models_say_of_it(results: Path) -> None:
    paths = sorted((results / "diagnosis" / "predictions").glob("*.csv"))
    assert len(paths) == 6
    assert paths[0].read_text().splitlines()[0] == "time_s,lead_position_m,model_before_m,model_after_m"


def test_an_effect_put_in_by_hand_joins_the_history_of_the_ladder(
    results: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    added = []
    monkeypatch.setattr(fits, "add", lambda *given: added.append(add(*given)) or added[-1])
    code, output = run("add", "air_drag", results)
    assert code == 0, output
    assert "air_drag added to" in output
    assert re.search(r"Δχ² = -", output) is None
    assert "highest pressure" in output
    rows = list(csv.DictReader((results / "ladder.csv").read_text().splitlines()))
    assert [row["added"] for row in rows] == ["", "reservoir_depletion", "air_drag"]
    monkeypatch.setattr(fits, "add", lambda *_: added[0])  # the same once more, without the fits
    assert run("add", "air_drag", results)[0] == 0
    assert len(list(csv.DictReader((results / "ladder.csv").read_text().splitlines()))) == 3


def test_saved_it_stands_in_the_model_of_the_experiment(results: Path, experiment: Path) -> None:
    code, output = run("add", "reservoir_depletion", results, "--save")
    assert code == 0, output
    assert "reservoir_depletion" in (experiment / "experiment.yaml").read_text()
    assert command_for_results(experiment, results) in output.replace("\n", " ")
    code, output = run("add", "reservoir_depletion", results)
    assert code == 1
    assert "in the model already" in output


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (("diagnose", "nowhere"), "nowhere"),
        (("add", "air_drag", "nowhere"), "nowhere is not a folder"),
    ],
)
def test_a_wrong_folder_is_one_sentence(arguments: tuple[str, ...], sentence: str) -> None:
    code, output = run(*arguments)
    assert code == 1
    assert sentence in output
    assert "Traceback" not in output


def test_an_effect_misspelt_is_one_sentence_that_suggests(results: Path) -> None:
    code, output = run("add", "air_drgg", results)
    assert code == 1
    assert "air_drag" in output
