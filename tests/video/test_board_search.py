"""A printed board is named from a picture alone."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from vinetrack.video.target_corners import find_board


def charuco(squares: tuple[int, int], name: str, square_px: int = 80, marker_px: int = 60) -> np.ndarray:
    words = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))
    board = cv2.aruco.CharucoBoard(squares, square_px, marker_px, words)
    picture = board.generateImage((squares[0] * square_px, squares[1] * square_px))
    return np.pad(picture, 60, constant_values=200)


@pytest.mark.parametrize(
    ("squares", "name"), [((14, 5), "DICT_4X4_50"), ((7, 9), "DICT_5X5_50"), ((12, 9), "DICT_6X6_100")]
)
def test_a_charuco_board_is_named(squares: tuple[int, int], name: str) -> None:
    seen = find_board(charuco(squares, name))
    assert seen is not None
    assert (seen.kind, seen.squares, seen.dictionary) == ("charuco", squares, name)
    assert seen.marker_share == pytest.approx(0.75, abs=0.02)


def test_a_tilted_board_is_named() -> None:
    flat = charuco((10, 6), "DICT_4X4_50")
    height, width = flat.shape
    corners = np.array([[0, 0], [width, 0], [width, height], [0, height]], np.float32)
    moved = corners + np.array([[20, 30], [-40, 10], [-10, -40], [35, -5]], np.float32)
    tilted = cv2.warpPerspective(flat, cv2.getPerspectiveTransform(corners, moved), (width, height), borderValue=200)
    seen = find_board(tilted)
    assert seen is not None
    assert seen.squares == (10, 6)


def test_a_checkerboard_is_named() -> None:
    squares = np.kron(np.indices((6, 9)).sum(axis=0) % 2, np.ones((36, 36)))
    picture = np.pad((60 + 150 * squares).astype(np.uint8), 50, constant_values=210)
    seen = find_board(picture)
    assert seen is not None
    assert (seen.kind, sorted(seen.squares)) == ("checkerboard", [6, 9])


def test_a_picture_without_a_board_has_none() -> None:
    noise = np.random.default_rng(5).normal(120, 20, (300, 400)).clip(0, 255).astype(np.uint8)
    assert find_board(cv2.GaussianBlur(noise, (0, 0), 2)) is None
