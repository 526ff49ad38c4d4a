"""The command line: exit codes and files written; `diagnose`, `add` and `propose` on campaigns of known truth."""

from __future__ import annotations

import csv
import json
import re
import shutil
import subprocess
import sys
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pandas as pd
import pytest
from commanded import run, succeed
from explorer_campaign import FEW_CANDIDATES, SETTINGS, SMALL, make_experiment, make_results
from grown import FORCES, effect_file, grown
from grown import sheet as sheet_command
from hidden_truth import sheet

import vinetrack
from vinetrack.core.units import BASE_EFFECTS
from vinetrack.diagnosis.propose import add, propose
from vinetrack.dynamics.model import Model
from vinetrack.effects import catalogue, own_effects
from vinetrack.experiment.settings import read_experiment_settings
from vinetrack.laboratory.tracks import GroundTruth, damping_values, grow, write_experiment
from vinetrack.pipeline import effects_stage, model_stage
from vinetrack.pipeline.workflow import command_for_results

# The command line: exit codes, sentences, no tracebacks.
SHEET = "trial,track,diameter_mm,thickness_um,length_mm,pressure_kPa,yield_pressure_kPa\n"
TRACK = "time_s,position_m\n" + "".join(f"{i / 1000},{i / 1e4}\n" for i in range(20))


def experiment(folder: Path, rows: str = "a,a.csv,12,100,300,20,3\n") -> Path:
    folder.mkdir()
    (folder / "trials.csv").write_text(SHEET + rows)
    (folder / "a.csv").write_text(TRACK)
    return folder


def test_a_page_ends_without_waiting_for_its_thread():
    program = (
        "import atexit, sys, threading, time; atexit.register(print, 'waited')\n"
        "threading.Thread(target=time.sleep, args=(60,), daemon=True, name='vinetrack-fit').start()\n"
        "from vinetrack.cli.main import main; sys.argv = ['vinetrack', '--version']; main()"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60, check=False)
    assert (done.returncode, done.stdout) == (0, f"vinetrack {vinetrack.__version__}\n")


def test_check_names_file_trial_and_column_and_says_what_two_hundred_trials_share_once(tmp_path):
    assert run("check", experiment(tmp_path / "sound")).exit_code == 0
    rows = "".join(f"t{i},a.csv,12,100,300,9999,3\n" for i in range(200))
    done = run("check", experiment(tmp_path / "v", rows))
    assert done.exit_code == 1
    assert all(word in done.output for word in ("trials.csv", "t0 and 199 more", "pressure_kPa", "9999"))
    assert len(done.output.splitlines()) == 2


def test_effects_lists_every_effect_with_its_formula_and_units():
    output = run("effects").output
    assert all(effect.name in output and effect.formula in output for effect in catalogue().values())
    assert "N·(s/m)ⁿ" in output


def test_a_stage_that_cannot_begin_exits_with_its_code(tmp_path):
    folder = experiment(tmp_path / "v")
    without_input, no_json, out_of_bounds = "{}", "seed=3", '{"damping": {"resamples": 3}}'
    for settings, status in ((without_input, 1), (no_json, 2), (out_of_bounds, 1)):
        done = run("damping", folder, tmp_path, "--settings", settings)
        assert done.exit_code == status
        assert "Traceback" not in done.output
    for command in (("diagnose",), ("add", "air_drag"), ("check",)):
        assert run(*command, "nowhere").exit_code == 1


def test_an_unforeseen_fault_fails_its_trial_or_stage(tmp_path, monkeypatch):
    folder, log = experiment(tmp_path / "v"), tmp_path / "logs" / "a.log"
    monkeypatch.setattr("vinetrack.pipeline.trials.summarise_trial", Mock(side_effect=ZeroDivisionError("unforeseen")))
    succeed("trials", folder, tmp_path / "r", "--log", log)
    assert "ZeroDivisionError: unforeseen" in log.read_text()
    assert "1 trials, 1 failed" in run("damping", folder, tmp_path / "r").output
    monkeypatch.setattr("vinetrack.pipeline.trials.gather", Mock(side_effect=RuntimeError("the bottom fell out")))
    done = run("damping", folder, tmp_path / "r", "--log", log)
    assert done.exit_code == 1
    assert "Traceback" not in done.output
    assert "RuntimeError: the bottom fell out" in log.read_text()


