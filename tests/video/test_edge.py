"""The leading edge and its stated errors against the truth of recordings drawn by other code; seeds of their own."""

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pictures
import pytest
import yaml
from plain_scene import Plan, Scene, plain_scene, write_video
from scipy.special import ndtr
from tracking_accuracy import along_axis
from tracking_accuracy import film as rendered_film

from vinetrack.core.records import FLAGS, Correction, Track, Trial, with_flag
from vinetrack.experiment.folder import read_experiment
from vinetrack.laboratory.__main__ import DEMO
from vinetrack.laboratory.campaigns import film, grow, make_filming, read_ground_truth
from vinetrack.laboratory.scene import preset
from vinetrack.tracks.frame_timing import correct_frames
from vinetrack.video import edge, track
from vinetrack.video import edge_kernels as kernels
from vinetrack.video.axis import LEAST_FRONT_SHARE, Axis, SmallPictures, axis_through
from vinetrack.video.calibration import corrected_by_hand
from vinetrack.video.frames import RecordingError
from vinetrack.video.strip import Look, Positions, Tracker, cut_strip, steadied
from vinetrack.video.track import PointQuality, Tracking, ending_of, follow, moving_range, track_recording

SHORT = {"width": 520, "height": 160, "from_px": (20.0, 80.0), "start_px": 50.0, "end_px": 430.0, "radius": 24.0}
MOUTH_PLAN = Plan(seed=520, width=640, height=200, from_px=(20.0, 100.0), end_px=520.0, rest_frames=15)
AXIS = Axis((0.0, 66.0), (299.0, 66.0), 70.0)  # Six rows beside the middle of the tube
COLUMNS = 460
LONG_AXIS = Axis((20.0, 59.5), (440.0, 59.5), 40.0)
FITS = "from test_edge import *; s, e, p = stepping(); print(fitted(s, e + 1.4, p, RIM).tobytes().hex())"


def followed(**changes) -> tuple[Scene, Tracking]:
    """A scene of the short plan, and its tracking."""
    scene = plain_scene(Plan(**{**SHORT, **changes}))
    return scene, pictures.tracked(scene.frames, scene.plan.exposure)


def errors(scene: Scene, tracking: Tracking) -> tuple[np.ndarray, np.ndarray]:
    """Tracked minus true edge of the moving frames, none of which may be lost, px, and the stated errors."""
    angle = np.radians(scene.plan.angle_deg)
    origin = (np.asarray(tracking.axis.from_px) - scene.plan.from_px) @ [np.cos(angle), np.sin(angle)]
    # Nearer to its ends what creeps passes for rest.
    shown = scene.moving & (np.abs(scene.edge_px - scene.edge_px[[0, -1]][:, None]).min(axis=0) > 0.6)
    assert tracking.track.usable[shown].all()
    error = tracking.track.edge_px + origin - scene.edge_px
    stated = np.hypot(tracking.track.lead_position_sigma_m, tracking.track.lead_position_systematic_m)
    return error[shown], stated[shown] * 1e3


EDGES = {
    "bright": ({}, 0.12, 0.15),
    "dark": ({"film": 15.0}, 0.2, 0.3),
    "door": ({"door": True}, 0.15, 0.2),
    "low contrast": ({"film": 100.0, "wall_sd": 4.0, "tail_sd": 3.0}, 0.2, 0.25),
    "half-frame exposure": ({"speed": 30.0, "exposure": 0.5, "rise_frames": 4.0}, 0.3, 0.35),
    "sway": ({"wobble": 2.0}, 0.15, 0.2),
    "payload flies ahead": ({"payload": True}, 0.15, 0.2),
    "contrast changes sign": ({"gradient": 110.0, "film": 125.0}, 0.5, 0.5),
    "no rest at the start": ({"rest_frames": 0}, 0.15, 0.2),
    "creeps from its start": ({"speed": 3.0, "rise_frames": 150.0}, 0.15, 0.2),
    "creeps to its end": ({"slows_frames": 120.0}, 0.15, 0.2),
}


@pytest.mark.parametrize("name", EDGES)
def test_edge_of(name):
    changes, sd_px, bias_px = EDGES[name]
    error, stated = errors(*followed(seed=201, **changes))
    assert error.std() < sd_px
    assert abs(error.mean()) < bias_px
    assert 0.45 < error.std() / np.sqrt(np.mean(stated**2)) < 2.0


