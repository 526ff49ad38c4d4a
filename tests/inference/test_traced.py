"""Trials whose pressure was recorded by a gauge with noise: what the noise leaves wrong is no missing physics."""

from __future__ import annotations

import numpy as np
import pytest
from lsoda_vine import N_TRUE, as_track, small_campaign

import vinetrack as vt
from vinetrack.inference.fit_result import Fit

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


def test_the_gauge_is_believed_as_far_as_its_noise_lets_it(traced: Fit) -> None:
    for trial, item in zip(traced.trials, traced.predictor.data, strict=True):
        samples = np.count_nonzero(item.time_s >= trial.release_s)
        assert item.gauge_error == pytest.approx(GAUGE_NOISE_PA / np.sqrt(samples) / trial.trial.pressure_Pa, rel=0.4)
        assert abs(trial.pressure_deviation) < 4 * item.gauge_error
