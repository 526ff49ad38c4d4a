"""The statistics of the fit and its steps, compared with dense matrices, textbook results and exact minima."""

import math
from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
from scipy.linalg import block_diag, toeplitz
from scipy.optimize import lsq_linear
from scipy.stats import multivariate_normal

from vinetrack.inference import marginal_likelihood as marginal
from vinetrack.inference.errors import precision
from vinetrack.inference.gaussian_processes import at_correlation, products, whiten
from vinetrack.inference.marginal_likelihood import Linearised

RHO, SIGMA = 0.45, 0.3


def covariance(count: int, rho: float, sigma: float) -> np.ndarray:
    return np.asarray(sigma**2 * toeplitz(rho ** np.arange(count)))


def given(n_trials: int, count: int, keys: int, spread=1e-5, *, rho=RHO, sigma=SIGMA, **more):
    """A problem whose releases and origins are free, only B deviates and nothing has bounds or priors; its state."""
    own = {"has_deviation": np.tile([False, True], (n_trials, 1)), "gauge_error": np.zeros(n_trials)}
    own |= {"index": np.tile(np.arange(keys), (n_trials, 1)), "release_origin_mean": np.zeros((n_trials, 2))}
    own |= {
        "points": np.full(n_trials, float(count)),
        "stretches": np.ones(n_trials),
        "release_reach_s": np.full(n_trials, np.inf),
        "least_variance": np.zeros(n_trials),
    }
    own |= {"release_origin_precision": np.full((n_trials, 2), 1e-6)}
    shared = {name: np.zeros(keys) for name in ("prior_mean", "prior_precision")} | {"free": np.ones(keys, bool)}
    shared |= {"lower": np.full(keys, -np.inf), "upper": np.full(keys, np.inf), "random": np.zeros(keys, bool)}
    variance = np.full(n_trials, sigma**2 * (1 - rho**2))
    state = marginal.FitState(np.zeros(keys), np.zeros((n_trials, 4)), (1e-5, spread), rho, variance)
    return marginal.MixedProblem(**(own | shared | more)), state


def columns_of(n_trials: int, count: int, keys: int, seed: int) -> list[np.ndarray]:
    """Random columns; the pressure deviation is silent, the deviation of B moves what the first key moves."""
    draw, out = np.random.default_rng(seed), []
    for _ in range(n_trials):
        shared = draw.standard_normal((count, keys))
        own = np.column_stack([draw.standard_normal(count), np.ones(count), np.zeros(count), shared[:, 0]])
        out.append(np.column_stack([own, shared, draw.standard_normal(count)]))
    return out


def crossed(columns: list[np.ndarray]) -> np.ndarray:
    return np.stack([products(each, np.arange(len(each)) == 0) for each in columns])


def test_cross_products_agree_with_the_dense_inverse_covariance():
    columns, first = np.random.default_rng(0).standard_normal((30, 4)), np.isin(np.arange(30), [0, 17])
    noise = np.linspace(0.5, 2.0, 30)
    white = at_correlation(products(columns * noise[:, None], first, noise)[None], RHO)[0]
    dense = block_diag(covariance(17, RHO, 1.0), covariance(13, RHO, 1.0))
    assert white / (1 - RHO**2) == pytest.approx(columns.T @ np.linalg.solve(dense, columns))


@pytest.mark.parametrize(("flat_sd", "moved"), [(50.0, 0.0), (0.5, 2.0)])
def test_the_marginal_likelihood_agrees_with_the_dense_gaussian(flat_sd, moved):
    """Also where the data have moved release and origin far from their priors."""
    n_trials, count, keys, spread = 3, 12, 2, 0.7
    columns = columns_of(n_trials, count, keys, seed=2)
    effects = np.tile([moved, -moved, 0.0, 0.0], (n_trials, 1))
    frame, state = given(n_trials, count, keys, spread, release_origin_precision=np.full((n_trials, 2), flat_sd**-2))
    state = replace(state, trial_effects=effects)
    found = Linearised(frame, state, crossed(columns)).deviances(np.array([state.spread]), restricted=False)
    # The same by brute force: shared numbers by least squares, then the density of what is left.
    noise = covariance(count, RHO, SIGMA)
    for c in columns:
        c[:, 6] += c[:, :2] @ effects[0, :2]
    dense = [noise + flat_sd**2 * c[:, :2] @ c[:, :2].T + spread**2 * np.outer(c[:, 3], c[:, 3]) for c in columns]
    square = sum(c[:, 4:6].T @ np.linalg.solve(v, c[:, 4:6]) for c, v in zip(columns, dense, strict=True))
    slope = sum(c[:, 4:6].T @ np.linalg.solve(v, c[:, 6]) for c, v in zip(columns, dense, strict=True))
    best = np.linalg.solve(square, slope)
    left = [(c[:, 6] - c[:, 4:6] @ best, v) for c, v in zip(columns, dense, strict=True)]
    direct = -2 * sum(multivariate_normal(np.zeros(count), v).logpdf(residual) for residual, v in left)
    assert found == pytest.approx([direct], rel=1e-8)


