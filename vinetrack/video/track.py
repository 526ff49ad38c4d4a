"""Track one recording: find the growth axis, cut the strip along it, follow edge or body, assess each point."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vinetrack.core.records import Bools, Floats, Indices, Track, Trial, join_flags
from vinetrack.tracks.frame_timing import correct_frames
from vinetrack.tracks.importers import FEWEST_POINTS
from vinetrack.tracks.position_noise import rest_points, rough_noise, turning_point
from vinetrack.video.axis import (
    END_FRAMES,
    Axis,
    SmallPictures,
    axis_problem,
    busy_frames,
    centred_on_motion,
    column_after_leap,
    dividing_path,
    find_axis,
    find_growth_axis,
    read_event,
)
from vinetrack.video.calibration import corrected_by_hand
from vinetrack.video.edge import EdgeTracker
from vinetrack.video.frames import Frames, RecordingError, inspect_recording, odd_frames
from vinetrack.video.images import capture_exposure, capture_rate
from vinetrack.video.strip import SLOW_PX, Look, Positions, Tracker, calibrated_sigma, cut_strip

# ------------------------------------------------------------------------------
# Follow what moves along an axis, by frame. A body that moves as a whole (travel ratio 1): by registering it against
# itself along the axis.
#
# The body leaves background behind it, perhaps dark on dark, so that there is no film to compare with. A template is
# cut where the body is most clearly visible, found in every frame by correlation, to a fraction of a pixel by the
# enhanced correlation coefficient, which ignores gain and level (Evangelidis & Psarakis, IEEE TPAMI 30, 1858, 2008),
# and replaced by the median of the patches found. The reported point is fixed on the body.

SEARCH_ACROSS_PX = 8  # Distance across the axis by which the body may deviate in the search (chosen)
LEAST_MATCH = 0.6  # Correlation with the template below which the patch found is not the body (chosen)


class BodyTracker(Tracker):
    """Registers what moves along an axis against itself; None where the travel ratio says that a tube everts."""

    def follow(self, look: Look) -> Positions | None:
        """See `Tracker`."""
        if look.travel_ratio != 1:
            return None
        strip = cut_strip(look.luma, look.axis, 0.75 * look.axis.width_px + 12)
        pictures = strip.brightness()
        path, half = _coarse_path(pictures, strip.noise, _near(pictures.shape[1], strip.axis.width_px))
        half = max(half, round(0.75 * strip.axis.width_px))  # as long as it is wide; a glint on it is shorter
        if np.ptp(path) < 3:
            raise RecordingError("nothing moves along the axis")
        # Cut near the middle of the frames in which the whole body is inside and moving
        whole = np.flatnonzero((path > 1.3 * half) & (path < pictures.shape[2] - 1 - 1.3 * half))
        moving = [i for i in whole if 0 < i < len(path) - 1 and path[i + 1] > path[i - 1]]
        chosen = moving or whole.tolist() or [*range(len(path))]
        template_frame = int(chosen[len(chosen) // 2])
        template = _patch(pictures[template_frame], path[template_frame], 0.0, half)
        mask = np.broadcast_to(_near(len(template), strip.axis.width_px), template.shape).astype(np.uint8)
        place, error, match = _registered(pictures, template, mask, _searched(pictures, template, path))
        # 3: times that the template is replaced by the median of the patches found (chosen)
        for _ in range(3):
            template = _median_template(pictures, place, match, half)
            place, error, match = _registered(pictures, template, mask, place)
        inside = (place[:, 0] > 0.6 * half) & (place[:, 0] < pictures.shape[2] - 1 - 0.6 * half)
        off_axis = np.abs(place[:, 1]) > 0.75 * SEARCH_ACROSS_PX
        unseen, end = (match < LEAST_MATCH) | off_axis, None
        recognised = np.flatnonzero(~unseen)
        if len(recognised) >= 3:
            # 3.0, 6.0: distance behind its furthest place where a body has turned back, px and standard errors (chosen)
            back_px = np.maximum(3.0, 6.0 * error[recognised])
            turned = turning_point(place[recognised, 0], back_px)
            last = int(recognised[-1 if turned is None else turned])
            unseen |= np.arange(len(unseen)) > last
            end = None if turned is None else last
        found = np.flatnonzero(~unseen)
        # 0.5: part of the frames, from the first to the last in which it is seen, that must show a body (chosen)
        hardly_seen = len(found) > 0 and len(found) < 0.5 * (1 + np.ptp(found))
        if hardly_seen or hops_between_bodies(place[:, 0], ~unseen):
            raise RecordingError(
                "what is followed hops between several bodies that move along the axis: give the axis, with a smaller "
                "width"
            )
        edge = np.where(unseen, np.nan, place[:, 0])
        return Positions(
            strip=strip, edge_px=edge, sigma_px=calibrated_sigma(edge, error),
            unsure=~inside, reach_px=float(half), slow_px=SLOW_PX, end=end,
            exposure_frames=look.exposure_frames,
        )  # fmt: skip


def hops_between_bodies(along: Floats, seen: Bools) -> bool:
    """Whether places scatter about any smooth motion by as much as they advance. Shapes: along, seen (n_frames,)."""
    places = along[seen & np.isfinite(along)]
    # 3.0, 0.5, 9: scatter of single places, in px and in steps of a frame, above which what is followed is not one
    # body; and the fewest places from which it is estimated (chosen)
    return len(places) >= 9 and rough_noise(places) > max(3.0, 0.5 * float(np.median(np.abs(np.diff(places)))))


def _near(rows: int, width_px: float) -> Bools:
    """Rows within the body's width and 2 px (chosen) beside it, where no neighbour moves, shape (n_rows, 1)."""
    return ~(np.abs(np.arange(rows) - (rows - 1) / 2) > width_px / 2 + 2.0)[:, None]


