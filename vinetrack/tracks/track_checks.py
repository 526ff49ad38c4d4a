"""Checks that every imported track must pass, and how a track is assembled."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from vinetrack.core.records import Floats, Track, plain_track

FEWEST_POINTS = 5
"""Fewest points of a track. Derived: a cubic and one to spare."""

LARGEST_PRESSURE_KPA = 1000.0
"""Largest gauge pressure in kPa that is accepted. Chosen: ten times what vines bear; Pa in place of kPa are larger from
1 kPa on. At half or twice only that message changes."""

VACUUM_KPA = -101.4
"""Least gauge pressure that is accepted; sensors do read a little below zero. Derived: minus the standard atmosphere,
101.325, rounded away from zero."""
LARGEST_NUMBER = 1e9
"""Largest time or position, s or m; anything larger is no measurement and would overflow when squared and summed.
Chosen: squares and their sums then stay far below 1e308."""


class TrackError(Exception):
    """A file that cannot be used as a track or a pressure trace: one sentence, with a remedy."""


def check_times(time_s: Floats, lines: Sequence[int] | None = None) -> None:
    """Refuse times that do not increase from row to row.

    Parameters
    ----------
    time_s : shape (n,), s.
    lines : line of each row in its file, for the message.

    Raises
    ------
    TrackError
        Naming the first row that is not later than the one before.
    """
    wrong = np.flatnonzero(np.diff(time_s) <= 0)
    if len(wrong):
        i = int(wrong[0]) + 1
        place = f"line {lines[i]}, column time_s: " if lines else ""
        raise TrackError(
            f"{place}time does not increase ({time_s[i]:g} after {time_s[i - 1]:g} s): sort or correct the rows"
        )


def check_pressure(pressure_kPa: Floats, lines: Sequence[int]) -> None:
    """Refuse pressures outside what the sheet allows; NaN passes.

    Parameters
    ----------
    pressure_kPa : shape (n,), gauge, kPa.
    lines : line of each row in its file, for the message.

    Raises
    ------
    TrackError
        Naming the first reading below vacuum or above `LARGEST_PRESSURE_KPA`.
    """
    wrong = np.flatnonzero((pressure_kPa > LARGEST_PRESSURE_KPA) | (pressure_kPa < VACUUM_KPA))
    if len(wrong):
        i = int(wrong[0])
        value = float(pressure_kPa[i])
        where = f"line {lines[i]}, column pressure_kPa: {value:g}"
        if value < 0:
            raise TrackError(f"{where} is below vacuum: gauge pressure in kPa is wanted")
        hint = f": looks like Pa, {value:g} Pa is {value / 1000:g} kPa" if value < 1000 * LARGEST_PRESSURE_KPA else ""
        raise TrackError(f"{where} is above {LARGEST_PRESSURE_KPA:g} kPa{hint}")


def new_track(
    time_s: Floats,
    lead_position_m: Floats,
    *,
    sigma_m: Floats | None = None,
    edge_px: Floats | None = None,
    pressure_Pa: Floats | None = None,
    notes: Iterable[str] = (),
) -> Track:
    """Make a track with blank flags, after the checks that all kinds of file share.

    Parameters
    ----------
    time_s, lead_position_m : shape (n,), s and m; positions are NaN where there is none.
    sigma_m : standard error of each position, shape (n,), m; unknown if None.
    edge_px : position along the growth axis of the picture, shape (n,), px; unknown if None.
    pressure_Pa : gauge pressure, shape (n,), Pa; none if None.
    notes : sentences about the track.

    Returns
    -------
    the track.

    Raises
    ------
    TrackError
        If it has fewer than 5 points with a position, times that do not increase, or numbers beyond all measure.
    """
    known = np.isfinite(lead_position_m)
    if np.sum(known) < FEWEST_POINTS:
        count = int(np.sum(known))
        raise TrackError(f"has {count} point{'s' * (count != 1)}: at least {FEWEST_POINTS} are needed")
    if max(np.max(np.abs(time_s)), np.max(np.abs(lead_position_m[known]))) > LARGEST_NUMBER:
        raise TrackError("holds a time or position too large to be one: correct it")
    check_times(time_s)
    first, last = lead_position_m[known][[0, -1]]
    backwards = ("Position decreases from first to last point; it should grow along the axis.",) if last < first else ()
    track = plain_track(time_s, lead_position_m, sigma_m=sigma_m, pressure_Pa=pressure_Pa)
    return replace(track, edge_px=track.edge_px if edge_px is None else edge_px, notes=(*notes, *backwards))
