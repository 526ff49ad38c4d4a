"""The pictures show what the truth says: measured in them by area, centroid and correlation, never by a tracker.

Truth here is geometry that the renderer does not use: the area of a strip, the projection of OpenCV, a known variance.
"""

from __future__ import annotations

import math
from dataclasses import replace

import cv2
import numpy as np
import pytest

from vinetrack.laboratory.render import FrameRenderer
from vinetrack.laboratory.scene import Ball, Camera, Door, Light, Scene, Sensor, Tube, preset

FPS = 1000.0
CLEAN = preset("clean")
SMALL = Camera(width_px=480, height_px=128)
NO_NOISE = Sensor(noise=False, fixed_pattern=0, bit_depth=16)
EVEN = Light(vignetting=0)


def steadily(lead_m_s: float, from_s: float = 0.0):
    return lambda time_s: lead_m_s * np.clip(np.asarray(time_s) - from_s, 0, None)


def still(time_s):
    return np.zeros_like(np.asarray(time_s, dtype=float))


def renderer(scene: Scene, motion=None, n_frames: int = 60, **settings) -> FrameRenderer:
    return FrameRenderer(scene, motion or steadily(2.0), n_frames=n_frames, capture_fps=FPS, **settings)


def axis_rows(scene: Scene) -> slice:
    """Rows in which the tip's outline is flat, with 5 px to spare."""
    flat_px = scene.subject.diameter_m / 2 / scene.camera.m_per_px * (1 - scene.subject.tip_roundness) - 5
    middle = scene.camera.centre_px[1]
    return slice(math.ceil(middle - flat_px), math.floor(middle + flat_px) + 1)


FILM, BEHIND = 52428.0, 6553.0
"""Levels of `clean` film (0.8) and of what is behind it (0.1) in 16 bits."""


def length_from_area(levels: np.ndarray, rows: slice) -> float:
    """Length of the tube on its axis, px: the area of a strip over its width."""
    return float(((levels[rows].astype(float).mean(axis=0) - BEHIND) / (FILM - BEHIND)).sum())


# --- the leading edge


@pytest.mark.parametrize("exposure_s", [1e-6, 9.9e-4])
def test_tip_is_where_the_area_says_at_any_exposure(exposure_s):
    scene = replace(CLEAN, camera=SMALL)
    shots = renderer(scene, steadily(2.0), exposure_s=exposure_s)
    truth = shots.truth(np.arange(60))
    rows = axis_rows(scene)
    mouth_px = 60.0
    for index in (3, 17, 41, 55):
        measured = mouth_px + length_from_area(shots.frame(index), rows)
        assert measured == pytest.approx(truth.tip_x_px[index], abs=0.01)


@pytest.mark.parametrize("angle_deg", [0, 37, 90, 215])
def test_growth_in_any_direction_adds_the_tubes_width_times_its_travel(angle_deg):
    scene = replace(CLEAN, camera=Camera(width_px=360, height_px=360), growth_angle_deg=angle_deg)
    shots = renderer(scene, steadily(2.0), exposure_s=3e-4)
    truth = shots.truth(np.array([4, 22]))
    radius_px = scene.subject.diameter_m / 2 / scene.camera.m_per_px
    early, late = (shots.frame(index).astype(float) for index in (4, 22))
    travel_px = (late - early).sum() / (FILM - BEHIND) / (2 * radius_px)
    assert travel_px == pytest.approx(np.diff(truth.lead_px)[0], abs=0.01)
    step = np.array([np.diff(truth.tip_x_px)[0], np.diff(truth.tip_y_px)[0]])
    angle = math.radians(angle_deg)
    assert step == pytest.approx(np.diff(truth.lead_px)[0] * np.array([math.cos(angle), math.sin(angle)]), abs=1e-9)


