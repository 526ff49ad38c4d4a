"""Steps of the fit, compared with exact minima within bounds."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from mixed_problem import RHO, columns_of, frame_of, state_of
from scipy.optimize import lsq_linear

from vinetrack.inference.marginal_likelihood import bounded_solve, levenberg_marquardt_step
from vinetrack.inference.mixed_effects import MixedProblem, decrease_within_bounds
from vinetrack.inference.optimiser import CONVERGED_DECREASE, _next_step
from vinetrack.inference.whitening import all_products, whiten


@pytest.mark.parametrize("seed", range(20))
def test_the_compiled_decrease_agrees_with_the_bounded_step(seed: int) -> None:
    draw, size = np.random.default_rng(seed), 6
    rows = draw.standard_normal((30, size)) * [1, 10, 0.1, 1e3, 1, 1]
    square, slope = rows.T @ rows, rows.T @ draw.standard_normal(30)
    reach = np.abs(np.linalg.solve(square, slope))
    theta = draw.uniform(-1, 1, size) * reach
    held = np.arange(size) == (seed % 9)
    problem = replace(frame_of(1, 5, size), lower=-1.1 * reach, upper=1.3 * reach, free=~held)
    step, moving = bounded_solve(square, slope, problem, theta)
    solved, decrease, log_det = decrease_within_bounds(
        square, slope, theta - problem.lower, problem.upper - theta, problem.free
    )
    k = np.flatnonzero(moving)
    assert solved
    assert decrease == pytest.approx(step @ (2 * slope - square @ step))
    assert log_det == pytest.approx(np.linalg.slogdet(square[np.ix_(k, k)])[1])


def test_a_step_ends_at_the_first_bound_and_continues_along_it() -> None:
    # ½xᵀHx − gᵀx in the unit square: its minimum (14/3, 7/3) lies outside; on the side x₁ = 1 it is at x₂ = ½.
    square, slope = np.array([[2.0, -1.0], [-1.0, 2.0]]), np.array([7.0, 0.0])
    problem = replace(frame_of(1, 5, 2), lower=np.zeros(2), upper=np.ones(2))
    step, moving = bounded_solve(square, slope, problem, np.zeros(2))
    assert step == pytest.approx([1.0, 0.5])
    assert list(moving) == [False, True]


def test_of_two_parameters_that_met_their_bounds_together_one_is_released() -> None:
    # ½xᵀHx − gᵀx for x ≥ 0, from the corner: its minimum (−1, −2) lies outside; on the side x₂ = 0 it is at 0.8.
    square, slope = np.array([[1.0, -0.9], [-0.9, 1.0]]), np.array([0.8, -1.1])
    problem = replace(frame_of(1, 5, 2), lower=np.zeros(2))
    step, moving = bounded_solve(square, slope, problem, np.zeros(2))
    assert step == pytest.approx([0.8, 0.0])
    assert list(moving) == [True, False]
    solved, decrease, log_det = decrease_within_bounds(square, slope, np.zeros(2), np.full(2, np.inf), np.ones(2, bool))
    assert (solved, decrease, log_det) == (True, pytest.approx(0.64), pytest.approx(0.0))


@pytest.mark.parametrize("seed", range(40))
def test_a_bounded_step_ends_at_the_minimum_in_the_box(seed: int) -> None:
    draw = np.random.default_rng(seed)
    columns = draw.standard_normal((12, 6)) + 2 * draw.standard_normal((12, 1))
    square, slope, free = columns.T @ columns, columns.T @ draw.standard_normal(12) * 10, np.ones(6, bool)
    free[seed % 6] = False
    # At their bounds from the start, near them, and free of them.
    theta = np.clip(draw.uniform(-2, 3, 6), -1, 2)
    problem = replace(frame_of(1, 5, 6), lower=np.full(6, -1.0), upper=np.full(6, 2.0), free=free)
    step, _ = bounded_solve(square, slope, problem, theta)
    target = np.linalg.lstsq(columns.T, slope, rcond=None)[0]
    exact = lsq_linear(columns[:, free], target, (-1 - theta[free], 2 - theta[free]), tol=1e-14, method="bvls").x
    best = exact @ (2 * slope[free] - square[np.ix_(free, free)] @ exact)
    assert step[~free] == 0
    assert step @ (2 * slope - square @ step) == pytest.approx(best, rel=1e-6, abs=1e-5)
    solved, decrease, _ = decrease_within_bounds(square, slope, theta + 1, 2 - theta, free)
    assert solved
    assert decrease == pytest.approx(best, rel=1e-6, abs=1e-5)


@pytest.mark.parametrize("damping", [0.0, 0.1, 100.0])
@pytest.mark.parametrize("bound", [np.inf, 0.02])
def test_a_step_predicts_the_decrease_of_the_undamped_sum_of_squares(damping: float, bound: float) -> None:
    n_trials, count, keys = 4, 20, 2
    columns = columns_of(n_trials, count, keys, seed=8)
    for each in columns:
        each[:, -1] += each[:, 5]
    frame = replace(frame_of(n_trials, count, keys), lower=np.full(keys, -bound), upper=np.full(keys, bound))
    state = state_of(n_trials, keys, 0.5)
    starts = np.arange(count) == 0
    step, own, predicted = levenberg_marquardt_step(all_products(columns, [starts] * n_trials), frame, state, damping)

    def cost(theta: np.ndarray, effects: np.ndarray) -> float:
        left = [c[:, -1] - c[:, 4:6] @ theta - c[:, :4] @ u for c, u in zip(columns, effects, strict=True)]
        white = [whiten(residual, starts, RHO) for residual in left]
        prior = np.array([1e-3, 1e-3, 1e5, 2.0]) ** 2
        return sum(float(w @ w) for w in white) / float(state.variance[0]) + float(np.sum(prior * effects**2))

    lowered = cost(np.zeros(keys), np.zeros((n_trials, 4))) - cost(step, own)
    assert predicted == pytest.approx(lowered, rel=1e-6)


def test_a_short_step_that_is_short_by_its_damping_alone_is_no_convergence() -> None:
    columns = columns_of(4, 20, 2, seed=8)
    for each in columns:
        each[:, -1] += each[:, 5]
    frame, state = frame_of(4, 20, 2), state_of(4, 2, 0.5)
    cross_products = all_products(columns, [np.arange(20) == 0] * 4)
    assert levenberg_marquardt_step(cross_products, frame, state, 1e6)[2] < CONVERGED_DECREASE
    (step, _, decrease), damping = _next_step(cross_products, frame, state, 1e6, CONVERGED_DECREASE)
    assert decrease > CONVERGED_DECREASE
    assert damping == 0
    assert step == pytest.approx(levenberg_marquardt_step(cross_products, frame, state, 0.0)[0])


@pytest.mark.parametrize("seed", range(40))
def test_a_bounded_step_lowers_the_sum_of_squares_even_for_nearly_collinear_parameters(seed: int) -> None:
    draw = np.random.default_rng(seed)
    columns = draw.standard_normal((50, 6))
    columns[:, 5] = columns[:, 4] * (1 + 1e-7 * draw.standard_normal(50))
    square, slope = columns.T @ columns, columns.T @ draw.standard_normal(50) * 30
    problem = replace(frame_of(1, 5, 6), lower=np.full(6, -1.0), upper=np.full(6, 2.0))
    theta = draw.uniform(-1, 2, 6)
    step, _ = bounded_solve(square, slope, problem, theta)
    assert np.all(theta + step >= problem.lower - 1e-12)
    assert np.all(theta + step <= problem.upper + 1e-12)
    assert step @ (2 * slope - square @ step) > 0
    # Held against the exact minimum in the box.
    exact = lsq_linear(columns, 1.0 * columns @ np.linalg.lstsq(square, slope, rcond=None)[0], (-1 - theta, 2 - theta))
    best = exact.x @ (2 * slope - square @ exact.x)
    assert step @ (2 * slope - square @ step) > (1 - 1e-6) * best


def test_one_step_solves_a_linear_problem() -> None:
    columns = columns_of(3, 25, 2, seed=8)
    truth = np.array([0.3, -0.7])
    for c in columns:
        c[:, -1] = c[:, 4:6] @ truth + 0.2 * c[:, 0] - 0.1
    frame, state = frame_of(3, 25, 2, flat_sd=1e6), state_of(3, 2, 1e-3, sigma=1e-3)
    step, own, predicted_decrease = levenberg_marquardt_step(
        all_products(columns, [np.arange(25) == 0] * 3), frame, state, 0.0
    )
    assert step == pytest.approx(truth, abs=1e-6)
    assert own[:, 0] == pytest.approx(0.2, abs=1e-6)
    assert predicted_decrease > 0


def test_a_parameter_at_its_bound_does_not_leave_it() -> None:
    columns = columns_of(3, 25, 2, seed=9)
    for c in columns:
        c[:, -1] = c[:, 4:6] @ np.array([0.3, -0.7])
    frame = frame_of(3, 25, 2)
    bounded = MixedProblem(**{**frame.__dict__, "lower": np.array([-np.inf, 0.0])})
    step, _, _ = levenberg_marquardt_step(
        all_products(columns, [np.arange(25) == 0] * 3), bounded, state_of(3, 2, 0.1), 0.0
    )
    assert step[1] == 0.0
    assert step[0] > 0
