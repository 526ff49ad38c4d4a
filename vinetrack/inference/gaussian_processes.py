"""Gaussian processes: the noise of positions and gauges, and smooth functions whose size the data choose."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from vinetrack.core.records import Floats

# ------------------------------------------------------------------------------
# Cross products of a trial's columns under AR(1) noise, as a polynomial of the noise correlation; and whitening.
#
# With noise e_k = ρ e_{k−1} + s ε_k, the columns c_k enter every quantity of a fit through
#
#     Σ (c_k − ρ c_{k−1})(c_k − ρ c_{k−1})ᵀ + (1 − ρ²) Σ_first c cᵀ = G₀ − ρ G₁ + ρ² G₂
#
# so three small matrices per trial replace all its points, for any ρ. `first` marks the points that begin a stretch
# without gaps; the noise of different stretches is independent. Where the noise varies from point to point, columns are
# first divided by the relative standard deviation of each point, which leaves AR(1) noise of constant variance.


@np.errstate(over="ignore", invalid="ignore")
def products(columns: Floats, first: NDArray[np.bool_], relative_sd: Floats | None = None) -> Floats:
    """G₀, G₁, G₂ of one trial. Shapes: columns (n_points, k); first, relative_sd (n_points,) → (3, k, k)."""
    if relative_sd is not None:
        columns = columns / relative_sd[:, None]
    firsts, lasts = columns[first], columns[np.append(first[1:], True)]
    # Of neighbours, but for those on either side of a gap; points with a successor, but for the first of each stretch
    lag_one = columns[1:].T @ columns[:-1] - firsts[1:].T @ lasts[:-1]
    all_points, ends = columns.T @ columns, np.concatenate([firsts, lasts])
    return np.stack([all_points, lag_one + lag_one.T, all_points - ends.T @ ends])


@np.errstate(over="ignore", invalid="ignore")
def at_correlation(cross_products: Floats, rho: float | Floats) -> Floats:
    """Whitened cross products, (n_trials, k, k), at a given correlation, for innovations of variance 1."""
    return np.asarray(cross_products[:, 0] - rho * cross_products[:, 1] + rho**2 * cross_products[:, 2])


def whiten(residual: Floats, first: NDArray[np.bool_], rho: float, relative_sd: Floats | None = None) -> Floats:
    """Whiten residuals or columns under AR(1) noise; the first point of a stretch has the same variance as others.
    Shapes: residual (n_points, …); first, relative_sd (n_points,).
    """
    if relative_sd is not None:
        residual = (residual.T / relative_sd).T
    white = residual.copy()
    white[1:] -= (residual[:-1].T * np.where(first[1:], 0.0, rho)).T
    white[first] *= np.sqrt(1 - rho**2)
    return white


# ------------------------------------------------------------------------------
# Smooth functions of a variable from 0 to 1: Gaussian processes whose size and smoothness the data choose.
#
# They are cubic B-splines at even steps (de Boor 2001, ch. IX), their coefficients a Gaussian process of covariance
#
#     a² (1 + s + s²/3) exp(−s),   s = √5 |u − u'|/ℓ
#
# between their centres: the Matérn kernel of order 5/2 (Rasmussen & Williams 2006, §4.2), products of it for two
# variables. Its functions are twice differentiable. The squared-exponential kernel, whose functions are infinitely
# smooth, gives bands that are far too narrow for a force such as a power of the growth.

# Length scales ℓ that are averaged over, as parts of the range (chosen)
LENGTH_SCALES = (0.05, 0.08, 0.14, 0.25, 0.45, 0.8, 1.6)

NEGLIGIBLE_LOG_RATIO = 5.0  # Log-likelihood below the best at which hyperparameters are left out of the mean (chosen)


def splines(at: Floats, count: int) -> Floats:
    """Design matrix of the splines; constant beyond 0 and 1. Shapes: at (n,) → (n, count)."""
    d = np.abs((count - 3) * np.clip(at, 0.0, 1.0)[:, None] + 1.0 - np.arange(count))
    return np.asarray((np.maximum(2.0 - d, 0.0) ** 3 - 4.0 * np.maximum(1.0 - d, 0.0) ** 3) / 6.0)


@lru_cache(maxsize=256)
def root_of_covariance(count: int, length: float, zero_at_start: bool = False) -> Floats:
    """Modes of the splines' coefficients at unit amplitude: a square root of their covariance, shape (count, count).
    `zero_at_start` conditions the function on being 0 at 0.
    """
    steps = np.arange(count)
    s = math.sqrt(5) * np.abs(steps[:, None] - steps) / ((count - 3) * length)
    covariance = (1 + s + s**2 / 3) * np.exp(-s)
    if zero_at_start:
        at_start = splines(np.zeros(1), count)[0]
        with_start = covariance @ at_start
        covariance = covariance - np.outer(with_start, with_start) / (at_start @ with_start)
    variances, vectors = np.linalg.eigh(covariance)
    return np.asarray(vectors * np.sqrt(np.maximum(variances, 0.0)))


def product_of_modes(roots: Sequence[Floats]) -> Floats:
    """Modes of a product of processes, without those of negligible variance, shape (n_splines, n_modes)."""
    modes = roots[0] if len(roots) == 1 else np.kron(*roots)
    variances = np.sum(modes**2, axis=0)
    # 1e-6: relative variance below which a mode is dropped (chosen)
    return np.asarray(modes[:, variances > 1e-6 * variances.max()])


class Posterior(NamedTuple):
    """Mean, (..., q), and covariance of coefficients given data, averaged over priors and amplitudes by their
    likelihood. `log_evidence` is relative to coefficients of 0; `hypothesis`, the place of a prior, and `amplitude` are
    likeliest.
    """

    mean: Floats
    covariance: Floats
    log_evidence: float
    hypothesis: int
    amplitude: float


def posterior(
    information: Floats, score: Floats, priors: Sequence[Floats], amplitudes: Floats, log_odds: Sequence[float] = ()
) -> Posterior:
    """Average over priors, given by their modes, and amplitudes, the same for all sets of coefficients. For given modes
    the information is diagonalised, so that the amplitude only changes how much each component is shrunk. Shapes:
    information (..., q, q); score (..., q); priors (q, n_modes); amplitudes (n_amplitudes,); log_odds (n_priors,).
    """
    odds = np.array(log_odds or [0.0] * len(priors))
    gained, components = [], []
    for modes in priors:
        values, vectors = np.linalg.eigh(modes.T @ information @ modes)
        directions = modes @ vectors
        along = (score[..., None, :] @ directions)[..., 0, :]
        sizes = amplitudes.reshape(-1, *[1] * along.ndim) ** 2
        widening = 1 + sizes * np.maximum(values, 0.0)
        shrunk = sizes / widening
        gains = 0.5 * (shrunk * along**2 - np.log(widening))
        gained.append(gains.reshape(len(amplitudes), -1).sum(axis=1))
        components.append((directions, shrunk, shrunk * along))
    logs = np.array(gained) + odds[:, None]
    prior, amplitude = divmod(int(np.argmax(logs)), len(amplitudes))
    likelihood = np.exp(logs - logs.max())
    weights = np.where(logs > logs.max() - NEGLIGIBLE_LOG_RATIO, likelihood, 0.0)
    weights /= weights.sum()
    mean, second_moment = np.zeros_like(score), np.zeros_like(information)
    for of_prior, (directions, variances, means) in zip(weights, components, strict=True):
        for weight, variance, along in zip(of_prior, variances, means, strict=True):
            if weight > 0:
                each = (directions @ along[..., None])[..., 0]
                mean += weight * each
                second_moment += weight * (directions * variance[..., None, :]) @ np.swapaxes(directions, -1, -2)
                second_moment += weight * each[..., :, None] * each[..., None, :]
    evidence = float(logs.max()) + math.log(float(likelihood.sum() / (np.exp(odds).sum() * len(amplitudes))))
    covariance = second_moment - mean[..., :, None] * mean[..., None, :]
    return Posterior(mean, covariance, evidence, prior, float(amplitudes[amplitude]))


def standard_error(basis: Floats, covariance: Floats) -> Floats:
    """Standard error of linear combinations of coefficients. Shapes: basis (n, q); covariance (q, q) → (n,)."""
    return np.asarray(np.sqrt(np.einsum("nk,kl,nl->n", basis, covariance, basis)))
