"""Trials that could be made next: pressures, payloads, vines and rigs within what the user allows.

Where the user says nothing the experiment is the guide: pressures from the lowest used to a quarter above the highest
and never above what the film holds; no payload or the heaviest used; half and twice the chamber; connectors of half and
twice the area; and film of other thickness rolled to other diameters. Rigs change one thing at a time.
"""

from __future__ import annotations

import itertools
import math
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from vinetrack.core.records import Trial
from vinetrack.experiment.naming import with_names
from vinetrack.experiment.schema import COLUMNS
from vinetrack.experiment.settings import Limits
from vinetrack.planning.scaling_priors import hoop_stress_Pa

SAME_RIG, OTHER_RIG, NEW_VINE = 0, 1, 2
"""What a trial asks for: nothing new; another chamber, connector or angle; a vine that has to be made. Defined in order
of effort; nothing but their order counts."""

HEADROOM = 1.25
"""Pressures are looked at up to this many times the highest that was used. Chosen: a modest step beyond experience. At
1.12 less of the model is tested, at 1.5 pressures may exceed what a rig can hold."""

ABOVE_YIELD = 1.15
"""Nearer to the yield pressure its own error decides how a vine moves. Chosen: an error of 3 % of P_y is then 20 % of
the drive P − P_y. At 1.07 it is 40 %, at 1.3 slow trials are not offered."""

PRESSURE_STEP_PA = 100.0
"""As finely as pressures are set. Chosen: regulators are read to about 0.1 kPa; at half or twice a plan's pressures
differ by less than their errors."""

PAYLOAD_KG = 0.05
"""Payload offered where none was used yet, kg. Chosen: several times the mass of a usual tail; the user's limits
replace it."""

PRESSURES_LOOKED_AT = 6
"""Chosen: over a range of ten, steps of 1.6. At half an optimum between pressures is missed by little (designs are flat
there), at twice the search takes longer."""

MOST_NEW_VINES = 10
"""Chosen for time; the most different sizes are kept. At half a useful size may be missed, at twice the search takes
twice as long."""

SAME = 1e-4
"""Relative difference below which two values are the same. Chosen: below any tolerance of a workshop, above
rounding."""


@dataclass(frozen=True)
class Condition:
    """A trial that could be made.

    `like` is the place among the trials of the experiment of the one it is modelled on: for a vine that exists, a trial
    with it; else one with the vine nearest in size. `changed` names what differs from the rig of that trial.
    """

    trial: Trial
    like: int
    effort: int
    changed: tuple[str, ...] = ()


def conditions(trials: Sequence[Trial], limits: Limits) -> list[Condition]:
    """Every trial to look at; empty where the limits leave none.

    Parameters
    ----------
    trials : of the experiment, at least one.
    limits : what the user allows.

    Returns
    -------
    list of Condition
        Named `next_1`, `next_2`, …
    """
    models = _models(trials)
    if not models:
        return []
    used = [trial for trial in trials if trial.travel_ratio != 1]
    vines = [(trials[k], k) for k in models]
    feasible = []
    for vine, k in vines:
        if _allowed(vine, limits):
            for effort, rig in _rigs(vine, used, limits):
                feasible += _loads(rig, k, effort, used, limits)
    for vine, k in _new_vines(vines, limits) if limits.new_vines else []:
        rigs = _rigs(vine, used, limits)
        least = min((effort for effort, _ in rigs), default=SAME_RIG)
        for effort, rig in rigs:
            if effort == least:
                feasible += _loads(rig, k, NEW_VINE, used, limits)
    named = [f"next_{i + 1}" for i in range(len(feasible))]
    return [
        replace(
            condition,
            trial=replace(condition.trial, name=name),
            changed=_changed(condition.trial, trials[condition.like]),
        )
        for condition, name in zip(feasible, named, strict=True)
    ]


RIG = {"chamber_l": "chamber_m3", "inlet_mm": "inlet_m", "growth_angle_deg": "growth_angle_rad"}


def _changed(rig: Trial, before: Trial) -> tuple[str, ...]:
    return tuple(column for column, name in RIG.items() if not _alike(rig, before, [name]))


