"""Cross products of a trial's columns under AR(1) noise, as a polynomial of the noise correlation; and whitening.

With noise e_k = ρ e_{k−1} + s ε_k, the columns c_k enter every quantity of a fit through

    Σ (c_k − ρ c_{k−1})(c_k − ρ c_{k−1})ᵀ + (1 − ρ²) Σ_first c cᵀ = G₀ − ρ G₁ + ρ² G₂

so three small matrices per trial replace all its points, for any ρ. `first` marks the points that begin a stretch
without gaps; the noise of different stretches is independent. Where the noise varies from point to point, columns are
first divided by the relative standard deviation of each point, which leaves AR(1) noise of constant variance.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from vinetrack.core.records import Floats


@np.errstate(over="ignore", invalid="ignore")
def products(columns: Floats, first: NDArray[np.bool_], relative_sd: Floats | None = None) -> Floats:
    """G₀, G₁, G₂ of one trial. Shapes: columns (n_points, k); first, relative_sd (n_points,) → (3, k, k)."""
    if relative_sd is not None:
        columns = columns / relative_sd[:, None]
    if np.count_nonzero(first) == 1:
        later, earlier = columns[1:], columns[:-1]
        firsts, lasts = columns[:1], columns[-1:]
    else:
        with_predecessor = np.flatnonzero(~first)
        later, earlier = columns[with_predecessor], columns[with_predecessor - 1]
        firsts, lasts = columns[first], columns[np.append(first[1:], True)]
    all_points, lag_one = columns.T @ columns, later.T @ earlier
    matrices = np.empty((3, *all_points.shape))
    # The points with a successor are all but the last of each stretch.
    matrices[0], matrices[1], matrices[2] = (
        all_points,
        lag_one + lag_one.T,
        all_points - lasts.T @ lasts - firsts.T @ firsts,
    )
    return matrices


def all_products(
    columns: Sequence[Floats],
    first: Sequence[NDArray[np.bool_]],
    relative_sd: Sequence[Floats | None] | None = None,
) -> Floats:
    """`products` of every trial. Shapes: columns (n_points, k) → (n_trials, 3, k, k)."""
    relative = [None] * len(columns) if relative_sd is None else relative_sd
    return np.stack([products(c, f, sd) for c, f, sd in zip(columns, first, relative, strict=True)])


@np.errstate(over="ignore", invalid="ignore")
def at_correlation(cross_products: Floats, rho: float) -> Floats:
    """Whitened cross products at a given correlation, for innovations of variance 1. Shapes: cross_products (n_trials,
    3, k, k) → (n_trials, k, k).
    """
    return np.asarray(cross_products[:, 0] - rho * cross_products[:, 1] + rho**2 * cross_products[:, 2])


def whiten(residual: Floats, first: NDArray[np.bool_], rho: float, relative_sd: Floats | None = None) -> Floats:
    """Whiten residuals or columns under AR(1) noise; the first point of a stretch has the same variance as others.
    Shapes: residual, first, relative_sd (n_points,).
    """
    if relative_sd is not None:
        residual = residual / (relative_sd if residual.ndim == 1 else relative_sd[:, None])
    white = residual.copy()
    rows, earlier = (np.swapaxes(values, 0, 1) if values.ndim == 3 else values for values in (white, residual))
    with_predecessor = np.flatnonzero(~first)
    rows[with_predecessor] -= rho * earlier[with_predecessor - 1]
    rows[first] *= np.sqrt(1 - rho**2)
    return white
