"""The published rule for a steady window, to the letter: coefficient of variation below 3 % over at least three points.

Alvarez et al., "High-Velocity, Pressure-Driven Eversion for Rapid Vine Robots", IEEE RA-L 2025. It finds windows in
still frames, in drifting speed and by chance; it is computed beside the gated rule so that both can be compared.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from vinetrack.core.records import Floats, Track, Window


def paper_window(track: Track, *, travel_ratio: float, cv_limit: float = 0.03, min_points: int = 3) -> Window:
    """The published rule to the letter: the longest run whose velocities vary by less than 3 %, wherever it is.

    Velocities are central differences of the raw positions, as Physics Tracker computes them; the run holds at
    least `min_points` consecutive velocities with (sample standard deviation)/(mean) below `cv_limit`; x_ss is
    their mean, and its error s/√n, which is what the rule implies and not what the data allow.
    """
    usable = track.usable
    time_s, position_m = track.time_s[usable], track.lead_position_m[usable]
    if time_s.size < min_points + 2:
        return Window("paper", False, f"{time_s.size} points are too few for {min_points} central differences")
    velocity = (position_m[2:] - position_m[:-2]) / (time_s[2:] - time_s[:-2])
    run = _longest_run(velocity, cv_limit, min_points)
    if run is None:
        return Window("paper", False, f"no {min_points} consecutive velocities vary by less than {cv_limit:.0%}")
    start, stop = run
    chosen = velocity[start : stop + 1] * travel_ratio
    mean, sd = float(chosen.mean()), float(chosen.std(ddof=1))
    drift = float(np.polyfit(np.linspace(-0.5, 0.5, chosen.size), chosen, 1)[0]) / mean
    cv = sd / abs(mean)
    return Window(
        rule="paper",
        accepted=True,
        reason=f"longest run with a coefficient of variation below {cv_limit:.0%}: {chosen.size} velocities, {cv:.2%}",
        from_s=float(time_s[start + 1]),
        to_s=float(time_s[stop + 1]),
        n_points=chosen.size,
        x_ss_m_s=mean,
        x_ss_sigma_m_s=sd / math.sqrt(chosen.size),
        drift=drift,
        cv=cv,
    )


def _longest_run(velocity: Floats, cv_limit: float, min_points: int) -> tuple[int, int] | None:
    """First and last index of the longest run with coefficient of variation below the limit; the steadiest of ties.

    Lengths are tried from the longest down, octave by octave: a run of 2b to 4b values holds an aligned block of b
    whose own scatter cannot be larger than the whole run's, so that only runs around quiet blocks are looked at.
    """
    n = velocity.size
    level = float(np.median(velocity))
    nothing = 1e-9 * float(np.max(np.abs(velocity)))  # a mean of rounding errors is none: 0/0 is not steady
    total = np.concatenate([[0.0], np.cumsum(velocity - level)])
    square = np.concatenate([[0.0], np.cumsum((velocity - level) ** 2)])
    longest = n
    while longest >= min_points:
        block = max(1, 2 ** (int(math.log2(longest)) - 1))
        shortest = max(min_points, 2 * block if block > 1 else 1)
        starts = _near_quiet_blocks(velocity, block, cv_limit)
        for length in range(longest, shortest - 1, -1):
            first = starts[starts + length <= n]
            if first.size == 0:
                continue
            sums = total[first + length] - total[first]
            spread = np.maximum(square[first + length] - square[first] - sums**2 / length, 0.0) / (length - 1)
            mean = sums / length + level
            good = np.flatnonzero((spread < (cv_limit * mean) ** 2) & (np.abs(mean) > nothing))
            if good.size:
                start = int(first[good[np.argmin(spread[good] / mean[good] ** 2)]])
                return start, start + length - 1
        longest = shortest - 1
    return None


def _near_quiet_blocks(velocity: Floats, block: int, cv_limit: float) -> NDArray[np.int_]:
    """Starts from which a run of 2 to 4 blocks can reach over a block that is quiet enough for the run.

    The run's mean m lies within 2·cv·|m| of the block's, and the block's squares sum to no more than 4·block·(cv·m)².
    """
    n = velocity.size
    if 2 * cv_limit >= 1 or block < 2:
        return np.arange(n)
    rows = velocity[: n // block * block].reshape(-1, block)
    mean = rows.mean(axis=1)
    squares = np.sum((rows - mean[:, None]) ** 2, axis=1)
    quiet = np.flatnonzero(squares <= 4 * block * (cv_limit * mean / (1 - 2 * cv_limit)) ** 2) * block
    edge = np.zeros(n + 1, dtype=int)
    np.add.at(edge, np.maximum(quiet - 3 * block, 0), 1)
    np.add.at(edge, quiet + 1, -1)
    return np.flatnonzero(np.cumsum(edge[:n]) > 0)
