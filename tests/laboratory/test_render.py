"""The pictures show what the truth says, measured by area, centroid and correlation, never by a tracker."""

import math
from dataclasses import replace

import av
import cv2
import numpy as np
import pytest

from vinetrack.laboratory.filming import render_recording
from vinetrack.laboratory.render import FrameRenderer
from vinetrack.laboratory.scene import Ball, Camera, Door, Encoding, Light, Scene, Sensor, Tube, preset

FPS = 1000.0
CLEAN = preset("clean")
SMALL = Camera(width_px=480, height_px=128)
NO_NOISE = Sensor(noise=False, fixed_pattern=0, bit_depth=16)
EVEN = Light(vignetting=0)


def steadily(lead_m_s: float, from_s: float = 0.0):
    return lambda time_s: lead_m_s * np.clip(np.asarray(time_s) - from_s, 0, None)


def renderer(scene: Scene, motion=None, n_frames: int = 60, **settings) -> FrameRenderer:
    return FrameRenderer(scene, motion or steadily(2.0), n_frames=n_frames, capture_fps=FPS, **settings)


FILM, BEHIND = 52428.0, 6553.0
"""Levels of `clean` film (0.8) and of what is behind it (0.1) in 16 bits."""


@pytest.mark.slow
@pytest.mark.parametrize("exposure_s", [1e-6, 9.9e-4])
def test_tip_is_where_the_area_says_at_any_exposure(exposure_s):
    scene = replace(CLEAN, camera=SMALL)
    shots = renderer(scene, exposure_s=exposure_s)
    truth = shots.truth(np.arange(60))
    # Rows in which the tip's outline is flat, with 5 px to spare
    flat_px = scene.subject.diameter_m / 2 / SMALL.m_per_px * (1 - scene.subject.tip_roundness) - 5
    rows = slice(math.ceil(SMALL.centre_px[1] - flat_px), math.floor(SMALL.centre_px[1] + flat_px) + 1)
    for index in (3, 17, 41, 55):
        across = (shots.frame(index)[rows].astype(float).mean(axis=0) - BEHIND) / (FILM - BEHIND)
        assert 60.0 + across.sum() == pytest.approx(truth.tip_x_px[index], abs=0.01)


@pytest.mark.parametrize("angle_deg", [0, 37, 90, 215])
def test_growth_in_any_direction_adds_the_tubes_width_times_its_travel(angle_deg):
    scene = replace(CLEAN, camera=Camera(width_px=360, height_px=360), growth_angle_deg=angle_deg)
    shots = renderer(scene, exposure_s=3e-4)
    truth = shots.truth(np.array([4, 22]))
    radius_px = scene.subject.diameter_m / 2 / scene.camera.m_per_px
    early, late = (shots.frame(index).astype(float) for index in (4, 22))
    travel_px = (late - early).sum() / (FILM - BEHIND) / (2 * radius_px)
    assert travel_px == pytest.approx(np.diff(truth.lead_px)[0], abs=0.01)
    step = np.array([np.diff(truth.tip_x_px)[0], np.diff(truth.tip_y_px)[0]])
    angle = math.radians(angle_deg)
    assert step == pytest.approx(np.diff(truth.lead_px)[0] * np.array([math.cos(angle), math.sin(angle)]), abs=1e-9)


def test_truth_is_in_metres_along_the_growth_and_at_mid_exposure():
    truth = renderer(replace(CLEAN, camera=SMALL), steadily(3.0, 0.01), exposure_s=4e-4).truth(np.arange(60))
    mid_s = np.arange(60) / FPS + 2e-4
    assert truth.time_s == pytest.approx(mid_s)
    assert truth.lead_position_m == pytest.approx(3.0 * np.clip(mid_s - 0.01, 0, None), abs=1e-12)
    assert truth.release_s == pytest.approx(0.01, abs=2e-4)
    assert np.diff(truth.lead_px) == pytest.approx(np.diff(truth.lead_position_m) / SMALL.m_per_px, abs=1e-9)


def projected(plane_m: np.ndarray, camera: Camera) -> np.ndarray:
    """Where OpenCV sees points of the plane, px, shape (n, 2)."""
    about_x, _ = cv2.Rodrigues(np.radians([camera.tilt_x_deg, 0, 0]))
    about_y, _ = cv2.Rodrigues(np.radians([0, camera.tilt_y_deg, 0]))
    turn, _ = cv2.Rodrigues(about_y @ about_x)
    away_m = np.array([0, 0, camera.focal_px * camera.m_per_px])
    spatial_m = np.column_stack([plane_m, np.zeros(len(plane_m))])
    f, (cx, cy) = camera.focal_px, camera.centre_px
    matrix = np.array([[f, 0, cx], [0, f, cy], [0, 0, 1.0]])
    seen, _ = cv2.projectPoints(spatial_m, turn, away_m, matrix, np.array([camera.k1, camera.k2, 0, 0, 0]))
    return seen[:, 0]


