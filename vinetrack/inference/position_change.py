"""Finite differences of the observed positions of a trial, taken correctly across the end of growth."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from vinetrack.core.records import Floats
from vinetrack.dynamics.simulate import Trajectory

LONGEST_EXTRAPOLATION = 3.0
"""Time over which the perturbed trajectory is extrapolated beyond its end, in units of the delay that the perturbation
causes. Derived: 1 for a motion that keeps its speed to the end; 3 allows for one that slows down to a third."""


def clip_at_end(change: Floats, over: NDArray[np.bool_], *, moved_ends: bool) -> None:
    """Set the change of position after the end of growth: that of the end position, or 0 where only the time changes.

    Parameters
    ----------
    change : array, shape (n_points,), m
        Modified in place.
    over : array of bool, shape (n_points,)
        Points after the end of the unperturbed trajectory.
    moved_ends : bool
        Whether the perturbed trajectory reaches the end of growth too.
    """
    change[over] = change[-1] if moved_ends else 0.0


def position_change(plain: Trajectory, moved: Trajectory) -> Floats:
    """Change of the observed positions of a trial under a small perturbation, m, shape (n_points,).

    Growth ends at the same position whenever it ends. Between the two end times a plain difference therefore has a jump
    as large as the whole response, which depends on the sign and size of the perturbation: two effects with exactly the
    same action would seem to differ in that one frame. So the perturbed trajectory is extrapolated at its last speed
    until the unperturbed one ends; after that, only a change of the end position counts.

    Parameters
    ----------
    plain : Trajectory
        The unperturbed trajectory.
    moved : Trajectory
        The perturbed trajectory of the same trial at the same times.

    Returns
    -------
    array, shape (n_points,), m
    """
    change = np.asarray(moved.observed_position_m - plain.observed_position_m)
    if plain.status == "ended":
        clip_at_end(change, plain.time_s > plain.end_time_s, moved_ends=moved.status == "ended")
    plain_end_s, moved_end_s = (each.end_time_s if each.status == "ended" else math.inf for each in (plain, moved))
    early = (plain.time_s <= plain_end_s) & (plain.time_s > moved_end_s)
    last = int(np.argmax(early)) - 1
    if early.any() and last >= 0:
        # A small perturbation ends growth earlier by displacement over speed. Where the unperturbed motion takes much
        # longer than that, the two motions differ in kind (one stops before the end), and nothing is extrapolated.
        speed_m_s = max(float(plain.lead_velocity_m_s[last]), 1e-9)
        reach_s = plain.time_s[last] + LONGEST_EXTRAPOLATION * abs(float(change[last])) / speed_m_s
        early &= plain.time_s <= reach_s + 2 * (plain.time_s[1] - plain.time_s[0])
        if early.any():
            faster = moved.lead_velocity_m_s[last] - plain.lead_velocity_m_s[last]
            change[early] = change[last] + faster * (plain.time_s[early] - plain.time_s[last])
    return change
