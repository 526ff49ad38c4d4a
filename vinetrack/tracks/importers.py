"""Import positions measured elsewhere as a track: a CSV, a Physics Tracker project, or tables of other programs.

A trial whose sheet names a `track` skips the video stages; this module reads what they would have produced. It depends
on `records` and `tables` alone, so that the experiment's check can use it.
"""

from __future__ import annotations

import io
import math
import re
import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from vinetrack.core.problems import InputError
from vinetrack.core.process import table
from vinetrack.core.records import END_FRACTION, Floats, Track, Trial, join_flags, plain_track
from vinetrack.core.tables import Table, parse_table, read_bytes, read_table, read_text
from vinetrack.core.units import UNITS, number, split_unit
from vinetrack.tracks.position_noise import rest_points, rough_noise, turning_point

# ------------------------------------------------------------------------------
# Checks that every imported track must pass, and how a track is assembled.

FEWEST_POINTS = 5  # Fewest points of a track, and frames of a recording (derived)
LARGEST_NUMBER = 1e9  # Largest time or position, s or m (chosen)


def check_times(time_s: Floats, lines: Sequence[int] | None = None) -> None:
    """Refuse times that do not increase from row to row. Shapes: time_s (n,)."""
    wrong = np.flatnonzero(np.diff(time_s) <= 0)
    if len(wrong):
        i = int(wrong[0]) + 1
        place = f"line {lines[i]}, column time_s: " if lines else ""
        message = f"{place}time does not increase ({time_s[i]:g} after {time_s[i - 1]:g} s)"
        raise InputError(message, "sort or correct the rows")


def check_pressure(pressure_kPa: Floats, lines: Sequence[int]) -> None:
    """Refuse pressures outside what the sheet allows; NaN passes. Shapes: pressure_kPa (n,)."""
    # 1000, -101.4: largest gauge pressure (chosen), and least (derived); sensors do read a little below zero
    wrong = np.flatnonzero((pressure_kPa > 1000.0) | (pressure_kPa < -101.4))
    if len(wrong):
        value = float(pressure_kPa[wrong[0]])
        hint = f"; {value:g} Pa are {value / 1000:g} kPa" if 1000 < value < 1e6 else ""
        message = f"line {lines[wrong[0]]}, column pressure_kPa: {value:g} is below vacuum or above 1000 kPa"
        raise InputError(message, f"gauge pressure in kPa is wanted{hint}")


def new_track(time_s: Floats, lead_position_m: Floats, notes: Sequence[str], **known: Any) -> Track:
    """Make a track of positions and other fields, after the checks that all kinds of file share. Shapes (n,)."""
    placed_m = lead_position_m[np.isfinite(lead_position_m)]
    if (count := placed_m.size) < FEWEST_POINTS:
        raise InputError(f"has {count} point{'s' * (count != 1)}", f"at least {FEWEST_POINTS} are needed")
    if max(np.max(np.abs(time_s)), np.max(np.abs(placed_m))) > LARGEST_NUMBER:
        raise InputError("holds a time or position too large to be one", "correct it")
    check_times(time_s)
    if placed_m[-1] < placed_m[0]:
        notes = [*notes, "Position decreases from first to last point; it should grow along the axis."]
    return plain_track(time_s, lead_position_m, notes=tuple(notes), **known)


# ------------------------------------------------------------------------------
# Restore times of frames that a file holds with too few digits.
#
# Frames 0.935 ms apart, written to the millisecond, deviate by up to half a millisecond, 2 mm at 4 m/s, and two may
# share a time. Where all times of a file lie within half their last digit of an even series, that is used.