class MiddleTracker(Tracker):
    """An edge at 2 px a frame, whatever is in the picture."""

    def follow(self, look: Look) -> Positions:
        strip, n = cut_strip(look.luma, look.axis, 10.0), len(look.luma)
        sure = {"sigma_px": np.full(n, 0.1), "unsure": np.zeros(n, bool), "reach_px": 1.0, "slow_px": 0.0}
        return Positions(strip=strip, edge_px=100.0 + 2.0 * np.arange(n), **sure)


def test_another_tracker_is_a_class_of_its_own_in_the_registry(monkeypatch):
    monkeypatch.setattr(track, "TRACKERS", [MiddleTracker(), *track.TRACKERS])
    scene, tracking = followed()
    assert tracking.track.edge_px == pytest.approx(100.0 + 2.0 * np.arange(len(scene.frames)))
    assert with_flag(tracking.track.flag, "before_release").sum() < 3


def test_flicker_is_taken_out_of_every_picture():
    frames = plain_scene(Plan(**SHORT, seed=201, flicker=0.06)).frames
    strip = cut_strip(frames, Axis((20.0, 80.0), (490.0, 80.0)), 24)
    beyond = strip.values[:, :, 440:].mean(axis=(1, 2))
    assert np.std(strip.scale * beyond + strip.offset) < 0.1 < 2 < np.std(beyond)


@pytest.mark.parametrize("angle", [90.0, 205.0])
def test_edge_in_any_direction_of_growth(angle):
    direction = np.array([np.cos(np.radians(angle)), np.sin(np.radians(angle))])
    plan = {"width": 420, "height": 420, "from_px": tuple(210.0 - 180 * direction), "angle_deg": angle}
    error, _ = errors(*followed(**plan, seed=202, end_px=320.0, radius=18.0, tip_depth=5.0))
    assert error.std() < 0.2
    assert abs(error.mean()) < 0.3


def test_a_given_axis_two_degrees_off_is_centred():
    scene = plain_scene(Plan(seed=203, **SHORT))
    tilt = np.tan(np.radians(2.0)) * 470
    axis = Axis((20.0, 80.0 - tilt / 2), (490.0, 80.0 + tilt / 2), 48.0)
    tracking = pictures.tracked(scene.frames, scene.plan.exposure, axis)
    assert abs(tracking.axis.direction[1]) < 0.01
    assert errors(scene, tracking)[0].std() < 0.2


def test_time_is_mid_exposure_and_flags_are_known_and_a_still_recording_is_refused():
    scene, tracking = followed(seed=206)
    with pytest.raises(RecordingError):
        pictures.tracked(np.repeat(scene.frames[:1], 20, axis=0), 0.2)
    track = tracking.track
    assert track.time_s[0] == pytest.approx(scene.plan.exposure / 2000)
    assert np.diff(track.time_s) == pytest.approx(np.full(len(track.time_s) - 1, 1e-3))
    assert all(part in FLAGS for flag in track.flag for part in flag.split(";") if part)
    before, after = with_flag(track.flag, "before_release"), with_flag(track.flag, "after_end")
    assert before[: scene.plan.rest_frames - 1].all()
    assert after[-scene.plan.end_frames + 2 :].all()
    assert not (before | after)[scene.moving][3:].any()


@pytest.mark.parametrize("speed", [6.0, 20.0])
def test_two_frames_of_rest_at_the_end_are_not_growth(speed):
    scene = plain_scene(Plan(**{**SHORT, "seed": 214, "speed": speed, "end_px": 330.0}))
    count = int(np.flatnonzero(scene.moving)[-1]) + 3
    after = with_flag(pictures.tracked(scene.frames[:count], scene.plan.exposure).track.flag, "after_end")
    assert after.tolist() == [False] * (count - 2) + [True] * 2
    # A pause of one frame in slow growth is not a stop.
    edge = np.concatenate([np.full(8, 50.0), 50 + 1.0 * np.arange(1, 30), [79.0]])
    assert moving_range(edge, np.full(edge.size, 0.05)) == (8, edge.size - 1)


