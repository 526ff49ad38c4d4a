"""State of the edge tracker and the steps of its alternation: estimate film and background, then fit the edge."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from vinetrack.core.records import Bools, Floats, Indices
from vinetrack.video import edge_kernels as kernels
from vinetrack.video.edge_kernels import coverage_reach
from vinetrack.video.strip import Strip

# Frames before and after the passage of the edge over which the weight of a pixel's values falls to 1/e (chosen)
MEMORY_FRAMES = 6.0
# Standard deviation, grey levels, of a pixel about the mean of its neighbours, used where the pixel was never visible
TEXTURE_SD = 12.0
# Maximum number of Gauss-Newton steps, in final fits and in fits that others follow (measured)
FIT_ROUNDS, EARLY_FIT_ROUNDS = 12, 6
MARGIN_PX = 6.0  # Pixels used beyond the blurred edge on either side: they determine amplitude and level (chosen)
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
    """Return the length of the motion blur in every frame: smoothed speed times exposure. Shapes: edge (n_frames,) →
    (n_frames,).
    """
    if len(edge) < 3:
        return np.zeros(len(edge))
    speed = np.gradient(edge)
    smooth = np.convolve(np.pad(speed, 1, mode="edge"), [0.25, 0.5, 0.25], mode="valid")
    return np.clip(smooth, 0, None) * exposure_frames


def moving_frames(edge: Floats) -> Bools:
    """Return the frames in which the edge moves; all frames if fewer than five do. Shapes: edge (n_frames,) →
    (n_frames,).
    """
    speed = np.abs(np.gradient(edge)) if len(edge) > 1 else np.zeros(len(edge))
    moving = speed > max(0.2, 0.1 * float(np.quantile(speed, 0.95)))
    return moving if moving.sum() >= 5 else np.ones(len(edge), dtype=bool)


def informative_frames(edge: Floats) -> Bools:
    """Return the frames that determine film, background and tip shape. They are the frames in motion, and MEMORY_CUTOFF
    memories before and after. Shapes: edge (n_frames,) → (n_frames,).
    """
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
    late = np.clip(np.interp(behind, monotone, frames), begin, end)
    # 2.06: distance from the edge, in optical blurs, from which a pixel is pure film or background (derived)
    reach = 0.5 * state.lengths + 2.06 * state.blur
    sums = kernels.gather(
        strip.values, strip.scale, strip.offset, state.edge, reach, state.lag, early, late, MEMORY_FRAMES,
        state.appearance, clip, state.shading,
    )  # fmt: skip
    half = len(strip.values) // 2
    middle = float(np.median(strip.values[half])) * float(strip.scale[half]) + float(strip.offset[half])
    appearance = kernels.solve(sums, ridge_weight, neighbour_decay, middle, strip.noise, TEXTURE_SD)
    # Columns near the start whose background looks like their film were film all along. If the initial edge is placed
    # too far back, film serves as its own background; without contrast nothing corrects it.
    contrast = np.sqrt(np.mean((appearance[0] - appearance[1]) ** 2, axis=0))
    columns, clear = np.arange(len(contrast)), clear_of_start(state.edge)
    near = (columns > state.edge[0] - 5) & (columns < clear)
    later = (columns >= clear) & (columns < state.edge.max() - 5)
    # 0.4: part of the typical contrast below which film and background are the same material (chosen)
    film_all_along = near & (contrast < 0.4 * float(np.median(contrast[later]))) if later.sum() >= 10 else near & False
    if film_all_along.any():
        sums[1, :, :, film_all_along] = 0.0
        appearance = kernels.solve(sums, ridge_weight, neighbour_decay, middle, strip.noise, TEXTURE_SD)
    return replace(state, appearance=appearance)


def clear_of_start(edge: Floats) -> float:
    """Return the column beyond which nothing that held the tip at its start is near. It lies START_CLEARANCE_PX, or a
    fifth of the growth if that is less, beyond the start. Shapes: edge (n_frames,).
    """
    return float(edge[0] + min(START_CLEARANCE_PX, 0.2 * (edge.max() - edge[0])))


def core_frames(state: EdgeState, fit: Floats) -> Bools:
    """Select the frames that determine the shape of the tip. They are in motion, clear of the start, and fit no worse
    than most. Shapes: fit (n_frames, 6) → (n_frames,).
    """
    moving = moving_frames(state.edge)
    clear = moving & (state.edge > clear_of_start(state.edge))
    if not np.isfinite(fit[clear if clear.sum() >= 5 else moving, 2]).any():
        raise ValueError("something moves along the axis, but nothing like an edge is seen in any frame")
    if clear.sum() < 5:
        return moving
    good = clear & (fit[:, 2] <= 1.3 * np.nanmedian(fit[clear, 2]))
    return good if good.sum() >= 5 else clear


def fit_edges(strip: Strip, state: EdgeState, chosen: Bools | bool = True, rounds: int = FIT_ROUNDS) -> Floats:
    """Fit the edge of the chosen frames by maximum likelihood; see `edge_kernels.fit_edges`. Shape (n_frames, 6), NaN
    in the other frames.
    """
    frames = np.flatnonzero(np.isfinite(state.edge) & chosen)
    out = np.full((len(state.edge), 6), np.nan)
    out[frames] = search_edges(strip, state, frames, state.edge[frames], rounds)
    return out


def search_edges(strip: Strip, state: EdgeState, frames: Indices, starts: Floats, rounds: int = FIT_ROUNDS) -> Floats:
    """Fit the edge from each of several starts, in any frames; see `edge_kernels.fit_edges`. Shapes: frames, starts
    (n_searches,).
    """
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
    would not lower its own; see `edge_kernels.residual_sums`. Shapes: fit (n_frames, 6); use (n_frames,).
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
OPTICAL_BLUR_PX = (0.4, 3.0)  # Bounds of the optical blur, from a sharp pixel to a picture out of focus (chosen)


def find_shape(strip: Strip, state: EdgeState, fit: Floats) -> EdgeState:
    """Estimate by how much each row of the tip lags behind its foremost point, then the optical blur. Both come from
    the core frames with less motion blur; frames in which a door may still stand in front of the tip are not among
    them. Shapes: fit (n_frames, 6).
    """
    largest_lag_step_px = 4.0  # Largest change of a row's lag in one round (chosen)
    core = core_frames(state, fit)
    slow = core & (state.lengths <= max(2.0, float(np.quantile(state.lengths[core], 0.5))))
    for _ in range(3):
        (slope_of_row, known), *_ = residual_sums(strip, state, fit, slow)
        step = slope_of_row / (known + 0.02 * float(known.max()) + 1e-9)
        step = np.clip(step, -largest_lag_step_px, largest_lag_step_px)
        lag, lead = _smooth_lag(state.lag + step, known)
        state = replace(state, lag=lag, edge=state.edge - lead)
    # 16: frames from which the blur is estimated (chosen)
    sampled = np.flatnonzero(slow)[:: max(1, int(slow.sum()) // 16)]
    candidates = np.array([0.5, 0.7, 0.9, 1.2, 1.6, 2.1, 2.8])  # Blurs that are tried, px (chosen)
    # Over the same pixels for all blurs: pixels far from the edge, which always fit, would favour the widest.
    widest = MARGIN_PX + coverage_reach(0.0, float(candidates.max()))
    misfits = np.full(len(candidates), np.inf)
    least = int(np.argmin(np.abs(candidates - state.blur)))
    while not np.isfinite(misfits[max(least - 1, 0) : least + 2]).all():  # down to the least, from the blur until now
        for k in range(max(least - 1, 0), min(least + 2, len(candidates))):
            # Each with a new fit: a blur must not be judged by edges fitted with another.
            blurred = replace(state, blur=float(candidates[k]))
            fit = fit_edges(strip, blurred, np.isin(np.arange(len(state.edge)), sampled), EARLY_FIT_ROUNDS)
            use = np.isfinite(fit[:, 0])
            blurred = replace(blurred, edge=np.where(use, fit[:, 0], state.edge))
            misfits[k] = residual_sums(strip, blurred, fit, use, widest - coverage_reach(0.0, blurred.blur))[2]
        least = int(np.argmin(misfits))
    return replace(state, blur=float(np.clip(_least_misfit(candidates, misfits), *OPTICAL_BLUR_PX)))


def find_shading(strip: Strip, state: EdgeState, fit: Floats) -> EdgeState:
    """Estimate what the tip shows beyond film and background, by distance ahead of the edge. A round tip is lit
    differently from the tube behind it: its rim may be as bright as the background where the film is darker, and the
    edge would be fitted behind the rim. Shapes: fit (n_frames, 6).
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