def unrounded_times(time_s: Floats) -> tuple[Floats, str]:
    """Times of evenly spaced frames before they were rounded, and a note; or the times as they are, and a blank."""
    if time_s.size < 8 or not np.isfinite(time_s).all():
        return time_s, ""
    scaled = time_s * 10.0 ** np.arange(7)[:, None]  # with more decimals a time does not count as rounded
    off = np.max(np.abs(scaled - np.round(scaled)), axis=1)
    rounded = np.flatnonzero(off < 1e-6 * np.maximum(1.0, 1e-6 * np.max(np.abs(scaled), axis=1)))
    if not rounded.size:
        return time_s, ""
    digit_s = 10.0 ** -float(rounded[0])
    place = np.arange(time_s.size, dtype=float)
    step_s, first_s = np.polyfit(place, time_s, 1)
    even_s = first_s + step_s * place
    off_s = float(np.max(np.abs(time_s - even_s)))
    # Times must lie within 3/4 of their last digit, which matters from 1 % of a frame on, and three spacings differ
    # from the others: exact times from which a frame or two are missing may lie so too.
    uneven = np.abs(np.diff(time_s) - np.median(np.diff(time_s))) > 0.5 * digit_s
    if not step_s > 0 or off_s > 0.75 * digit_s or off_s < 0.005 * step_s or np.count_nonzero(uneven) < 3:
        return time_s, ""
    spacing = f"{1e3 * step_s:.3g} ms apart"
    return even_s, f"Times are rounded to {1e3 * digit_s:g} ms; evenly spaced ones, {spacing}, are used instead."


# ------------------------------------------------------------------------------
# Pressure traces in TDMS files, in which LabVIEW writes measurements, read by npTDMS.


def _tdms_trace(path: Path) -> tuple[Floats, Floats]:
    """Times, s, and gauge pressures, Pa, of a TDMS file: channels `time_s` and `pressure_kPa`. Their unit stands in
    the name, or beside it (`unit_string`). Where none is a time, the waveform's start and increment give it.
    """
    try:
        from nptdms import TdmsFile
    except ModuleNotFoundError:
        remedy = "pip install 'vinetrack[cameras]', or use a CSV"
        raise InputError("is a TDMS file, which npTDMS reads", remedy) from None
    data = read_bytes(path)
    # Of a file that is cut short npTDMS reads the rest: the lengths that its segments state are followed.
    place, damaged = 0, "export it from LabVIEW again, or as CSV"
    while place < len(data):
        length = data[place + 12 : place + 20]
        if data[place : place + 4] != b"TDSm" or len(length) < 8:
            raise InputError("is no whole TDMS file", damaged)
        place += 28 + int.from_bytes(length, "big" if data[place + 4] & 1 << 6 else "little")
    if place > len(data):
        raise InputError("is cut short", damaged)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            groups = TdmsFile.read(io.BytesIO(data)).groups()
            found = [(channel.name, channel.properties, channel[:]) for group in groups for channel in group.channels()]
    except Exception as error:  # Damaged files end in errors of many kinds.
        raise InputError(f"is no whole TDMS file ({error})", damaged) from None
    named = {}
    for name, properties, values in found:
        unit = str(properties.get("unit_string", ""))
        if len(values) and values.dtype.kind in "iuf":
            named[name if not unit or name.endswith(f"_{unit}") else f"{name}_{unit}"] = properties, values
    pressure = next((name for name in named if name.startswith("pressure")), None)
    if pressure is None:
        there = ", ".join(list(named)[:8]) or "none"
        raise InputError(f"lacks a channel pressure_kPa (found: {there[:120]})", "name it so in LabVIEW")
    properties, samples = named[pressure]
    pressure_Pa: Floats = samples * _factor(split_unit(pressure)[1], "Pa")
    for name, (_, values) in named.items():
        if name.startswith("time") and len(values) == len(samples):
            return values * _factor(split_unit(name)[1], "s"), pressure_Pa
    step, start = (float(properties.get(f"wf_{key}", 0.0)) for key in ("increment", "start_offset"))
    if not step > 0:
        raise InputError("states no times", "write a channel time_s, or the waveform's increment (wf_increment)")
    return start + step * np.arange(len(samples), dtype=float), pressure_Pa


# ------------------------------------------------------------------------------
# Read the projects of Physics Tracker (OSP): `.trk`, XML.
#
# A project stores the marks of a point mass in image pixels, frame by frame, and the axes: origin (px, image y
# downwards), angle (degrees, counter-clockwise) and scale (px per unit of length). The transform to world coordinates
# is that of Tracker's source, `org.opensourcephysics.media.core.ImageCoordSystem`. Where origin, angle or scale
# change, a project holds them for key frames; each is valid until the next.


