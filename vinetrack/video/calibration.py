"""Calibrate a recording: metres a pixel in the plane of growth, the error of that scale, and the place of
each pixel.

`calibrate` reads the settings: a ChArUco board or a checkerboard in a picture, a clip or the recording itself, held in
the plane in which the vine grows; two points and the distance between them; or the scale itself. The error of the scale
is one number for a whole recording, common to all its points, and kept apart from the random error of each.
"""

from __future__ import annotations

import itertools
import math
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from vinetrack.core.records import Correction, Floats, Track, join_flags
from vinetrack.experiment.settings import Calibration, Charuco, Checkerboard, MmPerPx, TwoPoints
from vinetrack.video.axis import Axis, length_along
from vinetrack.video.frames import RecordingError, inspect_recording, iterate_frames
from vinetrack.video.strip import SLOW_PX

# ------------------------------------------------------------------------------
# Find the corners of calibration targets in a picture by OpenCV, to about 0.05 px, or say why there are none.

Grey = NDArray[np.uint8]

FEWEST_CORNERS = 8  # Fewest corners of a calibration (chosen)
LEAST_IN_PLACE = 0.8  # Least share of the markers that must lie where a board has them (chosen)
# Distance, in squares, from where the board has it beyond which a marker belongs to another board (chosen)
MARKER_OUTLIER = 0.3
DICTIONARY_SIZES = (50, 100, 250, 1000)  # Words in OpenCV's dictionaries of each marker size (defined)
OTHER_DICTIONARIES = (*(f"DICT_{n}X{n}" for n in (4, 5, 6, 7)), "DICT_ARUCO_ORIGINAL", "DICT_APRILTAG_36h11")


class CalibrationError(RecordingError):
    """A calibration that cannot be made; of a picture in which the target cannot be read, in one sentence."""


def eight_bits(picture: NDArray[Any]) -> Grey:
    """Stretch grey levels, shape (height, width), so that 0.5 % of the pixels are black and 0.5 % white."""
    low, high = np.percentile(picture, [0.5, 99.5])
    stretched = (picture.astype(np.float32) - low) * (255 / max(float(high - low), 1.0))
    return stretched.clip(0, 255).astype(np.uint8)


