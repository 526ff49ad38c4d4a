"""Release, and the force in a steady window, against sums by hand and vines of known release."""

import math
from dataclasses import replace

import numpy as np
import pytest
from vine_truth import CAPTURE_FPS, Vine, ar1, make_track, record

from vinetrack import effects
from vinetrack.core.records import Kinematics, Track, Trial, Window, plain_track
from vinetrack.dynamics.model import base_model
from vinetrack.kinematics import force as module
from vinetrack.kinematics.force import Release, SteadyForce, TrialMotion, find_release, flag_rest
from vinetrack.kinematics.velocity import estimate_kinematics

G = 9.81
AREA = math.pi * 0.012**2
FILM = 1200 * math.pi * 0.024 * 200e-6
VINE = Trial(
    name="v", diameter_m=0.024, thickness_m=200e-6, length_m=0.28, pressure_Pa=14e3, pressure_sigma_Pa=140.0,
    yield_pressure_Pa=3e3, yield_pressure_sigma_Pa=200.0,
)  # fmt: skip
START_S, ORIGIN_M, SPEED = 0.05, 0.02, 1.0
TIME = START_S + np.arange(200) / 1000
WINDOW = Window("gated", True, "", from_s=START_S + 0.0499, to_s=START_S + 0.1501, n_points=101, x_ss_m_s=2 * SPEED)
RELEASE = Release(START_S, ORIGIN_M, 1e-5, False, "")


def moved(pressure_Pa: np.ndarray | None = None, trial: Trial = VINE) -> TrialMotion:
    """Growth at 1 m/s of the edge from 20 mm on; in WINDOW from 50 to 150 mm of growth, 100 mm in the mean."""
    y, ones = ORIGIN_M + SPEED * (TIME - START_S), np.ones(TIME.size)
    track = plain_track(TIME, y, pressure_Pa=pressure_Pa)
    kinematics = Kinematics(TIME, y, SPEED * ones, 0.01 * ones, 0 * ones, np.full(TIME.size, 7), 1e-4, 0.0, 2.0)
    return TrialMotion(trial, track, kinematics, RELEASE, {})


def force_of(trial: Trial, window: Window = WINDOW, pressure_Pa: np.ndarray | None = None, model=None) -> SteadyForce:
    return module.steady_force(moved(pressure_Pa, trial), window, model or base_model())


def test_force_is_the_excess_pressure_and_the_weight_of_what_still_moves():
    """Mean growth in the window 0.1 m: 0.18 m of film left, and its weight counts r = 2 times."""
    force = force_of(VINE)
    assert force.force_N == pytest.approx(11e3 * AREA + 2 * FILM * 0.18 * G, rel=1e-9)
    assert force.paper_N == pytest.approx(11e3 * AREA, rel=1e-12)
    assert force.sigma_N == pytest.approx(140 * AREA, rel=1e-12)
    assert force.yield_sigma_N == pytest.approx(200 * AREA, rel=1e-12)
    assert force.window_pressure_Pa == pytest.approx(14e3, rel=1e-12)
    assert force.pressure_source == "set"
    for angle_deg, share in ((60, 0.5), (90, 0), (180, -1)):
        force = force_of(replace(VINE, growth_angle_rad=math.radians(angle_deg)))
        assert force.force_N == pytest.approx(11e3 * AREA + share * 2 * FILM * 0.18 * G, rel=1e-9)


def test_a_measured_pressure_takes_the_place_of_the_set_one():
    """A trace that falls by 20 Pa a frame is 12 kPa in the mean, at the middle of the window; a fall is no error."""
    trace = 12e3 - 20.0 * (np.arange(200) - 100)
    force = force_of(VINE, pressure_Pa=trace)
    assert force.window_pressure_Pa == pytest.approx(12e3, rel=1e-9)
    assert force.force_N == pytest.approx(9e3 * AREA + 2 * FILM * 0.18 * G, rel=1e-9)
    assert force.sigma_N == pytest.approx(0, abs=1e-9)
    assert force.pressure_source == "trace"
    assert force.paper_N == pytest.approx(11e3 * AREA)
    noisy = trace + 100.0 * np.random.default_rng(3).standard_normal(200)
    assert force_of(VINE, pressure_Pa=noisy).sigma_N == pytest.approx(100 / math.sqrt(101) * AREA, rel=0.2)
    silent = np.where((np.arange(200) > 39) & (np.arange(200) < 160), math.nan, trace)
    assert force_of(VINE, pressure_Pa=silent).pressure_source == "set"


