"""Edges that break the motion, sought again where the motion leads; the edge in bands of rows, each fitted alone.

The disagreement of bands is an error that needs no model of noise: film, tail, glints and a swinging door touch one
band and not another, and whatever misleads them differently shows.

Where growth ends, when something flies on: a payload in free flight leaves background behind it, film stays.
"""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from vinetrack.core.records import Floats
from vinetrack.video.edge_state import EdgeState, core_frames, fit_edges, moving_frames
from vinetrack.video.slow_errors import shared_disagreement
from vinetrack.video.strip import Strip

ASTRAY_PX = 3.0
"""Error stated where nothing like the edge is found where the motion leads. Chosen just below LOST_SIGMA_PX: the point
stays, and hardly weighs. At twice such points are lost; at half they weigh four times as much."""
ASTRAY_MISFIT = 1.4
"""How much worse a fit may be that agrees with its neighbours than one that does not. Chosen between 1 and the 1.5
from which a fit counts as bad. By reasoning: near 1 noise keeps fits that break the motion; beyond 1.5 good fits at
gaps are replaced."""
FAINTEST = 0.5
"""An edge of less than this much of its contrast is another thing's. Chosen: half. By reasoning: at half of it
reflections pass for the edge; near 1 real edges of changing light do not."""
LONG_REST = 8
"""Frames of rest, counted from the motion, in which a bad fit is still sought again from many starts. Chosen for time:
at rest a search from one start is enough."""


def repair_jumps(strip: Strip, state: EdgeState, fit: Floats, chosen: NDArray[np.bool_]) -> Floats:
    """Fits that break the motion, or hardly fit, sought again where the motion leads, shape (n_frames, 6).

    From the middle of the motion backwards and forwards: the edge never retreats, and a step is at most 1.3 times (or
    1.5 px more than) its neighbour. A fit that breaks that (it caught the far side of a door, a payload) gives way to
    the best one that does not; only a good fit at two to four whole steps stands, for frames may be missing. A fit
    half again as bad as most gives way to a better one.

    Parameters
    ----------
    strip : along the axis.
    state : what lies before and after the edge.
    fit : from `edge_state.fit_edges`, shape (n_frames, 6).
    chosen : frames that were fitted, one stretch of them, shape (n_frames,).

    Returns
    -------
    fits, shape (n_frames, 6).
    """
    moving = np.flatnonzero(moving_frames(state.edge) & np.isfinite(fit[:, 0]))
    if len(moving) < 5:
        return fit
    out = fit.copy()
    bad = 1.5 * float(np.nanmedian(fit[core_frames(state, fit), 2]))
    central = np.abs(moving - 0.5 * (moving[0] + moving[-1])) / len(moving)
    anchor = int(moving[np.argmin(central + _rough(fit[moving, 0]) + (fit[moving, 2] > bad))])
    first, last = (int(frame) for frame in np.flatnonzero(chosen)[[0, -1]])
    edge = out[:, 0].tolist()
    for sense in (-1, 1):
        resting = 0
        for t in range(anchor + sense, first - 1 if sense < 0 else last + 1, sense):
            near, before, earlier = (edge[min(max(t - k * sense, 0), len(edge) - 1)] for k in (1, 2, 3))
            # Of two steps, for a frame may repeat the one before it.
            step = max(0.0 if math.isnan(gap) else abs(gap) for gap in (before - near, earlier - before))
            resting = resting + 1 if step < 0.3 else 0
            far = max(1.3 * step, step + 1.5)
            low, high = (near - far, near + 0.8) if sense < 0 else (near - 0.8, near + far)
            inside, faint = low <= edge[t] <= high, out[t, 3] < FAINTEST - 1
            if not math.isfinite(near) or (inside and (out[t, 2] <= bad or resting > LONG_REST) and not faint):
                continue
            better = _best_between(strip, state, t, low, high, 1 if resting > LONG_REST else 9)
            if inside:
                if better is not None and (faint or better[2] < out[t, 2]):
                    out[t] = better
            elif _may_be_gap(edge[t] - near, step) and not faint and _is_better(out[t], better, bad):
                continue
            elif better is None:
                place = near if math.isnan(edge[t]) else edge[t]
                out[t] = (min(max(place, low), high), ASTRAY_PX, 4 * bad, 0, 0, 0)
            else:
                out[t] = better
            edge[t] = float(out[t, 0])
    return _smoothed_out(strip, state, out, moving, bad)


