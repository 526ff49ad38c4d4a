"""A trial recorded to the end of growth carries no more information on an effect than one cut off before."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hidden.laboratory_folder import write_experiment
from hidden.laboratory_rows import campaign
from hidden_truth import sheet

import vinetrack as vt
from vinetrack.diagnosis import candidates as hypotheses
from vinetrack.diagnosis.ladder import candidates_of
from vinetrack.diagnosis.misfit_tests import FALSE_ALARM_LEVEL_FIRST_ROUND, misfit_tests
from vinetrack.dynamics.simulate import Trajectory
from vinetrack.inference.sensitivity import position_change
from vinetrack.laboratory.tracks import BASE, GroundTruth, damping_values, grow

TIMES_S = np.arange(0.0, 0.3, 1e-3)
LENGTH_M = 0.4


def grown(speed_m_s: float) -> Trajectory:
    """A tube that grows evenly until its film runs out."""
    position_m = np.minimum(speed_m_s * TIMES_S, LENGTH_M)
    ended = bool(position_m[-1] >= LENGTH_M)
    return Trajectory(
        time_s=TIMES_S,
        lead_position_m=position_m,
        lead_velocity_m_s=np.where(position_m < LENGTH_M, speed_m_s, 0.0),
        lead_acceleration_m_s2=np.zeros(TIMES_S.size),
        observed_position_m=position_m,
        travel_ratio=0.5,
        status="ended" if ended else "running",
        end_time_s=LENGTH_M / speed_m_s if ended else float("nan"),
        end_lead_velocity_m_s=speed_m_s,
        n_steps=1,
    )


@pytest.mark.parametrize("step_m_s", [0.03, -0.03])
def test_the_sensitivity_is_zero_after_the_end_of_growth(step_m_s: float):
    plain = grown(2.0)
    change = position_change(plain, grown(2.0 + step_m_s)) / step_m_s
    growing = plain.time_s <= plain.end_time_s
    np.testing.assert_allclose(change[growing], TIMES_S[growing], atol=1e-12)
    np.testing.assert_array_equal(change[~growing], 0.0)


def test_a_force_that_acts_like_a_pressure_shows_only_in_the_scatter_of_trials():
    # A payload that rubs and a pressure that is lower move one trial in exactly the same way. The jump at the end of
    # growth, different for the two as their steps have different signs, once passed for knowledge of μ_p to 1e-4.
    bare = [trial for trial in sheet() if trial.vine == sheet()[0].vine]
    trials = [
        replace(trial, name=f"{trial.name}_{load:g}", payload_kg=load, growth_angle_rad=math.pi / 2)
        for trial in bare
        for load in (0.0, 0.03)
    ]
    nature = GroundTruth(
        effects=(*BASE, "payload_friction"),
        values={**damping_values(trials), "payload_friction.mu_p": 0.3},
        damping_scatter=2e-3,
        pressure_scatter=5e-3,
        noise_m=2e-5,
        noise_correlation=0.0,
        seed=20_411,
        frames_after_end=4,
    )
    fit = vt.fit(vt.base_model(), [(each.stated, each.track) for each in grow(trials, nature)], profile=False)
    candidates = candidates_of(fit.model, ["payload_friction"], None)
    questions = misfit_tests(fit, hypotheses.testable(candidates, fit.predictor.data)[0], FALSE_ALARM_LEVEL_FIRST_ROUND)
    size, sigma = (float(values[0]) for values in (questions.scores.size, questions.scores.plain_sigma))
    # μ_p m g acts like a fall of the pressure by 2 μ_p m g / A, and half of the trials have the payload.
    alike = [2 * 0.03 * 9.81 / (math.pi / 4 * trial.diameter_m**2 * trial.pressure_Pa) for trial in bare]
    by_scatter = 5e-3 * math.sqrt(4 / len(trials)) / float(np.mean(alike))
    assert 0.5 * by_scatter < sigma < 3 * by_scatter
    assert size == pytest.approx(0.3, abs=3 * sigma)


def test_a_fit_converges_to_the_same_values_from_other_starting_values(tmp_path: Path) -> None:
    """Frames around the end of growth bias the delay of a rolling shutter towards zero, and trial deviations
    compensate."""
    shot = campaign("rolling_shutter", 20122, (12, 16))
    write_experiment(shot, tmp_path / "laboratory")
    fit = vt.fit(vt.base_model() + "rolling_shutter", tmp_path / "laboratory", profile=False)
    (delay,) = (number for number in fit.numbers if number.key == "rolling_shutter.delay")
    for size in (-1e-3, 2e-3):
        again = vt.refit(fit, start={"rolling_shutter.delay": size})
        assert again.log_likelihood < fit.log_likelihood + 0.5
    truth = shot.truth["camera"]["row_delay_s_m"]  # type: ignore[index]
    assert abs(delay.value - truth) < 2.5 * delay.sigma
