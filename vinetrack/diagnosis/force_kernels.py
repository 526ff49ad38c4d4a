"""Compiled integration of the variational equations: responses of motions to small accelerations."""

from __future__ import annotations

import numpy as np
from numba import njit

from vinetrack.core.records import Floats


@njit(cache=True, nogil=True, error_model="numpy")
def integrate_responses(
    time_s: Floats, stiffness: Floats, friction: Floats, acceleration: Floats, gamma: float
) -> tuple[Floats, Floats]:
    """Integrate δẍ = k δx + c δẋ + a from rest, for several added accelerations a along each motion. The method is the
    L-stable, singly diagonally implicit Runge-Kutta scheme of two stages and second order by Alexander, SIAM J. Numer.
    Anal. 14, 1006 (1977). Returns position_change, velocity_change : arrays, shape (n_trials, n_steps + 1, n), m and
    m/s. Shapes: time_s, stiffness, friction (n_trials, n_steps + 1); acceleration (n_trials, n_steps + 1, n).
    """
    trials, points, count = acceleration.shape
    position_change, velocity_change = np.zeros_like(acceleration), np.zeros_like(acceleration)
    for trial in range(trials):
        for i in range(points - 1):
            h = time_s[trial, i + 1] - time_s[trial, i]
            implicit, explicit = gamma * h, (1 - gamma) * h
            k, c = stiffness[trial, i + 1], friction[trial, i + 1]
            k_stage = (1 - gamma) * stiffness[trial, i] + gamma * k
            c_stage = (1 - gamma) * friction[trial, i] + gamma * c
            pivot_stage = 1 - implicit * c_stage - implicit * implicit * k_stage
            pivot = 1 - implicit * c - implicit * implicit * k
            for j in range(count):
                x, v, a = position_change[trial, i, j], velocity_change[trial, i, j], acceleration[trial, i + 1, j]
                a_stage = (1 - gamma) * acceleration[trial, i, j] + gamma * a
                rate = (k_stage * (x + implicit * v) + c_stage * v + a_stage) / pivot_stage
                x, v = x + explicit * (v + implicit * rate), v + explicit * rate
                v_end = v + implicit * ((k * (x + implicit * v) + c * v + a) / pivot)
                position_change[trial, i + 1, j], velocity_change[trial, i + 1, j] = x + implicit * v_end, v_end
    return position_change, velocity_change