# `vinetrack diagnose` and `vinetrack add` from a folder of tracks to files and sentences.
LADDER = (
    "model,added,rms_in_sample_m,rms_left_out_m,rms_highest_pressure_m,floor_m,excess_left_out_m,floor_sigma_m,partial"
)


@pytest.mark.slow
def test_diagnose_writes_the_contract_and_effects_are_added_and_saved(tmp_path, monkeypatch):
    trials = sheet()[6:]  # one vine at three pressures, twice each
    values = {**damping_values(trials), "reservoir_depletion.gamma": 1.2}
    scatter = {"damping_scatter": 0.02, "pressure_scatter": 0.005}
    nature = GroundTruth(effects=(*BASE_EFFECTS, "reservoir_depletion"), values=values, seed=7200, **scatter)
    folder, results, alone = (tmp_path / name for name in ("campaign", "results", "alone"))
    write_experiment(grow(trials, nature), folder, "chamber_l: 3.7\n" + FEW_CANDIDATES)

    # Straight from a folder of tracks to one file and no other.
    alone.mkdir()
    before = sorted(folder.rglob("*"))
    output = succeed("diagnose", folder, "--json", alone / "answer.json")
    assert output.startswith("missing: reservoir_depletion is missing")
    answer = json.loads((alone / "answer.json").read_text())
    assert answer["effects"] == ["reservoir_depletion"]
    assert answer["final_verdict"] == "adequate"
    assert [path.name for path in alone.iterdir()] == ["answer.json"]
    assert sorted(folder.rglob("*")) == before

    for stage in ("trials", "damping", "model"):
        succeed(stage, folder, results)
    (results / "provenance.json").write_text(json.dumps({"experiment": str(folder)}))

    def ladder() -> list[dict[str, str]]:
        return list(csv.DictReader((results / "ladder.csv").read_text().splitlines()))

    answer = json.loads((results / "diagnosis.json").read_text())
    keys = "effects answer_set explanation rounds final_verdict parameters cosines drift next_experiment"
    assert answer["verdict"] == "missing"
    assert set(keys.split()) <= set(answer)
    rows = ladder()
    assert ",".join(rows[0]) == LADDER
    assert [row["added"] for row in rows] == ["", "reservoir_depletion"]
    assert float(rows[1]["rms_left_out_m"]) < 0.5 * float(rows[0]["rms_left_out_m"])
    paths = sorted((results / "diagnosis" / "predictions").glob("*.csv"))
    assert len(paths) == 6
    assert paths[0].read_text().splitlines()[0] == "time_s,lead_position_m,model_before_m,model_after_m"

    added = []
    monkeypatch.setattr(model_stage, "add", lambda *given: added.append(add(*given)) or added[-1])
    output = succeed("add", "air_drag", results)
    assert re.search(r"Δχ² = -", output) is None
    assert "highest pressure" in output
    assert [row["added"] for row in ladder()] == ["", "reservoir_depletion", "air_drag"]
    assert {row["partial"] for row in ladder()} == {"False"}
    with monkeypatch.context() as again:
        again.setattr(model_stage, "add", lambda *_: added[0])  # the same once more, without the fits
        succeed("add", "air_drag", results)
    assert len(ladder()) == 3

    output = succeed("add", "reservoir_depletion", results, "--save")
    assert "reservoir_depletion" in (folder / "experiment.yaml").read_text()
    assert command_for_results(folder, results) in output.replace("\n", " ")
    assert run("add", "reservoir_depletion", results).exit_code == 1


