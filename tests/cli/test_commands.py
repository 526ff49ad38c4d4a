"""The command line: exit codes, files and numbers; `diagnose`, `add`, `propose`, `predict` and `design`."""

import csv
import json
import math
import shutil
import subprocess
import sys
from dataclasses import replace
from unittest.mock import Mock

import numpy as np
import pandas as pd
import pytest
from commanded import run, succeed
from explorer_campaign import FEW_CANDIDATES, SETTINGS, SMALL, make_experiment, make_results
from grown import FORCES, effect_file, grown, sheet, tubes
from hand_diagnosis import number
from hand_sheet import one_vine
from own_effect import write_effect

import vinetrack
import vinetrack as vt
from vinetrack.core.tables import write_json
from vinetrack.core.units import BASE_EFFECTS
from vinetrack.diagnosis import propose as proposing
from vinetrack.diagnosis.propose import fit_with, propose
from vinetrack.dynamics.model import Model, probe
from vinetrack.effects import own_effects
from vinetrack.experiment.settings import read_experiment_settings
from vinetrack.laboratory.campaigns import GroundTruth, damping_values, grow, write_experiment
from vinetrack.pipeline.planning_stage import read_basis, read_si_range
from vinetrack.pipeline.workflow import command_for_results
from vinetrack.planning.predictive_inputs import predictive_inputs


def test_a_page_ends_without_waiting_for_its_thread():
    program = (
        "import atexit, sys, threading, time; atexit.register(print, 'waited')\n"
        "threading.Thread(target=time.sleep, args=(60,), daemon=True, name='vinetrack-fit').start()\n"
        "from vinetrack.cli.main import main; sys.argv = ['vinetrack', '--version']; main()"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60, check=False)
    assert (done.returncode, done.stdout) == (0, f"vinetrack {vinetrack.__version__}\n")


def test_a_stage_that_cannot_begin_exits_with_its_code(tmp_path):
    folder = one_vine(tmp_path / "v")
    without_input, no_json, out_of_bounds = "{}", "seed=3", '{"damping": {"resamples": 3}}'
    for settings, status in ((without_input, 1), (no_json, 2), (out_of_bounds, 1)):
        done = run("model", folder, tmp_path, "--settings", settings)
        assert done.exit_code == status
        assert "Traceback" not in done.output
    for command in (("diagnose",), ("add", "air_drag"), ("check",)):
        assert run(*command, "nowhere").exit_code == 1
    assert run("check", folder).exit_code == 0
    assert run("check", one_vine(tmp_path / "w", "t,a.csv,12,100,300,9999,3\n")).exit_code == 1


def test_an_unforeseen_fault_fails_its_trial_or_stage(tmp_path, monkeypatch):
    folder, log = one_vine(tmp_path / "v"), tmp_path / "logs" / "a.log"
    monkeypatch.setattr(
        "vinetrack.pipeline.analysis.summarise_trial", Mock(side_effect=ZeroDivisionError("unforeseen"))
    )
    succeed("trials", folder, tmp_path / "r", "--log", log)
    assert "ZeroDivisionError: unforeseen" in log.read_text()
    assert "1 of 1 trial failed" in run("model", folder, tmp_path / "r").output
    monkeypatch.setattr("vinetrack.pipeline.analysis.gather", Mock(side_effect=RuntimeError("the bottom fell out")))
    done = run("model", folder, tmp_path / "r", "--log", log)
    assert done.exit_code == 1
    assert "Traceback" not in done.output
    assert "RuntimeError: the bottom fell out" in log.read_text()


# `vinetrack diagnose` and `vinetrack add` from a folder of tracks to files and sentences.
LADDER = (
    "model,added,rms_in_sample_m,rms_left_out_m,rms_highest_pressure_m,floor_m,excess_left_out_m,"
    "expected_m,expected_low_m,expected_high_m,partial"
)


@pytest.mark.slow
def test_diagnose_writes_the_contract_and_effects_are_added_and_saved(tmp_path, monkeypatch):
    trials = tubes()[6:]  # one vine at three pressures, twice each
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

    for stage in ("trials", "model"):
        succeed(stage, folder, results)
    (results / "provenance.json").write_text(json.dumps({"experiment": str(folder), "settings": {}}))

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

    succeed("add", "air_drag", results, "--json", tmp_path / "added.json")
    added = json.loads((tmp_path / "added.json").read_text())["ladder"]
    assert [row["added"] for row in added] == ["", "air_drag"]
    assert len(ladder()) == 2  # that of the diagnosis stays

    output = succeed("add", "reservoir_depletion+leak", results, "--save")
    assert read_experiment_settings(folder / "experiment.yaml").model[-2:] == ("reservoir_depletion", "leak")
    assert command_for_results(folder, results) in output.replace("\n", " ")
    succeed("diagnose", results)  # of the model that was saved, with its fit
    assert json.loads((results / "fit.json").read_text())["model"][-2:] == ["reservoir_depletion", "leak"]
    assert run("add", "reservoir_depletion", results).exit_code == 1
    monkeypatch.setattr(proposing, "fit_with", lambda *given: replace(fit_with(*given), converged=False))
    assert run("add", "air_drag", results, "--save").exit_code == 1
    assert "air_drag" not in read_experiment_settings(folder / "experiment.yaml").model


