"""Shape of the tip, optical blur and exposure, estimated from what the edge leaves unexplained."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from vinetrack.video.edge_state import EdgeState, blur_lengths, core_frames, fit_edges, residuals
from vinetrack.video.strip import Strip

Floats = NDArray[np.float64]

BLURS_PX = np.array([0.5, 0.7, 0.9, 1.2, 1.6, 2.1, 2.8])
EXPOSURES = np.array([0.02, 0.05, 0.1, 0.15, 0.2, 0.3, 0.4, 0.5, 0.65, 0.8, 1.0])
ASSUMED_EXPOSURE = 0.25
"""Exposure over frame period until it is estimated."""
FASTEST_LAG_STEP_PX = 4.0
DEEPEST_LAG_PX = 60.0
FEW_FRAMES = 16
OPTICAL_BLUR_PX = (0.4, 3.0)
"""From a sharp pixel to a picture out of focus; more is taken for blur only where noise drowns the edge."""


def find_shape(strip: Strip, state: EdgeState, fit: Floats, anew: bool) -> EdgeState:
    """Estimate how far each row of the tip lags behind its foremost point, then the optical blur.

    From the core frames with less blur by motion: not those in which a door may still stand before the tip.
    """
    core = core_frames(state, fit)
    slow = core & (state.lengths <= max(2.0, float(np.quantile(state.lengths[core], 0.5))))
    for _ in range(3):
        _, by_row, _ = residuals(strip, state, fit, slow)
        step = by_row[:, 0] / (by_row[:, 1] + 0.02 * float(by_row[:, 1].max()) + 1e-9)
        step = np.clip(step, -FASTEST_LAG_STEP_PX, FASTEST_LAG_STEP_PX)
        lag, lead = _smooth_lag(state.lag + step, by_row[:, 1])
        state = replace(state, lag=lag, edge=state.edge - lead)
    candidates = BLURS_PX if anew else state.blur * np.array([0.7, 0.85, 1, 1.2, 1.4])
    few = np.flatnonzero(slow)[:: max(1, int(slow.sum()) // FEW_FRAMES)]
    misfits = [_misfit_refitted(strip, replace(state, blur=float(blur)), few) for blur in candidates]
    return replace(state, blur=float(np.clip(_least(candidates, np.array(misfits)), *OPTICAL_BLUR_PX)))


def _misfit_refitted(strip: Strip, state: EdgeState, frames: NDArray[np.int_]) -> float:
    """Misfit of some frames with their edges sought anew: a blur must not be judged by edges fitted with another."""
    edge = np.full(len(state.edge), np.nan)
    edge[frames] = state.edge[frames]
    fit = fit_edges(strip, replace(state, edge=edge))
    use = np.isfinite(fit[:, 0])
    edge[use] = fit[use, 0]
    return residuals(strip, replace(state, edge=edge), fit, use)[2]


def find_exposure(strip: Strip, state: EdgeState, fit: Floats) -> float:
    """Exposure in frame periods that explains the blur of the faster frames best; a guess where none moves 2 px."""
    core = core_frames(state, fit)
    speed = blur_lengths(state.edge, 1.0)
    fast = core & (speed >= np.quantile(speed[core], 0.5)) & (speed > 2)
    if not fast.any():
        return ASSUMED_EXPOSURE
    misfits = [residuals(strip, replace(state, lengths=speed * tau), fit, fast)[2] for tau in EXPOSURES]
    return _least(EXPOSURES, np.array(misfits))


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
