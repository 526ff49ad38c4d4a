"""Where growth ends though something flies on, and why a motion ended, in words.

A payload in free flight leaves background behind it; film stays. A motion ends when the whole vine has grown, when an
obstacle stops it, or when the recording ends.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from vinetrack.core.records import Floats
from vinetrack.video.order_kernels import mean_changes
from vinetrack.video.point_quality import PointQuality
from vinetrack.video.strip import Strip

if TYPE_CHECKING:
    from vinetrack.video.body import BodyEnd

GROWN_TOLERANCE = 0.03  # Relative difference of travel and length within which the whole vine has grown (chosen)
FEWEST_STILL_FRAMES = 4  # Fewest frames of standstill at the end that are reported (chosen)
# Change of the pictures after the stop, as a part of that in motion, above which the picture goes on changing (chosen)
CHANGING_PART = 0.3

BARE_PART = 0.2  # Share of the film's median difference from the background (chosen)
SHORTEST_BARE_PX = 10  # Fewest columns in a row that must show background again (chosen)
# Parts of the columns passed, from the first, in at least one of which film is the majority (derived)
FILM_PARTS = (0.7, 0.35, 0.175)
FLIGHT_SPEED_RATIO = 1.35  # Ratio of the speeds after and before, below which the motion is still growth (chosen)


def is_grown(edge_px: Floats, quality: PointQuality, length_px: float) -> bool:
    """Whether the edge stops where the whole vine has grown; False where its length or its rest is unknown. Shapes:
    edge_px (n_frames,).
    """
    if quality.last_moving < 0 or not np.isfinite(length_px):
        return False
    start, end = edge_px[: quality.first_moving], edge_px[quality.last_moving + 1 :]
    if not (np.isfinite(start).any() and np.isfinite(end).any()):
        return False
    return bool(abs((np.nanmedian(end) - np.nanmedian(start)) / length_px - 1) < GROWN_TOLERANCE)


def body_end_note(end: BodyEnd, number: NDArray[np.int_]) -> str:
    """Say why a body is not followed to the end of the recording. Shapes: number (n_frames,)."""
    frame = number[end.last_frame]
    if end.turns_back:
        return f"the body turns back after frame {frame}: a bounce, or the end of its motion; later frames are not used"
    return f"the body is not recognised after frame {frame}: it is gone, hidden or turned over"


def growth_end_notes(
    luma: NDArray[Any], quality: PointQuality, edge_px: Floats, name: str, number: NDArray[np.int_]
) -> list[str]:
    """Say why the edge stops before the recording does. Shapes: luma (n_frames, height, width); edge_px, number
    (n_frames,).
    """
    n, last = len(edge_px), quality.last_moving
    if last < 0 or last >= n - FEWEST_STILL_FRAMES or quality.left_picture is not None:
        return []
    change = mean_changes(luma, 5)
    before = float(np.median(change[quality.first_moving : last])) if last > quality.first_moving else 0.0
    least = float(np.min(change)) if len(change) else 0.0
    later = float(np.median(change[last + 1 :]))
    resting = edge_px[last + 1 :][np.isfinite(edge_px[last + 1 :])]
    if not resting.size:
        return [f"{name}: the leading edge is not seen after frame {number[last]}"]
    where = f"{name}: the leading edge stops at {np.median(resting):.0f} px after frame {number[last]}"
    if later - least > CHANGING_PART * (before - least):
        return [f"{where} while the picture goes on changing: it met a wall or another obstacle, or left the axis"]
    return [f"{where}, {n - 1 - last} frames before the recording ends: grown to its end, or held"]


def truncation_notes(edge_px: Floats, quality: PointQuality, length_px: float, name: str) -> list[str]:
    """Say that the recording ends while the edge is moving. Shapes: edge_px (n_frames,)."""
    followed = np.flatnonzero(np.isfinite(edge_px))
    if quality.last_moving < followed[-1] or quality.left_picture is not None:
        return []
    travel_px = edge_px[followed[-1]] - float(np.median(edge_px[followed][: max(quality.first_moving, 1)]))
    share = f", after {travel_px / length_px:.0%} of the vine's length" if np.isfinite(length_px) else ""
    return [f"{name}: the recording ends while the leading edge moves{share}"]


def growth_end(strip: Strip, path: Floats, passed: tuple[int, int]) -> int:
    """Column at which the film ends although something moves on; the end of `passed` where nothing does. Going
    backwards from the last column passed: first the flying object (no longer than the tube is wide), then columns that
    look as they did before anything came, then film. Shapes: path (n_frames,).
    """
    columns, frames = np.arange(passed[0], passed[1]), len(path)
    if len(columns) < 5 * SHORTEST_BARE_PX or frames < 8:
        return passed[1]
    arrival = np.clip(np.searchsorted(path, columns + 0.5), 0, frames - 1)
    difference = _lasting_change(strip, columns, arrival)
    film_difference = max(float(np.median(difference[: int(part * len(difference))])) for part in FILM_PARTS)
    is_bare = difference < BARE_PART * film_difference
    bare_from = _first_bare_column(is_bare, strip.values.shape[1])
    if bare_from < 3 * SHORTEST_BARE_PX or is_bare[bare_from - 2 * SHORTEST_BARE_PX : bare_from].mean() > 0.3:
        return passed[1]
    growth = _speed(arrival, bare_from - 6 * SHORTEST_BARE_PX, bare_from - 5)
    flight = _speed(arrival, bare_from + 2, len(columns))
    # An object that comes out is ahead of the film at once by its own length, however slowly it then flies.
    exit_frame = int(arrival[bare_from])
    leap = float(np.diff(path)[max(exit_frame - 2, 0) : exit_frame + 2].max(initial=0.0))
    leaps = leap > max(FLIGHT_SPEED_RATIO * growth, growth + SHORTEST_BARE_PX / 2)
    flies_on = flight > FLIGHT_SPEED_RATIO * growth or leaps
    return int(columns[bare_from]) + 1 if flies_on else passed[1]


def _first_bare_column(is_bare: NDArray[np.bool_], longest: int) -> int:
    """First of SHORTEST_BARE_PX or more bare columns in a row, with at most `longest` after it that are not bare."""
    film_after = np.cumsum(~is_bare[::-1])[::-1]
    runs = np.convolve(is_bare, np.ones(SHORTEST_BARE_PX), mode="full")[SHORTEST_BARE_PX - 1 :] > SHORTEST_BARE_PX - 0.5
    starts = np.flatnonzero(runs & (film_after <= longest))
    return int(starts[0]) if len(starts) else 0


def _speed(arrival: NDArray[np.int_], first: int, last: int) -> float:
    """Mean speed between two columns, columns a frame."""
    first, last = max(first, 0), min(last, len(arrival)) - 1
    return (last - first) / max(float(arrival[last] - arrival[first]), 0.5)


def _lasting_change(strip: Strip, columns: NDArray[np.int_], arrival: NDArray[np.int_]) -> Floats:
    """Mean square over the rows of the last minus the first looks at each column, (n_columns,), averaged over 5."""
    last = _mean(strip, slice(len(strip.values) - 2, len(strip.values)), columns)
    out = np.zeros(len(columns))
    for when in np.unique(arrival):
        those = arrival == when
        before = _mean(strip, slice(max(int(when) - 8, 0), max(int(when) - 2, 1)), columns[those])
        out[those] = np.mean((last[:, those] - before) ** 2, axis=0)
    noise = strip.noise**2 * (0.5 + 0.2)
    return np.convolve(np.clip(out - noise, 0, None), np.ones(5) / 5, mode="same")


def _mean(strip: Strip, frames: slice, columns: NDArray[np.int_]) -> NDArray[np.float32]:
    """Mean brightness of some columns over some frames, shape (n_across, n_columns)."""
    values = strip.values[frames][:, :, columns].astype(np.float32)
    level = values * strip.scale[frames, None, None] + strip.offset[frames, None, None]
    return np.asarray(level.mean(axis=0), dtype=np.float32)
