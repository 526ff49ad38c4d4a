"""The rule that a tail cannot push, as a hypothesis: the same model with `tail_slack: free`.

Eq. (2) holds while the tail's tension T₁ = ½(P − P_y)A − ½Bẋⁿ − … is positive. It becomes negative where a payload
falls faster than the tip everts: the real tail goes slack there, but the model predicts that it pushes. The rule has no
parameter, so that any rise of the likelihood is due to it alone.
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

# Stands for the rule in answer sets
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

# Compression of the tail, as a fraction of the drive ½PA, from which the rule is tried (chosen)
MIN_PUSH_FRACTION = 0.02

# Rise of −2 ln L per point, on one trial of every condition, from which the rule is refuted without a full fit where
# trials scatter much (derived)
REFUTED_DEVIANCE_PER_POINT = 1.0


def pushes(fit: Fit) -> bool:
    """Whether the fitted model predicts compression in the tail of any trial that is not allowed to go slack."""
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
    fitted_trial = replace(trial.trial, pressure_Pa=trial.trial.pressure_Pa * (1 + trial.pressure_deviation))
    try:
        terms = evaluate(fit.model, fitted_trial, since_s, position_m, velocity_m_s, measured_Pa=measured_Pa)
    except EffectError:
        return False
    ratio = trial.trial.travel_ratio
    damping_N = terms.tip_N.get("eversion_damping", np.zeros_like(since_s))
    tension_N = terms.tension_N + trial.damping_deviation * damping_N / ratio
    return bool(np.any(tension_N < -MIN_PUSH_FRACTION * terms.pressure_Pa * terms.area_m2 / ratio))


def slack_fit(fit: Fit) -> LikelihoodRatio | None:
    """Refit the model with tails that may go slack; None where no tail pushes or the fit fails. Trial effects may have
    absorbed the misfit until no tail pushes. Where trials scatter much, the rule is therefore also tried from other
    exponents, without the fitted deviations, on one trial of every condition first.
    """
    taut = any(trial.trial.tail_slack != "free" and trial.trial.travel_ratio != 1 for trial in fit.trials)
    scattered = taut and has_excess_scatter(fit)
    if not scattered and not pushes(fit):
        return None
    data = [
        replace(trial_data, trial=replace(trial_data.trial, tail_slack="free")) for trial_data in fit.predictor.data
    ]
    slack = replace(fit, predictor=Predictor(fit.predictor.layout, data))
    subset_fit = None
    if scattered:
        fitter = SubsetFitter(slack)
        subset_fit = best_subset_fit(fitter, exponent_starts(slack), math.inf)
        allowed_rise = REFUTED_DEVIANCE_PER_POINT * fitter.n_points
        if subset_fit is not None and subset_fit.deviance > SubsetFitter(fit).null_deviance() + allowed_rise:
            return None
    fits = []
    with contextlib.suppress(FitError, SimulationError, np.linalg.LinAlgError):
        fits.append(refit(slack, thorough=False))
    if subset_fit is not None:
        fits += [other for other in (full_fit(slack, subset_fit, reset=True),) if other is not None]
    if not fits:
        return None
    after = max(fits, key=lambda known: known.log_likelihood)
    return likelihood_ratio(fit, (TAIL_SLACK,), after)