def test_distorted_and_tilted_tip_is_where_opencv_projects_it():
    camera = Camera(focal_px=900, k1=-0.3, k2=0.1, tilt_x_deg=6, tilt_y_deg=-9)
    scene = replace(CLEAN, camera=camera, growth_angle_deg=20)
    truth = renderer(scene).truth(np.arange(60))
    ux, uy = scene.direction
    offset_px = np.array(scene.origin) + truth.lead_px[:, None] * np.array([ux, uy]) - camera.centre_px
    expected = projected(offset_px * camera.m_per_px, camera)
    assert np.column_stack([truth.tip_x_px, truth.tip_y_px]) == pytest.approx(expected, abs=1e-6)


@pytest.mark.slow
def test_tail_moves_at_twice_the_speed_of_the_tip():
    tube = Tube(opacity=0.0, brightness=0.8, tail_opacity=0.9, tail_texture=0.4, texture=0, specular=0, tip_glow=0)
    scene = replace(CLEAN, camera=SMALL, subject=replace(tube, length_m=0.16))
    shots = renderer(scene, exposure_s=1e-6)
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
    ahead = [shots.frame(index)[:, 255:].astype(float) - BEHIND for index in (34, 38)]
    places = [(one.sum(axis=0) @ np.arange(255, 480)) / one.sum() for one in ahead]
    assert places[1] - places[0] == pytest.approx(4 * 4.0 / FPS / scene.camera.m_per_px, abs=0.02)
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
    shots = renderer(scene, np.zeros_like, n_frames=40)
    truth = shots.truth(np.array([3, 30]))
    window = (slice(10, 110), slice(300, 700))
    early, late = (shots.frame(index)[window].astype(np.float32) for index in (3, 30))
    _, warp = cv2.findTransformECC(early, late, np.eye(2, 3, dtype=np.float32), cv2.MOTION_TRANSLATION)
    moved = np.diff(truth.tip_x_px)[0], np.diff(truth.tip_y_px)[0]
    assert 1 < math.hypot(*moved) < 3
    assert warp[:, 2] == pytest.approx(moved, abs=0.02)
    assert truth.lead_position_m == pytest.approx([0, 0])


def test_noise_has_the_variance_of_shot_and_read_noise():
    sensor = Sensor(full_well_e=4000, read_noise_e=30, fixed_pattern=0, bit_depth=16)
    shots = renderer(replace(CLEAN, sensor=sensor), np.zeros_like)
    frames = np.array([shots.frame(index)[:100, 300:900] for index in range(12)]) / 65535
    expected = (0.1 * 4000 + 30**2) / 4000**2
    assert frames.mean() == pytest.approx(0.1, abs=1e-4)
    assert frames.var(axis=0, ddof=1).mean() == pytest.approx(expected, rel=0.01)


def test_same_seed_same_pictures_other_seed_others():
    one, again, other = (renderer(replace(preset("demo"), camera=SMALL), seed=seed).frame(20) for seed in (4, 4, 5))
    assert (one == again).all()
    assert (one != other).mean() > 0.5


DEMO = replace(preset("demo"), camera=Camera(width_px=320, height_px=128))
SETTINGS = {"n_frames": 24, "capture_fps": 1069.0, "seed": 7}


def film(scene: Scene, path):
    return render_recording(scene, steadily(2.0, 0.005), out_path=path, **SETTINGS)


def rendered(scene: Scene, index: int) -> np.ndarray:
    return FrameRenderer(scene, steadily(2.0, 0.005), **SETTINGS).frame(index)


def test_h264_holds_every_frame_at_the_rendered_levels_in_the_limited_range(tmp_path):
    truth = film(replace(DEMO, encoding=Encoding(gop=8)), tmp_path / "trial.mp4")
    with av.open(str(tmp_path / "trial.mp4")) as container:
        assert float(container.streams.video[0].average_rate) == pytest.approx(60)
        frames = list(container.decode(video=0))
    assert len(frames) == truth.time_s.size == 24
    assert [index for index, frame in enumerate(frames) if frame.key_frame] == [0, 8, 16]
    levels = 16 + 219 * rendered(DEMO, 10).astype(float) / 255
    error = frames[10].to_ndarray(format="yuv420p")[:128] - levels
    assert abs(error.mean()) < 0.2
    assert 10 * np.log10(219**2 / (error**2).mean()) > 36
