"""Restore times of frames that a file holds with too few digits.

Frames 0.935 ms apart, written to the millisecond, deviate from the motion by up to half a millisecond, 2 mm at 4 m/s,
and two of them may share the same time. Where all times of a file lie within half their last digit of an evenly spaced
series, that series is used.
"""

from __future__ import annotations

import numpy as np

from vinetrack.core.records import Floats

FEWEST_TIMES = 8
"""Fewest times from which an even series is recognised. Measured: of 3,000 series whose steps are one digit or two at
random 83 % are taken for even with 8 times, 7 % with 20, 0.03 % with 40; none of them is then moved by more than three
quarters of a digit. Chosen: a short film of few digits is restored, at the price of such as these."""

TOLERANCE_DIGITS = 0.75
"""Last digits by which a time may deviate from the series. Derived: half a digit by rounding, and half of that again by
which the series itself, fitted to rounded times, may be off; truncated times deviate by the same, apart from a shift
that has no consequence."""

LEAST_DIGIT_PART = 0.01
"""Last digit, as a part of a frame, from which times are restored. Chosen: half a hundredth of a frame is 0.3 mm at 60
m/s; at half nothing is gained below that, at twice 0.6 mm stay."""

MOST_DECIMALS = 7
"""Decimals from which a time does not count as rounded. Chosen: a tenth of a microsecond, 6 µm at 60 m/s."""


def unrounded_times(time_s: Floats) -> tuple[Floats, str]:
    """Times of evenly spaced frames before they were rounded, and a sentence that says so.

    Parameters
    ----------
    time_s : array, shape (n,), s

    Returns
    -------
    time_s : array, shape (n,), s
        Unchanged where they are not rounded, or not evenly spaced.
    note : str
        Blank where nothing was done.

    Examples
    --------
    >>> unrounded_times(np.round(np.arange(100) / 240, 3))[1]
    'Times are rounded to 1 ms; evenly spaced ones, 4.17 ms apart, are used instead.'
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