def _coarse_path(pictures: NDArray[np.float32], noise: float, near: Bools) -> tuple[Floats, int]:
    """Centre of the body by frame, to a few pixels, and half its length along the axis. The background is the median
    over frames spread evenly over the changes, so that a body that rests for long does not become part of it.
    """
    background = np.median(busy_frames(pictures, 41), axis=0)
    foreground = (near * np.clip(np.abs(pictures - background) - 3 * noise, 0, 60)).sum(axis=1)
    # Half the length of what differs from the background, from the width of its autocorrelation along the axis
    clearest = foreground[np.argsort(foreground.sum(axis=1))[len(pictures) // 2 :]]
    clearest = clearest - clearest.mean(axis=1, keepdims=True)
    columns = foreground.shape[1]
    spectrum = np.abs(np.fft.rfft(clearest, n=2 * columns, axis=1)) ** 2
    correlation = np.fft.irfft(spectrum.mean(axis=0))[: columns // 3]
    below = np.flatnonzero(correlation < 0.35 * correlation[0])
    width = int(below[0]) if len(below) else columns // 6
    half = int(np.clip(0.8 * width, 6, columns // 5))
    box = np.ones(2 * half + 1)
    score = np.stack([np.convolve(row, box, mode="same") for row in foreground])
    # The path that collects most score without a step back divides minus the slope of the score.
    return dividing_path(-np.diff(score, axis=1, prepend=0.0)) - 1, half


def _patch(picture: NDArray[np.float32], along: float, across: float, half: int) -> NDArray[np.float32]:
    """Patch of 2 half + 1 columns about (along, across), all rows but SEARCH_ACROSS_PX on each side, bicubic."""
    import cv2

    rows, middle = picture.shape[0] - 2 * SEARCH_ACROSS_PX, (picture.shape[0] - 1) / 2 + float(across)
    matrix = np.array([[1.0, 0.0, float(along) - half], [0.0, 1.0, middle - (rows - 1) / 2]])
    flags = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
    patch = cv2.warpAffine(picture, matrix, (2 * half + 1, rows), flags=flags, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(patch)


def _searched(pictures: NDArray[np.float32], template: NDArray[np.float32], path: Floats) -> Floats:
    """Place of the best normalised correlation near a path, in whole pixels along and across, (n, 2)."""
    import cv2

    half, place = template.shape[1] // 2, np.zeros((len(path), 2))
    reach = half + 14 + half // 2  # 14: distance along the axis searched about the expected place (chosen)
    for t, picture in enumerate(pictures):
        low = int(np.clip(path[t] - reach, 0, max(picture.shape[1] - 2 * half - 1, 0)))
        score = cv2.matchTemplate(picture[:, low : low + 2 * reach + 1].copy(), template, cv2.TM_CCOEFF_NORMED)
        row, column = np.unravel_index(int(np.argmax(score)), score.shape)
        place[t] = low + column + half, row - SEARCH_ACROSS_PX
    return place


def _registered(
    pictures: NDArray[np.float32], template: NDArray[np.float32], mask: NDArray[np.uint8], place: Floats
) -> tuple[Floats, Floats, Floats]:
    """Place (n, 2) along and across, its error along (n,) and correlation (n,) in every frame."""
    import cv2

    place, match, half = place.copy(), np.full(len(place), 0.01), template.shape[1] // 2
    until = cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 30, 1e-5
    for t, picture in enumerate(pictures):
        whole = np.rint(place[t])
        patch = _patch(picture, whole[0], whole[1], half)  # not interpolated
        with contextlib.suppress(cv2.error):  # where nothing is alike
            found, warp = cv2.findTransformECC(
                patch, template, np.eye(2, 3, dtype=np.float32), cv2.MOTION_TRANSLATION, until, mask, 1
            )
            match[t], place[t] = np.clip(found, 0.01, 1.0), whole - warp[:, 2]
    seen = mask > 0
    slope = np.linalg.norm(np.gradient(template, axis=1)[seen])
    return place, np.std(template[seen]) * np.sqrt(match**-2 - 1) / slope, match


def _median_template(pictures: NDArray[np.float32], place: Floats, match: Floats, half: int) -> NDArray[np.float32]:
    """Median of the patches found, each of unit variance."""
    whole = (place[:, 0] > 1.1 * half) & (place[:, 0] < pictures.shape[2] - 1 - 1.1 * half)
    good = np.flatnonzero(whole & (match >= LEAST_MATCH))
    if len(good) < 3:
        good = np.argsort(match)[-3:]
    good = good[np.unique(np.linspace(0, len(good) - 1, min(len(good), 60)).astype(int))]
    stack = np.stack([_patch(pictures[t], place[t, 0], place[t, 1], half) for t in good])
    stack -= stack.mean(axis=(1, 2), keepdims=True)
    return np.median(stack / stack.std(axis=(1, 2), keepdims=True), axis=0).astype(np.float32)


# ------------------------------------------------------------------------------
# Any other: the arrival of whatever comes. And the choice between the trackers.


class ArrivalTracker(Tracker):
    """Follows the tip of a vine that bends, sweeps or slides along walls, to about a pixel, as the column up to which
    the scene has changed: its film does not stay in place, so that another tracker would follow the sweep.
    """

    def follow(self, look: Look) -> Positions:
        """See `Tracker`."""
        width_px = min(4 * look.axis.width_px, 0.3 * max(look.luma.shape[1:]))
        strip = cut_strip(look.luma, look.axis, width_px)
        values = strip.brightness()
        # 4.0: change, in units of the noise, that counts, and rows of a column that must have changed (chosen)
        changed = np.abs(values - np.median(values[:END_FRAMES], axis=0)) > 4.0 * max(strip.noise, 3.0)
        path = dividing_path((4.0 - changed.sum(axis=1)).astype(np.float32))
        edge = np.maximum(path, column_after_leap(path)) - 0.5
        smoothed = np.convolve(np.pad(edge, 2, mode="edge"), np.ones(5) / 5, mode="valid")
        # 0.8, 1.0: random error before it is scaled to the roughness, and slow error, of an arrival (measured)
        return Positions(
            strip=strip, edge_px=smoothed, sigma_px=calibrated_sigma(smoothed, np.full(len(edge), 0.8)),
            unsure=np.zeros(len(edge), dtype=bool), reach_px=2.0, slow_px=1.0, exposure_frames=look.exposure_frames,
            is_edge=False,
        )  # fmt: skip


NO_GROWTH = (
    "see whether it shows this vine grow, four times as far from its background as a pixel's noise, name the right "
    "recording, or state the growth axis, base first, or by frames_used where it grows and does not draw back"
)

# Asked in turn: the first that knows what moves follows it; the others return None.
TRACKERS: list[Tracker] = [BodyTracker(), EdgeTracker(), ArrivalTracker()]


def follow(look: Look) -> Positions:
    """Follow what moves along an axis by the first tracker that knows it."""
    try:
        return next(found for tracker in TRACKERS if (found := tracker.follow(look)) is not None)
    except RecordingError:
        raise
    except ValueError as error:
        raise RecordingError(str(error)) from error


# ------------------------------------------------------------------------------
# Select the frames of a damaged recording that are tracked: the longest undamaged stretch.
#
# What a decoder makes of a damaged frame looks like a picture and may be tracked, with small stated errors, to a
# wrong place; so may the frames after a hole in the motion. Neither is used until a person has placed the edge of
# such a frame (`corrections.csv`).

LONGEST_HOLE = 1  # Most frames missing in a row that the tracker bridges (measured)
LEAST_PART = 0.5  # Least part of the frames that must follow each other without damage (measured)


def sound_stretch(frames: Frames, allowed: Bools) -> Bools:
    """Frames to be tracked: all that are allowed where none is damaged, else the longest stretch without damage."""
    damaged = frames.damaged & allowed
    # Lost frames, within the recording or at its end, count as damage.
    span = 1 + int(np.ptp(frames.slot[allowed]))
    if allowed.all():
        span = max(span, (frames.recording.declared_frames or 0) - len(frames.slots) + len(frames))
    complete = span < allowed.sum() / LEAST_PART
    # 3: most frames missing in a row that a recorder may have dropped from an undamaged recording (chosen)
    if complete and not damaged.any() and np.max(np.diff(frames.slot[allowed]), initial=1) <= 3 + 1:
        return allowed
    sound = np.flatnonzero(allowed & ~damaged)
    breaks = np.flatnonzero(np.diff(frames.slot[sound]) > LONGEST_HOLE + 1) + 1
    longest = max(np.split(sound, breaks), key=len)
    if len(longest) < LEAST_PART * span:
        where = f", {longest[0]} to {longest[-1]}," if len(longest) else ""
        count = int(damaged.sum())
        problem = f"{count} of {int(allowed.sum())} frames are damaged" if count else "frames are missing"
        raise RecordingError(
            f"{problem} and only {len(longest)}{where} follow each other without damage",
            "copy it from the camera again, or name sound ones in frames_used",
            frames.recording.path.name,
        )
    mask = np.zeros(len(frames), dtype=bool)
    mask[longest] = True
    return mask


def too_few(frames: int) -> str:
    """Say that a recording, or a picture taken for one, has too few frames."""
    what = "holds a single picture" if frames == 1 else f"has {frames} frames"
    return f"{what}; a track needs at least {FEWEST_POINTS} frames"


# ------------------------------------------------------------------------------
# Quality of each point, from positions alone, in pixels by frame: release, end, lost and doubtful points.

LOST_SIGMA_PX = 4.0  # A point with a larger standard error counts as lost (chosen)

REST_SIGMAS, REST_PX = 3.0, 0.25  # An edge is at rest while it stays this near to its level (chosen)


@dataclass(frozen=True)
class PointQuality:
    """Flag of every frame, and sentences for a person. `flag` and `without_edge` have shape (n_frames,)."""

    flag: NDArray[np.str_]
    notes: tuple[str, ...]
    first_moving: int
    last_moving: int
    left_picture: int | None
    without_edge: Bools


def moving_range(edge_px: Floats, sigma_px: Floats) -> tuple[int, int]:
    """First and last moving frame; (0, n − 1) if the edge never rests, (n, −1) if it never moves. At rest means: over
    three frames or more, within three standard errors of the resting level, or REST_PX, so that a creeping stop shows.
    """
    good = np.flatnonzero(np.isfinite(edge_px))
    n = len(edge_px)
    if len(good) < 3:
        return n, -1
    y, noise = edge_px[good], float(np.nanmedian(sigma_px[good]))
    low, high = float(np.median(y[:3])), float(np.median(y[-3:]))
    # 2.0: least travel that counts as motion (chosen)
    if high - low < max(2 * REST_SIGMAS * noise, 2.0):
        return n, -1
    tolerance = max(REST_SIGMAS * noise, REST_PX)
    first = _first_moving_point(y, tolerance)
    last = len(y) - 1 - _first_moving_point(-y[::-1], tolerance)
    steps = np.diff(y[-7:])
    # 5.0: ratio of the steps to the tolerance above which a fast edge that stands still in the last two frames stops,
    # though elsewhere two equal positions are no rest (chosen); the step before may be shorter than a whole one
    if last == len(y) - 1 and len(steps) == 6 and abs(steps[-1]) <= tolerance < steps[:-2].min() / 5.0:
        last -= 2
    return int(good[first]), int(good[max(last, first)])


def _first_moving_point(y: Floats, tolerance: float) -> int:
    """First of two points in a row above the resting level, which has three; 0 where the track starts in motion."""
    above = y - np.median(y[: max(rest_points(y), 3)]) > tolerance
    first = int(np.argmax(np.append(above & np.append(above[1:], True), True)))
    return first if first > 2 else 0


def assess_points(edge_px: Floats, sigma_px: Floats, number: Indices, *, unsure: Bools, end_px: float) -> PointQuality:
    """Flag every frame. Arrays have shape (n_frames,)."""
    n = len(edge_px)
    no_edge = ~np.isfinite(edge_px) | ~(sigma_px < LOST_SIGMA_PX)
    outside = np.flatnonzero(np.isfinite(edge_px) & (edge_px >= end_px))
    first_outside = int(outside[0]) if len(outside) else n
    y = np.where(no_edge | (np.arange(n) >= first_outside), np.nan, edge_px)
    first, last = moving_range(y, sigma_px)
    notes = []
    if first_outside < n:
        notes.append(f"the leading edge leaves the picture at frame {number[first_outside]}; later frames are not used")
    without_edge = no_edge & (np.arange(n) < first_outside)
    flags = [
        join_flags(
            "before_release" if i < first else "",
            "after_end" if i > last >= 0 or i >= first_outside else "",
            "lost" if without_edge[i] else "",
            "doubtful" if unsure[i] and not no_edge[i] else "",
        )
        for i in range(n)
    ]
    lost_in_motion = no_edge & (np.arange(n) >= first) & (np.arange(n) <= last)
    if lost_in_motion.any():
        count, first_lost = int(lost_in_motion.sum()), number[lost_in_motion][0]
        notes.append(f"moving frames in which the leading edge is lost: {count}, the first {first_lost}")
    return PointQuality(
        np.array(flags, dtype=np.str_), tuple(notes), first, last,
        first_outside if first_outside < n else None, without_edge,
    )  # fmt: skip


# ------------------------------------------------------------------------------
# Where growth ends though something flies on, and why a motion ended, in words.
#
# A payload in free flight leaves background behind it; film stays. A motion ends when the whole vine has grown, when
# an obstacle stops it, or when the recording ends.


@dataclass(frozen=True)
class Ending:
    """How an edge ends: its way to standstill, or to the last frame if it still moves, px or NaN; where it stops."""

    grown_px: float = math.nan
    truncated_px: float = math.nan
    remark: str = ""
    name: str = ""

    def notes(self, length_px: float) -> list[str]:
        """What a track is told about its end; nothing where most of the vine has grown."""
        # 0.9: most of the length in the sheet, which may count what is clamped; 1.03: more than the vine has (chosen)
        if 0.9 < np.fmax(self.grown_px, self.truncated_px) / length_px < 1.03:
            return []
        share = f", after {self.truncated_px / length_px:.0%} of the vine's length" if np.isfinite(length_px) else ""
        moves = f"{self.name}: the recording ends while the leading edge moves{share}"
        return [note for note in (self.remark, moves if np.isfinite(self.truncated_px) else "") if note]


def ending_of(quality: PointQuality, edge_px: Floats, name: str, number: Indices, whole: bool) -> Ending:
    """How an edge that moved ends; only a `whole` recording can be truncated. Shapes: edge_px, number (n_frames,)."""
    start, end = edge_px[: quality.first_moving], edge_px[quality.last_moving + 1 :]
    both = np.isfinite(start).any() and np.isfinite(end).any()
    grown_px, truncated_px = float(np.nanmedian(end) - np.nanmedian(start)) if both else math.nan, math.nan
    followed = np.flatnonzero(np.isfinite(edge_px))
    if whole and quality.last_moving >= followed[-1] and quality.left_picture is None:
        at_first = np.median(edge_px[followed][: max(quality.first_moving, 1)])
        truncated_px = float(edge_px[followed[-1]]) - float(at_first)
    remark, n, last = "", len(edge_px), quality.last_moving
    # 4: fewest frames of standstill at the end that are reported (chosen)
    if 0 <= last < n - 4 and quality.left_picture is None:
        resting = edge_px[last + 1 :][np.isfinite(edge_px[last + 1 :])]
        where = f"stops at {np.median(resting):.0f} px" if resting.size else "is not seen"
        why = f"{n - 1 - last} frames before the recording ends: grown to its end, held, or off the axis"
        remark = f"{name}: the leading edge {where} after frame {number[last]}, {why}"
    return Ending(grown_px, truncated_px, remark, name)


# ------------------------------------------------------------------------------
# The track of a recording: its frames, its axis, what moves along it, in pixels and in metres.

STABILISED_PX = 0.05  # Error left after a shaken camera was stabilised on the still background (measured)


@dataclass(frozen=True)
class Tracking:
    """A track and what a figure of it needs. `kymograph`, shape (n_rows, n_along), is the strip's brightness averaged
    across, in grey levels; `strip_rows`, shape (n_rows,), are the frames of its rows. Column j lies `j` px from
    `axis.from_px`, and `edge_px` of the track counts from the same point.
    """

    track: Track
    axis: Axis
    kymograph: NDArray[np.uint8]
    strip_rows: Indices
    pictures: tuple[tuple[int, NDArray[Any]], ...]
    exposure_frames: float
    shake_px: Floats
    tube_width_px: float = math.nan
    tube_width_sigma_px: float = math.nan
    seen_exposure_frames: float = math.nan
    fast_px_per_frame: float = math.nan
    ending: Ending = field(default_factory=Ending)


def track_recording(trial: Trial, axis: Axis | None = None) -> Tracking:
    """Track the leading edge of one recording, or the body where the travel ratio is 1, by the trial's own scale."""
    recording = inspect_recording(trial.video or Path())
    frames = read_event(recording, trial.frames_used)
    return track_frames(frames, trial, capture_rate(trial, recording), axis)


def track_frames(frames: Frames, trial: Trial, capture_fps: float, axis: Axis | None = None) -> Tracking:
    """Track frames that are already in memory; see `track_recording`."""
    tracking = track_pixels(frames, trial, capture_fps, axis, trial.diameter_m / trial.m_per_px)
    return in_metres(tracking, trial, trial.m_per_px)


def track_pixels(
    frames: Frames, trial: Trial, capture_fps: float, axis: Axis | None, diameter_px: float = math.nan
) -> Tracking:
    """Track frames in pixels: the part of a tracking that neither the scale nor the sizes in the sheet change, but for
    the width of a given axis. Errors are in px, positions in metres NaN; `in_metres` gives them.
    """
    name = frames.recording.path.name
    exposure_s = capture_exposure(trial, frames.recording)
    rows, left_out = _select_frames(frames, trial)
    number = frames.first + rows
    luma = frames.luma if len(rows) == len(frames) else frames.luma[rows]
    axis_given = axis is not None
    try:
        small = SmallPictures(luma)
        axis = locate_axis(small, axis, trial, diameter_px)
        followed = follow(Look(luma, axis, small, trial.travel_ratio, exposure_s * capture_fps))
    except RecordingError as error:
        raise RecordingError(error.what, error.remedy or NO_GROWTH, name) from error
    strip, random_px = followed.strip, followed.sigma_px
    # 0.04: slow error of a position along a curve, for each radian by which the curve turns (measured)
    shared_px = STABILISED_PX if strip.stabilised else 0.0, 0.04 * strip.axis.total_turn_rad
    slow_px = np.hypot(np.broadcast_to(followed.slow_px, random_px.shape), np.hypot(*shared_px))
    total_px = np.hypot(random_px, slow_px)
    end_px = strip.axis.length_px - followed.reach_px
    quality = assess_points(followed.edge_px, total_px, number, unsure=followed.unsure, end_px=end_px)
    if quality.last_moving < 0:
        # 0.5: fraction of frames without an edge above which it is too vague, not at rest (chosen)
        if np.mean(~(total_px < LOST_SIGMA_PX)) > 0.5:
            what = "something moves, but its edge is too vague to be followed"
            remedy = "film it nearer, with more light or contrast, or at more frames a second, or state the growth axis"
            raise RecordingError(what, remedy, name)
        raise RecordingError("nothing moves along the axis", NO_GROWTH, name)
    errors_px = np.minimum(random_px, LOST_SIGMA_PX), np.minimum(slow_px, LOST_SIGMA_PX)
    notes, ending = _notes(frames, number, trial, followed, quality, axis_given)
    notes += left_out
    track = _assemble(frames, rows, followed, errors_px, quality, capture_fps, exposure_s, notes)
    shown = [quality.first_moving, (quality.first_moving + quality.last_moving) // 2, quality.last_moving]
    pictures = tuple((int(number[i]), luma[i].copy()) for i in shown)
    mean = strip.values.mean(axis=1, dtype=np.float32) * strip.scale[:, None] + strip.offset[:, None]
    kymograph = np.clip(np.rint(mean), 0, 255).astype(np.uint8)
    shake_px = np.zeros(len(frames.slots))
    seen_px = np.where(np.isfinite(followed.edge_px), followed.edge_px, 0.5 * strip.axis.length_px)
    shake_px[number] = np.sum(strip.shift_px * strip.axis.direction_at(seen_px), axis=1)
    return Tracking(
        track, strip.axis, kymograph, number, pictures, followed.exposure_frames, shake_px,
        followed.width_px, followed.width_sigma_px, followed.seen_exposure_frames, followed.fast_px_per_frame, ending,
    )  # fmt: skip


def _select_frames(frames: Frames, trial: Trial) -> tuple[Indices, list[str]]:
    """Rows of the decoded frames to track: allowed, undamaged, not odd at either end; and notes on the others."""
    name = frames.recording.path.name
    if len(frames) < FEWEST_POINTS:
        raise RecordingError(too_few(len(frames)), "name a film or a folder of pictures", name)
    odd = odd_frames(frames.luma)
    first, last = trial.frames_used or (0, len(frames.slots) - 1)
    number = frames.first + np.arange(len(frames))
    allowed: Bools = (number >= first) & (number <= last)
    if allowed.sum() < FEWEST_POINTS:
        raise RecordingError(f"frames_used leaves {int(allowed.sum())} of {len(frames)} frames", "widen it", name)
    sound = sound_stretch(frames, allowed)
    odd &= sound
    rows = np.flatnonzero(sound & ~odd)
    notes = []
    if sound.sum() < allowed.sum():
        notes.append(
            f"{name}: {int(sound.sum())} of {len(frames)} frames are used, {number[rows[0]]} to {number[rows[-1]]}: "
            "damaged frames, and frames beyond damaged or missing ones, are not used until their edge is placed in "
            "corrections.csv"
        )
    if odd.any():
        first_odd = int(number[odd][0])
        notes.append(f"{name}: {int(odd.sum())} frames are unlike all others and rejected, first frame {first_odd}")
    return rows, notes


def _notes(
    frames: Frames, number: Indices, trial: Trial, followed: Positions, quality: PointQuality, axis_given: bool
) -> tuple[list[str], Ending]:
    """Sentences about the track: its points, its end and its axis; and how it ends."""
    name = frames.recording.path.name
    notes, ending = [*frames.notes, *quality.notes], Ending()
    if followed.end is not None:
        why = f"turns back after frame {number[followed.end]}: a bounce, or the end of its motion"
        notes.append(f"{name}: the body {why}; later frames are not used")
    else:
        whole = trial.travel_ratio == 2 and trial.frames_used is None and number[-1] == len(frames.slots) - 1
        ending = ending_of(quality, followed.edge_px, name, number, whole)
    axis = followed.strip.axis
    if axis.bends and not axis_given:
        notes.append(
            f"{name}: the vine bends by {np.degrees(axis.total_turn_rad):.0f}° in all, and positions are those "
            "along a curve that was found: look at its overlay, and draw the curve (column `axis`) if the edge is not "
            "on it"
        )
    if not followed.is_edge:
        notes.append(
            f"{name}: the vine bends or sweeps away from the axis; only how far along it its tip has come is followed, "
            "to about a pixel"
        )
    return notes, ending


def locate_axis(small: SmallPictures, axis: Axis | None, trial: Trial, diameter_px: float) -> Axis:
    """Find the growth axis, or give a known one a width and centre it on the motion."""
    if axis is None:
        return find_growth_axis(small) if trial.travel_ratio == 2 else find_axis(small, grows=False)
    # The width of the axis, else the sheet's diameter by the scale, else a fifth of the axis
    widths_px = (axis.width_px, diameter_px, 0.2 * axis.length_px)
    width_px = next(width for width in widths_px if np.isfinite(width))
    # A margin for an axis a few degrees off (derived); it is centred on the motion, here or by the tracker of tubes.
    wide_px = width_px + 0.08 * axis.length_px
    if axis.bends:
        width_known = np.isfinite(axis.width_px) or np.isfinite(diameter_px)
        if complaint := axis_problem(axis, width_px / 2 if width_known else math.nan, small.shape[::-1]):
            raise RecordingError(f"the growth axis {complaint[0]}", complaint[1])
        wide_px = min(wide_px, 2 * axis.largest_half_px)
        return replace(axis, width_px=max(wide_px, width_px) if width_known else wide_px)
    axis = replace(axis, width_px=wide_px)
    return centred_on_motion(small, axis) if trial.travel_ratio == 1 else axis


def _assemble(
    frames: Frames, rows: Indices, followed: Positions, errors_px: tuple[Floats, Floats], quality: PointQuality,
    capture_fps: float, exposure_s: float, notes: list[str],
) -> Track:  # fmt: skip
    """The track in pixels, a row for every frame; rejected and later frames have no position."""
    n, number = len(frames.slots), frames.first + rows
    edge, noise, slow = np.full((3, n), np.nan)
    flag = np.full(n, "rejected", dtype="<U64")
    # Frames before and after the event were not decoded, since nothing moves in them.
    flag[: frames.first] = "before_release"
    flag[number[-1] + 1 :] = "after_end"
    flag[frames.first + np.flatnonzero(frames.damaged)] = "rejected"
    edge[number] = np.where(quality.without_edge, np.nan, followed.edge_px)
    noise[number], slow[number] = np.where(quality.without_edge, np.nan, errors_px)
    flag[number] = quality.flag
    time = frames.slots / capture_fps + (exposure_s / 2 if np.isfinite(exposure_s) else 0.0)
    return Track(
        time, np.full(len(edge), np.nan), noise, flag.astype("<U64"), edge, notes=tuple(notes),
        lead_position_systematic_m=slow,
    )  # fmt: skip


def in_metres(
    tracking: Tracking, trial: Trial, m_per_px: float, position_m: Callable[[Floats], Floats] | None = None
) -> Tracking:
    """A tracking in pixels with hand corrections, positions and errors in metres, times corrected for dropped and
    inserted frames, and notes on its end where that is not the end of the vine. Shapes: position_m (n, 2).
    """
    notes = (*tracking.track.notes, *tracking.ending.notes(trial.length_m / m_per_px))
    track = corrected_by_hand(replace(tracking.track, notes=notes), trial.corrections)
    position = track.edge_px * m_per_px
    local_m_per_px: Floats | float = m_per_px
    if position_m is not None:
        finite, along = np.isfinite(track.edge_px), track.edge_px[np.isfinite(track.edge_px)]
        position, local_m_per_px = np.full((2, len(track.edge_px)), np.nan)
        if finite.any():
            points = tracking.axis.points
            position[finite] = position_m(points(along))
            local_m_per_px[finite] = np.abs(position_m(points(along + 0.5)) - position_m(points(along - 0.5)))
    slow_px = track.lead_position_systematic_m
    track = replace(
        track,
        lead_position_m=position,
        lead_position_sigma_m=track.lead_position_sigma_m * local_m_per_px,
        lead_position_systematic_m=None if slow_px is None else slow_px * local_m_per_px,
    )
    return replace(tracking, track=correct_frames(track))
