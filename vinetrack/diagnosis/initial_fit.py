"""The fit of the initial model, which `fit.json` holds and the diagnosis questions: both make it alike.

It is compiled with all that the diagnosis may ask about, so what is asked about (`candidates_of`) stands here.

A model far off its data has several minima a little apart. Begun, compiled or iterated differently, two fits of it
would end at numbers that differ in the third digit, and every page would show both.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

from vinetrack.dynamics.model import Model
from vinetrack.effects import Effect, catalogue, find_effect, load_effect
from vinetrack.inference.fit import fit
from vinetrack.inference.fit_data import Pairs
from vinetrack.inference.fit_result import Fit
from vinetrack.inference.sensitivity import Predictor

PROBE_FILE = Path(__file__).with_name("probes") / "probe_force.py"


def candidates_of(
    model: Model, wanted: Iterable[str] | None, user_effects: Mapping[str, Effect] | None = None
) -> tuple[Effect, ...]:
    """Effects to question: those `wanted` (default the catalogue) and the user's own, less what is in the model.

    Parameters
    ----------
    model
        The model that is questioned.
    wanted : iterable of str or None
        Names of effects; the catalogue where None.
    user_effects : mapping, optional
        Effects of the user by name.

    Returns
    -------
    tuple of Effect

    Raises
    ------
    EffectError
        If a name is unknown; the message suggests the nearest.
    """
    user_effects = user_effects or {}
    names = [name for name, effect in catalogue().items() if effect.kind != "base"] if wanted is None else list(wanted)
    names += [name for name in user_effects if name not in names]
    replaced = {name for effect in model for name in effect.replaces}
    return tuple(find_effect(name, user_effects) for name in names if name not in model and name not in replaced)


@lru_cache(maxsize=1)
def probe() -> Effect:
    """The probe force, see its file."""
    return load_effect(PROBE_FILE)


def host_for(model: Model, candidates: Iterable[Effect] = ()) -> Model:
    """One model that holds all that may be asked for, so that one compiled form serves every hypothesis.

    Parameters
    ----------
    model
        The model that is questioned.
    candidates : iterable of Effect

    Returns
    -------
    Model
    """
    held = {effect.name: effect for effect in (*catalogue().values(), probe(), *model, *candidates)}
    return Model(tuple(held[name] for name in held))


def with_host(fit: Fit, host: Model | None) -> Fit:
    """A fit whose trajectories come from the kernel of a larger model from here on.

    Parameters
    ----------
    fit
        A fitted model.
    host : Model or None
        Holds the effects of the model, and others that may be asked for.

    Returns
    -------
    Fit
    """
    predictor = Predictor(fit.predictor.layout, fit.predictor.data, host)
    # Copies: the predictor adapts its steps in place, and the caller's fit must stay as it is.
    predictor.steps = fit.predictor.steps.copy()
    predictor.pressure_step = fit.predictor.pressure_step.copy()
    return replace(fit, predictor=predictor)


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
