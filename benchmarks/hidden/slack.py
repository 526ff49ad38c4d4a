"""A vine whose tail cannot push: the payload runs ahead, the tip follows at its own pace.

Taut, x = 2 y:   m(y) ẍ = T + m(y) g cosθ, as long as the pull of the tip T = ½ [(P − P_y) A − B ẋⁿ] ≥ 0
Slack, x > 2 y:  ẍ = g cosθ for tail and payload, (P − P_y) A = B (2 ẏ)ⁿ for the tip, until 2 y has caught up with x
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from hidden.motion import G, Tube

Floats = NDArray[np.float64]

LONGEST_STEP_S = 2e-5


@njit(cache=True, nogil=True)
def _pull(w, tube, B, n):
    """Force of the tip on a taut tail at the tail speed, N."""
    area = math.pi * tube.diameter**2 / 4.0
    return 0.5 * ((tube.pressure - tube.yield_pressure) * area - B * max(w, 0.0) ** n)


@njit(cache=True, nogil=True)
def _taut_acceleration(y, w, tube, B, n):
    density = tube.film_density * math.pi * tube.diameter * tube.thickness
    mass = tube.payload + density * max(tube.length - y, math.pi * tube.thickness)
    return _pull(w, tube, B, n) / mass + G * tube.cosine


@njit(cache=True, nogil=True)
def _follow(times, tube, B, n, longest):
    out = np.zeros((times.size, 3))
    area = math.pi * tube.diameter**2 / 4.0
    own = 0.5 * (max(tube.pressure - tube.yield_pressure, 0.0) * area / B) ** (1.0 / n)
    t, x, y, w, slack = 0.0, 0.0, 0.0, 0.0, False
    for i in range(times.size):
        while t < times[i] and y < tube.length:
            h = min(longest, times[i] - t)
            if slack:
                x, w, y = x + h * w + 0.5 * h * h * G * tube.cosine, w + h * G * tube.cosine, y + h * own
                if 2.0 * y >= x:
                    slack, y = False, 0.5 * x
            else:
                # The midpoint rule: an error of some nanometres over a trial at this step.
                a = _taut_acceleration(y, w, tube, B, n)
                half_w = max(w + 0.5 * h * a, 0.0)
                a = _taut_acceleration(y + 0.25 * h * w, half_w, tube, B, n)
                y, w = y + 0.5 * h * half_w, max(w + h * a, 0.0)
                x = 2.0 * y
                slack = _pull(w, tube, B, n) < 0.0
            y = min(y, tube.length)
            t += h
        out[i, 0], out[i, 1], out[i, 2] = y, w, x - 2.0 * y
    return out


def follow_slack(times: Floats, tube: Tube, B: float, n: float, longest_s: float = LONGEST_STEP_S) -> Floats:
    """Follow one trial from rest at time 0.

    Parameters
    ----------
    times : array, shape (n_times,), s since release
    tube : the trial as it is, SI
    B, n : damping coefficient, N·(s/m)ⁿ, and exponent
    longest_s : longest step

    Returns
    -------
    array, shape (n_times, 3)
        Lead position, m, tail speed, m/s, and length of slack tail, m.
    """
    return _follow(times, tube, B, n, longest_s)
