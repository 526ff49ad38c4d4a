"""Linear inversion for missing forces: generalised least squares with model parameters and trial effects free.

The fit is linearised about its parameters and about given trial effects. With a force of amplitudes f, positions are

    y = J δθ + Z b_i + S f + e

J the sensitivities to the model parameters θ, Z those to the effects b_i of trial i (release, origin, pressure, B), S
those to the force amplitudes (`vinetrack.diagnosis.force_inversion`), and e AR(1) noise of the tracks. θ and b_i
have normal priors. The trial effects are eliminated trial by trial, the model parameters over all trials (Schur
complements of the normal equations), so that only equations for f remain.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np
from numba import njit
from numpy.typing import NDArray

from vinetrack.core.records import Floats, Trial
from vinetrack.diagnosis.replicates import LEAST_BETWEEN_TRIAL_SD, Scatter
from vinetrack.dynamics.audit import evaluate
from vinetrack.dynamics.model import Model
from vinetrack.dynamics.simulate import Trajectory, simulate_many
from vinetrack.inference.fit_data import FitTrial
from vinetrack.inference.fit_result import Fit
from vinetrack.inference.marginal_likelihood import DEVIATION_COLUMNS, FitState, trial_effect_prior
from vinetrack.inference.optimiser import FixedTerms, solve, track_correlation, variance_floor
from vinetrack.inference.sensitivity import N_TRIAL_EFFECTS, ORIGIN, RELEASE, Job
from vinetrack.inference.whitening import whiten

# ------------------------------------------------------------------------------
# Cubic B-splines, evaluated through the four that are nonzero at each position.

N_NONZERO = 4  # Cubic splines that are nonzero between two knots (derived)


@lru_cache(maxsize=64)
def _pieces(knots: tuple[float, ...]) -> tuple[Floats, Floats]:
    """Knots, and the polynomials of the nonzero splines on each interval, shape (n_knots − 1, power, spline)."""
    from scipy.interpolate import BSpline, PPoly

    ends = np.array([knots[0]] * 3 + [*knots] + [knots[-1]] * 3)
    polynomials = np.array([PPoly.from_spline(BSpline(ends, unit, 3)).c[::-1] for unit in np.eye(len(knots) + 2)])
    pieces = [polynomials[k : k + N_NONZERO, :, 3 + k].T for k in range(len(knots) - 1)]
    return np.array(knots), np.array(pieces)


def nonzero_splines(at: Floats, knots: tuple[float, ...]) -> tuple[np.ndarray, Floats]:
    """Indices and values of the splines that are nonzero at each position; constant beyond the end knots. Returns first
    (the first of the four nonzero splines, of n_knots + 2), values (of these four; they sum to 1). Shapes: at (n,) →
    (n,).
    """
    breaks, pieces = _pieces(knots)
    inside = np.clip(at, breaks[0], breaks[-1])
    first = np.clip(np.searchsorted(breaks, inside, side="right") - 1, 0, len(pieces) - 1)
    offset = inside - breaks[first]
    polynomials = pieces[first]
    values = polynomials[:, 3]
    for power in (2, 1, 0):
        values = values * offset[:, None] + polynomials[:, power]
    return first, values


def splines(at: Floats, knots: Floats) -> Floats:
    """Design matrix of cubic B-splines on these knots; constant beyond the end knots. Shapes: at (n,); knots (n_knots,)
    → (n, n_knots + 2).
    """
    first, values = nonzero_splines(at, tuple(np.asarray(knots).tolist()))
    design = np.zeros((len(first), len(knots) + 2))
    np.put_along_axis(design, first[:, None] + np.arange(N_NONZERO), values, axis=1)
    return design


def uniform_splines(at: Floats, count: int) -> Floats:
    """Cubic B-splines on 0 to 1 with evenly spaced knots. Shapes: at (n,) → (n, count)."""
    return splines(at, np.array(uniform_knots(count)))


@lru_cache
def uniform_knots(count: int) -> tuple[float, ...]:
    """Knots of `uniform_splines`."""
    return tuple(np.linspace(0.0, 1.0, count - 2).tolist())


# ------------------------------------------------------------------------------
# Compiled integration of the variational equations: responses of motions to small accelerations.


@njit(cache=True, nogil=True, error_model="numpy")
def integrate_responses(
    time_s: Floats, stiffness: Floats, friction: Floats, acceleration: Floats, gamma: float
) -> tuple[Floats, Floats]:
    """Integrate δẍ = k δx + c δẋ + a from rest, for several added accelerations a along each motion. The method is the
    L-stable, singly diagonally implicit Runge-Kutta scheme of two stages and second order by Alexander, SIAM J. Numer.
    Anal. 14, 1006 (1977). Returns position_change, velocity_change : arrays, shape (n_trials, n_steps + 1, n), m and
    m/s. Shapes: time_s, stiffness, friction (n_trials, n_steps + 1); acceleration (n_trials, n_steps + 1, n).
    """
    trials, points, count = acceleration.shape
    position_change, velocity_change = np.zeros_like(acceleration), np.zeros_like(acceleration)
    for trial in range(trials):
        for i in range(points - 1):
            h = time_s[trial, i + 1] - time_s[trial, i]
            implicit, explicit = gamma * h, (1 - gamma) * h
            k, c = stiffness[trial, i + 1], friction[trial, i + 1]
            k_stage = (1 - gamma) * stiffness[trial, i] + gamma * k
            c_stage = (1 - gamma) * friction[trial, i] + gamma * c
            pivot_stage = 1 - implicit * c_stage - implicit * implicit * k_stage
            pivot = 1 - implicit * c - implicit * implicit * k
            for j in range(count):
                x, v, a = position_change[trial, i, j], velocity_change[trial, i, j], acceleration[trial, i + 1, j]
                a_stage = (1 - gamma) * acceleration[trial, i, j] + gamma * a
                rate = (k_stage * (x + implicit * v) + c_stage * v + a_stage) / pivot_stage
                x, v = x + explicit * (v + implicit * rate), v + explicit * rate
                v_end = v + implicit * ((k * (x + implicit * v) + c * v + a) / pivot)
                position_change[trial, i + 1, j], velocity_change[trial, i + 1, j] = x + implicit * v_end, v_end
    return position_change, velocity_change


# ------------------------------------------------------------------------------
# Sensitivities of the fitted trajectories to a small added force on the tail.
#
# Linearised about a motion x(t), the equation of motion m ẍ = F(x, ẋ, t) + f becomes the variational equation
#
#     δẍ = (∂a/∂x) δx + (∂a/∂ẋ) δẋ + f/m,   a = F/m
#
# It is linear in f, so that the responses to many forces of any shape are integrated together, with no model compiled
# for them. The derivatives are finite differences of the model's own terms (`vinetrack.dynamics.audit`). For a force
# that is not small the motion is corrected and linearised again (Newton's method in function space, Kantorovich; also
# known as quasilinearisation).

N_STEPS = 400  # Steps of a motion, denser at its start (derived)

# Diagonal coefficient of the two-stage, second-order, L-stable method of Alexander, SIAM J. Numer
SDIRK_GAMMA = 1 - 1 / math.sqrt(2)


# Part of the highest speed below which a vine counts as standing still and does not respond to a small force (chosen)
LEAST_RELATIVE_SPEED = 1e-3


@dataclass(frozen=True)
class FittedMotion:
    """The motion of one trial on a fine grid since release; arrays have shape (N_STEPS + 1,), SI. `mass_kg` is all
    moving mass; `stiffness` and `friction` are ∂a/∂x and ∂a/∂ẋ.
    """

    trial: Trial
    model: Model
    measured_Pa: Floats | None
    time_s: Floats
    lead_position_m: Floats
    lead_velocity_m_s: Floats
    pressure_Pa: Floats
    mass_kg: Floats
    stiffness: Floats
    friction: Floats
    model_acceleration: Floats
    acceleration: Floats
    observed_slope: Floats
    observation_offset_m: Floats
    end_s: float
    counts_until_s: float = math.inf

    @property
    def tail_position_m(self) -> Floats:
        """Position of the tail, r·y, m."""
        return self.trial.travel_ratio * self.lead_position_m

    @property
    def tail_velocity_m_s(self) -> Floats:
        """Velocity of the tail, r·ẏ, m/s."""
        return self.trial.travel_ratio * self.lead_velocity_m_s


def motions_of(fit: Fit, trial_effects: Floats, theta: Floats | None = None) -> list[FittedMotion]:
    """Simulate the fitted motions with given trial effects and, optionally, other model parameters. Shapes:
    trial_effects (n_trials, 4); theta (n_free,).
    """
    predictor = fit.predictor
    jobs = predictor.jobs(fit.solution.state.theta if theta is None else theta, trial_effects)
    trials = [trial_of_job(trial_data.trial, job) for trial_data, job in zip(predictor.data, jobs, strict=True)]
    # 3.0: frames by which a motion is integrated beyond its recording, in case its release moves (chosen)
    grids = [
        max(trial_data.time_s[-1] - trial_effects[i, RELEASE] + 3.0 * trial_data.frame_s, 1e-6)
        * np.linspace(0, 1, N_STEPS + 1) ** 2
        for i, trial_data in enumerate(predictor.data)
    ]
    traces = [
        None if trial_data.trace is None else (trial_data.trace[0] - job.release_s, trial_data.trace[1])
        for trial_data, job in zip(predictor.data, jobs, strict=True)
    ]
    runs = simulate_many(
        fit.model, trials, grids, traces=traces, parameters=np.array([job.row for job in jobs]), host=predictor.host
    )
    return [_motion(fit.model, *run) for run in zip(trials, jobs, runs, traces, strict=True)]


def trial_of_job(trial: Trial, job: Job) -> Trial:
    """The trial with the pressure and yield pressure that its job simulates."""
    yield_Pa = trial.yield_pressure_Pa if math.isnan(job.yield_pressure_Pa) else job.yield_pressure_Pa
    return replace(trial, pressure_Pa=trial.pressure_Pa * (1 + job.pressure_deviation), yield_pressure_Pa=yield_Pa)


def _motion(model: Model, trial: Trial, job: Job, run: Trajectory, trace: tuple[Floats, Floats] | None) -> FittedMotion:
    model = model.with_values(dict(zip(model.parameter_names, job.row.tolist(), strict=True)))
    measured = None if trace is None else np.interp(run.time_s, *trace)
    if measured is None and any("chamber_rate" in effect.functions for effect in model):
        # Chamber pressure is held as it is along the fitted motion: its response to a small force is of higher order.
        measured = evaluate(model, trial, run.time_s, run.lead_position_m, run.lead_velocity_m_s).pressure_Pa
    zeros = np.zeros_like(run.time_s)
    unevaluated = FittedMotion(trial, model, measured, run.time_s, run.lead_position_m, run.lead_velocity_m_s, zeros,
                  zeros, zeros, zeros, zeros, zeros, _observed_slope(run),
                  run.observed_position_m - run.lead_position_m,
                  run.end_time_s if run.status == "ended" else math.inf)  # fmt: skip
    motion = with_model_terms(unevaluated)
    return replace(motion, acceleration=motion.model_acceleration)


def with_model_terms(motion: FittedMotion) -> FittedMotion:
    """The motion with acceleration, mass, stiffness and friction of the model evaluated along it."""
    y, v = motion.lead_position_m, motion.lead_velocity_m_s
    step_y, step_v = 1e-4 * max(float(y.max()), 1e-9), 1e-4 * max(float(v.max()), 1e-9)
    at_motion, further, faster = (
        evaluate(motion.model, motion.trial, motion.time_s, *at, measured_Pa=motion.measured_Pa)
        for at in ((y, v), (y + step_y, v), (y, v + step_v))
    )
    r = motion.trial.travel_ratio
    stands = v < LEAST_RELATIVE_SPEED * v.max()
    late = motion.time_s > motion.time_s[N_STEPS // 20]
    stiffness = (further.acceleration_m_s2 - at_motion.acceleration_m_s2) / (r * step_y)
    friction = (faster.acceleration_m_s2 - at_motion.acceleration_m_s2) / (r * step_v)
    return replace(
        motion,
        pressure_Pa=np.broadcast_to(at_motion.pressure_Pa, y.shape),
        mass_kg=np.broadcast_to(at_motion.inertia_kg, y.shape),
        stiffness=np.where(stands, 0.0, stiffness),
        friction=np.where(stands & late, -1e9, np.minimum(friction, 0.0)),
        model_acceleration=np.asarray(at_motion.acceleration_m_s2),
    )


def _observed_slope(run: Trajectory) -> Floats:
    """Derivative of the observed position by the true position of the leading edge; 1 where it stands still."""
    velocity = np.gradient(run.lead_position_m, run.time_s)
    observed_velocity = np.gradient(run.observed_position_m, run.time_s)
    moving = velocity > LEAST_RELATIVE_SPEED * velocity.max()
    return np.where(moving, observed_velocity / np.where(moving, velocity, 1.0), 1.0)


def force_sensitivities(
    fit: Fit, trial_effects: Floats, motions: Sequence[FittedMotion], force: Callable[[FittedMotion], Floats]
) -> list[Floats]:
    """Derivatives of the observed positions of every trial with respect to force amplitudes. Shapes: trial_effects
    (n_trials, 4) → (n_points, n_forces).
    """
    return acceleration_sensitivities(
        fit, trial_effects, motions, [force(motion) / motion.mass_kg[:, None] for motion in motions]
    )


def acceleration_sensitivities(
    fit: Fit, trial_effects: Floats, motions: Sequence[FittedMotion], accelerations: Sequence[Floats]
) -> list[Floats]:
    """As `force_sensitivities`, for added accelerations of the tail in place of forces. Shapes: trial_effects
    (n_trials, 4); accelerations (N_STEPS + 1, n) → (n_points, n).
    """
    dx, _ = _responses(motions, np.array(accelerations))
    return [
        _interpolated(
            trial_data.time_s - trial_effects[i, RELEASE],
            motion,
            response * motion.observed_slope[:, None] / motion.trial.travel_ratio,
        )
        for i, (trial_data, motion, response) in enumerate(zip(fit.predictor.data, motions, dx, strict=True))
    ]


def with_force(
    motions: Sequence[FittedMotion], force: Callable[[FittedMotion], Floats], rounds: int
) -> list[FittedMotion]:
    """The motions under an added force on the tail that need not be small. Each correction leaves about a tenth of the
    error of the one before. Motions that do not satisfy their models are corrected to do so. The stiffness and friction
    returned include the force.
    """
    for _ in range(rounds):
        motions = [_with_force_derivatives(motion, force) for motion in motions]
        defect = np.array(
            [motion.model_acceleration + force(motion) / motion.mass_kg - motion.acceleration for motion in motions]
        )
        dx, dv = (response[:, :, 0] for response in _responses(motions, defect[:, :, None]))
        motions = [_corrected(*step) for step in zip(motions, defect, dx, dv, strict=True)]
    return [_with_force_derivatives(motion, force) for motion in motions]


def _with_force_derivatives(motion: FittedMotion, force: Callable[[FittedMotion], Floats]) -> FittedMotion:
    """The motion with the derivatives of the added force included in stiffness and friction."""
    y, v = motion.lead_position_m, motion.lead_velocity_m_s
    step_y, step_v = 1e-4 * max(float(y.max()), 1e-9), 1e-4 * max(float(v.max()), 1e-9)
    at_motion, r = force(motion), motion.trial.travel_ratio
    further = (force(replace(motion, lead_position_m=y + step_y)) - at_motion) / (r * step_y * motion.mass_kg)
    faster = (force(replace(motion, lead_velocity_m_s=v + step_v)) - at_motion) / (r * step_v * motion.mass_kg)
    moves = v >= LEAST_RELATIVE_SPEED * v.max()
    return replace(
        motion,
        stiffness=motion.stiffness + np.where(moves, further, 0.0),
        friction=np.where(moves, np.minimum(motion.friction + faster, 0.0), motion.friction),
    )


def _corrected(motion: FittedMotion, defect: Floats, dx: Floats, dv: Floats) -> FittedMotion:
    """The motion after a change of the tail's position and velocity; growth does not run backwards."""
    r = motion.trial.travel_ratio
    # Step limit: a correction takes away at most half of the speed; the rest is left to the next correction.
    part = float(np.min(np.where(dv < 0, 0.5 * motion.tail_velocity_m_s / np.maximum(-dv, 1e-12), 1.0), initial=1.0,
                        where=motion.lead_velocity_m_s > 0.05 * motion.lead_velocity_m_s.max()))  # fmt: skip
    part = min(part, 1.0)
    changed = replace(
        motion,
        lead_position_m=np.maximum(motion.lead_position_m + part * dx / r, 0.0),
        lead_velocity_m_s=np.maximum(motion.lead_velocity_m_s + part * dv / r, 0.0),
        acceleration=motion.acceleration + part * (motion.stiffness * dx + motion.friction * dv + defect),
    )
    return with_model_terms(changed)


