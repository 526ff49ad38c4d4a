"""Repair of edge fits that break the motion, and errors of the edge by its bands.

The fit of every frame is compared with the motion; where it breaks it, the edge is searched again where the motion
leads. The edge is also fitted in bands of rows, each alone: their disagreement is an error that needs no model of
noise, since film, tail, glints and a swinging door touch one band and not another.
"""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from vinetrack.core.records import Floats
from vinetrack.video.edge_state import EdgeState, core_frames, fit_edges, moving_frames, search_edges
from vinetrack.video.slow_errors import shared_disagreement
from vinetrack.video.strip import Strip

ASTRAY_PX = 3.0  # Standard error stated where nothing like the edge is found where the motion leads
# Ratio by which the misfit of a fit that agrees with its neighbours may exceed that of one that does not (chosen)
CONSISTENT_MISFIT_RATIO = 1.4
# Amplitude (relative contrast) below which a fit has found something other than the edge (chosen)
LEAST_FITTED_AMPLITUDE = 0.5
# Frames of rest, counted from the motion, within which a bad fit is searched again from many starts (chosen)
LONG_REST_FRAMES = 8


def repair_jumps(strip: Strip, state: EdgeState, fit: Floats, chosen: NDArray[np.bool_]) -> Floats:
    """Replace fits that break the motion or hardly fit by the best ones where the motion leads. Goes from the middle of
    the motion backwards and forwards. The edge never retreats, and a step is at most 1.3 times its neighbour or 1.5 px
    more. Shapes: fit (n_frames, 6); chosen (n_frames,) → (n_frames, 6).
    """
    moving = np.flatnonzero(moving_frames(state.edge) & np.isfinite(fit[:, 0]))
    if len(moving) < 5:
        return fit
    out = fit.copy()
    bad_misfit = 1.5 * float(np.nanmedian(fit[core_frames(state, fit), 2]))
    decentrality = np.abs(moving - 0.5 * (moving[0] + moving[-1])) / len(moving)
    anchor = int(moving[np.argmin(decentrality + _is_rough(fit[moving, 0]) + (fit[moving, 2] > bad_misfit))])
    first, last = (int(frame) for frame in np.flatnonzero(chosen)[[0, -1]])
    edge = out[:, 0].tolist()
    for sense in (-1, 1):
        resting = 0
        for t in range(anchor + sense, first - 1 if sense < 0 else last + 1, sense):
            previous, second, third = (edge[min(max(t - k * sense, 0), len(edge) - 1)] for k in (1, 2, 3))
            # The larger of two steps, since a frame may repeat the one before it.
            step = max(0.0 if math.isnan(gap) else abs(gap) for gap in (second - previous, third - second))
            resting = resting + 1 if step < 0.3 else 0
            reach = max(1.3 * step, step + 1.5)
            low, high = (previous - reach, previous + 0.8) if sense < 0 else (previous - 0.8, previous + reach)
            inside, faint = low <= edge[t] <= high, out[t, 3] < LEAST_FITTED_AMPLITUDE - 1
            good_enough = (out[t, 2] <= bad_misfit or resting > LONG_REST_FRAMES) and not faint
            if not math.isfinite(previous) or (inside and good_enough):
                continue
            replacement = _best_between(strip, state, t, low, high, 1 if resting > LONG_REST_FRAMES else 9)
            if inside:
                if replacement is not None and (faint or replacement[2] < out[t, 2]):
                    out[t] = replacement
            elif not faint and _spans_missing_frames(edge[t] - previous, step) and _good_and_better(
                out[t], replacement, bad_misfit
            ):  # fmt: skip
                continue
            elif replacement is None:
                expected = previous if math.isnan(edge[t]) else edge[t]
                out[t] = (min(max(expected, low), high), ASTRAY_PX, 4 * bad_misfit, 0, 0, 0)
            else:
                out[t] = replacement
            edge[t] = float(out[t, 0])
    return _repair_strays(strip, state, out, moving, bad_misfit)