# `vinetrack propose`: from a verdict of `unexplained` to an effect file that `vinetrack add` takes.
@pytest.mark.slow
def test_a_law_is_written_beside_the_experiment_and_added(tmp_path, monkeypatch):
    """Vines that feel a force that grows with time, and one candidate, which is not it."""
    values = {"hidden.a": -0.3, "hidden.kind": float(list(FORCES).index("growing"))}
    virtual = grown(sheet((4,), replicates=1), 103, own=[effect_file(tmp_path)], values=values)
    experiment, results = tmp_path / "bench", tmp_path / "results"
    write_experiment(virtual, experiment, "candidates: [air_drag]\n")
    for stage in ("trials", "model"):
        succeed(stage, experiment, results)
    (results / "provenance.json").write_text(json.dumps({"experiment": str(experiment)}))
    diagnosis = json.loads((results / "diagnosis.json").read_text())
    assert diagnosis["verdict"] == "unexplained"
    proposals = []
    monkeypatch.setattr(proposing, "propose", lambda *given: proposals.append(propose(*given)) or proposals[-1])
    succeed("propose", results)
    path = experiment / "proposed_time.py"
    effect = own_effects([path])["proposed_time"]
    assert "4 trials of bench" in effect.text
    monkeypatch.setattr(proposing, "propose", lambda *_: proposals[0])  # the same once more, without the search
    again = run("propose", results)
    assert again.exit_code == 1
    assert "exists already" in again.output
    assert run("add", shutil.copy(path, results), results, "--save").exit_code == 1
    # Without the rest of the catalogue, with which this effect would be compiled once more.
    monkeypatch.setattr(
        "vinetrack.diagnosis.ladder.host_for", lambda model, more: Model((*model.effects, probe(), *more))
    )
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
VINE = "--diameter-mm 24 --length-mm 280 --pressure-kPa 30 --chamber-l 2"
COMMANDS = f"""compare RESULTS; diagnose RESULTS; power RESULTS; power RESULTS air_drag; add air_drag RESULTS;
predict --fit RESULTS {VINE} --thickness-um 200; design reservoir --fit RESULTS {VINE};
design vine --fit RESULTS --pressure-kPa 40 --chamber-l 2 --samples 50"""


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
    for command in COMMANDS.split(";"):
        succeed(*(results if word == "RESULTS" else word for word in command.split()), "--json", written)
        assert json.loads(written.read_text()), command
        written.unlink()


# `vinetrack predict`: what it says, what it writes, and how it refuses.
FAST = ("--diameter-mm", 25, "--thickness-um", 100, "--length-mm", 400, "--pressure-kPa", 62)
PLANNED_SHEET = "trial,diameter_mm,thickness_um,length_mm,pressure_kPa,yield_pressure_kPa,payload_g\n"
FEW = ("--samples", 60)


def row(output: str, begins: str) -> list[str]:
    """Cells of the line that begins so."""
    line = next(line for line in output.splitlines() if line.strip().startswith(begins))
    return [cell.strip() for cell in line.split("  ") if cell.strip()]


def test_the_fast_vine_in_a_table_with_units_in_files_and_from_python(tmp_path):
    files = [tmp_path / name for name in ("a.png", "a.csv", "a.json")]
    output = succeed("predict", *FAST, *FEW, "--figure", files[0], "--csv", files[1], "--json", files[2])
    median = row(output, "speed of the leading edge")[2]
    assert files[0].read_bytes().startswith(b"\x89PNG")
    table = pd.read_csv(files[1])
    assert {"condition", "y_over_L", "lead_position_m", "tension_N", "pressure_kPa"} < {*table.columns}
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
    rows = "a,24,200,280,14,3,0\nb,24,200,280,14,3,0\nc,24,200,280,28,3,35.6\n"
    (tmp_path / "trials.csv").write_text(PLANNED_SHEET + rows)
    (tmp_path / "experiment.yaml").write_text(f"model: [{', '.join(BASE_EFFECTS)}, tail_friction]\n")
    output = run("predict", tmp_path, *FEW, "--figure", tmp_path / "a.svg").output
    assert [row(output, f"24mm-200um-280mm_{one}")[1] for one in ("14kPa_0g", "28kPa_35.6g")] == ["0.95", "1"]
    assert "μ_s w: 0.500 N/m" in output
    assert len([line for line in output.splitlines() if line.startswith("24mm-200um-280mm_14kPa_0g")]) == 1