def read_project(text: str, point_mass: str = "", frames_used: tuple[int, int] | None = None) -> Track:
    """Read the track of a `.trk` project: one point mass, projected on the axis of its motion. It is the one named
    `point_mass`, else the one with the most marks; marks outside `frames_used` are ignored.
    """
    # Documents that define entities are refused: they can expand without end.
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise InputError("defines XML entities, which no Tracker project does", "save it anew in Tracker")
    try:
        root = ElementTree.fromstring(text.lstrip("\ufeff \n"))
    except (ElementTree.ParseError, ValueError, RecursionError):
        raise InputError("is not a Tracker project", "unpack a .trz, or save as .trk in Tracker") from None
    panel = next((node for node in root.iter("object") if node.get("class", "").endswith(".TrackerPanel")), None)
    if panel is None:
        raise InputError("holds no Tracker panel", "save the project as .trk in Tracker")
    masses: dict[str, dict[int, tuple[float, ...]]] = {}
    for node in panel.iter("object"):
        if node.get("class", "").endswith(".PointMass"):
            name = (_text(node, "name") or f"mass {len(masses) + 1}").strip()[:40]
            masses[f"{name} {len(masses) + 1}" if name in masses else name] = _frame_values(node, "x", "y")
    name, notes = _chosen({name: len(marks) for name, marks in masses.items()}, point_mass)
    marks = masses[name]
    first, last = frames_used or (0, max(marks))
    marks = {frame: place for frame, place in marks.items() if first <= frame <= last}
    if not marks:
        raise InputError(f"holds no marks of {name!r} in frames {first} to {last}", "widen frames_used")
    frames = np.array(sorted(marks))
    pixels = np.array([marks[frame] for frame in sorted(marks)])
    frame_s, start_s, start_frame = _clock(panel)
    unit = _text(panel, "length_unit").strip()
    if not unit:
        notes.append("The project names no unit of length; metres are assumed.")
    axes = _axes(panel)
    which = np.clip(np.searchsorted(sorted(axes), frames, side="right") - 1, 0, None)
    valid = np.array([axes[start] for start in sorted(axes)])[which]
    angle = np.array([math.radians(degrees) for degrees in valid[:, 2]])
    right, up = ((pixels - valid[:, :2]) / valid[:, 3:]).T * np.array([[1.0], [-1.0]])
    world = [np.cos(angle) * right + np.sin(angle) * up, np.cos(angle) * up - np.sin(angle) * right]
    world_m = np.column_stack(world) * _factor(unit or "m", "m")
    position_m, note = _project_on_axis(world_m)
    edge_px, _ = _project_on_axis(pixels)
    missing = int(frames[-1] - frames[0]) + 1 - len(frames)
    if missing:
        notes.append(f"{missing} frames between the first and the last point have none.")
    time_s = start_s + (frames - start_frame) * frame_s
    return new_track(time_s, position_m, [*notes, note], edge_px=edge_px)


def _frame_values(node: ElementTree.Element, *names: str) -> dict[int, tuple[float, ...]]:
    """Numbers stored per frame under `framedata`; frames that lack one are left out."""
    values: dict[int, tuple[float, ...]] = {}
    for entry in node.findall("property[@name='framedata']/property"):
        index = re.fullmatch(r"\[(\d{1,9})\]", entry.get("name", ""), re.ASCII)
        stored = entry.find("object")
        if index is None or stored is None:
            continue
        numbers = tuple(_number(stored, name) for name in names)
        if all(math.isfinite(number) for number in numbers):
            values[int(index[1])] = numbers
    return values


