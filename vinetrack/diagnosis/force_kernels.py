"""A compiled loop over the steps by which answers to small forces are followed along motions."""

from __future__ import annotations

import numpy as np
from numba import njit

from vinetrack.core.records import Floats


@njit(cache=True, nogil=True, error_model="numpy")
def answers(time_s: Floats, stiffness: Floats, friction: Floats, push: Floats, stage: float) -> tuple[Floats, Floats]:
    """Changes of position and speed for further accelerations along each motion.

    By the two-stage method of Alexander, SIAM J. Numer. Anal. 14, 1006 (1977): each stage holds with the rates there.

    Parameters
    ----------
    time_s : array, shape (n_trials, n_steps + 1), s
    stiffness, friction : arrays, shape (n_trials, n_steps + 1), 1/s² and 1/s
        ∂a/∂x and ∂a/∂ẋ along the motions.
    push : array, shape (n_trials, n_steps + 1, n), m/s²
        Further accelerations.
    stage : float
        Where in a step its first stage lies.

    Returns
    -------
    moved, sped : arrays, shape (n_trials, n_steps + 1, n), m and m/s
    """
    trials, points, count = push.shape
    moved, sped = np.zeros_like(push), np.zeros_like(push)
    for trial in range(trials):
        for i in range(points - 1):
            h = time_s[trial, i + 1] - time_s[trial, i]
            first, after = stage * h, (1 - stage) * h
            k, c = stiffness[trial, i + 1], friction[trial, i + 1]
            k_inside = (1 - stage) * stiffness[trial, i] + stage * k
            c_inside = (1 - stage) * friction[trial, i] + stage * c
            below, last = 1 - first * c_inside - first * first * k_inside, 1 - first * c - first * first * k
            for j in range(count):
                x, v, pushed = moved[trial, i, j], sped[trial, i, j], push[trial, i + 1, j]
                inside = (1 - stage) * push[trial, i, j] + stage * pushed
                rate = (k_inside * (x + first * v) + c_inside * v + inside) / below
                x, v = x + after * (v + first * rate), v + after * rate
                speed = v + first * ((k * (x + first * v) + c * v + pushed) / last)
                moved[trial, i + 1, j], sped[trial, i + 1, j] = x + first * speed, speed
    return moved, sped
