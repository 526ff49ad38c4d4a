"""Fits to a subset of the trials of a fit, starting from its solution.

Leaving out a condition, or fitting one vine or pressure alone, uses the same model on fewer data: nothing is read,
prepared or compiled again. Parameters that apply to none of the remaining trials (B of a vine that is left out) are
dropped.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from vinetrack.dynamics.simulate import SimulationError
from vinetrack.inference.assemble import assemble
from vinetrack.inference.fit_data import FitError
from vinetrack.inference.fit_result import Fit
from vinetrack.inference.optimiser import MOST_ITERATIONS, FixedTerms, solve
from vinetrack.inference.part_of_trials import (
    Indices,
    parameters_of_trials,
    subset_predictor,
    subset_problem,
    subset_state,
)


def fit_subset(
    fit: Fit,
    keep: Iterable[str] | Sequence[bool] | NDArray[np.bool_],
    *,
    held: Iterable[str] = (),
    hold_spreads: bool = False,
    hold_noise: bool = False,
    most_iterations: int = MOST_ITERATIONS,
) -> Fit:
    """Fit the same model to some of the trials of a fit, starting from its solution."""
    rows = _rows(fit, keep)
    places = parameters_of_trials(fit.predictor.layout, rows)
    predictor = subset_predictor(fit.predictor, rows, places)
    state = subset_state(fit.state, rows, places)
    problem = subset_problem(fit.solution.problem, predictor.layout, rows, places)
    names = set(held)
    free = [not names & {number.name, number.key} for number in predictor.layout.free]
    problem = replace(problem, free=problem.free & np.array(free, dtype=bool))
    # The numbers of a fit include their change by smooth errors of position; its state does not.
    reported = {number.name: number.value for number in fit.numbers}
    theta_with_fixed = [
        number.to_scaled(reported[number.name]) if not is_free and number.name in reported else theta
        for number, is_free, theta in zip(predictor.layout.free, free, state.theta, strict=True)
    ]
    state = replace(state, theta=np.array(theta_with_fixed, dtype=float))
    fixed_terms = _fixed_terms_of(fit, rows)
    fixed_terms = FixedTerms(
        state.spread if hold_spreads else fixed_terms.spread,
        (state.rho, state.variance) if hold_noise else fixed_terms.noise,
    )
    try:
        solution = solve(predictor, problem, state, fixed_terms, warm=True, most_iterations=most_iterations)
    except SimulationError as error:
        raise FitError(f"The model cannot be simulated for these trials: {error}") from error
    return assemble(predictor, solution, fit.left_out, {**fit.options, "held": fixed_terms}, profile=False)


def _rows(fit: Fit, keep: Iterable[str] | Sequence[bool] | NDArray[np.bool_]) -> Indices:
    """Indices of the trials to keep, in the order of the fit."""
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


def _fixed_terms_of(fit: Fit, rows: Indices) -> FixedTerms:
    """The variance components that the user fixed, for these trials."""
    fixed_terms: FixedTerms = fit.options.get("held", FixedTerms())
    if fixed_terms.noise is None:
        return fixed_terms
    rho, variance = fixed_terms.noise
    return replace(fixed_terms, noise=(rho, variance[rows]))
