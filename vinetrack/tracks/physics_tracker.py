"""Read files of Physics Tracker (OSP): its project (`.trk`, XML) and its text export.

A project stores the marks of a point mass in image pixels, frame by frame, and the axes: origin (px, image y
downwards), angle (degrees, counter-clockwise) and scale (px per unit of length). The transform to world coordinates is
that of Tracker's source, `org.opensourcephysics.media.core.ImageCoordSystem`. Where origin, angle or scale change, a
project holds them for key frames; each is valid until the next.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from vinetrack.core.records import Floats, Track
from vinetrack.core.tables import Table
from vinetrack.tracks.rounded_times import unrounded_times
from vinetrack.tracks.track_checks import LARGEST_NUMBER, TrackError, check_times, new_track

if TYPE_CHECKING:
    from xml.etree.ElementTree import Element

METRES = {"m": 1.0, "cm": 0.01, "mm": 0.001, "um": 1e-6, "µm": 1e-6, "km": 1000.0, "in": 0.0254, "ft": 0.3048}
SECONDS = {"s": 1.0, "ms": 0.001, "min": 60.0}
_HEADER_CELL = re.compile(r"#?\s*(t|time|x|y)\s*(?:[(\[_]\s*([a-zµ]+)\s*[)\]]?)?", re.IGNORECASE)


@dataclass(frozen=True)
class _Axes:
    """Tracker's coordinate system from one frame on: origin in px, angle in rad, px per unit of length."""

    from_frame: int
    origin_px: tuple[float, float]
    angle_rad: float
    px_per_unit: tuple[float, float]


def read_project(text: str, point_mass: str = "", frames_used: tuple[int, int] | None = None) -> Track:
    """Read the track of a `.trk` project: one point mass, projected on the axis of its motion. It is the one named
    `point_mass`, else the one with the most marks; marks outside `frames_used` are ignored.
    """
    panel = _parse_panel(text)
    name, marks, others = _choose_mass(panel, point_mass)
    first, last = frames_used or (0, max(marks))
    marks = {frame: place for frame, place in marks.items() if first <= frame <= last}
    if not marks:
        raise TrackError(f"holds no marks of {name!r} in frames {first} to {last}: widen frames_used")
    frames = np.array(sorted(marks))
    pixels = np.array([marks[frame] for frame in sorted(marks)])
    frame_s, start_s, start_frame = _clock(panel)
    notes = []
    if others and not point_mass:
        notes.append(f"Taken from the point mass {name!r}, which has the most points; not used: {', '.join(others)}.")
    unit = (_text(panel, "length_unit") or "").strip()
    if unit and unit not in METRES:
        raise TrackError(f"measures lengths in {unit[:20]!r}: set the length unit to m in Tracker")
    if not unit:
        notes.append("The project names no unit of length; metres are assumed.")
    world_m = _to_world(frames, pixels, _axes(panel)) * METRES.get(unit, 1.0)
    position_m, note = _project_on_axis(world_m)
    edge_px, _ = _project_on_axis(pixels)
    missing = int(frames[-1] - frames[0]) + 1 - len(frames)
    if missing:
        notes.append(f"{missing} frames between the first and the last point have none.")
    time_s = start_s + (frames - start_frame) * frame_s
    return new_track(time_s, position_m, edge_px=edge_px, notes=[*notes, note])


def _parse_panel(text: str) -> Element:
    """The element of Tracker's panel. Documents that define entities are refused: they can expand without end."""
    from xml.etree import ElementTree

    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise TrackError("defines XML entities, which no Tracker project does: save it anew in Tracker")
    try:
        root = ElementTree.fromstring(text.lstrip("\ufeff \n"))
    except (ElementTree.ParseError, ValueError, RecursionError):
        raise TrackError("is not a Tracker project: unpack a .trz, or save as .trk in Tracker") from None
    panels = [node for node in root.iter("object") if node.get("class", "").endswith(".TrackerPanel")]
    if not panels:
        raise TrackError("holds no Tracker panel: save the project as .trk in Tracker")
    return panels[0]


