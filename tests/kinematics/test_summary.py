"""One trial from its track to a row, against vines followed by SciPy."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from vine_truth import B_PRINTED, N_EXPONENT, G, Recording, Vine, make_track, motion, record

from vinetrack import effects
from vinetrack.core.records import Trial
from vinetrack.dynamics.model import base_model
from vinetrack.experiment.settings import RunSettings
from vinetrack.kinematics.summary import TrialError, TrialResult, summarise_trial

ROW = (
    "trial,vine,condition,status,reason,n_frames,mm_per_px,scale_rel_sigma,noise_m,"
    "steady_from_s,steady_to_s,"
    "steady_rule,x_ss_m_s,x_ss_sigma_m_s,x_ss_paper_m_s,cv,force_N,final_lead_velocity_m_s,efficiency,"
    "tube_width_mm,growth_mm"
)
SLOW = Vine(4, 1.5)


def trial_of(vine: Vine, **changes: object) -> Trial:
    area = math.pi * vine.diameter_m**2 / 4
    plain = Trial(
        name="t",
        vine="v",
        condition="c",
        diameter_m=vine.diameter_m,
        thickness_m=50e-6 * vine.scale,
        length_m=vine.length_m,
        pressure_Pa=vine.drive_N / area + 3e3,
        pressure_sigma_Pa=100.0,
        yield_pressure_Pa=3e3,
        yield_pressure_sigma_Pa=200.0,
        payload_kg=vine.payload_kg,
    )
    return replace(plain, **changes)  # type: ignore[arg-type]


def summarise(trial: Trial, recording: Recording, model=None) -> TrialResult:
    return summarise_trial(trial, recording.track, RunSettings(), model or base_model())


@pytest.fixture(scope="module")
def slow() -> tuple[Recording, TrialResult]:
    recording = record(SLOW, np.random.default_rng(5), noise_m=5e-5)
    return recording, summarise(trial_of(SLOW), recording)


def test_the_row_has_the_columns_of_the_results(slow: tuple[Recording, TrialResult]) -> None:
    recording, result = slow
    assert ",".join(result.row) == ROW
    assert result.row["trial"] == "t"
    assert result.row["vine"] == "v"
    assert result.row["condition"] == "c"
    assert result.row["status"] == "ok"
    assert result.row["reason"] == ""
    assert result.row["n_frames"] == recording.track.time_s.size
    assert result.row["noise_m"] == pytest.approx(5e-5, rel=0.2)


def test_a_steady_trial_gives_its_speed_and_the_force_that_holds_it(slow: tuple[Recording, TrialResult]) -> None:
    """B x_ssⁿ from the reported speed is the reported force, weight and all: the law that made the motion."""
    _, result = slow
    row = result.row
    assert row["steady_rule"] == "gated"
    x_ss, sigma, force = (float(row[name]) for name in ("x_ss_m_s", "x_ss_sigma_m_s", "force_N"))  # type: ignore[arg-type]
    assert 0 < sigma < 0.02 * x_ss
    assert B_PRINTED[4] * x_ss**N_EXPONENT == pytest.approx(force, rel=5e-3)
    assert force > SLOW.drive_N
    middle_s = 0.5 * (float(row["steady_from_s"]) + float(row["steady_to_s"]))  # type: ignore[arg-type]
    assert row["x_ss_paper_m_s"] == pytest.approx(x_ss, rel=0.1)
    solution, _ = motion(SLOW)
    assert x_ss == pytest.approx(solution(middle_s - slow[0].release_s)[1], rel=0.02)


def test_the_point_of_the_fit_repeats_the_row(slow: tuple[Recording, TrialResult]) -> None:
    _, result = slow
    point = result.point
    for name in ("x_ss_m_s", "x_ss_sigma_m_s", "force_N", "x_ss_paper_m_s", "trial", "vine"):
        assert point[name] == result.row[name]
    assert point["used"] is True
    assert point["reason"] == ""
    assert point["pressure_source"] == "set"
    area = math.pi * 0.012**2
    assert point["force_paper_N"] == pytest.approx(SLOW.drive_N, rel=1e-9)
    assert point["force_sigma_N"] == pytest.approx(100 * area, rel=1e-9)
    assert point["yield_force_sigma_N"] == pytest.approx(200 * area, rel=1e-9)
    assert point["diameter_mm"] == pytest.approx(24)
    assert point["thickness_um"] == pytest.approx(200)


def test_the_release_is_found_and_rest_is_flagged(slow: tuple[Recording, TrialResult]) -> None:
    recording, result = slow
    assert result.release.time_s == pytest.approx(recording.release_s, abs=3 / 1069)
    resting = np.char.find(result.track.flag.astype(str), "before_release") >= 0
    assert resting[:35].all()
    assert not resting[recording.track.time_s > recording.release_s + 3 / 1069].any()


def test_the_final_speed_is_taken_at_95_per_cent_of_the_length(slow: tuple[Recording, TrialResult]) -> None:
    _, result = slow
    solution, grown_s = motion(SLOW)
    times = np.linspace(0, grown_s, 20_001)
    x, v = solution(times)
    truth = np.interp(0.95 * 2 * SLOW.length_m, x, v) / 2
    assert result.row["final_lead_velocity_m_s"] == pytest.approx(truth, rel=0.03)


def test_the_efficiency_at_150_mm_is_that_of_the_true_motion(slow: tuple[Recording, TrialResult]) -> None:
    _, result = slow
    solution, grown_s = motion(SLOW)
    x, v = solution(np.linspace(0, grown_s, 20_001))
    speed = np.interp(0.3, x, v)
    trial = trial_of(SLOW)
    truth = 0.5 * float(SLOW.mass_kg(0.3)) * speed**2 / (trial.pressure_Pa * math.pi * 0.012**2 * 0.15)
    assert result.row["efficiency"] == pytest.approx(truth, rel=0.03)


def test_a_loaded_trial_that_still_gathers_speed_has_no_window_and_says_why() -> None:
    vine = Vine(4, 30.0, payload_kg=0.0356)
    result = summarise(trial_of(vine), record(vine, np.random.default_rng(5), noise_m=5e-5))
    assert result.row["steady_rule"] == ""
    assert math.isnan(float(result.row["x_ss_m_s"]))  # type: ignore[arg-type]
    assert "no steady window: " in str(result.row["reason"])
    assert result.row["status"] == "ok"
    assert result.point["used"] is False
    assert result.point["reason"] == "carries a payload of 35.6 g"
    assert np.isfinite(float(result.row["final_lead_velocity_m_s"]))  # type: ignore[arg-type]


def test_the_users_own_window_is_taken_before_ours() -> None:
    recording = record(SLOW, np.random.default_rng(5), noise_m=5e-5)
    start = recording.release_s + 0.1
    result = summarise(trial_of(SLOW, steady_window_s=(start, start + 0.05)), recording)
    assert result.row["steady_rule"] == "user"
    assert result.row["steady_from_s"] >= start - 1e-9
    assert result.row["steady_to_s"] <= start + 0.05 + 1e-9
    assert set(result.windows) == {"gated", "paper", "user"}


def test_a_window_of_the_user_outside_the_recording_is_a_warning_and_no_number() -> None:
    recording = record(SLOW, np.random.default_rng(5), noise_m=5e-5)
    result = summarise(trial_of(SLOW, steady_window_s=(900.0, 901.0)), recording)
    assert result.row["status"] == "warning"
    assert result.row["reason"]
    assert math.isnan(float(result.row["x_ss_m_s"]))  # type: ignore[arg-type]
    assert result.point["used"] is False


def test_a_falling_ball_is_measured_but_has_no_place_in_the_law() -> None:
    """½gt² at 500 frames a second: no plateau; the last speed is g t."""
    time_s = np.arange(150) / 500
    fallen = 0.5 * G * np.maximum(time_s - 0.05, 0) ** 2
    noise = 1e-4 * np.random.default_rng(4).standard_normal(150)
    ball = Trial(name="ball", travel_ratio=1.0, payload_kg=0.05, pressure_Pa=0.0, yield_pressure_Pa=0.0)
    result = summarise_trial(ball, make_track(time_s, 0.3 + fallen + noise), RunSettings(), base_model())
    assert result.point["reason"] == "a body that moves as a whole has no eversion damping"
    assert result.row["final_lead_velocity_m_s"] == pytest.approx(G * (time_s[-1] - 0.05), rel=0.05)
    assert math.isnan(float(result.row["efficiency"]))  # type: ignore[arg-type]


def test_fewer_than_five_usable_points_are_no_trial() -> None:
    track = make_track(np.arange(6) / 1000, np.array([0, 0.1, np.nan, 0.2, 0.3, np.nan]))
    with pytest.raises(TrialError, match="4 usable points; at least 5 are needed"):
        summarise_trial(trial_of(SLOW), track, RunSettings(), base_model())


def test_what_the_model_lacks_of_the_trial_is_its_reason() -> None:
    recording = record(SLOW, np.random.default_rng(5), noise_m=5e-5)
    with pytest.raises(TrialError, match="needs `chamber_l`, which is blank"):
        summarise(trial_of(SLOW), recording, base_model() + effects.reservoir_depletion)


def test_the_track_is_left_alone() -> None:
    recording = record(SLOW, np.random.default_rng(5), noise_m=5e-5)
    before = recording.track.lead_position_m.copy(), recording.track.flag.copy(), recording.track.time_s.copy()
    summarise(trial_of(SLOW), recording)
    after = recording.track.lead_position_m, recording.track.flag, recording.track.time_s
    for then, now in zip(before, after, strict=True):
        np.testing.assert_array_equal(now, then)
