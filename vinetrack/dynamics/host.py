"""One model with the whole catalogue, compiled once for all that is asked of any of its effects.

A model takes seconds to compile, an effect of no size next to nothing to simulate. What compares models therefore
simulates each by the compiled form of one larger model, the host. Wherever no effect of a user's own is involved it is
the same model, so that a design, a diagnosis and the explorer share what is compiled.
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import lru_cache
from pathlib import Path

from vinetrack.dynamics.model import Model
from vinetrack.effects import Effect, catalogue, load_effect

PROBE_FILE = Path(__file__).with_name("probes") / "probe_force.py"


@lru_cache(maxsize=1)
def probe() -> Effect:
    """The probe force of the diagnosis (`probes/probe_force.py`)."""
    return load_effect(PROBE_FILE)


def host_for(model: Model, candidates: Iterable[Effect] = ()) -> Model:
    """Return one model of the catalogue, the probe force, a model and further effects.

    Parameters
    ----------
    model
        The model to simulate; its effects outside the catalogue are included.
    candidates : iterable of Effect
        Further effects, such as a user's own.

    Returns
    -------
    Model
    """
    held = {effect.name: effect for effect in (*catalogue().values(), probe(), *model, *candidates)}
    return Model(tuple(held[name] for name in held))
