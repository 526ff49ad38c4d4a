"""The catalogue of physical and measurement effects, one file each.

`vinetrack.effects.gravity` is the effect of that name; `catalogue()` all of them; `load_effect(path)` one of a user's
own, `own_effects(paths)` all of them, tried out.
"""

from __future__ import annotations

from vinetrack.core.units import BASE_EFFECTS
from vinetrack.effects._base import HOOKS, REFERENCE_TRIAL, Effect, Parameter, State, TrialInputs, Worked
from vinetrack.effects._catalogue import EffectError, catalogue, find_effect, load_effect, own_effects, remember

__all__ = [
    "BASE_EFFECTS",
    "HOOKS",
    "REFERENCE_TRIAL",
    "Effect",
    "EffectError",
    "Parameter",
    "State",
    "TrialInputs",
    "Worked",
    "catalogue",
    "find_effect",
    "load_effect",
    "own_effects",
    "remember",
]


def __getattr__(name: str) -> Effect:
    if name.startswith("_"):
        raise AttributeError(name)
    try:
        return catalogue()[name]
    except KeyError:
        raise AttributeError(f"there is no effect named {name!r}") from None