def _models(trials: Sequence[Trial]) -> list[int]:
    """The trial of each everting vine that stands for it: the first of its commonest rig and yield pressure."""
    rigs = [(trial.vine, trial.yield_pressure_Pa, trial.chamber_m3, trial.inlet_m, trial.bends) for trial in trials]
    texts = [repr(rig) for rig in rigs]
    places = []
    for vine in dict.fromkeys(trial.vine for trial in trials if trial.travel_ratio != 1):
        mine = [texts[i] for i, rig in enumerate(rigs) if rig[0] == vine]
        places.append(texts.index(Counter(mine).most_common(1)[0][0]))
    return places


def _allowed(vine: Trial, limits: Limits) -> bool:
    """Whether the user's lists, where there are any, hold this vine."""
    sizes = (
        (vine.diameter_m * 1e3, limits.diameter_mm),
        (vine.thickness_m * 1e6, limits.thickness_um),
        (vine.length_m * 1e3, limits.length_mm),
    )
    return all(values is None or not math.isfinite(size) or _among(size, values) for size, values in sizes)


def _among(value: float, values: Iterable[float]) -> bool:
    return any(math.isclose(value, listed, rel_tol=SAME, abs_tol=1e-12) for listed in values)


def _rigs(vine: Trial, used: Sequence[Trial], limits: Limits) -> list[tuple[int, Trial]]:
    """The vine on every rig: of chamber, connector and angle no more is changed at a time than the limits ask for."""
    half, twice = math.sqrt(0.5), math.sqrt(2.0)
    chambers = _choices(vine.chamber_m3, [t.chamber_m3 for t in used], limits.chamber_l, 1e-3, (0.5, 2.0))
    inlets = _choices(vine.inlet_m, [t.inlet_m for t in used], limits.inlet_mm, 1e-3, (half, twice))
    angles = _choices(vine.growth_angle_rad, [t.growth_angle_rad for t in used], limits.growth_angle_deg, math.pi / 180)
    rigs: list[tuple[int, int, Trial]] = []
    for chamber, inlet, angle in itertools.product(chambers, inlets, angles):
        rig = replace(vine, chamber_m3=chamber, inlet_m=inlet, growth_angle_rad=angle)
        changes = len(_changed(rig, vine))
        if changes == 0 or not inlet > vine.diameter_m:
            at_hand = any(_alike(rig, trial, tuple(RIG.values())) for trial in used)
            rigs.append((changes, SAME_RIG if at_hand else OTHER_RIG, rig))
    fewest = min((changed for changed, _, _ in rigs), default=0)
    return [(effort, rig) for changed, effort, rig in rigs if changed <= max(1, fewest)]


def _choices(
    now: float, used: Sequence[float], given: Sequence[float] | None, unit: float, factors: Sequence[float] = ()
) -> list[float]:
    """Values of one thing of the rig: those the user lists, else those used and some about what is; NaN stays."""
    if not math.isfinite(now):
        return [now]
    if given is not None:
        return [value * unit for value in given]
    known = [now, *(value for value in dict.fromkeys(used) if math.isfinite(value))]
    known += [_rounded(now * factor) for factor in factors]
    return [value for i, value in enumerate(known) if not _among(value, known[:i])]


def _loads(rig: Trial, like: int, effort: int, used: Sequence[Trial], limits: Limits) -> list[Condition]:
    """Every pressure and payload for one vine on one rig."""
    return [
        Condition(replace(rig, pressure_Pa=pressure, pressure_sigma_Pa=sigma, payload_kg=payload), like, effort)
        for payload in _payloads(used, limits)
        for pressure, sigma in _pressures(rig, payload, used, limits)
    ]


def _payloads(used: Sequence[Trial], limits: Limits) -> list[float]:
    """None (or the least allowed), the heaviest, and those that were used between."""
    before = {trial.payload_kg for trial in used}
    heaviest = max(before) if max(before) > 0 else PAYLOAD_KG
    low, high = (0.0, heaviest) if limits.payload_g is None else (1e-3 * g for g in limits.payload_g)
    return sorted({low, high, *(payload for payload in before if low <= payload <= high)})


