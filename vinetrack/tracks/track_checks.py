"""Checks that every imported track must pass, and how a track is assembled."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from vinetrack.core.records import Floats, Track, plain_track

FEWEST_POINTS = 5  # Fewest points of a track (derived)

LARGEST_PRESSURE_KPA = 1000.0  # Largest gauge pressure in kPa that is accepted (chosen)

VACUUM_KPA = -101.4  # Least gauge pressure that is accepted; sensors do read a little below zero (derived)
LARGEST_NUMBER = 1e9  # Largest time or position, s or m (chosen)


class TrackError(Exception):
    """A file that cannot be used as a track or a pressure trace: one sentence, with a remedy."""


def check_times(time_s: Floats, lines: Sequence[int] | None = None) -> None:
    """Refuse times that do not increase from row to row. Shapes: time_s (n,)."""
    wrong = np.flatnonzero(np.diff(time_s) <= 0)
    if len(wrong):
        i = int(wrong[0]) + 1
        place = f"line {lines[i]}, column time_s: " if lines else ""
        raise TrackError(
            f"{place}time does not increase ({time_s[i]:g} after {time_s[i - 1]:g} s): sort or correct the rows"
        )


def check_pressure(pressure_kPa: Floats, lines: Sequence[int]) -> None:
    """Refuse pressures outside what the sheet allows; NaN passes. Shapes: pressure_kPa (n,)."""
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
    """Make a track with blank flags, after the checks that all kinds of file share. Shapes: time_s, lead_position_m,
    sigma_m, edge_px, pressure_Pa (n,).
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
