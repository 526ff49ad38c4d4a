"""What weighs other than the sheet says: film and payloads. Faults as those of `hidden.laboratories`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from hidden.shots import Draw, Fault, Laboratory, Shot


def film_off(sigma: float) -> Fault:
    """The film of each vine weighs more or less than thickness and density say, by so much."""

    def apply(laboratory: Laboratory, draw: Draw) -> Laboratory:
        vines = list(dict.fromkeys(shot.setting.vine for shot in laboratory.shots))
        factors = {vine: 1 + sigma * float(np.clip(draw.standard_normal(), -2, 2)) for vine in vines}
        shots = tuple(_with_film(shot, factors[shot.setting.vine]) for shot in laboratory.shots)
        known = {f"film_mass.eps.{k}": factor - 1 for k, factor in enumerate(factors.values())}
        return replace(laboratory, shots=shots).known(film_sigma=sigma, **known)

    return apply


def film_of(density: float) -> Fault:
    """The film has this density, kg/m³, and the settings do not say so."""

    def apply(laboratory: Laboratory, draw: Draw) -> Laboratory:  # noqa: ARG001
        shots = tuple(_with_film(shot, density / shot.tube.film_density) for shot in laboratory.shots)
        return replace(laboratory, shots=shots).known(film_density=density)

    return apply


def _with_film(shot: Shot, factor: float) -> Shot:
    return replace(shot, tube=shot.tube._replace(film_density=factor * shot.tube.film_density))


def mount_forgotten(low_g: float, high_g: float) -> Fault:
    """What holds the payload was not weighed along with it."""

    def apply(laboratory: Laboratory, draw: Draw) -> Laboratory:
        mount_kg = 1e-3 * float(draw.uniform(low_g, high_g))
        return _heavier(laboratory, lambda shot: mount_kg * bool(shot.setting.payload_g)).known(
            **{"payload_mass.delta": mount_kg}
        )

    return apply


def payload_mistyped(laboratory: Laboratory, draw: Draw) -> Laboratory:
    """One of the payloads weighs 15 % more than the sheet says."""
    loads = sorted({shot.setting.payload_g for shot in laboratory.shots} - {0.0})
    heavy_g = float(draw.choice(loads))
    more = _heavier(laboratory, lambda shot: 0.15e-3 * heavy_g * (shot.setting.payload_g == heavy_g))
    return more.known(**({"payload_mass.delta": 0.15e-3 * heavy_g} if len(loads) == 1 else {}))


def _heavier(laboratory: Laboratory, by_kg: Callable[[Shot], float]) -> Laboratory:
    shots = (replace(s, tube=s.tube._replace(payload=s.tube.payload + by_kg(s))) for s in laboratory.shots)
    return replace(laboratory, shots=tuple(shots))
