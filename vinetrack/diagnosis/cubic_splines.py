"""Cubic B-splines by the four that act at a place: of dozens of splines all others are nothing there."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from vinetrack.core.records import Floats

ACTING = 4
"""Cubic splines that act between two knots. Derived: order + 1."""


@lru_cache(maxsize=64)
def _pieces(knots: tuple[float, ...]) -> tuple[Floats, Floats]:
    """Knots, and the polynomials of the splines that act beyond each, shape (n_knots − 1, power, spline)."""
    from scipy.interpolate import BSpline, PPoly

    ends = np.array([knots[0]] * 3 + [*knots] + [knots[-1]] * 3)
    whole = np.array([PPoly.from_spline(BSpline(ends, only, 3)).c[::-1] for only in np.eye(len(knots) + 2)])
    pieces = [whole[k : k + ACTING, :, 3 + k].T for k in range(len(knots) - 1)]
    return np.array(knots), np.array(pieces)


def acting_splines(at: Floats, knots: tuple[float, ...]) -> tuple[np.ndarray, Floats]:
    """Which splines act at each place, and how much of each; constant beyond the ends.

    Parameters
    ----------
    at : array, shape (n,)
        Places.
    knots : tuple of float
        Rising.

    Returns
    -------
    first : array of int, shape (n,)
        The first of the four that act, of n_knots + 2.
    weights : array, shape (n, 4)
        Of these four; they sum up to 1.
    """
    breaks, pieces = _pieces(knots)
    inside = np.clip(at, breaks[0], breaks[-1])
    first = np.clip(np.searchsorted(breaks, inside, side="right") - 1, 0, len(pieces) - 1)
    beyond = inside - breaks[first]
    here = pieces[first]
    weights = here[:, 3]
    for power in (2, 1, 0):
        weights = weights * beyond[:, None] + here[:, power]
    return first, weights


def splines(at: Floats, knots: Floats) -> Floats:
    """Cubic B-splines on these knots, constant beyond the ends, shape (n, n_knots + 2).

    Parameters
    ----------
    at : array, shape (n,)
    knots : array, shape (n_knots,)
        Rising.

    Returns
    -------
    array, shape (n, n_knots + 2)
    """
    first, weights = acting_splines(at, tuple(np.asarray(knots).tolist()))
    whole = np.zeros((len(first), len(knots) + 2))
    np.put_along_axis(whole, first[:, None] + np.arange(ACTING), weights, axis=1)
    return whole
