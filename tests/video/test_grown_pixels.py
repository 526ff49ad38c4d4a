"""What stays and stands out is growth; what swings away, passes or was there at first is not. Drawn here, in full."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from plain_scene import write_images

from vinetrack.core.records import Trial
from vinetrack.experiment.settings import ExperimentSettings, MmPerPx
from vinetrack.video.axis import Axis, find_axis
from vinetrack.video.curved_axis import find_growth_axis
from vinetrack.video.edge import initial_front_path
from vinetrack.video.kymograph import path_by_change
from vinetrack.video.small_pictures import SmallPictures
from vinetrack.video.strip import Strip, cut_strip
from vinetrack.video.survey import measure_recording
from vinetrack.video.track import track_recording

MOUTH = (60, 120)
OPEN_RAD = math.radians(25)
SWING = range(10, 16)


def beside_a_door(seed: int, growth_px: int, door_px: int, speed_px: float, tube_px: int = 14) -> np.ndarray:
    """Frames in which a door of `door_px` swings up from across the way of a tube that then grows to the right."""
    rng = np.random.default_rng(seed)
    ground = cv2.GaussianBlur(rng.normal(70, 60, (240, 480)), (0, 0), 6)
    film = 165 + cv2.GaussianBlur(rng.normal(0, 60, ground.shape), (0, 0), 4)
    frames = []
    for t in range(SWING.stop + 4 + int(growth_px / speed_px) + 8):
        picture = ground.copy()
        tip = MOUTH[0] + min(max(speed_px * (t - SWING.stop + 2), 0.0), growth_px)
        x = np.arange(480)
        tube = np.clip(tip - x + 0.5, 0, 1) * (x >= MOUTH[0] - 30)
        rows = slice(MOUTH[1] - tube_px // 2, MOUTH[1] + tube_px // 2)
        picture[rows] += tube * (film[rows] - picture[rows])
        part = np.clip((t - SWING.start) / len(SWING), 0, 1)
        angle = math.radians(90) * (1 - part) - OPEN_RAD * part
        hinge = np.array([MOUTH[0] + 6, MOUTH[1] - tube_px // 2 - 6])
        end = hinge + door_px * np.array([math.cos(angle), math.sin(angle)])
        cv2.line(picture, tuple(int(v) for v in hinge), tuple(int(v) for v in end), 200.0, 7, cv2.LINE_AA)
        frames.append(cv2.GaussianBlur(picture, (0, 0), 0.8) + rng.normal(0, 2, picture.shape))
    return np.clip(np.stack(frames), 0, 255).astype(np.uint8)


def slope_deg(axis: Axis) -> float:
    return math.degrees(math.atan2(axis.direction[1], axis.direction[0]))


@pytest.mark.parametrize("growth_px", [90, 140, 220])
def test_the_axis_is_that_of_the_tube_beside_a_door_as_long_as_its_growth(growth_px: int) -> None:
    small = SmallPictures(beside_a_door(41, growth_px, door_px=100, speed_px=4.0))
    axis = find_growth_axis(small, small.frames)
    assert type(axis) is Axis
    assert abs(slope_deg(axis)) < 5
    assert abs((np.array(MOUTH) - axis.from_px) @ axis.normal) < 8


def test_neither_where_the_door_stood_nor_where_it_passed_is_growth() -> None:
    frames = beside_a_door(42, growth_px=140, door_px=100, speed_px=4.0)
    small = SmallPictures(frames)
    kinds = {"stood": (MOUTH[0] + 6, MOUTH[1] + 60), "passed": (MOUTH[0] + 60, MOUTH[1] + 40), "film": (150, MOUTH[1])}
    near = {}
    for name, (x, y) in kinds.items():
        for which, pixels in (("changed", small.changed), ("grown", small.grown)):
            places = (np.column_stack(pixels[:2]) + 0.5) * small.factor
            near[name, which] = int((np.hypot(*(places - (x, y)).T) < 12).sum())
    assert near["stood", "changed"] > 10
    assert near["stood", "grown"] <= 0.1 * near["stood", "changed"]
    assert near["passed", "grown"] <= 0.1 * max(near["passed", "changed"], 10)
    assert near["film", "grown"] >= 0.9 * near["film", "changed"] > 10


def test_the_middle_of_a_dark_tube_far_from_any_ground_counts_as_growth() -> None:
    rng = np.random.default_rng(46)
    frames = rng.normal(150, 2, (40, 200, 240))
    for t in range(40):
        frames[t, 70:130, : 20 + 5 * t] -= 110
    small = SmallPictures(np.clip(frames, 0, 255).astype(np.uint8))
    x, y, *_ = small.grown
    assert ((np.abs(y - 100) < 5) & (x > 25) & (x < 200)).sum() >= 0.95 * 9 * 174
    assert abs(slope_deg(find_axis(small))) < 1


@pytest.mark.parametrize("brighter", [-80.0, 80.0])
@pytest.mark.parametrize("tube_px", [40, 100, 150])
def test_a_tube_as_wide_as_most_of_the_picture_is_followed_along_itself(
    tmp_path: Path, tube_px: int, brighter: float
) -> None:
    rng = np.random.default_rng(47)
    ground = 120 + cv2.GaussianBlur(rng.normal(0, 30, (200, 240)), (0, 0), 5)
    tip = np.minimum(20 + 4.3 * np.arange(46), 205)
    frames = []
    for place in tip:
        picture = ground.copy()
        rows = slice(100 - tube_px // 2, 100 + tube_px // 2)
        picture[rows] += brighter * np.clip(place - np.arange(240) + 0.5, 0, 1)
        frames.append(cv2.GaussianBlur(picture, (0, 0), 0.8) + rng.normal(0, 2, picture.shape))
    video = write_images(tmp_path / "wide", np.clip(np.stack(frames), 0, 255).astype(np.uint8))
    trial = Trial(name="wide", video=video, capture_fps=1000.0, exposure_s=1e-5, m_per_px=0.001, length_m=0.3)
    tracking = track_recording(trial)
    assert abs(slope_deg(tracking.axis)) < 1
    assert tracking.axis.width_px == pytest.approx(tube_px, rel=0.05)
    track = tracking.track
    off = track.lead_position_m / 0.001 - np.interp(track.time_s, np.arange(46) / 1000, tip)
    assert np.all(track.lead_position_sigma_m < 0.001)
    np.testing.assert_allclose(off - np.median(off), 0.0, atol=0.4)


def test_the_axis_of_a_passing_body_is_found_from_all_change() -> None:
    rng = np.random.default_rng(43)
    frames = rng.normal(60, 2, (40, 120, 320))
    for t in range(40):
        cv2.circle(frames[t], (20 + 7 * t, 60), 9, 180.0, -1, cv2.LINE_AA)
    small = SmallPictures(np.clip(frames, 0, 255).astype(np.uint8))
    assert small.grown is small.changed
    assert abs(slope_deg(find_axis(small, grows=False))) < 1


def test_a_bright_door_beside_the_tube_is_not_flicker() -> None:
    frames = beside_a_door(44, growth_px=140, door_px=100, speed_px=4.0)
    # The door comes to rest, and stood at first, in the bands that tell of flicker; nothing here flickers.
    strip = cut_strip(frames, Axis((5.0, float(MOUTH[1])), (470.0, float(MOUTH[1]))), 12)
    still = strip.scale[:, None] * 70.0 + strip.offset[:, None]
    assert np.ptp(still) < 2.0


def test_a_calibration_does_not_widen_a_found_axis(tmp_path: Path) -> None:
    video = write_images(tmp_path / "clip", beside_a_door(45, growth_px=220, door_px=60, speed_px=4.0))
    trial = Trial(name="clip", video=video, capture_fps=1000.0, exposure_s=1e-4)
    settings = ExperimentSettings(calibration=MmPerPx(kind="mm_per_px", mm_per_px=0.5))
    calibrated = measure_recording(trial, settings, tmp_path)
    plain = track_recording(replace(trial, m_per_px=5e-4))
    assert calibrated.tracking.axis == plain.axis
    np.testing.assert_array_equal(calibrated.tracking.track.edge_px, plain.track.edge_px)
    np.testing.assert_allclose(
        calibrated.tracking.track.lead_position_m, plain.track.lead_position_m, rtol=1e-9, equal_nan=True
    )
    assert calibrated.m_per_px == pytest.approx(5e-4)


def test_a_door_that_rests_beside_the_tube_does_not_lead_its_first_path() -> None:
    rng = np.random.default_rng(48)
    ground, film = rng.uniform(60, 90, (40, 300)), rng.uniform(100, 130, (40, 300))
    tip = np.clip(40 + 4 * (np.arange(80) - 14), 40, 290)
    values = np.empty((80, 40, 300))
    for t, place in enumerate(tip):
        values[t] = np.where(np.arange(300) < place, film, ground)
        if t >= 12:
            values[t, 30:38, 60:180] = 250.0
    values += rng.normal(0, 2, values.shape)
    axis = Axis((0.0, 20.0), (299.0, 20.0), 40.0)
    strip = Strip(
        np.clip(values, 0, 255).astype(np.uint8), np.ones(80), np.zeros(80), np.zeros((80, 2)), 2.0, axis, False
    )
    by_change, _ = path_by_change(strip)
    assert np.abs(by_change - tip)[20:40].max() > 20
    path, passed = initial_front_path(strip)
    assert np.abs(path - tip)[18:60].max() <= 6
    assert abs(passed[0] - 40) <= 8
    assert abs(passed[1] - 290) <= 3
