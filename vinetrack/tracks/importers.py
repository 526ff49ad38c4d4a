"""Import positions measured elsewhere as a track: a CSV, a Physics Tracker project or its text export.

A trial whose sheet names a `track` skips the video stages; this module reads what they would have produced. It depends
on `records` and `tables` alone, so that the experiment's check can use it.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from vinetrack.core.files import file_size
from vinetrack.core.records import Floats, Track, Trial
from vinetrack.core.tables import Table, TableError, parse_table, read_text
from vinetrack.tracks.body_end import flag_end_of_body
from vinetrack.tracks.physics_tracker import is_export_header, read_export, read_project
from vinetrack.tracks.rounded_times import unrounded_times
from vinetrack.tracks.track_checks import FEWEST_POINTS, TrackError, check_pressure, check_times, new_track

__all__ = ["TrackError", "attach_pressure", "load_track", "read_pressure_trace", "read_track"]

LARGEST_TDMS_BYTES = 200_000_000  # Largest TDMS file that is read (chosen)
# Lines within which the header of a text export is looked for, below its title and remarks (chosen)
HEADER_WITHIN_LINES = 20


def load_track(trial: Trial) -> Track:
    """Load the track of a trial whose positions are already measured, with its `pressure_trace` if it has one."""
    if trial.track is None:
        raise TrackError("is blank: this trial has a video, not a track")
    track = read_track(trial.track, point_mass=trial.point_mass, frames_used=trial.frames_used)
    if trial.travel_ratio == 1 and trial.frames_used is None:
        track = flag_end_of_body(track)
    if trial.pressure_trace is None:
        return track
    try:
        return attach_pressure(track, *read_pressure_trace(trial.pressure_trace))
    except TrackError as error:
        raise TrackError(f"pressure_trace {trial.pressure_trace.name} {error}") from None


def read_track(path: Path, *, point_mass: str = "", frames_used: tuple[int, int] | None = None) -> Track:
    """Read positions measured elsewhere; the kind of file is recognised from its content. Accepted are a CSV with
    `time_s, position_m[, sigma_m][, pressure_kPa]`, a Physics Tracker project (`.trk`) and Tracker's text export
    (columns t, x, y or t and one coordinate, with or without a title above).
    """
    if path.suffix.lower() == ".trz":
        raise TrackError("is a packed Tracker project: unpack it and name the .trk inside")
    try:
        text = read_text(path)
        if path.suffix.lower() == ".trk" or text.lstrip("\ufeff \n").startswith("<?xml"):
            return read_project(text, point_mass, frames_used)
        if point_mass:
            raise TrackError("has no point masses to choose from: leave point_mass blank, or name a .trk file")
        lines = text.split("\n")[:HEADER_WITHIN_LINES]
        skip = next((i for i, line in enumerate(lines) if is_export_header(line)), None)
        table = parse_table(text, skip or 0)
        if skip is not None and "position_m" not in table.columns:
            return _only_frames(read_export(table), frames_used)
        return _only_frames(_read_positions(table), frames_used)
    except TableError as error:
        raise TrackError(str(error)) from None


def _only_frames(track: Track, frames_used: tuple[int, int] | None) -> Track:
    """Flag the rows before and after those used."""
    if frames_used is None:
        return track
    rows = np.arange(track.time_s.size)
    before, after = rows < frames_used[0], rows > frames_used[1]
    if np.count_nonzero(~before & ~after) < FEWEST_POINTS:
        raise TrackError(f"has fewer than {FEWEST_POINTS} of its {rows.size} rows in frames_used: widen it")
    flag = track.flag.astype("<U64")
    flag = np.where(before, "rejected", np.where(after, "after_end", flag))
    return replace(track, flag=flag)


def _read_positions(table: Table) -> Track:
    """Read a table of positions; every row of it is a row of the track."""
    _require(table, "time_s", "position_m")
    time_s, position_m = table.numbers("time_s"), table.numbers("position_m")
    time_s, note = unrounded_times(time_s)
    check_times(time_s, table.lines)
    sigma_m, notes = np.full(len(time_s), np.nan), [note] if note else []
    if "sigma_m" in table.columns:
        sigma_m = table.numbers("sigma_m", blank_is_nan=True)
        if np.any(sigma_m < 0):
            raise TrackError(f"line {table.lines[int(np.argmax(sigma_m < 0))]}, column sigma_m is negative: correct it")
        if np.any(sigma_m == 0):
            notes.append("A sigma_m of 0 is taken as unknown.")
            sigma_m = np.where(sigma_m == 0, np.nan, sigma_m)
    pressure_Pa = None
    if "pressure_kPa" in table.columns and any(row["pressure_kPa"] for row in table.rows):
        pressure_kPa = table.numbers("pressure_kPa", blank_is_nan=True)
        check_pressure(pressure_kPa, table.lines)
        known = np.isfinite(pressure_kPa)
        pressure_Pa = 1000 * np.interp(time_s, time_s[known], pressure_kPa[known])
        if not known.all():
            notes.append(f"Pressure is interpolated at {int(np.sum(~known))} points where its cell is blank.")
    return new_track(time_s, position_m, sigma_m=sigma_m, pressure_Pa=pressure_Pa, notes=notes)


def read_pressure_trace(path: Path) -> tuple[Floats, Floats]:
    """Read a pressure trace: a CSV with `time_s, pressure_kPa`, or a TDMS file with such channels. Returns times in s
    and gauge pressures in Pa, two arrays, shape (n,).
    """
    try:
        table = parse_table(_as_csv(path) if path.suffix.lower() == ".tdms" else read_text(path))
        _require(table, "time_s", "pressure_kPa")
        time_s, pressure_kPa = table.numbers("time_s"), table.numbers("pressure_kPa")
    except TableError as error:
        raise TrackError(str(error)) from None
    if len(time_s) == 0:
        raise TrackError("has no rows: write time_s and pressure_kPa of at least one reading")
    check_times(time_s, table.lines)
    check_pressure(pressure_kPa, table.lines)
    return time_s, 1000 * pressure_kPa


def attach_pressure(track: Track, time_s: Floats, pressure_Pa: Floats) -> Track:
    """Interpolate a pressure trace linearly on the times of a track; trace and track share one clock. Beyond the ends
    of the trace its first and last values are held, which a note reports. Shapes: time_s, pressure_Pa (n,) →
    (n_frames,).
    """
    start, end = float(np.min(track.time_s)), float(np.max(track.time_s))
    if len(time_s) > 1 and (time_s[-1] < start or time_s[0] > end):
        raise TrackError(
            f"runs from {time_s[0]:g} to {time_s[-1]:g} s, the track from {start:g} to {end:g} s: "
            "shift one so that both share a clock"
        )
    outside = int(np.sum((track.time_s < time_s[0]) | (track.time_s > time_s[-1])))
    notes = track.notes
    if outside:
        notes = (*notes, f"The pressure trace does not cover {outside} of {len(track.time_s)} points: its end is held.")
    return replace(track, pressure_Pa=np.interp(track.time_s, time_s, pressure_Pa), notes=notes)


def _as_csv(path: Path) -> str:
    """The channels of a TDMS file as the text of a CSV, so that units in their names are converted in the same way."""
    from vinetrack.tracks.tdms import tdms_columns

    try:
        size = file_size(path)
        if size > LARGEST_TDMS_BYTES:
            raise TrackError(f"is larger than {LARGEST_TDMS_BYTES // 1_000_000} MB: keep only its pressure channels")
        columns = tdms_columns(path.read_bytes())
    except OSError as error:
        raise TrackError(f"cannot be read: {error.strerror}") from None
    rows = zip(*(values.tolist() for values in columns.values()), strict=True)
    return "\n".join([",".join(columns), *(",".join(map(repr, row)) for row in rows)])


def _require(table: Table, *columns: str) -> None:
    """Refuse a table that lacks one of these columns."""
    if missing := [column for column in columns if column not in table.columns]:
        present = ", ".join(table.columns[:8]) or "none"
        raise TrackError(
            f"lacks the column {missing[0]} (found: {present[:120]}): name its columns {', '.join(columns)}"
        )
