"""Campaigns from the virtual laboratory for the tests of where a model fails and what drifts."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from pathlib import Path

from vinetrack.core.records import Track, Trial
from vinetrack.core.units import BASE_EFFECTS
from vinetrack.dynamics.model import Model, make_model
from vinetrack.effects import Effect, own_effects
from vinetrack.experiment.schema import with_names
from vinetrack.laboratory.campaigns import GroundTruth, VirtualTrial, campaign, damping_values, grow, isometric_vine

Pairs = list[tuple[Trial, Track]]
FORCES = {
    "patch": "0.5 * (np.tanh((s.lead_position - 0.12) / 0.003) - np.tanh((s.lead_position - 0.15) / 0.003))",
    "stribeck": "np.exp(-s.tail_velocity / 1.5)",
    "growing": "s.time / 0.2",
    "bump": "np.exp(-0.5 * ((s.lead_position - 0.08) / 0.01) ** 2)",
    "slow": "1 / (0.3 + s.tail_velocity)",
    "waves": "np.sin(2 * np.pi * (s.lead_position / 0.12) ** 1.5)",
    "square": "(s.lead_position / 0.28) ** 2",
}  # Forces that no catalogue has, of size 1
PRESSURES = {1: (16.0, 22.0, 30.0), 2: (30.0, 40.0, 50.0, 60.0), 4: (24.0, 30.0, 38.0, 48.0)}


def sheet(scales: Sequence[int] = (2, 4), replicates: int = 3, payloads_g: Sequence[float] = (0.0,)) -> list[Trial]:
    """Isometric vines at a few pressures each, with these payloads, on a chamber of 3.7 L."""
    trials: list[Trial] = []
    for scale, g in product(scales, payloads_g):
        trials += campaign(isometric_vine(scale), PRESSURES[scale], replicates, g, prefix=f"R{scale}_{g:g}g_")
    return list(with_names([replace(trial, chamber_m3=3.7e-3) for trial in trials]))


@dataclass(frozen=True, kw_only=True)
class Hiding(GroundTruth):
    """A nature with effects of a user's own files."""

    own: Mapping[str, Effect] = field(default_factory=dict)

    def model(self) -> Model:
        return make_model(self.effects, self.own).with_values(self.values)


def grown(trials: Sequence[Trial], seed: int, effects=(), values=None, own=(), **more: float) -> list[VirtualTrial]:
    """The trials grown with the printed B and n and these effects hidden."""
    hidden = own_effects(own)
    known = {**damping_values(trials), **(values or {})}
    nature = Hiding(effects=(*BASE_EFFECTS, *effects, *hidden), values=known, seed=seed, own=hidden, **more)
    return grow(trials, nature)


def pairs_of(virtual: Sequence[VirtualTrial]) -> Pairs:
    """What the analysis gets of them."""
    return [(one.stated, one.track) for one in virtual]


def tubes(payload_g: float = 0.0) -> list[Trial]:
    """Two vines, three pressures each, two trials a pressure, a chamber of 3.7 L."""
    trials = campaign(isometric_vine(4), (14, 20, 28), 2, payload_g=payload_g, prefix="a")
    trials += campaign(isometric_vine(3), (14, 22, 40), 2, payload_g=payload_g, prefix="b")
    return [replace(trial, chamber_m3=3.7e-3) for trial in with_names(trials)]


def hidden(values: Mapping[str, float] | None = None, *, seed: int, trials: list[Trial] | None = None) -> Pairs:
    """What the analysis gets of tubes that scatter, with effects whose values are given at work behind them."""
    effects = tuple(dict.fromkeys(name.split(".")[0] for name in values or {}))
    scatter = {"damping_scatter": 0.02, "pressure_scatter": 0.005, "yield_error_kPa": 0.1, "noise_correlation": 0.3}
    return pairs_of(grown(tubes() if trials is None else trials, seed, effects, values, **scatter))


def effect_file(folder: Path) -> Path:
    """A user's effect `hidden`: a tail force of size `a`, N, times that of `FORCES` whose place is `kind`."""
    shapes = enumerate(FORCES.values())
    choices = "\n".join(f"    if kind == {k}.0:\n        return a * ({force}) + 0.0 * s.time" for k, force in shapes)
    text = f'''"""Forces that no catalogue has.

    tail force a · shape
"""
import numpy as np
from vinetrack.effects import Parameter
PARAMETERS = (
    Parameter("a", "a", "N", 0.0, bounds=(-100.0, 100.0), meaning="size"),
    Parameter("kind", "kind", "1", 0.0, bounds=(0.0, 100.0), meaning="which"),
)
def tail_force(s, rig, a, kind):
{choices}
    return 0.0 * s.time
'''
    path = folder / "hidden.py"
    path.write_text(text, encoding="utf-8")
    return path


def hidden_force(trials: Sequence[Trial], seed: int, name: str, size_N: float, folder: Path) -> Pairs:
    """Trials that felt one of `FORCES` of this size; its file is written to the folder."""
    values = {"hidden.a": size_N, "hidden.kind": float(list(FORCES).index(name))}
    return pairs_of(grown(trials, seed, own=[effect_file(folder)], values=values))
