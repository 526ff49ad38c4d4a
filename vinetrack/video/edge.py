"""Tracking of the leading edge through a strip: its position at mid-exposure in every frame, and the standard error.

The tracker alternates between two estimates. Given the edge, the brightness of film and background at every pixel
follows from weighted least squares (a 2 by 2 system per pixel, so that no frame need be free of motion). Given film and
background, the edge in every frame follows by maximum likelihood: a step between the two, blurred by the optics (a
Gaussian) and by its own motion during the exposure (a box), is fitted by Gauss-Newton. The shape of the tip, the
optical blur, the exposure and the light and shade that the tip carries with it are estimated along the way.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vinetrack.core.records import Bools, Floats, Indices
from vinetrack.experiment.schema import SMALLEST_POINT_SPACING_PX
from vinetrack.video import edge_kernels as kernels
from vinetrack.video.axis import (
    END_FRAMES,
    LEAST_FRONT_SHARE,
    Axis,
    SmallPictures,
    axis_through,
    column_after_leap,
    dividing_path,
    front_share,
)
from vinetrack.video.edge_kernels import coverage_reach
from vinetrack.video.frames import RecordingError
from vinetrack.video.strip import Look, Positions, Strip, Tracker, calibrated_sigma, cut_strip, median_of, snap_to_grid

# ------------------------------------------------------------------------------
# State of the tracker and the steps of its alternation: estimate film and background, then fit the edge.

# Frames before and after the passage of the edge over which the weight of a pixel's values falls to 1/e: more of them
# would show a door where background stands once it has left (measured)
MEMORY_FRAMES = 3.0
# Standard deviation, grey levels, of a pixel about the mean of its neighbours, used where the pixel was never visible
TEXTURE_SD = 12.0
# Maximum number of Gauss-Newton steps, in final fits and in fits that others follow (measured)
FIT_ROUNDS, EARLY_FIT_ROUNDS = 12, 6
MARGIN_PX = 6.0  # Pixels used beyond the blurred edge on either side: they determine amplitude and level (chosen)
AROUND_PX = 64.0  # Distance from the edge's way up to which film and background are asked: a fifth of the time (chosen)
SHADING_REACH_PX = 24  # Distance from the edge within which the tip may carry light and shade with it (chosen)
# Growth after which the neighbourhood of the start is clear of whatever held the tip there (20 mm at 3 px/mm) (chosen)
START_CLEARANCE_PX = 60.0


@dataclass(frozen=True)
class EdgeState:
    """Current estimates of the alternation. `edge` and the `lengths` of its motion blur, shape (n_frames,), px; the
    tip's `lag` by row, shape (n_across,), px; the optical `blur`, px.
    """

    edge: Floats
    lengths: Floats
    lag: Floats
    blur: float
    appearance: NDArray[np.float32]
    shading: Floats = field(default_factory=lambda: np.zeros(2 * SHADING_REACH_PX + 1))


def blur_lengths(edge: Floats, exposure_frames: float) -> Floats:
    """Length of the motion blur by frame: smoothed speed times exposure. Shapes: edge (n_frames,) → (n_frames,)."""
    smooth = np.convolve(np.pad(np.gradient(edge), 1, mode="edge"), [0.25, 0.5, 0.25], mode="valid")
    return np.clip(smooth, 0, None) * exposure_frames


def moving_frames(edge: Floats) -> Bools:
    """Frames in which the edge moves or creeps on to its end; all if fewer than five. Shapes: (n_frames,) → same."""
    speed, frames = np.abs(np.gradient(edge)), np.arange(len(edge))
    moving = speed > max(0.2, 0.1 * np.sort(speed)[int(0.95 * (len(speed) - 1))])
    # 2.0: distance from its end up to which an edge has come to rest, px (chosen)
    moving |= (frames > frames.max(initial=0, where=moving)) & (edge < edge.max() - 2.0)
    return moving if moving.sum() >= 5 else np.ones(len(edge), dtype=bool)


def informative_frames(edge: Floats) -> Bools:
    """Frames that determine film and background: those in motion, and MEMORY_CUTOFF memories before and after."""
    moving, reach = np.flatnonzero(moving_frames(edge)), math.ceil(MEMORY_FRAMES * kernels.MEMORY_CUTOFF)
    frames = np.arange(len(edge))
    return np.asarray((frames >= moving[0] - reach) & (frames <= moving[-1] + reach))


def estimate_appearance(strip: Strip, state: EdgeState, clip: float) -> EdgeState:
    """Estimate the brightness of film and background at every pixel, given the edge."""
    ridge_weight = 0.05  # Weight, in frames, of a pixel's neighbours if the pixel itself was visible (derived)
    neighbour_decay = 0.93  # Factor by which the weight of neighbours falls per column (derived)
    # First and last frame in which the edge is over each column. Near the start, film is counted only once the edge has
    # cleared it: until then a door may stand or swing there.
    frames, places = np.arange(len(state.edge), dtype=float), np.arange(strip.values.shape[2], dtype=float)
    monotone = np.maximum.accumulate(state.edge) + 1e-6 * frames
    begin, end = frames[moving_frames(state.edge)][[0, -1]]
    passing_px = 0.5 * float(np.median(state.lengths)) + 3 * state.blur + 1
    behind = np.maximum(places + passing_px + float(state.lag.max()), clear_of_start(state.edge))
    early = np.clip(np.interp(places - passing_px, monotone, frames), begin, end)
    early[(places < state.edge.min() - AROUND_PX) | (places > state.edge.max() + AROUND_PX)] = np.inf
    late = np.clip(np.interp(behind, monotone, frames), begin, end)
    # 2.06: distance from the edge, in optical blurs, from which a pixel is pure film or background (derived)
    reach = 0.5 * state.lengths + 2.06 * state.blur
    sums = kernels.gather(
        strip.values, strip.scale, strip.offset, state.edge, reach, state.lag, early, late, MEMORY_FRAMES,
        state.appearance, clip, state.shading,
    )  # fmt: skip
    middle = float(strip.brightness(np.array([len(strip.values) // 2])).mean())
    appearance = kernels.solve(sums, ridge_weight, neighbour_decay, middle, strip.noise, TEXTURE_SD)
    # Columns near the start whose background looks like their film were film all along. If the initial edge is placed
    # too far back, film serves as its own background; without contrast nothing corrects it.
    contrast = np.sort(np.abs(appearance[0] - appearance[1]), axis=0)[appearance.shape[1] // 2]
    columns, clear = np.arange(len(contrast)), clear_of_start(state.edge)
    near = (columns > state.edge[0] - 5) & (columns < clear)
    later = (columns >= clear) & (columns < state.edge.max() - 5)
    # 0.4: part of the typical contrast below which film and background are the same material (chosen)
    film_all_along = near & (contrast < 0.4 * float(np.median(contrast[later]))) if later.sum() >= 10 else near & False
    film_all_along[near] = np.logical_and.accumulate(film_all_along[near])
    if film_all_along.any():
        sums[1, :, :, film_all_along] = 0.0
        appearance = kernels.solve(sums, ridge_weight, neighbour_decay, middle, strip.noise, TEXTURE_SD)
    return replace(state, appearance=appearance)


def clear_of_start(edge: Floats) -> float:
    """Column beyond which nothing that held the tip at its start is near. Shapes: edge (n_frames,)."""
    return float(edge[0] + min(START_CLEARANCE_PX, 0.2 * (edge.max() - edge[0])))


def core_frames(state: EdgeState, fit: Floats) -> Bools:
    """Frames that determine the shape of the tip: in motion, clear of the start, and fitted no worse than most."""
    moving = moving_frames(state.edge)
    clear = moving & (state.edge > clear_of_start(state.edge))
    if not np.isfinite(fit[clear if clear.sum() >= 5 else moving, 2]).any():
        raise ValueError("something moves along the axis, but nothing like an edge is seen in any frame")
    if clear.sum() < 5:
        return moving
    good = clear & (fit[:, 2] <= 1.3 * np.nanmedian(fit[clear, 2]))
    return good if good.sum() >= 5 else clear


def fit_edges(strip: Strip, state: EdgeState, chosen: Bools | bool = True, rounds: int = FIT_ROUNDS) -> Floats:
    """Fit the edge of the chosen frames; see `edge_kernels.fit_edges`. Shape (n_frames, 5), NaN in the other frames."""
    frames = np.flatnonzero(np.isfinite(state.edge) & chosen)
    out = np.full((len(state.edge), 5), np.nan)
    out[frames] = search_edges(strip, state, frames, state.edge[frames], rounds)
    return out


def search_edges(strip: Strip, state: EdgeState, frames: Indices, starts: Floats, rounds: int = FIT_ROUNDS) -> Floats:
    """Fit the edge from several starts, in any frames; see `edge_kernels.fit_edges`. frames, starts (n_searches,)."""
    contrast_prior_sd = 0.15  # Prior deviation of relative amplitude and level of the contrast in one frame (chosen)
    return kernels.fit_edges(
        strip.values, strip.scale, strip.offset, starts, state.lengths, state.lag, state.blur, state.appearance,
        contrast_prior_sd, MARGIN_PX, rounds, _padded_shading(state, MARGIN_PX), frames,
    )  # fmt: skip


def _padded_shading(state: EdgeState, margin_px: float) -> Floats:
    """Pad the shading of the tip with zeros to the width that the compiled loops read."""
    longest = float(np.fmax.reduce(state.lengths, initial=0.0))
    reach = math.ceil(coverage_reach(longest, state.blur) + margin_px) + 4
    padding = max(reach - SHADING_REACH_PX, 0)
    padded = np.zeros(len(state.shading) + 2 * padding)
    padded[padding : len(padded) - padding] = state.shading
    return padded


def residual_sums(
    strip: Strip, state: EdgeState, fit: Floats, use: Bools, margin_px: float = MARGIN_PX
) -> tuple[Floats, Floats, float]:
    """What a fit leaves in the frames of `use`, by rows, by distances, and its robust misfit, in which a wider blur
    would not lower its own; see `edge_kernels.residual_sums`. Shapes: fit (n_frames, 5); use (n_frames,).
    """
    filled, frames, shading = np.nan_to_num(fit), np.flatnonzero(use), _padded_shading(state, margin_px)
    filled[:, 0] = state.edge
    return kernels.residual_sums(
        strip.values, strip.scale, strip.offset, filled, state.lengths, state.lag, state.blur, state.appearance,
        margin_px, frames, shading,
    )  # fmt: skip


# ------------------------------------------------------------------------------
# Estimate the tip's shape and shading, the optical blur and the exposure from the residuals of the edge fit.

EXPOSURES = np.array([0.02, 0.05, 0.1, 0.15, 0.2, 0.3, 0.4, 0.5, 0.65, 0.8, 1.0])
ASSUMED_EXPOSURE = 0.25  # Exposure over frame period until it is estimated (chosen)


def find_shape(strip: Strip, state: EdgeState, fit: Floats) -> EdgeState:
    """Estimate by how much each row of the tip lags behind its foremost point, then the optical blur, both from the
    core frames with less motion blur. Shapes: fit (n_frames, 5).
    """
    largest_lag_step_px = 4.0  # Largest change of a row's lag in one round (chosen)
    core = core_frames(state, fit)
    slow = core & (state.lengths <= max(2.0, float(np.quantile(state.lengths[core], 0.5))))
    for _ in range(3):
        (slope_of_row, known), *_ = residual_sums(strip, state, fit, slow)
        step = slope_of_row / (known + 0.02 * float(known.max()) + 1e-9)
        step = np.clip(step, -largest_lag_step_px, largest_lag_step_px)
        lag, lead = _smooth_lag(state.lag + step, known, state.blur)
        state = replace(state, lag=lag, edge=state.edge - lead)
    # 16: frames from which the blur is estimated (chosen)
    sampled = np.flatnonzero(slow)[:: max(1, int(slow.sum()) // 16)]
    candidates = np.array([0.5, 0.7, 0.9, 1.2, 1.6, 2.1, 2.8])  # Blurs that are tried, px (chosen)
    # Over the same pixels for all blurs: pixels far from the edge, which always fit, would favour the widest.
    widest = MARGIN_PX + coverage_reach(0.0, float(candidates.max()))
    misfits = np.full(len(candidates), np.inf)
    least = int(np.argmin(np.abs(candidates - state.blur)))
    while not np.isfinite(misfits[max(least - 1, 0) : least + 2]).all():  # down to the least, from the blur until now
        for k in (k for k in range(max(least - 1, 0), min(least + 2, len(candidates))) if np.isinf(misfits[k])):
            # Each with a new fit: a blur must not be judged by edges fitted with another.
            blurred = replace(state, blur=float(candidates[k]))
            fit = fit_edges(strip, blurred, np.isin(np.arange(len(state.edge)), sampled), EARLY_FIT_ROUNDS)
            use = np.isfinite(fit[:, 0])
            blurred = replace(blurred, edge=np.where(use, fit[:, 0], state.edge))
            misfits[k] = residual_sums(strip, blurred, fit, use, widest - coverage_reach(0.0, blurred.blur))[2]
        least = int(np.argmin(misfits))
    return replace(state, blur=_least_misfit(candidates, misfits))


def find_shading(strip: Strip, state: EdgeState, fit: Floats) -> EdgeState:
    """Estimate what the tip shows beyond film and background, by distance ahead of the edge. A round tip is lit
    differently from the tube behind it: its rim may be as bright as the background where the film is darker, and the
    edge would be fitted behind the rim. Shapes: fit (n_frames, 5).
    """
    core = core_frames(state, fit)
    for _ in range(2):
        _, sums, _ = residual_sums(strip, state, fit, core)
        middle = sums.shape[1] // 2
        residual_sum, known = sums[:, middle - SHADING_REACH_PX : middle + SHADING_REACH_PX + 1]
        step = residual_sum / np.maximum(known, 1e-3 * float(known.max()) + 1e-12)
        # (0.25, 0.5, 0.25): smoothing kernel of the tip's shading (chosen)
        state = replace(state, shading=np.convolve(state.shading + step, (0.25, 0.5, 0.25), mode="same"))
    return state


def seen_exposure(strip: Strip, state: EdgeState, fit: Floats, stated_frames: float) -> tuple[float, float]:
    """Find the exposure that the blur of the faster frames shows, without the tip's shading, which looks like any error
    of the exposure at constant speed. Returns exposure over frame period, NaN where a stated one explains the blur as
    well or too few frames move 2 px; and the median speed of the frames used, px a frame.
    """
    core = core_frames(state, fit)
    speed = blur_lengths(state.edge, 1.0)
    fast = core & (speed >= np.quantile(speed[core], 0.5)) & (speed > 2)
    # 6: fewest frames from which a blur is told from the shape of the tip (chosen)
    if fast.sum() < 6:
        return np.nan, np.nan
    bare, tried = replace(state, shading=np.zeros_like(state.shading)), EXPOSURES.tolist()
    tried += [stated_frames] if np.isfinite(stated_frames) else []
    misfits = np.array([residual_sums(strip, replace(bare, lengths=speed * tau), fit, fast)[2] for tau in tried])
    # 1.01: ratio to the least misfit of any exposure above which the stated one is contradicted (measured)
    agrees = len(tried) > len(EXPOSURES) and misfits[-1] <= 1.01 * misfits.min()
    seen = np.nan if agrees else _least_misfit(EXPOSURES, misfits[: len(EXPOSURES)])
    return seen, float(np.median(speed[fast]))


def _smooth_lag(lag: Floats, weight: Floats, blur: float) -> tuple[Floats, float]:
    """Smooth the lag slightly along the rows, by weight, and subtract that of the foremost point; both are returned.
    The foremost point is the vertex of a parabola through the foremost third of the rows that show an edge, or five:
    the smallest lag would follow their noise. Smoothing and blur, of variance s², set a parabola c u² back by c s².
    """
    kernel = np.exp(-0.5 * (np.arange(-3, 4) / 0.8) ** 2)
    weight = weight + 1e-6 * float(weight.max() + 1e-12)
    top = np.convolve(np.pad(lag * weight, 3, mode="edge"), kernel, mode="valid")
    smooth = top / np.convolve(np.pad(weight, 3, mode="edge"), kernel, mode="valid")
    showing = np.flatnonzero(weight > 0.1 * float(np.median(weight[weight >= np.median(weight)])))
    foremost = showing[np.argsort(smooth[showing])[: max(len(showing) // 3, 5)]]
    lead = float(np.average(smooth[foremost], weights=weight[foremost]))
    if len(foremost) >= 5:
        middle = float(foremost.mean())
        curve = np.polyfit(foremost - middle, smooth[foremost], 2, w=np.sqrt(weight[foremost]))
        vertex = -curve[1] / (2 * curve[0]) if curve[0] > 1e-6 else np.inf
        if foremost.min() <= vertex + middle <= foremost.max():
            lead = float(np.polyval(curve, vertex) - curve[0] * (0.8**2 + blur**2))
    return smooth - lead, lead


def _least_misfit(candidates: Floats, misfits: Floats) -> float:
    """Candidate of least misfit, refined by a parabola through its neighbours in the logarithm."""
    i = int(np.argmin(misfits))
    if i in (0, len(candidates) - 1):
        return float(candidates[i])
    x, y = np.log(candidates[i - 1 : i + 2]), misfits[i - 1 : i + 2]
    curve = np.polyfit(x - x[1], y, 2)
    return float(np.exp(x[1] + np.clip(-curve[1] / (2 * curve[0]), x[0] - x[1], x[2] - x[1])))


# ------------------------------------------------------------------------------
# Repair of edge fits that break the motion, and errors of the edge.
#
# The fit of every frame is compared with the motion; where it breaks it, the edge is searched again where the motion
# leads. Its error is that of what its bands of rows would move it by, each alone: this needs no model of noise, since
# film, tail, glints and a swinging door touch one band and not another. The roughness of the track tells which part of
# it differs from frame to frame; the rest is slow. Near the start a door or a mouth may hide the tip as well.


ASTRAY_PX = 3.0  # Standard error stated where nothing like the edge is found where the motion leads
# Amplitude, contrast relative to that of other frames, below which too little of the edge is visible (chosen)
LEAST_AMPLITUDE = 0.5


def repair_jumps(strip: Strip, state: EdgeState, fit: Floats, chosen: Bools, cost: NDArray[np.float32]) -> Floats:
    """Replace fits that break the motion or hardly fit by the best ones where the motion leads, unless the pixels
    between the two, by the `cost` of an edge at each column, tell that the fit is right: frames are missing then, or
    its neighbour is astray. Goes from the middle of the motion backwards and forwards. The edge never retreats.
    Shapes: fit (n_frames, 5); chosen (n_frames,); cost (n_frames, n_along) → (n_frames, 5).
    """
    moving = np.flatnonzero(moving_frames(state.edge) & np.isfinite(fit[:, 0]))
    if len(moving) < 5:
        return fit
    out = fit.copy()
    bad_misfit = 1.5 * float(np.nanmedian(fit[core_frames(state, fit), 2]))
    decentrality = np.abs(moving - 0.5 * (moving[0] + moving[-1])) / len(moving)
    anchor = int(moving[np.argmin(decentrality + (fit[moving, 2] > bad_misfit))])
    first, last = (int(frame) for frame in np.flatnonzero(chosen)[[0, -1]])
    # Near the start a door passes for background, and only the motion tells.
    edge, clear = out[:, 0].tolist(), fit[:, 0] >= clear_of_start(state.edge)
    for sense in (-1, 1):
        for t in range(anchor + sense, first - 1 if sense < 0 else last + 1, sense):
            previous, second, third = (edge[min(max(t - k * sense, 0), len(edge) - 1)] for k in (1, 2, 3))
            # The larger of two steps, since a frame may repeat the one before it.
            step = max(0.0 if math.isnan(gap) else abs(gap) for gap in (second - previous, third - second))
            reach = max(1.3 * step, step + 1.5)
            low, high = (previous - reach, previous + 0.8) if sense < 0 else (previous - 0.8, previous + reach)
            inside, like_an_edge = low <= edge[t] <= high, abs(out[t, 3]) < 1 - LEAST_AMPLITUDE
            fits = out[t, 2] <= bad_misfit and like_an_edge
            if not math.isfinite(previous) or (inside and fits):
                continue
            places = np.linspace(low, high, int(np.clip((high - low) / 2, 3, 9)))
            found = search_edges(strip, state, np.full(len(places), t), places)
            seen = np.isfinite(found[:, 2]) & (found[:, 3] > LEAST_AMPLITUDE - 1)
            found = found[seen & (found[:, 0] >= low - 0.5) & (found[:, 0] <= high + 0.5)]
            if len(found):
                replacement = found[np.argmin(found[:, 2])]
            else:
                expected = previous if math.isnan(edge[t]) else edge[t]
                replacement = np.array([min(max(expected, low), high), ASTRAY_PX, 4 * bad_misfit, 0, 0])
            if inside:
                replace_it = len(found) > 0 and replacement[2] < out[t, 2]
            else:
                own, there = np.clip(np.nan_to_num([edge[t], replacement[0]]), 0, cost.shape[1] - 1).astype(int)
                replace_it = not (fits and clear[t]) or cost[t, there] < cost[t, own]
            if replace_it:
                out[t] = replacement
                edge[t] = float(out[t, 0])
    return out


def dwell_error_px(edge: Floats, exposure_frames: float) -> Floats:
    """Standard error of an edge that stops or starts within an exposure or next to it. The model's blur is that of
    uniform motion at the mean of the speeds before and after. Where these differ by Δv, either may be the speed during
    the exposure of τ frames, and the length of the blur is uncertain by τΔv/2. Shapes: edge (n_frames,) → (n_frames,).
    """
    if exposure_frames <= 0:
        return np.zeros(len(edge))
    steps = np.abs(np.diff(np.pad(np.nan_to_num(edge), 2, mode="edge")))
    speed = np.maximum(steps[:-3], steps[3:])
    from_middle = (steps[1:-2] + steps[2:-1]) / np.maximum(speed, 1e-9) - 1
    within = np.maximum(exposure_frames / 2 - np.abs(from_middle), 0.0)
    behind = speed * within**2 / (2 * exposure_frames)
    # 0.25: part of the distance between both ends of an uncertain blur that counts as its standard error (derived)
    return np.asarray(np.hypot(behind, 0.25 * exposure_frames / 4 * np.abs(steps[2:-1] - steps[1:-2])))


# ------------------------------------------------------------------------------
# Detect what hides the tip at the start: a door that stands or swings in front of it, or the mouth of a launcher.
#
# A door leaves. While it hides the tip, the picture resembles neither film nor background, and the misfit shows it. A
# mouth stays: its border with the background looks like a tip at rest while the tip moves behind it. What the tip
# leaves behind tells the two apart: behind a tip that was seen at rest the film continues without a border; behind a
# tip that came out of a mouth, the mouth's straight border stays where the edge rested.

# Columns left out on either side of a border, for its blur, and columns averaged beyond them (chosen)
BORDER_GAP_PX, BORDER_SIDE_PX = 3, 6


def find_mouth(strip: Strip, state: EdgeState, edge: Floats) -> Bools:
    """Frames in which an edge rests at a launcher's mouth, a straight border that stays, the tip perhaps behind it."""
    fewest_rest_frames = 3  # Fewest frames of rest from which the resting place is known (chosen)
    film_range_px = (20, 150)  # Distances beyond the border between which the film's own steps are taken (chosen)
    search_px = 3  # Distance from the resting place within which a border is looked for (chosen)
    frames, first = np.arange(len(edge)), int(np.flatnonzero(moving_frames(state.edge))[0])
    none = frames < 0
    if first < fewest_rest_frames:
        return none
    rest_px = float(np.median(edge[:first]))
    near = np.arange(round(rest_px) - search_px, round(rest_px) + search_px + 1)
    # Not where the tip comes to rest: it is round.
    last_px = int(edge.max() - START_CLEARANCE_PX)
    later = np.arange(near[-1] + film_range_px[0], min(near[-1] + film_range_px[1], last_px))
    beside = BORDER_GAP_PX + BORDER_SIDE_PX
    if near[0] < beside or len(later) < film_range_px[0]:
        return none
    # 0.6: part of the strip's rows, about its middle, that belong to the tube whatever its sides do (chosen)
    edge_rows = round((1 - 0.6) / 2 * strip.values.shape[1])
    film = state.appearance[0, edge_rows : strip.values.shape[1] - edge_rows]
    # Step of brightness across each column, by row; the first column is `beside`.
    sides = np.lib.stride_tricks.sliding_window_view(film, BORDER_SIDE_PX, axis=1).mean(axis=2)
    borders = sides[:, beside + BORDER_GAP_PX :] - sides[:, : -beside - BORDER_GAP_PX]
    border_steps = borders[:, near - beside].T
    border = border_steps[int(np.argmax(np.abs(np.median(border_steps, axis=1))))]
    border_step = float(np.median(border))
    film_step = float(np.abs(np.median(borders[:, later - beside], axis=0)).max())
    contrast = np.abs((state.appearance[0] - state.appearance[1]).mean(axis=0))[later]
    straight = float(np.mean(np.sign(border) == np.sign(border_step)))
    # 2.0, 0.5: least ratio of the border to the largest step of film further on, and to its contrast (measured)
    least_step = max(2.0 * film_step, 0.5 * float(np.median(contrast)))
    # 0.95: part of the rows that must show the border with the same sign (measured)
    if straight < 0.95 or abs(border_step) < least_step:
        return none
    return frames < first + int(np.argmax(edge[first:] > rest_px + 3 * state.blur + 1))