def _smoothed_out(strip: Strip, state: EdgeState, fit: Floats, moving: NDArray[np.int_], bad: float) -> Floats:
    """Bad fits that stray from a parabola through two neighbours on each side, sought again where it leads.

    A good fit stays (its frame may repeat another), and so does one that fits much better than what is found there.
    """
    out = fit.copy()
    for t in moving[2:-2]:
        around = out[[t - 2, t - 1, t + 1, t + 2], 0]
        expected = (-around[0] + 4 * around[1] + 4 * around[2] - around[3]) / 6
        bend = abs(around[0] - 2 * around[1] + 2 * around[2] - around[3])
        far = abs(out[t, 0] - expected)
        if not np.isfinite(far) or out[t, 2] <= bad or far < max(1.5, bend):
            continue
        reach = max(2.0, 0.3 * far)
        better = _best_between(strip, state, int(t), expected - reach, expected + reach, 9)
        if better is not None and better[2] < ASTRAY_MISFIT * out[t, 2]:
            out[t] = better
    return out


def _is_better(fit: Floats, other: Floats | None, bad: float) -> bool:
    """Whether a fit is good, and better than another."""
    return bool(fit[2] <= bad) and (other is None or bool(other[2] > fit[2]))


def _may_be_gap(stride: float, step: float) -> bool:
    """Whether a stride looks like two to four whole steps: frames are missing, and the point is right."""
    ratio = abs(stride) / max(step, 1e-6)
    return step > 1.0 and 1.75 < ratio < 4.25 and abs(ratio - round(ratio)) < 0.25


def _rough(edge: Floats) -> NDArray[np.bool_]:
    """Points that stray from the mean of their neighbours by more than a pixel and a tenth of the step, (n,)."""
    rough = np.ones(len(edge), dtype=bool)
    step = np.abs(edge[2:] - edge[:-2]) / 2
    rough[1:-1] = np.abs(edge[1:-1] - 0.5 * (edge[2:] + edge[:-2])) > 1.0 + 0.15 * step
    return rough


