"""The summary of a fit that `fit.json` stores: all quoted results, without the data and state behind them.

`summary_of` makes it from a fit in memory and `FitSummary.from_json` from a file, so that the
keys of the file are defined here alone.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Annotated, Any

import numpy as np
from pydantic import BeforeValidator, Field, PlainSerializer, PlainValidator

from vinetrack.core.problems import Remark, remark
from vinetrack.core.records import Floats
from vinetrack.core.tables import JsonRecord
from vinetrack.dynamics.model import Value, values_by_key
from vinetrack.inference.errors import robust_variances, trial_information, with_systematics
from vinetrack.inference.fit_result import (
    BetweenTrialSpread,
    Fit,
    Number,
    NumberTable,
    OrNaN,
    TrialEstimates,
    numbers_text,
)
from vinetrack.inference.systematics import FILM_ERROR, systematics_of

# ------------------------------------------------------------------------------
# Sensitivity of fitted numbers to the mass of the film.
#
# The mass of the film is computed from its thickness and density, which no sheet states to better than a few per
# cent. It is not part of the stated errors, because it can be weighed and is then negligible. In a campaign of two
# dozen precise trials it may exceed all stated errors, and the fit then says so.


def film_influence(fit: Fit) -> Floats:
    """Standard deviation of each fitted number due to an unknown film mass, independent by 2 % for each vine.

    Parameters
    ----------
    fit : Fit

    Returns
    -------
    array, shape (n_numbers,)
        In the units of `fit.numbers`, SI. Zeros if the fit estimates the mass of the film, or it has no influence.

    Examples
    --------
    >>> import vinetrack as vt
    >>> fit = vt.fit(vt.base_model(), vt.example_tracks())
    >>> vt.film_influence(fit).shape
    (3,)
    """
    if "film_mass" in fit.model:
        return np.zeros(len(fit.numbers))
    errors = systematics_of(fit.predictor, fit.solution, ["film"])
    solution = with_systematics(fit.predictor, fit.solution).solution
    plain = robust_variances(fit.predictor, solution)[0]
    products = fit.predictor.products(errors.beside(solution.columns))
    both = replace(solution, problem=errors.among(solution.problem), cross_products=products)
    moved = (plain @ trial_information(both)[0].sum(axis=0)[: len(plain), len(plain) :])[: len(fit.numbers)]
    free = fit.predictor.layout.free
    slopes = np.array([each.derivative(number.value) for each, number in zip(free, fit.numbers, strict=True)])
    return np.asarray(np.sqrt(np.sum(moved**2, axis=1)) * slopes)


def film_messages(numbers: Sequence[Number], moved: Floats) -> tuple[Remark, ...]:
    """A message on the film mass where it matters as much as the stated errors, else none. Shapes: moved
    (n_numbers,).
    """
    sigma = np.array([number.sigma for number in numbers])
    ratio = np.divide(moved, sigma, out=np.zeros_like(moved), where=np.isfinite(sigma) & (sigma > 0))
    affected = [k for k in np.argsort(-ratio, kind="stable").tolist() if ratio[k] >= 1]
    shown = [(numbers[k], moved[k], *numbers[k].shown) for k in affected]
    changes = [(number.title, factor * size, unit) for number, size, unit, factor in shown]
    return (remark("film_matters", error=FILM_ERROR, changes=changes),) if affected else ()


def _array(content: Any) -> Floats:
    """An array of a JSON file, where null means that a number is not known."""
    return np.array(content if content is not None else (), dtype=float)


Stored = Annotated[Floats, PlainValidator(_array), PlainSerializer(lambda array: array)]


@dataclass(frozen=True, repr=False)
class FitSummary(NumberTable, JsonRecord):
    """The quoted results of a fit: see `vinetrack.inference.fit_result.Fit` for the meaning of each field. `names` are
    those of the effects; `covariance` is that of `numbers`, SI, in their order; `warnings` are those of the audit.
    `refused` is the reason why the model was not fitted, blank if it was: everything else is empty then.
    """

    names: Annotated[tuple[str, ...], Field(alias="model")] = ()
    refused: Annotated[
        str, BeforeValidator(lambda reason: reason or ""), PlainSerializer(lambda text: text or None)
    ] = ""
    numbers: tuple[Number, ...] = ()
    covariance: Stored = field(default_factory=lambda: np.empty((0, 0)))
    moved_by_film: Stored = field(default_factory=lambda: np.empty(0))
    spreads: Mapping[str, BetweenTrialSpread] = field(default_factory=dict)
    noise_m: OrNaN = math.nan
    noise_correlation: OrNaN = math.nan
    chi2_per_dof: OrNaN = math.nan
    log_likelihood: OrNaN = math.nan
    converged: bool = False
    messages: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    left_out: Mapping[str, str] = field(default_factory=dict)
    trials: Mapping[str, TrialEstimates] = field(default_factory=dict)

    @property
    def fitted_values(self) -> dict[str, Value]:
        """Fitted values by `effect.parameter`, SI, as `Model.with_values` takes them."""
        return values_by_key((number.key, number.vine, number.value) for number in self.numbers)

    def to_json(self) -> dict[str, Any]:
        """As `fit.json` holds it, SI; a refused fit has its model and the reason alone."""
        content = super().to_json()
        return {key: content[key] for key in ("model", "refused")} if self.refused else content

    def __repr__(self) -> str:
        state = "refused" if self.refused else f"{len(self.trials)} trials"
        return f"FitSummary({' + '.join(self.names)}; {state})"

    def __str__(self) -> str:
        if self.refused:
            return f"{' + '.join(self.names)} was not fitted: {self.refused}"
        return "\n".join([self.heading, *numbers_text(self)])


# ------------------------------------------------------------------------------
# The summary of a fit in memory, in the form in which `fit.json` stores it.


def summary_of(fit: Fit, warnings: Sequence[str] = (), further_messages: Sequence[str] = ()) -> FitSummary:
    """The summary of a fit."""
    keys = [entry.name for entry in fields(TrialEstimates)]
    moved = film_influence(fit)
    same = "numbers covariance spreads noise_m noise_correlation chi2_per_dof log_likelihood converged left_out"
    return FitSummary(
        **{name: getattr(fit, name) for name in same.split()},
        names=tuple(fit.model.names),
        moved_by_film=moved,
        messages=tuple(map(str, (*fit.messages, *film_messages(fit.numbers, moved), *further_messages))),
        warnings=tuple(warnings),
        trials={trial.name: TrialEstimates(*(getattr(trial, key) for key in keys)) for trial in fit.trials},
    )
