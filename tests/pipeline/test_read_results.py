"""What a results folder holds, read back: fit, diagnosis and its tables, pictures, contradictions of the sheet."""

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from hand_diagnosis import BASE, VERDICTS, diagnosis, ladder, refused

from vinetrack.core.records import Trial, plain_track
from vinetrack.core.tables import write_json
from vinetrack.diagnosis.result import Diagnosis
from vinetrack.figures import registry as drawn
from vinetrack.figures.registry import FigureTables
from vinetrack.inference.fit_result import BetweenTrialSpread, FitSummary, Number, TrialEstimates
from vinetrack.narrative.verdict_text import verdict_sentence
from vinetrack.paper import motions
from vinetrack.pipeline.analysis import all_steps, propose_effect, sheet_contradictions, with_contradictions
from vinetrack.pipeline.planning_stage import choose_fit
from vinetrack.planning.predictive_inputs import damping_prior
from vinetrack.results import Results, ResultsError, read_diagnosis, read_fit, read_source_experiment


def test_a_fit_comes_back_as_it_was_written_and_one_that_is_none_of_ours_is_one_sentence(tmp_path):
    free = math.nan
    damping = Number("eversion_damping.B", "v", "B", "N·(s/m)ⁿ", 6.4, 0.1, 6.2, 6.6, free, "linear")
    onset = Number("yield_pressure.P_y", "", "P_y", "Pa", 3000.0, free, free, free, free, "none", 0.0)
    fit = FitSummary(
        names=("gravity", "eversion_damping"), numbers=(damping, onset), covariance=np.array([[0.01, 0], [0, free]]),
        spreads={"B": BetweenTrialSpread(0.03, True)}, noise_m=1e-4, noise_correlation=0.4, chi2_per_dof=1.2,
        log_likelihood=-12.5, converged=True, messages=("a",), warnings=("b",), left_out={"c": "never moves"},
        trials={"t": TrialEstimates(*(0.1 * i for i in range(8)))},
    )  # fmt: skip
    results = Results(tmp_path)
    write_json(results.fit, fit.to_json())
    back = read_fit(results)
    write_json(tmp_path / "again.json", back.to_json())
    assert (tmp_path / "again.json").read_text() == results.fit.read_text()
    assert back["B"].value == 6.4
    assert back.fitted_values == {"eversion_damping.B": {"v": 6.4}, "yield_pressure.P_y": 3000.0}
    assert [trial.release_sigma_s for trial in back.trials.values()] == [0.1]
    assert str(back) == str(fit)
    for content in ("[]", '{"model": 3}', '{"numbers": [1]}'):
        results.fit.write_text(content, encoding="utf-8")
        with pytest.raises(ResultsError, match="delete it and run `vinetrack run` again"):
            read_fit(results)
    write_json(results.provenance, {})
    with pytest.raises(ResultsError, match="such as"):  # the folder above holds results
        read_fit(Results(tmp_path.parent))
    with pytest.raises(ResultsError, match="cannot be read"):
        read_source_experiment(tmp_path)


def test_a_diagnosis_comes_back_as_it_was_written_and_a_refused_one_has_no_verdict(tmp_path):
    for verdict in VERDICTS:
        written = json.loads(json.dumps(Diagnosis.from_json(diagnosis(verdict)).to_json(), default=float))
        again = json.loads(json.dumps(Diagnosis.from_json(written).to_json(), default=float))
        assert json.dumps(again) == json.dumps(written)
        kept = ("verdict", "effects", "answer_set", "final_verdict", "where", "cosines")
        assert {key: again[key] for key in kept} == {key: diagnosis(verdict)[key] for key in kept}
    write_json(Results(tmp_path).diagnosis, refused("no trial moves"))
    back = read_diagnosis(Results(tmp_path))
    assert (back and (back.verdict, back.final_verdict, back.refused)) == ("", "", "no trial moves")


# What a diagnosis left in a results folder, read back for pictures and page: whole, in parts, and not there.
RELEASE_S, ORIGIN_M = 0.05, 0.2
TRIALS = {"a": "slow", "b": "slow", "c": "fast"}


def conditions() -> pd.DataFrame:
    alike = Trial(name="a", diameter_m=0.012, pressure_Pa=24e3, payload_kg=0.0)  # but for what only their names say
    labels = drawn.condition_labels({"12mm_0deg": alike, "12mm_90deg": alike})
    labels = dict(zip(("slow", "fast"), labels.values(), strict=True))
    rows = [(trial, "v", condition, labels[condition]) for trial, condition in TRIALS.items()]
    return pd.DataFrame(rows, columns=["trial", "vine", "condition", "condition_label"])


