"""Scales and corners in rendered targets against the geometry they were rendered with; seeds from 2000 on."""

import math
from dataclasses import replace

import cv2
import numpy as np
import pytest
from plain_scene import write_video

from vinetrack.experiment.settings import Charuco, Checkerboard, TwoPoints
from vinetrack.laboratory.campaigns import render_target
from vinetrack.laboratory.scene import Camera, Target, preset
from vinetrack.video.axis import Axis
from vinetrack.video.calibration import CalibrationError, calibrate, calibrate_pictures, find_board, fit_plane

DEMO = preset("demo")
CAMERA = Camera(m_per_px=1 / 2400, focal_px=1500, k1=-0.2, k2=0.05, tilt_x_deg=4, tilt_y_deg=-7)
BOARD = Target(squares=(16, 5), square_m=0.020, marker_m=0.014, angle_deg=1.5)
CHECKER = replace(BOARD, kind="checkerboard")
AXIS = ((120.0, 150.0), (840.0, 175.0))
NOT_THIS_BOARD = [{"squares": (14, 5)}, {"squares": (5, 16)}, {"dictionary": "DICT_6X6_250"}]
NOT_THIS_BOARD += [{"dictionary": "DICT_9X9_250"}, {"marker_mm": 17.0}, {}]


def stated(target: Target = BOARD, **changes) -> Charuco | Checkerboard:
    """What the settings say of a target."""
    told = {"kind": target.kind, "image": "board.png", "squares": target.squares, "square_mm": target.square_m * 1000}
    if target.kind == "checkerboard":
        return Checkerboard(**(told | changes))
    return Charuco(**(told | {"marker_mm": target.marker_m * 1000, "dictionary": target.dictionary} | changes))


def picture(target: Target = BOARD, camera: Camera = CAMERA, seed: int = 2000, **scene) -> np.ndarray:
    return render_target(target, replace(DEMO, camera=camera, **scene), seed=seed)


def true_length_m(camera: Camera, ends) -> float:
    plane = camera.plane_from_picture(np.array(ends, dtype=float)) * camera.m_per_px
    return float(np.linalg.norm(plane[1] - plane[0]))


def scale_error(found, camera: Camera = CAMERA, ends=AXIS) -> tuple[float, float]:
    """Relative error of the scale along an axis, and the error it states."""
    axis = found.along(Axis(*ends))
    return axis.m_per_px * math.dist(*ends) / true_length_m(camera, ends) - 1, axis.scale_rel_sigma


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(2000, 2005))
@pytest.mark.parametrize("kind", ["charuco", "checkerboard"])
def test_scale_of_a_random_pose_is_within_a_thousandth_and_its_stated_error(kind, seed):
    rng = np.random.default_rng(seed)
    camera = replace(
        CAMERA, focal_px=rng.uniform(1200, 2800), k1=rng.uniform(-0.3, 0.15), k2=rng.uniform(-0.1, 0.1),
        tilt_x_deg=rng.uniform(-10, 10), tilt_y_deg=rng.uniform(-10, 10),
    )  # fmt: skip
    target = replace(BOARD, kind=kind, centre_m=tuple(rng.uniform(-0.006, 0.006, 2)), angle_deg=rng.uniform(-2, 2))
    found = calibrate_pictures([picture(target, camera, seed)], stated(target))
    error, sigma = scale_error(found, camera)
    assert abs(error) < 1e-3
    assert abs(error) < 3 * sigma
    assert sigma < 5e-4
    assert found.reprojection_px < 0.12


@pytest.mark.slow
def test_stated_errors_of_many_fits_are_neither_too_small_nor_too_large():
    """Corners with noise of a known size, 100 times: z-scores of the scale have a standard deviation of one."""
    rng = np.random.default_rng(2100)
    board_m = BOARD.corners_m()
    exact = CAMERA.picture_from_plane(board_m / CAMERA.m_per_px + np.array(CAMERA.centre_px))
    z = []
    for _ in range(100):
        plane, _ = fit_plane(exact + rng.normal(0, 0.05, exact.shape), board_m, 960, 320)
        found_m = np.linalg.norm(np.diff(plane.plane_m(np.array(AXIS)), axis=0))
        z.append((found_m / true_length_m(CAMERA, AXIS) - 1) / plane.path_rel_sigma(np.array(AXIS)))
    assert np.std(z) == pytest.approx(1.0, abs=0.15)
    assert abs(np.mean(z)) < 0.25


