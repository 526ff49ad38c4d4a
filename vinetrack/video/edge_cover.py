"""Fraction of a pixel that is covered by an edge blurred by optics (Gaussian) and by its own motion (a box).

Neighbouring columns lie a whole pixel apart, so that a row reads every 1/STEP-th entry of a table of covers. The table
is kept in that order: inner loops then run over neighbours in memory, without a branch.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit

STEP = 0.05
"""Spacing of the table of covers, px. Derived: linear interpolation errs by at most |p''|·STEP²/8, with |p''| ≤
0.242/blur² and the least blur of 0.4 px 5e-4."""
Z_STEP, Z_LAST = 0.02, 8.0
"""Spacing and end of the table of the normal distribution. Derived: cubic interpolation errs by Z_STEP⁴/384 of the
fourth derivative, 2e-10, and Φ(−8) = 6e-16."""
SHORTEST_PX = 0.02
"""Motion blur below which there is none. Derived: it changes covers by less than STEP does, by
p''·SHORTEST_PX²/24 < 1e-4."""
PHASES = round(1 / STEP)
"""Entries of a table of covers by pixel. Derived from STEP."""
VECTOR = 8
"""Pixels that are computed at a time. Derived: 512 bits are eight doubles; smaller processors take a part of them."""
BORROWED: dict[str, Any] = {"_nrt": False}
"""Option of Numba for functions that allocate nothing: slices of arrays are used without reference counting, which
takes longer than a row of 20 px does. Measured: a fit of an edge takes 0.75 of the time."""
_Z = np.arange(-Z_LAST, Z_LAST + 1.5 * Z_STEP, Z_STEP)
_NORMAL = np.array([[0.5 * math.erfc(-z / math.sqrt(2)), math.exp(-0.5 * z * z) / math.sqrt(2 * math.pi)] for z in _Z])
MATHS = {"contract", "arcp", "nsz", "reassoc"}
"""Floating-point freedom of the compiler: reordered sums, no care for the sign of zero. Chosen: NaN and infinity keep
their meaning."""


@njit(cache=True, nogil=True, fastmath=MATHS, error_model="numpy")
def _normal(z: float) -> tuple[float, float]:
    """Φ(z), and its integral zΦ(z) + φ(z), from the table."""
    if z <= -Z_LAST:
        return 0.0, 0.0
    if z >= Z_LAST:
        return 1.0, z
    at = (z + Z_LAST) / Z_STEP
    i = int(at)
    f = at - i
    low, high = _NORMAL[i, 0], _NORMAL[i + 1, 0]
    low_slope, high_slope = _NORMAL[i, 1], _NORMAL[i + 1, 1]
    z_low, z_high = i * Z_STEP - Z_LAST, (i + 1) * Z_STEP - Z_LAST
    low_sum, high_sum = z_low * low + low_slope, z_high * high + high_slope
    g = 1 - f
    a, b, c, d = (1 + 2 * f) * g * g, f * g * g * Z_STEP, f * f * (3 - 2 * f), f * f * g * Z_STEP
    return a * low + b * low_slope + c * high - d * high_slope, a * low_sum + b * low + c * high_sum - d * high


@njit(cache=True, nogil=True, fastmath=MATHS, error_model="numpy")
def cover_table(length: float, blur: float, half: float) -> np.ndarray:
    """Cover p and slope dp/dx, at x = middle − k + j STEP for k = 0, 1 … and j = 0 … PHASES; middle = ceil(half) + 1.

    p is the mean of the normal distribution function over a box of `length`: ∫Φ = zΦ(z) + φ(z). Beyond
    length/2 + 4 blur + 0.5 it is 0 or 1.

    Parameters
    ----------
    length : of the motion blur, px.
    blur : standard deviation of the optical blur, px.
    half : largest distance from the edge that is needed, px.

    Returns
    -------
    p and dp/dx, shape (2, PHASES + 1, 2 middle + 2 + VECTOR).
    """
    middle = math.ceil(half) + 1
    length = max(length, SHORTEST_PX)
    reach = cover_reach(length, blur)
    table = np.zeros((2, PHASES + 1, 2 * middle + 2 + VECTOR))
    for k in range(2 * middle + 2):
        for j in range(PHASES + 1):
            x = middle - k + j * STEP
            if x >= reach:
                table[0, j, k] = 1.0
            elif x > -reach:
                cdf_a, sum_a = _normal((x + length / 2) / blur)
                cdf_b, sum_b = _normal((x - length / 2) / blur)
                table[0, j, k] = (sum_a - sum_b) * blur / length
                table[1, j, k] = (cdf_a - cdf_b) / length
    return table


@njit(cache=True, nogil=True, fastmath=MATHS, error_model="numpy")
def cover_reach(length: float, blur: float) -> float:
    """Distance from an edge beyond which a pixel is bare or covered.

    Parameters
    ----------
    length : of the motion blur, px.
    blur : standard deviation of the optical blur, px.

    Returns
    -------
    px.
    """
    return 0.5 * length + 4 * blur + 0.5


@njit(cache=True, nogil=True, fastmath=MATHS, error_model="numpy")
def phase(place: float) -> tuple[int, int, float, int]:
    """Split the place of an edge into the indices of a table of covers.

    Parameters
    ----------
    place : of the edge, px.

    Returns
    -------
    the whole part, px; the entry j below the fraction; the weight of the entry above; 1 where there is no fraction.
    """
    whole = math.floor(place)
    fraction = (place - whole) / STEP
    j = min(int(fraction), PHASES - 1)
    return int(whole), j, fraction - j, 0 if fraction > 0 else 1