def test_residuals_at_zero_deviations_are_restored():
    columns = columns_of(3, 15, 2, seed=8)
    frame, state = given(3, 15, 2, 0.5, release_origin_precision=np.zeros((3, 2)))
    state = replace(state, trial_effects=np.random.default_rng(9).standard_normal((3, 4)))
    whole = [c.copy() for c in columns]
    for column, effects in zip(whole, state.trial_effects, strict=True):
        column[:, -1] += column[:, 2:4] @ effects[2:]
    white = at_correlation(crossed(columns), RHO)
    restored = marginal.at_prior_means(white, frame, state)
    assert restored == pytest.approx(at_correlation(crossed(whole), RHO), rel=1e-9)


def test_nearly_collinear_deviations_are_integrated_out_of_precise_positions():
    """Squares of 1e12 times the noise, of which that of the noise is left: held against exact fractions."""
    k = np.arange(100)
    pressure = 20_000 * k
    damping = 2 * pressure + 40 * (k % 7) + k**2 // 9
    key, residual = 3 * damping + 5 * k, damping // 15 - 7 * k + k % 3
    columns = np.column_stack([pressure, damping, key, residual])
    block = [[Fraction(int(a @ b)) for b in columns.T] for a in columns.T]
    roots = (Fraction(1, 25), Fraction(3, 50))
    whole = [[value * (roots[i] if i < 2 else 1) * (roots[j] if j < 2 else 1) for j, value in enumerate(row)]
             for i, row in enumerate(block)]  # fmt: skip
    determinant = Fraction(1)
    for i in range(2):
        whole[i][i] += 1
    for i in range(2):
        pivot = whole[i]
        determinant *= pivot[i]
        for j in range(i + 1, 4):
            part = whole[j][i] / pivot[i]
            whole[j] = [a - part * b for a, b in zip(whole[j], pivot, strict=True)]
    left, log_det = marginal.without_deviations(np.array(block, dtype=float)[None], np.array([roots], dtype=float))
    exact = np.array([[float(value) for value in row[2:]] for row in whole[2:]])
    assert np.triu(left[0]) == pytest.approx(np.triu(exact), rel=1e-3)
    assert log_det == pytest.approx(math.log(determinant), rel=1e-9)


def test_the_restricted_likelihood_adds_the_information():
    columns = columns_of(4, 20, 2, seed=3)
    frame, state = given(4, 20, 2, 0.5)
    at, spreads = Linearised(frame, state, crossed(columns)), np.array([state.spread])
    restricted, plain = (at.deviances(spreads, restricted=how)[0] for how in (True, False))
    known = precision(at)
    assert restricted - plain == pytest.approx(-np.linalg.slogdet(known.covariance)[1], rel=1e-8)


def test_the_variance_of_a_one_way_layout_is_that_of_the_analysis_of_variance_with_one_degree_of_freedom_less():
    """σ^−ν exp(−νs²/2σ²) times σ has its maximum at s² ν/(ν − 1). So has the error of the common level."""
    n_trials, count, draw = 12, 25, np.random.default_rng(4)
    levels = 2.0 + 0.05 * draw.standard_normal(n_trials)
    own = np.tile([0.0, 0.0, 0.0, 1.0, 1.0], (count, 1))
    columns = [np.column_stack([own, level + 0.01 * draw.standard_normal(count)]) for level in levels]
    means = np.array([c[:, -1].mean() for c in columns])
    frame, state = given(n_trials, count, 1, 0.3, rho=0.0, sigma=0.01)
    at = Linearised(frame, state, crossed(columns), estimable=(False, True))
    found = at.likeliest_spread()
    solution = at.with_state(spread=found)
    assert found[1] == pytest.approx(math.sqrt(means.var(ddof=2) - 0.01**2 / 25), rel=2e-3)
    assert math.sqrt(precision(solution).covariance[0, 0]) == pytest.approx(means.std(ddof=2) / math.sqrt(12), rel=2e-3)


