"""A printed board of which nothing is known: its kind, squares and dictionary, read off a picture.

Sizes in millimetres cannot be seen; the share of a square that its marker takes can.
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

FEWEST_MARKERS = 6
"""Markers by which a board is told from chance. Chosen: of OpenCV's families one word in some hundreds is met by chance
in a cluttered picture; with half, clutter may pass; with twice, a board half hidden is missed."""
IN_PLACE = 0.8
"""Share of the markers that must lie where a board has them. Chosen: as `charuco_corners` asks; at half a wrong
layout of the same count may pass, twice cannot be."""
MOST_SQUARES = 40
"""Squares along a side at most; chosen: boards of more have markers of a few pixels. At half a long ruler of squares is
missed; twice doubles the search."""
HIDDEN = 2
"""Markers at the end of a board that may be hidden; chosen: one row of a small board."""


@dataclass(frozen=True)
class BoardSeen:
    """A board in a picture: `squares` across and down; `marker_share` is the marker's side over the square's."""

    kind: str
    squares: tuple[int, int]
    dictionary: str = ""
    marker_share: float = float("nan")
    n_markers: int = 0


def find_board(picture: NDArray[Any]) -> BoardSeen | None:
    """The printed board in a picture.

    Parameters
    ----------
    picture : grey levels, shape (height, width).

    Returns
    -------
    BoardSeen; None where there is none.
    """
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
    best, chosen = 0.0, None
    for squares in _layouts(int(ids.max()) + 1):
        # Any share below 1 will do: middles of markers tell the layout, and their size is then measured.
        board = Charuco(kind="charuco", image="", squares=squares, square_mm=1.0, marker_mm=0.7, dictionary=family)
        share, marker = marker_agreement(corners, ids, board, _largest(family))
        if share > best:
            dictionary = _smallest(family, squares[0] * squares[1] // 2)
            best, chosen = share, BoardSeen("charuco", squares, dictionary, marker, len(ids))
    return chosen if best >= IN_PLACE else None


def _layouts(n_markers: int) -> Iterator[tuple[int, int]]:
    """Squares across and down of boards with so many markers, or a few more."""
    for across in range(2, MOST_SQUARES + 1):
        for down in range(2, MOST_SQUARES + 1):
            if n_markers <= across * down // 2 <= n_markers + HIDDEN:
                yield across, down


def _largest(family: str) -> str:
    return f"{family}_{DICTIONARY_SIZES[-1]}" if family[-2] == "X" else family


def _smallest(family: str, n_markers: int) -> str:
    """The smallest dictionary of a family that has words for a board."""
    if family[-2] != "X":
        return family
    return f"{family}_{next((size for size in DICTIONARY_SIZES if size >= n_markers), DICTIONARY_SIZES[-1])}"