def test_truth_is_in_metres_along_the_growth_and_at_mid_exposure():
    shots = renderer(replace(CLEAN, camera=SMALL), steadily(3.0, from_s=0.01), exposure_s=4e-4)
    truth = shots.truth(np.arange(60))
    mid_s = np.arange(60) / FPS + 2e-4
    assert truth.time_s == pytest.approx(mid_s)
    assert truth.lead_position_m == pytest.approx(3.0 * np.clip(mid_s - 0.01, 0, None), abs=1e-12)
    assert truth.release_s == pytest.approx(0.01, abs=2e-4)
    assert np.diff(truth.lead_px) == pytest.approx(np.diff(truth.lead_position_m) / SMALL.m_per_px, abs=1e-9)


def test_accelerating_tip_lies_off_mid_exposure_only_by_the_known_second_order():
    """Area measures the mean over the exposure, which is a·T²/24 ahead of the middle."""
    scene = replace(CLEAN, camera=SMALL)
    acceleration_m_s2, exposure_s = 400.0, 9e-4
    shots = renderer(scene, lambda t: 0.5 * acceleration_m_s2 * np.asarray(t) ** 2, exposure_s=exposure_s, n_frames=26)
    truth = shots.truth(np.array([20]))
    measured = 60.0 + length_from_area(shots.frame(20), axis_rows(scene))
    ahead_px = acceleration_m_s2 * exposure_s**2 / 24 / scene.camera.m_per_px
    assert measured - truth.tip_x_px[0] == pytest.approx(ahead_px, abs=0.005)


def test_distorted_and_tilted_tip_is_where_opencv_projects_it():
    camera = Camera(focal_px=900, k1=-0.3, k2=0.1, tilt_x_deg=6, tilt_y_deg=-9)
    scene = replace(CLEAN, camera=camera, growth_angle_deg=20)
    truth = renderer(scene).truth(np.arange(60))
    ux, uy = scene.direction
    offset_px = np.array(scene.origin) + truth.lead_px[:, None] * np.array([ux, uy]) - camera.centre_px
    plane_m = np.column_stack([offset_px, np.zeros(60)]) * camera.m_per_px
    about_x, _ = cv2.Rodrigues(np.radians([camera.tilt_x_deg, 0, 0]))
    about_y, _ = cv2.Rodrigues(np.radians([0, camera.tilt_y_deg, 0]))
    turn, _ = cv2.Rodrigues(about_y @ about_x)
    away_m = np.array([0, 0, camera.focal_px * camera.m_per_px])
    lens = np.array([camera.k1, camera.k2, 0, 0, 0])
    expected, _ = cv2.projectPoints(plane_m, turn, away_m, camera.matrix, lens)
    assert np.column_stack([truth.tip_x_px, truth.tip_y_px]) == pytest.approx(expected[:, 0], abs=1e-6)


def test_camera_maps_there_and_back():
    camera = Camera(focal_px=900, k1=-0.3, k2=0.1, tilt_x_deg=6, tilt_y_deg=-9)
    points = np.random.default_rng(0).uniform([0, 0], [959, 319], (200, 2))
    assert camera.picture_from_plane(camera.plane_from_picture(points)) == pytest.approx(points, abs=1e-8)


# --- what moves with what


def test_everted_wall_stays_where_it_is():
    tube = Tube(opacity=0.6, tail_opacity=0.0, texture=0.3)
    scene = replace(CLEAN, camera=SMALL, subject=tube)
    shots = renderer(scene, steadily(2.0))
    truth = shots.truth(np.array([20, 40]))
    everted = slice(70, int(truth.tip_x_px[0]) - 30)
    early, late = (shots.frame(index)[40:88, everted].astype(float) for index in (20, 40))
    assert early.std() > 1500
    assert np.abs(early - late).max() <= 1


