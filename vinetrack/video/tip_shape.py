"""Shape of the tip, its light and shade, optical blur and exposure, from what an edge leaves unexplained."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from vinetrack.core.records import Floats
from vinetrack.video.edge_cover import cover_reach
from vinetrack.video.edge_state import (
    MARGIN_PX,
    SHADED_PX,
    EdgeState,
    blur_lengths,
    core_frames,
    fit_edges,
    residuals,
)
from vinetrack.video.strip import Strip

SMOOTHING = (0.25, 0.5, 0.25)
"""Weights by which neighbours share in the shading of the tip. Chosen: a pixel wide, no sharper than optics are. By
reasoning: without it noise of single pixels is taken for shading; over twice the width a narrow rim is blurred."""
BLURS_PX = np.array([0.5, 0.7, 0.9, 1.2, 1.6, 2.1, 2.8])
EXPOSURES = np.array([0.02, 0.05, 0.1, 0.15, 0.2, 0.3, 0.4, 0.5, 0.65, 0.8, 1.0])
ASSUMED_EXPOSURE = 0.25
"""Exposure over frame period until it is estimated. Chosen as usual for high-speed cameras; it is replaced after the
second round."""
FEWEST_FAST = 6
"""Chosen: frames from which a blur is told from the shape of the tip; a clip of eight frames, five of them in motion
and without any blur, showed one of 0.4 frames. The fastest trials of the demonstration have seven."""
CONTRADICTED = 1.01
"""Measured (seeds 20900 and up): the true exposure leaves a misfit within 1.003 of the least of any exposure but in
one recording of eight (1.012); twice the true one or more leaves 1.02 to 1.35 where the edge moves 7 px a frame."""
FASTEST_LAG_STEP_PX = 4.0
"""Largest change of a row's lag in one round. Chosen as trust region; only the number of rounds depends on it."""

DEEPEST_LAG_PX = 60.0
"""Largest lag of a row behind the foremost point. Chosen: above the radius of the widest tip, 36 px at 3 px/mm."""

FEW_FRAMES = 16
"""Frames from which the blur is told. Chosen for time; at half the blur scatters by 1.4 more."""

OPTICAL_BLUR_PX = (0.4, 3.0)
"""From a sharp pixel to a picture out of focus; more is taken for blur only where noise drowns the edge. Chosen;
sharper is not sampled, and wider is noise."""


