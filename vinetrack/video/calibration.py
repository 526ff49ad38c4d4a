"""Calibrate a recording: metres a pixel in the plane of growth, the error of that scale, and the place of
each pixel.

`calibrate` reads the settings: a ChArUco board or a checkerboard in a picture, a clip or the recording itself, held in
the plane in which the vine grows; two points and the distance between them; or the scale itself. The error of the scale
is one number for a whole recording, common to all its points, and kept apart from the random error of each.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vinetrack.core.records import Floats
from vinetrack.experiment.settings import Calibration, Charuco, Checkerboard, MmPerPx, TwoPoints
from vinetrack.video.axis import Axis
from vinetrack.video.curved_axis import CurvedAxis, length_along
from vinetrack.video.frames import RecordingError, inspect_recording, iterate_frames
from vinetrack.video.plane_map import PlaneMap, fit_planes
from vinetrack.video.target_corners import CornersError, charuco_corners, checkerboard_corners

CLICK_SIGMA_PX = 0.5  # Standard error of a point picked by hand in a picture
CORNER_BIAS_PX = 0.02  # Bias that the corners at one end of a target may share (chosen)
STATIONARY_PX = 0.5  # Motion of the corners over a clip above which the target was moved (chosen)
# Root mean square distance of the corners from the model above which the board is another one (chosen)
LARGEST_REPROJECTION_PX = 2.0

MOST_PICTURES_READ = 10  # Most pictures of a clip that are read (chosen)

# First frames of a recording in which a target is looked for, while nothing hides it yet (chosen)
SEARCHED_FRAMES = 300


CHORD_PX = 4.0  # Length of the chords over which a curve is summed in the plane (derived)


class CalibrationError(ValueError):
    """A calibration that cannot be made: what is wrong and what to do, in one sentence."""


@dataclass(frozen=True)
class AxisScale:
    """The calibration along one growth axis. `m_per_px` is the mean over the axis, `scale_rel_sigma` its relative
    standard error (NaN where unknown); `position_m` maps points of the picture (x, y), shape (n, 2), to metres along
    the axis from its start.
    """

    m_per_px: float
    scale_rel_sigma: float
    position_m: Callable[[Floats], Floats]


@dataclass(frozen=True)
class PlaneCalibration:
    """The result of a calibration. `m_per_px` and `scale_rel_sigma` hold across the middle of `covered_px` (left, top,
    right, bottom: the target's corners, or the whole picture without one), along the picture's longer side; `along`
    gives them for a growth axis.
    """

    kind: str
    plane: PlaneMap
    reprojection_px: float
    n_corners: int
    n_pictures: int
    own_rel_sigma: float
    covered_px: tuple[float, float, float, float]
    notes: tuple[str, ...] = ()

    @property
    def m_per_px(self) -> float:
        """Scale across the middle of what the target covers, m/px."""
        return self.along(*self._middle_line()).m_per_px

    @property
    def scale_rel_sigma(self) -> float:
        """Relative standard error of `m_per_px`; NaN where unknown."""
        return self.along(*self._middle_line()).scale_rel_sigma

    def plane_m(self, picture_px: Floats) -> Floats:
        """Map points of the picture to the plane of growth. Shapes: picture_px (..., 2) → (..., 2)."""
        return self.plane.plane_m(picture_px)

    def along(self, from_px: Sequence[float], to_px: Sequence[float]) -> AxisScale:
        """Return scale and position along an axis of the picture. Shape (n, 2)."""
        start_px, end_px = np.asarray(from_px, dtype=float), np.asarray(to_px, dtype=float)
        start_m, end_m = self.plane.plane_m(np.stack([start_px, end_px]))
        length_m = float(np.linalg.norm(end_m - start_m))
        direction = (end_m - start_m) / length_m

        def position_m(picture_px: Floats) -> Floats:
            return np.asarray((self.plane.plane_m(picture_px) - start_m) @ direction)

        m_per_px = length_m / float(np.linalg.norm(end_px - start_px))
        rel_sigma = math.hypot(self.plane.length_rel_sigma(start_px, end_px), self.own_rel_sigma)
        return AxisScale(m_per_px, rel_sigma, position_m)

    def along_path(self, axis: Axis, off_px: float = 0.0) -> AxisScale:
        """Return the scale along an axis that may be a curve: of the arc length in the plane, not of its chord."""
        if not isinstance(axis, CurvedAxis):
            return self.along(axis.from_px, axis.to_px)
        along_px = np.linspace(0.0, axis.length_px, int(axis.length_px / CHORD_PX) + 2)
        places_px = axis.points(along_px)
        path_m = length_along(self.plane.plane_m(places_px))
        rel_sigma = math.hypot(self.plane.path_rel_sigma(places_px), self.own_rel_sigma)
        rel_sigma = math.hypot(rel_sigma, off_px * abs(axis.turn_rad) / axis.length_px)

        def position_m(picture_px: Floats) -> Floats:
            nearest = axis.nearest_px(picture_px)
            return np.asarray(np.interp(nearest, along_px, path_m))

        return AxisScale(float(path_m[-1]) / axis.length_px, rel_sigma, position_m)

    def _middle_line(self) -> tuple[tuple[float, float], tuple[float, float]]:
        left, top, right, bottom = self.covered_px
        if self.plane.width_px >= self.plane.height_px:
            return (left, (top + bottom) / 2), (right, (top + bottom) / 2)
        return ((left + right) / 2, top), ((left + right) / 2, bottom)


def calibrate(settings: Calibration, folder: Path, width_px: int, height_px: int) -> PlaneCalibration:
    """Calibrate recordings of `width_px` × `height_px` as the experiment's settings say."""
    if isinstance(settings, MmPerPx):
        plane = PlaneMap.from_scale(settings.mm_per_px / 1000, width_px, height_px)
        note = "the scale is the one given as mm_per_px; nothing is known of its error, nor of distortion and tilt"
        return PlaneCalibration("mm_per_px", plane, math.nan, 0, 0, math.nan, _whole_picture(plane), (note,))
    if isinstance(settings, TwoPoints):
        return _from_two_points(settings, width_px, height_px)
    pictures = _target_pictures(folder / settings.image, settings.image)
    sizes_seen = {(picture.shape[1], picture.shape[0]) for picture in pictures}
    if sizes_seen != {(width_px, height_px)}:
        sizes = " and ".join(f"{width} × {height}" for width, height in sorted(sizes_seen))
        raise CalibrationError(
            f"{settings.image} is {sizes} pixels but the recordings are {width_px} × {height_px}; "
            "film the target with the camera's settings of the trials, without cropping or resizing"
        )
    return calibrate_pictures(pictures, settings)


def calibrate_pictures(pictures: Sequence[NDArray[Any]], board: Charuco | Checkerboard) -> PlaneCalibration:
    """Calibrate from pictures of a target, grey levels of shape (height, width) each. The corners of a stationary
    target are averaged. Of a target that is moved every picture gets its own plane but all share the lens, and the
    first readable one shows the plane of growth. Shapes: pictures (height, width).
    """
    views, complaints = [], []
    read = charuco_corners if isinstance(board, Charuco) else checkerboard_corners
    for picture in pictures:
        try:
            views.append(read(picture, board))  # type: ignore[arg-type]
        except CornersError as error:
            complaints.append(str(error))
    if not views:
        raise CalibrationError(f"{board.image}: {complaints[0]}")
    height, width = pictures[0].shape
    notes = [f"{board.image}: the target is read in {len(views)} of {len(pictures)} pictures"] if complaints else []
    moved_px = _target_motion_px(views)
    stationary = moved_px < STATIONARY_PX
    if not stationary:
        notes.append(
            f"{board.image}: the target moves by {moved_px:.1f} px; its first picture is taken for the plane of growth"
        )
    fit = fit_planes([_median_corners(views)] if stationary else views, width, height)
    if fit.reprojection_px > LARGEST_REPROJECTION_PX:
        raise CalibrationError(
            f"{board.image}: corners lie {fit.reprojection_px:.1f} px from where a flat board of {board.squares[0]} × "
            f"{board.squares[1]} squares has them; check `squares`, and that the board is flat"
        )
    corners_px = _median_corners(views)[0] if stationary else views[0][0]
    notes += _coverage_note(corners_px, width, height, board.image)
    bias_rel = CORNER_BIAS_PX * math.sqrt(2) / float(np.ptp(corners_px, axis=0).max())
    covered = (*corners_px.min(axis=0), *corners_px.max(axis=0))
    return PlaneCalibration(
        board.kind, fit.maps[0], fit.reprojection_px, len(corners_px), len(views), bias_rel, covered, tuple(notes)
    )


def _whole_picture(plane: PlaneMap) -> tuple[float, float, float, float]:
    return 0.0, 0.0, plane.width_px - 1.0, plane.height_px - 1.0


def _target_pictures(path: Path, name: str) -> list[NDArray[Any]]:
    """Up to MOST_PICTURES_READ grey pictures, spread over the first SEARCHED_FRAMES frames of a recording."""
    try:
        recording = inspect_recording(path)
        declared = recording.declared_frames or SEARCHED_FRAMES
        every = max(1, min(declared, SEARCHED_FRAMES) // MOST_PICTURES_READ)
        pictures = []
        for count, frame in enumerate(iterate_frames(recording)):
            if count % every == 0:
                pictures.append(frame)
            if len(pictures) == MOST_PICTURES_READ or count >= SEARCHED_FRAMES:
                break
    except RecordingError as error:
        raise CalibrationError(f"calibration: {error}") from error
    if not pictures:
        raise CalibrationError(f"calibration: {name} holds no picture that can be read; copy it from the camera again")
    return pictures


def _from_two_points(settings: TwoPoints, width_px: int, height_px: int) -> PlaneCalibration:
    """Scale from two points and the length between them; each point errs by CLICK_SIGMA_PX along the line."""
    distance_px = math.dist(settings.from_px, settings.to_px)
    plane = PlaneMap.from_scale(settings.length_mm / 1000 / distance_px, width_px, height_px)
    rel_sigma = math.sqrt(2) * CLICK_SIGMA_PX / distance_px
    note = (
        f"the scale rests on two points {distance_px:.0f} px apart, each good to {CLICK_SIGMA_PX} px, "
        "and on nothing else"
    )
    return PlaneCalibration("two_points", plane, math.nan, 2, 1, rel_sigma, _whole_picture(plane), (note,))


def _corners_by_place(view: tuple[Floats, Floats]) -> dict[tuple[float, float], Floats]:
    """Corners of a view by their place on the target, in micrometres."""
    return {(round(x * 1e6), round(y * 1e6)): corner for corner, (x, y) in zip(view[0], view[1], strict=True)}


def _target_motion_px(views: Sequence[tuple[Floats, Floats]]) -> float:
    """Motion of the target: the median, over corners, of the distance from the first view; the largest of all views."""
    first = _corners_by_place(views[0])
    largest = 0.0
    for view in views[1:]:
        places = _corners_by_place(view)
        shared = [place for place in first if place in places]
        if not shared:
            return math.inf
        distances = [float(np.linalg.norm(first[place] - places[place])) for place in shared]
        largest = max(largest, float(np.median(distances)))
    return largest


def _median_corners(views: Sequence[tuple[Floats, Floats]]) -> tuple[Floats, Floats]:
    """Corners of a stationary target: the median over the views that show each."""
    gathered: dict[tuple[float, float], list[Floats]] = {}
    for view in views:
        for place, corner in _corners_by_place(view).items():
            gathered.setdefault(place, []).append(corner)
    corners = np.array([np.median(seen, axis=0) for seen in gathered.values()])
    return corners, np.array(list(gathered)) * 1e-6


def _coverage_note(corners_px: Floats, width: int, height: int, name: str) -> list[str]:
    """Warn where the target spans less than half of the picture: beyond it scale and distortion are extrapolated."""
    longer = 0 if width >= height else 1
    share = float(np.ptp(corners_px[:, longer])) / max(width, height)
    if share >= 0.5:
        return []
    return [f"{name}: the target spans only {share:.0%} of the picture; fill it to know the scale everywhere"]
