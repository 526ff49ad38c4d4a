"""Memory of a search over hypotheses about many trials: curves of fits that no longer compete are dropped.

The curves of a fit to a thousand trials of 550 frames take some sixty megabytes, its misfit tests 700, and a search
makes dozens of fits. Numbers, likelihood and state of a fit always stay; its curves are computed again from them where
a later step needs them.
"""

from __future__ import annotations

from collections.abc import MutableMapping
from dataclasses import replace
from typing import TypeVar

from vinetrack.diagnosis.likelihood_ratio import ANSWER_SET_DELTA_CHI2, MAX_INFLATION, LikelihoodRatio
from vinetrack.inference.assemble import assemble
from vinetrack.inference.fit_result import Fit
from vinetrack.inference.sensitivity import Predictor

MANY_POINTS = 150_000  # Points of all trials from which curves are dropped (chosen)

# Fits, the likeliest of a search, and misfit tests, the last made, that are kept whole (chosen)
MAX_WHOLE_FITS, MAX_WHOLE_TESTS = 8, 1

Key = TypeVar("Key")


def is_large(fit: Fit) -> bool:
    """Whether a fit has so many points that the fits of other hypotheses cannot all be kept whole."""
    return sum(trial_data.time_s.size for trial_data in fit.predictor.data) > MANY_POINTS


def drop_curves(fitted: MutableMapping[Key, LikelihoodRatio]) -> None:
    """Drop the curves of hypotheses that can no longer enter an answer set."""
    ranked = sorted(fitted.items(), key=lambda entry: -entry[1].fit.log_likelihood)
    for key, hypothesis in ranked[MAX_WHOLE_FITS:]:
        fit = hypothesis.fit
        deviance_excess = 2 * (ranked[0][1].fit.log_likelihood - fit.log_likelihood)
        if fit.trials and deviance_excess > ANSWER_SET_DELTA_CHI2 * MAX_INFLATION and is_large(fit):
            fitted[key] = replace(hypothesis, fit=without_curves(fit))


def without_curves(fit: Fit) -> Fit:
    """Return a fit without its curves: its numbers, its state and the residuals of each trial."""
    residuals = tuple(columns[:, -1:].copy() for columns in fit.solution.columns)
    return replace(fit, trials=(), solution=replace(fit.solution, columns=residuals))


def with_curves(fit: Fit) -> Fit:
    """Return a fit with its curves, computed again where they were dropped."""
    if fit.trials:
        return fit
    former, state = fit.predictor, fit.solution.state
    predictor = Predictor(former.layout, former.data, former.host)
    predictor.steps, predictor.pressure_step = former.steps.copy(), former.pressure_step.copy()
    columns = predictor.linearise(state.theta, state.trial_effects)
    # Cross products stay those of the fit, whose columns were computed with other steps.
    solution = replace(fit.solution, columns=tuple(columns))
    trials = assemble(former, solution, fit.left_out, fit.options, profile=False).trials
    return replace(fit, trials=trials, solution=solution)