def _repair_strays(strip: Strip, state: EdgeState, fit: Floats, moving: NDArray[np.int_], bad_misfit: float) -> Floats:
    """Replace bad fits that stray from the parabola through two neighbours on each side by the best fit near it. A good
    fit stays (its frame may repeat another), and so does one that fits much better than what is found there.
    """
    out = fit.copy()
    for t in moving[2:-2]:
        around = out[[t - 2, t - 1, t + 1, t + 2], 0]
        expected = (-around[0] + 4 * around[1] + 4 * around[2] - around[3]) / 6
        bend = abs(around[0] - 2 * around[1] + 2 * around[2] - around[3])
        distance = abs(out[t, 0] - expected)
        if not np.isfinite(distance) or out[t, 2] <= bad_misfit or distance < max(1.5, bend):
            continue
        reach = max(2.0, 0.3 * distance)
        replacement = _best_between(strip, state, int(t), expected - reach, expected + reach, 9)
        if replacement is not None and replacement[2] < CONSISTENT_MISFIT_RATIO * out[t, 2]:
            out[t] = replacement
    return out


def _good_and_better(fit: Floats, other: Floats | None, bad_misfit: float) -> bool:
    """Whether a fit is good, and better than another."""
    return bool(fit[2] <= bad_misfit) and (other is None or bool(other[2] > fit[2]))


def _spans_missing_frames(stride: float, step: float) -> bool:
    """Whether a stride is two to four whole steps: frames are missing, and the point is right."""
    ratio = abs(stride) / max(step, 1e-6)
    return step > 1.0 and 1.75 < ratio < 4.25 and abs(ratio - round(ratio)) < 0.25


def _is_rough(edge: Floats) -> NDArray[np.bool_]:
    """Points further from the mean of their neighbours than a pixel and 0.15 of the step, (n,)."""
    rough = np.ones(len(edge), dtype=bool)
    step = np.abs(edge[2:] - edge[:-2]) / 2
    rough[1:-1] = np.abs(edge[1:-1] - 0.5 * (edge[2:] + edge[:-2])) > 1.0 + 0.15 * step
    return rough


