"""Release time and resting position against vines of known release. Scored on seeds 1000 and up (tuned on 0–99)."""

from __future__ import annotations

import math

import numpy as np
import pytest
from vine_truth import CAPTURE_FPS, Vine, ar1, make_track, record

from vinetrack.kinematics.force import find_release, flag_rest
from vinetrack.kinematics.velocity import estimate_kinematics


def release_of(track, travel_ratio=2.0):
    return find_release(track, estimate_kinematics(track, travel_ratio=travel_ratio))


@pytest.mark.parametrize(
    ("vine", "noise_m", "frames"),
    [
        (Vine(1, 3.0), 3e-5, 0.5),
        (Vine(1, 10.0), 1e-4, 0.5),
        (Vine(3, 5.0), 1e-4, 1.0),
        (Vine(4, 10.0), 1e-4, 1.0),
        (Vine(4, 1.0), 1e-4, 2.0),
        (Vine(4, 0.3), 3e-5, 2.0),
    ],
    ids=str,
)
def test_onset_is_found_to_within_frames(vine, noise_m, frames):
    off = []
    for seed in range(1000, 1020):
        trial = record(vine, np.random.default_rng(seed), noise_m=noise_m, rho=0.3, rest_frames=50)
        off.append((release_of(trial.track).time_s - trial.release_s) * CAPTURE_FPS)
    assert np.sqrt(np.mean(np.square(off))) < frames


def test_origin_is_within_its_error():
    pulls = []
    for seed in range(1000, 1060):
        trial = record(Vine(2, 2.0), np.random.default_rng(seed), noise_m=1e-4, rho=0.5, rest_frames=60)
        release = release_of(trial.track)
        pulls.append((release.lead_position_m - trial.lead_position_m[0]) / release.lead_position_sigma_m)
    assert 0.6 < np.sqrt(np.mean(np.square(pulls))) < 1.6


def test_rest_frames_are_flagged_and_no_others():
    trial = record(Vine(3, 5.0), np.random.default_rng(1000), noise_m=3e-5, rest_frames=50)
    release = release_of(trial.track)
    flagged = flag_rest(trial.track, release)
    resting = flagged.flag == "before_release"
    assert resting.sum() == np.sum(trial.track.time_s < release.time_s)
    assert abs(resting.sum() - 51) <= 1
    assert np.all(trial.track.flag == "")


def test_flags_already_there_are_kept():
    trial = record(Vine(3, 5.0), np.random.default_rng(1000), noise_m=3e-5, rest_frames=50)
    trial.track.flag[3] = "doubtful"
    flagged = flag_rest(trial.track, release_of(trial.track))
    assert flagged.flag[3] == "before_release;doubtful"


def test_motion_from_the_first_frame_is_said_and_the_first_point_taken():
    time_s = np.arange(200) / 1069
    y = 0.02 + 0.5 * time_s + ar1(200, 1e-4, 0.0, np.random.default_rng(1000))
    track = make_track(time_s, y)
    release = release_of(track)
    assert release.moving_from_start
    assert release.time_s == 0.0
    assert release.lead_position_m == pytest.approx(0.02, abs=4e-4)
    assert "moving at the first point" in release.reason
    assert "zeros set to the first point" in release.reason
    np.testing.assert_array_equal(flag_rest(track, release).flag, track.flag)


def test_a_start_just_missed_is_extrapolated_and_said():
    time_s = np.arange(8, 200) / 1000
    y = 0.5 * 9.81 * time_s**2 + ar1(192, 2e-5, 0.0, np.random.default_rng(1000))
    release = release_of(make_track(time_s, y), travel_ratio=1)
    assert release.moving_from_start
    assert "extrapolated" in release.reason
    assert release.time_s == pytest.approx(0.0, abs=1e-3)
    assert abs(release.lead_position_m) < 3e-4


@pytest.mark.parametrize("noise_m", [0.0, 1e-4])
def test_what_never_moves_has_no_release(noise_m):
    y = 0.3 + ar1(200, noise_m, 0.3, np.random.default_rng(1000))
    track = make_track(np.arange(200) / 1069, y)
    release = release_of(track)
    assert math.isnan(release.time_s)
    assert not release.moving_from_start
    assert release.lead_position_m == pytest.approx(0.3, abs=5e-5)
    assert "never moves" in release.reason
    np.testing.assert_array_equal(flag_rest(track, release).flag, track.flag)


def test_exact_rest_and_motion_give_the_exact_corner():
    time_s = np.arange(200) / 1000
    release = release_of(make_track(time_s, 0.5 * np.maximum(time_s - 0.1, 0.0)))
    assert release.time_s == pytest.approx(0.1, abs=1e-4)
    assert release.lead_position_m == 0.0
