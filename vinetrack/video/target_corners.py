"""Find the corners of calibration targets in a picture, to a few hundredths of a pixel, or say why there are none.

OpenCV finds the board; every corner is then fitted to the picture around it (`saddle`), markers left out.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from vinetrack.core.records import Floats
from vinetrack.experiment.settings import Charuco

if TYPE_CHECKING:
    from vinetrack.experiment.settings import Checkerboard


# ------------------------------------------------------------------------------
# Refine where two edges of a printed pattern cross, to under a hundredth of a pixel in a sharp picture.
#
# Around a corner of a checkerboard the picture is modelled as m + A·erf(a/s)·erf(b/s) on a linear ramp of light, with
# a and b the distances from the two edges and s the blur (√2 times its standard deviation). Levenberg-Marquardt least
# squares for the crossing, both slants, blur, contrast and ramp uses every pixel beside the edges. Symmetry alone
# (OpenCV's `cornerSubPix`) leaves 0.03 px in the same pictures.

EDGE_SHARE = 0.42  # Part of a square over which its edges are followed from the corner (chosen)


MOST_STEPS, SETTLED_PX = 20, 1e-4  # Most steps of the fit, and the step at which a corner has converged (chosen)


def refine_saddles(
    picture: NDArray[np.uint8], corners_px: Floats, steps_px: Floats, free_share: float
) -> tuple[Floats, NDArray[np.bool_]]:
    """Refine corners of a pattern of squares. Returns corners, shape (n, 2), and mask of those for which the fit holds,
    shape (n,). Shapes: picture (height, width); corners_px (n, 2); steps_px (n, 2, 2).
    """
    offsets, levels, weights = _windows(picture, corners_px, steps_px, free_share)
    values = _first_values(offsets, levels, weights, steps_px)
    model, slopes = _model(values, offsets)
    cost, damping = (weights * (levels - model) ** 2).sum(axis=1), np.full(len(values), 1e-3)
    for _ in range(MOST_STEPS):
        weighted = slopes * weights[:, :, None]
        normal = np.swapaxes(weighted, 1, 2) @ slopes
        gradient = np.swapaxes(weighted, 1, 2) @ (levels - model)[:, :, None]
        diagonal = np.einsum("nii->ni", normal)
        normal = normal + (damping[:, None] * diagonal + 1e-9)[:, :, None] * np.eye(values.shape[1])
        trial = values + np.linalg.solve(normal, gradient)[:, :, 0]
        # (0.4, 8.0): bounds of the blur (chosen)
        trial[:, 4] = np.clip(trial[:, 4], *(0.4, 8.0))
        trial_model, trial_slopes = _model(trial, offsets)
        trial_cost = (weights * (levels - trial_model) ** 2).sum(axis=1)
        better = trial_cost < cost
        moved_px = np.linalg.norm((trial - values)[:, :2], axis=1)[better]
        values[better], model[better], slopes[better] = trial[better], trial_model[better], trial_slopes[better]
        cost = np.minimum(trial_cost, cost)
        damping = np.where(better, damping / 5, damping * 8)
        if (moved_px < SETTLED_PX).all() and (better | (damping > 1e3)).all():
            break
    crossings = np.rint(corners_px) + values[:, :2]
    usable = (weights.sum(axis=1) > 30) & (np.abs(values[:, 6]) > 3)
    # 2.5: largest distance of a refined corner from the detected one (chosen)
    return crossings, usable & (np.linalg.norm(crossings - corners_px, axis=1) < 2.5)


def _windows(
    picture: NDArray[np.uint8], corners_px: Floats, steps_px: Floats, free_share: float
) -> tuple[Floats, Floats, Floats]:
    """Offsets (n, k, 2) of the pixels around each corner from its nearest pixel, their levels and weights (n, k). A
    pixel counts where, in steps of the pattern from the detected corner, it lies within EDGE_SHARE both ways and within
    `free_share`, less the blur, of one of the edges.
    """
    half_window_px = 12  # Half the side of the window (derived)
    reach = np.arange(-half_window_px, half_window_px + 1)
    grid = np.stack(np.meshgrid(reach, reach), axis=-1).reshape(-1, 2)
    nearest = np.rint(corners_px).astype(int)
    places = nearest[:, None, :] + grid[None]
    height, width = picture.shape
    inside = ((places >= 0) & (places < [width, height])).all(axis=2)
    levels = picture[places[..., 1].clip(0, height - 1), places[..., 0].clip(0, width - 1)].astype(float)
    away = places - corners_px[:, None, :]
    shares = np.abs(np.einsum("nij,nkj->nki", np.linalg.inv(np.swapaxes(steps_px, 1, 2)), away))
    square_px = np.linalg.norm(steps_px, axis=2).min(axis=1)[:, None]
    near = shares.max(axis=2) < EDGE_SHARE
    free = shares.min(axis=2) < np.maximum(free_share - 1.5 / square_px, 1.2 / square_px)
    offsets = np.broadcast_to(grid[None].astype(float), (len(corners_px), *grid.shape))
    return offsets, levels, (inside & near & free).astype(float)


def _first_values(offsets: Floats, levels: Floats, weights: Floats, steps_px: Floats) -> Floats:
    """First values: crossing (2), slants of the edge normals (2), blur, level, half contrast, ramp slopes (2)."""
    n = len(levels)
    values = np.zeros((n, 9))
    # The normal of an edge is a quarter turn from the step along it.
    values[:, 2:4] = np.arctan2(steps_px[:, :, 0], -steps_px[:, :, 1])
    # 1.1: first value of the blur (chosen)
    values[:, 4] = 1.1
    total = weights.sum(axis=1).clip(1)
    values[:, 5] = (levels * weights).sum(axis=1) / total
    sides = np.sign(_distances(values, offsets)).prod(axis=2)
    values[:, 6] = ((levels - values[:, 5:6]) * sides * weights).sum(axis=1) / total
    return values


def _distances(values: Floats, offsets: Floats) -> Floats:
    """Distances from both edges, shape (n, k, 2), px."""
    away = offsets - values[:, None, :2]
    normals = np.stack([np.cos(values[:, 2:4]), np.sin(values[:, 2:4])], axis=-1)
    return np.einsum("nei,nki->nke", normals, away)


def _model(values: Floats, offsets: Floats) -> tuple[Floats, Floats]:
    """Levels (n, k) that the values predict, and their derivatives (n, k, 9)."""
    from scipy.special import erf

    blur, contrast = values[:, 4, None, None], values[:, 6, None]
    away = offsets - values[:, None, :2]
    cosine, sine = np.cos(values[:, 2:4])[:, None, :], np.sin(values[:, 2:4])[:, None, :]
    distance = cosine * away[..., :1] + sine * away[..., 1:]
    turned = -sine * away[..., :1] + cosine * away[..., 1:]
    step = erf(distance / blur)
    bell = 2 / np.sqrt(np.pi) * np.exp(-((distance / blur) ** 2)) / blur
    other = step[..., ::-1]
    rise = contrast[..., None] * bell * other
    ground = values[:, 7, None] * away[..., 0] + values[:, 8, None] * away[..., 1]
    slopes = np.empty((*ground.shape, 9))
    slopes[..., 0] = -_sum_of_edges(rise * cosine) - values[:, 7, None]
    slopes[..., 1] = -_sum_of_edges(rise * sine) - values[:, 8, None]
    slopes[..., 2:4] = rise * turned
    slopes[..., 4] = -_sum_of_edges(rise * distance / blur)
    slopes[..., 5] = 1
    slopes[..., 6] = step[..., 0] * step[..., 1]
    slopes[..., 7:9] = away
    return values[:, 5, None] + contrast * slopes[..., 6] + ground, slopes


def _sum_of_edges(parts: Floats) -> Floats:
    """Sum over the two edges; several times faster than `sum` over an axis of two."""
    return np.asarray(parts[..., 0] + parts[..., 1])


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
    n_markers: int = 0


def find_board(picture: NDArray[Any]) -> BoardSeen | None:
    """Find the printed board in a picture. Shapes: picture (height, width)."""
    grey = eight_bits(picture)
    seen = [(*markers_seen(grey, _largest(family)), family) for family in OTHER_DICTIONARIES]
    corners, ids, family = max(seen, key=lambda markers: len(markers[1]))
    # 6: fewest markers that distinguish a board from chance (chosen)
    if len(ids) >= 6:
        board = _charuco(corners, ids, family)
        if board is not None:
            return board
    squares = checkerboard_squares(grey)
    return None if squares is None else BoardSeen("checkerboard", squares)


def _charuco(corners: Any, ids: NDArray[np.int32], family: str) -> BoardSeen | None:
    """The layout on which most markers lie in place; None where no layout has enough of them."""
    best_share, best_board = 0.0, None
    for squares in _layouts(int(ids.max()) + 1):
        # Any marker size below 1 will do: the layout follows from the markers' centres, and their size is measured.
        board = Charuco(kind="charuco", image="", squares=squares, square_mm=1.0, marker_mm=0.7, dictionary=family)
        share, marker = marker_agreement(corners, ids, board, _largest(family))
        if share > best_share:
            dictionary = _smallest(family, squares[0] * squares[1] // 2)
            best_share, best_board = share, BoardSeen("charuco", squares, dictionary, marker, len(ids))
    # 0.8: least share of the markers that must lie where a board has them (chosen)
    return best_board if best_share >= 0.8 else None


def _layouts(n_markers: int) -> Iterator[tuple[int, int]]:
    """Squares across and down of the boards with this many markers, or a few more."""
    most_squares = 40  # Most squares along a side (chosen)
    for across in range(2, most_squares + 1):
        for down in range(2, most_squares + 1):
            # 2: markers at the end of a board that may be hidden (chosen)
            if n_markers <= across * down // 2 <= n_markers + 2:
                yield across, down


def _largest(family: str) -> str:
    """The largest dictionary of a family."""
    return f"{family}_{DICTIONARY_SIZES[-1]}" if family[-2] == "X" else family


def _smallest(family: str, n_markers: int) -> str:
    """The smallest dictionary of a family that has enough words for a board."""
    if family[-2] != "X":
        return family
    return f"{family}_{next((size for size in DICTIONARY_SIZES if size >= n_markers), DICTIONARY_SIZES[-1])}"