def _axes(panel: ElementTree.Element) -> dict[int, tuple[float, ...]]:
    """The coordinate systems by the frame from which they are valid: origin in px, angle in degrees, px per unit."""
    coords = _object(panel, "coords")
    values = {} if coords is None else _frame_values(coords, "xorigin", "yorigin", "angle", "xscale", "yscale")
    if not values:
        raise InputError("holds no coordinate system", "calibrate it in Tracker")
    scales = np.array(list(values.values()))[:, 3:]
    if np.any(scales <= 0) or np.all(scales == 1):
        raise InputError("was never calibrated: 1 pixel is 1 m, or less", "set a calibration stick or tape in Tracker")
    return values


def _clock(panel: ElementTree.Element) -> tuple[float, float, int]:
    """Seconds per frame, and time and number of the start frame."""
    clip, control = _object(panel, "videoclip"), _object(panel, "clipcontrol")
    video = None if clip is None else _object(clip, "video")
    spacings = [_number(node, "delta_t") for node in (control, video) if node is not None]
    frame_ms = next((spacing for spacing in spacings if math.isfinite(spacing) and spacing > 0), math.nan)
    if math.isnan(frame_ms):
        raise InputError("does not say how long a frame lasts", "set the frame rate in Tracker's clip settings")
    start_ms, start_frame = (
        0.0 if clip is None else float(np.nan_to_num(_number(clip, name))) for name in ("starttime", "startframe")
    )
    return frame_ms / 1000, start_ms / 1000, int(start_frame)


def _object(node: ElementTree.Element, name: str) -> ElementTree.Element | None:
    """The object stored in a property."""
    return node.find(f"property[@name='{name}']/object")


def _text(node: ElementTree.Element, name: str) -> str:
    """The text of a property, blank where there is none."""
    return node.findtext(f"property[@name='{name}']") or ""


def _number(node: ElementTree.Element, name: str) -> float:
    """A stored number; NaN where it is missing, is none or is beyond LARGEST_NUMBER."""
    try:
        value = float(_text(node, name) or "nan")
    except ValueError:
        return math.nan
    return value if abs(value) <= LARGEST_NUMBER else math.nan


# ------------------------------------------------------------------------------
# Tables, a row a frame: your own (`time_s, position_m`, in any units), or of points as other programs write them:
# Tracker (`t, x, y`), trackpy (`y, x, …, frame, particle`), DeepLabCut (`scorer`, `bodyparts`, `coords` above), Kinovea
# (`Time, ball/0/X, ball/0/Y`, or sections of text), DLTdv (`pt1_cam1_X, …`, or `pt1_X, pt1_Y, pt1_Z`). What a file
# leaves open the sheet says: the rate by `capture_fps`, the length of a pixel or of any other unit by `mm_per_px`. A
# note says what was taken for what, unless the names of the columns do.


def _column(cell: str) -> tuple[str, str, str]:
    """Point, quantity (t, frame, x, y, z, position, likelihood, or blank) and unit of a column.

    >>> [_column(cell) for cell in ("x (cm)", "#t", "pt1_cam1_X", "ball/0/Y", "position_mm", "mass")]
    [('', 'x', 'cm'), ('', 't', ''), ('pt1_cam1', 'x', ''), ('ball/0', 'y', ''), ('', 'position', 'mm'), ('', '', '')]
    """
    form = r"#?\s*(?:(.+?)[\s_/]+)?(t|time|frame|x|y|z|position|likelihood)\s*(?:[(\[_]\s*([a-zµ]+)\s*[)\]]?)?"
    match = re.fullmatch(form, cell.strip().strip('"').strip(), re.IGNORECASE)
    return (match[1] or "", match[2].lower().replace("time", "t"), match[3] or "") if match else ("", "", "")