def test_a_standard_deviation_between_trials_that_looks_like_none_is_within_its_error_of_none():
    """Levels that scatter by their noise alone: the likelihood ends at 0, and σ would be known without an error."""
    n_trials, count, draw = 12, 25, np.random.default_rng(4)
    own = np.tile([0.0, 0.0, 0.0, 1.0, 1.0], (count, 1))
    columns = [np.column_stack([own, 2.0 + 0.01 * draw.standard_normal(count)]) for _ in range(n_trials)]
    frame, state = given(n_trials, count, 1, 0.3, rho=0.0, sigma=0.01)
    at = Linearised(frame, state, crossed(columns), estimable=(False, True))
    found = at.likeliest_spread()[1]
    at_it, at_none = at.deviances(np.array([[1e-5, found], [1e-5, 1e-5]]))
    assert 0.2 < at_it - at_none < 1
    assert found > 1e-4


@pytest.mark.parametrize("start", [(0.04, 1e-3), (0.04, 0.1), (1e-3, 0.1), (1e-5, 1e-5)])
def test_two_between_trial_standard_deviations_are_found_from_any_start(start):
    # Pressure and B move a trial alike but for a tenth, so that one can stand for the other.
    n_trials, count, draw = 24, 40, np.random.default_rng(31)
    slope, bend = np.linspace(0, 1, count), np.linspace(-1, 1, count) ** 2
    columns = []
    for deviations in draw.standard_normal((n_trials, 2)) * (0.004, 0.02):
        own = np.column_stack([0 * slope, 0 * slope, slope + 0.1 * bend, -0.4 * slope])
        seen = own[:, 2:] @ deviations + 1e-4 * draw.standard_normal(count)
        columns.append(np.column_stack([own, slope, seen]))
    frame, state = given(n_trials, count, 1, rho=0.0, sigma=1e-4, has_deviation=np.ones((n_trials, 2), bool))
    state = replace(state, spread=start)
    pressure, damping = Linearised(frame, state, crossed(columns), estimable=(True, True)).likeliest_spread()
    assert pressure == pytest.approx(0.004, rel=0.4)
    assert damping == pytest.approx(0.02, rel=0.4)


def test_noise_is_estimated_without_the_bias_of_fitted_parameters():
    columns, draw = [], np.random.default_rng(7)
    n_trials, count, rho = 300, 30, 0.4
    flat = np.column_stack([np.linspace(-1, 1, count), np.ones(count)])
    for _ in range(n_trials):
        noise = np.linalg.cholesky(covariance(count, rho, 1.0)) @ draw.standard_normal(count)
        noise -= flat @ np.linalg.lstsq(flat, noise, rcond=None)[0]
        columns.append(np.column_stack([flat, np.zeros((count, 2)), noise]))
    frame, state = given(n_trials, count, 0, rho=0.0, sigma=1.0)
    found, variance = Linearised(frame, state, crossed(columns)).likeliest_noise()
    # 9000 points: ρ to 0.01, σ² to 2 %. Without counting the line ρ would come out 0.06 too small.
    assert found == pytest.approx(rho, abs=0.03)
    assert variance.mean() == pytest.approx(1 - rho**2, rel=0.05)


def test_a_noise_correlation_near_the_largest_is_found_between_grid_points():
    draw, n_trials, count, rho = np.random.default_rng(9), 100, 200, 0.963
    root = np.linalg.cholesky(covariance(count, rho, 1.0))
    columns = [np.column_stack([np.zeros((count, 4)), root @ draw.standard_normal(count)]) for _ in range(n_trials)]
    frame, state = given(n_trials, count, 0, rho=0.0, sigma=1.0)
    # 20 000 points: ρ to 0.002
    assert Linearised(frame, state, crossed(columns)).likeliest_noise()[0] == pytest.approx(rho, abs=0.006)