def _interpolated(since_s: Floats, motion: FittedMotion, values: Floats) -> Floats:
    """Grid values interpolated linearly at other times; 0 before release and after growth has ended."""
    grid_s = motion.time_s
    k = np.clip(np.searchsorted(grid_s, since_s), 1, grid_s.size - 1)
    part = np.clip((since_s - grid_s[k - 1]) / (grid_s[k] - grid_s[k - 1]), 0.0, 1.0)[:, None]
    growing = (since_s > 0) & (since_s <= motion.end_s)
    return np.where(growing[:, None], values[k - 1] + part * (values[k] - values[k - 1]), 0.0)


def _responses(motions: Sequence[FittedMotion], acceleration: Floats) -> tuple[Floats, Floats]:
    """δx, m, and δẋ, m/s, of every trial to added accelerations; all of shape (n_trials, N_STEPS + 1, n)."""
    time_s, k, c = (
        np.array([getattr(motion, name) for motion in motions]) for name in ("time_s", "stiffness", "friction")
    )
    dx, dv = integrate_responses(time_s, k, c, np.ascontiguousarray(acceleration), SDIRK_GAMMA)
    # Compiled code does not raise on overflow.
    if np.geterr()["over"] == "raise" and not (np.isfinite(dx).all() and np.isfinite(dv).all()):
        raise FloatingPointError("the response to a force is not finite")
    return dx, dv


