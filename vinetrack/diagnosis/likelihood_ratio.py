"""Hypotheses: fits of candidate effects, likelihood ratios, the plausibility of sizes, and the answer set.

The answer set holds every hypothesis that the data cannot exclude. Which are fitted is in `selection`.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.special import hyperu, ndtri_exp

from vinetrack.core.problems import Remark, remark
from vinetrack.diagnosis.misfit_tests import is_plausible
from vinetrack.dynamics.model import Model
from vinetrack.dynamics.simulate import SimulationError
from vinetrack.effects import Effect, Parameter
from vinetrack.inference.errors import FEWEST_CLUSTERS, robust_variances
from vinetrack.inference.fit import refit
from vinetrack.inference.fit_data import FitError
from vinetrack.inference.fit_result import Fit, Number
from vinetrack.inference.optimiser import is_poor_fit

# ------------------------------------------------------------------------------
# Hypotheses compared with the fit without them, and the answer set: those that the data cannot exclude.

ANSWER_SET_DELTA_CHI2 = 9.0  # A hypothesis whose −2 ln L lies within this of the best cannot be excluded (derived)

# −2 ln L behind the best from which a hypothesis is not looked at again, whatever the scatter of trials (chosen)
OUT_OF_REACH = 54.0

CREDIBLE_RANGE_FACTOR = 3.0  # Multiple of its plausible range within which a size is still credible (chosen)


@dataclass(frozen=True)
class LikelihoodRatio:
    """A hypothesis compared with the fit without it: the effects it adds, its own fit, and the likelihood ratio.
    `delta_chi2` is the fall of −2 ln L, `sigma` the normal deviate as unlikely as that with one degree of freedom a
    size, reduced where trials scatter more than the noise model predicts.
    """

    effects: tuple[Effect, ...]
    fit: Fit
    delta_chi2: float
    sigma: float
    plausible: bool
    reason: Remark
    credible: bool = True
    inflation: float = 1.0
    split: tuple[str, ...] = ()  #: parameters of the model that it splits by groups of trials

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the effects that it adds."""
        return tuple(effect.name for effect in self.effects)

    @property
    def label(self) -> str:
        """Names of the effects, joined by `+`."""
        return "+".join(self.names)

    @property
    def n_parameters(self) -> int:
        """Number of parameters of its effects."""
        return sum(len(effect.parameters) for effect in self.effects)

    @property
    def numbers(self) -> tuple[Number, ...]:
        """Fitted sizes of its effects, without those that no trajectory depends on."""
        return tuple(number for number in self.fit.numbers if self._adds(number) and math.isfinite(number.sigma))

    @property
    def others(self) -> tuple[Number, ...]:
        """All other parameters of its fit."""
        return tuple(number for number in self.fit.numbers if not self._adds(number))

    def _adds(self, number: Number) -> bool:
        return number.key.split(".")[0] in self.names or number.key in self.split

    def contains(self, other: LikelihoodRatio) -> bool:
        """Whether another hypothesis is a limit of this one, which fits as well by construction."""
        return any(name in other.names for effect in self.effects for name in effect.replaces)

    def deviance_excess(self, other: LikelihoodRatio) -> float:
        """−2 ln L of this hypothesis minus that of another."""
        return 2 * (other.fit.log_likelihood - self.fit.log_likelihood)


def best_of(hypotheses: Iterable[LikelihoodRatio]) -> LikelihoodRatio:
    """The hypothesis with the highest likelihood."""
    return max(hypotheses, key=lambda hypothesis: hypothesis.fit.log_likelihood)


def likelihood_ratio(
    before: Fit,
    effects: Sequence[Effect],
    after: Fit,
    *,
    widened_by: Collection[str] | None = None,
    sizes: int | None = None,
) -> LikelihoodRatio:
    """Compare a refit with the fit without the effects."""
    delta_chi2 = 2 * (after.log_likelihood - before.log_likelihood)
    ratio = robust_ratio(after, [effect.name for effect in effects] if widened_by is None else widened_by)
    reason = implausible(effects, after)
    return LikelihoodRatio(
        effects=tuple(effects),
        fit=after,
        delta_chi2=delta_chi2,
        sigma=in_sigmas(delta_chi2 / ratio**2, sizes_of(effects, after) if sizes is None else sizes),
        plausible=not reason,
        reason=reason,
        credible=not implausible(effects, after, CREDIBLE_RANGE_FACTOR),
        inflation=ratio**2,
    )


def size_in_errors(effect: Effect, after: Fit) -> float:
    """Size of an effect in standard errors; the largest where each vine has its own; infinite where none is known."""
    sizes = [
        abs(number.value - parameter.zero) / number.sigma
        for parameter in effect.parameters[:1]
        for number in after.numbers
        if number.key == f"{effect.name}.{parameter.name}" and 0 < number.sigma < math.inf
    ]
    return max(sizes, default=math.inf)


def sizes_of(effects: Sequence[Effect], after: Fit) -> int:
    """Number of sizes of effects in a fit, the degrees of freedom of their likelihood ratio: the first parameter of
    each, for all trials or for each vine or day. The others shape it: where its size is zero nothing depends on them,
    so that Wilks' theorem does not hold (Davies, Biometrika 74, 33, 1987): it is the largest ratio of many.
    """
    sizes = [f"{effect.name}.{effect.parameters[0].name}" if effect.parameters else "" for effect in effects]
    return sum(max(sum(number.key == size for number in after.numbers), 1) for size in sizes)


