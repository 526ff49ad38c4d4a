"""Expected precision of n and B from planned trials: Fisher information of the linear mixed model.

Each condition is simulated once at the medians of the predictive inputs, with the camera's frames and noise. Its
information about n, B and the yield pressure follows from the sensitivities of its positions, with the trial effects
(release, origin, deviations of pressure and B) integrated out. Information adds up over trials, so any campaign is
evaluated without further simulation.

For comparison, the precision of n from steady speeds alone follows from the damping law

    ln (P − P_y)A = ln B + n ln ẋ_ss
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from vinetrack.core.records import Floats, Trial
from vinetrack.dynamics.model import Model, Value
from vinetrack.dynamics.simulate import simulate_many
from vinetrack.inference.fit_data import END_FRACTION, FitTrial
from vinetrack.inference.marginal_likelihood import deviations_eliminated, marginal
from vinetrack.inference.mixed_effects import FitState, MixedProblem
from vinetrack.inference.optimiser import make_problem
from vinetrack.inference.parameters import DAMPING, EXPONENT, FreeParameter, ParameterMap, make_layout
from vinetrack.inference.sensitivity import N_TRIAL_EFFECTS, Predictor
from vinetrack.inference.whitening import all_products
from vinetrack.kinematics.summary import lead_velocity_at
from vinetrack.planning.predictive_inputs import PredictiveInputs

REST_FRAMES = 20  # Frames at rest before release (chosen)

RELEASE_FRACTION = 0.4  # Time of release within a frame interval, in frames (chosen)

FEWEST_GROWTH_FRAMES = 12  # Frames of growth below which a trial is not worth filming (chosen)


@dataclass(frozen=True)
class FilmingPlan:
    """How a campaign is filmed: frames per second, noise of a position, m, and its lag-one correlation. A recording
    ends with the growth, at twice `longest_s` where the growth does not end, and at the latest `stops_s` after release.
    """

    capture_fps: float
    noise_m: float
    noise_correlation: float = 0.0
    longest_s: float = 4.0
    stops_s: float = math.inf


@dataclass(frozen=True)
class Information:
    """Fisher information of one trial of each condition about the `free` parameters. Parameters are scaled as in the
    fit (ln B, n over its scale). `each`, shape (n_conditions, n_free, n_free); `prior`, shape (n_free,), is the prior
    precision: that of the yield pressures as stated.
    """

    free: tuple[FreeParameter, ...]
    each: Floats
    prior: Floats

    def covariance(self, counts: Floats) -> Floats:
        """Covariance of the free parameters after these numbers of trials. Returns scaled as in the fit; infinite on
        the whole diagonal where the information is singular. Shapes: counts (n_conditions,) → (n_free, n_free).
        """
        total = np.tensordot(counts, self.each, axes=1) + np.diag(self.prior)
        scale = 1 / np.sqrt(np.maximum(np.diag(total), 1e-300))
        even = total * scale[:, None] * scale
        values, vectors = np.linalg.eigh(even)
        if values[0] < 1e-12:
            return np.diag(np.full(len(total), math.inf))
        return np.asarray((vectors / values) @ vectors.T * scale[:, None] * scale)

    def errors(self, counts: Floats) -> tuple[float, dict[str, float]]:
        """Standard errors of n (absolute) and of B by vine (relative). Returns n (absolute standard error of n; 0 where
        n is not free), B (relative standard error of B by vine). Shapes: counts (n_conditions,).
        """
        diagonal = np.sqrt(np.diag(self.covariance(counts)))
        n = next(
            (number.scale * float(diagonal[k]) for k, number in enumerate(self.free) if number.key == EXPONENT), 0.0
        )
        B = {number.vine: float(diagonal[k]) for k, number in enumerate(self.free) if number.key == DAMPING}
        return n, B


def joint_model(vine_inputs: Sequence[PredictiveInputs]) -> Model:
    """Return one model with the median B of each vine and everything else shared."""
    first = vine_inputs[0].model
    B: Value = {inputs.trial.vine: inputs.medians[DAMPING] for inputs in vine_inputs}
    return first.with_values({DAMPING: B})


def filmed(model: Model, trials: Sequence[Trial], camera: FilmingPlan) -> list[FitTrial | None]:
    """Return the data of each trial as a fit would get them, without noise; None where it is too slow or too fast."""
    frame_s = float(1 / camera.capture_fps)
    ends = simulate_many(model, trials, [np.array([0.0, camera.longest_s])] * len(trials))
    data: list[FitTrial | None] = []
    times: list[Floats] = []
    until = [end.end_time_s if end.status == "ended" else 0.0 for end in ends]
    for end in until:
        frames = np.arange(-REST_FRAMES, max(int(end * camera.capture_fps), 1), dtype=float)
        times.append((frames + 1 - RELEASE_FRACTION) * frame_s)
    moved = simulate_many(model, trials, times)
    for trial, trajectory, end in zip(trials, moved, until, strict=True):
        keep = trajectory.lead_position_m < END_FRACTION * trial.length_m
        if end == 0.0 or np.count_nonzero(keep & (trajectory.lead_position_m > 0)) < FEWEST_GROWTH_FRAMES:
            data.append(None)
            continue
        count = int(np.count_nonzero(keep))
        data.append(
            FitTrial(
                trial=trial,
                time_s=trajectory.time_s[keep],
                lead_position_m=trajectory.observed_position_m[keep],
                first=np.arange(count) == 0,
                n_rest=REST_FRAMES,
                noise_m=camera.noise_m,
                correlation=camera.noise_correlation,
            )
        )
    return data


def final_lead_speeds(model: Model, trials: Sequence[Trial], longest_s: float) -> Floats:
    """Return the speed of the leading edge at 0.95 of the length, m/s; 0 where it does not get there. Shape
    (n_trials,).
    """
    times = [np.linspace(0.0, 1.0, 4000) ** 2 * longest_s] * len(trials)
    moved = simulate_many(model, trials, times)
    return np.array(
        [
            np.nan_to_num(
                lead_velocity_at(
                    trajectory.lead_position_m, trajectory.lead_velocity_m_s, END_FRACTION * trial.length_m
                )
            )
            for trial, trajectory in zip(trials, moved, strict=True)
        ]
    )


def information(
    model: Model, data: Sequence[FitTrial], camera: FilmingPlan, spreads: tuple[float, float]
) -> Information:
    """Return the information of one trial of each condition, trial effects integrated out."""
    layout = make_layout(model, data)
    predictor = Predictor(layout, data)
    trial_effects = np.zeros((len(data), N_TRIAL_EFFECTS))
    theta = layout.start
    predictor.linearise(theta, trial_effects)  # the first call adapts the steps of the finite differences
    columns = predictor.linearise(theta, trial_effects)
    cross_products = all_products(columns, [trial_data.first for trial_data in data])
    problem = make_problem(predictor, trial_effects)
    variance = np.full(len(data), camera.noise_m**2 * (1 - camera.noise_correlation**2))
    state = FitState(theta, trial_effects, spreads, camera.noise_correlation, variance)
    return _information(layout, problem, state, cross_products)


def _information(layout: ParameterMap, problem: MixedProblem, state: FitState, cross_products: Floats) -> Information:
    left, _ = deviations_eliminated(marginal(cross_products, problem, state), problem, state.spread)
    count = len(layout.free)
    each = np.zeros((len(left), count + 1, count + 1))
    for k, block in enumerate(left):
        each[np.ix_([k], problem.index[k], problem.index[k])] += block[None, :-1, :-1]
    return Information(layout.free, each[:, :count, :count], layout.prior_precision)


STEADY_FRACTION = 0.97  # Fraction of the speed of Eq. (chosen)


def reaches_steady(model: Model, trials: Sequence[Trial], longest_s: float) -> np.ndarray:
    """Return which vines without payload come to within 3 % of their steady speed before the end. Shape (n_trials,)."""
    times = [np.linspace(0.0, longest_s, 2000)] * len(trials)
    reached = []
    for trial, moved in zip(trials, simulate_many(model, trials, times), strict=True):
        inside = moved.lead_position_m < 0.95 * trial.length_m
        highest = trial.travel_ratio * float(np.max(moved.lead_velocity_m_s[inside]))
        reached.append(trial.payload_kg == 0 and highest > STEADY_FRACTION * steady_speed(model, trial))
    return np.array(reached)


def steady_speed(model: Model, trial: Trial) -> float:
    """Return the tail speed of Eq. (3) of Alvarez et al. (2025), ((P − P_y)A/B)^(1/n), m/s."""
    values = dict(zip(model.parameter_names, model.parameters_of(trial).tolist(), strict=True))
    force_N = max(trial.pressure_Pa - trial.yield_pressure_Pa, 0.0) * trial.area_m2
    return float((force_N / values[DAMPING]) ** (1 / values[EXPONENT]))


def steady_error(
    model: Model, trials: Sequence[Trial], counts: Floats, spreads: tuple[float, float], steady: np.ndarray
) -> float:
    """Return the standard error of n from the steady trials alone; infinite where they do not determine it. Weighted
    least squares of ln F = ln B_v + n ln ẋ_ss with one error of the yield pressure for each vine. Shapes: counts,
    steady (n_trials,).
    """
    vines = list(dict.fromkeys(trial.vine for trial in trials))
    size = 1 + 2 * len(vines)
    total = np.zeros((size, size))
    for trial, count, is_steady in zip(trials, counts.tolist(), steady.tolist(), strict=True):
        if not is_steady or count == 0:
            continue
        drive = trial.pressure_Pa - trial.yield_pressure_Pa
        scatter = math.hypot(spreads[1], spreads[0] * trial.pressure_Pa / drive)
        row = np.zeros(size)
        row[0] = math.log(steady_speed(model, trial))
        row[1 + vines.index(trial.vine)] = 1.0
        row[1 + len(vines) + vines.index(trial.vine)] = trial.yield_pressure_sigma_Pa / drive
        total += count * np.outer(row, row) / max(scatter, 1e-6) ** 2
    has_information = np.diag(total) > 0
    if not has_information[0]:
        return math.inf
    # Errors of yield pressures are in units of their stated standard error, so their prior precision is 1.
    total[np.arange(1 + len(vines), size), np.arange(1 + len(vines), size)] += 1.0
    determined = np.flatnonzero(has_information)
    information_matrix = total[np.ix_(determined, determined)]
    if np.linalg.cond(information_matrix) > 1e12:
        return math.inf
    return math.sqrt(float(np.linalg.inv(information_matrix)[0, 0]))
