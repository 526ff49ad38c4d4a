"""Several effects together, and steps that mend a part of what nothing mends in full.

Seeds from 7200 are used here alone.
"""

from __future__ import annotations

import json
from types import SimpleNamespace
from typing import Any

import pandas as pd
import pytest
from hidden_truth import Pairs, grown, sheet

import vinetrack as vt
from vinetrack.diagnosis import selection
from vinetrack.diagnosis.ladder import LADDER_COLUMNS
from vinetrack.diagnosis.remarks import remark
from vinetrack.diagnosis.result import Diagnosis
from vinetrack.narrative.diagnosis_text import diagnosis_text
from vinetrack.narrative.verdict_text import settled_rows

pytestmark = pytest.mark.slow

CANDIDATES = ("reservoir_depletion", "tail_friction", "latch_release", "leak")
TRUTH = {
    "reservoir_depletion.gamma": 1.3,
    "tail_friction.mu_w": 1.0,
    "latch_release.F": 1.0,
    "latch_release.reach": 0.01,
}


def campaign() -> Pairs:
    """Each condition once."""
    return grown(TRUTH, seed=7200, trials=sheet()[::2])


@pytest.fixture(scope="module")
def three_missing() -> Diagnosis:
    return vt.diagnose(campaign(), candidates=CANDIDATES, ladder=False, advice=False)


@pytest.fixture(scope="module")
def one_not_asked() -> Diagnosis:
    asked = [name for name in CANDIDATES if name != "latch_release"]
    return vt.diagnose(campaign(), candidates=asked, advice=False)


def test_three_effects_are_found_one_after_the_other(three_missing: Diagnosis) -> None:
    assert three_missing.verdict == "missing"
    assert set(three_missing.effects) == {"reservoir_depletion", "tail_friction", "latch_release"}
    assert three_missing.final_verdict == "adequate"
    assert [len(step.model) for step in three_missing.rounds] == [4, 5, 6, 7]
    assert "three effects are missing" in three_missing.explanation.lower()
    numbers = {number.key: number for number in three_missing.parameters}
    for key in ("reservoir_depletion.gamma", "tail_friction.mu_w"):
        assert abs(numbers[key].value - TRUTH[key]) < 4 * numbers[key].sigma


def test_a_set_that_mends_everything_but_is_worth_no_more_than_chance_is_said_to_be_that(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """It had been said that something is left once it is added."""
    pair = SimpleNamespace(label="leak with air_drag", credible=True, fit=SimpleNamespace(log_likelihood=1.0))
    sets = SimpleNamespace(
        grow=lambda _: [pair],
        of_size=lambda _: [pair],
        is_better=lambda _: False,
        plausible_steps=lambda: (),
        fitted={},
    )
    questions: Any = SimpleNamespace(fit=SimpleNamespace(chi2_per_dof=2.0))
    monkeypatch.setattr(selection, "EffectSets", lambda *_: sets)
    monkeypatch.setattr(selection, "adequate_hypotheses", lambda *_: ([pair], {}, questions))
    (step,) = selection._effect_set_rounds(questions, questions, [pair], str)  # type: ignore[list-item]
    assert step.verdict == "unexplained"
    assert step.rejected == (("leak with air_drag", remark("gain_within_chance")),)


@pytest.mark.parametrize(
    ("gained", "named"), [(970.0, [("artefact", "lens")]), (930.0, [("missing", "latch_release")])]
)
def test_a_lens_that_mends_nearly_all_comes_before_what_its_next_term_looks_like(
    monkeypatch: pytest.MonkeyPatch, gained: float, named: list[tuple[str, str]]
) -> None:
    """Measured: a lens with a fifth order was `latch_release`, with a lens beside it."""
    latch, lens = (
        SimpleNamespace(name=name, kind=kind) for name, kind in (("latch_release", ""), ("lens", "measurement"))
    )
    singles = [SimpleNamespace(names=(e.name,), delta_chi2=gain) for e, gain in ((latch, 900.0), (lens, gained))]
    pair = SimpleNamespace(names=("latch_release", "lens"), effects=(latch, lens), delta_chi2=1000.0, fit=None)
    sets: Any = SimpleNamespace(
        fitted=dict(enumerate(singles)), subset=lambda *_: None, search=SimpleNamespace(tests_after=lambda _: None)
    )
    monkeypatch.setattr(selection, "_shared_step", lambda verdict, *parts: (verdict, parts[4]))
    monkeypatch.setattr(selection, "_remainder", lambda *_: SimpleNamespace(names=("lens",), effects=(lens,)))
    monkeypatch.setattr(selection, "SelectionStep", lambda *_, **__: None)
    steps = selection._rounds_of_sets(sets, sets, [pair], {}, sets)  # type: ignore[list-item]
    assert [step for step in steps if step is not None] == named


def test_every_round_says_which_effects_it_adds_together(three_missing: Diagnosis) -> None:
    first, second, *_ = three_missing.rounds
    assert len(first.sets) == 1
    assert set(first.sets[0]) == set(three_missing.effects)
    assert set(second.sets[0]) == set(three_missing.effects[1:])


def test_what_lacks_an_effect_that_is_not_asked_stays_unexplained_and_shows_partial_steps(
    one_not_asked: Diagnosis,
) -> None:
    assert one_not_asked.verdict == "unexplained"
    assert one_not_asked.effects == one_not_asked.answer_set == ()
    steps = [step.effect for step in one_not_asked.rounds[0].partial]
    assert steps
    ladder = one_not_asked.ladder
    assert ladder is not None
    assert tuple(ladder.columns) == LADDER_COLUMNS
    assert ladder["partial"].tolist() == [False, *[True] * len(steps)]
    assert ladder["added"].tolist() == ["", *steps]
    assert ladder["rms_in_sample_m"].iloc[-1] < ladder["rms_in_sample_m"].iloc[0]
    assert f"{steps[0]}, partial" in diagnosis_text(one_not_asked)


def test_partial_steps_and_sets_are_read_back(one_not_asked: Diagnosis, three_missing: Diagnosis) -> None:
    for diagnosis in (one_not_asked, three_missing):
        stored = Diagnosis.from_json(json.loads(json.dumps(diagnosis.to_json(), default=str)))
        for step, read in zip(diagnosis.rounds, stored.rounds, strict=True):
            assert read.sets == step.sets
            assert [one.effect for one in read.partial] == [one.effect for one in step.partial]


def test_headlines_are_those_of_the_model_that_stands() -> None:
    rows = [("", False), ("leak", False), ("air_drag", True)]
    table = pd.DataFrame(rows, columns=["added", "partial"])
    assert settled_rows(table)["added"].tolist() == ["", "leak"]
    assert settled_rows(table.astype({"partial": str}))["added"].tolist() == ["", "leak"]
    assert len(settled_rows(table[["added"]])) == 3
