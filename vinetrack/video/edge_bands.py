"""The edge in bands of rows, each fitted alone: their disagreement is an error that owes nothing to a model of noise.

Film, tail, glints and a swinging door touch one band and not another; what misleads them differently shows.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from vinetrack.video.edge_state import EdgeState, fit_edges
from vinetrack.video.strip import Strip

Floats = NDArray[np.float64]

BANDS = 4
"""Bands across: enough to tell who errs, few enough that each still finds the edge."""
FEWEST_ROWS = 4
OUTLYING = 2.0
"""A band further off than this many median distances counts as that far: its pixels hardly counted in the fit."""
HABIT_PX = 50.0
"""Growth over which a lead or lag of one band is its habit: longer than film's grain, shorter than a sway."""
HABIT_FRAMES = 7
NEIGHBOURS = 2
"""Frames on each side of which the median disagreement is taken: four bands alone say little, one glint nothing."""
MEDIAN_TO_MEAN = 1.27
"""Mean over median of χ² with three degrees of freedom."""


def disagreement(strip: Strip, state: EdgeState, edge: Floats, core: NDArray[np.bool_]) -> Floats:
    """Error of the edge by how far the bands disagree, shape (n_frames,), px; zeros where there is one band only.

    The weighted mean of K independent bands errs by Σ w (y − ȳ)² / ((K − 1) Σ w). What a band is ahead or behind
    for long in the `core` frames is the shape of the tip, not an error.
    """
    edges, sigmas = band_fits(strip, state, edge)
    if edges.shape[1] < 2:
        return np.zeros(len(edge))
    off = np.nan_to_num(edges - edge[:, None])
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
    return np.asarray(np.sqrt(MEDIAN_TO_MEAN * usual))


def band_fits(strip: Strip, state: EdgeState, edge: Floats) -> tuple[Floats, Floats]:
    """Edge by band and its Fisher sigma, shapes (n_frames, n_bands), px; NaN where a band shows none.

    The bands share the rows that say anything about the edge evenly.
    """
    rows = strip.values.shape[1]
    said = np.sum((state.pictures[0] - state.pictures[1]) ** 2, axis=1).astype(float)
    said = np.minimum(said, 4 * np.median(said) + 1e-9)
    cuts = np.searchsorted(np.cumsum(said) / said.sum(), np.linspace(0, 1, BANDS + 1)[1:-1])
    limits = np.concatenate([[0], cuts, [rows]])
    edges, sigmas = [], []
    for low, high in pairwise(limits):
        if high - low < FEWEST_ROWS:
            continue
        part = replace(strip, values=np.ascontiguousarray(strip.values[:, low:high]))
        own = replace(
            state, edge=edge, lag=np.ascontiguousarray(state.lag[low:high]),
            pictures=np.ascontiguousarray(state.pictures[:, low:high]),
        )  # fmt: skip
        fit = fit_edges(part, own)
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
