"""Release, the force in a steady window, one trial's row, replicates and efficiency, against sums by hand and SciPy."""

import math
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from by_hand import G, N, Vine
from vine_truth import CAPTURE_FPS, Recording, ar1, motion, record, scaled

from vinetrack import effects
from vinetrack.core.records import Kinematics, Track, Trial, plain_track
from vinetrack.dynamics.model import base_model
from vinetrack.experiment.schema import with_names
from vinetrack.experiment.settings import RunSettings
from vinetrack.kinematics import steady as module
from vinetrack.kinematics import summary
from vinetrack.kinematics.steady import Release, SteadyForce, TrialMotion, Window, find_release, flag_rest
from vinetrack.kinematics.summary import estimate_kinematics

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
FOUND_WITHIN = [
    (scaled(1, 3.0), 3e-5, 0.5), (scaled(1, 10.0), 1e-4, 0.5), (scaled(3, 5.0), 1e-4, 1.0),
    (scaled(4, 10.0), 1e-4, 1.0), (scaled(4, 1.0), 1e-4, 2.0), (scaled(4, 0.3), 3e-5, 2.0),
]  # fmt: skip
SLOW = scaled(4, 1.5)
BARE_TRIAL = Trial(name="", diameter_m=0.012, thickness_m=100e-6, length_m=0.2, pressure_Pa=24e3, yield_pressure_Pa=3e3)
LOADED_TRIAL = replace(BARE_TRIAL, pressure_Pa=34e3, payload_kg=0.0356)
KINDS = {"bare": (BARE_TRIAL, 4), "loaded": (LOADED_TRIAL, 3), "alone": (replace(BARE_TRIAL, pressure_Pa=30e3), 1)}
KNOWN = with_names([replace(one, name=f"{name}{i}") for name, (one, count) in KINDS.items() for i in range(count)])
LONG = replace(LOADED_TRIAL, length_m=0.3)


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
    assert module.paper_force_N(VINE) == pytest.approx(11e3 * AREA, rel=1e-12)
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


@pytest.mark.parametrize(("vine", "noise_m", "frames"), FOUND_WITHIN, ids=str)
def test_onset_is_found_to_within_frames(vine, noise_m, frames):
    off = []
    for seed in range(1000, 1010):
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
        trial = record(scaled(2, 2.0), np.random.default_rng(seed), noise_m=1e-4, rho=0.5, rest_frames=60)
        release = release_of(trial.track)
        pulls.append((release.lead_position_m - trial.lead_position_m[0]) / release.lead_position_sigma_m)
    assert 0.6 < np.sqrt(np.mean(np.square(pulls))) < 1.6


def test_motion_from_the_first_frame_is_said_and_a_start_just_missed_is_extrapolated():
    time_s = np.arange(8, 200) / 1000
    noise_m = ar1(192, 2e-5, 0.0, np.random.default_rng(1000))
    even = plain_track(time_s, 0.02 + 0.5 * time_s + noise_m)
    assert release_of(even).moving_from_start
    assert release_of(even).time_s == time_s[0]
    assert release_of(even).lead_position_m == pytest.approx(0.024, abs=4e-4)
    np.testing.assert_array_equal(flag_rest(even, release_of(even)).flag, even.flag)
    release = release_of(plain_track(time_s, 0.5 * 9.81 * time_s**2 + noise_m), travel_ratio=1)
    assert release.moving_from_start
    assert release.time_s == pytest.approx(0.0, abs=1e-3)
    assert abs(release.lead_position_m) < 3e-4


def summarise(vine: Vine, **changes: object) -> tuple[Recording, dict, dict]:
    """A recording of a vine, its row and its point."""
    known = {"condition": "c", "growth_angle_rad": 0.0, "pressure_sigma_Pa": 100.0, "yield_pressure_sigma_Pa": 200.0}
    trial = vine.trial(chamber_m3=math.nan, inlet_m=math.nan, **known)
    recording = record(vine, np.random.default_rng(5), noise_m=5e-5)
    result = summary.summarise_trial(replace(trial, **changes), recording.track, RunSettings(), base_model())
    return recording, result.row, result.point


