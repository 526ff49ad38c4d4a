"""The stopping rule of a campaign that is diagnosed repeatedly."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from vinetrack.cli.main import app
from vinetrack.core.problems import ExperimentError
from vinetrack.diagnosis.result import (
    ADEQUATE,
    AMBIGUOUS,
    MISSING,
    NOT_TESTABLE,
    REFITTED,
    SCREENED,
    UNEXPLAINED,
    Candidate,
    Diagnosis,
    Round,
    limit_reason,
)
from vinetrack.diagnosis.stopping import GO_ON, STOP, CampaignLook, look_at, trials_to_go
from vinetrack.pipeline import power_stage, sequence_stage
from vinetrack.pipeline.sequence_stage import LEDGER, Ledger, look_at_folder, read_ledger


def diagnosis(log_bayes: float = 30.0, rival: float = 1e-6, verdict: str = MISSING, final: str = ADEQUATE) -> Diagnosis:
    """A leak was found, with another candidate refitted, one only score-tested, and one without response."""
    ranking = (
        Candidate("leak", "physical", REFITTED, 80.0, 8.9, posterior_weight=1 - rival, log_bayes=log_bayes),
        Candidate("air_drag", "physical", REFITTED, 40.0, 6.3, posterior_weight=rival, log_bayes=10.0),
        Candidate("fold_inertia", "physical", SCREENED, 2.0, 1.4),
        Candidate("static_yield", "physical", NOT_TESTABLE),
    )
    answer = ("leak",) if verdict == MISSING else ("leak", "air_drag") if verdict == AMBIGUOUS else ()
    rounds = [Round(("gravity",), verdict, answer, ranking, "")]
    if verdict == MISSING:
        rounds.append(Round(("gravity", "leak"), final, (), (), ""))
    return Diagnosis(tuple(rounds), ("leak",) if verdict == MISSING else (), "")


def test_one_effect_with_a_sufficient_likelihood_ratio_stops_the_campaign() -> None:
    look = look_at(diagnosis(), 12, 0.03)
    assert (look.decision, look.names) == (STOP, ("leak",))
    assert look.needed == pytest.approx(math.log(3 / 0.03))
    assert look.rival == "air_drag"
    assert look.log_ratio == pytest.approx(math.log((1 - 1e-6) / 1e-6))


@pytest.mark.parametrize(
    ("given", "why"),
    [
        (diagnosis(rival=0.2), "air_drag is not excluded"),
        (diagnosis(log_bayes=2.0), "nothing missing is not excluded"),
        (diagnosis(final=UNEXPLAINED), "not among the candidates"),
        (diagnosis(verdict=UNEXPLAINED), "not among the candidates"),
        (diagnosis(verdict=AMBIGUOUS), "several effects are left"),
        (diagnosis(verdict=ADEQUATE), "nothing is found to be missing"),
        (diagnosis(log_bayes=math.nan), "not known"),
        (replace(diagnosis(), rounds=(), refused="no trial moves"), "no trial moves"),
    ],
)
def test_reasons_to_continue_a_campaign(given: Diagnosis, why: str) -> None:
    look = look_at(given, 12, 0.03)
    assert look.decision == GO_ON
    assert why in look.why


def test_the_first_few_trials_never_stop_a_campaign() -> None:
    assert look_at(diagnosis(), 5, 0.03).decision == GO_ON


def test_a_smaller_risk_requires_a_larger_ratio() -> None:
    assert look_at(diagnosis(rival=1e-3), 12, 0.03).decision == STOP
    assert look_at(diagnosis(rival=1e-3), 12, 0.001).decision == GO_ON


@pytest.mark.parametrize(
    ("reason", "decision"),
    [
        (limit_reason("leak"), STOP),
        # As earlier versions stored it, and as the answer set states it.
        ("it contains leak as a limit", STOP),
        ("it contains leak as a limit and fits no better", STOP),
        (limit_reason("air_drag"), GO_ON),
        ("", GO_ON),
    ],
)
def test_a_richer_form_of_the_same_effect_is_no_rival(reason: str, decision: str) -> None:
    given = diagnosis()
    richer = Candidate("slow_leak", "physical", SCREENED, 80.0, 8.9, reason=reason)
    first = replace(given.rounds[0], ranking=(*given.rounds[0].ranking, richer))
    assert look_at(replace(given, rounds=(first, given.rounds[1])), 12, 0.03).decision == decision


def test_monitoring_after_every_observation_keeps_the_stated_risk() -> None:
    # Two normal means a priori alike, the first true: the ratio of likelihoods ever exceeds (m − 1)/risk = 1/risk.
    draw, risk = np.random.default_rng(3), 0.1
    x = draw.standard_normal((4000, 400))
    log_ratio = np.cumsum(0.3 * x - 0.045, axis=1)
    wrong = np.mean(np.max(log_ratio, axis=1) >= math.log(1 / risk))
    assert 0.03 < wrong <= risk


def test_the_log_ratio_predicts_how_many_trials_are_still_needed() -> None:
    look = look_at(diagnosis(log_bayes=2.0, rival=1e-9), 12, 0.03)
    assert trials_to_go(look) == math.ceil(12 * (look.needed / 2.0 - 1))
    assert trials_to_go(look_at(diagnosis(), 12, 0.03)) == 0


def test_a_ledger_stores_the_looks_and_the_risk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    said = [diagnosis(rival=0.2)]
    data = [b"six trials"]

    def diagnosed(target: Path, experiment: Path | None) -> tuple[Diagnosis, list[bytes], Path]:  # noqa: ARG001
        return said[0], data * 8, tmp_path

    monkeypatch.setattr(sequence_stage, "_diagnose_target", diagnosed)
    monkeypatch.setattr(sequence_stage, "_data_fingerprint", lambda pairs: pairs[0].decode())
    monkeypatch.setattr(power_stage, "recommended_trials", lambda *_: "Make 2 trials at 40 kPa.")
    first = look_at_folder(tmp_path, 0.05)
    assert first.next_text.startswith("Make 2 trials at 40 kPa. With trials like those so far, about ")
    assert [look.decision for look in first.looks] == [GO_ON]
    again = look_at_folder(tmp_path)
    assert len(again.looks) == 1
    said[0], data[0] = diagnosis(), b"ten trials"
    last = look_at_folder(tmp_path)
    assert [look.decision for look in last.looks] == [GO_ON, STOP]
    assert read_ledger(tmp_path / LEDGER) == last
    with pytest.raises(ExperimentError, match="differs from the risk stated"):
        look_at_folder(tmp_path, 0.01)


def test_the_command_prints_looks_and_the_next_trials(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    look = CampaignLook(8, AMBIGUOUS, ("leak", "air_drag"), math.nan, "", 6.9, GO_ON, "several effects are left")
    ledger = Ledger(0.03, (look,), ("x",), "Two trials at 30 kPa.")
    monkeypatch.setattr(sequence_stage, "look_at_folder", lambda *_: ledger)
    file = tmp_path / "ledger.json"
    result = CliRunner().invoke(app, ["campaign", str(tmp_path), "--json", str(file)])
    assert result.exit_code == 0, result.output
    assert "leak or air_drag" in result.output
    assert "Next: Two trials at 30 kPa." in result.output
    assert json.loads(file.read_text())["looks"][0]["log_ratio"] is None


def test_an_invalid_ledger_is_refused(tmp_path: Path) -> None:
    (tmp_path / LEDGER).write_text("{}")
    with pytest.raises(ExperimentError, match="not a campaign ledger"):
        read_ledger(tmp_path / LEDGER)