def test_wrong_repeated_and_missing_frames_are_flagged_and_the_times_are_corrected():
    luma = plain_scene(Plan(seed=212, **SHORT)).frames.copy()
    luma[1], luma[25], luma[-3:] = luma[-3], luma[24], 0
    track = pictures.tracked(np.delete(luma, 30, axis=0), 0.2).track
    assert (track.flag[1], track.flag[30]) == ("rejected", "gap;retimed")
    assert np.flatnonzero(np.isnan(track.edge_px)).tolist() == [0, 1, *range(track.time_s.size)[-3:]]
    assert np.flatnonzero(with_flag(track.flag, "duplicate")).tolist() == [25]
    assert np.flatnonzero(with_flag(track.flag, "gap")).tolist() == [30]
    assert np.diff(track.time_s[28:32]) == pytest.approx([1e-3, 2e-3, 1e-3])
    np.testing.assert_array_equal(correct_frames(track).time_s, track.time_s)


@pytest.mark.parametrize(
    ("speed", "flight", "ahead", "in_flight", "radius", "grey"),
    [
        (20, 2, 0, 99, 14, 12),
        (20, 1, 28, 99, 14, 12),
        (8, 1, 0, 6, 14, 12),
        (4, 2, 0, 5, 14, 12),
        (3.5, 1, 0, 9, 22, 170),
    ],
)
def test_a_track_does_not_follow_the_payload(speed, flight, ahead, in_flight, radius, grey):
    """Whether it leaves the picture or the recording ends while it flies, and where it looks like film."""
    scene = plain_scene(Plan(**{**SHORT, "seed": 302, "end_px": 330.0, "speed": speed}))
    luma = scene.frames.copy()
    last = int(np.flatnonzero(scene.moving)[-1])
    speed = scene.edge_px[last - 1] - scene.edge_px[last - 2]
    for t in range(last - 1, len(luma)):
        x = 350 + ahead + flight * speed * (t - last + 1)
        disc = cv2.circle(np.zeros_like(luma[t], np.float32), (round(x), 80), radius, 1.0, -1, cv2.LINE_AA)
        luma[t] = np.rint(luma[t] * (1 - disc) + grey * disc).astype(np.uint8)
    luma = luma[: last + in_flight]
    tracking = pictures.tracked(luma, scene.plan.exposure)
    error = tracking.track.edge_px + tracking.axis.from_px[0] - 20.0 - scene.edge_px[: len(luma)]
    assert np.abs(error[tracking.track.usable]).max() < 2.0
    assert with_flag(tracking.track.flag, "after_end")[last + 2 :].all()


@pytest.mark.parametrize(("length_px", "complete"), [(395, True), (430, True), (460, False), (370, False)])
def test_travel_is_compared_with_the_length(length_px, complete):
    edge_px = np.concatenate([np.full(10, 100.0), np.linspace(100, 500, 40), np.full(6, 500.0)])
    quality = PointQuality(np.full(56, "", dtype="<U64"), (), 10, 49, None, np.zeros(56, dtype=bool))
    ending = ending_of(quality, edge_px, "a.mp4", np.arange(56), whole=True)
    assert ending.remark
    assert (ending.notes(length_px) == []) is complete


def test_points_moved_dropped_and_confirmed_by_hand_stand_beside_the_trackers_own():
    flag = np.array(["", "doubtful", "lost", "gap", "", "after_end"], dtype="<U64")
    edge = np.array([0.0, 10.0, np.nan, 30.0, 40.0, 50.0])
    track = Track(np.arange(6) / 1000, np.full(6, np.nan), np.full(6, 0.1), flag, edge)
    given = [(0, "drop"), (1, "confirm"), (2, "move", 21.5), (3, "move", 29.0)]
    out = corrected_by_hand(track, [Correction(*one) for one in given])
    assert list(out.flag[:4]) == ["rejected;corrected", "corrected", "corrected", "corrected;gap"]
    np.testing.assert_array_equal(out.edge_px, [np.nan, 10.0, 21.5, 29.0, 40.0, 50.0])
    assert out.lead_position_sigma_m[2] == 0.5  # of a click
    np.testing.assert_array_equal(out.tracked_px, edge)


def test_a_recording_is_tracked_with_its_corrections(tmp_path):
    scene = plain_scene(Plan(width=480, height=160, from_px=(20, 80), start_px=40, end_px=400, speed=14, radius=20))
    film = write_video(tmp_path / "a.mp4", scene.frames)
    plain = Trial(name="a", video=film, capture_fps=1000.0, m_per_px=2.5e-4)
    before = track_recording(plain).track
    given = (Correction(20, "move", float(before.edge_px[20]) + 4), Correction(25, "drop"))
    after = track_recording(replace(plain, corrections=given)).track
    assert after.lead_position_m[20] - before.lead_position_m[20] == pytest.approx(4 * 2.5e-4)
    assert not after.usable[25]
    others = np.setdiff1d(np.arange(len(before.edge_px)), [20, 25])
    np.testing.assert_array_equal(after.edge_px[others], before.edge_px[others])
    np.testing.assert_array_equal(after.tracked_px, before.edge_px)
    assert np.flatnonzero(with_flag(after.flag, "corrected")).tolist() == [20, 25]