def find_shape(strip: Strip, state: EdgeState, fit: Floats, anew: bool) -> EdgeState:
    """Estimate how far each row of the tip lags behind its foremost point, then the optical blur.

    From the core frames with less blur by motion: not those in which a door may still stand before the tip.

    Parameters
    ----------
    strip : along the axis.
    state : the last estimate.
    fit : from `fit_edges`, shape (n_frames, 6).
    anew : whether the blur is looked for everywhere, not only near the last one.

    Returns
    -------
    the state with new `lag` and `blur`, and the edge moved to the foremost point.
    """
    core = core_frames(state, fit)
    slow = core & (state.lengths <= max(2.0, float(np.quantile(state.lengths[core], 0.5))))
    for _ in range(3):
        by_row = residuals(strip, state, fit, slow).by_row
        step = by_row[:, 0] / (by_row[:, 1] + 0.02 * float(by_row[:, 1].max()) + 1e-9)
        step = np.clip(step, -FASTEST_LAG_STEP_PX, FASTEST_LAG_STEP_PX)
        lag, lead = _smooth_lag(state.lag + step, by_row[:, 1])
        state = replace(state, lag=lag, edge=state.edge - lead)
    candidates = BLURS_PX if anew else state.blur * np.array([0.7, 0.85, 1, 1.2, 1.4])
    few = np.flatnonzero(slow)[:: max(1, int(slow.sum()) // FEW_FRAMES)]
    misfits = []
    for blur in candidates:
        # Over the same pixels for all of them: pixels far from the edge, which always fit, would speak for the widest.
        margin = MARGIN_PX + cover_reach(0.0, float(candidates.max())) - cover_reach(0.0, float(blur))
        misfits.append(_misfit_refitted(strip, replace(state, blur=float(blur)), few, margin))
    return replace(state, blur=float(np.clip(_least(candidates, np.array(misfits)), *OPTICAL_BLUR_PX)))


def find_shading(strip: Strip, state: EdgeState, fit: Floats) -> EdgeState:
    """Estimate what the tip shows beyond film and background, by distance ahead of the edge.

    A round tip is lit otherwise than the tube behind it: its rim may be as bright as the background where the film is
    darker, and the edge would be sought behind the rim.

    Parameters
    ----------
    strip : along the axis.
    state : the last estimate.
    fit : from `fit_edges`, shape (n_frames, 6).

    Returns
    -------
    the state with new `shading`.
    """
    core = core_frames(state, fit)
    for _ in range(2):
        by_place = residuals(strip, state, fit, core).by_place
        middle = len(by_place) // 2
        left, weight = by_place[middle - SHADED_PX : middle + SHADED_PX + 1].T
        step = left / np.maximum(weight, 1e-3 * float(weight.max()) + 1e-12)
        state = replace(state, shading=np.convolve(state.shading + step, SMOOTHING, mode="same"))
    return state


def _misfit_refitted(strip: Strip, state: EdgeState, frames: NDArray[np.int_], margin_px: float) -> float:
    """Misfit of some frames with their edges sought anew: a blur must not be judged by edges fitted with another."""
    edge = np.full(len(state.edge), np.nan)
    edge[frames] = state.edge[frames]
    fit = fit_edges(strip, replace(state, edge=edge))
    use = np.isfinite(fit[:, 0])
    edge[use] = fit[use, 0]
    return residuals(strip, replace(state, edge=edge), fit, use, margin_px).misfit


def find_exposure(strip: Strip, state: EdgeState, fit: Floats) -> float:
    """Exposure in frame periods that explains the blur of the faster frames best; a guess where none moves 2 px.

    Parameters
    ----------
    strip : along the axis.
    state : the last estimate.
    fit : from `fit_edges`, shape (n_frames, 6).

    Returns
    -------
    exposure over frame period.
    """
    speed, fast = _fast_frames(state, fit)
    if not fast.any():
        return ASSUMED_EXPOSURE
    return _least(EXPOSURES, _misfits_of_exposures(strip, state, fit, speed, fast, EXPOSURES))


def seen_exposure(strip: Strip, state: EdgeState, fit: Floats, stated_frames: float) -> tuple[float, float]:
    """Find the exposure that the blur shows in place of a stated one.

    The exposure is NaN where the stated one explains the blur as well (misfit within CONTRADICTED).

    Parameters
    ----------
    strip : along the axis.
    state : the last estimate.
    fit : from `fit_edges`, shape (n_frames, 6).
    stated_frames : stated exposure over frame period.

    Returns
    -------
    exposure over frame period, NaN where the stated one explains the blur as well (misfit within CONTRADICTED); and the
        median speed of the frames used, px a frame.
    """
    speed, fast = _fast_frames(state, fit)
    if fast.sum() < FEWEST_FAST:
        return np.nan, np.nan
    misfits = _misfits_of_exposures(strip, state, fit, speed, fast, np.append(EXPOSURES, stated_frames))
    contradicted = misfits[-1] > CONTRADICTED * misfits.min()
    seen = _least(EXPOSURES, misfits[:-1]) if contradicted else np.nan
    return seen, float(np.median(speed[fast]))


def _fast_frames(state: EdgeState, fit: Floats) -> tuple[Floats, NDArray[np.bool_]]:
    """Speed in every frame, px a frame, and the faster half of the core frames, of those that move 2 px."""
    core = core_frames(state, fit)
    speed = blur_lengths(state.edge, 1.0)
    return speed, core & (speed >= np.quantile(speed[core], 0.5)) & (speed > 2)


def _misfits_of_exposures(
    strip: Strip, state: EdgeState, fit: Floats, speed: Floats, frames: NDArray[np.bool_], exposures: Floats
) -> Floats:
    """Misfit of some frames with each exposure, shape (n_exposures,).

    Without shading of the tip, which at constant speed looks like any error of the exposure.
    """
    bare = replace(state, shading=np.zeros_like(state.shading))
    return np.array([residuals(strip, replace(bare, lengths=speed * tau), fit, frames).misfit for tau in exposures])


def _smooth_lag(lag: Floats, weight: Floats) -> tuple[Floats, float]:
    """Smooth slightly along the rows, by weight, and set zero at the foremost point of the tip; what was taken off.

    That point is the vertex of a parabola through the foremost third of the rows that show an edge at all: the least
    of them would follow their noise.
    """
    kernel = np.exp(-0.5 * (np.arange(-3, 4) / 0.8) ** 2)
    weight = weight + 1e-6 * float(weight.max() + 1e-12)
    top = np.convolve(np.pad(lag * weight, 3, mode="edge"), kernel, mode="valid")
    smooth = top / np.convolve(np.pad(weight, 3, mode="edge"), kernel, mode="valid")
    seen = np.flatnonzero(weight > 0.1 * float(np.median(weight[weight >= np.median(weight)])))
    front = seen[np.argsort(smooth[seen])[: max(len(seen) // 3, 3)]]
    lead = float(np.average(smooth[front], weights=weight[front]))
    if len(front) >= 6:
        middle = float(front.mean())
        curve = np.polyfit(front - middle, smooth[front], 2, w=np.sqrt(weight[front]))
        vertex = -curve[1] / (2 * curve[0]) if curve[0] > 1e-6 else np.inf
        if front.min() <= vertex + middle <= front.max():
            lead = float(np.polyval(curve, vertex))
    return np.clip(smooth - lead, -3.0, DEEPEST_LAG_PX), lead


def _least(candidates: Floats, misfits: Floats) -> float:
    """Candidate of least misfit, refined by a parabola through its neighbours in its logarithm."""
    i = int(np.argmin(misfits))
    if i in (0, len(candidates) - 1):
        return float(candidates[i])
    x, y = np.log(candidates[i - 1 : i + 2]), misfits[i - 1 : i + 2]
    curve = np.polyfit(x - x[1], y, 2)
    if curve[0] <= 0:
        return float(candidates[i])
    return float(np.exp(x[1] + np.clip(-curve[1] / (2 * curve[0]), x[0] - x[1], x[2] - x[1])))