def _best_between(strip: Strip, state: EdgeState, t: int, low: float, high: float, starts: int) -> Floats | None:
    """Best fit of frame t that starts and stays between `low` and `high`, shape (6,); None where there is none."""
    best = None
    for start in np.linspace(low, high, int(np.clip((high - low) / 2, 3, 9)))[:: 9 // starts]:
        edge = np.full(len(state.edge), np.nan)
        edge[t] = start
        fit = fit_edges(strip, replace(state, edge=edge))[t]
        inside = low - 0.5 <= fit[0] <= high + 0.5 and fit[3] > FAINTEST - 1
        if inside and np.isfinite(fit[2]) and (best is None or fit[2] < best[2]):
            best = fit
    return best


BANDS = 4
"""Bands across: enough to tell who errs, few enough that each still finds the edge. Chosen: three degrees of freedom;
at half one, at twice bands of thin vines hold two rows."""
FEWEST_ROWS = 4
"""Rows of a band at least. Chosen: fewer show no edge in noise."""

OUTLYING = 2.0
"""A band further off than this many median distances counts as that far: its pixels hardly counted in the fit. Chosen:
two median distances are 1.35 standard deviations of four bands. At half errors of all frames shrink; at twice one
glint makes a frame doubtful."""
HABIT_PX = 50.0
"""Growth over which a lead or lag of one band is its habit: longer than film's grain, shorter than a sway. Chosen: a
few diameters of the smallest vine. By reasoning: at half noise is taken for a habit, at twice a sway for an error."""
HABIT_FRAMES = 7
"""Frames over which the habit is taken at least. Chosen: the median of seven knows it to half of a frame's error."""

NEIGHBOURS = 2
"""Frames on each side of which the median disagreement is taken: four bands alone say little, one glint nothing.
Chosen: five frames of three degrees of freedom know a standard deviation to 18 % (1/√30). At half to 24 %, at twice an
error of few frames is averaged away."""
MEDIAN_TO_MEAN = 1.27
"""Mean over median of χ² with three degrees of freedom. Derived: 3/2.366."""


def band_disagreement(strip: Strip, state: EdgeState, edge: Floats, core: NDArray[np.bool_]) -> tuple[Floats, float]:
    """Error of the edge by how far the bands disagree, and the part of it that neighbouring frames share.

    The weighted mean of K independent bands errs by Σ w (y − ȳ)² / ((K − 1) Σ w). What a band is ahead or behind
    for long in the `core` frames is the shape of the tip, not an error.

    Parameters
    ----------
    strip : along the axis.
    state : what lies before and after the edge.
    edge : fitted to all rows, shape (n_frames,), px.
    core : moving frames clear of the start, mask, shape (n_frames,).

    Returns
    -------
    standard error, shape (n_frames,), px; zeros where there is one band only
    slow error of all frames, px; see `slow_errors.shared_disagreement`
    """
    edges, sigmas = band_fits(strip, state, edge)
    if edges.shape[1] < 2:
        return np.zeros(len(edge)), 0.0
    off = np.nan_to_num(edges - edge[:, None])
    slow = shared_disagreement(off[core])
    off = off - _habit(off, edge, np.flatnonzero(core))
    weight = np.where(np.isfinite(sigmas), 1 / (np.nan_to_num(sigmas, nan=1.0) ** 2 + 1e-4), 1e-4)
    middle = np.median(off, axis=1, keepdims=True)
    reach = OUTLYING * np.median(np.abs(off - middle), axis=1, keepdims=True) + 0.05
    off = middle + np.clip(off - middle, -reach, reach)
    total = weight.sum(axis=1)
    mean = (weight * off).sum(axis=1) / total
    variance = (weight * (off - mean[:, None]) ** 2).sum(axis=1) / (off.shape[1] - 1) / total
    padded = np.pad(variance, NEIGHBOURS, mode="edge")
    usual = np.median(np.lib.stride_tricks.sliding_window_view(padded, 2 * NEIGHBOURS + 1), axis=1)
    return np.asarray(np.sqrt(MEDIAN_TO_MEAN * usual)), slow


LENGTH_PART = 0.25
"""Part of the distance between both ends of an unsure blur that counts as its standard error. Derived: √(1/12) = 0.29
of a place evenly spread between them. Measured: 0.2 to 1.8 px off where 0.9 is stated, in four recordings drawn by
other code that stop at 40 px a frame and half a frame of exposure (tuning seeds 1 to 4). At half or twice such frames
weigh four times as much or a quarter."""


def dwell_error_px(edge: Floats, exposure_frames: float) -> Floats:
    """Error of an edge that stops or sets off within an exposure or beside it, one standard deviation.

    The blur is pictured as that of an even motion, with the mean of the speeds before and after. Where these differ by
    Δv, either may be that of the exposure of τ frames, and the blur is unsure by τΔv/2; one that is longer or shorter
    than pictured is placed by either of its ends, τΔv/4 apart at most, of which LENGTH_PART counts.

    A tip that moves at v px a frame and stops s frames before or after the middle of the exposure is seen, on average
    over the exposure, v (τ/2 − |s|)²/2τ behind where it is in the middle; the way between two frames before and two
    after tells s.

    Parameters
    ----------
    edge : shape (n_frames,), px.
    exposure_frames : exposure over frame period.

    Returns
    -------
    shape (n_frames,), px; 0 of an even motion.
    """
    if len(edge) < 3 or exposure_frames <= 0:
        return np.zeros(len(edge))
    steps = np.abs(np.diff(np.pad(np.nan_to_num(edge), 2, mode="edge")))
    speed = np.maximum(steps[:-3], steps[3:])
    stop = (steps[1:-2] + steps[2:-1]) / np.maximum(speed, 1e-9) - 1
    outside = np.maximum(exposure_frames / 2 - np.abs(stop), 0.0)
    behind = speed * outside**2 / (2 * exposure_frames)
    return np.asarray(np.hypot(behind, LENGTH_PART * exposure_frames / 4 * np.abs(steps[2:-1] - steps[1:-2])))


def band_fits(strip: Strip, state: EdgeState, edge: Floats) -> tuple[Floats, Floats]:
    """Edge by band and its Fisher sigma, shapes (n_frames, n_bands), px; NaN where a band shows none.

    The bands share the rows that say anything about the edge evenly.

    Parameters
    ----------
    strip : along the axis.
    state : what lies before and after the edge.
    edge : where each search begins, shape (n_frames,), px.

    Returns
    -------
    edge and its standard error, each of shape (n_frames, n_bands), px.
    """
    rows = strip.values.shape[1]
    contrast = np.sum((state.pictures[0] - state.pictures[1]) ** 2, axis=1).astype(float)
    contrast = np.minimum(contrast, 4 * np.median(contrast) + 1e-9)
    cuts = np.searchsorted(np.cumsum(contrast) / contrast.sum(), np.linspace(0, 1, BANDS + 1)[1:-1])
    limits = np.concatenate([[0], cuts, [rows]])
    edges, sigmas = [], []
    for low, high in pairwise(limits):
        if high - low < FEWEST_ROWS:
            continue
        part = replace(strip, values=np.ascontiguousarray(strip.values[:, low:high]))
        state_of_rows = replace(
            state, edge=edge, lag=np.ascontiguousarray(state.lag[low:high]),
            pictures=np.ascontiguousarray(state.pictures[:, low:high]),
        )  # fmt: skip
        fit = fit_edges(part, state_of_rows)
        edges.append(fit[:, 0])
        sigmas.append(fit[:, 1])
    return np.stack(edges, axis=1), np.stack(sigmas, axis=1)


def _habit(off: Floats, edge: Floats, core: NDArray[np.int_]) -> Floats:
    """Median lead of each band over the core frames within HABIT_PX, or the nearest few, shape (n_frames, n_bands)."""
    out = np.empty_like(off)
    fewest = min(HABIT_FRAMES, len(core))
    for t in range(len(edge)):
        far = np.abs(edge[core] - edge[t])
        near = far <= max(HABIT_PX, float(np.partition(far, fewest - 1)[fewest - 1]))
        out[t] = np.median(off[core[near]], axis=0)
    return out


RETURNED = 0.2
"""Share of the film's usual difference from the background (in power) below which a column shows background again.
Chosen: 0.45 of the film's contrast. By reasoning: at half noise keeps bare columns from counting as bare; at twice
faint film counts as bare."""
SHORTEST_PX = 10
"""Columns that must show background again: more than any blur or ringing of the coder. Chosen. By reasoning: at half
ringing of the coder counts as bare; at twice payloads that leave late are followed."""
FILM_PARTS = (0.7, 0.35, 0.175)
"""Parts of the columns passed, from the first, of which at least one is film by more than half. Derived: it is so where
film is from a tenth to all of what is passed; a payload flies on over several lengths of a short tube. By reasoning: of
half of the least a door's columns make half, at twice a tube that is a fifth of the way counts as bare."""
RUNS_AWAY = 1.35
"""A payload leaves at the speed of the tail, twice the edge's; less than this is growth. Chosen between 1 and 2. By
reasoning: nearer 1 growth that speeds up counts as flight; nearer 2 a payload slowed by drag does not."""


def growth_end(strip: Strip, path: Floats, passed: tuple[int, int]) -> int:
    """Column where the film ends although what moves goes on, or the end of `passed` where nothing does.

    From the last column passed backwards: what flies (no longer than the tube is wide), then columns that look as
    they did before anything came, then film. What flies must be faster than the edge was, or have leapt ahead of it.

    Parameters
    ----------
    strip : along the axis.
    path : column of the front by frame, shape (n_frames,), px.
    passed : first column passed, and the one behind the last.

    Returns
    -------
    column.
    """
    columns, frames = np.arange(passed[0], passed[1]), len(path)
    if len(columns) < 5 * SHORTEST_PX or frames < 8:
        return passed[1]
    arrival = np.clip(np.searchsorted(path, columns + 0.5), 0, frames - 1)
    stays = _difference(strip, columns, arrival)
    usual = max(float(np.median(stays[: int(part * len(stays))])) for part in FILM_PARTS)
    back = stays < RETURNED * usual
    i = _first_bare(back, strip.values.shape[1])
    if i < 3 * SHORTEST_PX or back[i - 2 * SHORTEST_PX : i].mean() > 0.3:
        return passed[1]
    growth, flight = _speed(arrival, i - 6 * SHORTEST_PX, i - 5), _speed(arrival, i + 2, len(columns))
    # What comes out is ahead of the film at once by its own length, however slowly it then flies.
    out = int(arrival[i])
    leap = float(np.diff(path)[max(out - 2, 0) : out + 2].max(initial=0.0))
    leaves = flight > RUNS_AWAY * growth or leap > max(RUNS_AWAY * growth, growth + SHORTEST_PX / 2)
    return int(columns[i]) + 1 if leaves else passed[1]


def _first_bare(back: NDArray[np.bool_], longest: int) -> int:
    """First column of SHORTEST_PX or more in a row that are `back`, with at most `longest` after it that are not."""
    others = np.cumsum(~back[::-1])[::-1]
    runs = np.convolve(back, np.ones(SHORTEST_PX), mode="full")[SHORTEST_PX - 1 :] > SHORTEST_PX - 0.5
    starts = np.flatnonzero(runs & (others <= longest))
    return int(starts[0]) if len(starts) else 0


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
