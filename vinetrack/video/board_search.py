"""Recognise an unknown printed board in a picture: its kind, its squares and its dictionary.

Sizes in millimetres cannot be seen; the ratio of a marker to its square can.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vinetrack.experiment.settings import Charuco
from vinetrack.video.target_corners import (
    DICTIONARY_SIZES,
    OTHER_DICTIONARIES,
    checkerboard_squares,
    eight_bits,
    marker_agreement,
    markers_seen,
)

FEWEST_MARKERS = 6  # Fewest markers that distinguish a board from chance (chosen)
LEAST_AGREEMENT = 0.8  # Least share of the markers that must lie where a board has them (chosen)
MOST_SQUARES = 40  # Most squares along a side (chosen)
HIDDEN_MARKERS = 2  # Markers at the end of a board that may be hidden (chosen)


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
    if len(ids) >= FEWEST_MARKERS:
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
    return best_board if best_share >= LEAST_AGREEMENT else None


def _layouts(n_markers: int) -> Iterator[tuple[int, int]]:
    """Squares across and down of the boards with this many markers, or a few more."""
    for across in range(2, MOST_SQUARES + 1):
        for down in range(2, MOST_SQUARES + 1):
            if n_markers <= across * down // 2 <= n_markers + HIDDEN_MARKERS:
                yield across, down


def _largest(family: str) -> str:
    """The largest dictionary of a family."""
    return f"{family}_{DICTIONARY_SIZES[-1]}" if family[-2] == "X" else family


def _smallest(family: str, n_markers: int) -> str:
    """The smallest dictionary of a family that has enough words for a board."""
    if family[-2] != "X":
        return family
    return f"{family}_{next((size for size in DICTIONARY_SIZES if size >= n_markers), DICTIONARY_SIZES[-1])}"
