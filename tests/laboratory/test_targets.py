"""Targets are drawn where a camera of OpenCV's sees them, with the pattern OpenCV prints."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.special import erf

from vinetrack.laboratory.filming import render_target
from vinetrack.laboratory.render import FrameRenderer
from vinetrack.laboratory.scene import Camera, Sensor, Target, preset

CAMERA = Camera(focal_px=1300, k1=-0.25, k2=0.08, tilt_x_deg=7, tilt_y_deg=-9)
SCENE = replace(preset("demo"), camera=CAMERA, sensor=Sensor(noise=False, fixed_pattern=0, bit_depth=16))
CHECKER = Target(kind="checkerboard", squares=(11, 4), square_m=0.025, angle_deg=2.0, centre_m=(0.004, -0.003))


def corners_by_opencv(target: Target, camera: Camera) -> np.ndarray:
    about_x, _ = cv2.Rodrigues(np.radians([camera.tilt_x_deg, 0, 0]))
    about_y, _ = cv2.Rodrigues(np.radians([0, camera.tilt_y_deg, 0]))
    turn, _ = cv2.Rodrigues(about_y @ about_x)
    away_m = np.array([0, 0, camera.focal_px * camera.m_per_px])
    plane_m = np.column_stack([target.corners_m(), np.zeros(len(target.corners_m()))])
    seen, _ = cv2.projectPoints(plane_m, turn, away_m, camera.matrix, np.array([camera.k1, camera.k2, 0, 0, 0]))
    return seen[:, 0]


def crossings(picture: np.ndarray, near: np.ndarray) -> np.ndarray:
    """Where two blurred edges cross, by least squares in a window of ±9 px; written apart from the package's own."""
    found = []
    for corner in near:
        x0, y0 = np.rint(corner).astype(int)
        y, x = np.mgrid[y0 - 9 : y0 + 10, x0 - 9 : x0 + 10]
        levels = picture[y0 - 9 : y0 + 10, x0 - 9 : x0 + 10] / 65535.0

        def misfit(p, x=x, y=y, levels=levels):
            a = ((x - p[0]) * np.cos(p[2]) + (y - p[1]) * np.sin(p[2])) / p[4]
            b = ((x - p[0]) * np.cos(p[3]) + (y - p[1]) * np.sin(p[3])) / p[4]
            return (p[5] + p[7] * (x - x.mean()) + p[8] * (y - y.mean()) + p[6] * erf(a) * erf(b) - levels).ravel()

        starts = [[*corner, 0.0, np.pi / 2, 1.0, levels.mean(), sign * levels.std(), 0, 0] for sign in (1, -1)]
        fits = [least_squares(misfit, start, method="lm") for start in starts]
        found.append(min(fits, key=lambda fit: fit.cost).x[:2])
    return np.array(found)


def test_corners_of_a_checkerboard_are_where_opencv_projects_them():
    expected = corners_by_opencv(CHECKER, CAMERA)
    measured = crossings(render_target(CHECKER, SCENE), expected + 0.3)
    assert np.abs(measured - expected).max() < 0.03
    assert np.abs((measured - expected).mean(axis=0)).max() < 0.01


def test_every_marker_of_a_charuco_board_can_be_read():
    target = Target(squares=(12, 5), square_m=0.022, marker_m=0.016)
    words = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_100)
    picture = (render_target(target, SCENE) / 257).astype(np.uint8)
    _, ids, _ = cv2.aruco.ArucoDetector(words).detectMarkers(picture)
    assert sorted(ids.ravel().tolist()) == list(range(30))


def test_board_is_black_and_white_as_stated_and_has_its_border():
    square_on = replace(SCENE, camera=Camera(), light=replace(SCENE.light, vignetting=0))
    target = replace(CHECKER, centre_m=(0, 0), angle_deg=0, squares=(6, 3))
    picture = render_target(target, square_on, ramp=0) / 65535
    square_px = 0.025 * 2750
    left, top = 479.5 - 3 * square_px, 159.5 - 1.5 * square_px
    middle = [picture[int(top + (j + 0.5) * square_px), int(left + (i + 0.5) * square_px)] for i, j in ((0, 0), (1, 0))]
    assert middle == pytest.approx([target.black, target.white], abs=1e-3)
    assert picture[160, int(left - 0.25 * square_px)] == pytest.approx(target.white, abs=1e-3)
    assert picture[160, int(left - 0.8 * square_px)] < 0.5


@pytest.mark.parametrize("shake_px", [0.0, 0.5])
def test_target_in_a_trials_recording_hangs_where_it_is_told(shake_px):
    target = replace(CHECKER, squares=(11, 3), square_m=0.02)
    scene = replace(SCENE, target=target, door=None, origin_px=(60.0, 20.0), shake_px=shake_px)
    renderer = FrameRenderer(scene, np.zeros_like, n_frames=3, capture_fps=1000.0)
    moved = renderer.scene_motion.shake_px(float(renderer.scene_motion.mid_exposure_s(2)))
    where_m = np.array(target.centre_m) + np.array(moved) * CAMERA.m_per_px
    expected = corners_by_opencv(replace(target, centre_m=tuple(where_m)), CAMERA)
    measured = crossings(renderer.frame(2), expected)
    free = expected[:, 1] > 110  # clear of the tube
    assert (max(np.abs(moved)) > 0.1) == (shake_px > 0)
    assert np.abs(measured - expected)[free].max() < 0.05