def _smooth_lag(lag: Floats, weight: Floats) -> tuple[Floats, float]:
    """Smooth the lag slightly along the rows, by weight, and subtract that of the foremost point; both are returned.
    The foremost point is the vertex of a parabola through the foremost third of the rows that show an edge: the
    smallest lag would follow their noise.
    """
    kernel = np.exp(-0.5 * (np.arange(-3, 4) / 0.8) ** 2)
    weight = weight + 1e-6 * float(weight.max() + 1e-12)
    top = np.convolve(np.pad(lag * weight, 3, mode="edge"), kernel, mode="valid")
    smooth = top / np.convolve(np.pad(weight, 3, mode="edge"), kernel, mode="valid")
    showing = np.flatnonzero(weight > 0.1 * float(np.median(weight[weight >= np.median(weight)])))
    foremost = showing[np.argsort(smooth[showing])[: max(len(showing) // 3, 3)]]
    lead = float(np.average(smooth[foremost], weights=weight[foremost]))
    if len(foremost) >= 6:
        middle = float(foremost.mean())
        curve = np.polyfit(foremost - middle, smooth[foremost], 2, w=np.sqrt(weight[foremost]))
        vertex = -curve[1] / (2 * curve[0]) if curve[0] > 1e-6 else np.inf
        if foremost.min() <= vertex + middle <= foremost.max():
            lead = float(np.polyval(curve, vertex))
    # 60.0: largest lag of a row behind the foremost point (chosen)
    return np.clip(smooth - lead, -3.0, 60.0), lead


def _least_misfit(candidates: Floats, misfits: Floats) -> float:
    """Candidate of least misfit, refined by a parabola through its neighbours in the logarithm."""
    i = int(np.argmin(misfits))
    if i in (0, len(candidates) - 1):
        return float(candidates[i])
    x, y = np.log(candidates[i - 1 : i + 2]), misfits[i - 1 : i + 2]
    curve = np.polyfit(x - x[1], y, 2)
    if curve[0] <= 0:
        return float(candidates[i])
    return float(np.exp(x[1] + np.clip(-curve[1] / (2 * curve[0]), x[0] - x[1], x[2] - x[1])))
