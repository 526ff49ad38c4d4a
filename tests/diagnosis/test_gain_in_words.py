"""What `vinetrack add` says of an effect that helps, one that does not, and one whose fit did not converge."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from vinetrack.inference.fit_result import Number
from vinetrack.narrative.diagnosis_text import gain_in_words
from vinetrack.narrative.verdict_text import SIGNIFICANT_SIGMA, estimate_text, estimates_text, interval_text


def fit(log_likelihood: float, converged: bool = True) -> Any:
    return SimpleNamespace(log_likelihood=log_likelihood, converged=converged)


@pytest.mark.parametrize(
    ("after", "words"),
    [
        (fit(110.0), "Δχ² = 20.0"),
        (fit(101.0), "no significant improvement (Δχ² = 2.0; 9 are needed)"),
        (fit(47.0), "the fit did not converge, so whether it helps is unknown"),
        (fit(110.0, converged=False), "Δχ² = 20.0; the fit did not converge"),
    ],
)
def test_a_gain_is_said_as_what_it_is(after: Any, words: str) -> None:
    assert gain_in_words(fit(100.0), after) == words


def number(value: float, sigma: float, **more: float) -> Number:
    return Number(
        "tail_stretch.compliance", "", "1/E", "1/Pa", value, sigma, value - sigma, value + sigma, 9.0, "x", **more
    )


def test_a_size_at_its_bound_is_said_to_be_there() -> None:
    assert estimate_text(number(-3.464e-12, float("nan"), bound=0.0)) == "1/E = 0 1/kPa (at its bound)"


def test_a_negative_size_of_what_cannot_be_negative_is_said_to_be_one() -> None:
    assert estimate_text(number(-2e-3, 1e-4, lower=0.0)).endswith("(negative, which is impossible)")


def test_a_bound_that_an_interval_ends_at_is_named() -> None:
    assert interval_text(number(1.0, 0.5, upper=1.5)).endswith("(its upper bound)")
    assert interval_text(number(1.0, 0.5, upper=2.0)).endswith("1/kPa")


def test_a_size_less_than_two_errors_from_none_is_none_seen() -> None:
    from vinetrack.diagnosis.result import Candidate

    row = Candidate("tail_stretch", "physical", "refitted", 1.0, SIGNIFICANT_SIGMA - 0.1, (number(1.0, 0.6),))
    assert estimates_text(row).endswith(": not significant")


@pytest.mark.parametrize(
    ("others", "words"),
    [
        ((), "refitted, posterior weight 50 %"),
        (("slow_leak",), "refitted, posterior weight 50 %, shared with slow_leak, which contains it"),
        (("a_leak", "b_leak"), "refitted, posterior weight 50 %, shared with a_leak and b_leak, which contain it"),
    ],
)
def test_a_weight_shared_with_a_richer_form_is_said_to_be(others: tuple[str, ...], words: str) -> None:
    from vinetrack.diagnosis.remarks import remark
    from vinetrack.diagnosis.result import MISSING, REFITTED, Candidate, Diagnosis, Round
    from vinetrack.narrative.diagnosis_text import diagnosis_text

    found = Candidate("leak", "physical", REFITTED, 80.0, 8.9, in_answer_set=True, posterior_weight=0.5)
    reason = remark("contains_and_fits_no_better", name="leak")
    richer = [Candidate(name, "physical", REFITTED, 80.1, 8.9, reason=reason, posterior_weight=0.5) for name in others]
    step = Round(("gravity",), MISSING, ("leak",), (found, *richer), "")
    lines = diagnosis_text(Diagnosis((step,), ("leak",), "")).splitlines()
    assert next(line for line in lines if line.startswith("* leak")).endswith(f"  {words}")