def test_tail_moves_at_twice_the_speed_of_the_tip():
    tube = Tube(opacity=0.0, brightness=0.8, tail_opacity=0.9, tail_texture=0.4, texture=0, specular=0, tip_glow=0)
    scene = replace(CLEAN, camera=SMALL, subject=replace(tube, length_m=0.16))
    shots = renderer(scene, steadily(2.0), exposure_s=1e-6)
    truth = shots.truth(np.array([40, 41]))
    window = slice(150, 270)
    early, late = (shots.frame(index)[58:70, window].astype(np.float32) for index in (40, 41))
    (shift, _), response = cv2.phaseCorrelate(early, late, cv2.createHanningWindow((120, 12), cv2.CV_32F))
    assert response > 0.3
    assert shift == pytest.approx(2 * np.diff(truth.lead_px)[0], abs=0.3)


def test_payload_leaves_at_the_end_and_flies_on_at_the_speed_of_the_tail():
    tube = replace(CLEAN.subject, length_m=0.05, payload_diameter_m=0.008, payload_brightness=0.45)
    scene = replace(CLEAN, camera=SMALL, subject=tube)
    shots = renderer(scene, lambda t: np.minimum(2.0 * np.asarray(t), 0.05), n_frames=60, exposure_s=3e-4)
    places = []
    for index in (34, 38):
        ahead = shots.frame(index)[:, 255:].astype(float) - BEHIND
        places.append((ahead.sum(axis=0) @ np.arange(255, 480)) / ahead.sum())
    expected_px = 4 * 4.0 / FPS / scene.camera.m_per_px
    assert places[1] - places[0] == pytest.approx(expected_px, abs=0.02)
    assert shots.truth(np.array([40])).lead_position_m[0] == pytest.approx(0.05)


def test_evenly_bright_ball_has_its_centroid_at_the_truth():
    camera = Camera(width_px=160, height_px=400, m_per_px=1 / 3000)
    scene = replace(CLEAN, camera=camera, subject=Ball(diameter_m=0.015), growth_angle_deg=90)
    shots = renderer(scene, lambda t: 0.5 * 9.81 * np.asarray(t) ** 2, n_frames=160, exposure_s=9e-4)
    shots._subject._surface[:] = 0.9
    truth = shots.truth(np.array([130]))
    extra = shots.frame(130).astype(float) - BEHIND
    row = (extra.sum(axis=1) @ np.arange(400)) / extra.sum()
    assert row == pytest.approx(truth.tip_y_px[0] - 0.0075 * 3000, abs=0.01)


def test_sway_moves_the_tip_sideways_as_the_truth_says():
    wobbling = replace(CLEAN.subject, wobble_px=8.0, length_m=0.12)
    scene = replace(CLEAN, camera=SMALL, subject=wobbling)
    shots = renderer(scene, steadily(2.5), n_frames=60)
    truth = shots.truth(np.arange(60))
    index = int(np.argmax(np.abs(truth.tip_y_px - 63.5)))
    assert abs(truth.tip_y_px[index] - 63.5) > 4
    column = int(truth.tip_x_px[index]) - 30
    lit = shots.frame(index)[:, column].astype(float) - BEHIND
    middle = (lit @ np.arange(128)) / lit.sum()
    along = (column - scene.origin[0]) * scene.camera.m_per_px / 0.12
    at_tip = (truth.tip_x_px[index] - scene.origin[0]) * scene.camera.m_per_px / 0.12
    expected = 63.5 + (truth.tip_y_px[index] - 63.5) * (along / at_tip) ** 2
    assert middle == pytest.approx(expected, abs=0.05)


def test_door_is_closed_until_the_release_then_swings_out_of_the_way():
    scene = replace(CLEAN, door=Door(lead_s=0.0, swing_s=0.01), camera=Camera(width_px=480, height_px=256))
    shots = renderer(scene, steadily(0.05, from_s=0.02), n_frames=60)
    frames = [shots.frame(index).astype(float) for index in (2, 15, 26, 50)]
    assert (frames[0] == frames[1]).all()
    before_tip = (slice(100, 156), slice(98, 110))
    assert frames[0][before_tip].max() > 0.5 * 65535
    assert np.abs(frames[2] - frames[0]).max() > 0.3 * 65535
    assert frames[3][130:156, 112:140].max() < 0.11 * 65535  # nothing left across the path below the axis


