"""The growth axis, straight or bent, and the strip along it: growth, pixels, flicker, shake and scale; and a body
registered against itself."""

import math
from dataclasses import replace

import cv2
import numpy as np
import pictures
import pytest
from pictures import in_memory, tracked
from plain_scene import BENDS, BENT, Plan, Scene, plain_scene, write_images

from vinetrack.core.records import Trial
from vinetrack.video import axis as curves
from vinetrack.video.axis import Axis, SmallPictures, axis_problem, axis_through, find_axis, find_growth_axis
from vinetrack.video.calibration import PlaneCalibration, PlaneMap
from vinetrack.video.edge import initial_front_path
from vinetrack.video.frames import RecordingError
from vinetrack.video.strip import Strip, cut_strip
from vinetrack.video.track import hops_between_bodies, in_metres, track_frames, track_pixels, track_recording

MOUTH = (60, 120)
OPEN_RAD = math.radians(25)
SWING = range(10, 16)
RATE = 1000.0
G_PX = 9.81 / 0.5e-3 / RATE**2  # px a frame², at 0.5 mm a pixel
SHAPE = (420, 160)
BALL = Trial(name="ball", capture_fps=RATE, m_per_px=0.5e-3, travel_ratio=1)


def test_black_background_is_not_used_for_flicker():
    luma = np.zeros((12, 120, 200), np.uint16)
    luma[:, 55:65] = 180
    strip = cut_strip(luma, Axis((5.0, 60.0), (195.0, 60.0)), 8)
    assert np.ptp(strip.scale) == 0
    assert not strip.offset.any()
    assert not strip.stabilised


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
def test_the_axis_is_that_of_the_tube_beside_a_door_as_long_as_its_growth(growth_px):
    small = SmallPictures(beside_a_door(41, growth_px, door_px=100, speed_px=4.0))
    axis = find_growth_axis(small)
    assert type(axis) is Axis
    assert abs(slope_deg(axis)) < 5
    assert abs(axis.along_and_across(np.array([MOUTH]))[1][0]) < 8


@pytest.mark.parametrize(("tube_px", "brighter"), [(40, -80.0), (100, 80.0), (150, -80.0), (150, 80.0)])
def test_a_tube_as_wide_as_most_of_the_picture_is_followed_along_itself(tmp_path, tube_px, brighter):
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


def test_a_bright_door_beside_the_tube_is_not_flicker():
    frames = beside_a_door(44, growth_px=140, door_px=100, speed_px=4.0)
    # The door comes to rest, and stood at first, in the bands that tell of flicker; nothing here flickers.
    strip = cut_strip(frames, Axis((5.0, float(MOUTH[1])), (470.0, float(MOUTH[1]))), 12)
    still = strip.scale[:, None] * 70.0 + strip.offset[:, None]
    assert np.ptp(still) < 2.0


def test_a_door_that_rests_beside_the_tube_does_not_lead_its_first_path():
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
    state, passed, _ = initial_front_path(strip)
    assert np.abs(state.edge - tip)[18:60].max() <= 6
    assert abs(passed[0] - 40) <= 8
    assert abs(passed[1] - 290) <= 3


@pytest.mark.slow
def test_shake_added_to_a_position_is_where_the_edge_is_seen():
    """At rest the edge is where each picture has it: seen there, less the tracked one, is the shake, of rms 0.8 px."""
    luma = plain_scene(Plan(seed=41, shake=1.2, rest_frames=40)).frames
    found = pictures.tracked(luma, 0.2)
    resting = slice(0, 38)
    rows = luma[resting, 115:126, 60:160].astype(float).mean(axis=1)
    half = (rows[:, :20].mean() + rows[:, -40:].mean()) / 2
    seen_px = 60 + np.argmax(rows < half, axis=1) - 1
    before, after = (rows[np.arange(38), seen_px - 60 + k] for k in (0, 1))
    seen_px = seen_px + (before - half) / (before - after)
    off_px = seen_px - found.axis.points(found.track.edge_px[resting])[:, 0]
    off_px -= np.nanmean(off_px)
    shake_px = found.shake_px[resting] - found.shake_px[resting].mean()
    assert np.std(off_px) > 0.6
    assert np.nanstd(off_px - shake_px) < 0.15


def falling_disc(seed, body=150.0, back=70.0, marks=25.0, rest=8, n=185):
    """Frames (n, height, width), uint8, of a marked disc falling from rest, and its true row (n,)."""
    rng = np.random.default_rng(seed)
    backdrop = back + cv2.GaussianBlur(rng.standard_normal(SHAPE).astype(np.float32), (0, 0), 3) * 40
    pattern = cv2.GaussianBlur(rng.standard_normal((61, 61)).astype(np.float32), (0, 0), 3)
    pattern = marks * pattern / pattern.std()
    t = np.clip(np.arange(n) - rest, 0, None)
    row = 50 + 0.5 * G_PX * t**2
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(np.float32)
    frames = np.empty((n, *SHAPE), np.uint8)
    for i in range(n):
        distance = np.hypot(y - row[i], x - 80)
        cover = np.clip(24 - distance + 0.5, 0, 1)
        matrix = np.array([[1, 0, 80 - 30], [0, 1, row[i] - 30]], np.float32)
        drawn = cv2.warpAffine(pattern, matrix, SHAPE[::-1], flags=cv2.INTER_CUBIC)
        picture = cv2.GaussianBlur(backdrop + cover * (body + drawn - backdrop), (0, 0), 0.8)
        frames[i] = np.clip(np.rint(picture + rng.normal(0, 2, SHAPE)), 0, 255)
    return frames, row


