"""Formatting of numbers: values with as many digits as their error justifies.

Used by terminal, report, figures and explorer alike.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

_FIXED_EXPONENTS = (-4, 6)  # Decimal exponents written without "e" (convention)

_MAX_FIXED_DECIMALS = 6  # Decimals beyond which value and error are written with a common power of ten (chosen)

_SUPERSCRIPTS = str.maketrans("0123456789", "⁰¹²³⁴⁵⁶⁷⁸⁹")

_MAX_DECIMALS = 12  # Derived: an error below 1e-11 is the rounding of a double of order 1e5


def decimals(sigma: float) -> int:
    """Return the number of decimals that shows two digits of an error, at most 12; 0 for an error of 0 or NaN."""
    return min(max(1 - math.floor(math.log10(sigma)), 0), _MAX_DECIMALS) if 0 < sigma < math.inf else 0


def or_nan(value: Any) -> float:
    """Return a number of a JSON file as a float; NaN for None, which means unknown."""
    return math.nan if value is None else float(value)


def number(value: float | None, digits: int = 3) -> str:
    """Return `value` to `digits` significant digits, without exponent from 0.0001 to 999999; "–" for None and NaN."""
    if value is None or not math.isfinite(value):
        return "–"
    if value == 0:
        return "0"
    exponent = math.floor(math.log10(abs(value)))
    if not _FIXED_EXPONENTS[0] <= exponent < _FIXED_EXPONENTS[1]:
        return f"{value:.{digits - 1}e}"
    return f"{value:.{max(digits - 1 - exponent, 0)}f}"


def with_error(value: float | None, sigma: float | None) -> str:
    """Return `value ± sigma`, the error to two significant digits and the value to the same decimal."""
    if value is None or not math.isfinite(value):
        return "–"
    if sigma is None or not math.isfinite(sigma) or sigma <= 0:
        return number(value)
    places = 1 - math.floor(math.log10(float(f"{sigma:.1e}")))  # 0.00999 rounds to 0.010
    if places > _MAX_FIXED_DECIMALS:
        power = 3 * ((places - 1) // 3)
        shown = max(places - power, 0)
        scaled = value * 10.0**power
        scaled = 0.0 if abs(scaled) < 0.5 * 10.0**-shown else scaled  # no "-0.0"
        return f"({scaled:.{shown}f} ± {sigma * 10.0**power:.{shown}f})·10⁻{str(power).translate(_SUPERSCRIPTS)}"
    return f"{value:.{max(places, 0)}f} ± {sigma:.{max(places, 0)}f}"


def interval(bounds: Sequence[float | None] | None) -> str:
    """Return `(low, high)` as "low to high", with decimals that suit its width; "–" if unknown."""
    if bounds is None or any(bound is None or not math.isfinite(bound) for bound in bounds):
        return "–"
    low, high = (float(bound) for bound in bounds if bound is not None)
    width = high - low
    places = min(max(1 - math.floor(math.log10(width)), 0), 6) if width > 0 else 2
    return f"{low:.{places}f} to {high:.{places}f}"


def with_interval(value: float | None, bounds: Sequence[float | None] | None) -> str:
    """Return `value (95 %: low to high)`, with decimals that suit the width; only the value if the bounds
    are unknown.
    """
    if value is None or bounds is None or any(bound is None or not math.isfinite(bound) for bound in bounds):
        return number(value)
    low, high = (float(bound) for bound in bounds if bound is not None)
    half = float(f"{(high - low) / 2:.1e}")  # 0.00999 rounds to 0.010
    places = min(max(1 - math.floor(math.log10(half)), 0), 6) if half > 0 else 3
    return f"{value:.{places}f} (95 %: {low:.{places}f} to {high:.{places}f})"