def test_a_steady_trial_gives_its_speeds_and_the_force_that_holds_it():
    """B x_ssⁿ from the reported speed is the reported force, weight and all: the law that made the motion."""
    recording, row, _ = summarise(SLOW)
    assert row["steady_rule"] == "gated"
    x_ss, sigma, force = row["x_ss_m_s"], row["x_ss_sigma_m_s"], row["force_N"]
    assert 0 < sigma < 0.02 * x_ss
    assert SLOW.B * x_ss**N == pytest.approx(force, rel=5e-3)
    assert force > (SLOW.P - SLOW.P_y) * SLOW.A
    assert row["x_ss_paper_m_s"] == pytest.approx(x_ss, rel=0.1)
    solution, grown_s = motion(SLOW)
    middle_s = 0.5 * (row["steady_from_s"] + row["steady_to_s"])
    assert x_ss == pytest.approx(solution(middle_s - recording.release_s)[1], rel=0.02)
    x, v = solution(np.linspace(0, grown_s, 20_001))
    truth = np.interp(0.95 * 2 * SLOW.L, x, v) / 2
    assert row["final_lead_velocity_m_s"] == pytest.approx(truth, rel=0.03)


def test_a_trial_that_still_gathers_speed_or_whose_window_is_outside_the_recording_says_why():
    outside = {"steady_window_s": (900.0, 901.0)}
    for vine, changes, status in ((scaled(4, 30.0, payload=0.0356), {}, "ok"), (SLOW, outside, "warning")):
        _, row, point = summarise(vine, **changes)
        assert (row["steady_rule"], row["status"], point["used"]) == ("", status, False)
        assert math.isnan(row["x_ss_m_s"])
        assert np.isfinite(row["final_lead_velocity_m_s"])


def test_a_falling_ball_is_measured_but_has_no_place_in_the_law():
    """½gt² at 500 frames a second: no plateau; the last speed is g t."""
    time_s = np.arange(150) / 500
    fallen = 0.5 * G * np.maximum(time_s - 0.05, 0) ** 2
    position_m = 0.3 + fallen + 1e-4 * np.random.default_rng(4).standard_normal(150)
    ball = Trial(name="ball", travel_ratio=1.0, payload_kg=0.05, pressure_Pa=0.0, yield_pressure_Pa=0.0)
    result = summary.summarise_trial(ball, plain_track(time_s, position_m), RunSettings(), base_model())
    assert result.point["used"] is False
    assert result.row["final_lead_velocity_m_s"] == pytest.approx(G * (time_s[-1] - 0.05), rel=0.05)
    assert math.isnan(float(result.row["efficiency"]))  # type: ignore[arg-type]
    late = summary.summarise_trial(ball, plain_track(time_s[30:], position_m[30:]), RunSettings(), base_model())
    assert (late.release.moving_from_start, late.row["status"]) == (True, "ok")  # seen late, as from a launcher's mouth


def row(name: str, x_ss: float = math.nan, final: float = math.nan, status: str = "ok", **numbers: float) -> dict:
    condition = next(trial.condition for trial in KNOWN if trial.name == name)
    speeds = {"x_ss_m_s": x_ss, "x_ss_sigma_m_s": 0.05, "final_lead_velocity_m_s": final, "efficiency": math.nan}
    return {"trial": name, "condition": condition, "status": status, **speeds, **numbers}


ROWS = [
    row("bare0", 2.0, 1.1), row("bare1", 2.4, 1.3), row("bare2", 2.2, 1.2), row("bare3", final=1.4, status="warning"),
    row("loaded0", efficiency=0.50), row("loaded1", efficiency=0.54), row("loaded2", efficiency=9.0, status="failed"),
    row("alone0", 3.0),
]  # fmt: skip


def table(rows: list[dict] = ROWS) -> pd.DataFrame:
    found = summary.condition_table(pd.DataFrame(rows), KNOWN, final_at_fraction=0.95, efficiency_at_mm=150.0)
    return found.set_index(found["condition"].str.split("_").str[1:].str.join("_"))


