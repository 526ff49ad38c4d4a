"""vinetrack: from recordings of everting vine robots to the physics that a model of them lacks.

    import vinetrack as vt

    experiment = vt.read_experiment("my_experiment")
    fit = vt.fit(vt.base_model(), experiment)
    print(fit)
    print(vt.compare(fit, experiment).table)
    print(vt.refit(fit, fit.model + vt.effects.reservoir_depletion))

Whatever is named here is loaded when it is first used.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

__version__ = "0.1.0"

_HOMES = {
    "FitError": "vinetrack.model.fit",
    "Model": "vinetrack.model.model",
    "Said": "vinetrack.design.believe",
    "base_model": "vinetrack.model.model",
    "believe": "vinetrack.design.believe",
    "compare": "vinetrack.diagnosis.compare",
    "diagnose": "vinetrack.diagnosis.diagnose",
    "fit": "vinetrack.model.fit",
    "foresee": "vinetrack.design.foresee",
    "make_model": "vinetrack.model.model",
    "planned_trial": "vinetrack.planned",
    "predict": "vinetrack.model.fit",
    "read_experiment": "vinetrack.experiment",
    "refit": "vinetrack.model.fit",
    "simulate": "vinetrack.model.simulate",
}

__all__ = ["__version__", "effects", *_HOMES]


def __getattr__(name: str) -> Any:
    if name == "effects":
        return import_module("vinetrack.effects")
    if name in _HOMES:
        return getattr(import_module(_HOMES[name]), name)
    raise AttributeError(f"module 'vinetrack' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
