"""A growth axis that bends: geometry, the strip along it, its scale, and how it is found."""

import math
from dataclasses import replace

import numpy as np
import pytest
from bent_scene import BENDS, BentPlan, BentScene, bent_scene
from pictures import in_memory, tracked
from plain_scene import Plan, plain_scene

from vinetrack.core.records import Trial
from vinetrack.video import axis as curves
from vinetrack.video.axis import Axis, axis_problem, axis_through, find_axis
from vinetrack.video.calibration import PlaneCalibration, PlaneMap
from vinetrack.video.frames import RecordingError
from vinetrack.video.small_pictures import SmallPictures
from vinetrack.video.strip import cut_strip
from vinetrack.video.track import in_metres, track_pixels

RADIUS = 300.0


def quarter(count: int = 25) -> Axis:
    """A quarter of a circle about (20, 330), from (20, 30) downwards to the right."""
    angle = np.linspace(0, math.pi / 2, count)
    axis = axis_through(np.column_stack([20 + RADIUS * np.sin(angle), 330 - RADIUS * np.cos(angle)]))
    assert axis.bends
    return axis


def test_two_points_are_the_straight_axis():
    axis = axis_through([(10.0, 30.0), (100.0, 70.0)], 12.0)
    assert not axis.bends
    assert axis == Axis((10.0, 30.0), (100.0, 70.0), 12.0)
    assert curves.axis_from_entry(curves.axis_entry(axis) | {"width_px": 12.0}) == axis
    curve = replace(quarter(), width_px=14.0)
    assert curves.axis_from_entry(curves.axis_entry(curve) | {"width_px": 14.0}) == curve
    assert set(curves.axis_entry(axis)) == {"from_px", "to_px"}


def test_positions_on_a_quarter_of_a_circle_are_its_arc_length():
    axis = quarter()
    assert axis.length_px == pytest.approx(RADIUS * math.pi / 2, rel=2e-3)
    place = axis.points(RADIUS * np.array([0.3, 0.8, 1.3]))
    assert np.allclose(np.hypot(place[:, 0] - 20, place[:, 1] - 330), RADIUS, atol=0.6)
    steps = axis.points(np.arange(0, axis.length_px, 1.0))
    assert np.allclose(np.hypot(*np.diff(steps, axis=0).T), 1.0, atol=1e-4)
    assert axis.turn_rad == pytest.approx(math.pi / 2, abs=0.06)
    uneven = axis_through([(0.0, 0.0), (200.0, 0.0), (212.0, 5.0), (215.0, 200.0)])
    places = uneven.points(np.linspace(0, uneven.length_px, 500))
    assert places[:, 0].max() < 230  # no overshoot
    assert places[:, 1].min() > -6
    # Places beside a curve lie on its normal, and beyond its end straight on.
    along = np.array([100.0, 250.0])
    beside, middle = axis.points(along, 20.0), axis.points(along)
    assert np.allclose(np.sum((beside - middle) * axis.direction_at(along), axis=1), 0, atol=1e-9)
    assert np.allclose(np.hypot(*(beside - middle).T), 20.0)
    ahead = axis.points(axis.length_px + np.array([0.0, 15.0]))
    assert np.allclose(ahead[1] - ahead[0], 15.0 * axis.direction_at(axis.length_px))
    assert np.allclose(axis.along_and_across(beside)[0], along, atol=1e-2)


def test_points_that_coincide_and_curves_that_cannot_be_cut_are_refused():
    with pytest.raises(RecordingError):
        axis_through([(10.0, 10.0), (10.5, 10.0), (90.0, 40.0)])
    sharp = axis_through([(20.0, 20.0), (60.0, 20.0), (60.0, 50.0)])
    assert axis_problem(sharp, 40.0, (100, 100)) is not None
    assert axis_problem(sharp, math.nan, (100, 100)) is None
    assert axis_problem(Axis((0.0, 0.0), (500.0, 0.0)), 10.0, (100, 100)) is not None
    assert axis_problem(quarter(), 5.0, (310, 400)) is not None


def test_rings_about_the_circles_middle_become_level_lines():
    y, x = np.mgrid[:400, :400].astype(float)
    rings = np.clip(128 + (np.hypot(x - 20, y - 330) - RADIUS), 0, 255)
    strip = cut_strip(np.repeat(rings[None], 4, axis=0).round().astype(np.uint8), quarter(), 12.0)
    assert strip.values.shape == (4, 25, int(quarter().length_px) + 1)
    # Across is from x towards y seen along the growth: towards the middle, where rings are darker.
    assert np.abs(strip.values[0] - (128 - np.arange(-12, 13))[:, None].astype(float)).max() < 1.6
    assert strip.axis == quarter()


def drawn(scene: BentScene) -> Axis:
    """An axis as a hand draws it: six points, each off by a few pixels."""
    places = scene.places(np.linspace(8.0, scene.arc_px[-1] - 8.0, 6))
    return axis_through(places + np.random.default_rng(scene.plan.seed).normal(0, 3.0, places.shape))


