"""A diagnosis leaves the fit of its caller as it was."""

from __future__ import annotations

import numpy as np
from hidden_truth import Pairs, sheet

import vinetrack as vt
from vinetrack.laboratory.tracks import BASE, GroundTruth, damping_values, grow


def campaign(seed: int) -> Pairs:
    trials = sheet()
    nature = GroundTruth(effects=BASE, values=damping_values(trials), damping_scatter=0.02, noise_m=5e-5, seed=seed)
    return [(grown.stated, grown.track) for grown in grow(trials, nature)]


def test_steps_and_values_of_a_fit_stay_through_its_diagnosis() -> None:
    fit = vt.fit(vt.base_model(), campaign(5), profile=False)
    steps, pressure_step = fit.predictor.steps.copy(), fit.predictor.pressure_step.copy()
    theta = fit.solution.state.theta.copy()
    diagnosis = vt.diagnose(fit, candidates=["leak", "air_drag"], ladder=False, advice=False)
    assert not np.shares_memory(diagnosis.fits[0].predictor.steps, fit.predictor.steps)
    assert not np.shares_memory(diagnosis.fits[0].predictor.pressure_step, fit.predictor.pressure_step)
    np.testing.assert_array_equal(fit.predictor.steps, steps)
    np.testing.assert_array_equal(fit.predictor.pressure_step, pressure_step)
    np.testing.assert_array_equal(fit.solution.state.theta, theta)