# `vinetrack propose`: from a verdict of `unexplained` to an effect file that `vinetrack add` takes.
@pytest.mark.slow
def test_a_law_is_written_beside_the_experiment_and_added(tmp_path, monkeypatch):
    """Vines that feel a force that grows with time, and one candidate, which is not it."""
    values = {"hidden.a": -0.3, "hidden.kind": float(list(FORCES).index("growing"))}
    virtual = grown(sheet_command((4,), replicates=1), 103, own=[effect_file(tmp_path)], values=values)
    experiment, results = tmp_path / "bench", tmp_path / "results"
    write_experiment(virtual, experiment, "candidates: [air_drag]\n")
    for stage in ("trials", "damping", "model"):
        succeed(stage, experiment, results)
    (results / "provenance.json").write_text(json.dumps({"experiment": str(experiment)}))
    diagnosis = json.loads((results / "diagnosis.json").read_text())
    assert diagnosis["verdict"] == "unexplained"
    proposals = []
    monkeypatch.setattr(effects_stage, "propose", lambda *given: proposals.append(propose(*given)) or proposals[-1])
    succeed("propose", results)
    path = experiment / "proposed_time.py"
    effect = own_effects([path])["proposed_time"]
    assert "4 trials of bench" in effect.text
    monkeypatch.setattr(effects_stage, "propose", lambda *_: proposals[0])  # the same once more, without the search
    again = run("propose", results)
    assert again.exit_code == 1
    assert "exists already" in again.output
    assert run("add", shutil.copy(path, results), results, "--save").exit_code == 1
    # Without the rest of the catalogue, with which this effect would be compiled once more.
    monkeypatch.setattr("vinetrack.diagnosis.ladder.host_for", lambda model, more: Model((*model.effects, *more)))
    succeed("add", path, results, "--save")
    settings = read_experiment_settings(experiment / "experiment.yaml")
    assert (settings.model[-1], settings.effects) == ("proposed_time", ("proposed_time.py",))
    # Nothing is proposed where the verdict is another.
    for asked in diagnosis["rounds"]:
        asked["verdict"] = "adequate"
    other = diagnosis | {"verdict": "adequate", "final_verdict": "adequate"}
    (results / "diagnosis.json").write_text(json.dumps(other))
    done = run("propose", results)
    assert done.exit_code == 1
    assert "exists already" not in done.output
    assert "Traceback" not in done.output


# Every command that reads results, on those of films and of tracks, with a trial left out.
VINE = ("--diameter-mm", "24", "--length-mm", "280", "--pressure-kPa", "30", "--chamber-l", "2")
COMMANDS = (
    ("compare", "RESULTS"),
    ("diagnose", "RESULTS"),
    ("power", "RESULTS"),
    ("power", "RESULTS", "--effect", "air_drag"),
    ("add", "air_drag", "RESULTS"),
    ("predict", "--fit", "RESULTS", *VINE, "--thickness-um", "200"),
    ("design", "vine", "--fit", "RESULTS", "--pressure-kPa", "40", "--chamber-l", "2", "--samples", "50"),
    ("design", "reservoir", "--fit", "RESULTS", *VINE),
)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["films", "tracks"])
def test_commands_answer_for_every_kind_of_results(kind, tmp_path):
    settings = SETTINGS + FEW_CANDIDATES + "model: [pressure_drive, gravity, eversion_damping, yield_pressure, leak]\n"
    experiment = make_experiment(tmp_path / "vines", SMALL, settings)
    sheet = pd.read_csv(experiment / "trials.csv")
    # The second replicate of its condition, so that the condition stays.
    sheet = sheet.assign(use=np.where(sheet["trial"] == "d24_36kPa_2", "no", ""))
    sheet.to_csv(experiment / "trials.csv", index=False)
    results = make_results(experiment, tmp_path / "results" / "vines")
    if kind == "films":  # say so: their tracks state the slow error of a tracker, which is larger near a door
        (experiment / "film.mp4").touch()
        sheet.drop(columns="track").assign(video="film.mp4").to_csv(experiment / "trials.csv", index=False)
        for path in (results / "tracks").glob("*.csv"):
            table = pd.read_csv(path)
            slow_m = np.where(np.arange(len(table)) < 20, 4e-4, 1e-4)
            table.assign(lead_position_systematic_m=slow_m).to_csv(path, index=False)
    succeed("model", experiment, results)
    # A diagnosis asked for again writes all that the run wrote.
    paths = [results / "diagnosis.json", *(results / "diagnosis").glob("*.csv")]
    files = {path: path.read_bytes() for path in paths}
    assert results / "diagnosis" / "damping_laws.csv" in files
    succeed("diagnose", results)
    assert {path: path.read_bytes() for path in files} == files
    written = tmp_path / "answer.json"
    for command in COMMANDS:
        succeed(*(results if word == "RESULTS" else word for word in command), "--json", written)
        assert json.loads(written.read_text()), command
        written.unlink()
