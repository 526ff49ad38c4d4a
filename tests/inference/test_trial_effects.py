"""Trials recorded only in motion: their release has several likelihood maxima, and the highest is found."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from lsoda_vine import N_TRUE, as_track, small_campaign

import vinetrack as vt
from vinetrack.inference import trial_effects
from vinetrack.inference.assemble import _with_smooth_errors_removed, log_likelihood
from vinetrack.inference.fit import fit
from vinetrack.inference.fit_result import Fit
from vinetrack.inference.mixed_effects import FitState
from vinetrack.inference.optimiser import FixedTerms, _stagnates, solve
from vinetrack.inference.position_errors import SmoothErrors
from vinetrack.inference.trial_effects import (
    LARGEST_DEVIATION,
    optimise_trial_effects,
    products_at_releases,
    residuals_in,
    trial_costs,
)
from vinetrack.inference.whitening import products, whiten


@pytest.fixture(scope="module")
def only_in_motion() -> Fit:
    """Eight trials, grown by scipy and let go 10 ms before the first frame that is kept."""
    pairs, _ = small_campaign(seed=7, replicates=1)
    seen = [track.time_s > 0.03 for _, track in pairs]
    cut = [
        (trial, as_track(track.time_s[keep], track.lead_position_m[keep]))
        for (trial, track), keep in zip(pairs, seen, strict=True)
    ]
    return fit(vt.base_model(), cut)


def test_parameters_are_estimated_without_a_frame_at_rest(only_in_motion: Fit) -> None:
    assert only_in_motion.converged
    assert abs(only_in_motion["n"].value - N_TRUE) < 3 * only_in_motion["n"].sigma
    assert only_in_motion["n"].sigma < 0.02


@pytest.mark.parametrize("early_frames", [5, 20, 45])
def test_the_same_likelihood_is_reached_from_any_initial_release(only_in_motion: Fit, early_frames: int) -> None:
    solution, predictor = only_in_motion.solution, only_in_motion.predictor
    own = solution.state.trial_effects.copy()
    own[:, 0] = [item.time_s[0] - early_frames * item.frame_s for item in predictor.data]
    elsewhere = solve(predictor, solution.problem, replace(solution.state, trial_effects=own), FixedTerms(), warm=True)
    found = vt.refit(replace(only_in_motion, solution=elsewhere))
    assert log_likelihood(found.solution) == pytest.approx(log_likelihood(solution), abs=0.5)
    assert np.isfinite(found["n"].sigma)


@pytest.fixture(scope="module")
def gauged_in_motion() -> Fit:
    """The same with a gauge on each chamber, whose pressures stand still."""
    pairs, truth = small_campaign(seed=7, replicates=1)
    gauged = []
    for (trial, track), true in zip(pairs, truth, strict=True):
        time_s, position_m = (values[track.time_s > 0.03] for values in (track.time_s, track.lead_position_m))
        gauged.append((trial, as_track(time_s, position_m, np.full(time_s.size, trial.pressure_Pa * true["pressure"]))))
    return fit(vt.base_model(), gauged, profile=False)


@pytest.mark.parametrize("early_frames", [5, 45])
def test_the_same_likelihood_is_reached_with_a_gauge_on_the_chamber(gauged_in_motion: Fit, early_frames: int) -> None:
    solution, predictor = gauged_in_motion.solution, gauged_in_motion.predictor
    assert all(trial_data.trace is not None and not trial_data.shows_rest for trial_data in predictor.data)
    away = solution.state.trial_effects.copy()
    away[2, 0] = predictor.data[2].time_s[0] - early_frames * predictor.data[2].frame_s
    begin = replace(solution.state, trial_effects=away)
    elsewhere = solve(predictor, solution.problem, begin, FixedTerms(), warm=True)
    # Each trial stays where another release would lower its −2 ln L by less than WORTH_MOVING.
    within = 0.5 * trial_effects.LEAST_DECREASE * len(predictor.data)
    assert log_likelihood(elsewhere) == pytest.approx(log_likelihood(solution), abs=within)


@pytest.mark.parametrize("rho", [0.0, 0.6])
def test_products_at_a_release_are_those_of_the_shifted_and_whitened_columns(rho: float) -> None:
    draw = np.random.default_rng(5)
    time_s, grid_s = np.linspace(0.0, 0.3, 41), 0.4 * np.linspace(0, 1, 60) ** 1.5
    curves, position_m, relative = draw.standard_normal((5, 60)), draw.standard_normal(41), draw.uniform(1, 3, 41)
    first = np.zeros(41, dtype=bool)
    first[[0, 17]] = True
    releases_s = np.array([-0.2, 0.0, 0.013, 0.25])
    products = products_at_releases(time_s, position_m, first, relative, releases_s, grid_s, curves, rho)
    for release_s, product in zip(releases_s, products, strict=True):
        columns = np.array([np.interp(np.maximum(time_s - release_s, 0.0), grid_s, curve) for curve in curves]).T
        columns[:, -1] = position_m - columns[:, -1]
        white = whiten(columns, first, rho, relative)
        assert np.allclose(product, white.T @ white, rtol=1e-12, atol=1e-12)


def test_a_release_that_returned_jumps_again_only_if_the_misfit_falls(
    only_in_motion: Fit, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Otherwise steps, which lower the misfit, and searches, which maximise the likelihood, cycle."""
    solution, predictor = only_in_motion.solution, only_in_motion.predictor
    columns = predictor.linearise(solution.state.theta, solution.state.trial_effects)
    there = solution.state.trial_effects.copy()
    there[:, 0] -= 0.004
    elsewhere, missed = replace(solution.state, trial_effects=there), [0.0]

    def level(_predictor: object, _problem: object, state: FitState, *_: object) -> np.ndarray:
        return np.full(len(there), -9.0 if state is elsewhere else 0.0)

    def cost(_predictor: object, _problem: object, state: FitState, *_: object) -> np.ndarray:
        return np.full(len(there), missed[0] if state is elsewhere else 0.0)

    monkeypatch.setattr(trial_effects, "_trial_deviances", level)
    monkeypatch.setattr(trial_effects, "trial_costs", cost)
    monkeypatch.setattr(trial_effects, "optimise_trial_effects", lambda *given: (given[-1], None))
    monkeypatch.setattr(trial_effects.ReleaseSearch, "_by_linear_model", lambda *_: elsewhere)
    search = trial_effects.ReleaseSearch(predictor, solution.problem)

    def looked(missed_there: float) -> object:
        missed[0] = missed_there
        return search.likelier(solution.state, residuals_in(columns))

    assert looked(+4.0) is not None
    # The next search finds the trials where they had been.
    assert looked(+4.0) is None
    assert search.returned.all()
    assert looked(-4.0) is not None


