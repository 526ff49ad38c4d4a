"""Mixtures of effects at random plausible sizes: the integration gets through, and as exactly as it says.

Scored on seeds 0–149 of NumPy's generator; nothing was tuned on them.
"""

from __future__ import annotations

import numpy as np
import pytest
from by_hand import N, Vine, whole_catalogue

from vinetrack.dynamics.simulate import simulate
from vinetrack.effects import catalogue

TIMES = np.linspace(0.0, 0.3, 200)
DRAWN_LAST = ("film_mass", "payload_mass")
"""Effects that came after the seeds: the others keep the sizes that these seeds always gave them."""


def mixture(seed: int) -> tuple[Vine, dict[str, float]]:
    """A vine, and two effects in five."""
    rng = np.random.default_rng(seed)
    vine = Vine(
        D=rng.uniform(5e-3, 30e-3),
        t=1e-4,
        L=rng.uniform(0.15, 0.6),
        P=rng.uniform(8e3, 60e3),
        P_y=3e3,
        B=rng.uniform(0.5, 6.0),
        payload=float(rng.choice([0.0, 35.6e-3])),
        down=float(rng.choice([1.0, 0.0, -1.0])),
    )
    sizes = {"eversion_damping.B": vine.B, "eversion_damping.n": N}
    for effect in sorted(catalogue().values(), key=lambda effect: effect.name in DRAWN_LAST):
        if effect.kind != "base" and rng.random() < 0.4:
            for parameter in effect.parameters:
                assert parameter.plausible is not None
                sizes[f"{effect.name}.{parameter.name}"] = rng.uniform(*parameter.plausible)
    return vine, sizes


@pytest.mark.parametrize("tens", range(15))
def test_the_usual_tolerance_gives_what_a_thousandth_of_it_gives(tens: int) -> None:
    for seed in range(10 * tens, 10 * tens + 10):
        vine, sizes = mixture(seed)
        model = whole_catalogue(sizes)
        usual = simulate(model, vine.trial(), TIMES).lead_position_m
        exact = simulate(model, vine.trial(), TIMES, relative_tolerance=1e-7).lead_position_m
        # Of the distance; where it hardly moves, and sets off by a hair (a latch as strong as the drive), of L/10.
        assert np.max(np.abs(usual - exact)) <= 1e-5 * max(exact[-1], 0.1 * vine.L), seed


def test_a_vine_that_stops_and_creeps_on_is_nowhere_else_meanwhile() -> None:
    # Seed 1025: friction brings it to rest between two frames while the drive exceeds what holds it by a hair.
    vine, sizes = mixture(1025)
    found = simulate(whole_catalogue(sizes), vine.trial(), TIMES).lead_position_m
    assert np.all(np.diff(found) >= -1e-9)
    assert found.max() < vine.L
