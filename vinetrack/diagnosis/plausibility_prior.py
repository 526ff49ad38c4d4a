"""Priors from plausible ranges, and the marginal likelihoods and posterior probabilities of hypotheses with them.

A parameter whose plausible range is (a, b) has a normal prior of mean (a + b)/2 and standard deviation τ = (b − a)/4:
the range holds 95 % of it. With a likelihood that is normal about its maximum θ̂ with covariance Σ, the marginal
likelihood of a hypothesis is

    ln Z = ln L̂ + ½ ln det(2πΣ) + ln N(θ̂; m, Σ + T),   T = diag(τ²)

which is Laplace's approximation with the prior integrated exactly (Kass & Raftery, JASA 90, 773, 1995). Each parameter
of a hypothesis costs ln(σ/τ), and sizes outside the range cost more. What all hypotheses share cancels.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from vinetrack.core.records import Floats
from vinetrack.diagnosis.candidates import plausible_range, slip_of
from vinetrack.effects import Parameter
from vinetrack.inference.fit_result import Fit, Number

# Squared distance from the middle of a plausible range, in units of the prior variance, up to which a size is not
# penalised (derived)
RANGE_EDGE_DISTANCE = 4.0


def _prior_of(parameter: Parameter, number: Number) -> tuple[float, float]:
    """Mean and standard deviation of the prior of a plausible range, in the parameter's unit. A size that a common slip
    in the sheet would produce has its prior about that size, as wide as ordinary errors.
    """
    low, high = plausible_range(parameter)
    mean, sd = 0.5 * (low + high), 0.25 * (high - low)
    slip = slip_of(parameter, number.value, number.sigma)
    return (mean, sd) if slip is None else (slip[0] + (1 + slip[0]) * mean, (1 + slip[0]) * sd)


def prior_penalty(fit: Fit, parameters: Mapping[str, Parameter]) -> float:
    """Penalty of sizes outside their plausible ranges, on the scale of −2 ln L; 0 inside."""
    total = 0.0
    for number in fit.numbers:
        parameter = parameters.get(number.key)
        if parameter is None or not math.isfinite(number.sigma) or number.value == parameter.zero:
            continue
        mean, sd = _prior_of(parameter, number)
        variance = number.sigma**2 + sd**2
        if variance > 0:
            total += max((number.value - mean) ** 2 / variance - RANGE_EDGE_DISTANCE, 0.0)
    return total


def log_evidence(fit: Fit, parameters: Mapping[str, Parameter]) -> float:
    """Logarithm of the marginal likelihood Z of a hypothesis, up to a constant common to all fits of the same trials.
    Parameters that no trajectory depends on, or that have no finite standard error, keep their prior and cost nothing.
    """
    indices, means, sds = [], [], []
    for k, number in enumerate(fit.numbers):
        parameter = parameters.get(number.key)
        if parameter is not None and math.isfinite(number.sigma) and number.sigma > 0:
            mean, sd = _prior_of(parameter, number)
            if sd > 0:
                indices.append(k)
                means.append(mean)
                sds.append(sd)
    if not indices:
        return fit.log_likelihood
    values = np.array([fit.numbers[k].value for k in indices])
    scale = np.array(sds)
    covariance = fit.covariance[np.ix_(indices, indices)] / scale[:, None] / scale
    deviation = (values - np.array(means)) / scale
    predictive = covariance + np.eye(len(indices))
    occam = 0.5 * (_log_det(covariance) - _log_det(predictive))
    return float(fit.log_likelihood + occam - 0.5 * deviation @ np.linalg.solve(predictive, deviation))


def _log_det(matrix: Floats) -> float:
    return float(np.linalg.slogdet(matrix + 1e-300 * np.eye(len(matrix)))[1])


def posterior_weights(log_evidences: Sequence[float]) -> list[float]:
    """Posterior probabilities of hypotheses of equal prior probability; they add up to 1."""
    if not log_evidences:
        return []
    values = np.array(log_evidences)
    weights = np.exp(values - values.max())
    return [float(weight) for weight in weights / weights.sum()]