INDEPENDENT_POINTS_PER_TRIAL = 10.0  # Effective number of independent residuals in one trial (chosen)


PARAMETER_CUTOFF = 1e-11  # Relative eigenvalue below which a combination of model parameters is not estimable (derived)

# Penalties on second differences among which generalised cross-validation chooses, relative to the mean information
# about a coefficient (chosen)
SMOOTHING_PENALTIES = np.geomspace(1e-6, 1e2, 17)


@dataclass(frozen=True)
class ForceEstimate:
    """Least-squares estimate of force amplitudes, N, and the fall of χ² that they bring. `sigma` is the root mean
    square standard error of an amplitude. `parameter_shift` is how far the model parameters move along, in the fit's
    own scaling.
    """

    delta_chi2: float
    amplitude: Floats
    sigma: float
    parameter_shift: Floats
    degrees_of_freedom: int

    @property
    def delta_chi2_beyond_chance(self) -> float:
        """The fall of χ² in excess of its expectation under no force; at least 0."""
        return max(self.delta_chi2 - self.degrees_of_freedom, 0.0)


class LinearInversion:
    """A fit linearised about its parameters and given trial effects, ready to estimate any number of forces. The noise
    variance is that of the tracks, so that misfit of the model does not count as noise. Pressure and B of a trial have
    the standard deviations estimated from replicates.
    """

    def __init__(self, fit: Fit, trial_effects: Floats, scatter: Scatter) -> None:
        data, problem = fit.predictor.data, fit.solution.problem
        rho = track_correlation(data)
        noise = np.array([trial_data.noise_m**2 for trial_data in data]) * (1 - rho**2)
        self.scatter = scatter
        spread = (max(scatter.pressure, LEAST_BETWEEN_TRIAL_SD[0]), max(scatter.damping, LEAST_BETWEEN_TRIAL_SD[1]))
        fitted = fit.solution.state
        state = FitState(fitted.theta, trial_effects, spread, rho, np.maximum(noise, variance_floor(data)))
        parameters_held = replace(problem, free=np.zeros_like(problem.free))
        noise_held = FixedTerms(spread, (rho, state.variance))
        # 8: most iterations of the trial effects (chosen)
        solution = solve(fit.predictor, parameters_held, state, noise_held, warm=True, most_iterations=8)
        self.data, self.problem = data, problem
        self.state, self.columns = solution.state, solution.columns
        self.trial_effect_precision = trial_effect_prior(problem, self.state)[1]
        self.prior_score = -problem.prior_precision * (state.theta - problem.prior_mean)
        self.conditions = [trial_data.trial.condition for trial_data in data]
        self.n_points = float(sum(trial_data.time_s.size for trial_data in data))

    @property
    def trial_effects(self) -> Floats:
        """The trial effects about which everything is linear, shape (n_trials, 4)."""
        return self.state.trial_effects

    def estimate_each(self, sensitivities: Sequence[Floats], columns: Sequence[int]) -> list[ForceEstimate]:
        """Estimate each of several forces with none of the others present. Shapes: sensitivities (n_points,
        n_columns).
        """
        products = self._products_without_trial_effects(sensitivities)
        matrix, cross, total = self._sums_over_trials(products)
        parameter_response = scaled_pseudo_inverse(matrix, PARAMETER_CUTOFF) @ cross
        reduced = total - cross.T @ parameter_response
        ends = np.concatenate([[0], np.cumsum(columns)])
        return [
            self._estimate(products, parameter_response, reduced, slice(a, b))
            for a, b in itertools.pairwise(ends.tolist())
        ]

    def estimate_jointly(self, sensitivities: Sequence[Floats]) -> ForceEstimate:
        """Estimate all force amplitudes together, the same in every trial. Shapes: sensitivities (n_points,
        n_columns).
        """
        return self.estimate_each(sensitivities, [sensitivities[0].shape[1]])[0]

    def estimate_by_condition(self, sensitivities: Sequence[Floats]) -> ForceEstimate:
        """Estimate all force amplitudes together, with separate amplitudes for each condition. Shapes: sensitivities
        (n_points, n_columns).
        """
        names = list(dict.fromkeys(self.conditions))
        count = sensitivities[0].shape[1]
        of_conditions = []
        for condition, of_trial in zip(self.conditions, sensitivities, strict=True):
            block = np.zeros((len(of_trial), count * len(names)))
            k = names.index(condition) * count
            block[:, k : k + count] = of_trial
            of_conditions.append(block)
        return self.estimate_jointly(of_conditions)

    @cached_property
    def chi2_without_force(self) -> float:
        """χ² with model parameters and trial effects re-estimated and no force added."""
        products = self._products_without_trial_effects([np.zeros((len(c), 0)) for c in self.columns])
        matrix, cross, total = self._sums_over_trials(products)
        covariance = scaled_pseudo_inverse(matrix, PARAMETER_CUTOFF)
        return float(total[-1, -1] - cross[:, -1] @ covariance @ cross[:, -1])

    def bic(self, delta_chi2: float, n_parameters: int, largest_delta_chi2: float) -> float:
        """Bayesian information criterion of a force, relative to the force that explains most: smaller is better. The
        misfit that not even the best force explains is counted as further noise: it inflates the variance of every
        independent residual. Source: Schwarz, Annals of Statistics 6, 461 (1978), with χ² divided by that inflation.
        """
        independent_points = INDEPENDENT_POINTS_PER_TRIAL * len(self.data)
        unexplained = max(self.chi2_without_force - largest_delta_chi2 - self.n_points, 0.0)
        misfit = (largest_delta_chi2 - delta_chi2) / (1 + unexplained / independent_points)
        return misfit + n_parameters * math.log(independent_points)

    def smooth_force_by_condition(
        self, sensitivities: Sequence[Floats], parameter_shift: Floats
    ) -> dict[str, tuple[Floats, Floats]]:
        """Estimate a smooth force in every condition: spline coefficients and their covariance. The coefficients
        minimise χ² plus a penalty on their second differences (a P-spline, Eilers & Marx 1996). One penalty for all
        conditions is chosen by generalised cross-validation. Returns dict of (coefficients, covariance): By condition;
        shapes (n_columns,) in N and (n_columns, n_columns) in N². Shapes: sensitivities (n_points, n_columns);
        parameter_shift (n_free,).
        """
        products = self._products_without_trial_effects(sensitivities)
        k = self.problem.index.shape[1]
        shift_of_keys = np.append(parameter_shift, 0.0)[self.problem.index]
        names = list(dict.fromkeys(self.conditions))
        condition_of_trial = np.array([names.index(condition) for condition in self.conditions])
        count = sensitivities[0].shape[1]
        information, score = np.zeros((len(names), count, count)), np.zeros((len(names), count))
        residual_products = products[:, k:, -1] - np.einsum("nlk,nk->nl", products[:, k:, :k], shift_of_keys)
        np.add.at(information, condition_of_trial, products[:, k:-1, k:-1])
        np.add.at(score, condition_of_trial, residual_products[:, :-1])
        second_difference = np.diff(np.eye(count), 2, axis=0)
        unit = float(np.mean(np.einsum("nkk->n", information))) / count
        roughness = unit * (second_difference.T @ second_difference + 1e-6 * np.eye(count))
        best: tuple[float, Floats, Floats] | None = None
        independent_points = INDEPENDENT_POINTS_PER_TRIAL * len(self.data)
        unpenalised = np.linalg.solve(information + 1e-9 * roughness, score[:, :, None])[:, :, 0]
        largest_gain = float(np.sum(score * unpenalised))
        for penalty in SMOOTHING_PENALTIES:
            inverse = np.linalg.inv(information + penalty * roughness)
            coefficients = np.einsum("nkl,nl->nk", inverse, score)
            lost_gain = largest_gain - float(
                np.sum(2 * coefficients * score) - np.einsum("nk,nkl,nl->", coefficients, information, coefficients)
            )
            degrees_of_freedom = float(np.einsum("nkl,nlk->", inverse, information))
            cross_validation = (lost_gain + independent_points) / max(independent_points - degrees_of_freedom, 1.0) ** 2
            if best is None or cross_validation < best[0]:
                best = cross_validation, coefficients, inverse
        assert best is not None
        residual_dof = max(self.n_points - count * len(names), 1.0)
        unmoved = not parameter_shift.any()
        inflation = max(1.0, (self.chi2_without_force - largest_gain) / residual_dof) if unmoved else 1.0
        return {name: (best[1][i], inflation * best[2][i]) for i, name in enumerate(names)}

    def _products_without_trial_effects(self, sensitivities: Sequence[Floats]) -> Floats:
        """Cross products of [parameters, forces, residual] of each trial, its trial effects eliminated. Shape
        (n_trials, n_keys + n_forces + 1, the same again).
        """
        products = []
        for i, (columns, of_force) in enumerate(zip(self.columns, sensitivities, strict=True)):
            deviations = self.state.trial_effects[i, list(DEVIATION_COLUMNS)]
            residual = columns[:, -1] + columns[:, list(DEVIATION_COLUMNS)] @ deviations
            rows = np.column_stack([columns[:, :-1], of_force, residual])
            white = whiten(rows, self.data[i].first, self.state.rho, self.data[i].relative_sd)
            gram = white.T @ white / self.state.variance[i]
            effects, others = slice(None, N_TRIAL_EFFECTS), slice(N_TRIAL_EFFECTS, None)
            of_effects = gram[effects, effects] + np.diag(self.trial_effect_precision[i])
            eliminated = gram[others, effects] @ np.linalg.solve(of_effects, gram[effects, others])
            products.append(gram[others, others] - eliminated)
        return np.array(products)

    def _sums_over_trials(self, products: Floats) -> tuple[Floats, Floats, Floats]:
        """Normal equations over all trials, with the priors of the p model parameters. Blocks: parameters by parameters
        (p, p); parameters by [forces, residual] (p, L + 1); the latter by themselves.
        """
        k, p = self.problem.index.shape[1], self.prior_score.size
        index = self.problem.index
        matrix, cross = np.zeros((p + 1, p + 1)), np.zeros((p + 1, products.shape[1] - k))
        np.add.at(matrix, (index[:, :, None], index[:, None, :]), products[:, :k, :k])
        np.add.at(cross, index, products[:, :k, k:])
        matrix, cross = matrix[:p, :p] + np.diag(self.problem.prior_precision), cross[:p].copy()
        cross[:, -1] += self.prior_score
        held = ~self.problem.free | ~(np.diag(matrix) > 0)
        matrix[held, :] = matrix[:, held] = cross[held] = 0.0
        return matrix, cross, products[:, k:, k:].sum(axis=0)

    def _estimate(self, products: Floats, parameter_response: Floats, reduced: Floats, columns: slice) -> ForceEstimate:
        """The force whose amplitudes are in `columns`, from the equations with all other unknowns eliminated. Its
        standard error is the larger of the model-based one and the cluster-robust one with trials as clusters.
        """
        # Part of the largest information below which a force amplitude is not estimable (chosen)
        least_relative_information = 1e-9
        information, score = reduced[columns, columns], reduced[columns, -1]
        size = np.diag(information)
        estimable = size > least_relative_information * max(float(size.max()), 1e-300)
        if not estimable.any():
            return ForceEstimate(0.0, np.zeros(score.size), math.inf, np.zeros(parameter_response.shape[0]), 0)
        covariance = scaled_pseudo_inverse(information, least_relative_information, estimable)
        amplitude = covariance @ score
        shift = parameter_response[:, -1] - parameter_response[:, columns] @ amplitude
        scores = self._scores_by_trial(products, parameter_response[:, columns], columns, amplitude, shift)
        n_trials = len(scores)
        residual_dof = max(n_trials - shift.size - score.size, 1)
        robust = covariance @ (scores.T @ scores * n_trials / residual_dof) @ covariance
        sigma = math.sqrt(max(float(np.trace(covariance)), float(np.trace(robust))) / score.size)
        return ForceEstimate(float(score @ amplitude), amplitude, sigma, shift, int(np.count_nonzero(estimable)))

    def _scores_by_trial(
        self, products: Floats, parameter_response: Floats, columns: slice, amplitude: Floats, shift: Floats
    ) -> Floats:
        """Contribution of each trial to the score of the amplitudes at the estimate, shape (n_trials, n_columns)."""
        k = self.problem.index.shape[1]
        index = self.problem.index
        shift_of_keys = np.append(shift, 0.0)[index]
        forces = slice(k + columns.start, k + columns.stop)
        residual_products = (
            products[:, :, -1]
            - np.einsum("nqk,nk->nq", products[:, :, :k], shift_of_keys)
            - products[:, :, forces] @ amplitude
        )
        response_of_keys = np.vstack([parameter_response, np.zeros((1, parameter_response.shape[1]))])[index]
        return np.asarray(
            residual_products[:, forces] - np.einsum("nkl,nk->nl", response_of_keys, residual_products[:, :k])
        )