def in_sigmas(delta_chi2: float, degrees_of_freedom: int) -> float:
    """Normal deviate of the same two-sided tail probability as Δχ² with these degrees of freedom (Wilks' theorem).
    Returns negative where the fit is worse; with several degrees of freedom 0 where it is no better than chance makes
    it.
    """
    if degrees_of_freedom < 2 or delta_chi2 <= 0:
        return math.copysign(math.sqrt(abs(delta_chi2)), delta_chi2)
    # Also where the tail probability underflows: Γ(a, x) = xᵃ e⁻ˣ U(1, 1 + a, x), https://dlmf.nist.gov/8.5.E3.
    a, x = 0.5 * degrees_of_freedom, 0.5 * delta_chi2
    log_p = a * math.log(x) - x - math.lgamma(a) + math.log(hyperu(1, 1 + a, x))
    return max(float(-ndtri_exp(log_p - math.log(2))), 0.0)


def implausible(effects: Sequence[Effect], after: Fit, widened: float = 1.0, errors: float = 1.0) -> Remark:
    """Why the fitted sizes are not plausible; blank where they are, or might be within so much of their errors."""
    parameters = {f"{effect.name}.{parameter.name}": parameter for effect in effects for parameter in effect.parameters}
    for number in after.numbers:
        if (parameter := parameters.get(number.key)) is None or not math.isfinite(number.sigma):
            continue
        low, high = parameter.plausible or (math.nan, math.nan)
        # At a bound outside the plausible range the size is implausible whatever its standard error.
        at_implausible_bound = math.isfinite(number.bound) and (number.bound < low or number.bound > high)
        if at_implausible_bound or not is_plausible(
            parameter, number.value, number.sigma, widened=widened, errors=errors
        ):
            unit = "" if parameter.unit == "1" else parameter.unit
            facts = {"symbol": number.symbol, "value": number.value, "unit": unit, "low": low, "high": high}
            return Remark("implausible_size", facts | {"pressure_unit": number.pressure_unit})
    return Remark()


def robust_ratio(after: Fit, names: Collection[str]) -> float:
    """Ratio of the standard error of a size from the scatter of trials to that from the noise model; at least 1. The
    largest of all these sizes.
    """
    if not names or len(after.predictor.data) < FEWEST_CLUSTERS:
        return 1.0
    plain, variance, _ = robust_variances(after.predictor, after.solution)
    ratios = [
        float(variance[k] / plain[k, k])
        for k, number in enumerate(after.numbers)
        if (number.key.split(".")[0] in names or number.key in names) and plain[k, k] > 0
    ]
    return math.sqrt(max([1.0, *ratios]))


def answer_set(hypotheses: Sequence[LikelihoodRatio]) -> tuple[list[LikelihoodRatio], dict[str, Remark]]:
    """Hypotheses that cannot be excluded, the best first, and for those rejected the reason in words. A hypothesis is
    excluded if its −2 ln L, divided by the best one's inflation, is more than 9 above the best. Returns members,
    rejected (reason by label; hypotheses excluded by their likelihood alone are not listed).
    """
    best = best_of(hypotheses)
    reach = ANSWER_SET_DELTA_CHI2 * best.inflation
    likely = [hypothesis for hypothesis in hypotheses if hypothesis.deviance_excess(best) <= reach]
    likely.sort(key=lambda ratio: -ratio.fit.log_likelihood)
    # Sizes outside the plausible range are believed where no other hypothesis has plausible ones.
    credible = [ratio for ratio in likely if ratio.credible]
    plausible = [ratio for ratio in credible if ratio.plausible] or credible or likely
    rejected = {ratio.label: ratio.reason for ratio in likely if ratio not in plausible}
    members = []
    for ratio in plausible:
        simpler = [
            other
            for other in plausible
            if ratio.contains(other)
            and other.n_parameters < ratio.n_parameters
            and other.deviance_excess(ratio) <= reach
        ]
        if simpler:
            rejected[ratio.label] = remark("contains_and_fits_no_better", name=simpler[0].names[-1])
        else:
            members.append(ratio)
    return members, rejected


# ------------------------------------------------------------------------------
# Fits of hypotheses.


def stand_in(name: str, kind: str = "physical", parameters: tuple[Parameter, ...] = ()) -> Effect:
    """What stands for a hypothesis that is no effect in tables of candidates and answer sets."""
    return Effect(name=name, kind=kind, summary=name, text=name, parameters=parameters, functions={}, path=Path(name))


FAR_BEHIND = 50.0  # Difference of ln L to another hypothesis at which a fit is given up (chosen)


def full_fit(before: Fit, model: Model | None = None, *, best: float = -math.inf, **how: Any) -> Fit | None:
    """Refit with another model, or other options of `refit`; None where the fit fails. `best` is the largest ln L of
    other hypotheses: a fit that stays far behind it, or far off the tracks, is given up.
    """
    try:
        # 14, 40: iterations of a full fit at first, and of one that is near then (chosen)
        fit = refit(before, model, most_iterations=14, least=best - FAR_BEHIND, **how)
        if fit.converged or fit.iterations < 14 or is_poor_fit(fit.predictor, fit.solution):
            return fit
        return refit(fit, most_iterations=40, least=best - FAR_BEHIND)
    except (FitError, SimulationError, np.linalg.LinAlgError):
        return None
