"""The strip along an axis: pixels where they belong, flicker and shake taken out."""

from __future__ import annotations

import numpy as np
import pytest
from plain_scene import Plan, plain_scene

from vinetrack.video.axis import LEAST_FRONT_SHARE, Axis, find_axis, front_share
from vinetrack.video.frames import RecordingError
from vinetrack.video.strip import cut_strip, sample, snap_to_grid


def ramp(gx, gy, shape=(90, 140)):
    y, x = np.mgrid[: shape[0], : shape[1]]
    return (100 + gx * x + gy * y)[None].astype(np.float32)


@pytest.mark.parametrize(("to", "expected"), [((100, 30), 2.0), ((10, 80), 3.0), ((-50 + 60, 30 + 40), 3.0)])
def test_a_ramp_rises_along_the_axis_by_its_slope(to, expected):
    axis = Axis((10.0, 30.0), (float(to[0]), float(to[1])))
    slope = expected if abs(axis.direction[0] - 1) < 1e-9 or abs(axis.direction[1] - 1) < 1e-9 else None
    strip = sample(ramp(2.0, 3.0), axis, np.arange(-2, 3))
    measured = np.diff(strip[0, 2]).mean()
    assert measured == pytest.approx(slope if slope else 2 * axis.direction[0] + 3 * axis.direction[1], rel=1e-3)


def test_an_oblique_strip_reads_the_picture_at_its_points():
    axis = Axis((20.5, 11.25), (100.0, 70.0))
    strip = sample(ramp(1.0, 2.0), axis, np.arange(-3, 4))
    points = axis.points(np.arange(strip.shape[2], dtype=float)[None, :], np.arange(-3, 4)[:, None])
    assert np.abs(strip[0] - (100 + points[..., 0] + 2 * points[..., 1])).max() < 0.2


def test_an_axis_to_the_left_turns_the_picture_half_round():
    picture = ramp(1.0, 2.0)
    strip = sample(picture, Axis((120.0, 40.0), (20.0, 40.0)), np.arange(-2, 3))
    assert np.array_equal(strip[0, 2], picture[0, 40, 120:19:-1])
    assert np.array_equal(strip[0, 3], picture[0, 39, 120:19:-1])


def test_a_nearly_level_axis_is_squared_and_a_tilted_one_is_not():
    assert snap_to_grid(Axis((0.0, 20.1), (500.0, 20.3))) == Axis((0, 20), (500, 20))
    tilted = Axis((0.0, 20.0), (500.0, 23.0))
    assert snap_to_grid(tilted) is tilted


def test_flicker_is_taken_out_by_the_bands():
    scene = plain_scene(Plan(seed=11, flicker=0.08, end_px=300, width=420, rest_frames=6, end_frames=4))
    strip = cut_strip(scene.frames, Axis((40.0, 120.0), (400.0, 120.0)), 33)
    phase = np.ptp(scene.frames[:, :40].mean(axis=(1, 2)))
    assert phase > 5  # it does flicker
    still = strip.values[:, :, 300:].astype(float).mean(axis=(1, 2)) * strip.scale + strip.offset
    assert np.ptp(still) < 0.05 * phase


def test_shake_is_measured_to_a_twentieth_of_a_pixel():
    plan = Plan(seed=12, shake=0.8, end_px=300, width=420, rest_frames=6, end_frames=4)
    scene = plain_scene(plan)
    strip = cut_strip(scene.frames, Axis((40.0, 120.0), (400.0, 120.0)), 33)
    assert strip.stabilised
    phase = np.random.default_rng(plan.seed)
    del phase
    n = np.arange(len(scene.frames))
    # Shake is 0.8 sin(0.55 n + φ): its amplitude and phase by least squares leave the error of the measurement.
    waves = np.column_stack([np.sin(0.55 * n), np.cos(0.55 * n), np.ones(len(n))])
    fit, *_ = np.linalg.lstsq(waves, strip.shift_px[:, 0], rcond=None)
    assert np.hypot(fit[0], fit[1]) == pytest.approx(0.8, abs=0.04)
    assert np.std(strip.shift_px[:, 0] - waves @ fit) < 0.05


def test_a_still_camera_is_not_stabilised():
    scene = plain_scene(Plan(seed=13, end_px=300, width=420, rest_frames=6, end_frames=4))
    strip = cut_strip(scene.frames, Axis((40.0, 120.0), (400.0, 120.0)), 33)
    assert not strip.stabilised
    assert np.all(strip.shift_px == 0)


@pytest.mark.parametrize("angle", [0.0, 90.0, 180.0, 270.0, 25.0])
def test_axis_is_found_in_any_direction_of_growth(angle):
    direction = np.array([np.cos(np.radians(angle)), np.sin(np.radians(angle))])
    start = np.array([200.0, 200.0]) - 170 * direction
    plan = Plan(
        seed=14, width=400, height=400, from_px=tuple(start), angle_deg=angle, start_px=40, end_px=280, radius=16,
        tip_depth=6, rest_frames=4, end_frames=4, door=True,
    )  # fmt: skip
    scene = plain_scene(plan)
    axis = find_axis(scene.frames)
    assert np.degrees(np.arccos(axis.direction @ direction)) < 1.5
    assert abs((start - axis.from_px) @ axis.normal) < 4
    assert front_share(scene.frames, axis) >= LEAST_FRONT_SHARE


def test_pictures_without_motion_are_refused():
    still = np.repeat(plain_scene(Plan(seed=15, width=300, end_px=200, end_frames=1)).frames[:1], 20, axis=0)
    with pytest.raises(RecordingError, match="nothing moves"):
        find_axis(still)


def test_an_axis_needs_length():
    with pytest.raises(RecordingError, match="shorter than 10"):
        Axis((5.0, 5.0), (9.0, 5.0))


@pytest.mark.parametrize("kind", [np.uint8, np.uint16])
def test_black_background_is_not_used_for_flicker(kind: type) -> None:
    luma = np.zeros((12, 120, 200), kind)
    luma[:, 55:65] = 180
    strip = cut_strip(luma, Axis((5.0, 60.0), (195.0, 60.0)), 8)
    assert np.ptp(strip.scale) == 0
    assert not strip.offset.any()
    assert not strip.stabilised
