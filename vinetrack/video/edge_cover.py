"""Fraction of each pixel that the film covers, for an edge blurred by optics (Gaussian) and by its own motion (box).

The fraction, called coverage, is tabulated at subpixel steps. Neighbouring columns lie a whole pixel apart, so that a
row of pixels reads every 1/TABLE_STEP_PX-th entry; the table is stored in that order, so that inner loops run over
neighbours in memory, without a branch.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit

TABLE_STEP_PX = 0.05  # Spacing of the coverage table, px (derived)
Z_STEP, Z_LAST = 0.02, 8.0  # Spacing and end of the table of the normal distribution (derived)
MIN_MOTION_BLUR_PX = 0.02  # Shorter motion blurs are set to this length (derived)
SUBPIXEL_STEPS = round(1 / TABLE_STEP_PX)  # Entries of the coverage table per pixel (derived)
NO_REFCOUNT: dict[str, Any] = {"_nrt": False}  # Numba option for functions that allocate nothing (measured)
_Z = np.arange(-Z_LAST, Z_LAST + 1.5 * Z_STEP, Z_STEP)
_NORMAL = np.array([[0.5 * math.erfc(-z / math.sqrt(2)), math.exp(-0.5 * z * z) / math.sqrt(2 * math.pi)] for z in _Z])
FASTMATH = {"contract", "arcp", "nsz", "reassoc"}  # Floating-point freedom of the compiler (chosen)


@njit(cache=True, nogil=True, fastmath=FASTMATH, error_model="numpy")
def _normal(z: float) -> tuple[float, float]:
    """Interpolate Φ(z) and its integral zΦ(z) + φ(z) from the table."""
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


@njit(cache=True, nogil=True, fastmath=FASTMATH, error_model="numpy")
def coverage_table(length: float, blur: float, half: float) -> np.ndarray:
    """Tabulate the coverage p and its slope dp/dx for one length of motion blur. Entry [j, k] is for x = middle − k + j
    TABLE_STEP_PX, with middle = ceil(half) + 1. p is the mean of the normal distribution function over a box of
    `length`, from ∫Φ = zΦ(z) + φ(z). Beyond `coverage_reach` it is 0 or 1. Shape (2, SUBPIXEL_STEPS + 1, 2 middle + 2).
    """
    middle = math.ceil(half) + 1
    length = max(length, MIN_MOTION_BLUR_PX)
    reach = coverage_reach(length, blur)
    table = np.zeros((2, SUBPIXEL_STEPS + 1, 2 * middle + 2))
    last = 2 * middle + 1
    # One half is the other one mirrored: p(−x) = 1 − p(x).
    for k in range(middle + 1):
        for j in range(SUBPIXEL_STEPS + 1):
            x = middle - k + j * TABLE_STEP_PX
            table[0, j, k] = 1.0
            if x < reach:
                cdf_a, sum_a = _normal((x + length / 2) / blur)
                cdf_b, sum_b = _normal((x - length / 2) / blur)
                table[0, j, k] = (sum_a - sum_b) * blur / length
                table[1, j, k] = (cdf_a - cdf_b) / length
                table[0, SUBPIXEL_STEPS - j, last - k] = 1.0 - table[0, j, k]
                table[1, SUBPIXEL_STEPS - j, last - k] = table[1, j, k]
    return table


@njit(cache=True, nogil=True, fastmath=FASTMATH, error_model="numpy")
def coverage_reach(length: float, blur: float) -> float:
    """Return the distance from an edge beyond which a pixel is fully covered or fully uncovered."""
    return 0.5 * length + 4 * blur + 0.5


@njit(cache=True, nogil=True, fastmath=FASTMATH, error_model="numpy")
def subpixel_index(place: float) -> tuple[int, int, float, int]:
    """Split the position of an edge into indices of a coverage table. Returns whole part, px; entry j below the
    fraction; weight of entry j + 1; 1 if the position is a whole number, else 0.
    """
    whole = math.floor(place)
    fraction = (place - whole) / TABLE_STEP_PX
    j = min(int(fraction), SUBPIXEL_STEPS - 1)
    return int(whole), j, fraction - j, 0 if fraction > 0 else 1