def test_plane_map_agrees_with_opencv_on_a_lens_and_a_pose_of_its_own():
    """The truth from cv2.projectPoints: another hand than the laboratory's camera."""
    matrix = np.array([[1800, 0, 639.5], [0, 1800, 359.5], [0, 0, 1]])
    lens, turn, away = np.array([-0.22, 0.06, 0, 0, 0]), np.array([0.12, -0.15, 0.03]), np.array([-0.2, -0.1, 0.75])
    grid = np.stack(np.meshgrid(np.arange(14), np.arange(8)), axis=-1).reshape(-1, 2) * 0.03
    seen, _ = cv2.projectPoints(np.column_stack([grid, np.zeros(len(grid))]), turn, away, matrix, lens)
    plane, reprojection_px = fit_plane(seen[:, 0], grid, 1280, 720)
    assert reprojection_px < 1e-3
    between = grid[:-15] + 0.013
    truth, _ = cv2.projectPoints(np.column_stack([between, np.zeros(len(between))]), turn, away, matrix, lens)
    assert plane.plane_m(truth[:, 0]) == pytest.approx(between, abs=1e-6)


def test_squares_of_a_few_pixels_are_read_in_an_enlarged_copy():
    target = Target(squares=(20, 7), square_m=0.0075, marker_m=0.0056, dictionary="DICT_4X4_100")
    camera = replace(CAMERA, tilt_x_deg=0, tilt_y_deg=2)
    found = calibrate_pictures([picture(target, camera)], stated(target))
    error, sigma = scale_error(found, camera, ((330, 140), (630, 160)))
    assert found.n_corners > 60
    assert abs(error) < min(2e-3, 3 * sigma)


def test_corners_are_refined_until_they_stand_still():
    """Places along an axis by the lens; where the corners are left half way, they err by 0.045 to 0.09 px."""
    target = Target(squares=(14, 5), square_m=0.015, marker_m=0.011, dictionary="DICT_4X4_100")
    camera = replace(CAMERA, k2=0, tilt_x_deg=0, m_per_px=2.4e-4, focal_px=2600, k1=-0.08, tilt_y_deg=0.8)
    points = np.linspace(*AXIS, 40)
    true_m = np.linalg.norm(np.diff(camera.plane_from_picture(points), axis=0), axis=1).cumsum() * camera.m_per_px
    for seed in (2200, 2201):
        found_m = calibrate_pictures([picture(target, camera, seed)], stated(target)).along(Axis(*AXIS))
        assert np.ptp(found_m.position_m(points)[1:] - true_m) < 0.04 * camera.m_per_px


def test_board_partly_outside_the_picture_is_enough():
    found = calibrate_pictures([picture(replace(BOARD, centre_m=(0.11, 0.03)))], stated())
    assert found.n_corners < 45
    error, sigma = scale_error(found, ends=((420.0, 150.0), (880.0, 170.0)))
    assert abs(error) < min(1e-3, 3 * sigma)


def test_board_printed_by_old_opencv_with_markers_in_the_other_squares():
    words = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_100)
    layout = cv2.aruco.CharucoBoard((10, 6), 0.02, 0.014, words)
    layout.setLegacyPattern(True)
    page = cv2.GaussianBlur(layout.generateImage((600, 360), marginSize=0), (0, 0), 0.8)
    page = cv2.copyMakeBorder(page, 30, 30, 30, 30, cv2.BORDER_CONSTANT, value=255)
    target = Target(squares=(10, 6), square_m=0.020, marker_m=0.014)
    found = calibrate_pictures([page], stated(target))
    assert found.middle.m_per_px == pytest.approx(0.02 / 60, rel=5e-4)
    assert found.n_corners == 45