def test_shake_moves_the_background_as_the_truth_says():
    scene = replace(preset("shake"), shake_px=0.6, sensor=NO_NOISE, light=EVEN, door=None, subject=replace(Tube()))
    shots = renderer(scene, still, n_frames=40)
    truth = shots.truth(np.array([3, 30]))
    window = (slice(10, 110), slice(300, 700))
    early, late = (shots.frame(index)[window].astype(np.float32) for index in (3, 30))
    _, warp = cv2.findTransformECC(early, late, np.eye(2, 3, dtype=np.float32), cv2.MOTION_TRANSLATION)
    moved = np.diff(truth.tip_x_px)[0], np.diff(truth.tip_y_px)[0]
    assert 1 < math.hypot(*moved) < 3
    assert warp[:, 2] == pytest.approx(moved, abs=0.02)
    assert truth.lead_position_m == pytest.approx([0, 0])


# --- light and sensor


def test_noise_has_the_variance_of_shot_and_read_noise():
    sensor = Sensor(full_well_e=4000, read_noise_e=30, fixed_pattern=0, bit_depth=16)
    scene = replace(CLEAN, sensor=sensor)
    shots = renderer(scene, still)
    window = (slice(0, 100), slice(300, 900))
    frames = np.array([shots.frame(index)[window] for index in range(12)]) / 65535
    expected = (0.1 * 4000 + 30**2) / 4000**2
    assert frames.mean() == pytest.approx(0.1, abs=1e-4)
    assert frames.var(axis=0, ddof=1).mean() == pytest.approx(expected, rel=0.01)


def test_lamps_flicker_by_what_is_left_after_the_exposure():
    light = Light(flicker=0.2, flicker_Hz=100.0, vignetting=0)
    shots = renderer(replace(CLEAN, light=light), still, exposure_s=9e-4, n_frames=100)
    levels = np.array([shots.frame(index)[:20, 400:].mean() for index in range(0, 100)]) / 6553.5
    spectrum = np.abs(np.fft.rfft(levels - 1)) / 50
    begin_s = np.arange(20000) * 9e-4 / 20000
    left = abs(np.exp(2j * np.pi * 100 * begin_s).mean())
    assert spectrum[10] == pytest.approx(0.2 * left, rel=1e-3)
    assert np.delete(spectrum, 10).max() < 1e-3


def test_ticks_of_the_ruler_are_a_millimetre_apart():
    scene = replace(CLEAN, backdrop=replace(CLEAN.backdrop, ruler=True))
    picture = renderer(scene, still).frame(0).astype(float)
    row = 160 + round(1.9 * 0.012 * 2750 + 14) + 2
    dark = picture[row].max() - picture[row]
    centres = []
    for tick_mm in range(5, 305):
        expected = 60 + tick_mm * 2.75
        near = slice(round(expected) - 1, round(expected) + 2)
        centres.append((dark[near] @ np.arange(near.start, near.stop)) / dark[near].sum())
    slope, offset = np.polyfit(np.arange(5, 305), centres, 1)
    assert slope == pytest.approx(2.75, rel=5e-5)
    assert offset == pytest.approx(60, abs=0.15)


# --- frames, faults, refusals


def test_same_seed_same_pictures_other_seed_others():
    scene = replace(preset("demo"), camera=SMALL)
    one, again, other = (renderer(scene, seed=seed).frame(20) for seed in (4, 4, 5))
    assert (one == again).all()
    assert (one != other).mean() > 0.5


def test_a_frame_does_not_depend_on_which_were_rendered_before():
    scene = replace(preset("shake"), camera=SMALL)
    shots = renderer(scene)
    alone = renderer(scene).frame(30)
    for index in range(5):
        shots.frame(index)
    assert (shots.frame(30) == alone).all()
