"""What a fit leaves, linear in a missing force about one place: where every search for that force begins."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vinetrack.core.records import Floats
from vinetrack.diagnosis.cubic_splines import splines
from vinetrack.diagnosis.force_inversion import ForceFit, Gain
from vinetrack.diagnosis.force_sensitivities import FittedMotion, force_sensitivities, motions_of
from vinetrack.diagnosis.per_trial_estimates import lay
from vinetrack.diagnosis.stretches import courses_of, replicate_scatter
from vinetrack.dynamics.simulate import SimulationError
from vinetrack.inference.fit_data import FitError
from vinetrack.inference.fit_result import Fit

PIECES, EARLY = 15, (0.01, 0.03, 0.06)
"""Smooth pieces of a force along the growth of one condition; and further knots in the first tenth of it. Chosen:
finer than any force that leaves a trace of its own in positions."""


@dataclass(frozen=True)
class LinearMisfit:
    """The trials about one place: their motions, what smooth pieces of force do to them, and what all pieces explain.

    `longest` is the largest lead position of each condition, m; `pieces` has an array of every trial, shape
    (frames, PIECES), of positions per newton; `everything` is the gain of all pieces in every condition.
    """

    fit: ForceFit
    motions: list[FittedMotion]
    longest: dict[str, float]
    pieces: list[Floats]
    everything: Gain


def linear_misfit(model_fit: Fit) -> LinearMisfit:
    """Lay the trials out about the fit or about the estimates of single trials, whichever leaves less unexplained.

    Parameters
    ----------
    model_fit : the fit that is questioned.

    Returns
    -------
    LinearMisfit

    Raises
    ------
    FitError
        If the model cannot be followed.
    """
    try:
        scatter = replicate_scatter(model_fit, courses_of(model_fit)[0])
        begins = [model_fit.solution.state.trial_effects, lay(model_fit).trial_effects]
        tried = [_about(model_fit, ForceFit(model_fit, trial_effects, scatter)) for trial_effects in begins]
    except SimulationError as error:
        raise FitError(f"The model cannot be followed: {error}") from error
    return min(tried, key=lambda linear: linear.fit.chi2 - linear.everything.chi2)


def pieces_along(part: Floats) -> Floats:
    """Smooth pieces of a force along the growth: narrower at the start, where speed rises.

    Parameters
    ----------
    part : array, shape (n,)
        Lead positions as parts of the largest of their condition.

    Returns
    -------
    array, shape (n, PIECES)
        Each piece at each place, 1.
    """
    return splines(part, np.concatenate([[0.0, *EARLY], np.linspace(0.0, 1.0, PIECES - 2 - len(EARLY))[1:]]))


def _about(model_fit: Fit, fit: ForceFit) -> LinearMisfit:
    motions = motions_of(model_fit, fit.trial_effects)
    # A vine that stands still by its model is at the start of its growth throughout.
    longest = {motion.trial.condition: float(np.finfo(float).tiny) for motion in motions}
    for motion in motions:
        longest[motion.trial.condition] = max(longest[motion.trial.condition], float(motion.lead_position_m.max()))
    pieces = force_sensitivities(
        model_fit, fit.trial_effects, motions, lambda m: pieces_along(m.lead_position_m / longest[m.trial.condition])
    )
    return LinearMisfit(fit, motions, longest, pieces, fit.by_condition(pieces))
