"""Trials with a pressure recorded by a noisy gauge: the remaining error is not taken for missing physics."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from lsoda_vine import N_TRUE, as_track, small_campaign

import vinetrack as vt
from vinetrack.inference.fit_result import Fit
from vinetrack.inference.robust_covariance import systematics_of
from vinetrack.inference.sensitivity import PRESSURE, Predictor

GAUGE_NOISE_PA = 100.0


@pytest.fixture(scope="module")
def traced() -> Fit:
    """Sixteen trials; the gauge sees each pressure as it is, not as it was set, give or take 0.1 kPa a sample."""
    pairs, truth = small_campaign(seed=21)
    draw = np.random.default_rng(21)
    seen = []
    for (trial, track), true in zip(pairs, truth, strict=True):
        gauge_Pa = trial.pressure_Pa * true["pressure"] + GAUGE_NOISE_PA * draw.standard_normal(track.time_s.size)
        seen.append((trial, as_track(track.time_s, track.lead_position_m, gauge_Pa)))
    return vt.fit(vt.base_model(), seen, profile=False)


def test_the_tracks_are_explained_to_their_noise(traced: Fit) -> None:
    assert traced.chi2_per_dof < 1.15
    assert abs(traced["n"].value - N_TRUE) < 3 * traced["n"].sigma


def test_pressure_deviations_are_limited_by_the_noise_of_the_gauge(traced: Fit) -> None:
    for trial, item in zip(traced.trials, traced.predictor.data, strict=True):
        samples = np.count_nonzero(item.time_s >= trial.release_s)
        assert item.gauge_error == pytest.approx(GAUGE_NOISE_PA / np.sqrt(samples) / trial.trial.pressure_Pa, rel=0.4)
        assert abs(trial.pressure_deviation) < 4 * item.gauge_error


def test_an_error_of_a_recorded_pressure_affects_its_own_trial_alone(traced: Fit) -> None:
    """The tip of a light vine follows the pressure at once: what a ramp adds is the integral of what a step adds."""
    predictor = traced.predictor
    trace = predictor.data[3].trace
    assert trace is not None
    ramp = np.linspace(-100.0, 100.0, trace[0].size)
    data = [replace(trial_data, trace_errors_Pa=None, trace_error_sizes=None) for trial_data in predictor.data]
    data[3] = replace(data[3], trace_errors_Pa=ramp[:, None])
    errors = systematics_of(Predictor(predictor.layout, data, predictor.host), traced.solution, traced.trials)
    without = systematics_of(
        Predictor(
            predictor.layout,
            [replace(data[3], trace_errors_Pa=None) if i == 3 else each for i, each in enumerate(data)],
            predictor.host,
        ),
        traced.solution,
        traced.trials,
    )
    assert errors.count == without.count + 1
    moved = [columns[:, :1] for columns in errors.columns]
    assert all(not columns.any() for i, columns in enumerate(moved) if i != 3)
    part = np.interp(data[3].time_s, trace[0], ramp) / np.interp(data[3].time_s, *trace)
    expected = np.cumsum(np.diff(traced.solution.columns[3][:, PRESSURE], prepend=0.0) * part)
    assert moved[3][:, 0] == pytest.approx(expected, abs=0.05 * np.ptp(expected))
