"""Scales found in rendered targets against the geometry they were rendered with.

Poses are drawn from seeds from 2000 on, which tuned nothing (see benchmarks/calibration_accuracy.py).
"""

from __future__ import annotations

import math
from dataclasses import replace

import cv2
import numpy as np
import pytest

from vinetrack.experiment.settings import Charuco, Checkerboard, MmPerPx, TwoPoints
from vinetrack.laboratory.filming import render_calibration_clip, render_recording, render_target
from vinetrack.laboratory.scene import Camera, Encoding, Light, Sensor, Target, Tube, preset
from vinetrack.video.calibration import CalibrationError, PlaneMap, calibrate, calibrate_pictures, fit_planes

DEMO = preset("demo")
CAMERA = Camera(m_per_px=1 / 2400, focal_px=1500, k1=-0.2, k2=0.05, tilt_x_deg=4, tilt_y_deg=-7)
BOARD = Target(squares=(16, 5), square_m=0.020, marker_m=0.014, angle_deg=1.5)
CHECKER = replace(BOARD, kind="checkerboard")


def charuco(target: Target = BOARD, **changes) -> Charuco:
    stated = {
        "kind": "charuco", "image": "board.png", "squares": target.squares, "square_mm": target.square_m * 1000,
        "marker_mm": target.marker_m * 1000, "dictionary": target.dictionary,
    }  # fmt: skip
    return Charuco(**(stated | changes))


def checkerboard(target: Target = CHECKER, **changes) -> Checkerboard:
    stated = {"kind": "checkerboard", "image": "board.png", "squares": target.squares, "square_mm": 20.0}
    return Checkerboard(**(stated | changes))


def picture(target: Target = BOARD, camera: Camera = CAMERA, seed: int = 2000, **scene) -> np.ndarray:
    return render_target(target, replace(DEMO, camera=camera, **scene), seed=seed)


def true_length_m(camera: Camera, ends) -> float:
    plane = camera.plane_from_picture(np.array(ends, dtype=float)) * camera.m_per_px
    return float(np.linalg.norm(plane[1] - plane[0]))


AXIS = ((120.0, 150.0), (840.0, 175.0))


def scale_error(found, camera: Camera = CAMERA, ends=AXIS) -> tuple[float, float]:
    """Relative error of the scale along an axis, and the error it states."""
    axis = found.along(*ends)
    return axis.m_per_px * math.dist(*ends) / true_length_m(camera, ends) - 1, axis.scale_rel_sigma


# --- targets in any pose


@pytest.mark.parametrize("seed", range(2000, 2008))
@pytest.mark.parametrize("kind", ["charuco", "checkerboard"])
def test_scale_of_a_random_pose_is_within_a_thousandth_and_its_stated_error(kind, seed):
    rng = np.random.default_rng(seed)
    camera = replace(
        CAMERA, focal_px=rng.uniform(1200, 2800), k1=rng.uniform(-0.3, 0.15), k2=rng.uniform(-0.1, 0.1),
        tilt_x_deg=rng.uniform(-10, 10), tilt_y_deg=rng.uniform(-10, 10),
    )  # fmt: skip
    target = replace(BOARD, kind=kind, centre_m=tuple(rng.uniform(-0.006, 0.006, 2)), angle_deg=rng.uniform(-2, 2))
    board = charuco(target) if kind == "charuco" else checkerboard(target)
    found = calibrate_pictures([picture(target, camera, seed)], board)
    error, stated = scale_error(found, camera)
    assert abs(error) < 1e-3
    assert abs(error) < 3 * stated
    assert stated < 5e-4
    assert found.reprojection_px < 0.12


def test_stated_errors_of_many_fits_are_neither_too_small_nor_too_large():
    """Corners with noise of a known size, 100 times: z-scores of the scale have a standard deviation of one."""
    rng = np.random.default_rng(2100)
    board_m = BOARD.corners_m()
    exact = CAMERA.picture_from_plane(board_m / CAMERA.m_per_px + np.array(CAMERA.centre_px))
    z = []
    for _ in range(100):
        fit = fit_planes([(exact + rng.normal(0, 0.05, exact.shape), board_m)], 960, 320)
        found_m = fit.maps[0].length_m(*AXIS)
        z.append((found_m / true_length_m(CAMERA, AXIS) - 1) / fit.maps[0].length_rel_sigma(*AXIS))
    assert np.std(z) == pytest.approx(1.0, abs=0.15)
    assert abs(np.mean(z)) < 0.25


def test_exact_corners_give_the_plane_back_to_rounding():
    board_m = BOARD.corners_m()
    exact = CAMERA.picture_from_plane(board_m / CAMERA.m_per_px + np.array(CAMERA.centre_px))
    fit = fit_planes([(exact, board_m)], 960, 320)
    points = np.random.default_rng(2101).uniform([100, 60], [860, 260], (50, 2))
    truth_m = (CAMERA.plane_from_picture(points) - np.array(CAMERA.centre_px)) * CAMERA.m_per_px
    assert fit.maps[0].plane_m(points) == pytest.approx(truth_m, abs=2e-7)
    assert fit.reprojection_px < 1e-3


