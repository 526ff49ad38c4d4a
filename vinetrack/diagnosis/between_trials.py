"""Differences between trials as explanations: n by vine, drift with the order of trials, specimens, days.

A tube that wears, another tube for the high pressures or a gauge whose zero moves from day to day changes B or the
pressure of whole groups of trials. Where all replicates of a condition share the group, that looks exactly like physics
that follows the condition. So such differences are hypotheses of the diagnosis like the effects of the catalogue:

    ln B_j          = ln B_vine + Σ_g a_g z_gj + u_j
    P_j / P_set,j   = 1         + Σ_g b_g z_gj + v_j        u_j, v_j random from trial to trial

with z_gj the number of trials that the vine (or specimen) of trial j has seen (pressure: all trials before, as a supply
empties or a regulator creeps; or 1 from some trial on, as a regulator is set anew), or 1 in group g and 0 elsewhere
(pressure: 1 kPa / P_set,j, a shift of the zero of the gauge or of P_y, which are the same to a force (P − P_y) A).
Coefficients of groups are random effects with a prior, integrated out of the likelihood, so that a hypothesis with many
groups pays for each of them; a drift has one coefficient, fixed. All are compared by the same Δχ² as effects are.
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

PLAUSIBLE_DRIFT = {"B": 0.05, "P": 0.01, "step": 0.05}
"""Change of ln B a trial that is still plausible, of ln P, and of ln P at once. Chosen: a tube whose B rises by 5 % a
trial is done for after ten; a supply that loses 1 % a trial has lost a fifth after twenty, and somebody has looked at
the gauge; a regulator is set to 5 %, as `pressure_gain` has it."""

MAX_GAIN_SHORTFALL = 40.0
"""How far in −2 ln L the linear estimate may stay behind the best hypothesis and still be fitted. Chosen: well above
the answer set's 9 times the usual inflation of 1 to 3; twice as much only costs time."""

MIN_LINEAR_GAIN = 2.0
"""Fall of −2 ln L below which a difference is not fitted. Chosen: a fifth of what the gate asks for."""

SYSTEMATICS_CHECK_P_VALUE = 0.01
"""Chance below which a difference is also asked beside the errors that all replicates of a condition share. Chosen for
time: three times the level of all tests of a first model, so that at half of it as at twice nothing that would be
called goes unasked; beside more errors no difference gains chance."""

FIRST_ITERATIONS, MORE_ITERATIONS = 14, 30
"""Iterations of the fit of a difference: at first, and in all. Chosen for time; a fit that has not settled by then says
so."""


@dataclass(frozen=True)
class BetweenRatio(LikelihoodRatio):
    """The likelihood ratio of a difference between trials; `difference` tells which."""

    difference: Difference = field(default_factory=lambda: Difference(""))

    @property
    def numbers(self) -> tuple[Number, ...]:
        """Its coefficients, or the exponents of the vines."""
        keys = {term.key for term in self.difference.terms} | set(self.difference.shared)
        return tuple(number for number in self.fit.numbers if number.key in keys and math.isfinite(number.sigma))

    @property
    def others(self) -> tuple[Number, ...]:
        """All other numbers of its fit."""
        keys = {number.name for number in self.numbers}
        return tuple(number for number in self.fit.numbers if number.name not in keys)


def differences(fit: Fit) -> list[Difference]:
    """The hypotheses that trials differ which these data allow, each with its linear estimate.

    Parameters
    ----------
    fit
        The fit that is questioned.

    Returns
    -------
    list
        Of the forms of a hypothesis (B, pressure, both) the one that gains most.
    """
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


def significant(among: Sequence[Difference], level: float) -> list[Difference]:
    """Differences that are no chance, and that follow the conditions so closely that they may pass for physics.

    One that random order or replicates keep apart from the conditions is a random deviation of the trials, which the
    fit allows for. Those that the sheet states make a model inadequate of themselves. The others go by the order of the
    rows, which need not be that of the trials: they decide nothing, and are told beside a model that is adequate.

    Parameters
    ----------
    among : sequence of Difference
        Those that were estimated.
    level : float
        Chance of a false alarm of them all (Bonferroni).

    Returns
    -------
    list of Difference
    """
    return [difference for difference in among if difference.confounded and difference.p < level / len(among)]


def between_fits(
    before: Fit, among: Sequence[Difference], best: float, report: Callable[[str], None]
) -> list[LikelihoodRatio]:
    """Fits of the differences whose estimate comes near the `best` Δχ² of the effects.

    Parameters
    ----------
    before
        The fit that is questioned.
    among : sequence of Difference
        Those that were estimated.
    best : float
        Largest Δχ² of the effects.
    report : callable
        Called with a sentence at each fit.

    Returns
    -------
    list of LikelihoodRatio
    """
    fitted: list[LikelihoodRatio] = []
    for difference in among:
        if difference.gain < MIN_LINEAR_GAIN or difference.gain < best - max(MAX_GAIN_SHORTFALL, 0.3 * best):
            continue
        report(f"fitting {difference.name}")
        fit = _fitted(before, difference)
        if fit is None:
            continue
        ratio = likelihood_ratio(before, (_effect_of(difference),), fit, widened_by=_widened_by(difference))
        fitted.append(BetweenRatio(**{**vars(ratio), "difference": difference}))
    return fitted


def _widened_by(difference: Difference) -> tuple[str, ...]:
    """Names whose scatter from trial to trial takes away from the significance of a difference.

    Those of its numbers; but a coefficient of a random effect, which only the few trials of its group feel, has a
    robust error that says nothing.
    """
    random = any(math.isfinite(term.prior_sd) for term in difference.terms)
    return () if random else (difference.name, *difference.shared)


def _effect_of(difference: Difference) -> Effect:
    """A stand-in for the effect that the tables of candidates and the answer set show."""
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
    """The difference with its linear estimate; None where it cannot be laid out."""
    gain = linear_gain(fit, base, difference)
    if not math.isfinite(gain):
        return None
    p = gain_p_value(fit, difference, gain)
    if p < SYSTEMATICS_CHECK_P_VALUE and difference.stated and difference.confounded:
        beside = linear_gain(fit, with_shared_errors(fit, plain), difference)
        p = max(p, gain_p_value(fit, difference, beside))
    return replace(difference, gain=gain, p=min(p * difference.n_forms, 1.0))


def _fitted(before: Fit, difference: Difference) -> Fit | None:
    """The difference fitted; None where it cannot be followed."""
    between = (*before.predictor.layout.between, *difference.terms)
    try:
        fit = refit(before, between=between, shared=difference.shared, most_iterations=FIRST_ITERATIONS, thorough=False)
        return fit if fit.converged else refit(fit, most_iterations=MORE_ITERATIONS, thorough=False)
    except (FitError, SimulationError, np.linalg.LinAlgError):
        return None


def between_candidates(
    tried: Sequence[LikelihoodRatio], answer: Sequence[str], aside: Mapping[str, str]
) -> list[Candidate]:
    """Rows of the ranking of candidates for the differences that were fitted.

    Parameters
    ----------
    tried : sequence of LikelihoodRatio
        Hypotheses that were fitted.
    answer : sequence of str
        Names in the answer set.
    aside : mapping
        Why those set aside were, by name.

    Returns
    -------
    list of Candidate
    """
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
            aside.get(hypothesis.names[0], hypothesis.reason),
            {},
            hypothesis.others if hypothesis.names[0] in answer else (),
        )
        for hypothesis in tried
        if hypothesis.effects[-1].kind == BETWEEN_TRIALS
    ]


__all__ = ["BetweenRatio", "Difference", "between_candidates", "between_fits", "differences", "significant"]