def _choose_mass(panel: Element, wanted: str) -> tuple[str, dict[int, tuple[float, ...]], list[str]]:
    """Name and marks (frame → px) of the point mass wanted, or of that with the most marks; names of the others."""
    masses: list[tuple[str, dict[int, tuple[float, ...]]]] = []
    for node in panel.iter("object"):
        if node.get("class", "").endswith(".PointMass"):
            name = _text(node, "name") or f"mass {len(masses) + 1}"
            masses.append((name.strip()[:40], _frame_values(node, "x", "y")))
    marked = [(name, marks) for name, marks in masses if marks]
    if not marked:
        raise TrackError("holds no point mass with marks: mark the leading edge as a point mass in Tracker")
    best = max(range(len(marked)), key=lambda i: len(marked[i][1]))
    if wanted:
        named = [i for i, (name, _) in enumerate(marked) if name.casefold() == wanted.strip().casefold()]
        if len(named) != 1:
            names = ", ".join(repr(name) for name, _ in marked)
            many = "several point masses" if named else "no point mass"
            raise TrackError(f"holds {many} named {wanted!r}: point_mass is one of {names}")
        best = named[0]
    name, marks = marked[best]
    return name, marks, [other for i, (other, _) in enumerate(marked) if i != best]


def _frame_values(node: Element, *names: str) -> dict[int, tuple[float, ...]]:
    """Numbers stored per frame under `framedata`; frames that lack one are left out."""
    values: dict[int, tuple[float, ...]] = {}
    for entry in _children(_property(node, "framedata")):
        index = re.fullmatch(r"\[(\d{1,9})\]", entry.get("name", ""), re.ASCII)
        stored = entry.find("object")
        if index is None or stored is None:
            continue
        numbers = tuple(_number(stored, name) for name in names)
        if all(math.isfinite(number) for number in numbers):
            values[int(index[1])] = numbers
    return values


def _axes(panel: Element) -> list[_Axes]:
    """The coordinate systems of the key frames, in their order."""
    coords = _object(panel, "coords")
    values = {} if coords is None else _frame_values(coords, "xorigin", "yorigin", "angle", "xscale", "yscale")
    if not values:
        raise TrackError("holds no coordinate system: calibrate it in Tracker")
    if any(xscale <= 0 or yscale <= 0 for *_, xscale, yscale in values.values()):
        raise TrackError("holds a scale that is not positive: calibrate it anew in Tracker")
    if all(xscale == 1 and yscale == 1 for *_, xscale, yscale in values.values()):
        raise TrackError("was never calibrated (1 pixel is 1 m): set a calibration stick or tape in Tracker")
    return [_Axes(n, (x, y), math.radians(angle), (sx, sy)) for n, (x, y, angle, sx, sy) in sorted(values.items())]


def _to_world(frames: np.ndarray, pixels: Floats, axes: list[_Axes]) -> Floats:
    """World coordinates, in units of length, of points in px; shape (n, 2)."""
    starts = np.array([system.from_frame for system in axes])
    which = np.clip(np.searchsorted(starts, frames, side="right") - 1, 0, None)
    origin = np.array([system.origin_px for system in axes])[which]
    scale = np.array([system.px_per_unit for system in axes])[which]
    angle = np.array([system.angle_rad for system in axes])[which]
    right, up = ((pixels - origin) / scale).T * np.array([[1.0], [-1.0]])
    return np.column_stack([np.cos(angle) * right + np.sin(angle) * up, np.cos(angle) * up - np.sin(angle) * right])


def _clock(panel: Element) -> tuple[float, float, int]:
    """Seconds per frame, and time and number of the start frame."""
    clip, control = _object(panel, "videoclip"), _object(panel, "clipcontrol")
    video = None if clip is None else _object(clip, "video")
    spacings = [_number(node, "delta_t") for node in (control, video) if node is not None]
    frame_ms = next((spacing for spacing in spacings if math.isfinite(spacing) and spacing > 0), math.nan)
    if math.isnan(frame_ms):
        raise TrackError("does not say how long a frame lasts: set the frame rate in Tracker's clip settings")
    start_ms = 0.0 if clip is None else _number(clip, "starttime")
    start_frame = 0.0 if clip is None else _number(clip, "startframe")
    return (
        frame_ms / 1000,
        start_ms / 1000 if math.isfinite(start_ms) else 0.0,
        int(start_frame) if math.isfinite(start_frame) else 0,
    )


def _children(node: Element | None) -> list[Element]:
    return [] if node is None else node.findall("property")


def _property(node: Element, name: str) -> Element | None:
    return next((child for child in _children(node) if child.get("name") == name), None)


