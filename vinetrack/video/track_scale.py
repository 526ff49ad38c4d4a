"""A track from pixels along its axis to metres."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from vinetrack.core.records import Floats, Track
from vinetrack.video.axis import Axis


def in_metres(track: Track, axis: Axis, m_per_px: float, position_m: Callable[[Floats], Floats] | None) -> Track:
    """Give positions and their errors in metres.

    Parameters
    ----------
    track : whose errors are in px yet.
    axis : along which its edge counts.
    m_per_px : scale; positions and errors are NaN where it is.
    position_m : metres along the axis of picture points, shape (n, 2), px; used in place of the scale where given.

    Returns
    -------
    Track
    """
    if position_m is None:
        return _scaled(track, track.edge_px * m_per_px, m_per_px)
    finite = np.isfinite(track.edge_px)
    position = np.full(len(track.edge_px), np.nan)
    local = np.full(len(track.edge_px), np.nan)
    if finite.any():
        along = track.edge_px[finite]
        position[finite] = position_m(axis.points(along))
        local[finite] = position_m(axis.points(along + 0.5)) - position_m(axis.points(along - 0.5))
    return _scaled(track, position, np.abs(local))


def _scaled(track: Track, position_m: Floats, m_per_px: Floats | float) -> Track:
    slow_px = track.lead_position_systematic_m
    return replace(
        track,
        lead_position_m=position_m,
        lead_position_sigma_m=track.lead_position_sigma_m * m_per_px,
        lead_position_systematic_m=None if slow_px is None else slow_px * m_per_px,
    )
