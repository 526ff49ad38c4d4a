"""Estimate the tip's shape and shading, the optical blur and the exposure from the residuals of the edge fit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from vinetrack.core.records import Floats
from vinetrack.video.edge_cover import coverage_reach
from vinetrack.video.edge_state import (
    EARLY_FIT_ROUNDS,
    MARGIN_PX,
    SHADING_REACH_PX,
    EdgeState,
    blur_lengths,
    core_frames,
    fit_edges,
    misfit,
    place_sums,
    row_sums,
)
from vinetrack.video.strip import Strip

SHADING_KERNEL = (0.25, 0.5, 0.25)  # Smoothing kernel of the tip's shading (chosen)
BLURS_PX = np.array([0.5, 0.7, 0.9, 1.2, 1.6, 2.1, 2.8])
NEAR_BLURS = np.array([0.7, 0.85, 1, 1.2, 1.4])  # Blurs that are tried near the last estimate, as a part of it (chosen)
EXPOSURES = np.array([0.02, 0.05, 0.1, 0.15, 0.2, 0.3, 0.4, 0.5, 0.65, 0.8, 1.0])
ASSUMED_EXPOSURE = 0.25  # Exposure over frame period until it is estimated (chosen)
FEWEST_FAST_FRAMES = 6  # Fewest frames from which a blur is told from the shape of the tip (chosen)
# Ratio of the misfit with the stated exposure to the least of any exposure, above which the stated one is contradicted
# (measured)
CONTRADICTION_RATIO = 1.01
LARGEST_LAG_STEP_PX = 4.0  # Largest change of a row's lag in one round (chosen)

DEEPEST_LAG_PX = 60.0  # Largest lag of a row behind the foremost point (chosen)

BLUR_FRAMES = 16  # Frames from which the blur is estimated (chosen)

OPTICAL_BLUR_PX = (0.4, 3.0)  # Bounds of the optical blur, from a sharp pixel to a picture out of focus (chosen)


def find_shape(strip: Strip, state: EdgeState, fit: Floats, everywhere: bool) -> EdgeState:
    """Estimate by how much each row of the tip lags behind its foremost point, then the optical blur. Both come from
    the core frames with less motion blur; frames in which a door may still stand in front of the tip are not among
    them. Shapes: fit (n_frames, 6).
    """
    core = core_frames(state, fit)
    slow = core & (state.lengths <= max(2.0, float(np.quantile(state.lengths[core], 0.5))))
    for _ in range(3):
        by_row = row_sums(strip, state, fit, slow)
        step = by_row[:, 0] / (by_row[:, 1] + 0.02 * float(by_row[:, 1].max()) + 1e-9)
        step = np.clip(step, -LARGEST_LAG_STEP_PX, LARGEST_LAG_STEP_PX)
        lag, lead = _smooth_lag(state.lag + step, by_row[:, 1])
        state = replace(state, lag=lag, edge=state.edge - lead)
    sampled = np.flatnonzero(slow)[:: max(1, int(slow.sum()) // BLUR_FRAMES)]
    candidates = BLURS_PX if everywhere else state.blur * NEAR_BLURS
    # Over the same pixels for all blurs: pixels far from the edge, which always fit, would favour the widest.
    widest = MARGIN_PX + coverage_reach(0.0, float(candidates.max()))

    def misfit_of(blur: float) -> float:
        return _misfit_refitted(strip, replace(state, blur=blur), sampled, widest - coverage_reach(0.0, blur))

    if everywhere:
        misfits = [misfit_of(float(blur)) for blur in candidates]
    else:
        # The outer two are tried only where the least lies at the border of the inner three.
        misfits = [np.inf, *(misfit_of(float(blur)) for blur in candidates[1:-1]), np.inf]
        least = int(np.argmin(misfits))
        if least in (1, len(candidates) - 2):
            outer = 0 if least == 1 else len(candidates) - 1
            misfits[outer] = misfit_of(float(candidates[outer]))
        tried = np.isfinite(misfits)
        candidates, misfits = candidates[tried], [value for value in misfits if np.isfinite(value)]
    return replace(state, blur=float(np.clip(_least_misfit(candidates, np.array(misfits)), *OPTICAL_BLUR_PX)))


def find_shading(strip: Strip, state: EdgeState, fit: Floats) -> EdgeState:
    """Estimate what the tip shows beyond film and background, by distance ahead of the edge. A round tip is lit
    differently from the tube behind it: its rim may be as bright as the background where the film is darker, and the
    edge would be fitted behind the rim. Shapes: fit (n_frames, 6).
    """
    core = core_frames(state, fit)
    for _ in range(2):
        by_place = place_sums(strip, state, fit, core)
        middle = len(by_place) // 2
        residual, weight = by_place[middle - SHADING_REACH_PX : middle + SHADING_REACH_PX + 1].T
        step = residual / np.maximum(weight, 1e-3 * float(weight.max()) + 1e-12)
        state = replace(state, shading=np.convolve(state.shading + step, SHADING_KERNEL, mode="same"))
    return state


def _misfit_refitted(strip: Strip, state: EdgeState, frames: NDArray[np.int_], margin_px: float) -> float:
    """Misfit of some frames after a new fit of their edges: a blur must not be judged by edges fitted with another."""
    edge = np.full(len(state.edge), np.nan)
    edge[frames] = state.edge[frames]
    fit = fit_edges(strip, replace(state, edge=edge), EARLY_FIT_ROUNDS)
    use = np.isfinite(fit[:, 0])
    edge[use] = fit[use, 0]
    return misfit(strip, replace(state, edge=edge), fit, use, margin_px)


def find_exposure(strip: Strip, state: EdgeState, fit: Floats) -> float:
    """Exposure, in frame periods, that explains the blur of the faster frames best. It is ASSUMED_EXPOSURE where no
    frame moves 2 px. Shapes: fit (n_frames, 6).
    """
    speed, fast = _fast_frames(state, fit)
    if not fast.any():
        return ASSUMED_EXPOSURE
    return _least_misfit(EXPOSURES, _misfits_of_exposures(strip, state, fit, speed, fast, EXPOSURES))


def seen_exposure(strip: Strip, state: EdgeState, fit: Floats, stated_frames: float) -> tuple[float, float]:
    """Find the exposure that the blur shows where it contradicts the stated one. Returns exposure over frame period,
    NaN where the stated one explains the blur as well (CONTRADICTION_RATIO); and the median: speed of the frames used,
    px a frame. Shapes: fit (n_frames, 6).
    """
    speed, fast = _fast_frames(state, fit)
    if fast.sum() < FEWEST_FAST_FRAMES:
        return np.nan, np.nan
    misfits = _misfits_of_exposures(strip, state, fit, speed, fast, np.append(EXPOSURES, stated_frames))
    contradicted = misfits[-1] > CONTRADICTION_RATIO * misfits.min()
    seen = _least_misfit(EXPOSURES, misfits[:-1]) if contradicted else np.nan
    return seen, float(np.median(speed[fast]))


def _fast_frames(state: EdgeState, fit: Floats) -> tuple[Floats, NDArray[np.bool_]]:
    """Speed in every frame, px a frame, and the faster half of the core frames among those that move 2 px."""
    core = core_frames(state, fit)
    speed = blur_lengths(state.edge, 1.0)
    return speed, core & (speed >= np.quantile(speed[core], 0.5)) & (speed > 2)


def _misfits_of_exposures(
    strip: Strip, state: EdgeState, fit: Floats, speed: Floats, frames: NDArray[np.bool_], exposures: Floats
) -> Floats:
    """Misfit of some frames with each exposure, shape (n_exposures,). The tip's shading is left out: at constant speed
    it looks like any error of the exposure.
    """
    bare = replace(state, shading=np.zeros_like(state.shading))
    return np.array([misfit(strip, replace(bare, lengths=speed * tau), fit, frames) for tau in exposures])


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
    return np.clip(smooth - lead, -3.0, DEEPEST_LAG_PX), lead


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
