"""Trials recorded only in motion: their release has several likelihood maxima, and the highest is found."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from lsoda_vine import N_TRUE, as_track, small_campaign

import vinetrack as vt
from vinetrack.inference import trial_effects
from vinetrack.inference.optimiser import FixedTerms, solve
from vinetrack.inference.trial_effects import products_at_releases, residuals_in, trial_costs
from vinetrack.inference.whitening import products, whiten


@pytest.fixture(scope="module")
def only_in_motion():
    """Eight trials, grown by scipy and let go 10 ms before the first frame that is kept."""
    pairs = [(trial, track, track.time_s > 0.03) for trial, track in small_campaign(seed=7, replicates=1)[0]]
    return vt.fit(vt.base_model(), [(t, as_track(x.time_s[seen], x.lead_position_m[seen])) for t, x, seen in pairs])


def test_parameters_are_estimated_without_a_frame_at_rest(only_in_motion):
    assert only_in_motion.converged
    assert abs(only_in_motion["n"].value - N_TRUE) < 3 * only_in_motion["n"].sigma
    assert only_in_motion["n"].sigma < 0.02


@pytest.mark.slow
@pytest.mark.parametrize("early_frames", [5, 20, 45])
def test_the_same_likelihood_is_reached_from_any_initial_release(only_in_motion, early_frames):
    solution, predictor = only_in_motion.solution, only_in_motion.predictor
    own = solution.state.trial_effects.copy()
    own[:, 0] = [item.time_s[0] - early_frames * item.frame_s for item in predictor.data]
    elsewhere = solve(predictor, solution.problem, replace(solution.state, trial_effects=own), FixedTerms(), warm=True)
    found = vt.refit(replace(only_in_motion, solution=elsewhere))
    assert found.solution.log_likelihood() == pytest.approx(solution.log_likelihood(), abs=0.5)
    assert np.isfinite(found["n"].sigma)


@pytest.mark.parametrize("rho", [0.0, 0.6])
def test_products_at_a_release_are_those_of_the_shifted_and_whitened_columns(rho):
    draw = np.random.default_rng(5)
    time_s, grid_s = np.linspace(0.0, 0.3, 41), 0.4 * np.linspace(0, 1, 60) ** 1.5
    curves, position_m, relative = draw.standard_normal((5, 60)), draw.standard_normal(41), draw.uniform(1, 3, 41)
    first, releases_s = np.isin(np.arange(41), [0, 17]), np.array([-0.2, 0.0, 0.013, 0.25])
    products = products_at_releases(time_s, position_m, first, relative, releases_s, grid_s, curves, rho)
    for release_s, product in zip(releases_s, products, strict=True):
        columns = np.array([np.interp(np.maximum(time_s - release_s, 0.0), grid_s, curve) for curve in curves]).T
        columns[:, -1] = position_m - columns[:, -1]
        white = whiten(columns, first, rho, relative)
        assert np.allclose(product, white.T @ white, rtol=1e-12, atol=1e-12)


def test_a_jump_is_remembered_by_later_searches(only_in_motion, monkeypatch):
    """A search one step later forgot the jump: 3 of 400 trials cycled eight times, in 40 steps of all trials."""
    solution, predictor = only_in_motion.solution, only_in_motion.predictor
    residuals = residuals_in(predictor.linearise(solution.state.theta, solution.state.trial_effects))
    there = solution.state.trial_effects.copy()
    there[:, 0] -= 0.004
    elsewhere = replace(solution.state, trial_effects=there)
    monkeypatch.setattr(trial_effects.ReleaseSearch, "_confirmed", lambda *given: given[-1])
    search = trial_effects.ReleaseSearch(predictor, solution.problem)
    for begins, likelier in ((solution.state, elsewhere), (elsewhere, None), (solution.state, None)):
        monkeypatch.setattr(trial_effects.ReleaseSearch, "_by_linear_model", lambda *_, at=likelier: at)
        search.likelier(begins, residuals)
    assert search.returned.all()


def test_a_fit_ends_if_the_remaining_steps_cannot_reach_the_target(only_in_motion):
    solution, predictor = only_in_motion.solution, only_in_motion.predictor
    start = replace(solution.state, theta=solution.state.theta + 0.3 * (np.arange(solution.state.theta.size) == 0))
    led = solve(predictor, solution.problem, start, FixedTerms(), warm=True, goal=solution.log_likelihood() - 1)
    assert led.converged
    assert led.log_likelihood() == pytest.approx(solution.log_likelihood(), abs=0.5)
    given_up = solve(predictor, solution.problem, start, FixedTerms(), warm=True, goal=1e9)
    assert not given_up.converged
    assert given_up.iterations < led.iterations


def test_a_search_converges_if_the_model_is_close_to_the_tracks(only_in_motion):
    """And one whose trajectories overflow costs infinitely much, without a warning."""
    solution, predictor = only_in_motion.solution, only_in_motion.predictor
    found = solve(predictor, solution.problem, solution.state, FixedTerms(), least_decrease=1e-4, search=True)
    assert found.converged
    far = [np.full(trial.time_s.size, 1e200) for trial in predictor.data]
    assert not np.isfinite(trial_costs(predictor, solution.problem, solution.state, far)).any()
    assert not np.isfinite(products(np.full((5, 2), 1e200), np.arange(5) == 0)).all()