def test_plane_map_agrees_with_opencv_on_a_lens_and_a_pose_of_its_own():
    """The truth from cv2.projectPoints: another hand than the laboratory's camera."""
    matrix = np.array([[1800, 0, 639.5], [0, 1800, 359.5], [0, 0, 1]])
    lens, turn, away = np.array([-0.22, 0.06, 0, 0, 0]), np.array([0.12, -0.15, 0.03]), np.array([-0.2, -0.1, 0.75])
    grid = np.stack(np.meshgrid(np.arange(14), np.arange(8)), axis=-1).reshape(-1, 2) * 0.03
    seen, _ = cv2.projectPoints(np.column_stack([grid, np.zeros(len(grid))]), turn, away, matrix, lens)
    fit = fit_planes([(seen[:, 0], grid)], 1280, 720)
    between = grid[:-15] + 0.013
    truth, _ = cv2.projectPoints(np.column_stack([between, np.zeros(len(between))]), turn, away, matrix, lens)
    assert fit.maps[0].plane_m(truth[:, 0]) == pytest.approx(between, abs=1e-6)


def test_distances_do_not_depend_on_where_the_axis_lies():
    found = calibrate_pictures([picture()], charuco())
    for ends in (((150, 60), (800, 60)), ((150, 260), (800, 240)), ((480, 60), (470, 260)), ((160, 250), (820, 70))):
        error, _ = scale_error(found, ends=ends)
        assert abs(error) < 1e-3


def test_position_along_an_axis_is_in_metres_and_straightens_the_lens():
    found = calibrate_pictures([picture()], charuco())
    start, direction_m = np.array([-0.14, 0.004]), np.array([1.0, 0.05]) / math.hypot(1, 0.05)
    travel_m = np.linspace(0, 0.27, 12)
    plane_m = start + travel_m[:, None] * direction_m
    seen_px = CAMERA.picture_from_plane(plane_m / CAMERA.m_per_px + np.array(CAMERA.centre_px))
    axis = found.along(seen_px[0], seen_px[-1])
    assert axis.position_m(seen_px) == pytest.approx(travel_m, abs=5e-5)
    even_m = axis.m_per_px * np.linalg.norm(seen_px - seen_px[0], axis=1)
    assert np.abs(even_m - travel_m).max() > 5e-4  # one scale for all would be off by this much


def test_upright_picture():
    camera = Camera(width_px=320, height_px=960, m_per_px=1 / 2400, tilt_x_deg=6)
    target = Target(squares=(4, 14), square_m=0.022, marker_m=0.016)
    found = calibrate_pictures([picture(target, camera)], charuco(target))
    error, stated = scale_error(found, camera, ((160, 150), (160, 800)))
    assert abs(error) < min(1e-3, 3 * stated)


def test_checkerboard_counted_the_other_way_round():
    found = calibrate_pictures([picture(CHECKER)], checkerboard(squares=(5, 16)))
    assert abs(scale_error(found)[0]) < 1e-3


def test_twelve_bit_picture_in_poor_light():
    dim = picture(sensor=Sensor(bit_depth=12), light=Light(vignetting=0.4)) // 5
    assert dim.dtype == np.uint16
    assert dim.max() < 700
    error, stated = scale_error(calibrate_pictures([dim], charuco()))
    assert abs(error) < min(1e-3, 3 * stated)


def test_squares_of_a_few_pixels_are_read_in_an_enlarged_copy():
    target = Target(squares=(20, 7), square_m=0.0075, marker_m=0.0056, dictionary="DICT_4X4_100")
    found = calibrate_pictures([picture(target, replace(CAMERA, tilt_x_deg=0, tilt_y_deg=2))], charuco(target))
    error, stated = scale_error(found, replace(CAMERA, tilt_x_deg=0, tilt_y_deg=2), ((330, 140), (630, 160)))
    assert found.n_corners > 60
    assert abs(error) < min(2e-3, 3 * stated)


def test_board_partly_outside_the_picture_is_enough():
    target = replace(BOARD, centre_m=(0.11, 0.03))
    found = calibrate_pictures([picture(target)], charuco(target))
    assert found.n_corners < 45
    error, stated = scale_error(found, ends=((420.0, 150.0), (880.0, 170.0)))
    assert abs(error) < min(1e-3, 3 * stated)