def test_a_jump_is_remembered_by_later_searches(only_in_motion: Fit, monkeypatch: pytest.MonkeyPatch) -> None:
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


@pytest.mark.parametrize(
    ("levels", "ends"),
    [
        ([100.0, 50.0, 49.0, 48.5, 48.2, 48.1], False),
        ([100.0, 50.0, 49.9, 49.8, 49.7, 49.6], True),
        ([50.0, 49.9, 49.8, 49.7, 60.0], False),
        ([50.0, 49.9, 49.8, 49.7], False),
    ],
    ids=["it still falls", "it creeps", "a jump has just raised it", "too few steps"],
)
def test_a_stagnating_fit_may_end(levels: list[float], *, ends: bool) -> None:
    assert _stagnates(levels, 1.0) == ends


def test_residuals_of_several_sets_are_those_of_each(only_in_motion: Fit) -> None:
    solution, predictor = only_in_motion.solution, only_in_motion.predictor
    there = solution.state.trial_effects.copy()
    there[:, 0] -= 0.004
    ways = [solution.state.trial_effects, there]
    together = predictor.residuals_of_each(solution.state.theta, ways)
    for way, left_m in zip(ways, together, strict=True):
        alone = predictor.residuals(solution.state.theta, way)
        assert all(np.array_equal(a, b) for a, b in zip(left_m, alone, strict=True))