def _table(text: str) -> Table:
    """The table of positions in a text, its header in one line."""
    lines = text.split("\n")
    if lines[0].startswith("#Kinovea"):  # sections of lines `t x y`, each below `# name`
        name, table = "", ["t;particle;x;y"]
        for line in lines[2:]:
            name = line.strip("# ") if line.startswith("#") else name
            table += [";".join([cells[0], name, *cells[1:]]) for cells in [line.split()] if cells and line[0] != "#"]
        return parse_table("\n".join(table))
    heads = [line.partition(",")[0] for line in lines[:5]]
    if heads[0] == "scorer" and "coords" in heads:
        body = heads.index("coords") + 1
        names = map(" ".join, zip(*(line.split(",")[1:] for line in lines[1:body]), strict=False))
        return parse_table("\n".join([",".join(["frame", *names]), *lines[body:]]))
    for skip, line in enumerate(lines[:20]):  # a title and remarks may stand above the header (chosen)
        columns = [_column(cell) for cell in re.split(r"[\t;,]", line)]
        found = {quantity for _, quantity, _ in columns}
        if found & {"x", "y", "position"} and (found & {"t", "frame"} or columns[0][0].startswith("pt")):
            return parse_table(text, skip)
    remedy = "name them time_s and position_m (or in other units), or frame or t, and x, y or both"
    found_names = ", ".join(parse_table(text).columns[:8])
    raise InputError(f"has no columns of times and positions (found: {found_names[:120]})", remedy)


def table_track(text: str, wanted: str, capture_fps: float, m_per_px: float) -> Track:
    """Read the track of one point of a table, given as text: that of the name `wanted`, else that with the most places.
    A blank coordinate, or one that DeepLabCut finds unlikely, is a frame without a place.
    """
    table = _table(text)
    known = [{name: "" if cell.lower() == "nan" else cell for name, cell in row.items()} for row in table.rows]
    table = replace(table, rows=tuple(known))
    columns: dict[str, dict[str, tuple[str, str]]] = {}  # by point and quantity, with their units
    for column in table.columns:
        of, quantity, unit = _column(column)
        if quantity:
            columns.setdefault("clock" if quantity in ("t", "frame") else of, {}).setdefault(quantity, (column, unit))
    clock = columns.pop("clock", {})
    particle = np.array([row.get("particle", "").removesuffix(".0") for row in table.rows])
    points = {}
    for of, given in columns.items():
        axes = [given["position"]] if "position" in given else [given[axis] for axis in "xyz" if axis in given]
        if not axes:
            continue
        places = np.column_stack([table.numbers(column, blank_is_nan=True) for column, _ in axes])
        if "likelihood" in given:  # 0.6: from which DeepLabCut itself draws a point
            places[table.numbers(given["likelihood"][0], blank_is_nan=True) < 0.6] = np.nan
        for one in dict.fromkeys(particle.tolist()):
            points[f"{of} {one}".strip()] = axes, np.flatnonzero(particle == one), places[particle == one]
    counts = {name: int(np.isfinite(places).all(axis=1).sum()) for name, (_, _, places) in points.items()}
    name, notes = _chosen(counts, wanted)
    axes, rows, places = points[name]

    column, time_unit = clock.get("t") or clock.get("frame") or ("the rows", "frames")
    if any(":" in row.get(column, "") for row in table.rows):
        raise InputError("holds times of a clock", "export them in seconds or milliseconds")
    time = table.numbers(column)[rows] if clock else rows.astype(float)
    factors = {"seconds": 1.0, "milliseconds": 1e-3, "frames": 1 / capture_fps}
    if "t" not in clock:
        time_unit = "frames"
    elif not time_unit:  # that in which points are a frame apart
        step = capture_fps * float(np.median(np.diff(time))) if time.size > 1 else math.nan
        time_unit = next((unit for unit, factor in factors.items() if abs(step * factor - 1) < 0.05), "seconds")
    time_s = time * (factors[time_unit] if time_unit in factors else _factor(time_unit, "s"))
    if not np.isfinite(time_s).all():
        raise InputError("states no times", "give the rate of its frames as capture_fps")
    time_s, rounded = unrounded_times(time_s)
    check_times(time_s, [table.lines[row] for row in rows])

    unit, scale = axes[0][1], m_per_px
    # 10: no motion is measured in fewer pixels, and no vine of which they are taken is as long in metres (chosen)
    is_small = np.max(np.nanmax(places, axis=0) - np.nanmin(places, axis=0)) <= 10
    if unit and unit.lower() not in ("px", "pixel", "pixels"):
        scale = _factor(unit, "m")
    elif not unit and ("t" in clock or len(axes) == 3) and (is_small or not math.isfinite(m_per_px)):
        unit, scale = "metres", 1.0
    elif not math.isfinite(m_per_px):
        raise InputError("has its places in pixels", "give the length of a pixel as mm_per_px")
    is_position = _column(axes[0][0])[1] == "position"
    position_m, projected = (scale * places[:, 0], "") if is_position else _project_on_axis(places * scale)
    taken = f"{' and '.join(column for column, _ in axes)} in {unit or f'units of {1e3 * scale:g} mm'}"
    if not (is_position and axes[0][1] and clock.get("t", ("", ""))[1]):
        notes.append(f"Places are taken from {taken}, times from {column} in {time_unit}.")
    notes += [rounded, projected]
    if missing := int(np.sum(~np.isfinite(position_m))):
        notes.append(f"{missing} rows have no position.")
    beside = (("sigma", "m"), ("systematic", "m"), ("pressure", "Pa"))
    sigma_m, systematic_m, pressure_Pa = (_beside(table, quantity, si)[rows] for quantity, si in beside)
    if np.any(sigma_m < 0):
        raise InputError(f"line {table.lines[rows[np.argmax(sigma_m < 0)]]}, column sigma is negative", "correct it")
    if np.any(sigma_m == 0):
        notes.append("A sigma_m of 0 is taken as unknown.")
    traced = np.isfinite(pressure_Pa)
    check_pressure(pressure_Pa / 1000, [table.lines[row] for row in rows])
    if traced.any() and not traced.all():
        notes.append(f"Pressure is interpolated at {int(np.sum(~traced))} points where its cell is blank.")
    trace_Pa = np.interp(time_s, time_s[traced], pressure_Pa[traced]) if traced.any() else None
    more: dict[str, Any] = {"lead_position_sigma_m": np.where(sigma_m == 0, np.nan, sigma_m), "pressure_Pa": trace_Pa}
    if np.isfinite(systematic_m).any():  # a track of vinetrack itself
        more["lead_position_systematic_m"] = systematic_m
        more["flag"] = np.array([join_flags(table.rows[row].get("flag", "")) for row in rows])
        notes.append("Read as a track of vinetrack, with its errors and flags.")
    return new_track(time_s, position_m, list(filter(None, notes)), **more)