def charuco_corners(picture: NDArray[Any], board: Charuco) -> tuple[Floats, Floats]:
    """Find the corners of a ChArUco board in the picture (px) and on the board (m), both of shape (n, 2). Boards
    printed by OpenCV before 4.6 (markers in the other squares where the rows are even) are recognised too.
    """
    grey, dictionary = eight_bits(picture), _dictionary(board.dictionary)
    corners, ids = _detect_markers(grey, dictionary)
    if len(ids) < 0.9 * (board.squares[0] * board.squares[1] // 2):
        corners, ids = max((corners, ids), _detect_markers(grey, dictionary, enlarge=2), key=lambda pair: len(pair[1]))
    share, marker_mm, layout = _best_layout(corners, ids, board, dictionary) if len(ids) else (0.0, math.nan, None)
    # 0.10: relative difference above which markers were printed at another size (chosen)
    if layout is None or share < LEAST_IN_PLACE or abs(marker_mm / board.marker_mm - 1) > 0.10:
        seen = f"{len(ids)} markers of {board.dictionary} are seen"
        raise _not_as_stated(picture, f"{seen}, {share:.0%} of them where the board has them, {marker_mm:.3g} mm wide")
    # OpenCV stops refining corners at steps of 0.1 px, near where the markers' corners led it.
    fine = cv2.aruco.DetectorParameters()
    fine.cornerRefinementMinAccuracy, fine.cornerRefinementMaxIterations = 1e-3, 100
    found_px, found_ids, _, _ = cv2.aruco.CharucoDetector(layout, detectorParams=fine).detectBoard(
        grey, markerCorners=list(corners), markerIds=ids
    )
    places = np.empty(0, int) if found_ids is None else found_ids.ravel()
    grid_m = np.array(layout.getChessboardCorners())[places, :2].astype(float)
    corners_px = np.empty((0, 2)) if found_ids is None else found_px.reshape(-1, 2).astype(float)
    return _enough(corners_px, grid_m, f"{len(ids)} markers are seen")


def checkerboard_corners(picture: NDArray[Any], board: Checkerboard) -> tuple[Floats, Floats]:
    """Find all inner corners of a checkerboard in the picture (px) and on the board (m), both of shape (n, 2)."""
    grey, (across, down) = eight_bits(picture), board.squares
    flags = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_ACCURACY
    for columns, rows in dict.fromkeys([(across, down), (down, across)]):
        # The sector-based detector (Duda & Frese 2018)
        seen, found_px = cv2.findChessboardCornersSB(grey, (columns - 1, rows - 1), flags=flags)
        if seen:
            grid = np.stack(np.meshgrid(np.arange(columns - 1), np.arange(rows - 1)), axis=-1).reshape(-1, 2)
            grid_m = grid.astype(float) * (board.square_mm / 1000)
            return _enough(found_px.reshape(-1, 2).astype(float), grid_m, "all are seen")
    raise _not_as_stated(picture, f"no checkerboard of {across} × {down} squares is seen")


def _not_as_stated(picture: NDArray[Any], found: str) -> CalibrationError:
    """The error of a picture that does not show the board of the settings: what was found, and what it shows."""
    seen = find_board(picture)
    if seen is None:
        return CalibrationError(
            f"{found}; the board with a white border must be in the picture, in focus, evenly lit, not mirrored and "
            "larger than 5 pixels a marker bit, and `squares` counts squares, not inner corners"
        )
    markers = f" with markers of {seen.dictionary}, {seen.marker_share:.2g} of a square wide" if seen.dictionary else ""
    return CalibrationError(
        f"{found}, but a {seen.kind} of {seen.squares[0]} × {seen.squares[1]} squares{markers}; correct `calibration`"
    )


def checkerboard_squares(grey: Grey) -> tuple[int, int] | None:
    """Count the squares across and down of a checkerboard, as far as visible; None where there is none."""
    flags = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_LARGER
    seen, corners, shape = cv2.findChessboardCornersSBWithMeta(grey, (3, 3), flags)
    if not seen:
        return None
    grid = corners.reshape(*shape.shape, 2)  # evenly spaced where second differences are below a tenth of a square
    step = np.median(np.linalg.norm(np.diff(grid, axis=1), axis=2))
    bends = [np.linalg.norm(np.diff(grid, 2, axis=axis), axis=2).max() for axis in (0, 1)]
    return (grid.shape[1] + 1, grid.shape[0] + 1) if max(bends) < 0.1 * step else None


def _dictionary(name: str) -> Any:
    """A dictionary of markers by its name in OpenCV."""
    code = getattr(cv2.aruco, name, None)
    if code is None:
        raise CalibrationError(f"there is no marker dictionary {name}; choose one such as DICT_4X4_100")
    return cv2.aruco.getPredefinedDictionary(code)


def _best_layout(
    corners: list[Any], ids: NDArray[np.int32], board: Charuco, dictionary: Any
) -> tuple[float, float, Any]:
    """Share of the markers that lie where a board has them, their size (mm), and its layout: OpenCV 4.6, or before."""
    found = []
    for legacy in (False, True):
        layout = cv2.aruco.CharucoBoard(board.squares, board.square_mm / 1000, board.marker_mm / 1000, dictionary)
        layout.setLegacyPattern(legacy)
        found.append((*_marker_agreement(layout, corners, ids, board), layout))
    return max(found, key=lambda agreement: agreement[0])


def _detect_markers(
    grey: Grey, dictionary: Any, enlarge: int = 1
) -> tuple[list[NDArray[np.float32]], NDArray[np.int32]]:
    """Corners of each marker, shape (1, 4, 2), px, and their numbers, shape (n, 1), from the picture or a larger copy,
    for squares that are only a few pixels wide. Pixel 0 of a copy is centred on ½/enlarge − ½ of the picture's.
    """
    copy = cv2.resize(grey, None, fx=enlarge, fy=enlarge, interpolation=cv2.INTER_CUBIC)
    corners, ids, _ = cv2.aruco.ArucoDetector(dictionary).detectMarkers(copy)
    if ids is None:
        return [], np.empty((0, 1), np.int32)
    return [((corner + 0.5) / enlarge - 0.5).astype(np.float32) for corner in corners], np.asarray(ids)


def _marker_agreement(layout: Any, corners: list[Any], ids: NDArray[np.int32], board: Charuco) -> tuple[float, float]:
    """Share of markers where the board has them, and their size (mm) when squares are `square_mm`. The centres of the
    markers fix the plane whatever their size; sizes are then measured in that plane.
    """
    places = {
        int(key): np.array(square)[:, :2] for key, square in zip(layout.getIds(), layout.getObjPoints(), strict=True)
    }
    on_board = [k for k, key in enumerate(ids.ravel()) if int(key) in places]
    if len(on_board) < 4:
        return (1.0, board.marker_mm) if len(on_board) == len(ids) else (len(on_board) / len(ids) / 2, board.marker_mm)
    detected = np.array([np.asarray(corners[k]).reshape(4, 2) for k in on_board], dtype=float)
    stated = np.array([places[int(ids.ravel()[k])] for k in on_board]) * 1000
    plane, _ = cv2.findHomography(
        detected.mean(axis=1), stated.mean(axis=1), cv2.RANSAC, MARKER_OUTLIER * board.square_mm, maxIters=5000
    )  # fmt: skip
    if plane is None:
        return 0.0, board.marker_mm
    read = cv2.perspectiveTransform(detected.reshape(-1, 1, 2), plane).reshape(-1, 4, 2)
    distance = np.linalg.norm(read.mean(axis=1) - stated.mean(axis=1), axis=1)
    inside = distance < MARKER_OUTLIER * board.square_mm
    sides = np.linalg.norm(read - np.roll(read, 1, axis=1), axis=2).mean(axis=1)
    size_mm = float(np.median(sides[inside])) if inside.any() else board.marker_mm
    return float(inside.sum()) / len(ids), size_mm


def _enough(corners_px: Floats, grid_m: Floats, seen: str) -> tuple[Floats, Floats]:
    """Corners, and their places on the board to a micrometre, (n, 2) each, unless they are too few or on one line."""
    if len(grid_m) >= FEWEST_CORNERS:
        grid_m = 1e-6 * np.rint(1e6 * grid_m)
        if min(len(np.unique(grid_m[:, k])) for k in (0, 1)) > 1:
            return corners_px, grid_m
        seen = "they lie on one line"
    raise CalibrationError(
        f"only {len(grid_m)} corners of the board can be read ({seen}; at least {FEWEST_CORNERS}, not on one line, are "
        "needed); show more of it, larger, in focus, evenly lit and not mirrored"
    )


# ------------------------------------------------------------------------------
# Recognise an unknown printed board in a picture: its kind, its squares and its dictionary.
#
# Sizes in millimetres cannot be seen; the ratio of a marker to its square can.


@dataclass(frozen=True)
class BoardSeen:
    """A board in a picture: `squares` across and down; `marker_share` is the marker's side over the square's."""

    kind: str
    squares: tuple[int, int]
    dictionary: str = ""
    marker_share: float = float("nan")


def find_board(picture: NDArray[Any]) -> BoardSeen | None:
    """Find the printed board in a picture. Shapes: picture (height, width)."""
    grey = eight_bits(picture)
    seen = [(*_detect_markers(grey, _dictionary(_smallest(family, math.inf))), family) for family in OTHER_DICTIONARIES]
    corners, ids, family = max(seen, key=lambda markers: len(markers[1]))
    best_share, best_board, n_markers = 0.0, None, int(ids.max(initial=0)) + 1
    # Squares across and down, at most 40, of the boards with this many markers, of which two may be hidden (chosen)
    for across, down in itertools.product(range(2, 41), repeat=2):
        layout, count = (across, down), across * down // 2
        # 6: fewest markers that distinguish a board from chance (chosen)
        if len(ids) < 6 or not n_markers <= count <= n_markers + 2:
            continue
        # Any marker size below 1 will do: the layout follows from the markers' centres, and their size is measured.
        board = Charuco(kind="charuco", image="seen", squares=layout, square_mm=1.0, marker_mm=0.7, dictionary=family)
        share, marker, _ = _best_layout(corners, ids, board, _dictionary(_smallest(family, math.inf)))
        if share > best_share:
            best_share, best_board = share, BoardSeen("charuco", layout, _smallest(family, count), marker)
    if best_share >= LEAST_IN_PLACE:
        return best_board
    squares = checkerboard_squares(grey)
    return None if squares is None else BoardSeen("checkerboard", squares)


def _smallest(family: str, n_markers: float) -> str:
    """The smallest dictionary of a family that has enough words for a board."""
    if family[-2] != "X":
        return family
    return f"{family}_{next((size for size in DICTIONARY_SIZES if size >= n_markers), DICTIONARY_SIZES[-1])}"


# ------------------------------------------------------------------------------
# Map from pixels to the plane of growth: lens distortion and tilt, with their uncertainty.
#
# A point of the plane, seen through a pinhole, is mapped by a homography (for any pose and focal length), and radial
# distortion then moves it outwards or inwards from the centre of the picture (Brown 1966; the form OpenCV uses): q_d
# = q (1 + κ₁ q² + κ₂ q⁴), lengths in half-diagonals of the picture. A single view of a flat target determines these
# ten parameters. Focal length and distance remain unknown, but are not needed to measure in the plane.
#
# Gaussian priors (PRIOR_SIGMA), of typical lenses and set-ups, constrain what the corners do not determine, so that a
# small target neither fails nor claims too much: the covariance includes what remains uncertain.

# Prior standard deviations of the two perspective terms, and of the two of a lens (chosen)
PRIOR_SIGMA = (0.15, 0.15, 0.10, 0.02)
N_PLANE, N_LENS = 8, 2  # Parameters of a plane and of a lens (derived)


@dataclass(frozen=True)
class PlaneMap:
    """Map from pixels to the plane of growth. `parameters` are the first eight entries of the homography from
    undistorted half-diagonals to metres, by rows (the ninth is 1), κ₁ and κ₂; `covariance` is theirs, (10, 10).
    """

    width_px: int
    height_px: int
    parameters: Floats
    covariance: Floats

    @classmethod
    def from_scale(cls, m_per_px: float, width_px: int, height_px: int) -> PlaneMap:
        """Make the map of a plane seen at right angles, without distortion, known without error."""
        step_m = m_per_px * float(_camera(width_px, height_px)[0, 0])
        parameters = np.array([step_m, 0, 0, 0, step_m, 0, 0, 0, 0, 0], dtype=float)
        return cls(width_px, height_px, parameters, np.zeros((N_PLANE + N_LENS, N_PLANE + N_LENS)))

    def plane_m(self, picture_px: Floats) -> Floats:
        """Map points of the picture to the plane. Shapes: picture_px (..., 2) → (..., 2)."""
        return self._plane_m(self.parameters, picture_px)

    def path_rel_sigma(self, places_px: Floats) -> float:
        """Relative standard error of the length of a path in the plane, from the covariance; its places are (n, 2)."""

        def length_m(parameters: Floats) -> float:
            return float(length_along(self._plane_m(parameters, places_px))[-1])

        best, steps = self.parameters, np.maximum(0.01 * np.sqrt(np.diag(self.covariance)), 1e-9)
        gradient = np.array([length_m(best + step) - length_m(best - step) for step in np.diag(steps)]) / (2 * steps)
        variance = float(gradient @ self.covariance @ gradient)
        return math.sqrt(max(variance, 0.0)) / length_m(best)

    def _plane_m(self, parameters: Floats, picture_px: Floats) -> Floats:
        until = cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 50, 1e-12
        camera, lens = _camera(self.width_px, self.height_px), np.append(parameters[N_PLANE:], (0.0, 0.0))
        points = np.ascontiguousarray(picture_px, dtype=float).reshape(-1, 1, 2)
        ideal_px = cv2.undistortImagePoints(points, camera, lens, None, until)
        places_m = cv2.perspectiveTransform(ideal_px, _homography(parameters) @ np.linalg.inv(camera))
        return np.asarray(places_m, dtype=float).reshape(picture_px.shape)


def _camera(width_px: int, height_px: int) -> Floats:
    """OpenCV's matrix of a camera whose undistorted coordinates are in half-diagonals from the picture's middle."""
    unit_px = 0.5 * math.hypot(width_px, height_px)
    return np.array([[unit_px, 0.0, (width_px - 1) / 2], [0.0, unit_px, (height_px - 1) / 2], [0.0, 0.0, 1.0]])


def _homography(parameters: Floats) -> Floats:
    return np.append(parameters[:N_PLANE], 1.0).reshape(3, 3)


def fit_plane(corners_px: Floats, board_m: Floats, width_px: int, height_px: int) -> tuple[PlaneMap, float]:
    """Fit plane and lens to corners of a board, (n, 2) each; also return the rms reprojection error, px."""
    from scipy.optimize import least_squares

    camera, still, reach_m = _camera(width_px, height_px), np.zeros(3), float(np.ptp(board_m, axis=0).max())
    places = (board_m / reach_m)[:, None]
    start, _ = cv2.findHomography(cv2.undistortPoints(corners_px[:, None], camera, None), places)
    values, noise_px = np.append(start.ravel()[:N_PLANE], np.zeros(N_LENS)), 0.1

    def off_px(values: Floats) -> Floats:
        """Corners minus their predicted positions, shape (n, 2)."""
        ideal = cv2.perspectiveTransform(places, np.linalg.inv(_homography(values)))
        lens = np.append(values[N_PLANE:], (0.0, 0.0))
        seen, _ = cv2.projectPoints(cv2.convertPointsToHomogeneous(ideal), still, still, camera, lens)
        return np.asarray(corners_px - seen[:, 0])

    def misfit(values: Floats) -> Floats:
        """Residuals over the noise, followed by the parameters with priors over their prior standard deviations."""
        return np.concatenate([off_px(values).ravel() / noise_px, values[6:] / np.array(PRIOR_SIGMA)])

    # 3: iterations of fit and noise estimate (chosen)
    for _ in range(3):
        fit = least_squares(misfit, values, method="lm", xtol=1e-12, ftol=1e-12)
        values = fit.x
        squares_px = (off_px(values) ** 2).sum(axis=1)
        # 0.01: chosen: no corner is located better
        noise_px = max(math.sqrt(squares_px.sum() / max(2 * len(corners_px) - N_PLANE - N_LENS, 1)), 0.01)
    metres = np.array([reach_m] * 6 + [1.0] * 4)
    covariance = np.linalg.inv(fit.jac.T @ fit.jac) * np.outer(metres, metres)
    return PlaneMap(width_px, height_px, values * metres, covariance), math.sqrt(squares_px.mean())


CLICK_SIGMA_PX = 0.5  # Standard error of a point picked by hand in a picture


@dataclass(frozen=True)
class AxisScale:
    """The calibration along a growth axis: mean `m_per_px`, its relative standard error (NaN where unknown), and the
    map from points of the picture (x, y), shape (n, 2), to metres along the axis from its start.
    """

    m_per_px: float
    scale_rel_sigma: float
    position_m: Callable[[Floats], Floats]


@dataclass(frozen=True)
class PlaneCalibration:
    """The result of a calibration; `covered_px` is left, top, right and bottom of the target, or of the picture."""

    kind: str
    plane: PlaneMap
    reprojection_px: float
    n_corners: int
    own_rel_sigma: float
    covered_px: tuple[float, float, float, float]
    notes: tuple[str, ...] = ()

    @cached_property
    def middle(self) -> AxisScale:
        """The scale across the middle of what the target covers, along the picture's longer side."""
        left, top, right, bottom = self.covered_px
        if self.plane.width_px >= self.plane.height_px:
            return self.along(Axis((left, (top + bottom) / 2), (right, (top + bottom) / 2)))
        return self.along(Axis(((left + right) / 2, top), ((left + right) / 2, bottom)))

    def along(self, axis: Axis, off_px: float = 0.0) -> AxisScale:
        """Scale and position along an axis: a curve's arc length in the plane, not its chord; `off_px` changes it."""
        places_px, along_px = np.array([axis.from_px, axis.to_px]), np.array([0.0, axis.length_px])
        if axis.bends:
            # 4.0: length of the chords over which a curve is summed in the plane (derived)
            along_px = np.linspace(0.0, axis.length_px, int(axis.length_px / 4.0) + 2)
            places_px = axis.points(along_px)
        places_m = self.plane.plane_m(places_px)
        path_m = length_along(places_m)

        def position_m(picture_px: Floats) -> Floats:
            if axis.bends:
                return np.interp(axis.along_and_across(picture_px)[0], along_px, path_m)
            return np.asarray((self.plane.plane_m(picture_px) - places_m[0]) @ (places_m[1] - places_m[0]) / path_m[1])

        rel_sigma = math.hypot(self.plane.path_rel_sigma(places_px), self.own_rel_sigma)
        rel_sigma = math.hypot(rel_sigma, off_px * abs(axis.turn_rad) / axis.length_px)
        return AxisScale(float(path_m[-1]) / axis.length_px, rel_sigma, position_m)


def calibrate(settings: Calibration, folder: Path, width_px: int, height_px: int) -> PlaneCalibration:
    """Calibrate recordings of `width_px` × `height_px` as the experiment's settings say."""
    whole = 0.0, 0.0, width_px - 1.0, height_px - 1.0
    if isinstance(settings, MmPerPx):
        plane = PlaneMap.from_scale(settings.mm_per_px / 1000, width_px, height_px)
        note = "the scale is the one given as mm_per_px; nothing is known of its error, nor of distortion and tilt"
        return PlaneCalibration("mm_per_px", plane, math.nan, 0, math.nan, whole, (note,))
    if isinstance(settings, TwoPoints):  # each point errs by CLICK_SIGMA_PX along the line
        distance_px = math.dist(settings.from_px, settings.to_px)
        plane = PlaneMap.from_scale(settings.length_mm / 1000 / distance_px, width_px, height_px)
        note = (
            f"the scale rests on two points {distance_px:.0f} px apart, each good to {CLICK_SIGMA_PX} px, "
            "and on nothing else"
        )
        rel_sigma = math.sqrt(2) * CLICK_SIGMA_PX / distance_px
        return PlaneCalibration("two_points", plane, math.nan, 2, rel_sigma, whole, (note,))
    try:
        recording = inspect_recording(folder / settings.image)
    except RecordingError as error:
        raise CalibrationError(error.what, error.remedy) from error
    if (recording.width, recording.height) != (width_px, height_px):
        raise CalibrationError(
            f"{settings.image} is {recording.width} × {recording.height} pixels but the recordings are {width_px} × "
            f"{height_px}",
            "film the target with the camera's settings of the trials, without cropping or resizing",
        )
    # Up to ten pictures, spread over the first 300 frames of a recording (chosen), while nothing hides the target yet
    most_pictures, searched_frames = 10, 300
    every = max(1, min(recording.declared_frames or searched_frames, searched_frames) // most_pictures)
    return calibrate_pictures(
        itertools.islice(iterate_frames(recording), 0, every * (most_pictures - 1) + 1, every), settings
    )


def calibrate_pictures(pictures: Iterable[NDArray[Any]], board: Charuco | Checkerboard) -> PlaneCalibration:
    """Calibrate from the first picture in which a target can be read: more add less than what all corners share."""
    complaint = "it holds no picture that can be read"
    for picture in pictures:
        try:
            if isinstance(board, Charuco):
                corners_px, board_m = charuco_corners(picture, board)
            else:
                corners_px, board_m = checkerboard_corners(picture, board)
            break
        except CalibrationError as error:
            complaint = error.message
    else:
        raise CalibrationError(complaint, name=board.image)
    height, width = picture.shape
    plane, reprojection_px = fit_plane(corners_px, board_m, width, height)
    # 2.0: distance of the corners from the model above which the board is another one (chosen)
    if reprojection_px > 2.0:
        raise CalibrationError(
            f"corners lie {reprojection_px:.1f} px from where a flat board of {board.squares[0]} × "
            f"{board.squares[1]} squares has them",
            "check `squares`, and that the board is flat",
            board.image,
        )
    notes = []
    # Beyond a target that spans less than half of the picture, scale and distortion are extrapolated.
    share = float(np.ptp(corners_px[:, 0 if width >= height else 1])) / max(width, height)
    if share < 0.5:
        notes.append(
            f"{board.image}: the target spans only {share:.0%} of the picture; fill it to know the scale everywhere"
        )
    # 0.05: bias that the corners at one end of a target may share, px: the error of one (measured)
    bias_rel = 0.05 * math.sqrt(2) / float(np.ptp(corners_px, axis=0).max())
    covered = (*corners_px.min(axis=0), *corners_px.max(axis=0))
    return PlaneCalibration(board.kind, plane, reprojection_px, len(corners_px), bias_rel, covered, tuple(notes))


# ------------------------------------------------------------------------------
# Apply corrections by hand to a track: points moved, dropped or confirmed, each flagged `corrected`.


def corrected_by_hand(track: Track, corrections: Sequence[Correction]) -> Track:
    """Move points of a track, which then have the error of a click, drop them, or confirm them as not doubtful."""
    if not corrections:
        return track
    edge, sigma, slow = track.edge_px.copy(), track.lead_position_sigma_m.copy(), track.lead_position_systematic_m
    slow = None if slow is None else slow.copy()
    flag = track.flag.astype("<U80")
    settled = {"doubtful", "lost", "rejected", "after_end"}  # once a person has placed or confirmed a point
    past_tense = {"move": "moved", "drop": "dropped", "confirm": "confirmed"}
    counts: Counter[str] = Counter()
    notes = []
    for point in corrections:
        if point.frame >= len(edge):
            notes.append(f"the correction of frame {point.frame} is ignored: the recording has {len(edge)} frames")
            continue
        if point.action == "confirm" and not math.isfinite(edge[point.frame]):
            notes.append(f"frame {point.frame} has no edge to be confirmed; move it to where the edge is")
            continue
        flags = [part for part in str(flag[point.frame]).split(";") if part not in settled]
        if point.action == "move":
            edge[point.frame], sigma[point.frame] = point.edge_px, CLICK_SIGMA_PX
            if slow is not None:
                slow[point.frame] = SLOW_PX
        elif point.action == "drop":
            edge[point.frame] = sigma[point.frame] = math.nan
            flags.append("rejected")
        flag[point.frame] = join_flags(*flags, "corrected")
        counts[past_tense[point.action]] += 1
    if counts:
        parts = ", ".join(f"{count} {words}" for words, count in counts.items())
        notes.append(f"points corrected by hand: {parts}")
    return replace(
        track,
        edge_px=edge,
        lead_position_sigma_m=sigma,
        lead_position_systematic_m=slow,
        flag=np.asarray(flag),
        tracked_px=track.edge_px,
        notes=(*track.notes, *notes),
    )