def test_board_printed_by_old_opencv_with_markers_in_the_other_squares():
    words = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_100)
    layout = cv2.aruco.CharucoBoard((10, 6), 0.02, 0.014, words)
    layout.setLegacyPattern(True)
    page = cv2.GaussianBlur(layout.generateImage((600, 360), marginSize=0), (0, 0), 0.8)
    page = cv2.copyMakeBorder(page, 30, 30, 30, 30, cv2.BORDER_CONSTANT, value=255)
    target = Target(squares=(10, 6), square_m=0.020, marker_m=0.014)
    found = calibrate_pictures([page], charuco(target))
    assert found.m_per_px == pytest.approx(0.02 / 60, rel=5e-4)
    assert found.n_corners == 45


def test_a_small_target_states_a_larger_error():
    small = replace(BOARD, squares=(6, 5), centre_m=(-0.09, 0))
    wide = calibrate_pictures([picture()], charuco())
    narrow = calibrate_pictures([picture(small)], charuco(small))
    far = ((500.0, 160.0), (900.0, 160.0))
    assert narrow.along(*far).scale_rel_sigma > 5 * wide.along(*far).scale_rel_sigma
    error, stated = scale_error(narrow, ends=far)
    assert abs(error) < 3 * stated
    assert any("spans only" in note for note in narrow.notes)
    assert not wide.notes


def test_the_scale_of_a_target_holds_across_its_middle():
    found = calibrate_pictures([picture()], charuco())
    left, top, right, bottom = found.covered_px
    assert right - left == pytest.approx(14 * 0.02 * 2400, rel=0.1)
    ends = ((left, (top + bottom) / 2), (right, (top + bottom) / 2))
    assert found.m_per_px == pytest.approx(true_length_m(CAMERA, ends) / (right - left), rel=1e-3)
    assert 0 < found.scale_rel_sigma < 5e-4


# --- pictures, clips, the recording itself


def test_picture_in_a_file(tmp_path):
    cv2.imwrite(str(tmp_path / "board.png"), picture())
    found = calibrate(charuco(), tmp_path, 960, 320)
    assert abs(scale_error(found)[0]) < 1e-3
    assert found.n_pictures == 1


def test_still_clip_averages_the_corners(tmp_path):
    render_calibration_clip(BOARD, replace(DEMO, camera=CAMERA), 30, tmp_path / "board.mp4", seed=2001)
    found = calibrate(charuco(image="board.mp4"), tmp_path, 960, 320)
    error, stated = scale_error(found)
    assert found.n_pictures == 10
    assert abs(error) < min(1e-3, 3 * stated)
    assert not found.notes


def test_moved_target_shows_the_plane_first_and_the_lens_throughout(tmp_path):
    moves = ({}, *({"centre_m": (x, 0.0), "tilt_y_deg": tilt} for x, tilt in ((0.03, 5), (-0.04, -10), (0.06, 3))))
    scene = replace(DEMO, camera=CAMERA)
    render_calibration_clip(BOARD, scene, 4, tmp_path / "board.avi", seed=2002, moves=moves)
    found = calibrate(charuco(image="board.avi"), tmp_path, 960, 320)
    error, stated = scale_error(found)
    assert abs(error) < min(1e-3, 3 * stated)
    assert "the target moves by" in found.notes[0]
    alone = calibrate_pictures([picture(seed=2002)], charuco())
    assert found.along(*AXIS).scale_rel_sigma < 1.2 * alone.along(*AXIS).scale_rel_sigma


def test_target_hanging_in_the_trials_own_recording(tmp_path):
    target = Target(squares=(16, 3), square_m=0.016, marker_m=0.0115, centre_m=(0.02, 0.032))
    scene = replace(
        DEMO, camera=CAMERA, target=target, subject=Tube(length_m=0.25), origin_px=(60.0, 110.0),
        backdrop=replace(DEMO.backdrop, ruler=False),
    )  # fmt: skip
    render_recording(
        scene, lambda t: np.minimum(3.0 * np.asarray(t), 0.25), n_frames=60, capture_fps=1069,
        out_path=tmp_path / "trial.mp4", seed=2003,
    )  # fmt: skip
    found = calibrate(charuco(target, image="trial.mp4"), tmp_path, 960, 320)
    error, stated = scale_error(found, ends=((150.0, 230.0), (820.0, 240.0)))
    assert abs(error) < min(1e-3, 3 * stated)


def test_folder_of_pictures(tmp_path):
    scene = replace(DEMO, camera=CAMERA, encoding=Encoding(codec="png"))
    render_calibration_clip(CHECKER, scene, 3, tmp_path / "board", seed=2004)
    found = calibrate(checkerboard(image="board"), tmp_path, 960, 320)
    assert found.n_pictures == 3
    assert abs(scale_error(found)[0]) < 1e-3


# --- scales given