def _best_between(strip: Strip, state: EdgeState, t: int, low: float, high: float, starts: int) -> Floats | None:
    """Best fit of frame t that starts and stays between `low` and `high`, shape (6,); None where there is none."""
    places = np.linspace(low, high, int(np.clip((high - low) / 2, 3, 9)))[:: 9 // starts]
    fits = search_edges(strip, state, np.full(len(places), t), places)
    inside = (fits[:, 0] >= low - 0.5) & (fits[:, 0] <= high + 0.5) & (fits[:, 3] > LEAST_FITTED_AMPLITUDE - 1)
    inside &= np.isfinite(fits[:, 2])
    return fits[inside][np.argmin(fits[inside, 2])] if inside.any() else None


BANDS = 4  # Bands across the strip: enough to show which errs, few enough that each still finds the edge (chosen)
FEWEST_ROWS = 4  # Fewest rows of a band (chosen)

# Deviation of a band, in median absolute deviations of the bands of its frame, at which it is clipped (chosen)
OUTLYING_BAND = 2.0
BAND_OFFSET_PX = 50.0  # Growth over which the lead or lag of a band is taken as its usual offset (chosen)
BAND_OFFSET_FRAMES = 7  # Fewest frames from which that offset is taken (chosen)

NEIGHBOURS = 2  # Frames on each side over which the median disagreement is taken (chosen)
MEDIAN_TO_MEAN = 1.27  # Ratio of mean to median of χ² with three degrees of freedom (derived)


def band_disagreement(strip: Strip, state: EdgeState, edge: Floats, core: NDArray[np.bool_]) -> tuple[Floats, float]:
    """Error of the edge from the disagreement of its bands, and the part of it that neighbouring frames share. The
    weighted mean of K independent bands has the variance Σ w (y − ȳ)² / ((K − 1) Σ w). What a band leads or lags by for
    long in the `core` frames is the shape of the tip, not an error. Returns standard error, shape (n_frames,), px;
    zeros where there is one band only, slow error of all frames, px; see `slow_errors.shared_disagreement`. Shapes:
    edge, core (n_frames,).
    """
    edges, sigmas = band_fits(strip, state, edge)
    if edges.shape[1] < 2:
        return np.zeros(len(edge)), 0.0
    lead_px = np.nan_to_num(edges - edge[:, None])
    slow = shared_disagreement(lead_px[core])
    lead_px = lead_px - _band_offsets(lead_px, edge, np.flatnonzero(core))
    weight = np.where(np.isfinite(sigmas), 1 / (np.nan_to_num(sigmas, nan=1.0) ** 2 + 1e-4), 1e-4)
    median_lead = np.median(lead_px, axis=1, keepdims=True)
    limit = OUTLYING_BAND * np.median(np.abs(lead_px - median_lead), axis=1, keepdims=True) + 0.05
    lead_px = median_lead + np.clip(lead_px - median_lead, -limit, limit)
    total = weight.sum(axis=1)
    mean = (weight * lead_px).sum(axis=1) / total
    variance = (weight * (lead_px - mean[:, None]) ** 2).sum(axis=1) / (lead_px.shape[1] - 1) / total
    padded = np.pad(variance, NEIGHBOURS, mode="edge")
    running_median = np.median(np.lib.stride_tricks.sliding_window_view(padded, 2 * NEIGHBOURS + 1), axis=1)
    return np.asarray(np.sqrt(MEDIAN_TO_MEAN * running_median)), slow


# Part of the distance between both ends of an uncertain blur that counts as its standard error (derived)
BLUR_SIGMA_PART = 0.25


def dwell_error_px(edge: Floats, exposure_frames: float) -> Floats:
    """Standard error of an edge that stops or starts within an exposure or next to it. The model's blur is that of
    uniform motion at the mean of the speeds before and after. Where these differ by Δv, either may be the speed during
    the exposure of τ frames, and the length of the blur is uncertain by τΔv/2. Shapes: edge (n_frames,) → (n_frames,).
    """
    if len(edge) < 3 or exposure_frames <= 0:
        return np.zeros(len(edge))
    steps = np.abs(np.diff(np.pad(np.nan_to_num(edge), 2, mode="edge")))
    speed = np.maximum(steps[:-3], steps[3:])
    from_middle = (steps[1:-2] + steps[2:-1]) / np.maximum(speed, 1e-9) - 1
    within = np.maximum(exposure_frames / 2 - np.abs(from_middle), 0.0)
    behind = speed * within**2 / (2 * exposure_frames)
    return np.asarray(np.hypot(behind, BLUR_SIGMA_PART * exposure_frames / 4 * np.abs(steps[2:-1] - steps[1:-2])))


def band_fits(strip: Strip, state: EdgeState, edge: Floats) -> tuple[Floats, Floats]:
    """Fit the edge of each band of rows alone; NaN where a band shows none. The bands share the rows that are
    informative about the edge evenly. Returns edge and its standard error, each of shape (n_frames, n_bands), px.
    Shapes: edge (n_frames,).
    """
    rows = strip.values.shape[1]
    contrast = np.sum((state.appearance[0] - state.appearance[1]) ** 2, axis=1).astype(float)
    contrast = np.minimum(contrast, 4 * np.median(contrast) + 1e-9)
    cuts = np.searchsorted(np.cumsum(contrast) / contrast.sum(), np.linspace(0, 1, BANDS + 1)[1:-1])
    limits = np.concatenate([[0], cuts, [rows]])
    edges, sigmas = [], []
    for low, high in pairwise(limits):
        if high - low < FEWEST_ROWS:
            continue
        fit = fit_edges(strip, replace(state, edge=edge), rows=(int(low), int(high)))
        edges.append(fit[:, 0])
        sigmas.append(fit[:, 1])
    return np.stack(edges, axis=1), np.stack(sigmas, axis=1)


def _band_offsets(lead_px: Floats, edge: Floats, core: NDArray[np.int_]) -> Floats:
    """Median lead of each band over the core frames within BAND_OFFSET_PX, or the nearest few, (n_frames, n_bands)."""
    fewest = min(BAND_OFFSET_FRAMES, len(core))
    # Places a pixel apart have the same frames nearby but for one, and an edge at rest has one place.
    places, frame_places = np.unique(np.rint(edge), return_inverse=True)
    out = np.empty((len(places), lead_px.shape[1]))
    for i, place in enumerate(places):
        distance = np.abs(edge[core] - place)
        near = distance <= max(BAND_OFFSET_PX, float(np.partition(distance, fewest - 1)[fewest - 1]))
        out[i] = np.median(lead_px[core[near]], axis=0)
    return out[frame_places]