def _near_start(edge: Floats) -> Bools:
    """Frames in which a door may still hide the tip."""
    return np.asarray(edge < clear_of_start(edge) + 0.5 * START_CLEARANCE_PX)


def hidden_errors(fit: Floats, misfit_ratio: Floats, edge: Floats) -> Floats:
    """Error of the edge in frames in which a door hides the tip, 0 in others. There the edge is a guess; where the
    picture differs entirely from the model, or hardly any contrast is left, there is no edge, and its error is
    infinite. Shapes: fit (n_frames, 5); misfit_ratio, edge (n_frames,) → (n_frames,).
    """
    misfit, amplitude = fit[:, 2], 1 + fit[:, 3]
    # 2.4, 1.6: misfit, over the usual one and in itself, above which a frame differs from those clear of the start
    # (chosen); 3.6: misfit in itself, above which an object stands in front of the tip (chosen)
    unusual = _near_start(edge) & (misfit_ratio > 2.4) & (misfit > 1.6)
    covered = unusual & ((misfit > 3.6) | (amplitude < LEAST_AMPLITUDE))
    guess = np.zeros(len(edge))
    if covered.sum() > 1:
        # A door leaves and does not come: in earlier frames the tip was hidden too.
        earlier = np.arange(len(edge)) < int(np.flatnonzero(covered)[-1])
        covered |= earlier & moving_frames(edge)
        guess[earlier] = ASTRAY_PX
    return np.where(covered, np.inf, guess)