def _object(node: Element, name: str) -> Element | None:
    """The object stored in a property."""
    node_of_name = _property(node, name)
    return None if node_of_name is None else node_of_name.find("object")


def _text(node: Element, name: str) -> str | None:
    node_of_name = _property(node, name)
    return None if node_of_name is None else node_of_name.text


def _number(node: Element, name: str) -> float:
    """A stored number; NaN where it is missing, is none or is beyond LARGEST_NUMBER."""
    try:
        value = float(_text(node, name) or "nan")
    except ValueError:
        return math.nan
    return value if abs(value) <= LARGEST_NUMBER else math.nan


def is_export_header(line: str) -> bool:
    """Whether a line names the columns of a text export: t, and x or y."""
    names = {name for cell in re.split(r"[\t;,]", line) if (name := _column(cell)[0])}
    return "t" in names and bool(names & {"x", "y"})


def _column(cell: str) -> tuple[str, str]:
    """Name (t, x, y or blank) and unit of a column of an export.

    >>> _column("x (cm)"), _column("#t"), _column("v_{x}")
    (('x', 'cm'), ('t', ''), ('', ''))
    """
    match = _HEADER_CELL.fullmatch(cell.strip().strip('"').strip())
    if match is None:
        return "", ""
    return {"time": "t"}.get(match[1].lower(), match[1].lower()), (match[2] or "")


def read_export(table: Table) -> Track:
    """Read the track of Tracker's text export; a blank coordinate is a frame without a point."""
    columns: dict[str, tuple[str, str]] = {}
    for column in table.columns:
        name, unit = _column(column)
        columns.setdefault(name, (column, unit))
    if "t" not in columns or not {"x", "y"} & columns.keys():
        raise TrackError("has no columns t and x or y: export them from Tracker with one separator throughout")
    time_s, rounded = unrounded_times(table.numbers(columns["t"][0]) * _factor(columns["t"], SECONDS))
    check_times(time_s, table.lines)
    axes = [
        table.numbers(columns[name][0], blank_is_nan=True) * _factor(columns[name], METRES)
        for name in ("x", "y")
        if name in columns
    ]
    position_m, note = _project_on_axis(np.column_stack(axes))
    missing = int(np.sum(~np.isfinite(position_m)))
    notes = [rounded] if rounded else []
    if missing:
        notes.append(f"{missing} rows have no position.")
    if not columns["t"][1] and not any(columns[name][1] for name in ("x", "y") if name in columns):
        notes.append("The export names no units; seconds and metres are assumed.")
    return new_track(time_s, position_m, notes=[*notes, note] if note else notes)


def _factor(column: tuple[str, str], units: dict[str, float]) -> float:
    """Factor that converts a column's unit to SI."""
    name, unit = column
    if unit and unit not in units:
        raise TrackError(f"column {name[:30]!r} has an unknown unit: use one of {', '.join(units)}")
    return units.get(unit, 1.0)


def _project_on_axis(points: Floats) -> tuple[Floats, str]:
    """Positions along the principal axis of the motion, and a sentence saying so; NaN rows stay NaN. Returns position,
    note: Shape (n,), with a net displacement that is not negative; the note is blank where nothing was done. Shapes:
    points (n, 1).
    """
    known = np.all(np.isfinite(points), axis=1)
    if not known.any():
        return np.full(len(points), np.nan), ""
    if np.max(np.abs(points[known])) > LARGEST_NUMBER:
        raise TrackError("holds a position too large to be one: correct it")
    if points.shape[1] == 1:
        net = points[known][-1, 0] - points[known][0, 0]
        return (-points[:, 0], "Turned round so that position grows.") if net < 0 else (points[:, 0], "")
    centred = points[known] - points[known].mean(axis=0)
    axis = np.linalg.svd(centred, full_matrices=False)[2][0]
    position = (points - points[known][0]) @ axis
    if position[known][-1] < 0:
        axis, position = -axis, -position
    stray = float(np.sqrt(np.mean((centred - np.outer(centred @ axis, axis)) ** 2) * 2))
    degrees = math.degrees(math.atan2(axis[1], axis[0]))
    note = (
        f"Points in a plane projected on the principal axis of their motion ({degrees:.1f}° from x); "
        f"they stray {1000 * stray:.3g} mm rms from it."
    )
    return np.where(known, position, np.nan), note
