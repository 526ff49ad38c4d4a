"""The tip of a vine that bends, sweeps or slides along walls: how far along the axis anything new has come.

Such a vine leaves what it has covered, and no picture of its film holds for long; a straight front's tracker would
follow its sweeping. What remains true is that a place the tip has not reached looks as it did at first. The edge is
the monotone path that best divides changed from unchanged columns, good to about a pixel, not better.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vinetrack.video.strip import Strip

Floats = NDArray[np.float64]

FIRST_FRAMES = 5
CHANGED_ROWS = 4
"""Rows of a column that must have changed for something to be there."""
STRONG = 4.0
"""Change in units of the noise, with the noise of compressed pictures at 3 grey levels or more."""
SIGMA_PX = 0.8
"""Half a pixel of the path's own grid, and the ragged outline of a crumpled tip."""


def track_arrival(strip: Strip) -> tuple[Floats, Floats]:
    """Edge along the strip and its error in every frame, shapes (n_frames,), px.

    Raises
    ------
    ValueError
        Where nothing new arrives anywhere.
    """
    from vinetrack.video.edge import after_jump
    from vinetrack.video.kymograph import evident_path

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
