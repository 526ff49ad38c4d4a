"""One model with the whole catalogue, compiled once for all that is asked of any of its effects.

A model takes seconds to compile, an effect of no size next to nothing to simulate. What compares models therefore
simulates each by the compiled form of one larger model, the host. Wherever no effect of a user's own is involved it is
the same model, so that fits, designs, diagnoses and the explorer share what is compiled. An effect that is switched off
is skipped, so that the trajectories are those of the smaller model to the last bit.
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import lru_cache
from pathlib import Path

from vinetrack.dynamics.model import Model
from vinetrack.effects import BASE_EFFECTS, Effect, catalogue, load_effect

PROBE_FILE = Path(__file__).with_name("probes") / "probe_force.py"


@lru_cache(maxsize=1)
def probe() -> Effect:
    """The probe force of the diagnosis (`probes/probe_force.py`)."""
    return load_effect(PROBE_FILE)


def host_for(model: Model, candidates: Iterable[Effect] = ()) -> Model:
    """Return one model of the catalogue, the probe force, a model and further effects."""
    held = {effect.name: effect for effect in (*catalogue().values(), probe(), *model, *candidates)}
    return Model(tuple(held[name] for name in held))


@lru_cache(maxsize=256)
def shared_host(effects: tuple[Effect, ...]) -> Model | None:
    """Return the host for a model of which none is stated. It is worth 3 s to compile a further model, while a
    trajectory takes 1.4 times as long by the host (`benchmarks/catalogue_speed.py`): 15 µs more each, less than the 3 s
    for 200 000 of them, which is twenty fits.
    """
    known = all(catalogue().get(effect.name) == effect for effect in effects)
    return host_for(Model(())) if known and not {effect.name for effect in effects} <= set(BASE_EFFECTS) else None