@pytest.mark.slow
def test_metres_are_lengths_along_the_curve_in_the_tilted_plane():
    bent = bent_scene(BentPlan(seed=3, speed=22.0, **BENDS["quarter"]))
    parameters = np.array([0.45, 0.02, 0.0, -0.01, 0.4, 0.0, 0.08, 0.05, -0.05, 0.0])
    covariance = np.diag((0.002 * np.abs(parameters)) ** 2)
    plane = PlaneMap(bent.plan.width, bent.plan.height, parameters, covariance)
    calibration = PlaneCalibration("charuco", plane, 0.1, 50, 0.0, (0, 0, 639, 639))
    trial = Trial(name="t", exposure_s=bent.plan.exposure / 1000)
    in_px = track_pixels(in_memory(bent.frames), trial, 1000.0, drawn(bent))
    axis = in_px.axis
    scale = calibration.along(axis)
    tracking = in_metres(in_px, trial, scale.m_per_px, scale.position_m)
    used = bent.moving & tracking.track.usable
    fine = np.arange(0.0, bent.arc_px[-1], 0.5)
    steps = np.linalg.norm(np.diff(plane.plane_m(bent.places(fine)), axis=0), axis=1)
    true_m = np.interp(bent.edge_px, fine, np.concatenate([[0.0], np.cumsum(steps)]))
    assert (tracking.track.lead_position_m[used] - true_m[used]).std() < 0.4 * 1.3e-3
    chord = calibration.along(Axis(axis.from_px, axis.to_px))
    assert 0 < scale.scale_rel_sigma < 0.02
    assert scale.scale_rel_sigma != pytest.approx(chord.scale_rel_sigma, rel=1e-3)
    ends_m = scale.position_m(axis.points(np.array([0.0, axis.length_px])))
    assert scale.m_per_px * axis.length_px == pytest.approx(float(np.ptp(ends_m)))
    off = calibration.along(axis, off_px=0.5).scale_rel_sigma
    assert off == pytest.approx(math.hypot(scale.scale_rel_sigma, 0.5 * abs(axis.turn_rad) / axis.length_px))


@pytest.mark.slow
def test_camera_shake_is_removed_along_a_curve():
    short = {"pieces": ((120.0, 0.0), (345.0, 66.0)), "from_px": (40.0, 90.0)}
    shaken = bent_scene(BentPlan(seed=2, speed=22.0, shake=1.2, width=560, height=480, **short))
    tracking = tracked(shaken.frames, shaken.plan.exposure, drawn(shaken))
    used = shaken.moving & tracking.track.usable
    error = tracking.track.edge_px[used] - shaken.edge_px[used]
    assert error.std() < 0.4  # of a shake of 1.2 px, 0.9 px as a standard deviation
    assert np.abs(tracking.shake_px).max() > 0.8
    assert tracking.track.lead_position_systematic_m is not None
    assert np.nanmin(tracking.track.lead_position_systematic_m[used]) > 0.05e-3


@pytest.mark.slow
@pytest.mark.parametrize(("name", "is_drawn"), [("quarter", True), ("quarter", False), ("gentle", False)])
def test_a_bent_vine_is_followed_along_a_curve_drawn_or_found(name, is_drawn):
    sd_px, off_px = (0.35, 2.0) if is_drawn else (0.4, 2.5)
    scene = bent_scene(BentPlan(seed=3 if is_drawn else 4, speed=22.0, **BENDS[name]))
    tracking = tracked(scene.frames, scene.plan.exposure, drawn(scene) if is_drawn else None)
    assert tracking.axis.bends
    track, used = tracking.track, scene.moving & tracking.track.usable
    assert used.sum() == scene.moving.sum()
    error = track.edge_px[used] - scene.edge_px[used]
    assert error.std() < sd_px
    stated = float(np.sqrt(np.mean((track.lead_position_sigma_m[used] / 1e-3) ** 2)))
    assert stated > 0.4 * error.std()
    places = tracking.axis.points(track.edge_px[used])
    assert np.hypot(*(places - scene.places(scene.edge_px[used])).T).max() < off_px
    assert tracking.tube_width_px == pytest.approx(2 * scene.plan.radius, rel=0.1)


@pytest.mark.parametrize("changes", [{"door": True}, {"shake": 1.2}, {"gradient": 110.0, "film": 130.0}])
def test_a_straight_vine_keeps_the_straight_axis_it_had(changes):
    plan = Plan(**({"seed": 5, "width": 640, "end_px": 540.0} | changes))
    small = SmallPictures(plain_scene(plan).frames)
    assert curves.find_growth_axis(small) == find_axis(small)


@pytest.mark.parametrize(("share", "width_px", "bends"), [(0.65, 30.0, True), (0.9, 48.0, False)])
def test_a_curve_is_the_axis_where_it_explains_more_in_a_band_of_one_width(monkeypatch, share, width_px, bends):
    found = {"find_axis": Axis((20.0, 30.0), (220.0, 30.0), 40.0), "find_curve": replace(quarter(), width_px=width_px)}
    for name, axis in found.items():
        monkeypatch.setattr(curves, name, lambda _, axis=axis: axis)
    monkeypatch.setattr(curves, "front_share", lambda _, axis, **__: share if axis.bends else 0.65)
    assert curves.find_growth_axis(None).bends is bends


@pytest.mark.parametrize(("length_px", "width_px"), [(21, 2), (3, 10), (9, 3), (14, 1), (40, 40)])
def test_a_band_hardly_longer_than_wide_has_no_curve(length_px, width_px):
    rng = np.random.default_rng(2211)
    for _ in range(10):
        frames = rng.normal(60, 2, (20, 99, 134))
        x, y = rng.integers(0, 90), rng.integers(0, 55)
        for t in range(20):
            frames[t, y : y + width_px, x : x + length_px * t // 20 + 1] += 100
        small = SmallPictures(np.clip(frames, 0, 255).astype(np.uint8))
        curve = curves.find_curve(small)
        assert curve is None or curve.length_px > 2 * curve.width_px
