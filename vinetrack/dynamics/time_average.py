"""Positions averaged over time: the position reported at t is the mean from t − T/2 to t + T/2."""

import math

from vinetrack.dynamics.between_frames import motion_at
from vinetrack.dynamics.equations import compiled

# Gauss–Legendre quadrature with three nodes, and its weights (derived)
NODE, WEIGHT, MIDDLE_WEIGHT = math.sqrt(0.6), 5 / 18, 4 / 9


@compiled
def average_over(times, out, means, ratio, end, square):
    """Replace instantaneous positions by their means over the time around each."""
    half = 0.5 * math.sqrt(square)
    for i in range(times.size):
        first, last = times[i] - half, times[i] + half
        k = i
        while k > 0 and times[k] > first:
            k -= 1
        area, at = 0.0, first
        while at < last:
            # The intervals before the first time and after the last are one piece each.
            until = last
            if at < times[0]:
                until = min(last, times[0])
            elif k < times.size - 1:
                until = min(last, times[k + 1])
            if at < end.time < until:
                until = end.time
            area += _integral(times, out, ratio, end, k, at, until)
            at = until
            while k < times.size - 1 and times[k + 1] <= at:
                k += 1
        means[i] = area / (2 * half)
    for i in range(times.size):
        out[i, 3] = means[i]


@compiled
def _integral(times, out, ratio, end, k, low, high):
    """Integral of the reported position, m s, over an interval in which the motion is one polynomial."""
    middle, reach = 0.5 * (low + high), 0.5 * NODE * (high - low)
    total = 0.0
    for place in range(3):
        x, _v, offset = motion_at(times, out, ratio, end, k, middle + (place - 1) * reach)
        total += (MIDDLE_WEIGHT if place == 1 else WEIGHT) * (x / ratio + offset)
    return total * (high - low)