def _beside(table: Table, quantity: str, si: str) -> Floats:
    """A column of another quantity in SI, such as `pressure_psi`; NaN where there is none. Shape (n_rows,)."""
    for name in table.columns:
        if (split := split_unit(name.removeprefix("lead_position_")))[0] == quantity:
            return table.numbers(name, blank_is_nan=True) * _factor(split[1], si)
    return np.full(len(table.rows), np.nan)


def _chosen(counts: Mapping[str, int], wanted: str) -> tuple[str, list[str]]:
    """The point of the name `wanted`, else that with the most places, and a note of others."""
    marked = {name: count for name, count in counts.items() if count}
    if not marked:
        raise InputError("holds no point with places", "mark the leading edge")
    named = [name for name in marked if not wanted or name.casefold() == wanted.strip().casefold()]
    if not named:
        raise InputError(f"holds no point named {wanted!r}", f"point_mass is one of {', '.join(map(repr, marked))}")
    best = max(named, key=marked.__getitem__)
    others = ", ".join(name for name in marked if name != best)
    return best, [f"Taken from {best!r}, which has the most points; not used: {others}."] * bool(others and not wanted)


def _factor(unit: str, si: str) -> float:
    """Factor that converts a unit of Tracker to SI."""
    known = UNITS.get(unit.replace("µ", "u"))
    if known is None or known.si != si:
        others = ", ".join(key for key, other in UNITS.items() if other.si == si)
        raise InputError(f"has an unknown unit {unit[:20]!r}", f"use one of {others}")
    return known.to_si(1.0)


