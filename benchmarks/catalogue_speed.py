"""What the whole catalogue costs in one compiled model, against the base model alone.

A diagnosis tries every effect on the same trials. If effects of no size cost next to nothing, one compiled model does
for all of them. Printed: microseconds a trajectory, best of several runs, on trials as in the paper's protocol, for the
base model, the whole catalogue at no size, one effect after the other at its default size, and all of them at once;
and seconds of processor time to compile the whole catalogue, which every new version does once.

    python benchmarks/catalogue_speed.py
"""

from __future__ import annotations

import os
import tempfile
import time
from dataclasses import replace

import numpy as np

from vinetrack.core.records import Trial
from vinetrack.dynamics.model import Model, base_model, make_model
from vinetrack.dynamics.simulate import simulate_many
from vinetrack.effects import catalogue

RUNS, COPIES = 40, 10
LIMIT = 1.6
"""A diagnosis with one compiled model may be slower than the base model by this factor."""

VINE = Trial(
    name="t",
    vine="v",
    diameter_m=24e-3,
    thickness_m=200e-6,
    length_m=0.28,
    pressure_Pa=28e3,
    yield_pressure_Pa=3e3,
    chamber_m3=3.7e-3,
    inlet_m=6e-3,
)
TRIALS = [
    replace(VINE, pressure_Pa=pressure, payload_kg=payload)
    for pressure in (7e3, 14e3, 28e3, 45e3)
    for payload in (0.0, 35.6e-3)
]
TIMES = np.linspace(0.0, 0.3, 321)  # 1069 frames a second
BASE_VALUES = {"eversion_damping.B": 6.44, "eversion_damping.n": 0.37}


def whole(sizes: dict[str, float]) -> Model:
    """Every effect, at no size unless said."""
    model = make_model(catalogue())
    nothing = {f"{e.name}.{p.name}": p.zero for e in model for p in e.parameters if e.kind != "base"}
    return model.with_values({**nothing, **BASE_VALUES, **sizes})


def microseconds(models: dict[str, Model]) -> dict[str, float]:
    """Best time of each model, the models taking turns so that a busy machine slows all alike."""
    trials = TRIALS * COPIES
    best = dict.fromkeys(models, float("inf"))
    for _ in range(RUNS):
        for name, model in models.items():
            start = time.perf_counter()
            simulate_many(model, trials, [TIMES] * len(trials))
            best[name] = min(best[name], time.perf_counter() - start)
    return {name: 1e6 * seconds / len(trials) for name, seconds in best.items()}


def default_sizes(name: str) -> dict[str, float]:
    return {f"{name}.{parameter.name}": parameter.default for parameter in catalogue()[name].parameters}


def main() -> None:
    """Print the table."""
    physical = [name for name, effect in catalogue().items() if effect.kind != "base"]
    compiling_s = 0.0
    models = {"base model": base_model().with_values(BASE_VALUES), "whole catalogue at no size": whole({})}
    models |= {f"  + {name}": whole(default_sizes(name)) for name in physical}
    models["all at their default sizes"] = whole({k: v for name in physical for k, v in default_sizes(name).items()})
    with tempfile.TemporaryDirectory() as folder:
        os.environ["VINETRACK_CACHE"] = folder
        for model in models.values():
            start = time.process_time()
            simulate_many(model, TRIALS[:1], [TIMES])  # compiled before the clock starts
            compiling_s = max(compiling_s, time.process_time() - start)
    found = microseconds(models)
    base = found["base model"]
    print(f"{'model':<30} {'µs a trajectory':>16} {'against base':>13}")
    for name, value in found.items():
        print(f"{name:<30} {value:16.1f} {value / base:13.2f}")
    print(f"\ncompiled in {compiling_s:.1f} s")
    ratio = found["whole catalogue at no size"] / base
    print(f"The whole catalogue at no size takes {ratio:.2f} times the base model; wanted: at most {LIMIT}.")


if __name__ == "__main__":
    main()
