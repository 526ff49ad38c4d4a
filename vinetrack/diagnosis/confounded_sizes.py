"""What of a fitted size may belong to another effect that nobody can exclude: "this K includes up to … of drag".

Once an effect is in the model, what the other candidates could add on top is too weak to be named, but not zero: air is
never absent. Were another effect there with size s, the size θ of the added one would fall by L s, with
L = I_θθ⁻¹ I_θs the lever of the linear fit (`score_test.levers_of`). For s, what the trajectories say, N(ŝ, σ_s²), is
combined with what is plausible: a normal prior centred on absence, scaled so that 95 % of it lies within the farther
end of the plausible range, cut off where physics allows one sign only. L is the coefficient of omitted-variable bias;
with a prior for the omitted size it is Bayesian bias analysis. Effects are looked at one at a time and to first order,
and the interval stated is the hull of the fit's own and of the one with the other effect left open: at least 95 %.
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

MIN_SHIFT_SIGMAS = 1.0
"""Shift, in standard errors of the size, from which it is said. Chosen: a shift of one error leaves a 95 %
interval 83 %; at half (92 %) every correlated pair is listed, at twice (48 %) an interval misses the truth without a
word."""

MAX_LISTED = 3
"""Effects listed for each size. Chosen: a sentence that can be read; further ones are weaker."""

TWO_SIDED_95 = 1.959964
"""Derived: quantile of the normal distribution."""


def confounders_of(after: MisfitTests, added: Sequence[str]) -> tuple[Confounder, ...]:
    """Find, for each size of the added effects, the physical effects that a part of it may belong to.

    Parameters
    ----------
    after : the fit with the effects in, held against all other candidates.
    added : names of the effects whose sizes are asked about.

    Returns
    -------
    tuple of Confounder
        For each size those that could move it by more than its own standard error, the largest first.
    """
    if after.poorly_fitted or not after.sensitivities.shapes:
        return ()
    levers = levers_of(after.fit, after.products)
    chosen = []
    for k, number in enumerate(after.fit.numbers):
        if number.key.split(".")[0] in added and math.isfinite(number.sigma) and number.sigma > 0:
            likely = [confounder for confounder in _of_number(after, number, levers[k]) if _is_worth_saying(confounder)]
            chosen += sorted(likely, key=lambda confounder: -abs(confounder.value - number.value))[:MAX_LISTED]
    return tuple(chosen)


def _is_worth_saying(confounder: Confounder) -> bool:
    return abs(confounder.value - confounder.number.value) > MIN_SHIFT_SIGMAS * confounder.number.sigma


def _of_number(after: MisfitTests, number: Number, lever: Floats) -> list[Confounder]:
    """Every physical effect as a confounder of one number, in the shape that moves the number most."""
    physical = {effect.name: effect for effect in after.effects if effect.kind == "physical"}
    confounders = []
    for name in dict.fromkeys(after.sensitivities.effects):
        # An effect that holds the added one as a limit stands in its place, not beside it.
        if name not in physical or number.key.split(".")[0] in physical[name].replaces:
            continue
        each = [_in_shape(after, number, place, float(lever[place])) for place in after.ranked_shapes(name)]
        known = [confounder for confounder in each if confounder is not None]
        if known:
            confounders.append(max(known, key=lambda confounder: abs(confounder.value - number.value)))
    return confounders


def _in_shape(after: MisfitTests, number: Number, place: int, lever: float) -> Confounder | None:
    """One shape of an effect as a confounder; None where the data say nothing about its size."""
    shape = after.sensitivities.shapes[place]
    sigma = float(after.scores.sigma[place])
    if not shape.effect.parameters or shape.whole or not math.isfinite(sigma):
        return None
    mean, sd, limit = size_not_excluded(float(after.scores.size[place]), sigma, shape.size)
    expected = number.value - lever * mean
    half = _quantile(number) * math.hypot(number.sigma, lever * sd)
    lower, upper = _bounds(after, number)
    return Confounder(
        number=number,
        effect=shape.effect.name,
        symbol=shape.size.symbol,
        unit=shape.size.unit,
        limit=shape.size.zero + limit,
        value=min(max(number.value - lever * limit, lower), upper),
        low_95=max(min(number.low, expected - half), lower),
        high_95=min(max(number.high, expected + half), upper),
    )


def _bounds(after: MisfitTests, number: Number) -> tuple[float, float]:
    """What physics allows of a number, SI."""
    effect, _, name = number.key.partition(".")
    parameters = next(
        effect_of_model for effect_of_model in after.fit.model if effect_of_model.name == effect
    ).parameters
    return next(parameter.bounds for parameter in parameters if parameter.name == name)


def _quantile(number: Number) -> float:
    """How many standard errors half of the number's own 95 % interval holds."""
    half = 0.5 * (number.high - number.low) / number.sigma
    return max(half, TWO_SIDED_95) if math.isfinite(half) else TWO_SIDED_95


def size_not_excluded(estimate: float, sigma: float, parameter: Parameter) -> tuple[float, float, float]:
    """Combine what trajectories say of a size with what is plausible.

    Parameters
    ----------
    estimate, sigma : one-step estimate of the size, from the value without effect, and its standard error, SI.
    parameter : the size: plausible range and sign.

    Returns
    -------
    mean, sd, limit : float
        Of the truncated normal posterior, from the value without effect; the limit is its 5 % or 95 % quantile,
        whichever is farther from absence and allowed.
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