@pytest.mark.parametrize(("louder", "lowest", "highest"), [(1.0, 0.0, 0.5), (5.0, 0.8, 1.2)])
def test_the_noise_of_short_trials_is_shrunk_as_far_as_chance_explains_the_differences(louder, lowest, highest):
    """Of twelve points σ² scatters by 41 % of itself; what half of the trials have 25 times over is no chance."""
    draw = np.random.default_rng(20670)
    n_trials, count = 40, 12
    sd = np.where(np.arange(n_trials) % 2, louder, 1.0)
    columns = [np.column_stack([np.zeros((count, 4)), s * draw.standard_normal(count)]) for s in sd]
    frame, state = given(n_trials, count, 0, rho=0.0, sigma=1.0)
    _, variance = Linearised(frame, state, crossed(columns)).likeliest_noise(rho=0.0)
    alone = np.array([np.mean(block[:, -1] ** 2) for block in columns])
    assert lowest < np.std(np.log(variance)) / np.std(np.log(alone)) < highest
    assert np.mean(variance) == pytest.approx(np.mean(alone), rel=0.1)


def test_a_measured_pressure_has_the_standard_deviation_of_its_gauge():
    frame, _ = given(3, 25, 1, gauge_error=np.array([0.0, 4e-3, 0.0]))
    expected = [[0.01, 0.03], [4e-3, 0.03], [0.01, 0.03]]
    assert frame.deviation_sd((0.01, 0.03)) == pytest.approx(np.array(expected))


def test_collinear_parameters_are_detected_and_the_later_one_is_left_where_it_is():
    columns = columns_of(4, 25, 3, seed=10)
    for c in columns:
        c[:, 6] = 2 * c[:, 5]
    frame, state = given(4, 25, 3, 0.1)
    found = precision(Linearised(frame, state, crossed(columns)))
    assert found.collinear.tolist() == [False, True, True]
    assert np.isinf(found.covariance[1, 1])
    assert np.isfinite(found.covariance[0, 0])
    draw = np.random.default_rng(10)
    rows, seen = draw.standard_normal((30, 4)), draw.standard_normal(30)
    twice = np.column_stack([rows, rows[:, 1]])
    far, free = np.full(5, np.inf), np.ones(5, dtype=bool)
    step, _ = marginal.step_within_bounds(twice.T @ twice, twice.T @ seen, far, far, free)
    assert twice @ step == pytest.approx(rows @ np.linalg.lstsq(rows, seen, rcond=None)[0], abs=1e-9)
    assert step[4] == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize("seed", range(40))
def test_a_bounded_step_ends_at_the_minimum_in_the_box(seed):
    draw = np.random.default_rng(seed)
    columns = draw.standard_normal((12, 6)) + 2 * draw.standard_normal((12, 1))
    square, slope, free = columns.T @ columns, columns.T @ draw.standard_normal(12) * 10, np.ones(6, bool)
    free[seed % 6] = False
    # At their bounds from the start, near them, and free of them.
    theta = np.clip(draw.uniform(-2, 3, 6), -1, 2)
    step, _ = marginal.step_within_bounds(square, slope, theta + 1.0, 2.0 - theta, free)
    target = np.linalg.lstsq(columns.T, slope, rcond=None)[0]
    exact = lsq_linear(columns[:, free], target, (-1 - theta[free], 2 - theta[free]), tol=1e-14, method="bvls").x
    best = exact @ (2 * slope[free] - square[np.ix_(free, free)] @ exact)
    assert step[~free] == 0
    assert step @ (2 * slope - square @ step) == pytest.approx(best, rel=1e-6, abs=1e-5)


@pytest.mark.parametrize("bound", [np.inf, 0.02])
def test_a_step_predicts_the_decrease_of_the_sum_of_squares(bound):
    columns, starts = columns_of(4, 20, 2, seed=8), np.arange(20) == 0
    for each in columns:
        each[:, -1] += each[:, 5]
    frame, state = given(4, 20, 2, 0.5, lower=np.full(2, -bound), upper=np.full(2, bound))
    step, own, predicted = Linearised(frame, state, crossed(columns)).step()

    def cost(theta: np.ndarray, effects: np.ndarray) -> float:
        left = [c[:, -1] - c[:, 4:6] @ theta - c[:, :4] @ u for c, u in zip(columns, effects, strict=True)]
        white = [whiten(residual, starts, RHO) for residual in left]
        prior = np.array([1e-3, 1e-3, 1e5, 2.0]) ** 2
        return sum(float(w @ w) for w in white) / float(state.variance[0]) + float(np.sum(prior * effects**2))

    lowered = cost(np.zeros(2), np.zeros((4, 4))) - cost(step, own)
    assert predicted == pytest.approx(lowered, rel=1e-6)
