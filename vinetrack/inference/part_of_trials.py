"""The parts of a fit that belong to some of its trials: free numbers, predictor, state, frame."""

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
    """Places of the free numbers that some of these trials feel, in their order.

    Parameters
    ----------
    layout : free numbers of all trials.
    rows : array of int
        Places of the trials.

    Returns
    -------
    array of int
    """
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


def subset_predictor(predictor: Predictor, rows: Indices, places: Indices) -> Predictor:
    """A predictor of these trials, with the steps that the other has found for its differences.

    Parameters
    ----------
    predictor : of all trials.
    rows, places : arrays of int
        Places of the trials, and of the free numbers that they feel.

    Returns
    -------
    Predictor
    """
    layout = _subset_layout(predictor.layout, rows, places)
    smaller = Predictor(layout, [predictor.data[row] for row in rows], predictor.host)
    smaller.pressure_step = predictor.pressure_step[rows].copy()
    smaller.steps = np.array([predictor.steps[predictor.layout.keys.index(key)] for key in layout.keys])
    return smaller


def subset_state(state: FitState, rows: Indices, places: Indices) -> FitState:
    """The state of these trials and numbers.

    Parameters
    ----------
    state : of all trials.
    rows, places : arrays of int
        Places of the trials, and of the free numbers that they feel.

    Returns
    -------
    FitState
    """
    return replace(
        state, theta=state.theta[places], trial_effects=state.trial_effects[rows], variance=state.variance[rows]
    )


def subset_problem(problem: MixedProblem, layout: ParameterMap, rows: Indices, places: Indices) -> MixedProblem:
    """The frame of these trials and numbers; `layout` is theirs already.

    Parameters
    ----------
    problem : of all trials.
    layout : free numbers of these trials.
    rows, places : arrays of int
        Places of the trials, and of the free numbers that they feel.

    Returns
    -------
    MixedProblem
    """

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