# ------------------------------------------------------------------------------
# Path of the front through a strip: the monotone path that best divides pixels that look like film from pixels that
# look like background.
#
# The first path knows neither, and takes the last frames for film and the first for background. An object that stood in
# front at the start misleads it, and the frames averaged at either end make it start late and end early. A late start
# is better than an early one: neighbours then stand in for the background.


# Power of a column's change over that of its noise from which it counts as changed; length of a run of columns, px, of
# which six in ten must have changed for a front to have passed (chosen)
LEAST_CHANGE, RUN_PX = 30.0, 9


def initial_front_path(strip: Strip) -> tuple[EdgeState, tuple[int, int, int], NDArray[np.float32]]:
    """Find the initial path of the front, with film and background for a straight tip and a typical blur; and the first
    column of those that changed in runs, the one behind the last, and that in the last frame, which may be further on;
    and the change of every pixel from the first pictures to the last.
    """
    ends = slice(-END_FRAMES, None), slice(0, END_FRAMES)
    last, first = (median_of(strip.brightness(frames)) for frames in ends)
    changed, by_now = (_changed_columns(now - first, strip.noise) for now in (last, strip.brightness(ends[0])[-1]))
    # Vote of a pixel: near −1 if it looks as at the end, near 1 if as at the start
    # 4.0: change of a pixel, in units of the noise, at which it has half a vote (chosen)
    weight = 1 / (np.abs(last - first) + np.float32(4.0 * strip.noise))
    votes, squares = kernels.votes(strip.values, strip.scale, strip.offset, first, last, weight)
    path = dividing_path(votes)
    # Film stays. A payload that flies on, no longer than the tube is wide, leaves columns that changed and turned back.
    for end, begin in itertools.pairwise([*by_now.tolist(), len(first[0])]):
        if begin - end > RUN_PX and by_now[-1] - begin < len(first):
            left, after = slice(end + RUN_PX // 2, begin - RUN_PX // 2), np.flatnonzero(path > end - RUN_PX)
            change = squares[after, left].max(axis=0, initial=0.0) / len(first)
            if np.median(change) > LEAST_CHANGE * strip.noise**2:
                changed, by_now = changed[changed <= end], by_now[by_now <= end]
                break
    first_column, last_column = max(min(changed, default=0), column_after_leap(path)), max(changed, default=-1)
    if first_column > last_column:
        raise ValueError("what changes along the axis does so all at once: nothing grows")
    passed = int(first_column), int(last_column) + 1, int(max(last_column, by_now[-1])) + 1
    return straight_tip(strip, _with_run_up(np.clip(path, *passed[:2]))), passed, last - first


def _changed_columns(change: NDArray[np.float32], noise: float) -> Indices:
    """Columns that changed, in runs, by the power of the change of rows averaged in groups over that of their noise."""
    # 12, 4: number of groups into which the rows of a strip are divided, and maximum rows per group (chosen)
    group_size = int(np.clip(len(change) // 12, 1, 4))
    grouped = change[: len(change) // group_size * group_size].reshape(-1, group_size, change.shape[1])
    power = np.mean(grouped.mean(axis=1) ** 2, axis=0) / (noise**2 / group_size)
    run = np.convolve(power > LEAST_CHANGE, np.ones(RUN_PX) / RUN_PX, mode="same") > 0.6
    if run.sum() < RUN_PX:
        raise ValueError("nothing moves along the axis")
    return np.flatnonzero(run & (power > LEAST_CHANGE))


def straight_tip(strip: Strip, path: Floats) -> EdgeState:
    """Film and background along a path, for a straight tip and a typical blur. Shapes: path (n_frames,)."""
    blank = np.zeros((4, *strip.values.shape[1:]), np.float32)
    state = EdgeState(path, blur_lengths(path, ASSUMED_EXPOSURE), np.zeros(blank.shape[1]), 2.0, blank)
    return estimate_appearance(strip, state, 0.0)


def _with_run_up(path: Floats) -> Floats:
    """The path with its beginning replaced by steps that decrease going back in time, as from rest. An object such as a
    door may have stood where growth is first visible, and the tip may have come from further back. If it did not, the
    columns in between turn out to be film from the start, and the second path corrects this.
    """
    steps = np.diff(path)
    onset = int(np.argmax(steps > 0)) if np.any(steps > 0) else 0
    later = path[onset + 1 :]
    if onset < 2 or len(later) < 5:
        return path
    # 0.1, 0.2: minimum decrease from step to step of the run-up, going back in time (chosen)
    fall = max(float(np.median(np.diff(later[:5], 2))), 0.1 * float(later[1] - later[0]), 0.2)
    step = float(np.median(np.diff(later[:4])))
    for t in range(onset, -1, -1):
        step = max(step - fall, 0.0)
        path[t] = max(path[t + 1] - step, 0.0)
    return path


class EdgeTracker(Tracker):
    """Follows the leading edge of a tube through a strip centred on it; None where no tube grows along the axis."""

    def follow(self, look: Look) -> Positions | None:
        """See `Tracker`."""
        if (outlined := tube_strip(look.luma, look.axis, look.small)) is None:
            return None
        strip, tube = outlined
        rounds = 4  # Fewest rounds of the alternation (chosen)
        state, path, passed, exposure_frames = tube.state, tube.state.edge, tube.passed, look.exposure_frames
        exposure = float(exposure_frames) if np.isfinite(exposure_frames) else ASSUMED_EXPOSURE
        for iteration in range(3):
            before, (path, cost) = path, _path_by_appearance(strip, state.appearance, passed)
            # Backwards in time the end is a start too: a path that leaps there goes over to what comes before the tip.
            path = np.minimum(path, -column_after_leap(-path[::-1]) or np.inf)
            # 1.0: two paths are the same if they nowhere differ by more than this (derived)
            if iteration > 0 and np.abs(before - path).max() <= 1.0:
                break
            state = estimate_appearance(strip, replace(state, edge=path, lengths=blur_lengths(path, exposure)), 0.0)
        fit = fit_edges(strip, state, informative_frames(state.edge), EARLY_FIT_ROUNDS)
        for iteration in range(3 * rounds):
            before = fit[:, 0]
            # Take over the fitted edges, and hold them at rest; blur lengths, film and background follow from them.
            fitted = np.flatnonzero(informative_frames(state.edge))
            edge = np.where(np.isfinite(before), before, state.edge)
            edge = np.minimum(edge[np.clip(np.arange(len(edge)), fitted[0], fitted[-1])], passed[2] + 2)
            state = replace(state, edge=edge, lengths=blur_lengths(edge, exposure))
            state = estimate_appearance(strip, state, 4 * strip.noise + 4)
            informative = informative_frames(state.edge)
            if iteration == 1 and not np.isfinite(exposure_frames):
                exposure = np.nan_to_num(seen_exposure(strip, state, fit, exposure_frames)[0], nan=ASSUMED_EXPOSURE)
            state = find_shape(strip, state, fit)
            if iteration > 0:
                state = find_shading(strip, state, fit)
            steps = FIT_ROUNDS if iteration >= rounds - 1 else EARLY_FIT_ROUNDS
            fit = repair_jumps(strip, state, fit_edges(strip, state, informative, steps), informative, cost)
            change_px = np.abs(fit[:, 0] - before)[moving_frames(state.edge)]
            # 0.2: the iteration has converged once no edge of a moving frame changes by more than this (chosen)
            if iteration >= rounds - 1 and np.nanmax(change_px) < 0.2:
                break
        fit = np.where(informative[:, None], fit, fit_edges(strip, state, ~informative))
        finished = _with_errors(strip, state, fit, exposure, tube)
        if not np.isfinite(exposure_frames):
            return finished
        blur_exposure, speed = seen_exposure(strip, state, fit, exposure)
        return replace(finished, seen_exposure_frames=blur_exposure, fast_px_per_frame=speed)


@dataclass(frozen=True)
class Outline:
    """Outline of the tube that the front leaves, px: its width, and its middles across the strip at places along it."""

    half_px: float
    state: EdgeState
    passed: tuple[int, int, int]
    places_px: Floats
    middles_px: Floats
    width_px: float
    width_sigma_px: float


def outline(strip: Strip, parts: int) -> Outline:
    """Measure the centreline and width of the tube that the front leaves, by the contrast of each row between film and
    background in `parts` stretches along the axis: a given axis that is two degrees off cuts the tube obliquely.
    """
    state, passed, change = initial_front_path(strip)
    film, background = state.appearance[:2, :, passed[0] : passed[1]]
    side, place, contrast = _sides(film - background, parts)
    width = side[:, 1] - side[:, 0]
    median_width = float(np.median(width))
    typical = np.abs(width - median_width) <= 0.15 * median_width + 2
    typical |= ~typical.any()  # two widths, equally frequent: neither is typical, so all are used
    outline_of_front = median_width / 2 + 1.5, state, passed, passed[0] + place[typical], side[typical].mean(axis=1)
    # Just behind a slow front there is but a rounded tip; what the front has left a width behind is a whole tube.
    whole = change[:, passed[0] : max(passed[1] - round(median_width), passed[0])]
    ends = _sides(whole, parts)[0] if whole.shape[1] >= 2 * RUN_PX else side
    width = max((each[:, 1] - each[:, 0] for each in (side, ends)), key=np.median)
    median_width = float(np.median(width))
    width_error = 1.4826 * float(np.median(np.abs(width - median_width))) / np.sqrt(len(width))
    # 25.0, 0.15: contrast, in grey levels, below which the sides of a tube fade into the background (measured)
    faint = 0.15 * median_width if contrast < 25.0 else 0.0
    # 1.0: error of a width between two sides that are each located to within a blur of about 0.7 px (derived)
    return Outline(*outline_of_front, median_width, float(np.linalg.norm([width_error, 1.0, faint])))


def _sides(change: NDArray[Any], parts: int) -> tuple[Floats, Floats, float]:
    """Both sides of a tube from the middle of a strip, px, and places, of stretches along it, by the change that the
    tube makes; and its typical contrast. Shapes: change (n_rows, n_columns) → (n_stretches, 2), (n_stretches,).
    """
    power, sides, places, contrasts = change.astype(float) ** 2, [], [], []
    for piece in np.array_split(np.arange(power.shape[1]), min(parts, max(1, power.shape[1] // 12))):
        profile = np.sqrt(np.minimum(power[:, piece], 9 * np.median(power[:, piece]) + 1e3).mean(axis=1))
        contrasts.append(float(np.quantile(profile, 0.75)))
        sides.append(_max_sum_run(profile - max(0.4 * contrasts[-1], 0.25 * float(profile.max()))))
        places.append(float(piece.mean()))
    return np.array(sides) - (len(power) - 1) / 2, np.array(places), float(np.median(contrasts))


def _max_sum_run(excess: Floats) -> tuple[float, float]:
    """Ends of the run with the greatest sum, to a fraction of a row: no short gap ends it, and no glint extends it."""
    total = np.concatenate([[0.0], np.cumsum(excess)])
    last = int(np.argmax(total[1:] - np.minimum.accumulate(total[:-1])))
    first = int(np.argmin(total[: last + 1]))
    return _zero_crossing(excess, first, -1), _zero_crossing(excess, last, 1)


def _zero_crossing(excess: Floats, row: int, outwards: int) -> float:
    """Return where the line from `row` to its outer neighbour crosses zero; `row` itself at the border."""
    if not 0 <= row + outwards < len(excess) or excess[row] <= 0:
        return float(row)
    return float(row + outwards * excess[row] / (excess[row] - min(excess[row + outwards], 0.0)))


# ------------------------------------------------------------------------------
# Cut the strip about a tube, centred on what its front left behind; decide whether a tube lies along the axis.


def tube_strip(luma: NDArray[Any], axis: Axis, small: SmallPictures) -> tuple[Strip, Outline] | None:
    """Cut the strip about the tube that grows along an axis, centred on the tube, whose outline in it is returned too:
    None where no single front passes along the axis, or along the middle of what it leaves, which is then no tube.
    """
    if front_share(small, axis) < LEAST_FRONT_SHARE:
        return None
    strip = cut_strip(luma, axis, 0.65 * axis.width_px + 3, nearest=True)
    # 30.0: length of the stretches in which the tube's middle is found along a curve (chosen)
    parts = max(12, round(axis.length_px / 30.0)) if axis.bends else 12
    tube = outline(strip, parts)
    try:
        moved, distance_px = axis_of_tube(strip.axis, tube)
        # 3: most times that the strip is cut anew: what lay outside the first shows only in the second (chosen)
        for _ in range(3):
            # 1.0, 2.0: distances from the tube's middle, and to its sides, from which its outline is right (chosen)
            if distance_px < 1.0 and tube.half_px + 2.0 < strip.values.shape[1] / 2:
                break
            strip = cut_strip(luma, moved, tube.half_px * 1.15 + 5, strip, nearest=True)
            tube = outline(strip, parts)
            moved, distance_px = axis_of_tube(strip.axis, tube)
        if front_share(small, moved) < LEAST_FRONT_SHARE:
            return None
        final = snap_to_grid(replace(moved, width_px=tube.width_px))
        strip = cut_strip(luma, final, tube.half_px * 1.15 + 5, strip)
    except (RecordingError, ValueError):
        return None
    return strip, replace(tube, state=straight_tip(strip, tube.state.edge))


def axis_of_tube(axis: Axis, tube: Outline) -> tuple[Axis, float]:
    """Move an axis across onto the middle of a tube, with the tube's width, and measure how far that is. It stays as it
    is where the tube's middle is no path that a strip can be cut along.
    """
    place, middle = tube.places_px, tube.middles_px
    if axis.bends:
        # 40.0: distance of the knots of a curve that is moved onto the middle of a tube (chosen)
        knots = np.linspace(0.0, axis.length_px, max(4, round(axis.length_px / 40.0) + 1))
        offsets = np.interp(knots, place, middle)
    else:  # a line by the median of pairwise slopes (Theil-Sen)
        i, j = np.triu_indices(len(place), 1)
        slope = float(np.median((middle[j] - middle[i]) / (place[j] - place[i]))) if len(i) else 0.0
        knots = np.array([0.0, axis.length_px])
        offsets = float(np.median(middle - slope * place)) + slope * knots
    through = axis.points(knots, offsets)
    separate = np.hypot(*np.diff(through, axis=0).T) > SMALLEST_POINT_SPACING_PX
    try:
        moved = axis_through(through[np.append(True, separate)], 2 * tube.half_px)
    except RecordingError:
        return axis, 0.0
    if moved.bends is not axis.bends or tube.half_px > moved.largest_half_px:
        return axis, 0.0
    return moved, float(np.abs(offsets).max())


def _path_by_appearance(
    strip: Strip, appearance: NDArray[np.float32], passed: tuple[int, int, int]
) -> tuple[Floats, NDArray[np.float32]]:
    """Find the monotone path that best divides film from background between the columns that it passes, and the cost
    of an edge by frame and column. Distances from either are clipped: no door, payload or reflection captures it.
    """
    contrast = np.abs(appearance[0] - appearance[1])[:, passed[0] : passed[1]]
    width = 0.1 * float(np.quantile(contrast, 0.7)) + strip.noise
    evidence = kernels.film_evidence(strip.values, strip.scale, strip.offset, appearance, width)
    # 25, 2: columns behind the first passed one, and ahead of the last, up to which it may lie (chosen)
    path = np.clip(dividing_path(evidence[:, : passed[1] + 3]) - 0.5, passed[0] - 25, passed[1] + 2)
    return path, np.cumsum(evidence + kernels.FILM_BIAS * strip.values.shape[1], axis=1)


BANDS_ERROR = 0.9  # Error of an edge over that which the scatter of its bands gives (measured on two renderers)


def _hidden_px(contrast: NDArray[np.float32], edge: Floats, tube: Outline) -> Floats:
    """Standard error of an edge behind a post: it may lie anywhere among neighbouring columns that look the same before
    and behind it. Shapes: contrast (n_along,), of every column; edge (n_frames,) → (n_frames,).
    """
    # 0.15: part of the usual contrast above which a column tells on which side the edge is: half or twice it the same
    first, behind, _ = tube.passed
    telling = contrast > 0.15 * np.median(contrast[first:behind])
    telling[:first] = telling[behind:] = True
    places, near = np.flatnonzero(telling), BORDER_GAP_PX
    before = places[np.maximum(np.searchsorted(places, edge - near, side="right") - 1, 0)]
    after = places[np.minimum(np.searchsorted(places, edge + near), len(places) - 1)]
    return np.maximum(after - before - 2 * near - 2, 0) / math.sqrt(12)


def _elsewhere_px(strip: Strip, state: EdgeState, fit: Floats, edge: Floats, passed: tuple[int, int, int]) -> Floats:
    """How far away the pixels of a frame put its edge, where a whole column of them says so; 0 in other frames. A path
    that never retreats is wrong there: it runs along no tube, or the tube draws back. Within reach of the tip, which
    looks unlike film and background, the edge must fit no worse there too. Not behind the first column passed, whose
    background nobody saw. Shapes: fit (n_frames, 5); edge (n_frames,) → (n_frames,).
    """
    from scipy.ndimage import minimum_filter1d

    cost, frames = _path_by_appearance(strip, state.appearance, passed)[1], np.arange(len(edge))
    best, at = passed[0] + cost[:, passed[0] :].argmin(axis=1), np.clip(np.rint(edge).astype(int), 0, cost.shape[1] - 1)
    # 9: columns about the edge, of which the best is taken, px (chosen)
    gain = minimum_filter1d(cost, 9, axis=1)[frames, at] - cost[frames, best]
    away = np.flatnonzero(gain > kernels.CLIP**2 * len(state.lag))
    found, distance = search_edges(strip, state, away, best[away] - 0.5), np.zeros(len(edge))
    beyond_tip = np.abs(best - edge)[away] > SHADING_REACH_PX + state.lag.max()
    distance[away] = np.where(beyond_tip | (found[:, 2] <= fit[away, 2]), np.abs(best - edge)[away], 0.0)
    return np.maximum(distance, edge - passed[2] - 2)


def _with_errors(strip: Strip, state: EdgeState, fit: Floats, exposure: float, tube: Outline) -> Positions:
    """Add to a converged fit the errors of its bands and of hidden tips, and refer the edge to mid-exposure."""
    from scipy.ndimage import median_filter

    usual = max(float(np.nanmedian(fit[core_frames(state, fit), 2])), 1e-3)
    edge_now = np.where(np.isfinite(fit[:, 0]), fit[:, 0], state.edge)
    # The fitted box assumes constant speed: its centre is the mean position, which leads mid-exposure by aτ²/24.
    acceleration = np.gradient(np.gradient(fit[:, 0]))
    edge = fit[:, 0] - np.clip(acceleration, -50, 50) * exposure**2 / 24
    # 5: frames of whose errors the median is taken, so that few bands do not agree by chance (chosen)
    scatter = np.nan_to_num(fit[:, 1], nan=ASTRAY_PX)
    scatter = np.minimum(BANDS_ERROR * np.maximum(scatter, median_filter(scatter, 5, mode="nearest")), ASTRAY_PX)
    sigma = calibrated_sigma(edge, scatter)
    unseen = np.sqrt(np.maximum(scatter**2 - sigma**2, 0.0))
    # 1.0, 21, 1.0: error of the pictures of film and background that all rows share, in grey levels of 255 (measured);
    # columns over which the contrast is taken, px, and its least, grey levels (chosen)
    difference = state.appearance[0] - state.appearance[1]
    contrast = np.abs(median_filter(difference.mean(axis=0), 21, mode="nearest"))
    column = np.clip(np.rint(edge_now), tube.passed[0], tube.passed[1] - 1).astype(int)
    shared = 1.0 / np.maximum(contrast[column], 1.0)
    in_mouth, ratio = find_mouth(strip, state, edge_now), fit[:, 2] / usual
    guess = np.where(in_mouth, np.inf, hidden_errors(fit, ratio, edge_now))
    hidden = _hidden_px(np.abs(difference).mean(axis=0), edge_now, tube)
    elsewhere = _elsewhere_px(strip, state, fit, edge_now, tube.passed)
    slow = np.sqrt(unseen**2 + shared**2 + guess**2 + hidden**2 + elsewhere**2)
    # 1.3: misfit over the usual one above which a frame near the start is doubtful; 1.5: amplitude (relative contrast)
    # above which any is, since something adds to the edge (chosen)
    odd = (_near_start(edge_now) & (ratio > 1.3)) | (fit[:, 3] < LEAST_AMPLITUDE - 1) | (fit[:, 3] > 1.5 - 1)
    # 1.0: standard error above which a point is doubtful, px (chosen)
    uncertain = np.hypot(sigma, slow) > 1.0
    return Positions(
        strip=strip, edge_px=edge, sigma_px=np.hypot(sigma, dwell_error_px(edge_now, exposure)),
        unsure=np.asarray(odd | uncertain), reach_px=3 * state.blur + 1, slow_px=slow, exposure_frames=exposure,
        width_px=tube.width_px, width_sigma_px=tube.width_sigma_px,
    )  # fmt: skip