def ok(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Which points have no flag, and the edge, px."""
    track = pictures.tracked(scene.frames, scene.plan.exposure, m_per_px=1.0).track
    return track.usable & ~with_flag(track.flag, "doubtful"), track.edge_px


@pytest.mark.slow
@pytest.mark.parametrize("grey", [20.0, 110.0, 200.0])
@pytest.mark.parametrize(("speed", "rise"), [(20.0, 8.0), (6.0, 20.0)], ids=["fast", "slow"])
def test_a_tip_in_the_mouth_of_a_launcher_is_never_ok(speed, rise, grey):
    scene = plain_scene(replace(MOUTH_PLAN, speed=speed, rise_frames=rise, mouth=30.0, mouth_grey=grey))
    good, edge_px = ok(scene)
    hidden = scene.edge_px < scene.plan.start_px + 30
    assert hidden.sum() > 15
    assert not good[hidden].any()
    seen = scene.moving & (scene.edge_px > scene.plan.start_px + 45)
    assert np.count_nonzero(~good[seen]) <= max(4, 0.1 * seen.sum())  # film beside the mouth is not seen before
    assert np.std((edge_px - scene.edge_px)[seen & good]) < 0.5


@pytest.mark.parametrize("film", [175.0, 20.0])
def test_a_tip_at_rest_in_sight_stays_ok(film):
    assert ok(plain_scene(replace(MOUTH_PLAN, film=film)))[0][: MOUTH_PLAN.rest_frames].all()


@pytest.mark.slow
def test_the_errors_near_a_start_that_a_door_leaves_are_stated(tmp_path):
    errors, stated = [], []
    for seed in (901, 903):
        path, truth = rendered_film(preset("downward"), "downward", seed, tmp_path, 6.0)
        trial = Trial(name="t", video=path, capture_fps=1000.0, exposure_s=truth.exposure_s, m_per_px=1.0)
        tracking = track_recording(trial)
        track = tracking.track
        use = track.usable & (np.gradient(truth.lead_px) > 0.05) & np.isfinite(truth.lead_px)
        error = (track.edge_px - along_axis(truth, tracking))[use]
        errors.append(error - error.mean())
        stated.append(np.hypot(track.lead_position_sigma_m, track.lead_position_systematic_m)[use])
    ratio = np.sqrt(np.mean(np.concatenate(errors) ** 2) / np.mean(np.concatenate(stated) ** 2))
    assert 0.67 < ratio < 1.2


@pytest.mark.slow
@pytest.mark.parametrize(("trial", "take", "seed"), [("d24_60kPa_1", 3, 110), ("d12_60kPa_2", 6, 171)])
def test_a_fast_tip_at_rest_beside_a_door_is_neither_behind_its_own_film_nor_at_the_doors_far_edge(
    trial, take, seed, tmp_path
):
    """Repeats of the demonstration's fastest trials."""
    experiment = read_experiment(Path(__file__).parents[2] / "data" / "demo", strict=True)
    stated = replace(experiment.trial(trial), name=f"{trial}_{take}", video=tmp_path / "a.mp4")
    content = yaml.safe_load(DEMO.read_text(encoding="utf-8"))
    (grown,) = grow([stated], read_ground_truth(DEMO))
    truth = film(grown, make_filming(content["filming"]), stated.video, seed)
    tracking = track_recording(replace(stated, m_per_px=2.4e-4))
    error_px = tracking.track.edge_px - along_axis(truth, tracking)
    grown_px = truth.lead_px - truth.lead_px[0]
    resting, passed = grown_px < 1e-3, (grown_px > 60) & (grown_px < 300)
    assert abs(np.nanmedian(error_px[resting]) - np.nanmedian(error_px[passed])) < 1.5  # of it 0.7 by the lens


def tube() -> np.ndarray:
    """A bright front that passes 5 columns a frame over noise and leaves 41 rows changed behind it."""
    n, rows, columns = 72, 121, 300
    luma = np.random.default_rng(81).normal(60, 2, (n, rows, columns))
    across = np.abs(np.arange(rows) - rows // 2)[:, None]
    for i in range(n):
        luma[i] += 90 * ((np.arange(columns) < 5 * (i - 8)) & (across <= 20))
    return np.clip(luma, 0, 255).astype(np.uint8)


@pytest.mark.parametrize(("on_axis", "beside"), [(-0.01, 1.0), (1.0, -0.01), (0.0, 0.0)])
def test_without_a_front_along_axis_and_middle_only_the_arrival_is_followed(monkeypatch, on_axis, beside):
    """Shares of the fronts along the axis and along any other, above the least."""
    share = {True: LEAST_FRONT_SHARE + on_axis, False: LEAST_FRONT_SHARE + beside}
    monkeypatch.setattr(edge, "front_share", lambda _, axis: share[axis is AXIS])
    luma = tube()
    positions = follow(Look(luma, AXIS, SmallPictures(luma), 2.0, 0.1))
    assert positions.is_edge is (min(on_axis, beside) >= 0)
    moving = slice(14, 60)
    assert np.abs(positions.edge_px - 5.0 * (np.arange(len(luma)) - 8))[moving].max() < 3


def step_errors(luma: np.ndarray, exposure: float, true: np.ndarray):
    """Tracked minus true edge, px, the tracking along LONG_AXIS, and its stated random and slow errors, px."""
    found = pictures.tracked(luma, exposure, LONG_AXIS, m_per_px=1e-4)
    error = found.track.edge_px + found.axis.from_px[0] - true
    return error, found, found.track.lead_position_sigma_m * 1e4, found.track.lead_position_systematic_m * 1e4


def instants(frames: np.ndarray, exposure: float) -> np.ndarray:
    """Sixty moments of each exposure, in frames, shape (n_frames, 60)."""
    return frames[:, None] + exposure * (np.arange(60) - 29.5) / 60


def step_frames(edge_px: np.ndarray, noise: float = 2.0, seed: int = 331) -> np.ndarray:
    """A straight front between background of 60 and film of 160, blurred by 1 px, averaged over instants.
    `edge_px` has shape (n_frames, n_instants) or (n_frames, n_instants, n_bands): a front for each band of rows.
    """
    bands = edge_px if edge_px.ndim == 3 else edge_px[:, :, None]
    cover = ndtr(bands[..., None] - np.arange(COLUMNS)).mean(axis=1)
    luma = np.full((len(edge_px), 120, COLUMNS), 60.0)
    luma[:, 40:80] += 100 * np.repeat(cover, 40 // cover.shape[1], axis=1)
    luma += np.random.default_rng(seed).normal(0, noise, luma.shape)
    return np.rint(np.clip(luma, 0, 255)).astype(np.uint8)


def grown_px(frames: np.ndarray, start_px: float = 60.0, rest: int = 12, speed: float = 4.0) -> np.ndarray:
    """Rest, then one speed, at these times in frames."""
    return start_px + speed * np.maximum(frames - rest, 0.0)


@pytest.mark.slow
@pytest.mark.parametrize("periods", [(11, 17), (43, 67)])
def test_slow_errors_of_bands_are_stated_though_the_track_is_smooth(periods):
    """By root mean squares over three draws: that of one is known to half. Bands further apart count as outliers."""
    frames = np.arange(100.0)
    true, moves = grown_px(frames), (frames > 12)[:, None]
    found = []
    for seed in (333, 334, 335):
        phase = np.random.default_rng(seed).uniform(0, 2 * np.pi, (2, 4))
        # Two waves for every band, which its neighbours do not have: differences of the track hardly see any of them.
        waves = [0.25 * np.sin(2 * np.pi * frames[:, None] / T + p) for T, p in zip(periods, phase, strict=True)]
        luma = step_frames((true[:, None] + np.sum(waves, axis=0) * moves)[:, None, :])
        error, tracking, sigma, slow = step_errors(luma, 0.05, true)
        use = (frames > 25) & (frames < 95) & tracking.track.usable
        assert use.sum() > 60
        found.append((error[use].var(), np.mean(sigma[use] ** 2), np.mean(slow[use] ** 2)))
    variance, noise, share = np.mean(found, axis=0)
    assert 0.6 < np.sqrt(variance / (noise + share)) < 1.8
    if min(periods) > 40:
        assert 0.6 < np.sqrt(variance / share) < 1.9


@pytest.mark.parametrize("exposure", [0.1, 0.9])
def test_an_edge_that_speeds_up_is_placed_where_it_was_at_mid_exposure(exposure):
    """At 4 px a frame² its mean over 0.9 frames lies aτ²/24 = 0.135 px ahead of where it was in their middle."""
    frames = np.arange(32.0)
    at, true = (60.0 + 2.0 * np.clip(t - 12.0, 0.0, 13.0) ** 2 for t in (instants(frames, exposure), frames))
    error, tracking, *_ = step_errors(step_frames(at, noise=1.0), exposure, true)
    use = (frames > 15) & (frames < 24) & tracking.track.usable
    assert use.sum() >= 7
    assert abs(error[use].mean()) < 0.05


def test_an_edge_that_stops_within_an_exposure_has_the_error_of_its_dwell():
    """Half of an exposure at 20 px a frame, half at rest: seen on average vτ/8 behind where it is in the middle."""
    frames, exposure = np.arange(36.0), 0.5
    at, true = (
        np.minimum(60.0 + 20.0 * np.clip(t - 12.0, 0.0, None), 380.0) for t in (instants(frames, exposure), frames)
    )
    error, _, sigma, _ = step_errors(step_frames(at, noise=1.0), exposure, true)
    last = int(np.argmax(true >= 380.0))
    assert 0.8 * 20.0 * exposure / 8 < sigma[last] < 3.0  # by the edge as measured, which is behind itself
    assert np.abs(error[14 : last + 1] / np.hypot(sigma, 0.1)[14 : last + 1]).max() < 4.0
    assert sigma[16 : last - 4].max() < 0.5


@pytest.mark.parametrize("door_grey", [30, 90])
def test_an_edge_behind_a_sliding_door_is_lost(door_grey):
    """A striped door slides by in front of the first 80 px of growth; the tip comes out from behind it and is seen."""
    frames, columns = np.arange(80.0), np.arange(COLUMNS)
    true = grown_px(frames)
    luma = step_frames(true[:, None]).astype(float)
    noise = np.random.default_rng(336).normal(0, 2, luma.shape)
    stripes = np.sin(2 * np.pi * (columns + 6 * np.minimum(frames, 40)[:, None]) / 30)
    luma[:, :, :140] = (door_grey + 40 * stripes[:, None, :] + noise)[:, :, :140]
    error, tracking, *_ = step_errors(np.rint(np.clip(luma, 0, 255)).astype(np.uint8), 0.05, true)
    usable = tracking.track.usable
    assert not usable[(frames > 12) & (true < 138)].any()
    assert usable[true > 150].all()
    assert np.abs(error[usable]).max() < 0.1


def test_a_bright_door_that_comes_over_the_tip_at_rest_is_not_its_film():
    true = np.minimum(grown_px(np.arange(95.0)), 300.0)
    luma = step_frames(true[:, None])
    for i in range(80, 95):  # the tip rests from the 72nd frame on
        luma[i, : 20 * (i - 79), 293:317] = 220
    error, tracking, *_ = step_errors(luma, 0.05, true)
    sure = tracking.track.usable & (tracking.track.flag == "")
    assert (sure[14:79].all(), np.abs(error[sure]).max() < 1.5) == (True, True)  # as film it puts the edge 6 px back


@pytest.mark.parametrize(("width_px", "grey", "count"), [(26, 20.0, 105.0), (44, 230.0, 105.0), (64, 110.0, 83.0)])
def test_an_edge_behind_a_post_is_lost_and_all_others_are_found(width_px, grey, count):
    """The last film ends with 26 px of growth beyond the post."""
    true = grown_px(np.arange(count))
    luma = step_frames(true[:, None]).astype(float)
    luma[:, :, 250 : 250 + width_px] = grey + np.random.default_rng(337).normal(0, 2, (len(luma), 120, width_px))
    error, tracking, *_ = step_errors(np.rint(np.clip(luma, 0, 255)).astype(np.uint8), 0.05, true)
    usable = tracking.track.usable
    assert not usable[(true > 258) & (true < 242 + width_px)].any()
    assert usable[:-1][((true < 244) | (true > 258 + width_px))[:-1]].all()
    assert np.abs(error[usable]).max() < 0.15


# Compiled loops against plain ones.
LAG = 0.02 * (np.arange(9) - 4.0) ** 2
RIM = 40 * np.exp(-0.5 * ((np.arange(65) - 32 + 4.0) / 2.0) ** 2)
"""Shading of a tip with a bright rim 4 px behind its edge, grey levels, by distance ahead of it from −32 px on."""


def stepping(seed: int = 961, rim: bool = False, contrast: float = 110.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A strip with a noisy edge, its place, and brightness and variances on either side."""
    rng = np.random.default_rng(seed)
    edge = 30.31 + 3.73 * np.arange(16)
    x = np.arange(120)
    cover = np.clip(edge[:, None, None] - LAG[:, None] - x + 0.5, 0, 1)
    pictures = np.stack([40 + contrast + rng.normal(0, 9, (9, 120)), 40 + rng.normal(0, 9, (9, 120)),
                         np.full((9, 120), 12.0), np.full((9, 120), 9.0)]).astype(np.float32)  # fmt: skip
    values = pictures[1] + cover * (pictures[0] - pictures[1]) + rng.normal(0, 3, cover.shape)
    if rim:
        ahead = x - (edge[:, None, None] - LAG[:, None])
        values = values + np.interp(ahead, np.arange(65) - 32.0, RIM, left=0.0, right=0.0)
    return np.clip(values, 0, 255).astype(np.uint8), edge, pictures


def fitted(strip: np.ndarray, start: np.ndarray, pictures: np.ndarray, shading: np.ndarray) -> np.ndarray:
    fixed = (np.zeros(16), LAG, 0.4, pictures, 0.15, 6.0, 12)
    return kernels.fit_edges(strip, np.ones(16), np.zeros(16), start, *fixed, shading, np.arange(16))


@pytest.mark.parametrize(("radius", "tip_depth"), [(24.0, 10.0), (6.0, 3.0)])
def test_the_edge_is_that_of_the_foremost_point_of_a_thin_tube_too(radius, tip_depth):
    error, _ = errors(*followed(seed=8101, rest_frames=20, radius=radius, tip_depth=tip_depth, tail_sd=0.0))
    assert abs(error.mean()) < 0.06
    assert error.std() < 0.1


def test_a_tube_that_draws_back_is_not_followed_where_it_was_before():
    out, slow = (plain_scene(Plan(**SHORT, seed=8102, rest_frames=20, speed=speed)) for speed in (20.0, 2.0))
    back = np.flatnonzero(slow.edge_px > 300)[::-1]
    back = np.append(back, np.repeat(back[-1:], 60))
    seen, edge_px = np.concatenate([out.frames, slow.frames[back]]), np.append(out.edge_px, slow.edge_px[back])
    tracking = pictures.tracked(seen, out.plan.exposure, axis_through([(0.0, 80.0), (519.0, 80.0)]))
    wrong = np.abs(tracking.track.edge_px - SHORT["from_px"][0] - edge_px) > 5
    assert not (wrong & tracking.track.usable).any()


@pytest.mark.parametrize("contrast", [110.0, -15.0, 0.0])
def test_a_rim_that_moves_with_the_tip_tells_of_its_edge_even_where_film_looks_like_background(contrast):
    strip, edge, pictures = stepping(rim=True, contrast=contrast)
    known, ignored = (fitted(strip, edge - 1.4, pictures, shading)[:, 0] - edge for shading in (RIM, 0 * RIM))
    assert np.abs(known).max() < 0.15
    assert np.abs(ignored).max() > 2 * np.abs(known).max()


@pytest.mark.slow
def test_a_fit_is_the_same_to_the_last_digit_in_the_process_that_compiles_it_and_in_later_ones(tmp_path):
    where = {"NUMBA_CACHE_DIR": str(tmp_path), "PYTHONPATH": os.pathsep.join(sys.path)}
    run = [sys.executable, "-c", FITS]
    first, later = (subprocess.run(run, env=os.environ | where, capture_output=True, check=True) for _ in range(2))
    assert first.stdout == later.stdout


def test_a_background_that_is_black_along_half_of_the_growth_is_no_flicker():
    picture = np.random.default_rng(1).integers(20, 200, (80, 160)).astype(np.uint8)
    picture[:, :100] = 0
    scale = steadied(np.stack([picture] * 6), axis_through(((10, 40), (150, 40)), 6.0), 5)[0]
    np.testing.assert_allclose(scale, 1.0, atol=1e-3)
