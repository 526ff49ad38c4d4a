"""Fits to part of the trials of a fit, begun where that one ended.

Leaving out a condition, or looking at one vine or pressure alone, is the same model on fewer data: nothing is read,
prepared or compiled anew. Numbers that none of the trials kept feels (B of a vine that is gone) drop out.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from vinetrack.core.records import Floats
from vinetrack.dynamics.simulate import SimulationError
from vinetrack.inference.assemble import assemble
from vinetrack.inference.fit_data import FitError
from vinetrack.inference.fit_result import Fit
from vinetrack.inference.mixed_effects import FitState, MixedProblem
from vinetrack.inference.optimiser import MOST_ITERATIONS, FixedTerms, solve
from vinetrack.inference.parameters import ParameterMap
from vinetrack.inference.sensitivity import Predictor

Indices = NDArray[np.int_]


def fit_subset(
    fit: Fit,
    keep: Iterable[str] | Sequence[bool] | NDArray[np.bool_],
    *,
    held: Iterable[str] = (),
    hold_spreads: bool = False,
    hold_noise: bool = False,
    most_iterations: int = MOST_ITERATIONS,
) -> Fit:
    """Fit the same model to some of the trials, from where a fit ended.

    Parameters
    ----------
    fit : the fit to all trials.
    keep : iterable of str, or mask
        Names of trials, or a mask over `fit.trials`.
    held : iterable of str
        Names of numbers (`Number.name`) or of parameters (`effect.parameter`) that stay at their values.
    hold_spreads, hold_noise : bool
        Whether spreads and noise stay those of `fit`.
    most_iterations : int
        Steps at most.

    Returns
    -------
    Fit

    Raises
    ------
    FitError
        If no trial is kept, one is unknown, or the model cannot be followed.
    """
    rows = _rows(fit, keep)
    places = _numbers_felt(fit.predictor.layout, rows)
    predictor = _subset_predictor(fit.predictor, rows, places)
    state = _subset_state(fit.state, rows, places)
    problem = _subset_frame(fit.solution.problem, predictor.layout, rows, places)
    names = set(held)
    free = [not names & {number.name, number.key} for number in predictor.layout.free]
    problem = replace(problem, free=problem.free & np.array(free, dtype=bool))
    # The numbers of a fit include what smooth errors of position moved them by; its state does not.
    reported = {number.name: number.value for number in fit.numbers}
    stays = [
        number.inside(reported[number.name]) if not moves and number.name in reported else theta
        for number, moves, theta in zip(predictor.layout.free, free, state.theta, strict=True)
    ]
    state = replace(state, theta=np.array(stays, dtype=float))
    told = _told(fit, rows)
    told = FixedTerms(
        state.spread if hold_spreads else told.spread, (state.rho, state.variance) if hold_noise else told.noise
    )
    try:
        solution = solve(predictor, problem, state, told, warm=True, most_iterations=most_iterations)
    except SimulationError as error:
        raise FitError(f"The model cannot be followed on part of the trials: {error}") from error
    return assemble(predictor, solution, fit.left_out, {**fit.options, "held": told}, profile=False)


def _rows(fit: Fit, keep: Iterable[str] | Sequence[bool] | NDArray[np.bool_]) -> Indices:
    """Places of the trials kept, in the order of the fit."""
    wanted = list(keep)
    names = [trial.name for trial in fit.trials]
    if wanted and all(isinstance(entry, (bool, np.bool_)) for entry in wanted):
        if len(wanted) != len(names):
            raise FitError(f"The mask has {len(wanted)} entries for {len(names)} trials.")
        rows = np.flatnonzero(wanted)
    else:
        unknown = sorted(set(map(str, wanted)) - set(names))
        if unknown:
            raise FitError(f"The fit has no trial {', '.join(unknown)}.")
        rows = np.array([i for i, name in enumerate(names) if name in set(wanted)], dtype=int)
    if not rows.size:
        raise FitError("No trial is left to fit: keep one at least.")
    return rows


def _numbers_felt(layout: ParameterMap, rows: Indices) -> Indices:
    """Places of the free numbers that some of these trials feel, in their order."""
    felt = np.unique(layout.index[rows])
    return np.asarray(felt[felt >= 0])


def _subset_layout(layout: ParameterMap, rows: Indices, places: Indices) -> ParameterMap:
    """The layout of these trials with these numbers; names, scales and priors stay."""
    moved = np.full(len(layout.free) + 1, -1)
    moved[places] = np.arange(places.size)
    index = moved[layout.index[rows]]
    columns = np.flatnonzero((index >= 0).any(axis=0))
    return replace(
        layout,
        free=tuple(layout.free[place] for place in places),
        keys=tuple(layout.keys[column] for column in columns),
        index=index[:, columns].astype(int),
        base=layout.base[rows],
        between=tuple(
            replace(term, groups=tuple(term.groups[row] for row in rows), regressor=term.regressor[rows])
            for term in layout.between
        ),
    )


def _subset_predictor(predictor: Predictor, rows: Indices, places: Indices) -> Predictor:
    """A predictor of these trials, with the steps that the other has found for its differences."""
    layout = _subset_layout(predictor.layout, rows, places)
    smaller = Predictor(layout, [predictor.data[row] for row in rows], predictor.host)
    smaller.pressure_step = predictor.pressure_step[rows].copy()
    smaller.steps = np.array([predictor.steps[predictor.layout.keys.index(key)] for key in layout.keys])
    return smaller


def _subset_state(state: FitState, rows: Indices, places: Indices) -> FitState:
    """The state of these trials and numbers."""
    return replace(
        state, theta=state.theta[places], trial_effects=state.trial_effects[rows], variance=state.variance[rows]
    )


def _subset_frame(problem: MixedProblem, layout: ParameterMap, rows: Indices, places: Indices) -> MixedProblem:
    """The frame of these trials and numbers; `layout` is theirs already."""

    def numbers(values: Floats) -> Floats:
        return values[places]

    return replace(
        problem,
        index=layout.index,
        feels=problem.feels[rows],
        gauge_error=problem.gauge_error[rows],
        own_centre=problem.own_centre[rows],
        own_precision=problem.own_precision[rows],
        prior_mean=numbers(problem.prior_mean),
        prior_precision=numbers(problem.prior_precision),
        lower=numbers(problem.lower),
        upper=numbers(problem.upper),
        free=problem.free[places],
        points=problem.points[rows],
        stretches=problem.stretches[rows],
        random=None if problem.random is None else problem.random[places],
    )


def _told(fit: Fit, rows: Indices) -> FixedTerms:
    """What the user told the fit, for these trials."""
    told: FixedTerms = fit.options.get("held", FixedTerms())
    if told.noise is None:
        return told
    rho, variance = told.noise
    return replace(told, noise=(rho, variance[rows]))
