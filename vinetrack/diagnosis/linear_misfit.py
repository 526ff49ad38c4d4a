"""The misfit of a fit, linearised in a missing force: the starting point of every search for that force."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vinetrack.core.records import Floats
from vinetrack.diagnosis.cubic_splines import splines
from vinetrack.diagnosis.force_inversion import ForceEstimate, LinearInversion
from vinetrack.diagnosis.force_sensitivities import FittedMotion, force_sensitivities, motions_of
from vinetrack.diagnosis.per_trial_estimates import align_trials
from vinetrack.diagnosis.stretches import replicate_scatter, residual_courses
from vinetrack.dynamics.simulate import SimulationError
from vinetrack.inference.fit_data import FitError
from vinetrack.inference.fit_result import Fit

# Splines of a force along the growth of one condition, and the extra knots in the first tenth of it (chosen)
N_SPLINES, EARLY_KNOTS = 15, (0.01, 0.03, 0.06)


@dataclass(frozen=True)
class LinearMisfit:
    """A fit linearised about one set of trial effects, and a smooth force estimated in every condition."""

    inversion: LinearInversion
    motions: list[FittedMotion]
    longest: dict[str, float]
    sensitivities: list[Floats]
    smooth_force: ForceEstimate


def linear_misfit(fit: Fit) -> LinearMisfit:
    """Linearise about the trial effects of the fit or about those estimated trial by trial. Of the two, the one is
    taken whose misfit a smooth force in every condition explains further.
    """
    try:
        scatter = replicate_scatter(fit, residual_courses(fit)[0])
        starts = [fit.solution.state.trial_effects, align_trials(fit).trial_effects]
        linearised = [_linearised(fit, LinearInversion(fit, trial_effects, scatter)) for trial_effects in starts]
    except SimulationError as error:
        raise FitError(f"The model cannot be simulated: {error}") from error
    return min(linearised, key=lambda each: each.inversion.chi2_without_force - each.smooth_force.delta_chi2)


def growth_splines(part: Floats) -> Floats:
    """Splines of a force along the growth, narrower at the start, where the vine accelerates. Shapes: part (n,) → (n,
    N_SPLINES).
    """
    uniform_knots = np.linspace(0.0, 1.0, N_SPLINES - 2 - len(EARLY_KNOTS))[1:]
    return splines(part, np.concatenate([[0.0, *EARLY_KNOTS], uniform_knots]))


def _linearised(fit: Fit, inversion: LinearInversion) -> LinearMisfit:
    motions = motions_of(fit, inversion.trial_effects)
    # In a condition where the model predicts no motion, every position is at the start of growth.
    longest = {motion.trial.condition: float(np.finfo(float).tiny) for motion in motions}
    for motion in motions:
        longest[motion.trial.condition] = max(longest[motion.trial.condition], float(motion.lead_position_m.max()))
    sensitivities = force_sensitivities(
        fit, inversion.trial_effects, motions, lambda m: growth_splines(m.lead_position_m / longest[m.trial.condition])
    )
    return LinearMisfit(inversion, motions, longest, sensitivities, inversion.estimate_by_condition(sensitivities))
