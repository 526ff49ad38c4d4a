"""Find the corners of calibration targets in a picture, to a few hundredths of a pixel, or say why there are none.

OpenCV finds the board; every corner is then fitted to the picture around it (`saddle`), markers left out.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from vinetrack.core.records import Floats
from vinetrack.video.saddle import refine_saddles

if TYPE_CHECKING:
    from vinetrack.experiment.settings import Charuco, Checkerboard

Grey = NDArray[np.uint8]

FEWEST_CORNERS = 8  # Fewest corners of a calibration (chosen)
# Distance, in squares, from where the board has it beyond which a marker belongs to another board (chosen)
MARKER_OUTLIER = 0.3
# Relative difference from `marker_mm` above which markers were printed at another size (chosen)
MARKER_TOLERANCE = 0.10
DICTIONARY_SIZES = (50, 100, 250, 1000)  # Words in OpenCV's dictionaries of each marker size (defined)
OTHER_DICTIONARIES = (*(f"DICT_{n}X{n}" for n in (4, 5, 6, 7)), "DICT_ARUCO_ORIGINAL", "DICT_APRILTAG_36h11")


class CornersError(ValueError):
    """A picture in which the target cannot be read: what is wrong and what to do, in one sentence."""


def eight_bits(picture: NDArray[Any]) -> Grey:
    """Stretch grey levels, shape (height, width), so that 0.5 % of the pixels are black and 0.5 % white. Shapes:
    picture (height, width) → (height, width).
    """
    low, high = np.percentile(picture, [0.5, 99.5])
    stretched = (picture.astype(np.float32) - low) * (255 / max(float(high - low), 1.0))
    return stretched.clip(0, 255).astype(np.uint8)


def charuco_corners(picture: NDArray[Any], board: Charuco) -> tuple[Floats, Floats]:
    """Find the corners of a ChArUco board in the picture (px) and on the board (m). Boards printed by OpenCV before 4.6
    (markers in the other squares where the rows are even) are recognised too. Returns corners in the picture (px) and
    on the board (m), both of shape (n, 2). Shapes: picture (height, width).
    """
    import cv2

    grey = eight_bits(picture)
    dictionary = _dictionary(board.dictionary)
    corners, ids = _detect_markers(grey, dictionary)
    if len(ids) < 0.9 * (board.squares[0] * board.squares[1] // 2):
        corners, ids = max((corners, ids), _detect_markers(grey, dictionary, enlarge=2), key=lambda pair: len(pair[1]))
    if not len(ids):
        raise CornersError(_no_markers(grey, board.dictionary))
    layouts = [_charuco_board(board, dictionary, legacy) for legacy in (False, True)]
    agreement = [_marker_agreement(layout, corners, ids, board) for layout in layouts]
    layout = layouts[int(np.argmax([share for share, _ in agreement]))]
    share, marker_mm = max(agreement, key=lambda pair: pair[0])
    if share < 0.8:
        raise CornersError(
            f"the markers do not lie as on a board of {board.squares[0]} × {board.squares[1]} squares "
            f"({len(ids)} markers, {share:.0%} in place); count the squares across and down and correct `squares`"
        )
    if abs(marker_mm / board.marker_mm - 1) > MARKER_TOLERANCE:
        raise CornersError(
            f"the markers measure {marker_mm:.3g} mm beside squares of {board.square_mm:g} mm, not "
            f"{board.marker_mm:g}; measure both on the print and correct `square_mm` or `marker_mm`"
        )
    found_px, found_ids, _, _ = cv2.aruco.CharucoDetector(layout).detectBoard(
        grey, markerCorners=list(corners), markerIds=ids
    )
    n = 0 if found_ids is None else len(found_ids)
    if n < FEWEST_CORNERS:
        raise CornersError(_too_few(n, f"{len(ids)} markers are seen"))
    grid_m = np.array(layout.getChessboardCorners())[found_ids.ravel(), :2].astype(float)
    gap_share = (1 - board.marker_mm / board.square_mm) / 2
    return _refined(grey, found_px.reshape(-1, 2).astype(float), grid_m, board.square_mm / 1000, gap_share)


def checkerboard_corners(picture: NDArray[Any], board: Checkerboard) -> tuple[Floats, Floats]:
    """Find the inner corners of a checkerboard, all of which must be in the picture (px), and on the board (m). Returns
    corners in the picture (px) and on the board (m), both of shape (n, 2). Shapes: picture (height, width).
    """
    grey = eight_bits(picture)
    across, down = board.squares
    for enlarge in (1, 2):
        for columns, rows in dict.fromkeys([(across, down), (down, across)]):
            found_px = _sector_corners(grey, columns - 1, rows - 1, enlarge)
            if found_px is None:
                continue
            grid = np.stack(np.meshgrid(np.arange(columns - 1), np.arange(rows - 1)), axis=-1).reshape(-1, 2)
            square_m = board.square_mm / 1000
            return _refined(grey, found_px, grid.astype(float) * square_m, square_m, 0.5)
    raise CornersError(_no_checkerboard(grey, across, down))


def markers_seen(grey: Grey, dictionary: str) -> tuple[list[NDArray[np.float32]], NDArray[np.int32]]:
    """Detect the markers of a dictionary in a picture. Returns corners of each marker, shape (1, 4, 2), px, and their
    numbers, shape (n, 1). Shapes: grey (height, width).
    """
    return _detect_markers(grey, _dictionary(dictionary))


def marker_agreement(
    corners: list[Any], ids: NDArray[np.int32], board: Charuco, dictionary: str
) -> tuple[float, float]:
    """Share of markers that lie where a board has them, and their size (mm) relative to squares of `square_mm`. Boards
    printed by OpenCV before 4.6 count too. Returns share, marker_mm.
    """
    predefined = _dictionary(dictionary)
    layouts = [_charuco_board(board, predefined, legacy) for legacy in (False, True)]
    return max(
        (_marker_agreement(layout, corners, ids, board) for layout in layouts), key=lambda agreement: agreement[0]
    )


def checkerboard_squares(grey: Grey) -> tuple[int, int] | None:
    """Count the squares across and down of the checkerboard in a picture, as far as visible; None where there is none.
    Returns across, down; or None. Shapes: grey (height, width).
    """
    import cv2

    flags = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_LARGER
    seen, corners, shape = cv2.findChessboardCornersSBWithMeta(grey, (3, 3), flags)
    if seen and _is_a_grid(corners.reshape(*shape.shape, 2)):
        return shape.shape[1] + 1, shape.shape[0] + 1
    return None


def _enlarged(grey: Grey, times: int) -> Grey:
    """The picture, or a larger copy for squares that are only a few pixels wide."""
    import cv2

    if times == 1:
        return grey
    size = (grey.shape[1] * times, grey.shape[0] * times)
    return np.asarray(cv2.resize(grey, size, interpolation=cv2.INTER_CUBIC))


def _in_original(corners_px: NDArray[Any], times: int) -> Floats:
    """Convert places in an enlarged copy: its pixel 0 is centred on ½/times − ½ of the picture's."""
    return (np.asarray(corners_px, dtype=float) + 0.5) / times - 0.5