def test_with_a_fit_comes_an_effect_of_its_experiments_own(tmp_path):
    results, experiment = tmp_path / "results", tmp_path / "mine"
    experiment.mkdir()
    write_effect(experiment)
    (experiment / "experiment.yaml").write_text("effects: [spring_line.py]\n")
    vine = "25mm-100um-400mm"
    numbers = [number("eversion_damping.n", "n", 0.37, 0.01), number("eversion_damping.B", "B", 3.3, 0.1, vine=vine)]
    content = {"model": [*BASE_EFFECTS, "spring_line"], "numbers": numbers, "covariance": [[1e-4, 0.0], [0.0, 0.01]]}
    write_json(results / "fit.json", content)
    write_json(results / "provenance.json", {"experiment": experiment.as_posix()})
    values = dict(zip((name[2:].replace("-", "_") for name in FAST[::2]), map(str, FAST[1::2]), strict=True))
    planned, stated, fit, _ = read_basis(cells=values, results=results)
    assert predictive_inputs(planned.trials[0], stated, fit).model.names[-1] == "spring_line"
    write_json(results / "provenance.json", {"experiment": (tmp_path / "gone").as_posix()})
    assert run("predict", *FAST, "--fit", results).exit_code == 1


# `vinetrack design …`: what it says, what it writes, and how it refuses.
INJECTOR = ("--diameter-mm", 2.5, "--length-mm", 12.5, "--pressure-kPa", 48, "--chamber-l", 0.003534)
FASTEST = ("vine", "--pressure-kPa", 62, "--burst-fraction", 1, "--samples", 60)


def test_the_answers_of_both_designs_are_numbers_in_json(tmp_path):
    said = run("design", "reservoir", *INJECTOR, "--json", tmp_path / "r.json", "--figure", tmp_path / "a.png").output
    assert "sweeps 0.0614 mL" in said
    assert (tmp_path / "a.png").exists()
    asked = next(e for e in json.loads((tmp_path / "r.json").read_text())["chambers"] if e["chamber"] == "asked about")
    assert asked["volume_l"] == pytest.approx(0.003534)
    assert list(asked["loss_of_gauge_pressure"].values()) == pytest.approx([0.053, 0.074], abs=5e-4)
    assert read_si_range("diameter_mm", "5:25") == (0.005, 0.025)
    succeed("design", *FASTEST, "--json", tmp_path / "v.json", "--figure", tmp_path / "a.svg")
    assert (tmp_path / "a.svg").read_text().startswith("<?xml")
    best = json.loads((tmp_path / "v.json").read_text())["films"][0]
    assert (best["thickness_um"], best["diameter_mm"]) == pytest.approx((100, 25), rel=0.01)
    speed = best["final_speed_m_s"]
    assert speed["low_90"] < speed["median"] < speed["high_90"]


def test_a_place_that_cannot_be_written_and_the_wrong_folder_are_named(tmp_path):
    """A folder for a file, as output or log; results where an experiment is wanted, and the other way round."""
    results, experiment = tmp_path / "results", tmp_path / "vines"
    for folder, name in ((results, "experiment.json"), (experiment, "trials.csv")):
        folder.mkdir()
        (folder / name).write_text(json.dumps({"experiment": str(experiment)}))
    wrong = {
        ("settings", "--json", tmp_path): tmp_path,
        ("settings", "--log", tmp_path): tmp_path,
        ("check", results): experiment,
        ("compare", experiment): "results/vines",
    }
    for arguments, named in wrong.items():
        done = run(*arguments)
        assert done.exit_code == 1
        assert str(named) in done.output.replace("\n", "")
        assert "internal error of the program" not in done.output


MISSING_OR_WRONG = (
    ("predict", "--diameter-mm", 25),
    ("predict", *FAST[:-1], 62000),
    *(("predict", *FAST, "--effect", name) for name in ("air_drg", "reservoir_depletion")),
    ("predict", *FAST, "--fit", "nowhere"),
    ("predict", *FAST, "--figure", "a.doc"),
    ("predict", *FAST, "--chamber-l", 0),
    ("design", "vine"),
    ("design", "vine", "--pressure-kPa", 62000),
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
    assert done.exit_code == (2 if "a.doc" in arguments else 1)
    assert done.exit_code == 2 or done.output.startswith("error: ")
    assert "Traceback" not in done.output
    assert "internal error of the program" not in done.output
