"""The summary of a fit in memory, in the form in which `fit.json` stores it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields

import numpy as np

from vinetrack.inference.film_influence import film_influence, film_messages
from vinetrack.inference.fit_result import Fit
from vinetrack.inference.fit_summary import FitSummary, TrialEstimates


def summary_of(fit: Fit, warnings: Sequence[str] = (), further_messages: Sequence[str] = ()) -> FitSummary:
    """The summary of a fit."""
    keys = [entry.name for entry in fields(TrialEstimates)]
    moved = film_influence(fit)
    return FitSummary(
        names=tuple(fit.model.names),
        numbers=fit.numbers,
        covariance=fit.covariance,
        spreads=fit.spreads,
        noise_m=fit.noise_m,
        noise_correlation=fit.noise_correlation,
        chi2_per_dof=fit.chi2_per_dof,
        log_likelihood=fit.log_likelihood,
        converged=fit.converged,
        messages=(*fit.messages, *film_messages(fit.numbers, moved), *further_messages),
        warnings=tuple(warnings),
        left_out=fit.left_out,
        trials={trial.name: TrialEstimates(*(getattr(trial, key) for key in keys)) for trial in fit.trials},
        between=np.zeros_like(fit.covariance) if fit.between is None else fit.between,
        moved_by_film=moved,
    )
