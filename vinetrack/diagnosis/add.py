"""One effect added to the model by hand: both models are fitted, and compared on conditions that were left out."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from vinetrack.core.records import Track
from vinetrack.diagnosis.candidates import shapes_of
from vinetrack.diagnosis.initial_fit import candidates_of, initial_fit
from vinetrack.diagnosis.misfit_tests import FAR_OFF_CHI2_PER_DOF
from vinetrack.diagnosis.multi_start import (
    SubsetFitter,
    best_subset_fit,
    full_fit,
    restart_exponents,
    restart_without,
    start_values,
)
from vinetrack.diagnosis.selection import MAX_RESTARTS, MIN_LOG_LIKELIHOOD_GAIN
from vinetrack.dynamics.model import make_model
from vinetrack.dynamics.trial_inputs import check_needs
from vinetrack.effects import Effect, EffectError, find_effect
from vinetrack.inference.fit import refit
from vinetrack.inference.fit_data import FitError, pairs_of
from vinetrack.inference.fit_result import Fit

if TYPE_CHECKING:
    import pandas as pd

    from vinetrack.experiment.folder import Experiment


def add(
    experiment: Experiment, tracks: Mapping[str, Track], name: str, report: Callable[[str], None]
) -> tuple[Fit, Fit, pd.DataFrame]:
    """Fit the model in use without and with an effect, and work out the ladder of both. Returns before, after, table
    (the ladder of errors, one row for each model).
    """
    from vinetrack.diagnosis.ladder import ladder
    from vinetrack.effects import own_effects

    user_effects = own_effects([experiment.folder / path for path in experiment.settings.effects])
    model = make_model(experiment.settings.model, user_effects)
    if name.endswith(".py"):
        user_effects = {**own_effects([name]), **user_effects}
    effect = find_effect(Path(name).stem, user_effects)
    if effect.name in model:
        raise EffectError(f"{effect.name} is in the model already: {' + '.join(model.names)}.")
    check_needs(model + effect, *(trial for trial in experiment.trials if trial.name in tracks))
    report("fitting the model as it is")
    candidates = candidates_of(model, experiment.settings.candidates, user_effects)
    if effect not in candidates:
        candidates = (*candidates, effect)
    before = initial_fit(model, pairs_of(experiment, tracks)[0], candidates, profile=False)
    before, after = both_fits(before, effect, report)
    report("errors before and after")
    return before, after, ladder((before, after), ("", effect.name))


def both_fits(before: Fit, effect: Effect, report: Callable[[str], None]) -> tuple[Fit, Fit]:
    """Fit a model without and with an effect, each from its best minimum, as the diagnosis does. Returns before, after
    : Fit.
    """
    if before.chi2_per_dof > FAR_OFF_CHI2_PER_DOF:
        before = restart_exponents(before)
    for _ in range(1 + MAX_RESTARTS):
        report(f"fitting it with {effect.name}")
        after = _fit_with(before, effect)
        refitted = restart_without(before, after)
        if refitted.log_likelihood <= before.log_likelihood + MIN_LOG_LIKELIHOOD_GAIN:
            break
        before = refitted
    return before, after


def _fit_with(before: Fit, effect: Effect) -> Fit:
    """Fit a model with an effect added, from several starts."""
    fitter = SubsetFitter(before)
    starts = [((effect,), start_values(shape, shape.step * 10)) for shape in shapes_of(effect)]
    subset_fit = best_subset_fit(fitter, starts, float("inf"))
    after = full_fit(before, subset_fit) if subset_fit is not None else None
    if after is None:
        raise FitError(f"The model with {effect.name} cannot be simulated from any start.")
    if after.log_likelihood < before.log_likelihood:
        from_before = refit(before, before.model + effect)
        after = max((after, from_before), key=lambda fit: fit.log_likelihood)
    return after
