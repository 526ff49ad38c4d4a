"""Restriction of a fit to a subset of its trials: free parameters, predictor, state and problem."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from vinetrack.core.records import Floats
from vinetrack.inference.mixed_effects import FitState, MixedProblem
from vinetrack.inference.parameters import ParameterMap
from vinetrack.inference.sensitivity import Predictor

Indices = NDArray[np.int_]


def parameters_of_trials(layout: ParameterMap, rows: Indices) -> Indices:
    """Indices of the free parameters that apply to some of these trials, in order."""
    applicable = np.unique(layout.index[rows])
    return np.asarray(applicable[applicable >= 0])


def _subset_layout(layout: ParameterMap, rows: Indices, places: Indices) -> ParameterMap:
    """The layout of these trials and parameters; names, scales and priors are unchanged."""
    new_index = np.full(len(layout.free) + 1, -1)
    new_index[places] = np.arange(places.size)
    index = new_index[layout.index[rows]]
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


def subset_predictor(predictor: Predictor, rows: Indices, places: Indices) -> Predictor:
    """A predictor of these trials, with the finite-difference steps of the other."""
    layout = _subset_layout(predictor.layout, rows, places)
    smaller = Predictor(layout, [predictor.data[row] for row in rows], predictor.host)
    smaller.pressure_step = predictor.pressure_step[rows].copy()
    smaller.steps = np.array([predictor.steps[predictor.layout.keys.index(key)] for key in layout.keys])
    return smaller


def subset_state(state: FitState, rows: Indices, places: Indices) -> FitState:
    """The state of these trials and parameters."""
    return replace(
        state, theta=state.theta[places], trial_effects=state.trial_effects[rows], variance=state.variance[rows]
    )


def subset_problem(problem: MixedProblem, layout: ParameterMap, rows: Indices, places: Indices) -> MixedProblem:
    """The problem of these trials and parameters."""

    def numbers(values: Floats) -> Floats:
        return values[places]

    return replace(
        problem,
        index=layout.index,
        has_deviation=problem.has_deviation[rows],
        gauge_error=problem.gauge_error[rows],
        release_origin_mean=problem.release_origin_mean[rows],
        release_origin_precision=problem.release_origin_precision[rows],
        prior_mean=numbers(problem.prior_mean),
        prior_precision=numbers(problem.prior_precision),
        lower=numbers(problem.lower),
        upper=numbers(problem.upper),
        free=problem.free[places],
        points=problem.points[rows],
        stretches=problem.stretches[rows],
        random=None if problem.random is None else problem.random[places],
    )
