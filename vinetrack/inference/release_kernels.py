"""Compiled loop over the candidate releases of a trial: shift the trajectory, whiten its columns, take
cross products.

A search for releases evaluates some forty candidates per trial, a few times per fit; as array operations that was three
quarters of the time of a fit that continues from another.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from vinetrack.core.records import Floats


@njit(cache=True, nogil=True, error_model="numpy")
def products_at_releases(
    time_s: Floats,
    position_m: Floats,
    first: NDArray[np.bool_],
    relative_sd: Floats,
    releases_s: Floats,
    grid_s: Floats,
    curves: Floats,
    rho: float,
) -> Floats:
    """Whitened cross products of the columns and residual of a trial for each candidate release. Equivalent to
    `whitening.whiten` and a matrix product for each release. Curves are interpolated linearly, and constant beyond the
    ends of the grid. Returns the last column is the residual. Shapes: time_s, position_m, first, relative_sd
    (n_points,); releases_s (n_releases,); grid_s (n_grid,); curves (n_columns, n_grid) → (n_releases, n_columns,
    n_columns).
    """
    count, size, last = len(curves), len(time_s), len(grid_s) - 1
    begins = math.sqrt(1 - rho**2)
    plain, white = np.empty((count, size)), np.empty((count, size))
    products = np.empty((len(releases_s), count, count))
    for r in range(len(releases_s)):
        j = 0
        for i in range(size):
            since_s = min(max(time_s[i] - releases_s[r], 0.0), grid_s[last])
            while j < last - 1 and grid_s[j + 1] <= since_s:
                j += 1
            part = (since_s - grid_s[j]) / (grid_s[j + 1] - grid_s[j])
            for c in range(count):
                plain[c, i] = curves[c, j] + part * (curves[c, j + 1] - curves[c, j])
            plain[count - 1, i] = position_m[i] - plain[count - 1, i]
        for c in range(count):
            before = 0.0
            for i in range(size):
                value = plain[c, i] / relative_sd[i]
                white[c, i] = begins * value if first[i] else value - rho * before
                before = value
        products[r] = np.dot(white, white.T)
    return products
