"""Replicates of motions that are known, laid over each other."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from vinetrack.core.records import Trial
from vinetrack.diagnosis.ladder import position_errors
from vinetrack.diagnosis.replicates import align_replicates, replicates_of
from vinetrack.inference.fit_data import ImpreciseRest
from vinetrack.inference.fit_result import TrialFit

STEP_S = 1e-3


def grown(
    name: str,
    *,
    speed: float = 1.0,
    noise_m: float = 0.0,
    rest: int = 30,
    clock_s: float = 0.0,
    origin_m: float = 0.0,
    seed: int = 0,
) -> TrialFit:
    """A vine that speeds up as 1 − exp(−t / 20 ms) towards 2 m/s times `speed`, begun `clock_s` after its time 0."""
    time_s = clock_s + STEP_S * np.arange(-rest, 151)
    since_s = np.maximum(time_s - clock_s - 0.0004, 0.0)
    position_m = 2.0 * speed * (since_s - 0.02 * (1 - np.exp(-since_s / 0.02))) + origin_m
    position_m = position_m + noise_m * np.random.default_rng(seed).standard_normal(time_s.size)
    model_m = origin_m + 1.9 * np.maximum(time_s - clock_s, 0.0)
    return TrialFit(
        trial=Trial(name=name, vine="v", condition="c"),
        time_s=time_s,
        lead_position_m=position_m,
        predicted_position_m=model_m,
        predicted_velocity_m_s=np.where(time_s > clock_s, 1.9, 0.0),
        residual_m=position_m - model_m,
        whitened=position_m - model_m,
        release_s=clock_s,
        release_sigma_s=0.0,
        origin_m=origin_m,
        origin_sigma_m=0.0,
        pressure_deviation=0.0,
        pressure_deviation_sigma=0.0,
        damping_deviation=0.0,
        damping_deviation_sigma=0.0,
        noise_m=1e-5,
    )


def scattered(count: int, **same: float) -> list[TrialFit]:
    draw = np.random.default_rng(20000)
    return [
        grown(f"t{i}", speed=1 + 0.02 * draw.standard_normal(), noise_m=5e-5, seed=20000 + i, **same)
        for i in range(count)
    ]


def another_model(trial: TrialFit) -> TrialFit:
    """The same measurement, put by another model 7 ms and 5 mm elsewhere and predicted to grow half as fast."""
    model_m = trial.origin_m + 5e-3 + 0.9 * np.maximum(trial.time_s - trial.release_s - 7e-3, 0.0)
    return replace(
        trial,
        predicted_position_m=model_m,
        residual_m=trial.lead_position_m - model_m,
        release_s=trial.release_s + 7e-3,
        origin_m=trial.origin_m + 5e-3,
    )


@pytest.mark.parametrize("rest", [30, 0])
def test_the_floor_is_the_same_for_every_model(rest):
    trials = scattered(4, rest=rest)
    others = [another_model(trial) if i % 2 else trial for i, trial in enumerate(trials)]
    one, other = (position_errors(each, replicates_of(each)) for each in (trials, others))
    assert one["replicate_floor_m"] == other["replicate_floor_m"] > 0
    assert one["replicate_floor_sigma_m"] == other["replicate_floor_sigma_m"]
    assert one["rms_position_m"] != other["rms_position_m"]


@pytest.mark.parametrize("rest", [30, 0])
def test_equal_motions_with_clocks_and_origins_of_their_own_differ_by_nothing(rest):
    trials = [grown("a", rest=rest), grown("b", rest=rest, clock_s=0.31234, origin_m=0.1)]
    # What is left is the curvature within half a frame beside the smoothed reference.
    assert align_replicates(trials).floor_m < 2e-5


def test_a_track_that_begins_in_motion_is_laid_on_one_that_shows_its_rest():
    one, whole = grown("a"), grown("b", clock_s=0.2)
    kept = whole.time_s > 0.2 + 0.015
    late = replace(
        whole,
        time_s=whole.time_s[kept],
        lead_position_m=whole.lead_position_m[kept],
        predicted_position_m=whole.predicted_position_m[kept],
        residual_m=whole.residual_m[kept],
    )
    aligned = align_replicates([one, late])
    assert aligned.floor_m < 2e-5
    assert aligned.release_s[1] - aligned.release_s[0] == pytest.approx(0.2, abs=5e-4)


@pytest.mark.parametrize("vague", [True, False])
def test_motions_of_different_speed_are_not_slid_to_where_they_agree(vague):
    # Two motions 14 % apart in speed over 0.26 m: with the release at its best they are off by 0.14 · 0.26 m / √24 =
    # 7 mm, less what the bend at the start makes up for. Without a rest the origin is free too: the little that they
    # bend is then all that is left, but it is no tenth of a millimetre.
    trials = [grown("slow", speed=0.93, rest=0), grown("fast", speed=1.07, rest=0)]
    if vague:
        trials = [
            replace(trial, imprecise_rest=ImpreciseRest(release_s=0.0, origin_m=0.0, sigma_m=3e-4)) for trial in trials
        ]
    aligned = align_replicates(trials)
    both = aligned.present > 1
    assert np.count_nonzero(both) > 0.79 * 151
    assert aligned.floor_m > (5e-3 if vague else 1e-3)


def test_its_error_is_that_of_a_standard_deviation_known_from_so_many_replicates():
    draw = np.random.default_rng(20001)
    aligned = [
        align_replicates([grown(f"t{i}", speed=1 + 0.02 * draw.standard_normal()) for i in range(3)]) for _ in range(60)
    ]
    floors_m = np.array([one.floor_m for one in aligned])
    # σ/√(2ν) with ν = 2 is half of σ; the scatter of a standard deviation of ν = 2 is 0.52 of its mean.
    assert floors_m.std() / floors_m.mean() == pytest.approx(0.52, abs=0.12)
    np.testing.assert_allclose([one.floor_sigma_m for one in aligned], floors_m / 2)


def test_one_trial_alone_has_no_floor():
    alone = align_replicates([grown("a")])
    assert np.isnan(alone.floor_m)
    assert np.isnan(alone.floor_sigma_m)
