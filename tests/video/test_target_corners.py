"""Corners in rendered targets against where the laboratory's camera puts them, and crossings drawn by hand."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.special import ndtr

from vinetrack.experiment.settings import Charuco, Checkerboard
from vinetrack.laboratory.filming import render_target
from vinetrack.laboratory.scene import Camera, Light, Sensor, Target, preset
from vinetrack.video.target_corners import (
    CornersError,
    charuco_corners,
    checkerboard_corners,
    eight_bits,
    refine_saddles,
)

CAMERA = Camera(focal_px=1500, k1=-0.2, tilt_x_deg=5, tilt_y_deg=-6)
SCENE = replace(preset("demo"), camera=CAMERA)
SQUARES, SQUARE_MM, MARKER_MM = (13, 5), 20.0, 14.0
BOARD = Target(squares=SQUARES, square_m=SQUARE_MM / 1000, marker_m=MARKER_MM / 1000, angle_deg=1.0)
CHECKER = replace(BOARD, kind="checkerboard")
CHARUCO = Charuco(
    kind="charuco", image="board.png", squares=SQUARES, square_mm=SQUARE_MM, marker_mm=MARKER_MM,
    dictionary="DICT_4X4_100",
)  # fmt: skip
CHECKERBOARD = Checkerboard(kind="checkerboard", image="board.png", squares=SQUARES, square_mm=SQUARE_MM)


def misses_px(found: tuple[np.ndarray, np.ndarray], target: Target, camera: Camera = CAMERA) -> np.ndarray:
    """Corners found minus where they are, by their place on the board, up to half a turn of a checkerboard."""
    corners_px, places_m = found
    truth_px = camera.picture_from_plane(target.corners_m() / camera.m_per_px + np.array(camera.centre_px))
    columns, rows = target.squares[0] - 1, target.squares[1] - 1
    cell = np.rint((places_m - places_m.min(axis=0)) / target.square_m).astype(int)
    turned = np.array([columns - 1, rows - 1]) - cell
    candidates = [corners_px - truth_px[one[:, 1] * columns + one[:, 0]] for one in (cell, turned)]
    return min(candidates, key=lambda miss: np.abs(miss).max())


def crossing(centre, angles_deg, size=41, sigma=0.7, low=40.0, high=200.0) -> np.ndarray:
    """Two blurred edges that cross: an independent drawing, from the normal distribution."""
    y, x = np.mgrid[:size, :size]
    first, second = (
        ndtr(((x - centre[0]) * np.cos(a) + (y - centre[1]) * np.sin(a)) / sigma) for a in np.radians(angles_deg)
    )
    return low + (high - low) * (first * second + (1 - first) * (1 - second))


STEPS = np.array([[[15.0, 0.0], [0.0, 15.0]]])


@pytest.mark.parametrize(("target", "seed"), [(BOARD, 3000), (CHECKER, 3001)])
def test_corners_are_found_to_a_fiftieth_of_a_pixel(target, seed):
    picture = render_target(target, SCENE, seed=seed)
    found = charuco_corners(picture, CHARUCO) if target is BOARD else checkerboard_corners(picture, CHECKERBOARD)
    miss = misses_px(found, target)
    assert len(miss) == 48
    assert miss.std() < 0.02
    assert np.abs(miss.mean(axis=0)).max() < 0.01
    assert np.abs(miss).max() < 0.08


def test_uneven_light_moves_corners_by_less_than_the_bias_allowed_for():
    picture = render_target(CHECKER, replace(SCENE, light=Light(vignetting=0.5)), seed=3002, ramp=0.8)
    miss = misses_px(checkerboard_corners(picture, CHECKERBOARD), CHECKER)
    assert np.abs(miss.mean(axis=0)).max() < 0.02


@pytest.mark.parametrize("psf_px", [0.5, 1.0, 1.8])
def test_blur_of_the_picture_is_fitted_along(psf_px):
    picture = render_target(CHECKER, replace(SCENE, psf_px=psf_px, sensor=Sensor(noise=False)), seed=3003)
    miss = misses_px(checkerboard_corners(picture, CHECKERBOARD), CHECKER)
    assert miss.std() < 0.02


@pytest.mark.parametrize("angles_deg", [(0, 90), (3, 88), (10, 75)])
@pytest.mark.parametrize("shift", [(0.0, 0.0), (0.31, -0.27), (0.5, 0.5)])
def test_crossing_of_two_edges_is_found_to_a_hundredth(angles_deg, shift):
    centre = np.array([20.0, 20.0]) + shift
    picture = np.rint(crossing(centre, angles_deg)).astype(np.uint8)
    found, held = refine_saddles(picture, np.array([[20.0, 20.0]]), STEPS, 0.5)
    assert held.all()
    assert found[0] == pytest.approx(centre, abs=0.01)


def test_dark_and_light_squares_may_change_places():
    picture = np.rint(crossing((20.2, 19.7), (4, 92), low=210, high=30)).astype(np.uint8)
    found, held = refine_saddles(picture, np.array([[20.0, 20.0]]), STEPS, 0.5)
    assert held.all()
    assert found[0] == pytest.approx((20.2, 19.7), abs=0.01)


def test_prints_beside_the_edges_are_left_out():
    picture = crossing((20.3, 19.6), (2, 91))
    y, x = np.mgrid[:41, :41]
    picture[(np.abs(x - 20.3) > 5) & (np.abs(y - 19.6) > 5)] = 120  # a grey marker in each corner of the window
    found, held = refine_saddles(np.rint(picture).astype(np.uint8), np.array([[20.0, 20.0]]), 2 * STEPS, 0.12)
    spoilt, _ = refine_saddles(np.rint(picture).astype(np.uint8), np.array([[20.0, 20.0]]), 2 * STEPS, 0.5)
    assert held.all()
    assert found[0] == pytest.approx((20.3, 19.6), abs=0.01)
    assert np.abs(spoilt[0] - (20.3, 19.6)).max() > 0.001


def test_corner_at_the_border_of_the_picture_is_found_from_what_is_left():
    picture = np.rint(crossing((20.2, 19.7), (4, 92))).astype(np.uint8)[:, 16:]
    found, held = refine_saddles(picture, np.array([[4.0, 20.0]]), STEPS, 0.5)
    assert held.all()
    assert found[0] == pytest.approx((4.2, 19.7), abs=0.02)


def test_a_false_corner_is_discarded():
    flat = np.full((41, 41), 90, dtype=np.uint8)
    noise = np.random.default_rng(3004).integers(88, 93, (41, 41)).astype(np.uint8)
    for picture in (flat, noise):
        _, held = refine_saddles(picture, np.array([[20.0, 20.0]]), STEPS, 0.5)
        assert not held.any()


def test_inputs_are_unchanged():
    picture = render_target(CHECKER, SCENE, seed=3005)
    before = picture.copy()
    checkerboard_corners(picture, CHECKERBOARD)
    assert (picture == before).all()


def test_any_depth_becomes_eight_bits_from_black_to_white():
    ramp = np.linspace(300, 900, 10000).reshape(100, 100).astype(np.uint16)
    grey = eight_bits(ramp)
    assert grey.dtype == np.uint8
    assert (grey.min(), grey.max()) == (0, 255)
    assert eight_bits(np.full((10, 10), 7, np.uint8)).max() == 0


def test_mirrored_board_cannot_be_read():
    picture = cv2.flip(render_target(BOARD, SCENE, seed=3006), 1)
    with pytest.raises(CornersError, match="not mirrored"):
        charuco_corners(picture, CHARUCO)
