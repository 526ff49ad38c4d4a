"""The rule that a tail cannot push, as a hypothesis: the same model with `tail_slack: free`.

Eq. (2) holds while the tail's tension T₁ = ½(P − P_y)A − ½Bẋⁿ − … is positive. A payload that falls faster than the tip
everts makes it negative: then the true tail goes slack, and the model as written pushes. The rule brings no number to
fit, so that a likelihood which rises by it is no matter of taste.
"""

from __future__ import annotations

import contextlib
import math
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType

import numpy as np

from vinetrack.diagnosis.likelihood_ratio import LikelihoodRatio, likelihood_ratio
from vinetrack.diagnosis.multi_start import SubsetFitter, best_subset_fit, exponent_starts, full_fit
from vinetrack.diagnosis.trial_effect_tests import has_excess_scatter
from vinetrack.dynamics.force_terms import evaluate
from vinetrack.dynamics.simulate import SimulationError
from vinetrack.effects import Effect, EffectError
from vinetrack.inference.fit import refit
from vinetrack.inference.fit_data import FitError
from vinetrack.inference.fit_result import Fit, TrialFit
from vinetrack.inference.sensitivity import Predictor

TAIL_SLACK = Effect(
    name="tail_slack",
    kind="physical",
    summary="Tail slack: a tail cannot push.",
    text="Tail slack: a tail cannot push.\n\n    tension ≥ 0\n\nReduce it with a lighter payload or a higher pressure.",
    parameters=(),
    functions=MappingProxyType({}),
    needs=(),
    easily_taken_for=(),
    worked=(),
    path=Path(__file__).resolve(),
)
"""Stands for the rule in answer sets. It is no term of a model: `tail_slack: free` in `experiment.yaml` turns it on."""

MIN_PUSH_FRACTION = 0.02
"""Part of the drive ½PA by which a tail must push to count. Chosen: the numbers of a fit are good to about 1 %; at half
of it their errors ask for a fit in vain, at twice a push of 4 % of the drive goes untried."""

REFUTED_DEVIANCE_PER_POINT = 1.0
"""By how much −2 ln L of a point rises on one trial of every condition where the rule is refuted without a refit, of
trials that scatter much. Derived: −2 ln L of n points with noise s is n ln s², so their misfit is √e times as large.
Measured: with hidden effects (tuning seeds 702, 703, 706) it rises by 6,500 to 20,000 in all, more than this a point;
of vines that went slack with payloads of 15 to 60 g it falls. Not asked where trials scatter little: with 200 g, which
a fit cannot bend away, it rose by 0.7 a point in one campaign of two. At half that one would be refuted if its trials
scattered, at twice hardly any refit is spared."""


def pushes(fit: Fit) -> bool:
    """Whether the fitted model has the tail of some trial push, where the trial does not let it go slack.

    Parameters
    ----------
    fit
        A fitted model.

    Returns
    -------
    bool
    """
    return any(_pushes(fit, trial) for trial in fit.trials)


def _pushes(fit: Fit, trial: TrialFit) -> bool:
    if trial.trial.tail_slack == "free" or trial.trial.travel_ratio == 1:
        return False
    moving = trial.time_s > trial.release_s
    if not moving.any():
        return False
    since_s = trial.time_s[moving] - trial.release_s
    trace = next(trial_data.trace for trial_data in fit.predictor.data if trial_data.trial is trial.trial)
    measured_Pa = None if trace is None else np.interp(trial.time_s[moving], *trace)
    position_m = trial.predicted_position_m[moving] - trial.origin_m
    velocity_m_s = trial.predicted_velocity_m_s[moving]
    pressed = replace(trial.trial, pressure_Pa=trial.trial.pressure_Pa * (1 + trial.pressure_deviation))
    try:
        terms = evaluate(fit.model, pressed, since_s, position_m, velocity_m_s, measured_Pa=measured_Pa)
    except EffectError:
        return False
    ratio = trial.trial.travel_ratio
    damping_N = terms.tip_N.get("eversion_damping", np.zeros_like(since_s))
    tension_N = terms.tension_N + trial.damping_deviation * damping_N / ratio
    return bool(np.any(tension_N < -MIN_PUSH_FRACTION * terms.pressure_Pa * terms.area_m2 / ratio))


def slack_fit(fit: Fit) -> LikelihoodRatio | None:
    """The model refitted with tails that may go slack; None where no tail pushes or the fit does not get through.

    A fit that has bent its trials to do without the rule may have bent them until no tail pushes. So where they scatter
    much the rule is also tried from other exponents, with nothing of the deviations, on one trial of every condition
    first: where it fits those far worse (REFUTED_DEVIANCE_PER_POINT), nothing is fitted to all trials.

    The model is compiled alone: with all candidates and tails that may go slack that takes the better part of a minute,
    for a rule that is mostly refuted.

    Parameters
    ----------
    fit : the fit that is questioned.

    Returns
    -------
    LikelihoodRatio or None
    """
    taut = any(trial.trial.tail_slack != "free" and trial.trial.travel_ratio != 1 for trial in fit.trials)
    bent = taut and has_excess_scatter(fit)
    if not bent and not pushes(fit):
        return None
    data = [
        replace(trial_data, trial=replace(trial_data.trial, tail_slack="free")) for trial_data in fit.predictor.data
    ]
    slack = replace(fit, predictor=Predictor(fit.predictor.layout, data))
    climb = None
    if bent:
        slope = SubsetFitter(slack)
        climb = best_subset_fit(slope, exponent_starts(slack), math.inf)
        if (
            climb is not None
            and climb.deviance > SubsetFitter(fit).null_deviance() + REFUTED_DEVIANCE_PER_POINT * slope.n_points
        ):
            return None
    fits = []
    with contextlib.suppress(FitError, SimulationError, np.linalg.LinAlgError):
        fits.append(refit(slack, thorough=False))
    if climb is not None:
        fits += [other for other in (full_fit(slack, climb, afresh=True),) if other is not None]
    if not fits:
        return None
    after = max(fits, key=lambda known: known.log_likelihood)
    return likelihood_ratio(fit, (TAIL_SLACK,), after)
