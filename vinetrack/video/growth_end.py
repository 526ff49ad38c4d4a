"""Where growth ends, when something flies on: a payload in free flight leaves background behind it, film stays."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vinetrack.video.strip import Strip

Floats = NDArray[np.float64]

RETURNED = 0.2
"""Share of the film's usual difference from the background (in power) below which a column shows background again."""
SHORTEST_PX = 10
"""Columns that must show background again: more than any blur or ringing of the coder."""
RUNS_AWAY = 1.35
"""A payload leaves at the speed of the tail, twice the edge's; less than this is growth."""


def growth_end(strip: Strip, path: Floats, passed: tuple[int, int]) -> int:
    """Column where the film ends although what moves goes on, or the end of `passed` where nothing does.

    From the last column passed backwards: what flies (no longer than the tube is wide), then columns that look as
    they did before anything came, then film. What flies must be faster than the edge was.
    """
    columns, frames = np.arange(passed[0], passed[1]), len(path)
    if len(columns) < 5 * SHORTEST_PX or frames < 8:
        return passed[1]
    arrival = np.clip(np.searchsorted(path, columns + 0.5), 0, frames - 1)
    stays = _difference(strip, columns, arrival)
    usual = float(np.median(stays[: int(0.7 * len(stays))]))
    back = stays < RETURNED * usual
    i = _first_bare(back, strip.values.shape[1])
    if i < 3 * SHORTEST_PX or back[i - 2 * SHORTEST_PX : i].mean() > 0.3:
        return passed[1]
    flight = _speed(arrival, i + 2, len(columns))
    return int(columns[i]) + 1 if flight > RUNS_AWAY * _speed(arrival, i - 6 * SHORTEST_PX, i - 5) else passed[1]


def _first_bare(back: NDArray[np.bool_], longest: int) -> int:
    """First column of SHORTEST_PX or more in a row that are `back`, with at most `longest` after it that are not."""
    others = np.cumsum(~back[::-1])[::-1]
    runs = np.convolve(back, np.ones(SHORTEST_PX), mode="full")[SHORTEST_PX - 1 :] > SHORTEST_PX - 0.5
    found = np.flatnonzero(runs & (others <= longest))
    return int(found[0]) if len(found) else 0


def _speed(arrival: NDArray[np.int_], first: int, last: int) -> float:
    """Columns a frame between two of them."""
    first, last = max(first, 0), min(last, len(arrival)) - 1
    return (last - first) / max(float(arrival[last] - arrival[first]), 0.5)


def _difference(strip: Strip, columns: NDArray[np.int_], arrival: NDArray[np.int_]) -> Floats:
    """Mean square over the rows of last minus first looks at each column, shape (n_columns,), smoothed over 5."""
    last = _mean(strip, slice(len(strip.values) - 2, len(strip.values)), columns)
    out = np.zeros(len(columns))
    for when in np.unique(arrival):
        those = arrival == when
        before = _mean(strip, slice(max(int(when) - 8, 0), max(int(when) - 2, 1)), columns[those])
        out[those] = np.mean((last[:, those] - before) ** 2, axis=0)
    noise = strip.noise**2 * (0.5 + 0.2)
    return np.convolve(np.clip(out - noise, 0, None), np.ones(5) / 5, mode="same")


def _mean(strip: Strip, frames: slice, columns: NDArray[np.int_]) -> NDArray[np.float32]:
    """Mean brightness of some columns over some frames, shape (n_across, n_columns)."""
    values = strip.values[frames][:, :, columns].astype(np.float32)
    level = values * strip.scale[frames, None, None] + strip.offset[frames, None, None]
    return np.asarray(level.mean(axis=0), dtype=np.float32)