def test_a_step_is_rejected_without_simulation_if_the_linear_model_predicts_no_decrease(only_in_motion: Fit) -> None:
    solution, predictor = only_in_motion.solution, only_in_motion.predictor
    off = solution.state.trial_effects.copy()
    off[:, 1] += 1e-3
    state = replace(solution.state, trial_effects=off)
    better, costs = optimise_trial_effects(predictor, solution.problem, state)
    best = float(np.sum(trial_costs(predictor, solution.problem, solution.state)))
    assert float(np.sum(costs)) < best + 1.0
    kept, _ = optimise_trial_effects(predictor, solution.problem, state, 0.5 * best)
    assert kept is state
    followed, _ = optimise_trial_effects(predictor, solution.problem, state, 1.1 * best)
    assert np.array_equal(followed.trial_effects, better.trial_effects)


def test_a_release_search_leaves_the_other_trials_unchanged(only_in_motion: Fit) -> None:
    solution, predictor = only_in_motion.solution, only_in_motion.predictor
    off = solution.state.trial_effects.copy()
    off[[2, 5], 0] -= 0.02
    off[:, 1] += 2e-4
    state = replace(solution.state, trial_effects=off)
    tried = off.copy()
    tried[[2, 5]] = solution.state.trial_effects[[2, 5]]
    search = trial_effects.ReleaseSearch(predictor, solution.problem)
    kept = search._confirmed(state, replace(state, trial_effects=tried)).trial_effects
    others = np.delete(np.arange(len(off)), [2, 5])
    assert np.array_equal(kept[others], off[others])
    assert np.allclose(kept[[2, 5], 0], solution.state.trial_effects[[2, 5], 0], atol=1e-4)


def test_a_fit_ends_if_the_remaining_steps_cannot_reach_the_target(only_in_motion: Fit) -> None:
    solution, predictor = only_in_motion.solution, only_in_motion.predictor
    theta = solution.state.theta.copy()
    theta[0] += 0.3
    start = replace(solution.state, theta=theta)
    led = solve(predictor, solution.problem, start, FixedTerms(), warm=True, shortfall=lambda *_: 0.0)
    assert led.converged
    assert log_likelihood(led) == pytest.approx(log_likelihood(solution), abs=0.5)
    given_up = solve(predictor, solution.problem, start, FixedTerms(), warm=True, shortfall=lambda *_: math.inf)
    assert not given_up.converged
    assert given_up.iterations < led.iterations


def test_a_search_converges_if_the_model_is_close_to_the_tracks(only_in_motion: Fit) -> None:
    solution, predictor = only_in_motion.solution, only_in_motion.predictor
    found = solve(predictor, solution.problem, solution.state, FixedTerms(), least_decrease=1e-4, search=True)
    assert found.converged


def test_unbounded_linear_deviations_are_reported_within_their_limit(
    only_in_motion: Fit,
) -> None:
    fitted = only_in_motion
    effects = np.zeros_like(fitted.solution.state.trial_effects)
    effects[0], effects[1] = 2000.0, -2000.0
    there = replace(fitted.solution, state=replace(fitted.solution.state, trial_effects=effects))
    smooth = SmoothErrors(there, 0.0, tuple(trial.whitened for trial in fitted.trials), ())
    high, low, *others = _with_smooth_errors_removed(fitted.trials, smooth)
    assert high.damping_deviation == pytest.approx(math.expm1(LARGEST_DEVIATION))
    assert low.damping_deviation == pytest.approx(math.expm1(-LARGEST_DEVIATION))
    assert (high.pressure_deviation, low.pressure_deviation) == (LARGEST_DEVIATION, -LARGEST_DEVIATION)
    assert {trial.damping_deviation for trial in others} == {0.0}


def test_an_overflowing_trajectory_has_infinite_cost_without_a_warning(only_in_motion: Fit) -> None:
    solution, predictor = only_in_motion.solution, only_in_motion.predictor
    far = [np.full(trial.time_s.size, 1e200) for trial in predictor.data]
    assert not np.isfinite(trial_costs(predictor, solution.problem, solution.state, far)).any()
    assert not np.isfinite(products(np.full((5, 2), 1e200), np.arange(5) == 0)).all()
