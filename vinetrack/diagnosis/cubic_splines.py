"""Cubic B-splines, evaluated through the four that are nonzero at each position."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from vinetrack.core.records import Floats

N_NONZERO = 4  # Cubic splines that are nonzero between two knots (derived)


@lru_cache(maxsize=64)
def _pieces(knots: tuple[float, ...]) -> tuple[Floats, Floats]:
    """Knots, and the polynomials of the nonzero splines on each interval, shape (n_knots − 1, power, spline)."""
    from scipy.interpolate import BSpline, PPoly

    ends = np.array([knots[0]] * 3 + [*knots] + [knots[-1]] * 3)
    polynomials = np.array([PPoly.from_spline(BSpline(ends, unit, 3)).c[::-1] for unit in np.eye(len(knots) + 2)])
    pieces = [polynomials[k : k + N_NONZERO, :, 3 + k].T for k in range(len(knots) - 1)]
    return np.array(knots), np.array(pieces)


def nonzero_splines(at: Floats, knots: tuple[float, ...]) -> tuple[np.ndarray, Floats]:
    """Indices and values of the splines that are nonzero at each position; constant beyond the end knots. Returns first
    (the first of the four nonzero splines, of n_knots + 2), values (of these four; they sum to 1). Shapes: at (n,) →
    (n,).
    """
    breaks, pieces = _pieces(knots)
    inside = np.clip(at, breaks[0], breaks[-1])
    first = np.clip(np.searchsorted(breaks, inside, side="right") - 1, 0, len(pieces) - 1)
    offset = inside - breaks[first]
    polynomials = pieces[first]
    values = polynomials[:, 3]
    for power in (2, 1, 0):
        values = values * offset[:, None] + polynomials[:, power]
    return first, values


def splines(at: Floats, knots: Floats) -> Floats:
    """Design matrix of cubic B-splines on these knots; constant beyond the end knots. Shapes: at (n,); knots (n_knots,)
    → (n, n_knots + 2).
    """
    first, values = nonzero_splines(at, tuple(np.asarray(knots).tolist()))
    design = np.zeros((len(first), len(knots) + 2))
    np.put_along_axis(design, first[:, None] + np.arange(N_NONZERO), values, axis=1)
    return design


def uniform_splines(at: Floats, count: int) -> Floats:
    """Cubic B-splines on 0 to 1 with evenly spaced knots. Shapes: at (n,) → (n, count)."""
    return splines(at, np.array(uniform_knots(count)))


@lru_cache
def uniform_knots(count: int) -> tuple[float, ...]:
    """Knots of `uniform_splines`."""
    return tuple(np.linspace(0.0, 1.0, count - 2).tolist())
