"""The fit and the diagnosis of a results folder, read back as they were written."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
from hand_diagnosis import VERDICTS, diagnosis, refused

from vinetrack.core.tables import write_json
from vinetrack.diagnosis.result import Diagnosis
from vinetrack.inference.fit_result import BetweenTrialSpread, Number
from vinetrack.inference.fit_summary import FitSummary, TrialEstimates
from vinetrack.results.folder_layout import Results, ResultsError, read_diagnosis, read_fit

OPEN = math.nan


def fit() -> FitSummary:
    damping = Number("eversion_damping.B", "v", "B", "N·(s/m)ⁿ", 6.4, 0.1, 6.2, 6.6, OPEN, "linear")
    onset = Number("yield_pressure.P_y", "", "P_y", "Pa", 3000.0, OPEN, OPEN, OPEN, OPEN, "none", 0.0)
    return FitSummary(
        names=("gravity", "eversion_damping"),
        numbers=(damping, onset),
        covariance=np.array([[0.01, 0.0], [0.0, OPEN]]),
        spreads={"B": BetweenTrialSpread(0.03, True)},
        noise_m=1e-4,
        noise_correlation=0.4,
        chi2_per_dof=1.2,
        log_likelihood=-12.5,
        converged=True,
        messages=("a",),
        warnings=("b",),
        left_out={"c": "never moves"},
        trials={"t": TrialEstimates(*(0.1 * i for i in range(8)))},
        between=np.array([[0.04, 0.0], [0.0, 0.0]]),
    )


def test_a_fit_comes_back_as_it_was_written(tmp_path: Path) -> None:
    results = Results(tmp_path)
    write_json(results.fit, fit().to_json())
    back = read_fit(results)
    write_json(tmp_path / "again.json", back.to_json())
    assert (tmp_path / "again.json").read_text() == results.fit.read_text()
    assert back["B"].value == 6.4
    assert back.between[0, 0] == 0.04
    assert back.fitted_values == {"eversion_damping.B": {"v": 6.4}, "yield_pressure.P_y": 3000.0}
    assert back.trial_table()["release_sigma_s"].tolist() == [0.1]
    assert str(back) == str(fit())


def test_a_refused_fit_has_its_reason_alone(tmp_path: Path) -> None:
    write_json(Results(tmp_path).fit, FitSummary(("gravity",), refused="nothing moves").to_json())
    back = read_fit(Results(tmp_path))
    assert (back.refused, back.numbers, repr(back)) == ("nothing moves", (), "FitSummary(gravity; refused)")


@pytest.mark.parametrize("verdict", VERDICTS)
def test_a_diagnosis_comes_back_as_it_was_written(verdict: str) -> None:
    written = json.loads(json.dumps(Diagnosis.from_json(diagnosis(verdict)).to_json(), default=float))
    again = json.loads(json.dumps(Diagnosis.from_json(written).to_json(), default=float))
    assert json.dumps(again) == json.dumps(written)
    told = diagnosis(verdict)
    assert {key: again[key] for key in ("verdict", "effects", "answer_set", "final_verdict", "where", "cosines")} == {
        key: told[key] for key in ("verdict", "effects", "answer_set", "final_verdict", "where", "cosines")
    }


def test_a_refused_diagnosis_says_why_and_has_no_verdict(tmp_path: Path) -> None:
    write_json(Results(tmp_path).diagnosis, refused("no trial moves"))
    back = read_diagnosis(Results(tmp_path))
    assert back is not None
    assert (back.verdict, back.final_verdict, back.refused) == ("", "", "no trial moves")
    assert str(back) == "No diagnosis could be made: no trial moves"


def test_without_a_diagnosis_there_is_none(tmp_path: Path) -> None:
    assert read_diagnosis(Results(tmp_path)) is None


@pytest.mark.parametrize("content", ["[]", '{"model": 3}', '{"numbers": [1]}'])
def test_a_fit_that_is_none_of_ours_is_one_sentence(tmp_path: Path, content: str) -> None:
    Results(tmp_path).fit.write_text(content, encoding="utf-8")
    with pytest.raises(ResultsError, match="delete it and run snakemake again"):
        read_fit(Results(tmp_path))


def test_a_model_takes_effects_by_name() -> None:
    import vinetrack as vt

    model = vt.base_model() + "air_drag"
    assert model.names[-1] == "air_drag"
    assert repr(model - "air_drag") == "Model(pressure_drive + gravity + eversion_damping + yield_pressure)"
    with pytest.raises(vt.effects.EffectError, match="air_drag"):
        model + "air_drg"
