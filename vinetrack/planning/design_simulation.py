"""What further trials would bring: they are simulated, and the hypotheses refitted to the old trials and the new ones.

Each hypothesis in turn is taken for the truth. The new trials are grown with deviations of pressure and B, releases,
origins and noise of their own and filmed as the experiment films; then every hypothesis is fitted to all trials,
spreads and noise estimated again as a diagnosis would: a wrong hypothesis passes part of its misfit off as scatter.
What −2 ln L then differs by, more than it does now, is the separation squared.

Two depths. `expected` holds the truth at the best values and lets the old trials answer linearly to a change of the
numbers: quick enough to compare designs. `observed` draws the truth from what the old trials leave open, and simulates
every trajectory anew: it is the check.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from vinetrack.core.records import Floats
from vinetrack.dynamics.simulate import SimulationError
from vinetrack.inference.assemble import log_likelihood
from vinetrack.inference.fit_data import FitTrial
from vinetrack.inference.fit_problem import make_problem
from vinetrack.inference.mixed_effects import FitState
from vinetrack.inference.optimiser import FixedTerms, Solution, solve
from vinetrack.inference.parameters import ParameterMap
from vinetrack.inference.sensitivity import Predictor
from vinetrack.inference.starts import align, initial_trial_effects
from vinetrack.planning.feasible_trials import Condition
from vinetrack.planning.hypothesis_predictions import Hypothesis
from vinetrack.planning.simulated_tracks import TrackSampling, film

MOST_ITERATIONS = 20
"""Chosen for time: refits start from a fit and end within ten. At half some are cut short, at twice only time is
spent."""

FURTHEST_DRAW = 2.0
"""Standard deviations by which a number that is taken for true may lie from its best value: beyond, what is linear
about a fit is not to be trusted. Chosen: 5 % of draws are cut. At half the scatter of the truth is too small, at twice
one draw in thousands leaves the range where a linear answer holds."""


class PartlyLinear(Predictor):
    """Simulates new trials; the old ones answer by the sensitivities that their fit ended with."""

    separable = False

    def __init__(self, layout: ParameterMap, old: Predictor, solution: Solution, new: Sequence[FitTrial]) -> None:
        super().__init__(layout, [*old.data, *new], old.host)
        self.old, self.at, self.known = len(old.data), solution.state, solution.columns
        new_layout = replace(layout, index=layout.index[self.old :], base=layout.base[self.old :])
        self.new = Predictor(new_layout, new, old.host)
        self.new.steps = old.steps.copy()

    def linearise(
        self, theta: Floats, trial_effects: Floats, *, trial_effects_only: bool = False, past_end: bool = False
    ) -> list[Floats]:
        """Residuals and sensitivities, as `Predictor.linearise`; those of the old trials with constant sensitivities.

        Parameters
        ----------
        theta : array, shape (n_free,)
            Free numbers, scaled.
        trial_effects : array, shape (n_trials, N_TRIAL_EFFECTS)
            Release, origin and deviations of each trial.
        trial_effects_only : bool
            Sensitivities of the new trials to trial effects alone.
        past_end : bool
            Run trajectories of the new trials on past the end of growth.

        Returns
        -------
        list of arrays, shape (n_points, n_columns + 1)
            One a trial; the last column is the residual, m.
        """
        moved = self.residuals_of_old(theta, trial_effects)
        columns = [np.column_stack([known[:, :-1], r]) for known, r in zip(self.known, moved, strict=True)]
        return columns + self.new.linearise(
            theta, trial_effects[self.old :], trial_effects_only=trial_effects_only, past_end=past_end
        )

    def residuals(self, theta: Floats, trial_effects: Floats) -> list[Floats]:
        """Measured minus predicted positions of all trials, m.

        Parameters
        ----------
        theta : array, shape (n_free,)
            Free numbers, scaled.
        trial_effects : array, shape (n_trials, N_TRIAL_EFFECTS)
            Release, origin and deviations of each trial.

        Returns
        -------
        list of arrays, shape (n_points,)
        """
        return self.residuals_of_old(theta, trial_effects) + self.new.residuals(theta, trial_effects[self.old :])

    def residuals_of_each(self, theta: Floats, ways: Sequence[Floats]) -> list[list[Floats]]:
        """`residuals` for several sets of the trials' own numbers.

        Parameters
        ----------
        theta : array, shape (n_free,)
            Free numbers, scaled.
        ways : sequence of arrays, shape (n_trials, N_TRIAL_EFFECTS)

        Returns
        -------
        list of lists of arrays, shape (n_points,)
            One list a way.
        """
        return [self.residuals(theta, way) for way in ways]

    def residuals_of_old(self, theta: Floats, trial_effects: Floats) -> list[Floats]:
        """Measured minus predicted position of the old trials, m, as far as they answer linearly.

        Parameters
        ----------
        theta : array, shape (n_free,)
            Free numbers, scaled.
        trial_effects : array, shape (n_trials, N_TRIAL_EFFECTS)
            Release, origin and deviations of each trial.

        Returns
        -------
        list of arrays, shape (n_points,)
            One for each old trial.
        """
        change = np.append(theta[: self.at.theta.size] - self.at.theta, np.zeros(theta.size - self.at.theta.size + 1))
        steps = np.hstack([trial_effects[: self.old] - self.at.trial_effects, change[self.layout.index[: self.old]]])
        return [known[:, -1] - known[:, :-1] @ step for known, step in zip(self.known, steps, strict=True)]


@dataclass(frozen=True)
class Bench:
    """What trials are tried out with: the hypotheses, every condition and its camera."""

    hypotheses: Sequence[Hypothesis]
    conditions: Sequence[Condition]
    cameras: Sequence[TrackSampling]


def expected(bench: Bench, design: Sequence[int], draws: Sequence[int], seed: int) -> Floats:
    """Rise of −2 ln L, shape (n_draws, n, n): (true, refitted); NaN where a refit is lost.

    Deviations of the trials are one standard deviation either way, in turns, so that few draws show the average.

    Parameters
    ----------
    bench : hypotheses, conditions, cameras.
    design : sequence of int
        Places among the conditions, one a trial.
    draws : sequence of int
        Numbers of the draws; with `seed` they make the random numbers.
    seed : int

    Returns
    -------
    array, shape (n_draws, n, n)
    """
    return _rises(bench, design, draws, seed, thorough=False)


def observed(bench: Bench, design: Sequence[int], draws: Sequence[int], seed: int) -> Floats:
    """As `expected`, with true numbers and deviations drawn at random and every trajectory simulated in the refits.

    Only where the pressure was measured do the old trials still answer linearly: to follow every wiggle of a trace
    takes a hundred times as long.

    Parameters
    ----------
    bench : hypotheses, conditions, cameras.
    design : sequence of int
        Places among the conditions, one a trial.
    draws : sequence of int
        Numbers of the draws; with `seed` they make the random numbers.
    seed : int

    Returns
    -------
    array, shape (n_draws, n, n)
    """
    return _rises(bench, design, draws, seed, thorough=True)


def _rises(bench: Bench, design: Sequence[int], draws: Sequence[int], seed: int, *, thorough: bool) -> Floats:
    n = len(bench.hypotheses)
    rises = np.full((len(draws), n, n), math.nan)
    now = np.array([-2 * hypothesis.fit.log_likelihood for hypothesis in bench.hypotheses])
    for k, a in np.ndindex(len(draws), n):
        rng = np.random.default_rng([seed, int(thorough), draws[k], a])
        truth = bench.hypotheses[a]
        theta = drawn(truth, rng) if thorough else truth.theta
        signs = rng.standard_normal((len(design), 2)) if thorough else _in_turns(design, draws[k])
        try:
            filmed = film(truth, design, bench.conditions, bench.cameras, theta, signs * truth.spread, rng)
        except SimulationError:
            continue
        seen = [(place, trial_data) for place, trial_data in zip(design, filmed, strict=True) if trial_data is not None]
        if seen:
            then = np.array([_refitted(hypothesis, seen, thorough=thorough) for hypothesis in bench.hypotheses])
            rises[k, a] = then - now - (then[a] - now[a])
    return rises


def _in_turns(design: Sequence[int], draw: int) -> Floats:
    """Deviations of pressure and B in standard deviations, ±1, so that replicates balance, shape (n_trials, 2)."""
    turns = np.array([[1, 1], [-1, -1], [1, -1], [-1, 1]], dtype=float)
    return turns[(np.arange(len(design)) + draw) % 4]


def separation(rises: Floats) -> Floats:
    """σ from rises of −2 ln L, their mean over the draws, shape (n, n): 0 where a wrong hypothesis gains.

    Parameters
    ----------
    rises : array, shape (n_draws, n, n)
        From `expected` or `observed`; NaN is left out.

    Returns
    -------
    array, shape (n, n)
        In standard deviations.
    """
    known = np.isfinite(rises)
    mean = np.where(known, rises, 0.0).sum(axis=0) / np.maximum(known.sum(axis=0), 1)
    return np.asarray(np.sqrt(np.maximum(mean, 0.0)))


def drawn(hypothesis: Hypothesis, rng: np.random.Generator) -> Floats:
    """True numbers as the trials so far leave them open, those of new vines as far as guesses err.

    Parameters
    ----------
    hypothesis : taken for true.
    rng : numpy.random.Generator

    Returns
    -------
    array, shape (n_free,)
        Free numbers, scaled, within their bounds.
    """
    old = hypothesis.fit.predictor.layout.start.size
    values, vectors = np.linalg.eigh(hypothesis.views[0].information[:old, :old])
    known = values > 1e-9 * values[-1]
    scale = np.where(known, 1 / np.sqrt(np.where(known, values, 1.0)), 0.0)
    away = np.clip(rng.standard_normal(old), -FURTHEST_DRAW, FURTHEST_DRAW)
    new = rng.standard_normal(hypothesis.spread_of_new.size) * hypothesis.spread_of_new
    down, up = hypothesis.room
    return np.asarray(hypothesis.theta + np.clip(np.concatenate([vectors @ (scale * away), new]), down, up))


def _refitted(hypothesis: Hypothesis, seen: Sequence[tuple[int, FitTrial]], *, thorough: bool) -> float:
    """−2 ln L of a hypothesis fitted to the trials so far and those seen; NaN where the fit is lost."""
    items = [trial_data for _, trial_data in seen]
    layout, old = _wider_layout(hypothesis, [place for place, _ in seen]), hypothesis.fit.solution
    quick = PartlyLinear(layout, hypothesis.fit.predictor, old, items)
    try:
        state = _wider_state(hypothesis, quick, items)
        problem = make_problem(quick, state.trial_effects)
        problem = replace(
            problem,
            release_origin_mean=np.concatenate(
                [old.problem.release_origin_mean, problem.release_origin_mean[len(old.problem.release_origin_mean) :]]
            ),
        )
        # Spreads and noise stay until the numbers have moved: what is only not yet fitted must not pass for scatter.
        told = FixedTerms(state.spread, (state.rho, state.variance))
        solution = solve(quick, problem, state, told, warm=True, most_iterations=MOST_ITERATIONS)
        whole: Predictor = quick
        if thorough and all(trial_data.trace is None for trial_data in quick.data[: quick.old]):
            whole = Predictor(layout, quick.data, quick.host)
            whole.steps = quick.new.steps.copy()
        solution = solve(whole, problem, solution.state, warm=True, most_iterations=MOST_ITERATIONS)
    except SimulationError:
        return math.nan
    return -2 * log_likelihood(solution)


def _wider_layout(hypothesis: Hypothesis, places: Sequence[int]) -> ParameterMap:
    """The trials so far and new ones, with only those new numbers free that they feel."""
    before, wide = hypothesis.fit.predictor.layout, hypothesis.layout
    old = len(before.free)
    felt = np.unique(wide.index[list(places)])
    used = [*range(old), *felt[felt >= old].tolist()]
    order = {place: k for k, place in enumerate(used)} | {-1: -1}
    index = np.vectorize(order.__getitem__, otypes=[int])(wide.index[list(places)])
    return ParameterMap(
        wide.model,
        tuple(wide.free[k] for k in used),
        wide.keys,
        np.concatenate([before.index, index]),
        np.concatenate([before.base, wide.base[list(places)]]),
    )


def _wider_state(hypothesis: Hypothesis, predictor: PartlyLinear, items: Sequence[FitTrial]) -> FitState:
    """The end of the fit so far, with the new trials' releases looked for and their noise as that of the others."""
    before = hypothesis.fit.solution.state
    theta = predictor.layout.start
    theta[: before.theta.size] = before.theta
    trial_effects, _ = align(predictor.new.data, predictor.new, theta, initial_trial_effects(items))
    variance = np.concatenate([before.variance, np.full(len(items), hypothesis.variance)])
    return replace(
        before, theta=theta, trial_effects=np.concatenate([before.trial_effects, trial_effects]), variance=variance
    )


__all__ = ["Bench", "PartlyLinear", "drawn", "expected", "observed", "separation"]