def folder(path: Path, **changes: object) -> Results:
    """Trials that grow 0.2 m in 0.1 s, of which the model before misses a part at the end, the one after nothing."""
    results, content = Results(path), diagnosis(**changes)
    (path / "diagnosis" / "predictions").mkdir(parents=True)
    (path / "comparison").mkdir()
    (path / "diagnosis.json").write_text(json.dumps(content))
    ladder("", *content["effects"]).to_csv(results.ladder, index=False)
    since_s = np.arange(-20, 101) * 1e-3
    growth_m = 2.0 * np.maximum(since_s, 0)
    for condition, off_m in (("slow", 0.02), ("fast", 0.004)):
        parts, before_m, seen_m = [], growth_m * (1 - off_m / 0.2), ORIGIN_M + growth_m
        table = pd.DataFrame({"time_s": since_s + RELEASE_S, "lead_position_m": seen_m})
        for trial in (t for t, c in TRIALS.items() if c == condition):
            said = table.assign(model_before_m=ORIGIN_M + before_m, model_after_m=seen_m)
            said.to_csv(results.predictions(trial), index=False)
            since = {"time_s": since_s, "lead_position_m": growth_m, "model_position_m": before_m}
            parts.append(pd.DataFrame({"trial": trial, **since}))
        pd.concat(parts).to_csv(results.trajectories(condition), index=False)
    rows = [("v", name, low, low + 0.1, 0.011, 0.001) for name in ("slow", "fast", "") for low in (0.0, 0.1)]
    columns = ["vine", "condition", "from_m", "to_m", "mean_residual_m", "sigma_m"]
    pd.DataFrame(rows, columns=columns).to_csv(path / "diagnosis" / "along_position.csv", index=False)
    return results


def tables_of(results: Results, trials: pd.DataFrame) -> drawn.DiagnosisTables | None:
    tables = FigureTables(results.folder, ())
    tables.trials = trials
    return tables.diagnosed


def test_predictions_count_from_release_and_origin(tmp_path):
    trials = drawn.predicted_trials(folder(tmp_path / "r"), conditions())
    one = trials[trials["trial"] == "a"]
    assert one["time_s"].iloc[0] == pytest.approx(-0.02)
    end = one[["lead_position_m", "model_before_m", "model_after_m"]].iloc[-1]
    assert end.to_numpy() == pytest.approx([0.2, 0.18, 0.2])


def test_the_worst_condition_is_shown_and_misfits_stand_along_the_growth_with_their_errors(tmp_path):
    found = tables_of(folder(tmp_path / "r"), conditions())
    assert found is not None
    assert found.worst == "12 mm, 24 kPa, 0deg"
    assert set(found.before_after["trial"]) == {"a", "b"}
    assert drawn.worst_condition(found.before_after.iloc[:0]) == ""
    assert set(found.where["condition_label"]) == {"12 mm, 24 kPa, 0deg", "12 mm, 24 kPa, 90deg"}
    slow = found.where[found.where["condition"] == "slow"]
    assert slow[["growth_from", "growth_to"]].to_numpy().tolist() == [[0.0, 0.5], [0.5, 1.0]]
    assert slow[["misfit_m", "scatter_m", "n_trials"]].to_numpy().tolist() == [[0.011, 0.001, 2]] * 2


def test_steps_of_earlier_runs_stand_before_those_of_a_model_that_was_saved_on_the_same_trials(tmp_path):
    results = folder(tmp_path / "r")
    former = ladder("", "leak").assign(model=["+".join(BASE), "+".join([*BASE, "leak"])])
    former.to_csv(results.ladder, index=False)
    now = former[1:].assign(added="").reset_index(drop=True)
    assert all_steps(results, now)["added"].tolist() == ["", "leak"]
    results.kept_steps.parent.mkdir()
    all_steps(results, now).to_csv(results.kept_steps, index=False)
    results.ladder.unlink()  # as a run does before it writes it again
    assert all_steps(results, now)["added"].tolist() == ["", "leak"]
    assert all_steps(results, now.assign(rms_in_sample_m=1.0))["added"].tolist() == [""], "of other trials"
    nearly = now.assign(rms_in_sample_m=1.005 * now["rms_in_sample_m"])
    assert all_steps(results, nearly)["rms_in_sample_m"].iloc[-1] == nearly["rms_in_sample_m"][0], "as this run has it"
    read = replace(read_diagnosis(results), ladder=now)
    assert len(drawn.DiagnosisTables(read, tables={"steps.csv": all_steps(results, now)}).ladder) == 2