def scaled_pseudo_inverse(matrix: Floats, cutoff: float, estimable: NDArray[np.bool_] | None = None) -> Floats:
    """Pseudo-inverse of a symmetric matrix after scaling its diagonal to 1. Returns zero in the rows and columns that
    do not take part. Shapes: matrix (n, n); estimable (n,) → (n, n).
    """
    diagonal = np.diag(matrix)
    scale = np.where(diagonal > 0 if estimable is None else estimable, 1 / np.sqrt(np.maximum(diagonal, 1e-300)), 0.0)
    inverse = np.linalg.pinv(matrix * scale[:, None] * scale, rcond=cutoff, hermitian=True)
    return np.asarray(inverse * scale[:, None] * scale)


# ------------------------------------------------------------------------------
# Motions that lie on the tracks, whatever the model says: the starting point for a force that is not small.
#
# The acceleration of every trial is a sum of splines, integrated twice from rest at its release and fitted to
# positions with the smoothing chosen by generalised cross-validation (Wahba 1990, ch. 4). The acceleration itself is
# not used as data: the equation of motion is linearised about this motion, and the defect there (what the model's
# forces lack) enters as one more known acceleration, so that noise in the smoothed motion cancels to first order
# (quasilinearisation, Bellman & Kalaba 1965). About the motion of a model that lacks a large force the linearisation
# would be poor.


