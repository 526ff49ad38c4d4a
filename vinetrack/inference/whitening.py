"""Sums of products of a trial's columns under AR(1) noise, as a polynomial of its correlation.

With noise e_k = ρ e_{k−1} + s ε_k, the columns c_k enter every quantity of a fit through

    Σ (c_k − ρ c_{k−1})(c_k − ρ c_{k−1})ᵀ + (1 − ρ²) Σ_first c cᵀ = G₀ − ρ G₁ + ρ² G₂

so three small matrices a trial stand for all its points, whatever ρ turns out to be. `first` are the points that begin
a stretch without gaps; the noise of stretches is independent. Where noise varies from point to point, columns are
divided by each point's relative standard deviation first: what is left is AR(1) of one variance.

A step far off may take a trajectory beyond what numbers hold. Its sums are then infinite, or no numbers, and the step
is refused: nothing is said of it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from vinetrack.core.records import Floats


@np.errstate(over="ignore", invalid="ignore")
def products(columns: Floats, first: NDArray[np.bool_], relative_sd: Floats | None = None) -> Floats:
    """G₀, G₁, G₂ of one trial, shape (3, k, k), for columns of shape (n_points, k).

    `relative_sd`, shape (n_points,), is the noise of every point relative to that of the trial, see `FitTrial`.

    Parameters
    ----------
    columns : array, shape (n_points, k)
    first : array of bool, shape (n_points,)
        Points that begin a stretch.
    relative_sd : array, shape (n_points,), optional
        Noise of every point relative to that of the trial, see `FitTrial`.

    Returns
    -------
    array, shape (3, k, k)
    """
    if relative_sd is not None:
        columns = columns / relative_sd[:, None]
    if np.count_nonzero(first) == 1:
        now, before = columns[1:], columns[:-1]
        begin, end = columns[:1], columns[-1:]
    else:
        follows = np.flatnonzero(~first)
        now, before = columns[follows], columns[follows - 1]
        begin, end = columns[first], columns[np.append(first[1:], True)]
    whole, cross = columns.T @ columns, now.T @ before
    sums = np.empty((3, *whole.shape))
    # What has a follower is all but the last point of each stretch.
    sums[0], sums[1], sums[2] = whole, cross + cross.T, whole - end.T @ end - begin.T @ begin
    return sums


def all_products(
    columns: Sequence[Floats],
    first: Sequence[NDArray[np.bool_]],
    relative_sd: Sequence[Floats | None] | None = None,
) -> Floats:
    """`products` of every trial, shape (n_trials, 3, k, k).

    Parameters
    ----------
    columns : sequence of arrays, shape (n_points, k)
    first : sequence of arrays of bool
    relative_sd : sequence of arrays or None, optional

    Returns
    -------
    array, shape (n_trials, 3, k, k)
    """
    relative = [None] * len(columns) if relative_sd is None else relative_sd
    return np.stack([products(c, f, sd) for c, f, sd in zip(columns, first, relative, strict=True)])


@np.errstate(over="ignore", invalid="ignore")
def at_correlation(cross_products: Floats, rho: float) -> Floats:
    """Sums of whitened products at one correlation, shape (n_trials, k, k), in units of the innovations' variance 1.

    Parameters
    ----------
    cross_products : array, shape (n_trials, 3, k, k)
        From `all_products`.
    rho : float
        Lag-one correlation.

    Returns
    -------
    array, shape (n_trials, k, k)
    """
    return np.asarray(cross_products[:, 0] - rho * cross_products[:, 1] + rho**2 * cross_products[:, 2])


def whiten(residual: Floats, first: NDArray[np.bool_], rho: float, relative_sd: Floats | None = None) -> Floats:
    """Residuals freed of their correlation, same variance at the first point of a stretch as at the others.

    They have shape (n_points,), (n_points, k) or (m, n_points, k), `first` and `relative_sd` (n_points,).

    Parameters
    ----------
    residual : array, shape (n_points,), (n_points, k) or (m, n_points, k)
    first : array of bool, shape (n_points,)
        Points that begin a stretch.
    rho : float
        Lag-one correlation.
    relative_sd : array, shape (n_points,), optional
        Noise of every point relative to that of the trial.

    Returns
    -------
    array
        Of the shape of `residual`.
    """
    if relative_sd is not None:
        residual = residual / (relative_sd if residual.ndim == 1 else relative_sd[:, None])
    white = residual.copy()
    along, before = (np.swapaxes(values, 0, 1) if values.ndim == 3 else values for values in (white, residual))
    follows = np.flatnonzero(~first)
    along[follows] -= rho * before[follows - 1]
    along[first] *= np.sqrt(1 - rho**2)
    return white
