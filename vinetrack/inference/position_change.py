"""How far the observed positions of a trial move when something about it is changed by a little."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from vinetrack.core.records import Floats
from vinetrack.dynamics.simulate import Trajectory

MOST_CONTINUED = 3.0
"""Times the delay that a step makes over which a trajectory is continued past its end. Derived: one for motions that
keep their speed to the end; three allows for one that slows down to a third."""


def clip_at_end(change: Floats, over: NDArray[np.bool_], *, moved_ends: bool) -> None:
    """End what positions move by where the growth ends; behind that nothing that only delays the end moves them.

    Parameters
    ----------
    change : array, shape (n_points,), m
        Changed in place.
    over : array of bool, shape (n_points,)
        Points behind the end of the trajectories_at trajectory.
    moved_ends : bool
        Whether the moved one comes to its end too.
    """
    change[over] = change[-1] if moved_ends else 0.0


def position_change(plain: Trajectory, moved: Trajectory) -> Floats:
    """How far the observed positions of a trial answer to a small step, m, shape (n_points,).

    Growth ends at the same place whenever it ends, so a plain difference has a jump between the two ends, of the order
    of the whole answer, that depends on the sign and size of the step: two effects that do exactly the same would seem
    to differ by that one frame. So until the trajectories_at trajectory ends the moved one is continued at its last speed, and
    from there on only what moves the place of the end counts.

    Parameters
    ----------
    plain : Trajectory
        The trajectories_at trajectory.
    moved : Trajectory
        The same trial, at the same instants, with a step made.

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
        # A step small enough ends growth earlier by what it moves over the speed; where the trajectories_at motion takes longer
        # it is another one, such as a stop before the end, and is not continued.
        speed_m_s = max(float(plain.lead_velocity_m_s[last]), 1e-9)
        reach_s = plain.time_s[last] + MOST_CONTINUED * abs(float(change[last])) / speed_m_s
        early &= plain.time_s <= reach_s + 2 * (plain.time_s[1] - plain.time_s[0])
        if early.any():
            faster = moved.lead_velocity_m_s[last] - plain.lead_velocity_m_s[last]
            change[early] = change[last] + faster * (plain.time_s[early] - plain.time_s[last])
    return change