def _pressures(rig: Trial, payload_kg: float, used: Sequence[Trial], limits: Limits) -> list[tuple[float, float]]:
    """Set pressures in equal ratios, Pa, with the error of setting them."""
    before = [trial.pressure_Pa for trial in used if trial.pressure_Pa > 0]
    if not before:
        return []
    low, high = min(before), HEADROOM * max(before)
    if limits.pressure_kPa is not None:
        low, high = (1e3 * kPa for kPa in limits.pressure_kPa)
    stress_Pa = hoop_stress_Pa(1.0, rig.diameter_m, rig.thickness_m)
    if math.isfinite(stress_Pa):
        # A guess of what film holds must not forbid what it has held; what the user says of it may.
        told = "hoop_stress_MPa" in limits.model_fields_set
        held = [trial.pressure_Pa for trial in used if trial.vine == rig.vine and not told]
        bursts_Pa = 1e6 * limits.hoop_stress_MPa / stress_Pa
        high = min(high, max([PRESSURE_STEP_PA * math.floor(bursts_Pa / PRESSURE_STEP_PA), *held]))
    if payload_kg == 0 and math.isfinite(rig.yield_pressure_Pa):
        low = max(low, ABOVE_YIELD * rig.yield_pressure_Pa)
    if not low <= high:
        return []
    steps = np.geomspace(low, high, PRESSURES_LOOKED_AT) if high > 1.02 * low else np.array([high])
    relative = [t.pressure_sigma_Pa / t.pressure_Pa for t in used if t.pressure_Pa > 0]
    share = float(np.nanmedian(relative)) if np.isfinite(relative).any() else math.nan
    steps = np.clip(PRESSURE_STEP_PA * np.round(steps / PRESSURE_STEP_PA), low, high)
    return [(float(pressure), share * float(pressure)) for pressure in np.unique(steps.round(3))]


def _new_vines(models: Sequence[tuple[Trial, int]], limits: Limits) -> list[tuple[Trial, int]]:
    """Vines that could be made, each with the place of the trial whose vine is nearest in size."""
    vines = [trial for trial, _ in models]
    diameters = _sizes([v.diameter_m for v in vines], limits.diameter_mm, 1e-3, (0.5, 0.75, 1.5))
    walls = _sizes([v.thickness_m for v in vines], limits.thickness_um, 1e-6, (0.5, 2.0))
    vines_found: list[tuple[Trial, int]] = []
    for diameter, wall in itertools.product(diameters, walls):
        if wall > diameter / 4 or not COLUMNS["diameter_mm"].low <= 1e3 * diameter <= COLUMNS["diameter_mm"].high:
            continue
        near, like = min(models, key=lambda m: _distance(m[0], diameter, wall))
        lengths = [near.length_m] if limits.length_mm is None else [1e-3 * mm for mm in limits.length_mm]
        for length in lengths:
            sized = replace(
                near,
                diameter_m=diameter,
                thickness_m=wall,
                length_m=length,
                video=None,
                track=None,
                pressure_trace=None,
            )
            if not any(_alike(sized, vine) for vine in vines):
                vines_found.append((with_names([sized])[0], like))
    return _spread_out(vines_found, MOST_NEW_VINES)


def _sizes(
    before: Sequence[float], given: Sequence[float] | None, unit: float, factors: Sequence[float]
) -> list[float]:
    """Sizes to look at: those the user lists, else those used and some beyond."""
    if given is not None:
        return [size * unit for size in given]
    known = {size for size in before if math.isfinite(size)}
    if not known:
        return []
    return sorted(known | {_rounded(f * (min(known) if f < 1 else max(known))) for f in factors})


def _rounded(value: float) -> float:
    """Two significant digits: sizes that a person would ask for."""
    return float(f"{value:.2g}")


def _distance(vine: Trial, diameter_m: float, thickness_m: float) -> float:
    return math.hypot(math.log(vine.diameter_m / diameter_m), math.log(vine.thickness_m / thickness_m))


def _alike(trial: Trial, other: Trial, names: Sequence[str] = ("diameter_m", "thickness_m", "length_m")) -> bool:
    pairs = [(getattr(trial, name), getattr(other, name)) for name in names]
    return all(_among(a, [b]) or (math.isnan(a) and math.isnan(b)) for a, b in pairs)


def _spread_out(vines: list[tuple[Trial, int]], most: int) -> list[tuple[Trial, int]]:
    """At most so many vines, those furthest from one another in diameter, thickness and length."""
    if len(vines) <= most:
        return vines
    places = np.log([[v.diameter_m, v.thickness_m, v.length_m] for v, _ in vines])
    chosen = [int(np.argmax(np.linalg.norm(places - places.mean(axis=0), axis=1)))]
    while len(chosen) < most:
        away = np.linalg.norm(places[:, None] - places[chosen], axis=2).min(axis=1)
        chosen.append(int(np.argmax(away)))
    return [vines[k] for k in sorted(chosen)]
