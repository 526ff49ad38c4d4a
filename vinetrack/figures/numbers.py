"""Numbers as people read them: a value to the digit its error allows."""

from __future__ import annotations

import math
from collections.abc import Sequence


def number(value: float | None, digits: int = 3) -> str:
    """`value` to `digits` significant digits, without an exponent where a person would write none; – where absent."""
    if value is None or not math.isfinite(value):
        return "–"
    if value == 0:
        return "0"
    exponent = math.floor(math.log10(abs(value)))
    if not -4 <= exponent < 6:
        return f"{value:.{digits - 1}e}"
    return f"{value:.{max(digits - 1 - exponent, 0)}f}"


def with_error(value: float | None, sigma: float | None) -> str:
    """`value ± sigma`, the error to two significant digits and the value to the same place.

    >>> with_error(0.36981, 0.0123)
    '0.370 ± 0.012'
    """
    if value is None or not math.isfinite(value):
        return "–"
    if sigma is None or not math.isfinite(sigma) or sigma <= 0:
        return number(value)
    places = 1 - math.floor(math.log10(float(f"{sigma:.1e}")))  # 0.00999 is written 0.010, and counts as that
    if places > 6:
        return f"{value:.3e} ± {sigma:.1e}"
    return f"{value:.{max(places, 0)}f} ± {sigma:.{max(places, 0)}f}"


def interval(bounds: Sequence[float | None] | None) -> str:
    """`[lo, hi]` as "lo to hi", both to the digit that the width of the interval allows; – where unknown."""
    if bounds is None or any(bound is None or not math.isfinite(bound) for bound in bounds):
        return "–"
    low, high = (float(bound) for bound in bounds if bound is not None)
    width = high - low
    places = 2 - math.floor(math.log10(width)) if width > 0 else 3
    places = min(max(places - 1, 0), 6)
    return f"{low:.{places}f} to {high:.{places}f}"


def half_width(bounds: Sequence[float | None] | None) -> float:
    """Half the width of an interval, NaN where it is unknown."""
    if bounds is None or any(bound is None for bound in bounds):
        return math.nan
    low, high = (float(bound) for bound in bounds if bound is not None)
    return (high - low) / 2