def test_what_the_last_model_says_joins_the_comparison_where_something_was_added(tmp_path):
    table, described = pd.DataFrame({"condition": ["slow", "fast"], "model": "base"}), conditions()
    for effects in (["air_drag"], []):
        tables = FigureTables(folder(tmp_path / str(len(effects)), effects=effects).folder, ())
        vars(tables).update(trials=described, comparison=table)
        joined = tables.trajectories["slow"]
        assert ("model_after_m" in joined) == bool(effects)
        assert not effects or np.allclose(joined["model_after_m"], joined["lead_position_m"], rtol=0, atol=1e-12)


# Predictions come from the model that the diagnosis ended with, never silently from one that it refuted.
@pytest.mark.parametrize(
    ("verdicts", "final", "model"),
    [
        (("adequate",), False, ["base"]),
        (("missing", "adequate"), True, ["base", "air_drag"]),
        (("missing", "adequate"), False, None),
        *(((*verdicts,), True, None) for verdicts in (["artefact"], ["unexplained"], ["ambiguous"])),
        (("missing", "unexplained"), True, None),
    ],
)
def test_predictions_take_the_model_that_the_diagnosis_ended_with_and_no_refuted_one(tmp_path, verdicts, final, model):
    results, added = Results(tmp_path), ["air_drag"] if verdicts[0] == "missing" else []
    write_json(results.fit, {"model": ["base"]})
    if final:
        write_json(results.final_fit, {"model": ["base", *added]})
    content = diagnosis(verdicts[0], effects=added, final_verdict=verdicts[-1])
    write_json(results.diagnosis, content)
    if model is None:
        with pytest.raises(ResultsError):
            choose_fit(tmp_path)
    else:
        fit, heading = choose_fit(tmp_path)
        assert list(fit.names) == model
        assert ("air_drag added" in " ".join(heading)) == bool(added)


# What recordings and speeds contradict in the sheet comes before the verdict, for it passes for physics.
def test_psi_under_the_name_of_kpa_and_a_wrong_scale_come_before_the_verdict(tmp_path):
    size = {"diameter_m": 0.012, "thickness_m": 1e-4, "length_m": 0.14, "capture_fps": 1000}
    vine = Trial(name="a", pressure_Pa=30e3, yield_pressure_Pa=3e3, **size)
    # A track at the steady speed of F = B·ẋⁿ with the B that tubes of this size have.
    force_N = (vine.pressure_Pa - vine.yield_pressure_Pa) * vine.area_m2
    tail_m_s = (force_N / damping_prior(vine.diameter_m, vine.thickness_m)) ** (1 / motions.PRINTED_EXPONENT)
    steady = plain_track(np.arange(40) / 1000, np.arange(40) / 1000 * tail_m_s / 2)
    results, made = Results(tmp_path), Diagnosis.from_json(diagnosis("missing"))
    right = [(replace(vine, name=name), steady) for name in "ab"]
    for name in "ab":
        write_json(results.analysed(name), {"row": {}, "contradictions": []})
    assert sheet_contradictions(results, right) == {}
    assert with_contradictions(made, results, right) == made

    psi = 6.894757
    typed = replace(vine, pressure_Pa=vine.pressure_Pa / psi, yield_pressure_Pa=vine.yield_pressure_Pa / psi)
    pairs = [(replace(typed, name=name), steady) for name in "ab"]
    narrow = {"code": "size", "column": "diameter_mm"}
    narrow |= {"reason": "diameter_mm '12' differs: the tube is 9.6 mm wide, a factor 1.25"}
    write_json(results.analysed("a"), {"row": {}, "contradictions": [narrow]})
    assert sheet_contradictions(results, right) == {}  # the other recording of this vine agrees with the sheet
    for name in "ab":
        write_json(results.analysed(name), {"row": {}, "contradictions": [narrow]})
    seen = sheet_contradictions(results, pairs)
    assert list(seen) == ["diameter_mm", "pressure_kPa"]
    assert seen["diameter_mm"] == f"a: {narrow['reason']} (and 1 more trial)"
    assert "looks like psi, not kPa" in seen["pressure_kPa"]
    contradicted = with_contradictions(made, results, pairs)
    assert contradicted.notes[:2] == tuple(seen.values())
    for first in (str(contradicted).splitlines()[0], verdict_sentence(contradicted)):
        assert "diameter_mm and pressure_kPa" in first
        assert "reservoir" not in first
    assert contradicted.explanation == verdict_sentence(contradicted)
    assert contradicted.next_experiment is None
    write_json(results.diagnosis, contradicted.to_json())
    with pytest.raises(ResultsError, match="pressure_kPa"):
        propose_effect(None, tmp_path, print)
