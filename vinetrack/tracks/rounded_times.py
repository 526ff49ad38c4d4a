"""Restore times of frames that a file holds with too few digits.

Frames 0.935 ms apart, written to the millisecond, deviate from the motion by up to half a millisecond, 2 mm at 4 m/s,
and two of them may share the same time. Where all times of a file lie within half their last digit of an evenly spaced
series, that series is used.
"""

from __future__ import annotations

import numpy as np

from vinetrack.core.records import Floats

FEWEST_TIMES = 8  # Fewest times from which an even series is recognised (measured)

TOLERANCE_DIGITS = 0.75  # Last digits by which a time may deviate from the series (derived)

LEAST_DIGIT_PART = 0.01  # Last digit, as a part of a frame, from which times are restored (chosen)

MOST_DECIMALS = 7  # Decimals from which a time does not count as rounded (chosen)


def unrounded_times(time_s: Floats) -> tuple[Floats, str]:
    """Times of evenly spaced frames before they were rounded, and a sentence that says so. Returns time_s (unchanged
    where they are not rounded, or not evenly spaced), note (blank where nothing was done). Shapes: time_s (n,) → (n,).
    """
    digit_s = _last_digit_s(time_s) if time_s.size >= FEWEST_TIMES else 0.0
    if digit_s == 0:
        return time_s, ""
    place = np.arange(time_s.size, dtype=float)
    step_s, first_s = np.polyfit(place, time_s, 1)
    even_s = first_s + step_s * place
    off_s = float(np.max(np.abs(time_s - even_s)))
    if not step_s > 0 or off_s > TOLERANCE_DIGITS * digit_s or off_s < 0.5 * LEAST_DIGIT_PART * step_s:
        return time_s, ""
    rounded, spacing = f"{1e3 * digit_s:g} ms", f"{1e3 * step_s:.3g} ms"
    return even_s, f"Times are rounded to {rounded}; evenly spaced ones, {spacing} apart, are used instead."


def _last_digit_s(time_s: Floats) -> float:
    """Decimal to which all times are rounded, s; 0 where they are not, or have more decimals."""
    if not np.isfinite(time_s).all():
        return 0.0
    for digits in range(MOST_DECIMALS):
        scaled = time_s * 10.0**digits
        if np.max(np.abs(scaled - np.round(scaled))) < 1e-6 * max(1.0, float(np.max(np.abs(scaled))) * 1e-6):
            return float(10.0**-digits)
    return 0.0