def _dictionary(name: str) -> Any:
    """A dictionary of markers by its name in OpenCV."""
    import cv2

    code = getattr(cv2.aruco, name, None)
    if code is None:
        raise CornersError(f"there is no marker dictionary {name}; choose one such as DICT_4X4_100")
    return cv2.aruco.getPredefinedDictionary(code)


def _charuco_board(board: Charuco, dictionary: Any, legacy: bool) -> Any:
    """The layout of a board, as OpenCV printed it from version 4.6, or before (`legacy`)."""
    import cv2

    layout = cv2.aruco.CharucoBoard(board.squares, board.square_mm / 1000, board.marker_mm / 1000, dictionary)
    layout.setLegacyPattern(legacy)
    return layout


def _detect_markers(
    grey: Grey, dictionary: Any, enlarge: int = 1
) -> tuple[list[NDArray[np.float32]], NDArray[np.int32]]:
    """Corners of each marker, shape (1, 4, 2), px, and their numbers, shape (n, 1)."""
    import cv2

    corners, ids, _ = cv2.aruco.ArucoDetector(dictionary).detectMarkers(_enlarged(grey, enlarge))
    if ids is None:
        return [], np.empty((0, 1), np.int32)
    return [_in_original(corner, enlarge).astype(np.float32) for corner in corners], np.asarray(ids)


def _marker_agreement(layout: Any, corners: list[Any], ids: NDArray[np.int32], board: Charuco) -> tuple[float, float]:
    """Share of markers where the board has them, and their size (mm) when squares are `square_mm`. The centres of the
    markers fix the plane whatever their size; sizes are then measured in that plane.
    """
    import cv2

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


