"""Memory of a search over hypotheses about many trials: curves of fits that are out of the race are let go.

A fit of a thousand trials of 550 frames holds some sixty megabytes of curves, what it leaves held against every
candidate 700; a search fits dozens. Numbers, likelihood and state of a fit always stay, from which its curves are made
again where a later step asks for them.
"""

from __future__ import annotations

from collections.abc import MutableMapping
from dataclasses import replace
from typing import TypeVar

from vinetrack.diagnosis.likelihood_ratio import ANSWER_SET_DELTA_CHI2, MAX_INFLATION, LikelihoodRatio
from vinetrack.inference.assemble import assemble
from vinetrack.inference.fit_result import Fit
from vinetrack.inference.sensitivity import Predictor

MANY_POINTS = 150_000
"""Points of all trials from which anything is let go. Chosen for memory: 300 trials of 500 frames, of which a fit takes
16 MB; at half smaller campaigns spend time on curves made again, at twice a search over them takes 2 GB. It decides no
number or likelihood of a fit; derivatives made again come of other steps, within the error of the first."""

MAX_WHOLE_FITS, MAX_WHOLE_TESTS = 8, 1
"""Fits, the likeliest of a search, and questioned fits, the last asked, that stay whole. Chosen for memory: what steps
go on from is among the best three; of fits at half curves are made again now and then; each questioned fit more holds
as much as ten fits."""

Key = TypeVar("Key")


def holds_many(fit: Fit) -> bool:
    """Whether a fit has so many points that fits of hypotheses beside it cannot all be held whole.

    Parameters
    ----------
    fit : of the trials in question.

    Returns
    -------
    bool
    """
    return sum(trial_data.time_s.size for trial_data in fit.predictor.data) > MANY_POINTS


def let_go(fitted: MutableMapping[Key, LikelihoodRatio]) -> None:
    """Let go of the curves of hypotheses that cannot come into an answer set any more.

    Parameters
    ----------
    fitted : mapping
        Hypotheses that compete, changed in place.
    """
    ranked = sorted(fitted.items(), key=lambda entry: -entry[1].fit.log_likelihood)
    for key, hypothesis in ranked[MAX_WHOLE_FITS:]:
        fit = hypothesis.fit
        behind = 2 * (ranked[0][1].fit.log_likelihood - fit.log_likelihood)
        if fit.trials and behind > ANSWER_SET_DELTA_CHI2 * MAX_INFLATION and holds_many(fit):
            fitted[key] = replace(hypothesis, fit=without_curves(fit))


def without_curves(fit: Fit) -> Fit:
    """A fit without its curves: its numbers, its state and what it leaves of each trial.

    Parameters
    ----------
    fit : a fit.

    Returns
    -------
    Fit
        `trials` is empty; the columns of its solution are the residuals alone.
    """
    residuals = tuple(columns[:, -1:].copy() for columns in fit.solution.columns)
    return replace(fit, trials=(), solution=replace(fit.solution, columns=residuals))


def with_curves(fit: Fit) -> Fit:
    """The fit, its curves made again where they were let go.

    Parameters
    ----------
    fit : a fit, whole or from `without_curves`.

    Returns
    -------
    Fit

    Raises
    ------
    SimulationError
        If the model cannot be followed.
    """
    if fit.trials:
        return fit
    former, state = fit.predictor, fit.solution.state
    predictor = Predictor(former.layout, former.data, former.host)
    predictor.steps, predictor.pressure_step = former.steps.copy(), former.pressure_step.copy()
    columns = predictor.linearise(state.theta, state.trial_effects)
    # The products are those of the fit, in which columns came of other steps.
    solution = replace(fit.solution, columns=tuple(columns))
    trials = assemble(former, solution, fit.left_out, fit.options, profile=False).trials
    return replace(fit, trials=trials, solution=solution)
