"""What a diagnosis left in a results folder, read back for pictures and page: whole, in parts, and not there."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from hand_diagnosis import BASE, VERDICTS, diagnosis, ladder, moved, one_round, refused

from vinetrack.diagnosis.result import Round
from vinetrack.figures.registry import diagnosis_figures, draw
from vinetrack.figures.style import render
from vinetrack.pipeline.diagnosis_stage import (
    DiagnosisTables,
    cosines_by_rank,
    predicted_trials,
    ranking_table,
    read_diagnosis_tables,
    round_heading,
    worst_condition,
)
from vinetrack.pipeline.report_stage import with_final_model
from vinetrack.results.folder_layout import Results

RELEASE_S, ORIGIN_M = 0.05, 0.2
TRIALS = {"a": "slow", "b": "slow", "c": "fast"}


def conditions() -> pd.DataFrame:
    labels = {"slow": "12 mm, 24 kPa", "fast": "12 mm, 60 kPa"}
    rows = [{"trial": t, "vine": "v", "condition": c, "condition_label": labels[c]} for t, c in TRIALS.items()]
    return pd.DataFrame(rows)


def prediction(off_m: float, after: bool) -> pd.DataFrame:
    """0.2 m in 0.1 s, of which the model before misses `off_m` at the end, the one after nothing."""
    since_s = np.arange(-20, 101) * 1e-3
    growth_m = 2.0 * np.maximum(since_s, 0)
    table = pd.DataFrame({"time_s": since_s + RELEASE_S, "lead_position_m": ORIGIN_M + growth_m})
    before_m = table["lead_position_m"] - off_m * growth_m / 0.2
    return table.assign(model_before_m=before_m, model_after_m=table["lead_position_m"] if after else math.nan)


def folder(path: Path, content: dict | None, after: bool = True, compared: bool = True) -> Results:
    results = Results(path)
    (path / "diagnosis" / "predictions").mkdir(parents=True)
    (path / "comparison").mkdir()
    if content is not None:
        (path / "diagnosis.json").write_text(json.dumps(content))
    ladder("", *content.get("effects", []) if content else ()).to_csv(results.ladder, index=False)
    moved().to_csv(results.diagnosed("moved.csv"), index=False)
    for condition in ("slow", "fast"):
        parts = []
        for trial in (t for t, c in TRIALS.items() if c == condition):
            table = prediction(0.02 if condition == "slow" else 0.004, after)
            table.to_csv(results.predictions(trial), index=False)
            since = {"time_s": table["time_s"] - RELEASE_S, "lead_position_m": table["lead_position_m"] - ORIGIN_M}
            model = {"model_position_m": table["model_before_m"] - ORIGIN_M}
            parts.append(pd.DataFrame({"trial": trial, **since, **model}))
        if compared:
            pd.concat(parts).to_csv(results.trajectories(condition), index=False)
    return results


@pytest.mark.parametrize("compared", [True, False])
def test_predictions_count_from_release_and_origin(tmp_path: Path, compared: bool) -> None:
    trials = predicted_trials(folder(tmp_path / "r", diagnosis(), compared=compared), conditions())
    one = trials[trials["trial"] == "a"]
    # Without the comparison the release is the first frame that moves: a frame or two late.
    assert one["time_s"].iloc[0] == pytest.approx(-0.02, abs=1e-9 if compared else 2.5e-3)
    assert one["lead_position_m"].iloc[-1] == pytest.approx(0.2)


def test_the_worst_condition_is_the_one_the_first_model_misses_most(tmp_path: Path) -> None:
    found = read_diagnosis_tables(folder(tmp_path / "r", diagnosis()), conditions())
    assert found is not None
    assert found.worst == "12 mm, 24 kPa"
    assert set(found.before_after["trial"]) == {"a", "b"}
    assert worst_condition(found.before_after.iloc[:0]) == ""


def test_misfits_are_averaged_along_the_growth_before_and_after(tmp_path: Path) -> None:
    found = read_diagnosis_tables(folder(tmp_path / "r", diagnosis()), conditions())
    assert found is not None
    slow = found.where[found.where["condition"] == "slow"]
    middle = (slow["growth_from"] + slow["growth_to"]) / 2
    assert slow["misfit_before_m"].to_numpy() == pytest.approx(0.02 * middle.to_numpy(), abs=3e-4)
    assert slow["misfit_after_m"].to_numpy() == pytest.approx(np.zeros(len(slow)), abs=1e-12)
    assert set(found.where["condition_label"]) == {"12 mm, 24 kPa", "12 mm, 60 kPa"}
    assert slow["n_trials"].tolist() == [2] * len(slow)


def test_misfits_that_the_diagnosis_found_are_taken_with_their_errors(tmp_path: Path) -> None:
    results = folder(tmp_path / "r", diagnosis())
    row = {"vine": "v", "condition": "slow", "from_m": 0.1, "to_m": 0.2, "lead_position_m": 0.15}
    row |= {"mean_residual_m": 0.011, "sigma_m": 0.001, "z": 11.0, "n_trials": 2}
    pd.DataFrame([row, row | {"condition": ""}]).to_csv(results.diagnosed("along_position.csv"), index=False)
    found = read_diagnosis_tables(results, conditions())
    assert found is not None
    (slow,) = found.where[found.where["condition"] == "slow"].to_dict("records")
    assert (slow["growth_from"], slow["growth_to"]) == (0.5, 1.0)
    assert (slow["misfit_before_m"], slow["scatter_m"]) == (0.011, 0.001)
    assert slow["misfit_after_m"] == pytest.approx(0, abs=1e-12)


@pytest.mark.parametrize("verdict", VERDICTS)
def test_every_verdict_has_a_picture_of_what_it_has_a_table_of(tmp_path: Path, verdict: str) -> None:
    found = read_diagnosis_tables(folder(tmp_path / "r", diagnosis(verdict), after=verdict == "missing"), conditions())
    assert found is not None
    drawn = {name: figure for name in diagnosis_figures() if (figure := draw(name, found))}
    assert set(drawn) == {"ladder", "before_after", "where", "candidates", "cosines"}
    for name, figure in drawn.items():
        assert render(figure, ["svg"])["svg"]
        assert len(getattr(found, diagnosis_figures()[name].data)) > 0


@pytest.mark.parametrize("content", [None, refused()], ids=["none", "refused"])
def test_without_a_verdict_there_is_nothing_to_draw(tmp_path: Path, content: dict | None) -> None:
    assert read_diagnosis_tables(folder(tmp_path / "r", content), conditions()) is None
    assert not any(draw(name, DiagnosisTables()) for name in diagnosis_figures())


def test_a_diagnosis_without_predictions_has_the_rest(tmp_path: Path) -> None:
    results = Results(tmp_path)
    (tmp_path / "diagnosis.json").write_text(json.dumps(diagnosis()))
    found = read_diagnosis_tables(results, conditions())
    assert found is not None
    assert {name for name in diagnosis_figures() if draw(name, found)} == {"candidates", "cosines"}


def test_what_the_last_model_says_joins_the_comparison_where_something_was_added(tmp_path: Path) -> None:
    results = folder(tmp_path / "r", diagnosis())
    trajectories = {
        "slow": pd.read_csv(results.trajectories("slow")),
        "fast": pd.read_csv(results.trajectories("fast")),
    }
    joined = with_final_model(trajectories, read_diagnosis_tables(results, conditions()))
    difference = joined["slow"]["model_after_m"] - joined["slow"]["lead_position_m"]
    assert float(np.abs(difference).max()) < 1e-12
    assert "model_after_m" not in with_final_model(trajectories, None)["slow"]
    shorter = {"slow": trajectories["slow"].iloc[1:]}
    assert "model_after_m" not in with_final_model(shorter, read_diagnosis_tables(results, conditions()))["slow"]


def test_rankings_keep_what_could_not_be_tested_and_round_two_says_what_was_added() -> None:
    told = [one_round("missing", "air_drag"), one_round("adequate", model=[*BASE, "air_drag"])]
    rounds = [Round.from_json(one) for one in told]
    table = ranking_table(rounds[0])
    assert table["effect"].tolist() == ["air_drag", "leak", "time_base", "payload_drag"]
    assert math.isnan(table["delta_chi2"].iloc[-1])
    assert round_heading(0, rounds) == "Which effect is missing from the initial model?"
    assert round_heading(1, rounds) == "Which is missing with air drag added?"


def test_ties_stand_in_the_order_of_the_ranking() -> None:
    cosines = {"effects": ["time_base", "leak", "air_drag"], "matrix": [[1, 0.1, 0.2], [0.1, 1, 0.3], [0.2, 0.3, 1]]}
    names, matrix = cosines_by_rank(Round.from_json(one_round("missing", "air_drag") | {"cosines": cosines}))
    assert names == ["air_drag", "leak", "time_base"]
    assert matrix == [[1, 0.3, 0.2], [0.3, 1, 0.1], [0.2, 0.1, 1]]
    assert cosines_by_rank(Round.from_json({"verdict": ""})) == ([], [])


def test_trials_in_which_nothing_grew_have_no_places_along_the_growth() -> None:
    import pandas as pd

    from vinetrack.pipeline import diagnosis_stage as diagnosis_tables

    still = {"trial": ["a"] * 6, "time_s": range(6), "lead_position_m": [0.0] * 6}
    members = pd.DataFrame(still | {"model_before_m": [0.0] * 6, "model_after_m": [0.0] * 6})
    assert diagnosis_tables._measured_sections(members) == []
    located = pd.DataFrame(
        {"vine": ["v"], "condition": ["c"], "from_m": [0.0], "to_m": [0.0], "mean_residual_m": [0.0], "sigma_m": [1.0]}
    )
    assert diagnosis_tables._located_sections(located, located, members) == []
