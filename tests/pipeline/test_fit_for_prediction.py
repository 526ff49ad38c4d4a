"""Predictions come from the model that the diagnosis ended with, never silently from one that it refuted."""

from __future__ import annotations

from pathlib import Path

import pytest

from vinetrack.core.tables import write_json
from vinetrack.pipeline.predict_stage import choose_fit
from vinetrack.results.folder_layout import Results, ResultsError


def results(folder: Path, verdicts: tuple[str, ...], effects: tuple[str, ...] = (), final: bool = False) -> Path:
    """A folder with a fit, a diagnosis of these verdicts, and the fit that it ended with."""
    where = Results(folder)
    write_json(where.fit, {"model": ["base"]})
    if final:
        write_json(where.final_fit, {"model": ["base", *effects]})
    if verdicts:
        rounds = [
            {"model": ["base"], "verdict": v, "answer_set": [], "explanation": f"it is {v}", "ranking": []}
            for v in verdicts
        ]
        content = {
            "verdict": verdicts[0], "final_verdict": verdicts[-1], "effects": list(effects), "answer_set": [],
            "explanation": f"it is {verdicts[0]}", "rounds": rounds, "parameters": [], "where": [], "drift": [],
            "next_experiment": None, "missing_force": None, "notes": [], "refused": None,
        }  # fmt: skip
        write_json(where.diagnosis, content)
    return folder


def test_an_adequate_model_is_used_as_it_is(tmp_path: Path) -> None:
    chosen = choose_fit(results(tmp_path, ("adequate",)))
    assert (chosen.content["model"], chosen.heading) == (["base"], ())


def test_the_model_that_the_diagnosis_ended_with_is_used_and_named(tmp_path: Path) -> None:
    chosen = choose_fit(results(tmp_path, ("missing", "adequate"), ("air_drag",), final=True))
    assert chosen.content["model"] == ["base", "air_drag"]
    assert "air_drag added" in chosen.heading[0]


@pytest.mark.parametrize("verdicts", [("artefact",), ("unexplained",), ("ambiguous",), ("missing", "unexplained")])
def test_a_refuted_model_is_refused_with_the_reason(tmp_path: Path, verdicts: tuple[str, ...]) -> None:
    with pytest.raises(ResultsError, match=f"--anyway. {verdicts[-1]}: it is {verdicts[0]}"):
        choose_fit(results(tmp_path, verdicts))


def test_anyway_puts_the_verdict_above(tmp_path: Path) -> None:
    chosen = choose_fit(results(tmp_path, ("artefact",)), anyway=True)
    assert chosen.content["model"] == ["base"]
    assert chosen.heading[0] == "! artefact: it is artefact"


def test_a_last_model_that_is_not_stored_is_asked_for(tmp_path: Path) -> None:
    with pytest.raises(ResultsError, match="is not stored there: run the diagnosis again"):
        choose_fit(results(tmp_path, ("missing", "adequate"), ("air_drag",)))


def test_a_fit_without_a_diagnosis_says_so(tmp_path: Path) -> None:
    assert "has no diagnosis" in choose_fit(results(tmp_path, ())).heading[0]
