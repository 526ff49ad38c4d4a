"""Differences between trials as hypotheses: n by vine, drift with the order of trials, specimens, days.

A tube that wears, another tube for the high pressures, or a gauge whose zero changes between days changes B or the
pressure of whole groups of trials. Where all replicates of a condition are in one group, this is indistinguishable from
physics that depends on the condition. Such differences are therefore hypotheses like the effects of the catalogue:

    ln B_j          = ln B_vine + Σ_g a_g z_gj + u_j
    P_j / P_set,j   = 1         + Σ_g b_g z_gj + v_j        u_j, v_j random effects of trials
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from vinetrack.diagnosis.between_forms import forms_of
from vinetrack.diagnosis.between_gain import (
    Difference,
    gain_p_value,
    linear_gain,
    with_shared_errors,
    with_trace_errors,
)
from vinetrack.diagnosis.likelihood_ratio import LikelihoodRatio, likelihood_ratio
from vinetrack.diagnosis.result import (
    BETWEEN_SUMMARIES,
    BETWEEN_TRIALS,
    ORDER_DRIFT,
    REFITTED,
    Candidate,
)
from vinetrack.dynamics.simulate import SimulationError
from vinetrack.effects import Effect, Parameter
from vinetrack.inference.fit import refit
from vinetrack.inference.fit_data import FitError
from vinetrack.inference.fit_result import Fit, Number
from vinetrack.inference.optimiser import Solution
from vinetrack.inference.parameters import DAMPING
from vinetrack.inference.position_errors import with_smooth_errors

# Largest plausible drift of ln B and of ln P per trial, and step of ln P (chosen)
PLAUSIBLE_DRIFT = {"B": 0.05, "P": 0.01, "step": 0.05}

# Predicted −2 ln L by which a difference may be behind the best hypothesis and still be fitted (chosen)
MAX_GAIN_SHORTFALL = 40.0

MIN_LINEAR_GAIN = 2.0  # Predicted fall of −2 ln L below which a difference is not fitted (chosen)

# p-value below which a difference is also tested with shared systematic errors in the model (chosen)
SYSTEMATICS_CHECK_P_VALUE = 0.01

FIRST_ITERATIONS, MORE_ITERATIONS = 14, 30  # Iterations of the fit of a difference, at first and in all (chosen)


@dataclass(frozen=True)
class BetweenRatio(LikelihoodRatio):
    """The likelihood ratio of a difference between trials."""

    difference: Difference = field(default_factory=lambda: Difference(""))

    @property
    def numbers(self) -> tuple[Number, ...]:
        """Its coefficients, or the exponents of the vines."""
        keys = {term.key for term in self.difference.terms} | set(self.difference.shared)
        return tuple(number for number in self.fit.numbers if number.key in keys and math.isfinite(number.sigma))

    @property
    def others(self) -> tuple[Number, ...]:
        """All other parameters of its fit."""
        keys = {number.name for number in self.numbers}
        return tuple(number for number in self.fit.numbers if number.name not in keys)


def differences(fit: Fit) -> list[Difference]:
    """Hypotheses that trials differ, with their predicted gains and p-values."""
    if DAMPING not in fit.predictor.layout.keys:
        return []
    plain = with_smooth_errors(fit)
    base = with_trace_errors(fit, plain)
    best: dict[str, Difference] = {}
    for difference in forms_of(fit, base):
        estimated = _estimated(fit, plain, base, difference)
        if estimated is not None and (
            difference.name not in best or estimated.penalised_gain > best[difference.name].penalised_gain
        ):
            best[difference.name] = estimated
    return list(best.values())


def significant(estimated: Sequence[Difference], level: float) -> list[Difference]:
    """Significant differences that are confounded with the conditions, so that they could pass for physics. Random
    order and replicates separate a difference from the conditions; it is then a random deviation of the trials, which
    the fit includes. Differences by a column of the sheet make a model inadequate.
    """
    return [difference for difference in estimated if difference.confounded and difference.p < level / len(estimated)]


def between_fits(
    before: Fit, estimated: Sequence[Difference], best: float, report: Callable[[str], None]
) -> list[LikelihoodRatio]:
    """Fit the differences whose predicted gain is near the best Δχ² of the effects."""
    fitted: list[LikelihoodRatio] = []
    for difference in estimated:
        if difference.gain < MIN_LINEAR_GAIN or difference.gain < best - max(MAX_GAIN_SHORTFALL, 0.3 * best):
            continue
        report(f"fitting {difference.name}")
        fit = _fitted(before, difference)
        if fit is None:
            continue
        # Exponents of several vines are as many sizes, less the one they had; random effects are integrated out.
        sizes = max(len(fit.numbers) - len(before.numbers), 1) if difference.shared else 1
        ratio = likelihood_ratio(
            before, (_effect_of(difference),), fit, widened_by=_widened_by(difference), sizes=sizes
        )
        fitted.append(BetweenRatio(**{**vars(ratio), "difference": difference}))
    return fitted


def _widened_by(difference: Difference) -> tuple[str, ...]:
    """Names of the sizes whose scatter between trials reduces the significance of a difference. Those of its
    parameters; but the coefficient of a random effect depends on the few trials of its group only, and its robust
    standard error is meaningless.
    """
    random = any(math.isfinite(term.prior_sd) for term in difference.terms)
    return () if random else (difference.name, *difference.shared)


def _effect_of(difference: Difference) -> Effect:
    """The difference in the form of an effect, for the tables of candidates and the answer set."""
    drift = tuple(
        Parameter(name, term.symbol, term.unit, 0.0, plausible=(-PLAUSIBLE_DRIFT[name], PLAUSIBLE_DRIFT[name]))
        for term in difference.terms
        for name in [term.key.split(".")[1]]
        if difference.name == ORDER_DRIFT
    )
    keys = [term.key for term in difference.terms] or list(difference.shared)
    parameters = tuple(Parameter(key.split(".")[1], key, "", 0.0) for key in keys)
    return Effect(
        name=difference.name,
        kind=BETWEEN_TRIALS,
        summary=BETWEEN_SUMMARIES[difference.name],
        text=BETWEEN_SUMMARIES[difference.name],
        parameters=drift or parameters,
        functions={},
        needs=(),
        easily_taken_for=(),
        worked=(),
        path=Path(difference.name),
    )


def _estimated(fit: Fit, plain: Solution, base: Solution, difference: Difference) -> Difference | None:
    """The difference with its predicted gain and p-value; None where the gain is not finite."""
    gain = linear_gain(fit, base, difference)
    if not math.isfinite(gain):
        return None
    p = gain_p_value(fit, difference, gain)
    if p < SYSTEMATICS_CHECK_P_VALUE and difference.stated and difference.confounded:
        gain_with_errors = linear_gain(fit, with_shared_errors(fit, plain), difference)
        p = max(p, gain_p_value(fit, difference, gain_with_errors))
    return replace(difference, gain=gain, p=min(p * difference.n_forms, 1.0))


def _fitted(before: Fit, difference: Difference) -> Fit | None:
    """Fit of the difference; None where the fit fails."""
    between = (*before.predictor.layout.between, *difference.terms)
    try:
        fit = refit(before, between=between, shared=difference.shared, most_iterations=FIRST_ITERATIONS, thorough=False)
        return fit if fit.converged else refit(fit, most_iterations=MORE_ITERATIONS, thorough=False)
    except (FitError, SimulationError, np.linalg.LinAlgError):
        return None


def between_candidates(
    fitted: Sequence[LikelihoodRatio], answer: Sequence[str], rejected: Mapping[str, str]
) -> list[Candidate]:
    """Rows of the ranking of candidates for the differences that were fitted."""
    return [
        Candidate(
            hypothesis.names[0],
            BETWEEN_TRIALS,
            REFITTED,
            hypothesis.delta_chi2,
            hypothesis.sigma,
            hypothesis.numbers,
            hypothesis.plausible,
            hypothesis.names[0] in answer,
            rejected.get(hypothesis.names[0], hypothesis.reason),
            {},
            hypothesis.others if hypothesis.names[0] in answer else (),
        )
        for hypothesis in fitted
        if hypothesis.effects[-1].kind == BETWEEN_TRIALS
    ]


__all__ = ["BetweenRatio", "Difference", "between_candidates", "between_fits", "differences", "significant"]