def test_two_points_and_a_length(tmp_path):
    settings = TwoPoints(kind="two_points", from_px=(100, 50), to_px=(400, 450), length_mm=250)
    found = calibrate(settings, tmp_path, 960, 540)
    axis = found.along((10, 20), (10, 520))
    assert axis.m_per_px == pytest.approx(0.5e-3)
    assert axis.scale_rel_sigma == pytest.approx(math.sqrt(2) * 0.5 / 500)
    assert axis.position_m(np.array([[10, 20], [200, 120], [10, 520]])) == pytest.approx([0, 0.05, 0.25])


def test_scale_given_as_mm_per_px(tmp_path):
    found = calibrate(MmPerPx(kind="mm_per_px", mm_per_px=0.27307), tmp_path, 384, 800)
    assert found.m_per_px == pytest.approx(0.27307e-3)
    assert math.isnan(found.scale_rel_sigma)
    assert math.isnan(found.reprojection_px)
    assert "nothing is known of its error" in found.notes[0]


def test_plane_seen_square_on_is_a_scale():
    plane = PlaneMap.from_scale(2e-4, 640, 480)
    assert plane.length_m((10, 20), (310, 420)) == pytest.approx(0.1)
    assert plane.length_rel_sigma((10, 20), (310, 420)) == 0


# --- what is wrong is said


@pytest.fixture(scope="module")
def board_picture():
    return picture()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"squares": (14, 5)}, r"do not lie as on a board of 14 × 5 squares .* correct `squares`"),
        ({"squares": (5, 16)}, r"do not lie as on a board of 5 × 16 squares .* correct `squares`"),
        ({"dictionary": "DICT_6X6_250"}, r"no marker of DICT_6X6_250 is seen, but \d+ of DICT_4X4_\d+; correct `dict"),
        ({"dictionary": "DICT_9X9_250"}, r"there is no marker dictionary DICT_9X9_250; choose one such as"),
        ({"marker_mm": 17.0}, r"markers measure 1[34]\S* mm beside squares of 20 mm, not 17; measure both"),
    ],
)
def test_charuco_that_is_not_as_stated(board_picture, changes, message):
    with pytest.raises(CalibrationError, match=r"board\.png: " + f".*{message}"):
        calibrate_pictures([board_picture], charuco(**changes))


def test_checkerboard_of_another_size_is_named():
    with pytest.raises(CalibrationError, match=r"no checkerboard of 9 × 7 squares is seen, but 16 × 5 squares are"):
        calibrate_pictures([picture(CHECKER)], checkerboard(squares=(9, 7)))


@pytest.mark.parametrize("board", [charuco(), checkerboard()])
def test_picture_without_a_target(board):
    empty = np.random.default_rng(2005).integers(60, 90, (320, 960)).astype(np.uint8)
    with pytest.raises(CalibrationError, match=r"is seen; (check `dictionary`|the whole board)"):
        calibrate_pictures([empty], board)


def test_too_few_corners(board_picture):
    with pytest.raises(CalibrationError, match=r"only [0-7] corners of the board can be read .* show more of it"):
        calibrate_pictures([np.where(np.arange(960) < 260, board_picture, 120).astype(np.uint8)[:150]], charuco())


def test_blurred_beyond_reading():
    blurred = cv2.GaussianBlur(picture(), (0, 0), 9)
    with pytest.raises(CalibrationError, match="in focus"):
        calibrate_pictures([blurred], charuco())


def test_unreadable_frames_of_a_clip_are_left_out(board_picture):
    empty = np.full_like(board_picture, 90)
    found = calibrate_pictures([board_picture, empty, board_picture], charuco())
    assert found.n_pictures == 2
    assert found.notes == ("board.png: the target is read in 2 of 3 pictures",)


def test_bent_board_is_refused(board_picture):
    ripple = np.float32(6 * np.sin(np.arange(960) / 90))
    x, y = np.meshgrid(np.arange(960, dtype=np.float32), np.arange(320, dtype=np.float32))
    bent = cv2.remap(board_picture, x, y + ripple[None, :], cv2.INTER_CUBIC)
    with pytest.raises(CalibrationError, match="px from where a flat board of 16 × 5 squares has them"):
        calibrate_pictures([bent], charuco())


def test_picture_of_another_size_than_the_recordings(tmp_path):
    cv2.imwrite(str(tmp_path / "board.png"), picture())
    with pytest.raises(
        CalibrationError, match=r"board\.png is 960 × 320 pixels but the recordings are 1280 × 720; film"
    ):
        calibrate(charuco(), tmp_path, 1280, 720)


@pytest.mark.parametrize(("content", "message"), [(None, "there is no such file"), (b"", "empty"), (b"no picture", "")])
def test_file_that_is_no_picture(tmp_path, content, message):
    if content is not None:
        (tmp_path / "board.png").write_bytes(content)
    with pytest.raises(CalibrationError, match=rf"board\.png.*{message}"):
        calibrate(charuco(), tmp_path, 960, 320)