# Penalties on second differences, relative to the information from positions (chosen)
SMOOTHED_MOTIONS_SMOOTHING_PENALTIES = np.geomspace(1e-8, 1e2, 21)


def on_tracks(inversion: LinearInversion, trial_effects: Floats, motions: Sequence[FittedMotion]) -> list[FittedMotion]:
    """Move motions onto their tracks and evaluate the model along them. Shapes: trial_effects (n_trials, 4)."""
    return [_on_track(inversion.data[i], trial_effects[i], motion) for i, motion in enumerate(motions)]


def _on_track(data: FitTrial, trial_effects: Floats, motion: FittedMotion) -> FittedMotion:
    since_s = data.time_s - trial_effects[RELEASE]
    observed_m = data.lead_position_m - trial_effects[ORIGIN]
    position_m = observed_m - np.interp(since_s, motion.time_s, motion.observation_offset_m)
    length_m = motion.trial.length_m
    # 0.96: part of the length up to which points are used (chosen)
    growing = (since_s > 0) & ~(position_m > 0.96 * length_m)
    if np.count_nonzero(growing) <= 2:
        return motion
    grid_s = motion.time_s
    last_s = float(since_s[growing].max())
    # 20: splines of an acceleration, even in the square root of time and so denser where a vine accelerates (chosen)
    accelerations = uniform_splines(np.sqrt(np.clip(grid_s / last_s, 0.0, 1.0)), 20)
    velocities = _integrated(grid_s, accelerations)
    positions = _integrated(grid_s, velocities)
    k = np.clip(np.searchsorted(grid_s, since_s[growing]), 1, grid_s.size - 1)
    part = ((since_s[growing] - grid_s[k - 1]) / (grid_s[k] - grid_s[k - 1]))[:, None]
    at_frames = positions[k - 1] + part * (positions[k] - positions[k - 1])
    coefficients = _penalised_fit(at_frames, position_m[growing])
    r = motion.trial.travel_ratio
    moved = replace(
        motion,
        lead_position_m=np.maximum.accumulate(np.maximum(positions @ coefficients, 0.0)),
        lead_velocity_m_s=np.maximum(velocities @ coefficients, 0.0),
        acceleration=r * (accelerations @ coefficients),
        # The model's end of growth is not that of the track: the vine responds to forces beyond it.
        end_s=math.inf,
        counts_until_s=last_s,
    )
    return with_model_terms(moved)