def test_speed_is_a_mean_with_its_standard_error():
    """2.0, 2.4, 2.2: mean 2.2, standard deviation 0.2, over √3. Final speeds count wherever growth got there."""
    bare = table().loc["24kPa_0g"]
    assert bare["x_ss_m_s"] == pytest.approx(2.2)
    assert bare["x_ss_sigma_m_s"] == pytest.approx(0.2 / math.sqrt(3))
    assert (bare["n_trials"], bare["n_steady"], bare["n_final"]) == (4, 3, 4)
    assert bare["x_ss_over_diameter_1_s"] == pytest.approx(2.2 / 0.012)
    assert bare["x_ss_over_diameter_sigma_1_s"] == pytest.approx(0.2 / math.sqrt(3) / 0.012)
    assert (bare["final_lead_velocity_m_s"], bare["final_at_mm"]) == pytest.approx((1.25, 190.0))
    assert table().loc["30kPa_0g", ["x_ss_m_s", "x_ss_sigma_m_s"]].tolist() == [3.0, 0.05]
    # A minority of steady trials stands for nobody.
    bare = table([*ROWS[:1], *(row(f"bare{i}", final=1.2) for i in (1, 2, 3))]).loc["24kPa_0g"]
    assert bare["n_steady"] == 1
    assert bare[["x_ss_m_s", "x_ss_over_diameter_1_s"]].isna().all()


def test_failed_trials_count_for_nothing_and_efficiency_has_its_variants():
    """Film 4.5239 g/m × 0.2 m: 0.22619 g are left at 0.15 m beside 35.6 g; the mean moving mass is 36.1655 g."""
    loaded = table().loc["34kPa_35.6g"]
    assert (loaded["n_trials"], loaded["n_efficiency"]) == (2, 2)
    assert loaded["efficiency"] == pytest.approx(0.52)
    assert loaded["efficiency_sigma"] == pytest.approx(0.02)  # standard deviation 0.0283 over √2
    payload = 35.6 / (35.6 + 0.226195)
    assert loaded["efficiency_payload"] == pytest.approx(0.52 * payload, rel=1e-5)
    share = 36.165487e-3 * 9.81 * 0.3 / (34e3 * math.pi * 0.006**2 * 0.15)
    assert loaded["weight_share"] == pytest.approx(share, rel=1e-6)
    assert loaded["efficiency_with_weight"] == pytest.approx(0.52 / (1 + share), rel=1e-6)
    assert loaded["efficiency_with_weight_sigma"] == pytest.approx(0.02 / (1 + share), rel=1e-6)


def test_velocity_where_a_position_is_passed_is_interpolated():
    y, v = np.array([0.0, 0.1, 0.2, 0.4]), np.array([0.0, 1.0, 3.0, 4.0])
    places_m = (0.15, 0.3, 0.2, 0.41, -0.1, 0.0)
    found = [summary.lead_velocity_at(y, v, place_m) for place_m in places_m]
    assert found == pytest.approx([2.0, 3.5, 3.0, math.nan, math.nan, math.nan], nan_ok=True)


def test_efficiency_by_hand():
    """Film of 4.5239 g/m: 0.15 m of 0.3 m left, 0.679 g, and 35.6 g at 2 × 3 m/s, over 34 kPa × 113.1 mm² × 0.15 m."""
    film_kg = 1200 * math.pi * 0.012 * 100e-6 * 0.15
    assert film_kg == pytest.approx(0.679e-3, rel=1e-3)
    truth = 0.5 * (0.0356 + film_kg) * 36 / (34e3 * math.pi * 0.006**2 * 0.15)
    assert summary.energy_efficiency(LONG, 0.15, 3.0) == pytest.approx(truth, rel=1e-12)
    assert truth == pytest.approx(1.132, rel=1e-3)


def test_the_weight_of_the_payload_works_beside_the_gas():
    """35.6 g × 9.81 m/s² × 0.3 m = 0.10477 J, beside 34 kPa × 0.15 m × 113.10 or 254.47 mm² = 0.57679 or 1.29777 J."""
    for D_mm, angle_deg, share in ((12, 0, 0.1816), (18, 0, 0.0807), (12, 60, 0.0908), (12, 180, -0.1816)):
        no_film = replace(LONG, diameter_m=D_mm / 1e3, thickness_m=1e-12, growth_angle_rad=math.radians(angle_deg))
        assert summary.efficiency_shares(no_film, 0.15)[1] == pytest.approx(share, rel=1e-3)