def _project_on_axis(points: Floats) -> tuple[Floats, str]:
    """Positions along the principal axis of the motion, forwards, (n,), and a note. Shapes: points (n, 1 to 3)."""
    known = np.all(np.isfinite(points), axis=1)
    if np.max(np.abs(points[known])) > LARGEST_NUMBER:
        raise InputError("holds a position too large to be one", "correct it")
    centred = points[known] - points[known].mean(axis=0)
    axis = np.linalg.svd(centred, full_matrices=False)[2][0]
    position = (points - points[known][0]) @ axis
    if position[known][-1] < 0:
        axis, position = -axis, -position
    stray = math.sqrt(np.mean(np.sum((centred - np.outer(centred @ axis, axis)) ** 2, axis=1)))
    degrees = math.degrees(math.acos(min(abs(axis[0]), 1.0)))
    note = (
        f"Points are projected on the principal axis of their motion ({degrees:.1f}° from x); "
        f"they stray {1000 * stray:.3g} mm rms from it."
    )
    return np.where(known, position, np.nan), note


# ------------------------------------------------------------------------------
# Find where the motion in an imported track ends: a body turns back (a bounce), or it stops abruptly, a vine short of
# its length. What slows down to rest may obey the model to the end.


def flag_end_of_motion(trial: Trial, track: Track) -> Track:
    """Flag points after the end of motion `after_end`, with a note; none where the user has chosen frames."""
    rows = np.flatnonzero(track.usable)
    y = track.lead_position_m[rows]
    if rows.size <= FEWEST_POINTS or trial.frames_used is not None:
        return track
    noise_m, is_vine, what = rough_noise(y), trial.travel_ratio != 1, "turns back"
    # A body has turned back when it is 8 standard deviations, and 2 % of its travel, behind its furthest place.
    end = None if is_vine else turning_point(y, max(8.0 * noise_m, 0.02 * float(np.ptp(y))))
    if end is None:
        end, what = _stops_dead(y, noise_m), "stops"
    if end is not None and is_vine:
        # The fit leaves out the end of the length itself; before it, the model goes on.
        end = end - 1 if np.median(y[-3:]) - np.median(y[:3]) < END_FRACTION * trial.length_m else None
    if end is None or end + 1 < FEWEST_POINTS:
        return track
    who, end_s = "vine" if is_vine else "body", track.time_s[rows[end]]
    note = f"the {who} {what} after {end_s:.5g} s: the end of its motion; later points are not used"
    return track.flagged(rows[end + 1 :], "after_end", note)


def _stops_dead(y: Floats, noise_m: float) -> int | None:
    """First point of a standstill that lasts to the end and begins abruptly: at constant speed the last twenty
    standard deviations of travel take half as long as the forty before them. None where there is none.
    """
    first = y.size - rest_points(-y[::-1])
    if not FEWEST_POINTS <= first <= y.size - 3:
        return None
    reach_m = 20 * max(noise_m, 1e-10)
    behind_m = float(np.median(y[first:])) - y[:first]
    far, near = np.flatnonzero(behind_m > 3 * reach_m), np.flatnonzero(behind_m > reach_m)
    is_abrupt = far.size and first - near[-1] <= 0.75 * (near[-1] - far[-1]) + 2
    return first if is_abrupt else None


def load_track(trial: Trial) -> Track:
    """Load the track of a trial whose positions are already measured, with its `pressure_trace` if it has one."""
    assert trial.track is not None
    chosen: dict[str, Any] = {"point_mass": trial.point_mass, "frames_used": trial.frames_used}
    track = read_track(trial.track, **chosen, capture_fps=trial.capture_fps, m_per_px=trial.m_per_px)
    return with_pressure_trace(trial, flag_end_of_motion(trial, track))


def with_pressure_trace(trial: Trial, track: Track) -> Track:
    """Return a track of a trial with its `pressure_trace`, if it has one."""
    if trial.pressure_trace is None:
        return track
    try:
        return attach_pressure(track, *read_pressure_trace(trial.pressure_trace))
    except InputError as error:
        raise InputError(f"pressure_trace {trial.pressure_trace.name} {error}") from None


