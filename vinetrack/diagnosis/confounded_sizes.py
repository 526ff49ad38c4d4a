"""How much of a fitted size may belong to another, undetected effect: "this K includes up to … of drag".

Once an effect is in the model, the other candidates are too weak to be detected, but not zero: air is never absent. If
another effect were present with size s, the size θ of the added one would fall by L s, with L = I_θθ⁻¹ I_θs the
coefficient of omitted-variable bias of the linear fit (`score_test.levers_of`). The estimate of s from the
trajectories, N(ŝ, σ_s²), is combined with a normal prior centred on zero, scaled so that 95 % of it lies within the
farther end of the plausible range, and truncated where physics allows one sign only (Bayesian bias analysis). Effects
are considered one at a time and to first order. The interval stated is the hull of the fit's own and of the one with
the other effect left free: at least 95 %.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from vinetrack.core.records import Floats
from vinetrack.diagnosis.candidates import plausible_range
from vinetrack.diagnosis.confounder import Confounder
from vinetrack.diagnosis.misfit_tests import MisfitTests
from vinetrack.diagnosis.score_test import levers_of
from vinetrack.effects import Parameter
from vinetrack.inference.fit_result import Number

MIN_SHIFT_SIGMAS = 1.0  # Shift, in standard errors of the size, from which a confounder is reported (chosen)

MAX_LISTED = 3  # Confounders listed for each size (chosen)

TWO_SIDED_95 = 1.959964  # Derived: quantile of the normal distribution


def confounders_of(after: MisfitTests, added: Sequence[str]) -> tuple[Confounder, ...]:
    """Find, for each size of the added effects, the physical effects that it may include. Returns for each size, those
    that could shift it by more than its standard error, the largest first.
    """
    if after.poorly_fitted or not after.sensitivities.shapes:
        return ()
    levers = levers_of(after.fit, after.products)
    chosen = []
    for k, number in enumerate(after.fit.numbers):
        if number.key.split(".")[0] in added and math.isfinite(number.sigma) and number.sigma > 0:
            relevant = [confounder for confounder in _of_number(after, number, levers[k]) if _is_relevant(confounder)]
            chosen += sorted(relevant, key=lambda confounder: -abs(confounder.value - number.value))[:MAX_LISTED]
    return tuple(chosen)


def _is_relevant(confounder: Confounder) -> bool:
    return abs(confounder.value - confounder.number.value) > MIN_SHIFT_SIGMAS * confounder.number.sigma


def _of_number(after: MisfitTests, number: Number, lever: Floats) -> list[Confounder]:
    """Every physical effect as a confounder of one size, in the shape that shifts the size most."""
    physical = {effect.name: effect for effect in after.effects if effect.kind == "physical"}
    confounders = []
    for name in dict.fromkeys(after.sensitivities.effects):
        # An effect that contains the added one as a limit is an alternative to it, no confounder.
        if name not in physical or number.key.split(".")[0] in physical[name].replaces:
            continue
        by_shape = [_in_shape(after, number, k, float(lever[k])) for k in after.ranked_shapes(name)]
        informative = [confounder for confounder in by_shape if confounder is not None]
        if informative:
            confounders.append(max(informative, key=lambda confounder: abs(confounder.value - number.value)))
    return confounders


def _in_shape(after: MisfitTests, number: Number, index: int, lever: float) -> Confounder | None:
    """One shape of an effect as a confounder; None where the data hold no information about its size."""
    shape = after.sensitivities.shapes[index]
    sigma = float(after.scores.sigma[index])
    if not shape.effect.parameters or shape.whole or not math.isfinite(sigma):
        return None
    mean, sd, limit = size_not_excluded(float(after.scores.size[index]), sigma, shape.size)
    expected = number.value - lever * mean
    half_width = _quantile(number) * math.hypot(number.sigma, lever * sd)
    lower, upper = _bounds(after, number)
    return Confounder(
        number=number,
        effect=shape.effect.name,
        symbol=shape.size.symbol,
        unit=shape.size.unit,
        limit=shape.size.zero + limit,
        value=min(max(number.value - lever * limit, lower), upper),
        low_95=max(min(number.low, expected - half_width), lower),
        high_95=min(max(number.high, expected + half_width), upper),
    )


def _bounds(after: MisfitTests, number: Number) -> tuple[float, float]:
    """Bounds of a parameter, SI."""
    effect, _, name = number.key.partition(".")
    parameters = next(
        effect_of_model for effect_of_model in after.fit.model if effect_of_model.name == effect
    ).parameters
    return next(parameter.bounds for parameter in parameters if parameter.name == name)


def _quantile(number: Number) -> float:
    """Half width of the 95 % interval of a fitted size, in standard errors."""
    quantile = 0.5 * (number.high - number.low) / number.sigma
    return max(quantile, TWO_SIDED_95) if math.isfinite(quantile) else TWO_SIDED_95


def size_not_excluded(estimate: float, sigma: float, parameter: Parameter) -> tuple[float, float, float]:
    """Combine the estimate of a size with its plausible range (truncated normal posterior). Returns mean, sd, limit :
    float.
    """
    from scipy.stats import truncnorm

    low, high = plausible_range(parameter)
    prior_sd = max(abs(low - parameter.zero), abs(high - parameter.zero)) / TWO_SIDED_95
    precision = 1 / sigma**2 + 1 / prior_sd**2
    centre, width = estimate / sigma**2 / precision, 1 / math.sqrt(precision)
    lower, upper = (-math.inf, math.inf)
    if parameter.sign > 0:
        lower = 0.0
    elif parameter.sign < 0:
        upper = 0.0
    posterior = truncnorm((lower - centre) / width, (upper - centre) / width, loc=centre, scale=width)
    ends = [float(posterior.ppf(share)) for share in (0.05, 0.95)]
    return float(posterior.mean()), float(posterior.std()), max(ends, key=abs)