def _integrated(time_s: Floats, columns: Floats) -> Floats:
    """Cumulative integrals of the columns by the trapezoidal rule, 0 at the first time."""
    steps = 0.5 * (columns[1:] + columns[:-1]) * np.diff(time_s)[:, None]
    return np.concatenate([np.zeros((1, columns.shape[1])), np.cumsum(steps, axis=0)])


def _penalised_fit(design: Floats, values: Floats) -> Floats:
    """Coefficients with penalised second differences, the penalty chosen by generalised cross-validation."""
    second_difference = np.diff(np.eye(design.shape[1]), 2, axis=0)
    gram = design.T @ design
    unit = float(np.trace(gram)) / design.shape[1]
    roughness = unit * (second_difference.T @ second_difference + 1e-9 * np.eye(design.shape[1]))
    best: tuple[float, Floats] | None = None
    for penalty in SMOOTHED_MOTIONS_SMOOTHING_PENALTIES:
        inverse = np.linalg.pinv(gram + penalty * roughness, hermitian=True)
        coefficients = inverse @ (design.T @ values)
        degrees_of_freedom = min(float(np.trace(inverse @ gram)), values.size - 1.0)
        score = float(np.sum((values - design @ coefficients) ** 2)) / (values.size - degrees_of_freedom) ** 2
        if best is None or score < best[0]:
            best = score, coefficients
    assert best is not None
    return best[1]