@pytest.mark.slow
def test_a_small_target_states_a_larger_error():
    small = replace(BOARD, squares=(6, 5), centre_m=(-0.09, 0))
    wide = calibrate_pictures([picture()], stated())
    narrow = calibrate_pictures([picture(small)], stated(small))
    far = ((500.0, 160.0), (900.0, 160.0))
    assert narrow.along(Axis(*far)).scale_rel_sigma > 5 * wide.along(Axis(*far)).scale_rel_sigma
    error, sigma = scale_error(narrow, ends=far)
    assert abs(error) < 3 * sigma
    assert narrow.notes
    assert not wide.notes


@pytest.mark.slow
def test_of_a_moved_target_the_first_picture_shows_the_plane(tmp_path):
    moved = [picture(seed=2002)]
    for k, (x_m, tilt_deg) in enumerate(((0.03, 5), (-0.04, -10), (0.06, 3))):
        moved.append(picture(replace(BOARD, centre_m=(x_m, 0.0)), replace(CAMERA, tilt_y_deg=tilt_deg), seed=2003 + k))
    write_video(tmp_path / "board.avi", np.stack(moved), codec="ffv1", pix_fmt="gray")
    found = calibrate(stated(image="board.avi"), tmp_path, 960, 320)
    error, sigma = scale_error(found)
    assert abs(error) < min(1e-3, 3 * sigma)
    alone = calibrate_pictures([picture(seed=2002)], stated())
    assert found.along(Axis(*AXIS)).scale_rel_sigma < 1.2 * alone.along(Axis(*AXIS)).scale_rel_sigma


def test_two_points_and_a_length(tmp_path):
    settings = TwoPoints(kind="two_points", from_px=(100, 50), to_px=(400, 450), length_mm=250)
    found = calibrate(settings, tmp_path, 960, 540)
    axis = found.along(Axis((10, 20), (10, 520)))
    assert axis.m_per_px == pytest.approx(0.5e-3)
    assert axis.scale_rel_sigma == pytest.approx(math.sqrt(2) * 0.5 / 500)
    assert axis.position_m(np.array([[10, 20], [200, 120], [10, 520]])) == pytest.approx([0, 0.05, 0.25])


@pytest.mark.slow
@pytest.mark.parametrize("changes", NOT_THIS_BOARD)
def test_a_charuco_board_that_is_not_as_stated_or_bent_is_refused(changes):
    seen = picture()
    if not changes:
        x, y = np.meshgrid(np.arange(960, dtype=np.float32), np.arange(320, dtype=np.float32))
        seen = cv2.remap(seen, x, y + 6 * np.sin(x / 90), cv2.INTER_CUBIC)
    with pytest.raises(CalibrationError):
        calibrate_pictures([seen], stated(**changes))


@pytest.mark.slow
@pytest.mark.parametrize("board", [stated(), stated(CHECKER)])
def test_picture_without_a_target(board):
    empty = np.random.default_rng(2005).integers(60, 90, (320, 960)).astype(np.uint8)
    with pytest.raises(CalibrationError):
        calibrate_pictures([empty], board)
    assert find_board(empty) is None


def test_file_that_is_no_picture(tmp_path):
    (tmp_path / "board.png").write_bytes(b"no picture")
    with pytest.raises(CalibrationError):
        calibrate(stated(), tmp_path, 960, 320)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("squares", "name"), [((14, 5), "DICT_4X4_50"), ((7, 9), "DICT_5X5_50"), ((12, 9), "DICT_6X6_100"), ((9, 6), "")]
)
def test_a_printed_board_is_named_from_a_picture_alone(squares, name):
    if name:
        words = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))
        page = cv2.aruco.CharucoBoard(squares, 80, 60, words).generateImage((squares[0] * 80, squares[1] * 80))
    else:
        page = (60 + 150 * np.kron(np.indices(squares[::-1]).sum(axis=0) % 2, np.ones((36, 36)))).astype(np.uint8)
    seen = find_board(np.pad(page, 60, constant_values=205))
    assert seen is not None
    if name:
        assert (seen.kind, seen.squares, seen.dictionary) == ("charuco", squares, name)
        assert seen.marker_share == pytest.approx(0.75, abs=0.02)
    else:
        assert (seen.kind, sorted(seen.squares)) == ("checkerboard", sorted(squares))
