"""Columns of a fit, of candidates and of systematic errors, and the sums of their products by trial.

In order: a trial's own numbers, the keys of the fit, the residual, shapes of candidates, systematic errors ("doubts").
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from vinetrack.core.records import Floats
from vinetrack.diagnosis.effect_sensitivities import EffectSensitivities
from vinetrack.dynamics.simulate import SimulationError
from vinetrack.inference.fit_data import FitTrial
from vinetrack.inference.fit_result import Fit
from vinetrack.inference.mixed_effects import FitState, MixedProblem, trial_effects_eliminated
from vinetrack.inference.sensitivity import N_TRIAL_EFFECTS
from vinetrack.inference.systematics import Systematics
from vinetrack.inference.whitening import all_products

TRIALS_AT_ONCE = 64
"""Trials whose products of all shapes are held at once, each of half a megabyte. Chosen for memory; no result depends
on it."""


@dataclass(frozen=True)
class Products:
    """Columns of a fit and of answers, shape (n_points, n_columns) a trial, and the sums of their products.

    In order: own numbers, keys, residual, shapes, doubts. Of doubts a trial has those that it feels; `places`, shape
    (n_trials, n_columns), tells which of the `n_doubts` they are, `n_doubts` for none.
    """

    columns: tuple[Floats, ...]
    data: Sequence[FitTrial]
    n_keys: int
    n_shapes: int
    places: NDArray[np.int_]
    n_doubts: int = 0

    @property
    def n_asked(self) -> int:
        """Shapes and doubts of the campaign."""
        return self.n_shapes + self.n_doubts

    @property
    def asked(self) -> NDArray[np.int_]:
        """Place of each trial's shapes and doubts among all of them, shape (n_trials, n_shapes + n_columns).

        `n_asked` where a trial does not feel a doubt.
        """
        shapes = np.tile(np.arange(self.n_shapes), (len(self.columns), 1))
        return np.concatenate([shapes, self.n_shapes + self.places], axis=1)

    @cached_property
    def parts(self) -> list[slice]:
        """The trials in parts whose products are held at once."""
        return [slice(begin, begin + TRIALS_AT_ONCE) for begin in range(0, len(self.columns), TRIALS_AT_ONCE)]

    def cross_products(self, part: slice) -> Floats:
        """Sums of products of a part of the trials, shape (n_trials, 3, n_columns, n_columns), see `whitening`.

        Kept where there is one part; those of more would be three times as large as the columns.

        Parameters
        ----------
        part : one of `parts`.

        Returns
        -------
        array, shape (n_trials, 3, n_columns, n_columns)
        """
        return self._whole if len(self.parts) == 1 else self._of(part)

    def of(self, places: Sequence[int]) -> Products:
        """The same of some of the trials, some of them several times.

        Parameters
        ----------
        places : of the trials, in their new order.

        Returns
        -------
        Products
        """
        columns, data = tuple(self.columns[k] for k in places), [self.data[k] for k in places]
        return replace(self, columns=columns, data=data, places=self.places[list(places)])

    @cached_property
    def _whole(self) -> Floats:
        return self._of(self.parts[0])

    def _of(self, part: slice) -> Floats:
        data = self.data[part]
        first = [trial_data.first for trial_data in data]
        relative = [trial_data.relative_sd for trial_data in data]
        return all_products(self.columns[part], first, relative)


def fit_columns(fit: Fit) -> list[Floats]:
    """Columns of a fit's own numbers and residual, with derivatives as those of the candidates are taken.

    Parameters
    ----------
    fit : the fit that is questioned.

    Returns
    -------
    list of arrays, shape (n_points, 4 + n_keys + 1)
        As `Predictor.linearise`, past the end of growth.
    """
    state = fit.solution.state
    try:
        return fit.predictor.linearise(state.theta, state.trial_effects, past_end=True)
    except SimulationError:
        # A vine that sticks may not be followed a step of another size away: then those that the fit itself ended with.
        return list(fit.solution.columns)


def products_of(
    fit: Fit, columns: Sequence[Floats], answers: EffectSensitivities, systematics: Systematics
) -> Products:
    """All that the tests need the products of.

    The columns of `answers` are views of those made here from then on, so that no trial's are held twice.

    Parameters
    ----------
    fit : the fit that is questioned.
    columns : its own, from `fit_columns`.
    answers : how positions answer to the candidates.
    systematics : Systematics
        What trials err by together.

    Returns
    -------
    Products
    """
    keys, shapes = columns[0].shape[1] - N_TRIAL_EFFECTS - 1, len(answers.shapes)
    of_shapes = slice(N_TRIAL_EFFECTS + keys + 1, N_TRIAL_EFFECTS + keys + 1 + shapes)
    whole: list[Floats] = []
    for i, (of_fit, systematic) in enumerate(zip(columns, systematics.columns, strict=True)):
        whole.append(np.column_stack([of_fit, answers.columns[i], systematic]))
        answers.columns[i] = whole[-1][:, of_shapes]
    return Products(tuple(whole), fit.predictor.data, keys, shapes, systematics.places, systematics.count)


def blocks_of(fit: Fit, sums: Products, state: FitState) -> Floats:
    """Products of keys, residual, shapes and systematic errors of every trial, its own numbers integrated out.

    Parameters
    ----------
    fit : the fit that is questioned.
    sums : from `products_of`.
    state : noise and spreads.

    Returns
    -------
    array, shape (n_trials, n_keys + 1 + n_shapes + n_columns, the same again)
    """
    size = sums.columns[0].shape[1] - N_TRIAL_EFFECTS
    blocks = np.empty((len(sums.columns), size, size))
    for part in sums.parts:
        of_part = _of_trials(fit.solution.problem, state, part)
        blocks[part] = trial_effects_eliminated(sums.cross_products(part), sums.n_keys, *of_part)
    return blocks


def _of_trials(problem: MixedProblem, state: FitState, part: slice) -> tuple[MixedProblem, FitState]:
    """Problem and state of a part of the trials."""
    arrays = (
        "index",
        "has_deviation",
        "gauge_error",
        "release_origin_mean",
        "release_origin_precision",
        "points",
        "stretches",
    )
    return (
        replace(problem, **{name: getattr(problem, name)[part] for name in arrays}),
        replace(state, trial_effects=state.trial_effects[part], variance=state.variance[part]),
    )
