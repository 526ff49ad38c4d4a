"""A small mixed-effects problem with random sensitivities, for tests of the statistics of the fit."""

from __future__ import annotations

import numpy as np
from scipy.linalg import toeplitz

from vinetrack.inference.marginal_likelihood import FitState, MixedProblem

RHO, SIGMA = 0.45, 0.3


def covariance(count: int, rho: float, sigma: float) -> np.ndarray:
    return np.asarray(sigma**2 * toeplitz(rho ** np.arange(count)))


def frame_of(n_trials: int, count: int, keys: int, flat_sd: float = 1e3) -> MixedProblem:
    return MixedProblem(
        index=np.tile(np.arange(keys), (n_trials, 1)),
        has_deviation=np.tile([False, True], (n_trials, 1)),
        gauge_error=np.zeros(n_trials),
        release_origin_mean=np.zeros((n_trials, 2)),
        release_origin_precision=np.full((n_trials, 2), flat_sd**-2),
        prior_mean=np.zeros(keys),
        prior_precision=np.zeros(keys),
        lower=np.full(keys, -np.inf),
        upper=np.full(keys, np.inf),
        free=np.ones(keys, dtype=bool),
        points=np.full(n_trials, float(count)),
        stretches=np.ones(n_trials),
        random=np.zeros(keys, dtype=bool),
    )


def state_of(n_trials: int, keys: int, spread: float, rho: float = RHO, sigma: float = SIGMA) -> FitState:
    variance = np.full(n_trials, sigma**2 * (1 - rho**2))
    return FitState(np.zeros(keys), np.zeros((n_trials, 4)), (1e-5, spread), rho, variance)


def columns_of(n_trials: int, count: int, keys: int, seed: int) -> list[np.ndarray]:
    """Random columns; the pressure deviation is silent, the deviation of B moves what the first key moves."""
    draw = np.random.default_rng(seed)
    out = []
    for _ in range(n_trials):
        shared = draw.standard_normal((count, keys))
        own = np.column_stack([draw.standard_normal(count), np.ones(count), np.zeros(count), shared[:, 0]])
        out.append(np.column_stack([own, shared, draw.standard_normal(count)]))
    return out
