"""The fit of the initial model, which `fit.json` holds and the diagnosis questions: both make it alike.

A model far off its data has several minima a little apart. Begun, compiled or iterated differently, two fits of it
would end at numbers that differ in the third digit, and every page would show both.
"""

from __future__ import annotations

from collections.abc import Iterable

from vinetrack.diagnosis.candidates import host_for
from vinetrack.dynamics.model import Model
from vinetrack.effects import Effect
from vinetrack.inference.fit import fit
from vinetrack.inference.fit_data import Pairs
from vinetrack.inference.fit_result import Fit


def initial_fit(
    model: Model, pairs: Pairs, candidates: Iterable[Effect], *, profile: bool = True, free: Iterable[str] = ()
) -> Fit:
    """Fit the model in use as the diagnosis does.

    Parameters
    ----------
    model
        The model in use.
    pairs
        Trials with their tracks.
    candidates
        Effects that the diagnosis asks about: their compiled form serves this fit too.
    profile
        Whether intervals near a bound are found by profile; values and standard errors do not depend on it.
    free
        Parameters to fit although known beforehand.

    Returns
    -------
    Fit

    Raises
    ------
    FitError
        If there is nothing to fit, or the model cannot be followed.
    """
    return fit(model, pairs, free=free, host=host_for(model, tuple(candidates)), profile=profile, thorough=False)
