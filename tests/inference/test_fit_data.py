"""What a fit is given: rounded positions, points of unequal noise, points beyond the end, no frame at rest."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from grown import grown, pairs_of
from hidden_truth import sheet
from lsoda_vine import N_TRUE, as_track, small_campaign
from vine_truth import Vine, record

import vinetrack as vt
from vinetrack.core.records import Trial
from vinetrack.diagnosis import score_test as hypotheses
from vinetrack.diagnosis.ladder import candidates_of
from vinetrack.diagnosis.misfit_tests import FALSE_ALARM_LEVEL_FIRST_ROUND, misfit_tests
from vinetrack.inference import trial_effects
from vinetrack.inference.fit_data import prepare
from vinetrack.inference.optimiser import FixedTerms, solve
from vinetrack.inference.trial_effects import products_at_releases, residuals_in, trial_costs
from vinetrack.inference.whitening import at_correlation, products, whiten

STEP_M = 2e-3


def rounded(seed: int, step_m: float = STEP_M):
    pairs, truth = small_campaign(seed)
    return [(t, replace(x, lead_position_m=np.round(x.lead_position_m / step_m) * step_m)) for t, x in pairs], truth


def test_a_rest_counts_as_one_point_where_rounding_hides_its_noise():
    data, _ = prepare(rounded(1)[0])
    assert len(data) > 12
    for each in data:
        assert each.n_rest == 0
        assert each.imprecise_rest.sigma_m == pytest.approx(STEP_M / np.sqrt(12))
        assert each.noise_m >= 0.999 * STEP_M / np.sqrt(12)
    assert all(each.n_rest > 5 and each.imprecise_rest is None for each in prepare(rounded(1, 1e-5)[0])[0])


def test_where_the_lens_is_unknown_smooth_errors_are_a_part_of_the_longest_travel():
    pairs, _ = small_campaign(1)
    longest_m = max(np.ptp(track.lead_position_m) for _, track in pairs)
    stated = [(replace(pairs[0][0], position_systematic_m=2.5e-4), pairs[0][1]), *pairs[1:]]
    first, *others = prepare(stated)[0]
    assert first.position_systematic_m == 2.5e-4
    assert [each.position_systematic_m for each in others] == pytest.approx([4e-4 * longest_m] * len(others))


@pytest.mark.slow
def test_origins_of_rounded_tracks_have_the_stated_errors():
    """Taken for independent values, twenty equal ones at rest gave origins that were off by five standard errors."""
    errors = []
    for seed in (2, 3):
        pairs, truth = rounded(seed)
        fit = vt.fit(vt.base_model(), pairs, profile=False)
        known = {trial.name: each for (trial, _), each in zip(pairs, truth, strict=True)}
        errors += [(t.origin_m - known[t.name]["origin_m"]) / t.origin_sigma_m for t in fit.trials]
        assert abs(fit["n"].value - N_TRUE) < 3 * fit["n"].sigma
    assert 0.5 < np.sqrt(np.mean(np.square(errors))) < 1.6


def test_weighted_products_are_those_of_columns_divided_by_their_noise():
    draw = np.random.default_rng(20000)
    first = np.isin(np.arange(60), [0, 25])
    columns, relative_sd = draw.standard_normal((60, 3)), np.exp(draw.uniform(-1, 1, 60))
    weighted, white = products(columns, first, relative_sd), whiten(columns, first, 0.4, relative_sd)
    np.testing.assert_array_equal(weighted, products(columns / relative_sd[:, None], first))
    np.testing.assert_allclose(at_correlation(weighted[None], 0.4)[0], white.T @ white, rtol=1e-12)


def test_trials_are_weighted_where_noise_grows_with_speed():
    """Sixteen fast vines filmed with 0.06 mm of noise and a blur of as many µs."""
    pairs, true_sd, vine = [], [], Vine(2, 10.0)
    known = {"diameter_m": vine.diameter_m, "thickness_m": 1e-4, "pressure_Pa": 3e4, "yield_pressure_Pa": 1e3}
    for i in range(16):
        draw = np.random.default_rng(20100 + i)
        made = record(vine, draw, noise_m=6e-5)
        blurred = 6e-5 * made.lead_velocity_m_s
        positions = made.track.lead_position_m + blurred * draw.standard_normal(blurred.size)
        pairs.append((Trial(name=f"t{i}", **known), replace(made.track, lead_position_m=positions)))
        true_sd.append(np.hypot(6e-5, blurred))
    data, left_out = prepare(pairs)
    assert not left_out
    for item, true in zip(data, true_sd, strict=True):
        assert np.mean(np.log(item.relative_sd)) == pytest.approx(0.0, abs=1e-12)
        # Thirty moving frames a trial, differences as good as 185 points in all: 5 % is its standard error.
        assert item.blur_s == pytest.approx(6e-5, rel=0.15)
        ratio = np.log(item.noise_m * item.relative_sd / true)
        assert np.sqrt(np.mean(ratio**2)) < 0.4
        assert item.mean_noise_m == pytest.approx(np.sqrt(np.mean(true**2)), rel=0.3)
    assert all(trial_data.relative_sd is None for trial_data in prepare(pairs, weighted=False)[0])


@pytest.mark.slow
def test_a_force_that_acts_like_a_pressure_shows_only_in_the_scatter_of_trials():
    # A payload that rubs and a pressure that is lower move one trial in exactly the same way. The jump at the end of
    # growth, different for the two as their steps have different signs, once passed for knowledge of μ_p to 1e-4.
    bare = [replace(trial, growth_angle_rad=math.pi / 2) for trial in sheet() if trial.vine == sheet()[0].vine]
    trials = [replace(t, name=f"{t.name}_{load:g}", payload_kg=load) for t in bare for load in (0.0, 0.03)]
    care = {"damping_scatter": 2e-3, "pressure_scatter": 5e-3, "noise_m": 2e-5, "frames_after_end": 4}
    virtual = grown(trials, 20_411, ["payload_friction"], {"payload_friction.mu_p": 0.3}, **care)
    fit = vt.fit(vt.base_model(), pairs_of(virtual), profile=False)
    candidates = candidates_of(fit.model, ["payload_friction"], None)
    questions = misfit_tests(fit, hypotheses.testable(candidates, fit.predictor.data)[0], FALSE_ALARM_LEVEL_FIRST_ROUND)
    size, sigma = (float(values[0]) for values in (questions.scores.size, questions.scores.plain_sigma))
    # μ_p m g acts like a fall of the pressure by 2 μ_p m g / A, and half of the trials have the payload.
    alike = [2 * 0.03 * 9.81 / (math.pi / 4 * trial.diameter_m**2 * trial.pressure_Pa) for trial in bare]
    by_scatter = 5e-3 * math.sqrt(4 / len(trials)) / float(np.mean(alike))
    assert 0.5 * by_scatter < sigma < 3 * by_scatter
    assert size == pytest.approx(0.3, abs=3 * sigma)


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