def read_track(
    path: Path,
    *,
    point_mass: str = "",
    frames_used: tuple[int, int] | None = None,
    capture_fps: float = math.nan,
    m_per_px: float = math.nan,
) -> Track:
    """Read positions measured elsewhere; the kind of file is recognised from its content: a table with `time_s,
    position_m[, sigma_m][, pressure_kPa]`, or of points of another program, or a Physics Tracker project (`.trk`).
    """
    text = read_text(path)
    if path.suffix.lower() == ".trk" or text.lstrip("\ufeff \n").startswith("<?xml"):
        return read_project(text, point_mass, frames_used)
    track = table_track(text, point_mass, capture_fps, m_per_px)
    if frames_used is None:
        return track
    rows = np.arange(track.time_s.size)
    before, after = rows < frames_used[0], rows > frames_used[1]
    if np.count_nonzero(~before & ~after) < FEWEST_POINTS:
        raise InputError(f"has fewer than {FEWEST_POINTS} of its {rows.size} rows in frames_used", "widen it")
    return track.flagged(before, "rejected").flagged(after, "after_end")


def track_lines(tracks: Iterable[tuple[Trial, Track]]) -> list[str]:
    """What was read of tracks as a table, and their notes; of those that differ only in numbers, the first."""
    rows, told = [], dict[str, list[str]]()
    for trial, track in tracks:
        time_s, growth_m = track.time_s, float(np.ptp(track.lead_position_m[track.usable]))
        facts = 1 / float(np.median(np.diff(time_s))), np.ptp(time_s), 1e3 * growth_m, 1e3 * trial.length_m
        rows.append((trial.name, time_s.size, *(number(float(fact), 4) for fact in facts)))
        for note in track.notes:
            told.setdefault(re.sub(r"\d[\d.]*", "", note), []).append(f"{trial.name}: {note}")
    head, units = ("track", "points", "rate", "lasts", "growth", "sheet"), ("", "", "1/s", "s", "mm", "mm")
    lines = [f"{alike[0]}{f' (and {len(alike) - 1} more alike)' if alike[1:] else ''}" for alike in told.values()]
    return [*table(rows, head, units, align="<>>>>>"), *lines] if rows else []


def read_pressure_trace(path: Path) -> tuple[Floats, Floats]:
    """Times, s, and gauge pressures, Pa, (n,) each: a CSV with `time_s, pressure_kPa`, or a TDMS with such channels."""
    if path.suffix.lower() == ".tdms":
        time_s, pressure_Pa = _tdms_trace(path)
        lines: Sequence[int] = range(1, len(time_s) + 1)
    else:
        table = read_table(path)
        if missing := {"time_s", "pressure_kPa"} - {*table.columns}:
            message = f"lacks the column {min(missing)} (found: {', '.join(table.columns[:8])[:120]})"
            raise InputError(message, "name its columns time_s, pressure_kPa")
        time_s, pressure_Pa, lines = table.numbers("time_s"), 1000 * table.numbers("pressure_kPa"), table.lines
    if len(time_s) == 0:
        raise InputError("has no rows", "write time_s and pressure_kPa of at least one reading")
    if not np.isfinite(time_s + pressure_Pa).all():
        raise InputError("holds a sample that is no number", "correct it in LabVIEW")
    check_times(time_s, lines)
    check_pressure(pressure_Pa / 1000, lines)
    return time_s, pressure_Pa


def attach_pressure(track: Track, time_s: Floats, pressure_Pa: Floats) -> Track:
    """Interpolate a pressure trace on the times of a track; a note reports where its first or last value is held."""
    start, end = float(np.min(track.time_s)), float(np.max(track.time_s))
    if len(time_s) > 1 and (time_s[-1] < start or time_s[0] > end):
        message = f"runs from {time_s[0]:g} to {time_s[-1]:g} s, the track from {start:g} to {end:g} s"
        raise InputError(message, "shift one so that both share a clock")
    outside = int(np.sum((track.time_s < time_s[0]) | (track.time_s > time_s[-1])))
    notes = track.notes
    if outside:
        notes = (*notes, f"The pressure trace does not cover {outside} of {len(track.time_s)} points: its end is held.")
    return replace(track, pressure_Pa=np.interp(track.time_s, time_s, pressure_Pa), notes=notes)