# ------------------------------------------------------------------------------
# Smooth forces over one variable or two: cubic B-splines with a Gaussian-process prior on their coefficients.
#
# The coefficients are the values of a Gaussian process at the centres of the splines, with covariance
#
#     a² Π_d (1 + s_d + s_d²/3) exp(−s_d),   s_d = √5 |u_d − u'_d|/ℓ_d
#
# where u are the variables scaled to the range that the trials visited: the Matérn kernel of order 5/2 (Rasmussen &
# Williams 2006, §4.2). Its functions are twice differentiable. The squared-exponential kernel exp(−½ s²), whose
# functions
# are infinitely smooth, gives bands that are far too narrow for a force such as a power of the growth: in a linear fit
# to
# draws they contain a third of the points instead of nearly all. The model is a penalised spline with an amplitude a,
# N,
# and length scales ℓ_d as hyperparameters (Wahba, JASA 73, 364, 1978; Wilson & Nickisch, ICML 2015).

# What a force may depend on, and the attribute of a motion that holds it
VARIABLES = {
    "growth": "lead_position_m",
    "speed": "tail_velocity_m_s",
    "time": "time_s",
    "pressure": "pressure_Pa",
}

SPLINES_ALONE = {"growth": 24, "speed": 16, "time": 16, "pressure": 7}
# Splines along a variable, when it is alone and when it is one of two (chosen)
SPLINES_IN_PAIR = {"growth": 20, "speed": 8, "time": 8, "pressure": 5}

# Length scales that are averaged over, as parts of the visited range (chosen)
LENGTH_SCALES = (0.05, 0.08, 0.14, 0.25, 0.45, 0.8, 1.6)

# Amplitudes that are averaged over, as parts of the largest drive (chosen)
RELATIVE_AMPLITUDES = np.geomspace(0.003, 0.3, 9)

KEPT_VARIANCE, SEARCHED_VARIANCE = 1e-6, 1e-4  # Relative variances below which a mode is dropped (chosen)

# What a force may be where growth begins
ZERO_AT_START, CONSTANT_AT_START, FREE_AT_START = "nothing", "a constant", "anything"


def standard_error(basis: Floats, covariance: Floats) -> Floats:
    """Standard error of a linear combination of coefficients, for each row of a basis. Shapes: basis (n, n_splines);
    covariance (n_splines, n_splines) → (n,).
    """
    return np.asarray(np.sqrt(np.einsum("nk,kl,nl->n", basis, covariance, basis)))


@lru_cache(maxsize=256)
def covariance_modes(count: int, length: float, *, zero_at_start: bool = False) -> tuple[Floats, Floats]:
    """Eigenvectors and eigenvalues of the covariance of a unit-variance process at the centres of the splines. Returns
    eigenvectors, variances. Shape (count, count).
    """
    knots = np.concatenate([[0.0] * 3, np.linspace(0.0, 1.0, count - 2), [1.0] * 3])
    at = np.array([knots[k + 1 : k + 4].mean() for k in range(count)])
    distance = math.sqrt(5) * np.abs(at[:, None] - at) / length
    covariance = (1 + distance + distance**2 / 3) * np.exp(-distance)
    if zero_at_start:
        covariance = covariance - np.outer(covariance[:, 0], covariance[0])
    variances, eigenvectors = np.linalg.eigh(covariance)
    variances = np.maximum(variances, 0.0)
    # Cached and shared, so made read-only: the same few are needed thousands of times.
    for array in (eigenvectors, variances):
        array.flags.writeable = False
    return eigenvectors, variances


@dataclass(frozen=True)
class Domain:
    """The variables of a force, their visited ranges (SI), and the number of splines along each. `log_scale` is the
    distance above the lowest value from which a variable is taken as its logarithm; infinite for never.
    """

    variables: tuple[str, ...]
    low: tuple[float, ...]
    high: tuple[float, ...]
    counts: tuple[int, ...]
    log_scale: tuple[float, ...]

    def normalised(self, values: Sequence[Floats]) -> list[Floats]:
        """The variables scaled to 0 to 1 over the visited range, logarithmically beyond `log_scale`. Speeds and
        durations of a campaign span decades, and forces change over fractions of them. Shapes: values (n,).
        """
        limits = zip(values, self.low, self.high, self.log_scale, strict=True)
        return [
            np.log1p(np.maximum(at - low, 0.0) / log_scale) / math.log1p((high - low) / log_scale)
            if math.isfinite(log_scale)
            else (at - low) / (high - low)
            for at, low, high, log_scale in limits
        ]

    @property
    def name(self) -> str:
        """The variables joined by +: `growth`, `growth+speed`."""
        return "+".join(self.variables)

    @property
    def size(self) -> int:
        """Total number of splines (products of splines, for two variables)."""
        return math.prod(self.counts)

    def values_along(self, motion: FittedMotion) -> list[Floats]:
        """The variables along a motion, SI, each of shape (n_times,)."""
        return [np.asarray(getattr(motion, VARIABLES[name])) for name in self.variables]

    def basis(self, values: Sequence[Floats]) -> Floats:
        """Design matrix: all splines, or products of splines, at these values. Shapes: values (n,) → (n, size)."""
        indices, products = self._nonzero_products(values)
        design = np.zeros((len(indices), self.size))
        np.put_along_axis(design, indices, products, axis=1)
        return design

    def evaluate(self, values: Sequence[Floats], coefficients: Floats) -> Floats:
        """Sum of all splines times their coefficients at these values. Shapes: values (n,); coefficients (size,) →
        (n,).
        """
        indices, products = self._nonzero_products(values)
        return np.asarray(np.einsum("ns,ns->n", products, coefficients[indices]))

    def _nonzero_products(self, values: Sequence[Floats]) -> tuple[np.ndarray, Floats]:
        """Indices and values of the nonzero products of splines, shape (n, 4^n_variables)."""
        indices, products = np.zeros((len(values[0]), 1), dtype=int), np.ones((len(values[0]), 1))
        for position, count in zip(self.normalised(values), self.counts, strict=True):
            first, splines = nonzero_splines(position, uniform_knots(count))
            along_axis = first[:, None] + np.arange(N_NONZERO)
            indices = (indices[:, :, None] * count + along_axis[:, None, :]).reshape(len(position), -1)
            products = (products[:, :, None] * splines[:, None, :]).reshape(len(position), -1)
        return indices, products

    @property
    def start_axis(self) -> int:
        """Index of the variable that marks the start of growth: growth, else time since release; else −1."""
        return next((self.variables.index(name) for name in ("growth", "time") if name in self.variables), -1)

    @property
    def start_conditions(self) -> tuple[str, ...]:
        """What a force over these variables may be where growth begins."""
        if self.start_axis < 0:
            return (FREE_AT_START,)
        return (
            (ZERO_AT_START, CONSTANT_AT_START)
            if len(self.variables) == 1
            else (ZERO_AT_START, CONSTANT_AT_START, FREE_AT_START)
        )

    def prior_modes(
        self, lengths: Sequence[float], at_start: str = FREE_AT_START, least_variance: float = KEPT_VARIANCE
    ) -> Floats:
        """Square root of the prior covariance: coefficients of the splines for each mode at unit amplitude. Shape
        (size, n_modes).
        """
        start_axis = self.start_axis
        by_axis = [
            covariance_modes(count, length, zero_at_start=k == start_axis)
            for k, (count, length) in enumerate(zip(self.counts, lengths, strict=True))
        ]
        columns = [_product(by_axis, least_variance)]
        if start_axis >= 0 and at_start == CONSTANT_AT_START:
            columns.append(np.ones((self.size, 1)))
        if start_axis >= 0 and at_start == FREE_AT_START:
            # 3.0: prior amplitude of the force where growth begins, as a multiple of that of the rest of
            # the surface (chosen)
            constant_along_start_axis = [
                (np.ones((count, 1)), np.array([3.0**2])) if k == start_axis else modes
                for k, (count, modes) in enumerate(zip(self.counts, by_axis, strict=True))
            ]
            columns.append(_product(constant_along_start_axis, least_variance))
        return np.hstack(columns)