def test_the_model_in_use_says_what_the_pressure_was():
    """An isothermal litre: the mean over the window of the gas law at 50 … 150 mm."""
    trial = replace(VINE, chamber_m3=1e-3)
    model = (base_model() + effects.reservoir_depletion).with_values({"reservoir_depletion.gamma": 1.0})
    y = np.arange(50, 151) / 1000
    mean = np.mean((14e3 + 101_325) * 1e-3 / (1e-3 + AREA * y) - 101_325)
    force = force_of(trial, model=model)
    assert force.window_pressure_Pa == pytest.approx(mean, rel=1e-9)
    assert force.pressure_source == "set"
    assert mean < 10e3


def test_in_a_quasi_steady_window_inertia_is_taken_off():
    """A drift of 10 % of 2 m/s over 0.1 s: ẍ = 2 m/s²."""
    window = replace(WINDOW, rule="quasi_steady", from_s=START_S + 0.05, to_s=START_S + 0.15, drift=0.1)
    exact = 11e3 * AREA + 2 * FILM * 0.18 * (G - 2.0)
    assert force_of(VINE, window).force_N == pytest.approx(exact, rel=1e-3)
    assert force_of(VINE).force_N - force_of(VINE, window).force_N == pytest.approx(2 * FILM * 0.18 * 2.0, rel=1e-2)


def test_pressure_along_the_motion_is_known_from_a_trace_or_a_model_only_and_payloads_are_in_no_law():
    assert module.known_pressure(moved(), base_model()) is None
    found = module.known_pressure(moved(np.where(np.arange(200) % 2, 12e3 + np.arange(200), math.nan)), base_model())
    assert found is not None
    np.testing.assert_allclose(found[1:], 12e3 + np.arange(1, 200))
    assert module.why_not_in_fit(VINE) == ""
    assert module.why_not_in_fit(replace(VINE, payload_kg=0.0356))


def release_of(track: Track, travel_ratio: float = 2.0) -> Release:
    return find_release(track, estimate_kinematics(track, travel_ratio=travel_ratio))


FOUND_WITHIN = [
    (Vine(1, 3.0), 3e-5, 0.5), (Vine(1, 10.0), 1e-4, 0.5), (Vine(3, 5.0), 1e-4, 1.0),
    (Vine(4, 10.0), 1e-4, 1.0), (Vine(4, 1.0), 1e-4, 2.0), (Vine(4, 0.3), 3e-5, 2.0),
]  # fmt: skip


@pytest.mark.parametrize(("vine", "noise_m", "frames"), FOUND_WITHIN, ids=str)
def test_onset_is_found_to_within_frames(vine, noise_m, frames):
    off = []
    for seed in range(1000, 1020):
        trial = record(vine, np.random.default_rng(seed), noise_m=noise_m, rho=0.3, rest_frames=50)
        release = release_of(trial.track)
        off.append((release.time_s - trial.release_s) * CAPTURE_FPS)
        resting = trial.track.time_s < release.time_s
        assert np.array_equal(flag_rest(trial.track, release).flag == "before_release", resting)
    assert np.sqrt(np.mean(np.square(off))) < frames


@pytest.mark.slow
def test_origin_is_within_its_error():
    pulls = []
    for seed in range(1000, 1060):
        trial = record(Vine(2, 2.0), np.random.default_rng(seed), noise_m=1e-4, rho=0.5, rest_frames=60)
        release = release_of(trial.track)
        pulls.append((release.lead_position_m - trial.lead_position_m[0]) / release.lead_position_sigma_m)
    assert 0.6 < np.sqrt(np.mean(np.square(pulls))) < 1.6


def test_motion_from_the_first_frame_is_said_and_a_start_just_missed_is_extrapolated():
    time_s = np.arange(8, 200) / 1000
    noise_m = ar1(192, 2e-5, 0.0, np.random.default_rng(1000))
    even = make_track(time_s, 0.02 + 0.5 * time_s + noise_m)
    assert release_of(even).moving_from_start
    assert release_of(even).time_s == time_s[0]
    assert release_of(even).lead_position_m == pytest.approx(0.024, abs=4e-4)
    np.testing.assert_array_equal(flag_rest(even, release_of(even)).flag, even.flag)
    release = release_of(make_track(time_s, 0.5 * 9.81 * time_s**2 + noise_m), travel_ratio=1)
    assert release.moving_from_start
    assert release.time_s == pytest.approx(0.0, abs=1e-3)
    assert abs(release.lead_position_m) < 3e-4
