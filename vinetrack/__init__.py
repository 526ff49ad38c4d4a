"""vinetrack: from recordings of everting vine robots to the physics that a model of them lacks.

    import vinetrack as vt

    results = vt.load("results/demo")
    print(results.diagnosis)
    fit = vt.fit(vt.base_model(), "results/demo")
    print(vt.compare(fit).table)
    print(vt.refit(fit, fit.model + "reservoir_depletion"))

Whatever is named here is loaded when it is first used.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

__version__ = "0.1.0"

_HOMES = {
    "FitError": "vinetrack.inference.fit",
    "Model": "vinetrack.dynamics.model",
    "StatedValues": "vinetrack.planning.predictive_inputs",
    "base_model": "vinetrack.dynamics.model",
    "compare": "vinetrack.interface",
    "diagnose": "vinetrack.interface",
    "example_tracks": "vinetrack.interface",
    "film_influence": "vinetrack.inference.errors",
    "fit": "vinetrack.interface",
    "load": "vinetrack.interface",
    "make_model": "vinetrack.dynamics.model",
    "planned_trial": "vinetrack.experiment.folder",
    "power": "vinetrack.interface",
    "predict": "vinetrack.inference.fit",
    "predict_vine": "vinetrack.planning.prediction",
    "predictive_inputs": "vinetrack.planning.predictive_inputs",
    "read_experiment": "vinetrack.experiment.folder",
    "refit": "vinetrack.inference.fit",
    "simulate": "vinetrack.dynamics.simulate",
    "tracks_from_frame": "vinetrack.interface",
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
