"""Compiled loops over trials behind the likelihoods of spreads and noise, which a fit asks for some thousand times.

Each trial takes a handful of columns, so that most of the time of array operations goes into calling them.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from vinetrack.core.records import Floats

RIDGE = 1e-13
"""Added to systems of unit diagonal before they are solved. Derived: a few hundred roundings of a double."""

WELL_KNOWN = 1e-9
"""Part of its information that every number keeps once those before it are known, where a system is solved by its
factors; one of a smaller pivot is left to least squares, which drops what is singular. Derived: a step is then good to
1e-7, and the decrease by it, of second order, to 1e-14."""


@njit(cache=True, nogil=True, error_model="numpy")
def decrease_within_bounds(
    square: Floats, slope: Floats, below: Floats, above: Floats, free: NDArray[np.bool_]
) -> tuple[bool, float, float]:
    """Decrease by the step to the minimum of a quadratic form within bounds, as `mixed_effects.bounded_solve` takes it.

    Parameters
    ----------
    square : array, shape (n, n)
        Information.
    slope : array, shape (n,)
    below, above : arrays, shape (n,)
        Room to the bounds.
    free : array of bool, shape (n,)
        Numbers that may move.

    Returns
    -------
    solved : bool
        Whether every pivot is of weight; else the other two say nothing.
    decrease : float
    log_det : float
        Of the information among the numbers that no bound holds.
    """
    size = len(slope)
    moving, step = np.empty(size, np.bool_), np.zeros(size)
    for u in range(size):
        moving[u] = free[u] and square[u, u] > 0
    among, scale = np.empty(size, np.int64), np.empty(size)
    log_det, bounded = 0.0, True
    while bounded:
        count = 0
        for u in range(size):
            if moving[u]:
                among[count] = u
                scale[count] = 1 / math.sqrt(square[u, u])
                count += 1
        even, lower, way = np.empty((count, count)), np.empty((count, count)), np.empty(count)
        log_det, first = 0.0, np.inf
        for i in range(count):
            u = among[i]
            for j in range(i + 1):
                even[i, j] = scale[i] * square[u, among[j]] * scale[j]
            left = slope[u]
            for v in range(size):
                if not moving[v]:
                    left -= square[u, v] * step[v]
            way[i] = scale[i] * left
        _factor(even, 0.0, lower)
        for i in range(count):
            if not lower[i, i] > WELL_KNOWN:
                return False, 0.0, 0.0
            log_det += math.log(lower[i, i]) - 2 * math.log(scale[i])
        _solve(lower, way)
        for i in range(count):
            u = among[i]
            way[i] = scale[i] * way[i] - step[u]
            room = above[u] - step[u] if way[i] > 0 else -below[u] - step[u]
            if way[i] != 0:
                first = min(first, max(room / way[i], 0.0))
        bounded = first < 1
        for i in range(count):
            u = among[i]
            room = above[u] - step[u] if way[i] > 0 else -below[u] - step[u]
            if bounded and way[i] != 0 and max(room / way[i], 0.0) <= first:
                moving[u] = False
            step[u] += min(first, 1.0) * way[i]
    decrease = 0.0
    for u in range(size):
        along = 0.0
        for v in range(size):
            along += square[u, v] * step[v]
        decrease += step[u] * (2 * slope[u] - along)
    return True, decrease, log_det


@njit(cache=True, nogil=True, error_model="numpy")
def sums_without_deviations(
    blocks: Floats, places: NDArray[np.int_], roots: Floats, size: int
) -> tuple[Floats, Floats, float, float]:
    """What all trials say of the free numbers once the two deviations of each are integrated out.

    Parameters
    ----------
    blocks : array, shape (n_trials, 2 + n_keys + 1, 2 + n_keys + 1)
        Products of deviations, keys, residual.
    places : array of int, shape (n_trials, n_keys)
        Of the keys among the free numbers; `size` for one that a trial does not feel.
    roots : array, shape (n_trials, 2)
        Standard deviations of pressure and ln B, 0 where a trial does not feel one.
    size : int
        Number of free numbers.

    Returns
    -------
    information : array, shape (size, size)
    slope : array, shape (size,)
    square : float
        Sum of squares that is left of the residuals.
    log_det : float
        Of I + S Z S of all trials, S the standard deviations and Z the products of deviations.
    """
    last = blocks.shape[1] - 1
    information, slope = np.zeros((size + 1, size + 1)), np.zeros(size + 1)
    square, log_det = 0.0, 0.0
    of_pressure, of_damping = np.empty(last + 1), np.empty(last + 1)
    for i in range(len(blocks)):
        block, of = blocks[i], places[i]
        s, t = roots[i, 0], roots[i, 1]
        # One after the other, by the Cholesky factor of I + S Z S: the two are nearly the same where speed is steady,
        # and its inverse, written out, takes from the squares of precise positions more than is left of them.
        first = 1.0 + s * s * block[0, 0]
        for u in range(1, last + 1):
            of_pressure[u] = s * block[0, u] / math.sqrt(first)
        second = 1.0 + t * t * (block[1, 1] - of_pressure[1] * of_pressure[1])
        for u in range(2, last + 1):
            of_damping[u] = t * (block[1, u] - of_pressure[1] * of_pressure[u]) / math.sqrt(second)
        log_det += math.log(first) + math.log(second)
        for u in range(2, last + 1):
            for v in range(2, u + 1):
                left = block[u, v] - of_pressure[u] * of_pressure[v] - of_damping[u] * of_damping[v]
                if u < last:
                    information[of[u - 2], of[v - 2]] += left
                    if v < u:
                        information[of[v - 2], of[u - 2]] += left
                elif v < last:
                    slope[of[v - 2]] += left
                else:
                    square += left
    return information[:size, :size].copy(), slope[:size].copy(), square, log_det


@njit(cache=True, nogil=True, error_model="numpy")
def noise_at_correlations(
    cross_products: Floats, stiff: Floats, pull_back: Floats, points: Floats, rhos: Floats, shared: float, least: float
) -> tuple[Floats, Floats, Floats]:
    """What every trial leaves at each correlation of the noise once its own numbers are fitted.

    Parameters
    ----------
    cross_products : array, shape (n_trials, 3, m + 1, m + 1)
        Products of the trial's own numbers and the residual, see `whitening`.
    stiff, pull_back : arrays, shape (n_trials, m)
        Precision of the own numbers, and that times how far they are from their centre, in units of the noise.
    points : array, shape (n_trials,)
    rhos : array, shape (n_rhos,)
    shared : float
        Degrees of freedom that the shared numbers take of each trial.
    least : float
        Least part of the sum of squares that is left.

    Returns
    -------
    scores : array, shape (n_rhos,)
        −2 ln of the restricted likelihood, variances at their best, without what gaps add.
    squares, degrees : arrays, shape (n_rhos, n_trials)
        Sums of squares left and their degrees of freedom.
    """
    trials, m = stiff.shape
    scores = np.zeros(len(rhos))
    squares, degrees = np.empty((len(rhos), trials)), np.empty((len(rhos), trials))
    white, even, lower = np.empty((m + 1, m + 1)), np.empty((m, m)), np.empty((m, m))
    scale, way = np.empty(m), np.empty(m)
    for k in range(len(rhos)):
        rho = rhos[k]
        for i in range(trials):
            plain, mixed, shifted = cross_products[i, 0], cross_products[i, 1], cross_products[i, 2]
            for u in range(m + 1):
                for v in range(m + 1):
                    white[u, v] = plain[u, v] - rho * mixed[u, v] + rho * rho * shifted[u, v]
            log_det = 0.0
            for u in range(m):
                scale[u] = 1 / math.sqrt(white[u, u] + stiff[i, u])
                log_det -= 2 * math.log(scale[u])
            for u in range(m):
                for v in range(m):
                    even[u, v] = scale[u] * white[u, v] * scale[v]
                even[u, u] += scale[u] * stiff[i, u] * scale[u]
            _factor(even, 0.0, lower)
            for u in range(m):
                log_det += math.log(abs(lower[u, u]))
            _factor(even, RIDGE, lower)
            taken, gain = shared, 0.0
            for v in range(m):
                for u in range(m):
                    way[u] = scale[u] * white[u, v] * scale[v]
                _solve(lower, way)
                taken += way[v]
            for u in range(m):
                way[u] = scale[u] * (white[u, m] - pull_back[i, u])
            _solve(lower, way)
            for u in range(m):
                gain += scale[u] * (white[u, m] - pull_back[i, u]) * way[u]
            dof = max(points[i] - taken, 1.0)
            square = max(white[m, m] - gain, least * white[m, m])
            scores[k] += dof * math.log(square / dof) + log_det
            squares[k, i], degrees[k, i] = square, dof
    return scores, squares, degrees


@njit(cache=True, nogil=True, error_model="numpy")
def _factor(square: Floats, ridge: float, lower: Floats) -> None:
    """L and D of a symmetric matrix L D Lᵀ, D on the diagonal of `lower`; `ridge` is added to its diagonal."""
    size = len(square)
    for u in range(size):
        for v in range(u + 1):
            left = square[u, v] + (ridge if u == v else 0.0)
            for w in range(v):
                left -= lower[u, w] * lower[v, w] * lower[w, w]
            lower[u, v] = left if u == v else left / lower[v, v]


@njit(cache=True, nogil=True, error_model="numpy")
def _solve(lower: Floats, right: Floats) -> None:
    """Solve with the factors of `_factor`, in place."""
    size = len(right)
    for u in range(size):
        for v in range(u):
            right[u] -= lower[u, v] * right[v]
    for u in range(size):
        right[u] /= lower[u, u]
    for u in range(size - 1, -1, -1):
        for v in range(u + 1, size):
            right[u] -= lower[v, u] * right[v]
