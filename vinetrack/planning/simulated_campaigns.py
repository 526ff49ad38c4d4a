"""Simulated campaigns of planned trials, with scatter, noise and misread yield pressures.

Every trial has its own pressure and B, every vine a misread yield pressure, release falls between frames and positions
are noisy. The true model may have an effect that the fitted one lacks: that is how the power of a campaign is checked.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from vinetrack.core.records import Floats, Track, Trial, plain_track
from vinetrack.dynamics.model import Model
from vinetrack.dynamics.simulate import SimulationError, simulate_many
from vinetrack.inference.fit_data import FitTrial
from vinetrack.inference.fit_result import DAMPING, ParameterMap
from vinetrack.inference.optimiser import FixedTerms, Solution, make_problem, solve
from vinetrack.inference.sensitivity import Predictor, align, initial_trial_effects
from vinetrack.planning.discriminating_design import Hypothesis, film_trials
from vinetrack.tracks.position_noise import ar1_noise


@dataclass(frozen=True)
class FilmingPlan:
    """How a trial is filmed: frames per second, noise of a position, m, and its lag-one correlation. A recording ends
    with the growth, at twice `longest_s` where the growth does not end, and at the latest `stops_s` after release.
    `slow_error_m` is the slow error that its tracker states, NaN for positions measured elsewhere; `has_trace` says
    whether its pressure is measured.
    """

    capture_fps: float
    noise_m: float
    noise_correlation: float = 0.0
    longest_s: float = 4.0
    stops_s: float = math.inf
    slow_error_m: float = math.nan
    has_trace: bool = False


def make(
    model: Model,
    trials: Sequence[Trial],
    cameras: Sequence[FilmingPlan],
    spreads: tuple[float, float],
    draw: np.random.Generator,
    host: Model | None = None,
) -> list[tuple[Trial, Track]]:
    """Simulate one campaign: its trials as the sheet states them, and their tracks. The camera counts as calibrated:
    positions have no systematic error unless the sheet states one.
    """
    rest_frames = 20  # Frames at rest before release (chosen)
    count = len(trials)
    pressure_factors = 1 + spreads[0] * draw.standard_normal(count)
    misread = {vine: draw.standard_normal() for vine in dict.fromkeys(trial.vine for trial in trials)}
    true_trials = [
        replace(
            trial,
            pressure_Pa=trial.pressure_Pa * float(factor),
            yield_pressure_Pa=max(trial.yield_pressure_Pa + trial.yield_pressure_sigma_Pa * misread[trial.vine], 0.0),
        )
        for trial, factor in zip(trials, pressure_factors, strict=True)
    ]
    theta = np.array([model.parameters_of(trial) for trial in trials])
    theta[:, model.parameter_names.index(DAMPING)] *= np.exp(spreads[1] * draw.standard_normal(count))
    until_longest = [np.array([0.0, 2 * camera.longest_s]) for camera in cameras]
    ends = simulate_many(model, true_trials, until_longest, parameters=theta, host=host)
    release_frames = rest_frames - draw.uniform(size=count)
    times, since_release = [], []
    for end, camera, release in zip(ends, cameras, release_frames.tolist(), strict=True):
        stop_s = min(end.end_time_s if end.status == "ended" else 2 * camera.longest_s, camera.stops_s)
        times.append(np.arange(rest_frames + int(stop_s * camera.capture_fps)) / camera.capture_fps)
        since_release.append(times[-1] - release / camera.capture_fps)
    moved = simulate_many(model, true_trials, since_release, parameters=theta, host=host)
    pairs = []
    for trial, time_s, trajectory, camera in zip(trials, times, moved, cameras, strict=True):
        noise_m = ar1_noise(time_s.size, camera.noise_m, camera.noise_correlation, draw)
        position_m = trajectory.observed_position_m + noise_m + draw.uniform(-0.05, 0.05)
        pressure_Pa = np.full(time_s.size, trial.pressure_Pa) if camera.has_trace else None
        track = plain_track(time_s, position_m, pressure_Pa=pressure_Pa)
        systematic_m = trial.position_systematic_m if math.isfinite(trial.position_systematic_m) else 0.0
        pairs.append(
            (
                replace(trial, position_systematic_m=systematic_m),
                replace(track, lead_position_systematic_m=np.full(time_s.size, camera.slow_error_m)),
            )
        )
    return pairs


# ------------------------------------------------------------------------------
# Separation by further trials, found by simulating them and refitting the hypotheses to old and new trials.
#
# Each hypothesis in turn is taken as the truth. The new trials are simulated with deviations of pressure and B,
# releases, origins and noise, and sampled as the experiment films. Every hypothesis is then fitted to all trials;
# between-trial standard deviations and noise are estimated anew as in a diagnosis, so a wrong hypothesis can explain
# part of its misfit as scatter. The squared separation is the increase in the difference of −2 ln L.
#
# There are two levels of detail. The quick one sets the truth to the best values and treats the old trials as linear in
# the parameters, which is fast enough to compare designs. The thorough one draws the truth from its distribution given
# the old trials and simulates every trajectory anew, as a check.


class PartlyLinear(Predictor):
    """Predictor that simulates new trials and treats the old ones as linear, with the sensitivities of their fit."""

    separable = False

    def __init__(self, layout: ParameterMap, old: Predictor, solution: Solution, new: Sequence[FitTrial]) -> None:
        super().__init__(layout, [*old.data, *new], old.host)
        self.n_old, self.expansion_point, self.old_columns = len(old.data), solution.state, solution.columns
        new_layout = replace(layout, index=layout.index[self.n_old :], base=layout.base[self.n_old :])
        self.new = Predictor(new_layout, new, old.host)
        self.new.steps = old.steps.copy()

    def linearise(
        self, theta: Floats, trial_effects: Floats, *, trial_effects_only: bool = False, past_end: bool = False
    ) -> list[Floats]:
        """Sensitivities and residuals, as `Predictor.linearise`; the sensitivities of the old trials are constant.
        Shapes: theta (n_free,); trial_effects (n_trials, N_TRIAL_EFFECTS) → (n_points, n_columns + 1).
        """
        residuals = self.residuals_of_old(theta, trial_effects)
        columns = [np.column_stack([of_fit[:, :-1], r]) for of_fit, r in zip(self.old_columns, residuals, strict=True)]
        return columns + self.new.linearise(
            theta, trial_effects[self.n_old :], trial_effects_only=trial_effects_only, past_end=past_end
        )

    def residuals_of_each(self, theta: Floats, effect_sets: Sequence[Floats]) -> list[list[Floats]]:
        """Measured minus predicted positions of all trials, m, for several sets of trial effects. Shapes: theta
        (n_free,); effect_sets (n_trials, N_TRIAL_EFFECTS) → (n_points,).
        """
        return [
            self.residuals_of_old(theta, trial_effects) + self.new.residuals(theta, trial_effects[self.n_old :])
            for trial_effects in effect_sets
        ]

    def residuals_of_old(self, theta: Floats, trial_effects: Floats) -> list[Floats]:
        """Measured minus predicted positions of the old trials, m, to first order. Shapes: theta (n_free,);
        trial_effects (n_trials, N_TRIAL_EFFECTS) → (n_points,).
        """
        at = self.expansion_point
        change = np.append(theta[: at.theta.size] - at.theta, np.zeros(theta.size - at.theta.size + 1))
        steps = np.hstack([trial_effects[: self.n_old] - at.trial_effects, change[self.layout.index[: self.n_old]]])
        return [of_fit[:, -1] - of_fit[:, :-1] @ step for of_fit, step in zip(self.old_columns, steps, strict=True)]


def simulated_rises(
    hypotheses: Sequence[Hypothesis], design: Sequence[int], draws: Sequence[int], seed: int, *, thorough: bool = False
) -> Floats:
    """Return the rise of −2 ln L of every (true, refitted) pair; NaN where a refit fails. The truth is at its best
    values and the deviations of the trials are plus or minus one standard deviation in turn, so that few draws show the
    average. If `thorough`, both are random and every trajectory is simulated: only where the pressure was recorded do
    the old trials stay linear, for to simulate those takes a hundred times as long. Shape (n_draws, n, n).
    """
    n = len(hypotheses)
    # Deviations of pressure and B in standard deviations, balanced over replicates (derived)
    alternating = np.array([[1.0, 1.0], [-1.0, -1.0], [1.0, -1.0], [-1.0, 1.0]])
    rises = np.full((len(draws), n, n), math.nan)
    before = np.array([-2 * hypothesis.fit.log_likelihood for hypothesis in hypotheses])
    for k, a in np.ndindex(len(draws), n):
        rng = np.random.default_rng([seed, int(thorough), draws[k], a])
        truth = hypotheses[a]
        theta = draw_parameters(truth, rng) if thorough else truth.theta
        in_turn = alternating[(np.arange(len(design)) + draws[k]) % 4]
        deviations = rng.standard_normal((len(design), 2)) if thorough else in_turn
        try:
            filmed = film_trials(truth, design, theta, deviations * truth.fit.solution.state.spread, rng)
        except SimulationError:
            continue
        new = [(place, trial_data) for place, trial_data in zip(design, filmed, strict=True) if trial_data is not None]
        if new:
            after = np.array([_refitted(hypothesis, new, thorough=thorough) for hypothesis in hypotheses])
            rises[k, a] = after - before - (after[a] - before[a])
    return rises


def draw_parameters(hypothesis: Hypothesis, rng: np.random.Generator) -> Floats:
    """Draw true parameters from their distribution given the trials so far; those of new vines from their prior.
    Returns free parameters, scaled, within their bounds. Shape (n_free,).
    """
    furthest_draw = 2.0  # Standard deviations at which draws are clipped: the linearised fit holds no further (chosen)
    old = hypothesis.fit.predictor.layout.start.size
    values, vectors = np.linalg.eigh(hypothesis.levels.information[0, :old, :old])
    is_determined = values > 1e-9 * values[-1]
    sd = np.where(is_determined, 1 / np.sqrt(np.where(is_determined, values, 1.0)), 0.0)
    normal = np.clip(rng.standard_normal(old), -furthest_draw, furthest_draw)
    of_new = rng.standard_normal(hypothesis.sd_of_new.size) * hypothesis.sd_of_new
    down, up = hypothesis.room
    return np.asarray(hypothesis.theta + np.clip(np.concatenate([vectors @ (sd * normal), of_new]), down, up))


def _refitted(hypothesis: Hypothesis, new: Sequence[tuple[int, FitTrial]], *, thorough: bool) -> float:
    """−2 ln L of a hypothesis fitted to old and new trials; NaN where the fit fails."""
    most = 20  # Iterations of a refit, at most (chosen)
    places, data = [place for place, _ in new], [trial_data for _, trial_data in new]
    layout, old = _extended_layout(hypothesis, places), hypothesis.fit.solution
    quick = PartlyLinear(layout, hypothesis.fit.predictor, old, data)
    try:
        # New releases are aligned, and the noise of the new trials is that of the old.
        theta = layout.start
        theta[: old.state.theta.size] = old.state.theta
        aligned, _ = align(data, quick.new, theta, initial_trial_effects(data))
        state = replace(
            old.state,
            theta=theta,
            trial_effects=np.concatenate([old.state.trial_effects, aligned]),
            variance=np.concatenate([old.state.variance, np.full(len(data), hypothesis.variance)]),
        )
        problem, before = make_problem(quick, state.trial_effects), old.problem.release_origin_mean
        means = np.concatenate([before, problem.release_origin_mean[len(before) :]])
        problem = replace(problem, release_origin_mean=means)
        # Scatter and noise are fixed at first, lest misfit that the parameters have yet to remove be taken as scatter.
        fixed = FixedTerms(state.spread, (state.rho, state.variance))
        solution = solve(quick, problem, state, fixed, warm=True, most_iterations=most)
        whole: Predictor = quick
        if thorough and all(trial_data.trace is None for trial_data in quick.data[: quick.n_old]):
            whole = Predictor(layout, quick.data, quick.host)
            whole.steps = quick.new.steps.copy()
        solution = solve(whole, problem, solution.state, warm=True, most_iterations=most)
    except SimulationError:
        return math.nan
    return -2 * solution.log_likelihood()


def _extended_layout(hypothesis: Hypothesis, places: Sequence[int]) -> ParameterMap:
    """Parameter map of old and new trials; of the new parameters only those that the new trials depend on are free."""
    before, wide = hypothesis.fit.predictor.layout, hypothesis.layout
    old = len(before.free)
    needed = np.unique(wide.index[list(places)])
    used = [*range(old), *needed[needed >= old].tolist()]
    order = {place: k for k, place in enumerate(used)} | {-1: -1}
    index = np.vectorize(order.__getitem__, otypes=[int])(wide.index[list(places)])
    return ParameterMap(
        wide.model,
        tuple(wide.free[k] for k in used),
        wide.keys,
        np.concatenate([before.index, index]),
        np.concatenate([before.base, wide.base[list(places)]]),
    )