def _product(by_axis: Sequence[tuple[Floats, Floats]], least_variance: float) -> Floats:
    """Modes of a product of processes, scaled by the root of their variance, shape (n_splines, n_modes kept)."""
    variances: Floats = np.ones(1)
    for _, of_axis in by_axis:
        variances = np.asarray(np.kron(variances, of_axis))
    kept = np.flatnonzero(variances > least_variance * variances.max())
    vectors: Floats = np.ones((1, kept.size))
    indices = np.unravel_index(kept, [of_axis.size for _, of_axis in by_axis])
    for (eigenvectors, _), index in zip(by_axis, indices, strict=True):
        vectors = (vectors[:, None, :] * eigenvectors[None, :, index]).reshape(-1, kept.size)
    return np.asarray(vectors * np.sqrt(variances[kept]))


@dataclass(frozen=True)
class SmoothForce:
    """A force over a domain whose amplitudes have independent normal priors of standard deviation `sd_N`. `modes`,
    shape (n_splines, n_amplitudes), are the spline coefficients for unit amplitudes. An infinite `sd_N` leaves the
    amplitudes free.
    """

    domain: Domain
    modes: Floats
    sd_N: float = math.inf

    @property
    def amplitude_precision(self) -> float:
        """Prior precision of each amplitude, 1/N²."""
        return self.sd_N**-2

    @property
    def shape_names(self) -> tuple[str, ...]:
        """No shape parameters: the amplitudes are the only unknowns."""
        return ()

    def size_of(self, name: str) -> float:  # pragma: no cover
        """Not applicable: there are no shape parameters."""
        raise KeyError(name)

    def shifted(self, name: str, by: float) -> SmoothForce:  # pragma: no cover
        """Not applicable: there are no shape parameters."""
        raise KeyError(name, by)

    def within_growth(self, growth_m: float) -> SmoothForce:  # noqa: ARG002
        """Return itself: the force is constant beyond the visited range."""
        return self

    def force(self, motion: FittedMotion, amplitude: Floats) -> Floats:
        """The force with these amplitudes along a motion. Shapes: amplitude (n_columns,) → (n_times,)."""
        return self.domain.evaluate(self.domain.values_along(motion), self.modes @ amplitude)

    def unit_force(self, motion: FittedMotion) -> Floats:
        """The force of each unit amplitude along a motion. Shape (n_times, n_columns)."""
        return np.asarray(self.domain.basis(self.domain.values_along(motion)) @ self.modes)


def candidate_domains(motions: Sequence[FittedMotion]) -> list[Domain]:
    """Every variable alone, then every pair, over the ranges that the motions visit."""
    pressure_margin = 0.03  # Part by which the range of pressures is extended at both ends (chosen)
    ranges: dict[str, tuple[float, float, float]] = {}
    for name, attribute in VARIABLES.items():
        by_trial = [
            np.asarray(getattr(motion, attribute))[motion.time_s <= motion.counts_until_s] for motion in motions
        ]
        # 0.98: quantile of a trial's speeds that counts as its highest (chosen)
        high = max(float(np.quantile(values, 0.98) if name == "speed" else values.max()) for values in by_trial)
        low = min(float(values.min()) for values in by_trial) if name == "pressure" else 0.0
        # 0.02: part of the highest pressure by which pressures must differ for pressure to be a variable (chosen)
        if high - low > 0.02 * abs(high):
            if name == "pressure":
                low, high = (1 - pressure_margin) * low, (1 + pressure_margin) * high
            typical = float(np.median([np.median(values) for values in by_trial]))
            # ("speed", "time"): variables on a logarithmic scale above their median (chosen)
            ranges[name] = low, high, typical if name in ("speed", "time") else math.inf

    def domain(names: tuple[str, ...], counts: dict[str, int]) -> Domain:
        lows, highs, log_scales = zip(*(ranges[name] for name in names), strict=True)
        return Domain(names, lows, highs, tuple(counts[name] for name in names), log_scales)

    return [domain((name,), SPLINES_ALONE) for name in ranges] + [
        domain(pair, SPLINES_IN_PAIR) for pair in itertools.combinations(ranges, 2)
    ]
