"""Finite differences of the observed positions of a trial, taken correctly across the end of growth."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from vinetrack.core.records import Floats
from vinetrack.dynamics.simulate import Trajectory

# Time over which the perturbed trajectory is extrapolated beyond its end, in units of the delay that the perturbation
# causes (derived)
LONGEST_EXTRAPOLATION = 3.0


def clip_at_end(change: Floats, over: NDArray[np.bool_], *, moved_ends: bool) -> None:
    """Set the change of position after the end of growth: that of the end position, or 0 where only the time changes.
    Shapes: change, over (n_points,).
    """
    change[over] = change[-1] if moved_ends else 0.0


def position_change(plain: Trajectory, moved: Trajectory) -> Floats:
    """Change of the observed positions of a trial under a small perturbation, m, shape (n_points,). Growth ends at the
    same position whenever it ends. Shape (n_points,).
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
