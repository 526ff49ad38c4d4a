"""Whether the next experiment keeps its promise: trials it asks for are grown with the true physics and fitted.

    python benchmarks/next_trial.py [--campaigns 6] [--first-seed 6000] [--only air_drag]

Campaigns of one tube (24 mm × 200 µm × 280 mm, 3.7 l, connector of 8 mm) are grown in the virtual laboratory with one
effect, and fitted with it and with what it is easily taken for. The trials that `next_experiment` asks for are grown
with the truth, releases, origins, noise and scatter of their own, B of new vines 15 % off the guess; then everything is
fitted again. A row a kind of tie:

predicted    √(Δ−2 ln L) that was promised if the truth is true, median over campaigns
realised    what the trials gave, against what was promised, median and range of the ratio
kept        campaigns in which trials were asked for, and those in which 0.8 of the promise or more came true
CPU         of `next_experiment`, s, median

Seeds below 1000 were looked at while the method was made; those from 6000 score.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from rich.progress import track

import vinetrack as vt
from vinetrack.core.process import table
from vinetrack.core.records import Track, Trial
from vinetrack.core.units import BASE_EFFECTS
from vinetrack.diagnosis.further_trials import NextExperiment, next_experiment
from vinetrack.experiment.schema import with_names
from vinetrack.experiment.settings import Limits
from vinetrack.inference.fit_result import Fit
from vinetrack.laboratory.campaigns import GroundTruth, Vine, campaign, grow
from vinetrack.planning.predictive_inputs import damping_prior

TUBE, DAMPING, EXPONENT, GUESSED_WRONG = Vine(24.0, 200.0, 280.0), 6.44, 0.37, 1.15


@dataclass(frozen=True)
class Tie:
    """An effect that is true, its size, what it is taken for, and the campaign."""

    effect: str
    size: Mapping[str, float]
    other: str
    pressures_kPa: Sequence[float] = (14.0, 20.0, 28.0, 38.0)
    replicates: int = 6
    limits: Limits = field(default_factory=Limits)
    rig: Mapping[str, Any] = field(default_factory=dict)
    note: str = ""


TIES = (
    Tie("air_drag", {"air_drag.C_D": 60.0}, "inlet_loss"),
    Tie("inlet_loss", {"inlet_loss.K": 0.6}, "air_drag", limits=Limits(inlet_mm=(8.0,)), note="one connector"),
    Tie("wall_stretch", {"wall_stretch.kappa": 2e-6}, "pressure_gain", replicates=3),
    Tie(
        "reservoir_depletion",
        {"reservoir_depletion.gamma": 1.4},
        "tail_friction",
        pressures_kPa=(28.0,),
        replicates=8,
        limits=Limits(chamber_l=(3.7,), new_vines=False),
        rig={"tail_store": "reel"},
        note="reel, same rig",
    ),
    Tie("fold_inertia", {"fold_inertia.eta": 0.4}, "linear_damping"),
)


def grown(trials: Sequence[Trial], tie: Tie, seed: int) -> list[tuple[Trial, Track]]:
    """Trials grown with the truth of a tie."""
    damping = {
        t.vine: DAMPING
        if (round(t.diameter_m * 1e3), round(t.thickness_m * 1e6)) == (24, 200)
        else GUESSED_WRONG * damping_prior(t.diameter_m, t.thickness_m)
        for t in trials
    }
    nature = GroundTruth(
        effects=(*BASE_EFFECTS, tie.effect),
        values={"eversion_damping.B": damping, "eversion_damping.n": EXPONENT, **tie.size},
        noise_correlation=0.3,
        seed=seed,
    )
    return [(one.stated, one.track) for one in grow(trials, nature)]


def asked_for(found: NextExperiment, like: Trial) -> list[Trial]:
    """The recommended trials."""
    made = []
    for k, entry in enumerate(found.trials):
        sizes = {
            "pressure_Pa": 1e3 * entry["pressure_kPa"],
            "payload_kg": 1e-3 * entry["payload_g"],
            "diameter_m": 1e-3 * entry["diameter_mm"],
            "thickness_m": 1e-6 * entry["thickness_um"],
            "length_m": 1e-3 * entry["length_mm"],
            "chamber_m3": 1e-3 * entry["chamber_l"],
            "inlet_m": 1e-3 * entry["inlet_mm"],
            "growth_angle_rad": math.radians(entry["growth_angle_deg"]),
        }
        made += [replace(like, name=f"new{k}_{j}", vine=entry["vine"], **sizes) for j in range(entry["replicates"])]
    return made


def fitted(pairs: Sequence[tuple[Trial, Track]], tie: Tie, before: Sequence[Fit] = ()) -> list[Fit]:
    """The true hypothesis and the other, each from nothing and from where it was before."""
    host = vt.make_model([*BASE_EFFECTS, tie.effect, tie.other])
    base = vt.fit(vt.base_model(), pairs, host=host)
    found = []
    for k, name in enumerate((tie.effect, tie.other)):
        model = base.model + getattr(vt.effects, name)
        starts: list[dict[str, Any]] = [{}]
        starts += [{key: v for key, v in fit.model.values.items() if key.startswith(name)} for fit in before[k : k + 1]]
        found.append(max((vt.refit(base, model, start=start) for start in starts), key=lambda fit: fit.log_likelihood))
    return found


def measure(tie: Tie, seed: int) -> dict[str, float] | None:
    """One campaign: promise and what became of it; None where no trials were asked for."""
    trials = campaign(TUBE, tie.pressures_kPa, tie.replicates)
    rig: dict[str, Any] = {"chamber_m3": 3.7e-3, "inlet_m": 8e-3, **tie.rig}
    pairs = grown(list(with_names([replace(trial, **rig) for trial in trials])), tie, seed)
    fits = fitted(pairs, tie)
    begin = time.process_time()
    found = next_experiment(fits, tie.limits)
    spent = time.process_time() - begin
    if not found.trials:
        return None
    after = fitted([*pairs, *grown(asked_for(found, pairs[0][0]), tie, seed + 100_000)], tie, fits)
    gained = [2 * (now.log_likelihood - was.log_likelihood) for now, was in zip(after, fits, strict=True)]
    (pair,) = found.separation_sigma
    promised = found.if_true_sigma[pair][tie.effect]
    return {"predicted": promised, "realised": math.sqrt(max(gained[0] - gained[1], 0.0)) / promised, "cpu": spent}


def main() -> None:
    """Run all kinds of ties and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--campaigns", type=int, default=6)
    parser.add_argument("--first-seed", type=int, default=6000)
    parser.add_argument("--only", help="the true effect of one kind of tie")
    arguments = parser.parse_args()
    rows = []
    for tie in [one for one in TIES if arguments.only in (None, one.effect)]:
        seeds = range(arguments.first_seed, arguments.first_seed + arguments.campaigns)
        every = [measure(tie, seed) for seed in track(seeds, description=tie.effect)]
        rows.append(_row(tie, [one for one in every if one is not None], len(every)))
    head = ("true", "taken for", "predicted σ", "realised", "range", "kept", "CPU s")
    print("\n".join(table(rows, head)))


def _row(tie: Tie, seen: Sequence[Mapping[str, float]], campaigns: int) -> tuple[str, ...]:
    name = f"{tie.effect} ({tie.note})" if tie.note else tie.effect
    if not seen:
        return name, tie.other, "–", "–", "–", f"0 of 0, {campaigns} campaigns", "–"
    columns = {key: np.array([one[key] for one in seen]) for key in seen[0]}
    ratio = columns["realised"]
    return (
        name,
        tie.other,
        f"{np.median(columns['predicted']):.1f}",
        f"{np.median(ratio):.2f}",
        f"{ratio.min():.2f}–{ratio.max():.2f}",
        f"{np.count_nonzero(ratio >= 0.8)} of {len(seen)}",
        f"{np.median(columns['cpu']):.1f}",
    )


if __name__ == "__main__":
    main()