def _sector_corners(grey: Grey, columns: int, rows: int, enlarge: int = 1) -> Floats | None:
    """Inner corners by the sector-based detector (Duda & Frese 2018), (columns · rows, 2), px; None where not found."""
    import cv2

    flags = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_ACCURACY
    seen, corners = cv2.findChessboardCornersSB(_enlarged(grey, enlarge), (columns, rows), flags=flags)
    return _in_original(corners.reshape(-1, 2), enlarge) if seen else None


def _refined(
    grey: Grey, corners_px: Floats, grid_m: Floats, square_m: float, free_share: float
) -> tuple[Floats, Floats]:
    """Refined corners and their places on the board, without those that could not be refined, both of shape (n, 2)."""
    refined_px, refined = refine_saddles(grey, corners_px, _corner_steps_px(corners_px, grid_m, square_m), free_share)
    places_m = grid_m[refined]
    if refined.sum() < FEWEST_CORNERS:
        raise CornersError(_too_few(int(refined.sum()), f"{len(refined)} are detected"))
    if min(len(np.unique(places_m[:, k].round(6))) for k in (0, 1)) < 2:
        raise CornersError(_too_few(len(places_m), "they lie on one line"))
    return refined_px[refined], places_m


def _corner_steps_px(corners_px: Floats, grid_m: Floats, square_m: float) -> Floats:
    """Steps in the picture to the next corner along the board's two directions, at each corner, shape (n, 2, 2)."""
    import cv2

    plane, _ = cv2.findHomography(grid_m, corners_px)
    steps = []
    for direction in np.eye(2) * square_m:
        ends = [cv2.perspectiveTransform((grid_m + sign * direction / 2)[:, None], plane)[:, 0] for sign in (-1, 1)]
        steps.append(ends[1] - ends[0])
    return np.stack(steps, axis=1)


def _is_a_grid(corners_px: NDArray[Any]) -> bool:
    """Whether corners, shape (rows, columns, 2), are evenly spaced: second differences below a tenth of a square."""
    steps = np.linalg.norm(np.diff(corners_px, axis=1), axis=2)
    bends = [np.linalg.norm(np.diff(corners_px, 2, axis=axis), axis=2).max() for axis in (0, 1)]
    return bool(max(bends) < 0.1 * np.median(steps))


def _too_few(n: int, why: str) -> str:
    """Say that too few corners can be read."""
    return (
        f"only {n} corners of the board can be read ({why}; at least {FEWEST_CORNERS}, not on one line, are needed); "
        "show more of it, larger, in focus, evenly lit and not mirrored"
    )


def _no_markers(grey: Grey, dictionary: str) -> str:
    """Say that there are no markers, and name the dictionary whose markers are there, if any."""
    best, numbers = "", np.empty(0, int)
    for name in OTHER_DICTIONARIES:
        family = f"{name}_{DICTIONARY_SIZES[-1]}" if name[-2] == "X" else name
        ids = _detect_markers(grey, _dictionary(family))[1].ravel()
        if name not in dictionary and len(ids) > len(numbers):
            best, numbers = name, ids
    if len(numbers) >= 3:
        enough = next((size for size in DICTIONARY_SIZES if size > numbers.max()), DICTIONARY_SIZES[-1])
        likely = f"{best}_{enough}" if best[-2] == "X" else best
        return f"no marker of {dictionary} is seen, but {len(numbers)} of {likely}; correct `dictionary`"
    return (
        f"no marker of {dictionary} is seen; check `dictionary`, and that the board is in the picture, in focus, "
        "not mirrored and larger than 5 pixels a marker bit"
    )


def _no_checkerboard(grey: Grey, across: int, down: int) -> str:
    """Say that there is no such checkerboard, and name the size of the one that is there, if any."""
    squares = checkerboard_squares(grey)
    if squares is not None:
        return (
            f"no checkerboard of {across} × {down} squares is seen, but {squares[0]} × {squares[1]} squares are; "
            "correct `squares` (squares, not inner corners), or show the whole board"
        )
    return (
        f"no checkerboard of {across} × {down} squares is seen; the whole board with a white border must be in the "
        "picture, in focus and evenly lit, and `squares` counts squares, not inner corners"
    )