@pytest.mark.slow
@pytest.mark.parametrize(("body", "back"), [(150.0, 70.0), (60.0, 55.0)], ids=["bright", "dark on dark"])
def test_falling_disc(body, back):
    frames, row = falling_disc(301, body, back)
    track = track_frames(in_memory(frames), BALL, RATE).track
    used = track.usable & (row > 90) & (row < 340)
    error = track.edge_px[used] - row[used]
    assert used.sum() > 70
    assert error.std() < 0.12
    fall = np.polyfit(track.time_s[used], track.lead_position_m[used], 2)
    assert 2 * fall[0] == pytest.approx(9.81, rel=0.01)


@pytest.mark.slow
def test_a_neighbour_in_a_wide_strip_is_not_followed():
    """Another disc, 60 px beside the first, falls later: the wide axis drawn by hand along the first holds both."""
    frames, row = falling_disc(305)
    other, _ = falling_disc(306, rest=40)
    both = np.concatenate([frames[:, :, 30:130], other[:, :, 50:110]], axis=2)
    track = track_frames(in_memory(both), BALL, RATE, Axis((54.0, 0.0), (50.0, 419.0), 120.0)).track
    used = track.usable & (row > 90) & (row < 340)
    assert used.sum() > 70
    assert (track.edge_px[used] - row[used]).std() < 0.15


@pytest.mark.slow
def test_a_bounce_ends_the_track():
    frames, row = falling_disc(307, n=185)
    impact = int(np.argmax(row > 340))
    there_and_back = np.concatenate([frames[: impact + 1], frames[impact - 1 : 90 : -1]])
    track = track_frames(in_memory(there_and_back), BALL, RATE).track
    assert not track.usable[impact + 2 :].any()
    assert all("after_end" in flag for flag in track.flag[impact + 2 :])
    assert not any("gap" in flag for flag in track.flag)
    used = np.flatnonzero(track.usable & (np.arange(len(track.flag)) > 60))
    assert np.abs(track.edge_px[used] - row[used]).max() < 1


def test_places_that_hop_between_bodies_are_refused():
    fall, seen = 0.3 * np.arange(30.0) ** 2, np.ones(40, dtype=bool)
    assert not hops_between_bodies(fall + np.random.default_rng(309).normal(0, 0.1, 30), seen[:30])
    turns = np.random.default_rng(310).random(30) < 0.5
    assert hops_between_bodies(np.where(turns, fall + 25, fall), seen[:30])
    for stops_or_bounces in (np.minimum(9 * np.arange(40.0), 180), 180 - np.abs(9 * np.arange(40.0) - 180)):
        assert not hops_between_bodies(stops_or_bounces, seen)


@pytest.mark.slow
def test_a_body_that_disappears_is_lost():
    frames, _ = falling_disc(308, n=150)
    empty = np.concatenate([frames[:60, 210:], frames[:60, 210:]], axis=1)[:, : SHAPE[0]]
    track = track_frames(in_memory(np.concatenate([frames, empty, empty])), BALL, RATE).track
    assert track.usable[60:145].all()
    assert not track.usable[151:].any()


# Axes that bend.
RADIUS = 300.0


def quarter(count: int = 25) -> Axis:
    """A quarter of a circle about (20, 330), from (20, 30) downwards to the right."""
    angle = np.linspace(0, math.pi / 2, count)
    axis = axis_through(np.column_stack([20 + RADIUS * np.sin(angle), 330 - RADIUS * np.cos(angle)]))
    assert axis.bends
    return axis


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


def drawn(scene: Scene) -> Axis:
    """An axis as a hand draws it: six points, each off by a few pixels."""
    places = scene.places(np.linspace(8.0, scene.arc_px[-1] - 8.0, 6))
    return axis_through(places + np.random.default_rng(scene.plan.seed).normal(0, 3.0, places.shape))


@pytest.mark.slow
def test_metres_are_lengths_along_the_curve_in_the_tilted_plane():
    bent = plain_scene(replace(BENT, seed=3, speed=22.0, **BENDS["quarter"]))
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
    short = {"pieces": ((120.0, 0.0), (345.0, 66.0)), "from_px": (40.0, 90.0), "width": 560, "height": 480}
    shaken = plain_scene(replace(BENT, seed=2, speed=22.0, shake=1.2, **short))
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
    scene = plain_scene(replace(BENT, seed=3 if is_drawn else 4, speed=22.0, **BENDS[name]))
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
