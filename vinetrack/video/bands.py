"""The edge in bands of rows, each fitted alone: their disagreement is an error that owes nothing to a model of noise.

Film, tail, glints and a swinging door touch one band and not another; what misleads them differently shows.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from vinetrack.video.edge_state import State, fit_edges
from vinetrack.video.strip import Strip

Floats = NDArray[np.float64]

BANDS = 4
"""Bands across: enough to tell who errs, few enough that each still finds the edge."""
FEWEST_ROWS = 4


def band_fits(strip: Strip, state: State, edge: Floats) -> tuple[Floats, Floats]:
    """Edge by band and its Fisher sigma, shapes (n_frames, n_bands), px; NaN where a band shows none.

    The bands share the rows that say anything about the edge evenly.
    """
    rows = strip.values.shape[1]
    said = np.sum((state.pictures[0] - state.pictures[1]) ** 2, axis=1).astype(float)
    said = np.minimum(said, 4 * np.median(said) + 1e-9)
    cuts = np.searchsorted(np.cumsum(said) / said.sum(), np.linspace(0, 1, BANDS + 1)[1:-1])
    limits = np.concatenate([[0], cuts, [rows]])
    edges, sigmas = [], []
    for low, high in zip(limits[:-1], limits[1:], strict=True):
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
