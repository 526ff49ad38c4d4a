"""The noise of a track: what one position errs by, and how far the error remembers itself."""

from __future__ import annotations

from vinetrack.core.records import Track
from vinetrack.tracks.position_noise import position_noise, rest_points

__all__ = ["rest_points", "track_noise"]


def track_noise(track: Track) -> tuple[float, float]:
    """Standard deviation and lag-one correlation of the random error of a single position.

    Parameters
    ----------
    track
        A track; only its usable points are read.

    Returns
    -------
    noise_m
        Standard deviation, m. 0 where the positions are exact or too few (under 5) to tell.
    correlation
        Lag-one correlation, 0 to 0.95; pulled to 0 where the track is too short to tell.
    """
    usable = track.usable
    return position_noise(track.time_s[usable], track.lead_position_m[usable])
