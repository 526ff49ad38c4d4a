"""The fit of the initial model, made identically for `fit.json` and for the diagnosis.

A model that is far off has several minima close together. Started, compiled or iterated differently, two fits of it
would end at parameters that differ in the third digit, and every page would show both. The model is therefore compiled
together with all candidates of the diagnosis (`candidates_of`) in either case.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace

from vinetrack.dynamics.host import host_for
from vinetrack.dynamics.model import Model
from vinetrack.effects import Effect, catalogue, find_effect
from vinetrack.inference.fit import fit
from vinetrack.inference.fit_data import Pairs
from vinetrack.inference.fit_result import Fit
from vinetrack.inference.sensitivity import Predictor


def candidates_of(
    model: Model, wanted: Iterable[str] | None, user_effects: Mapping[str, Effect] | None = None
) -> tuple[Effect, ...]:
    """Candidates of a diagnosis: the `wanted` effects and the user's own, less those in the model."""
    user_effects = user_effects or {}
    names = [name for name, effect in catalogue().items() if effect.kind != "base"] if wanted is None else list(wanted)
    names += [name for name in user_effects if name not in names]
    replaced = {name for effect in model for name in effect.replaces}
    return tuple(find_effect(name, user_effects) for name in names if name not in model and name not in replaced)


def with_host(fit: Fit, host: Model | None) -> Fit:
    """Return a fit whose trajectories are simulated by the compiled form of a larger model."""
    predictor = Predictor(fit.predictor.layout, fit.predictor.data, host)
    # Copies: the predictor adapts its steps in place, and the caller's fit must stay as it is.
    predictor.steps = fit.predictor.steps.copy()
    predictor.pressure_step = fit.predictor.pressure_step.copy()
    return replace(fit, predictor=predictor)


def initial_fit(
    model: Model, pairs: Pairs, candidates: Iterable[Effect], *, profile: bool = True, free: Iterable[str] = ()
) -> Fit:
    """Fit the model in use, as the diagnosis does."""
    return fit(model, pairs, free=free, host=host_for(model, tuple(candidates)), profile=profile, thorough=False)
