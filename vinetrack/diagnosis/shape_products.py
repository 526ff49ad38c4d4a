"""Columns of a fit, of candidates and of systematic errors, and their cross products by trial.

In this order: trial effects, parameters of the fit (keys), residual, shapes of candidates, shared systematic errors.
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

TRIALS_AT_ONCE = 64  # Trials whose cross products are held at once, each of half a megabyte (chosen)


@dataclass(frozen=True)
class Products:
    """Columns of a fit, of candidate shapes and of systematic errors, shape (n_points, n_columns) a trial. In this
    order: trial effects, keys, residual, shapes, systematic errors.
    """

    columns: tuple[Floats, ...]
    data: Sequence[FitTrial]
    n_keys: int
    n_shapes: int
    places: NDArray[np.int_]
    n_systematics: int = 0

    @property
    def n_tested(self) -> int:
        """Number of shapes and systematic errors of the campaign."""
        return self.n_shapes + self.n_systematics

    @property
    def tested_indices(self) -> NDArray[np.int_]:
        """Indices of each trial's shapes and systematic errors among all, shape (n_trials, n_shapes + n_affecting).
        `n_tested` for a systematic error that does not affect a trial.
        """
        shapes = np.tile(np.arange(self.n_shapes), (len(self.columns), 1))
        return np.concatenate([shapes, self.n_shapes + self.places], axis=1)

    @cached_property
    def parts(self) -> list[slice]:
        """Slices of the trials whose cross products are held at once."""
        return [slice(begin, begin + TRIALS_AT_ONCE) for begin in range(0, len(self.columns), TRIALS_AT_ONCE)]

    def cross_products(self, part: slice) -> Floats:
        """Cross products of a part of the trials, see `whitening`. They are cached where there is only one part; those
        of several would be three times as large as the columns. Shape (n_trials, 3, n_columns, n_columns).
        """
        return self._all_cross_products if len(self.parts) == 1 else self._cross_products_of(part)

    def of(self, places: Sequence[int]) -> Products:
        """The same for some of the trials, which may be repeated."""
        columns, data = tuple(self.columns[k] for k in places), [self.data[k] for k in places]
        return replace(self, columns=columns, data=data, places=self.places[list(places)])

    @cached_property
    def _all_cross_products(self) -> Floats:
        return self._cross_products_of(self.parts[0])

    def _cross_products_of(self, part: slice) -> Floats:
        data = self.data[part]
        first = [trial_data.first for trial_data in data]
        relative = [trial_data.relative_sd for trial_data in data]
        return all_products(self.columns[part], first, relative)


def fit_columns(fit: Fit) -> list[Floats]:
    """Columns of a fit's trial effects, parameters and residual, with the same derivatives as those of the candidates.
    Shape (n_points, 4 + n_keys + 1).
    """
    state = fit.solution.state
    try:
        return fit.predictor.linearise(state.theta, state.trial_effects, past_end=True)
    except SimulationError:
        # A vine that sticks may fail to simulate with another finite-difference step: use the last columns of the fit.
        return list(fit.solution.columns)


def products_of(
    fit: Fit, columns: Sequence[Floats], sensitivities: EffectSensitivities, systematics: Systematics
) -> Products:
    """Assemble the columns of a fit, of the candidates and of the systematic errors. Afterwards the columns of
    `sensitivities` are views of those made here, so that no trial's are held twice.
    """
    keys, shapes = columns[0].shape[1] - N_TRIAL_EFFECTS - 1, len(sensitivities.shapes)
    of_shapes = slice(N_TRIAL_EFFECTS + keys + 1, N_TRIAL_EFFECTS + keys + 1 + shapes)
    assembled: list[Floats] = []
    for i, (of_fit, systematic) in enumerate(zip(columns, systematics.columns, strict=True)):
        assembled.append(np.column_stack([of_fit, sensitivities.columns[i], systematic]))
        sensitivities.columns[i] = assembled[-1][:, of_shapes]
    return Products(tuple(assembled), fit.predictor.data, keys, shapes, systematics.places, systematics.count)


def products_without_trial_effects(fit: Fit, products: Products, state: FitState) -> Floats:
    """Cross products of keys, residual, shapes and systematic errors of every trial, its trial effects integrated out.
    Shape (n_trials, n_keys + 1 + n_shapes + n_affecting, the same again).
    """
    size = products.columns[0].shape[1] - N_TRIAL_EFFECTS
    blocks = np.empty((len(products.columns), size, size))
    for part in products.parts:
        of_part = _of_trials(fit.solution.problem, state, part)
        blocks[part] = trial_effects_eliminated(products.cross_products(part), products.n_keys, *of_part)
    return blocks


def _of_trials(problem: MixedProblem, state: FitState, part: slice) -> tuple[MixedProblem, FitState]:
    """Problem and state restricted to a part of the trials."""
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
