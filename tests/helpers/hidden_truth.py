"""Small campaigns with a truth that the diagnosis does not see."""

from collections.abc import Mapping
from dataclasses import replace

import grown as campaigns
from grown import Pairs, pairs_of

from vinetrack.core.records import Trial
from vinetrack.experiment.schema import with_names
from vinetrack.laboratory.campaigns import campaign, isometric_vine


def sheet(payload_g: float = 0.0) -> list[Trial]:
    """Two vines, three pressures each, two trials a pressure, a chamber of 3.7 L."""
    trials = campaign(isometric_vine(4), (14, 20, 28), 2, payload_g=payload_g, prefix="a")
    trials += campaign(isometric_vine(3), (14, 22, 40), 2, payload_g=payload_g, prefix="b")
    return [replace(trial, chamber_m3=3.7e-3) for trial in with_names(trials)]


def grown(values: Mapping[str, float] | None = None, *, seed: int, trials: list[Trial] | None = None) -> Pairs:
    """Trials as a sheet and tracks state them, with effects whose values are given at work behind them."""
    trials = trials if trials is not None else sheet()
    effects = tuple(dict.fromkeys(name.split(".")[0] for name in values or {}))
    scatter = {"damping_scatter": 0.02, "pressure_scatter": 0.005, "yield_error_kPa": 0.1, "noise_correlation": 0.3}
    return pairs_of(campaigns.grown(trials, seed, effects, values, **scatter))
