"""The front as a monotone path through space and time, by dynamic programming.

Two passes. The first (`first_path`) knows nothing of film or background: a column changes once, when the front passes
it. `changing_path` collects the change of every column; `lasting_path` divides columns that look as they will at last
from those that look as they did at first. The second pass knows both, and asks of every pixel in every frame which of
the two it resembles, with clipped distances, so that a door, a payload flying ahead or a reflection cannot steal the
path.

`track_arrival` is for the tip of a vine that bends, sweeps or slides along walls. Such a vine leaves what it has
covered, and no picture of its film holds for long; the tracker of a straight front would follow its sweeping. But a
place that the tip has not reached looks as it did at first: the edge is the monotone path that best divides changed
from unchanged columns, good to about a pixel, not better.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from vinetrack.core.records import Floats
from vinetrack.video.edge_cover import MATHS

if TYPE_CHECKING:
    from vinetrack.video.strip import Strip


BUNCHED, MOST_BUNCHED = 12, 4
"""Groups of rows that a strip is divided into, and rows of a group at most. Chosen for time; at half noise averages out
further and narrow vines fill one group, at twice the first path takes twice as long."""
WINDOW = 10
"""Frames before and after over which a change is judged. Chosen: noise averages out, and the slowest pass 10 px. By
reasoning: at half faint film is lost, at twice what follows soon upon another change is."""
LEAST_SCORE, SHARE, NEVER = 3.0, 0.15, 0.2
"""Score from which a column counts as changed; the part of its largest score that each frame must exceed to count; the
cost of crossing a column that never changed. Chosen: three times what noise brings on average; a change seen in part,
as by a blurred edge, still counts. By reasoning: at half noise draws the path on; at twice faint stretches end it."""
FIRST_FRAMES = 5
"""The median of the first so many frames is what stands before the vine comes, that of the last so many what it leaves.
Chosen: the median of five drops two odd ones. By reasoning: at half a single glint counts; at twice the fastest have
grown by a third."""
DISTINCT = 4.0
"""Difference of first and last look, in units of the noise, at which a pixel has half a vote. Chosen: two look alike
within it. By reasoning: at half noise votes, at twice dark film on dark ground hardly does."""
STRAY = 3.0
"""Noise beyond which a value is as far from a picture as can be. Chosen: three standard deviations. By reasoning: at
half noise counts like what is amiss; at twice a bright door counts more than the film it stands beside."""

CHANGED_ROWS = 4
"""Rows of a column that must have changed for something to be there. Chosen: noise above the threshold never fills
four rows. By reasoning: at half glints count, at twice thin vines do not."""
STRONG = 4.0
"""Change in units of the noise, with the noise of compressed pictures at 3 grey levels or more. Chosen: 6e-5 by chance
in a pixel. By reasoning: at half noise counts as arrival, at twice dark film on dark ground does not."""
SIGMA_PX = 0.8
"""Half a pixel of the path's own grid, and the ragged outline of a crumpled tip. Chosen; half or twice is the stated
error of such tracks."""


LEAP, LEAP_OVER_PX = 3.0, 2.0
"""A step so many times those that follow, taken as this much at least, is no growth. Chosen: from rest steps grow. By
reasoning: at half vines that slow down at once lose their start; at twice a tail that jerks passes for growth."""


@njit(cache=True, nogil=True, fastmath=MATHS, error_model="numpy")
def _change_score(
    strip: np.ndarray, scale: np.ndarray, offset: np.ndarray, window: int, bunch: int, noise: float
) -> np.ndarray:
    """How much each column changes at each frame, shape (n_frames, n_along).

    Sum of squares between the means of the `window` frames before and from frame t on, rows bunched by `bunch`, in
    units of its expectation under noise, which is subtracted.
    """
    n, rows, columns = strip.shape
    groups = rows // bunch
    binned = np.zeros((n + 1, columns), np.float32)
    score = np.zeros((n, columns), np.float32)
    total = np.empty(columns, np.int32)
    for g in range(groups):
        for t in range(n):
            total[:] = 0
            for k in range(bunch):
                values = strip[t, g * bunch + k]
                for s in range(columns):
                    total[s] += values[s]
            gain, level = np.float32(scale[t] / bunch), np.float32(offset[t])
            before, after = binned[t], binned[t + 1]
            for s in range(columns):
                after[s] = before[s] + (np.float32(total[s]) * gain + level)
        for t in range(1, n):
            a, b = min(n, t + window), max(0, t - window)
            factor = np.float32((a - t) * (t - b) / (a - b))
            share_after, share_before = np.float32(1 / (a - t)), np.float32(1 / (t - b))
            above, here, under, line = binned[a], binned[t], binned[b], score[t]
            for s in range(columns):
                d = (above[s] - here[s]) * share_after - (here[s] - under[s]) * share_before
                line[s] += factor * d * d
    unit = np.float32(noise * noise / bunch * max(groups, 1))
    return score / unit - np.float32(1.0)


@njit(cache=True)
def _collect_path(score: np.ndarray) -> np.ndarray:
    """Monotone path that collects most of `score` (n_frames, n_along), each column once; edge by frame, (n_frames,)."""
    n, columns = score.shape
    best = np.zeros((n, columns + 1), np.float32)
    came = np.zeros((n, columns + 1), np.uint8)
    for t in range(n):
        for s in range(columns + 1):
            # A path may begin anywhere: columns behind its beginning were covered before the first frame.
            top = best[t - 1, s] if t > 0 else 0.0
            if s > 0 and t > 0:
                across = best[t, s - 1] + score[t, s - 1]
                if across > top:
                    top = across
                    came[t, s] = 1
            best[t, s] = top
    path = np.zeros(n)
    s = int(np.argmax(best[n - 1]))
    for t in range(n - 1, -1, -1):
        path[t] = s
        while s > 0 and came[t, s] == 1:
            s -= 1
    return path


@njit(cache=True)
def evident_path(evidence: np.ndarray) -> np.ndarray:
    """Edge by frame, shape (n_frames,), never retreating, that best divides film from background.

    `evidence` (n_frames, n_along) is negative where a column looks like film; its sum behind the edge is made least.

    Parameters
    ----------
    evidence : shape (n_frames, n_along).

    Returns
    -------
    column of the edge, shape (n_frames,), px.
    """
    n, columns = evidence.shape
    best = np.zeros((n, columns + 1), np.float64)
    came = np.zeros((n, columns + 1), np.int32)
    for t in range(n):
        cost, running, where = 0.0, np.inf, 0
        for s in range(columns + 1):
            if s > 0:
                cost += evidence[t, s - 1]
            if t == 0:
                best[t, s] = cost
                continue
            if best[t - 1, s] < running:
                running, where = best[t - 1, s], s
            best[t, s] = running + cost
            came[t, s] = where
    path = np.zeros(n)
    s = int(np.argmin(best[n - 1]))
    for t in range(n - 1, -1, -1):
        path[t] = s
        s = came[t, s]
    return path


def changing_path(strip: Strip) -> tuple[Floats, Floats]:
    """Find the front by what changes most, and how much each column changes as it passes.

    Within a column the score is linear in the power of the change, so that the strongest change wins; between columns
    only its logarithm counts, so that a bright glint in a few columns cannot outvote the rest.

    Parameters
    ----------
    strip : along the axis, growth towards higher columns.

    Returns
    -------
    column of the front, shape (n_frames,), px
    logarithm of each column's change over that of noise, less SHARE of it; shape (n_along,)
    """
    score = _change_score(strip.values, strip.scale, strip.offset, WINDOW, _bunch(strip), strip.noise)
    peak = score.max(axis=0)
    worth = np.where(peak > LEAST_SCORE, np.log1p(np.maximum(peak, 0)) / np.maximum(peak, 1e-6), 0.0).astype(np.float32)
    score = score * worth[None, :]
    score = np.where(worth[None, :] > 0, score - SHARE * score.max(axis=0, keepdims=True), -NEVER).astype(np.float32)
    path, columns = _collect_path(score), np.arange(score.shape[1])
    when = np.clip(np.searchsorted(path, columns + 0.5), 0, len(path) - 1)
    return path, np.max([score[np.clip(when + d, 0, len(path) - 1), columns] for d in (-1, 0, 1)], axis=0)


def lasting_path(strip: Strip) -> tuple[Floats, Floats]:
    """Find the front by which of its first and last looks every pixel resembles, each having the same say.

    A pixel's vote is the difference of its distances from both, over the distance between them and DISTINCT times the
    noise: towards −1 where it looks as at last, towards 1 where as at first. Few rows of something else, however
    bright, hardly move a column's sum.

    Parameters
    ----------
    strip : along the axis, growth towards higher columns.

    Returns
    -------
    column of the front, shape (n_frames,), px
    change of each column from first to last, in the terms of `changing_path`; shape (n_along,)
    """
    first, last = _look(strip, slice(0, FIRST_FRAMES)), _look(strip, slice(-FIRST_FRAMES, None))
    votes = _votes(strip.values, strip.scale, strip.offset, first, last, DISTINCT * strip.noise)
    bunch = _bunch(strip)
    power = (last - first)[: len(first) // bunch * bunch].reshape(-1, bunch, first.shape[1]).mean(axis=1) ** 2
    times_noise = WINDOW / 2 * power.mean(axis=0) / (strip.noise**2 / bunch)
    return evident_path(votes), (1 - SHARE) * np.log1p(times_noise)


def _bunch(strip: Strip) -> int:
    """Rows of a strip that are judged together."""
    return int(np.clip(strip.values.shape[1] // BUNCHED, 1, MOST_BUNCHED))


def _look(strip: Strip, frames: slice) -> NDArray[np.float32]:
    """Median brightness of every pixel over some frames, shape (n_across, n_along)."""
    values = strip.values[frames] * strip.scale[frames, None, None].astype(np.float32)
    values += strip.offset[frames, None, None].astype(np.float32)
    if len(values) != FIRST_FRAMES:
        return np.asarray(np.median(values, axis=0), np.float32)
    # The median of five is that of the fifth, the larger minimum and the smaller maximum of two pairs.
    a, b, c, d, e = values
    low, high = np.maximum(np.minimum(a, b), np.minimum(c, d)), np.minimum(np.maximum(a, b), np.maximum(c, d))
    return np.maximum(np.minimum(low, high), np.minimum(np.maximum(low, high), e))


@njit(cache=True, nogil=True, fastmath=MATHS, error_model="numpy")
def _votes(
    strip: np.ndarray, scale: np.ndarray, offset: np.ndarray, first: np.ndarray, last: np.ndarray, unit: float
) -> np.ndarray:
    """How much less like its last than its first look each column is in each frame, shape (n_frames, n_along)."""
    n, rows, columns = strip.shape
    out = np.zeros((n, columns), np.float32)
    weight = np.float32(1.0) / (np.abs(last - first) + np.float32(unit))
    for t in range(n):
        gain, level = np.float32(scale[t]), np.float32(offset[t])
        for u in range(rows):
            for s in range(columns):
                value = np.float32(strip[t, u, s]) * gain + level
                out[t, s] += (abs(value - last[u, s]) - abs(value - first[u, s])) * weight[u, s]
    return out


@njit(cache=True, nogil=True, fastmath=MATHS, error_model="numpy")
def sides_of_front(
    strip: np.ndarray, scale: np.ndarray, offset: np.ndarray, path: np.ndarray, begin: int, end: int, window: int
) -> np.ndarray:
    """Mean brightness of each pixel in the frames after and before a front passes it.

    Parameters
    ----------
    strip : values as the camera wrote them, shape (n_frames, n_across, n_along).
    scale, offset : brightness = scale · value + offset, shape (n_frames,).
    path : column of the front by frame, never falling, shape (n_frames,), px.
    begin, end : first column, and the one behind the last.
    window : frames after and before the passage of which means are taken.

    Returns
    -------
    film and background, shape (2, n_across, end − begin), grey levels; a column that is never seen bare, or never
    covered, has the value of the nearest that is.
    """
    n, rows, _ = strip.shape
    front = np.empty(n + 1, np.int64)
    for t in range(n):
        front[t] = min(max(math.ceil(path[t]), begin), end)
    front[n] = front[n - 1]
    sums, counts = np.zeros((2, rows, end - begin), np.float32), np.zeros((2, end - begin), np.float32)
    for t in range(n):
        gain, level = np.float32(scale[t]), np.float32(offset[t])
        for k in range(2):
            # The frame of the passage and its neighbour show the edge itself.
            low, high = front[t + 1], front[min(t + window + 1, n)]
            if k == 0:
                low, high = begin if t <= window else front[t - window - 1], front[max(t - 1, 0)]
            elif t + window + 1 >= n:
                high = end
            if high <= low:
                continue
            counts[k, low - begin : high - begin] += np.float32(1.0)
            for u in range(rows):
                values, line = strip[t, u, low:high], sums[k, u, low - begin : high - begin]
                for s in range(high - low):
                    line[s] += np.float32(values[s]) * gain + level
    for k in range(2):
        known = np.flatnonzero(counts[k] > 0)
        for s in range(end - begin):
            source = s
            if len(known) and counts[k, s] == 0:
                source = known[np.argmin(np.abs(known - s))]
            share = 1 / max(counts[k, source], np.float32(1.0))
            for u in range(rows):
                if source <= s:
                    sums[k, u, s] = sums[k, u, source] * (share if source == s else np.float32(1.0))
                else:
                    sums[k, u, s] = sums[k, u, source] * share
    return sums


@njit(cache=True, nogil=True, fastmath=MATHS, error_model="numpy")
def unexplained(
    strip: np.ndarray,
    scale: np.ndarray,
    offset: np.ndarray,
    noise: float,
    path: np.ndarray,
    pictures: np.ndarray,
    begin: int,
    end: int,
) -> float:
    """Sum what film behind a path and background ahead of it do not explain.

    Parameters
    ----------
    strip : values as the camera wrote them, shape (n_frames, n_across, n_along).
    scale, offset : brightness = scale · value + offset, shape (n_frames,).
    noise : standard deviation of a value, grey levels.
    path : column of the front by frame, shape (n_frames,), px.
    pictures : brightness of film, then of background, shape (2, n_across, end − begin).
    begin, end : columns over which to sum.

    Returns
    -------
    squares in units of the noise, each STRAY² at most.
    """
    n, rows, _ = strip.shape
    unit, top, total = np.float32(1 / noise), np.float32(STRAY * STRAY), 0.0
    for t in range(n):
        gain, level = np.float32(scale[t]), np.float32(offset[t])
        front = min(max(math.ceil(path[t]), begin), end)
        for u in range(rows):
            row_total: Any = np.float32(0.0)
            for k in range(2):
                low, high = (begin, front) if k == 0 else (front, end)
                values, picture = strip[t, u, low:high], pictures[k, u, low - begin : high - begin]
                for s in range(high - low):
                    off = (np.float32(values[s]) * gain + level - picture[s]) * unit
                    row_total += min(off * off, top)
            total += row_total
    return total


def after_jump(path: Floats) -> int:
    """Column where growth begins in earnest: a path that leaps at its start and crawls on has not grown that far.

    At release the tail jerks inside the film that already stands, and its columns change without any front. No front
    is three times as fast in its first frames as in those that follow.

    Parameters
    ----------
    path : column of the front by frame, shape (n_frames,), px.

    Returns
    -------
    column; 0 where the path does not leap at its start.
    """
    steps = np.diff(path)
    if not np.any(steps > 0):
        return 0
    onset = int(np.argmax(steps > 0))
    begin = 0
    for t in range(onset, min(onset + 4, len(steps) - 4)):
        if steps[t] > LEAP * max(float(np.median(steps[t + 1 : t + 5])), LEAP_OVER_PX):
            begin = int(path[t + 1])
    return begin


def track_arrival(strip: Strip) -> tuple[Floats, Floats]:
    """Edge along the strip and its error in every frame, shapes (n_frames,), px.

    Parameters
    ----------
    strip : along the axis, growth towards higher columns.

    Returns
    -------
    edge and its standard error, each of shape (n_frames,), px.

    Raises
    ------
    ValueError
        Where nothing new arrives anywhere.
    """
    values = strip.values.astype(np.float32) * strip.scale[:, None, None].astype(np.float32)
    values += strip.offset[:, None, None].astype(np.float32)
    first = np.median(values[:FIRST_FRAMES], axis=0)
    threshold = STRONG * max(strip.noise, 3.0)
    changed = (np.abs(values - first) > threshold).sum(axis=1).astype(float)
    smooth = np.apply_along_axis(np.convolve, 1, changed, np.ones(3) / 3, "same")
    evidence = (CHANGED_ROWS - np.minimum(smooth, 3 * CHANGED_ROWS)).astype(np.float32)
    ever = np.flatnonzero((smooth > CHANGED_ROWS).mean(axis=0) > 0.05)
    if len(ever) < 10:
        raise ValueError("nothing moves along the axis")
    evidence[:, : ever[0]] = 0.0
    path = evident_path(evidence)
    edge = np.maximum(path, max(after_jump(path), float(ever[0]))) - 0.5
    smoothed = np.convolve(np.pad(edge, 2, mode="edge"), np.ones(5) / 5, mode="valid")
    return smoothed, np.full(len(edge), SIGMA_PX)
