"""Candidate trials for the next experiment: pressures, payloads, vines and rigs within the user's limits.

Where a limit is not given it follows from the experiment: pressures from the lowest used to a quarter above the highest
and never above the strength of the film; no payload or the heaviest used; half and twice the chamber; connectors of
half and twice the area; and vines of other diameters and film thicknesses. Only one part of a rig changes at a time.
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

SAME_RIG, OTHER_RIG, NEW_VINE = 0, 1, 2  # Effort of a trial: nothing new (defined)

HEADROOM = 1.25  # Highest candidate pressure, as a multiple of the highest used (chosen)

# Lowest candidate pressure of a vine without payload, as a multiple of the yield pressure (chosen)
LOWEST_PRESSURE_RATIO = 1.15

PRESSURE_STEP_PA = 100.0  # Resolution of set pressures, Pa (chosen)

PAYLOAD_KG = 0.05  # Payload offered where none was used yet, kg (chosen)

CANDIDATE_PRESSURES = 6  # Candidate pressures of a vine (chosen)

MOST_NEW_VINES = 10  # New vines considered, at most; those of the most different sizes are taken (chosen)

EQUAL_TOLERANCE = 1e-4  # Relative difference below which two values are equal (chosen)


@dataclass(frozen=True)
class Condition:
    """A trial that could be made. `like` is the index, among the trials of the experiment, of the trial it is modelled
    on: for an existing vine a trial with it, else one with the vine nearest in size.
    """

    trial: Trial
    like: int
    effort: int
    changed: tuple[str, ...] = ()


def feasible_conditions(trials: Sequence[Trial], limits: Limits) -> list[Condition]:
    """Return every candidate trial; empty where the limits exclude all."""
    typical = _typical_trials(trials)
    if not typical:
        return []
    used = [trial for trial in trials if trial.travel_ratio != 1]
    vines = [(trials[k], k) for k in typical]
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


# Columns of the sheet that describe a rig, with their fields of a trial
RIG_FIELDS = {"chamber_l": "chamber_m3", "inlet_mm": "inlet_m", "growth_angle_deg": "growth_angle_rad"}


def _changed(rig: Trial, before: Trial) -> tuple[str, ...]:
    return tuple(column for column, name in RIG_FIELDS.items() if not _alike(rig, before, [name]))


def _typical_trials(trials: Sequence[Trial]) -> list[int]:
    """Index of a typical trial of each everting vine: the first with its commonest rig and yield pressure."""
    rigs = [(trial.vine, trial.yield_pressure_Pa, trial.chamber_m3, trial.inlet_m, trial.bends) for trial in trials]
    texts = [repr(rig) for rig in rigs]
    places = []
    for vine in dict.fromkeys(trial.vine for trial in trials if trial.travel_ratio != 1):
        of_vine = [texts[i] for i, rig in enumerate(rigs) if rig[0] == vine]
        places.append(texts.index(Counter(of_vine).most_common(1)[0][0]))
    return places


def _allowed(vine: Trial, limits: Limits) -> bool:
    """Whether the user's lists of sizes, where given, contain this vine."""
    sizes = (
        (vine.diameter_m * 1e3, limits.diameter_mm),
        (vine.thickness_m * 1e6, limits.thickness_um),
        (vine.length_m * 1e3, limits.length_mm),
    )
    return all(values is None or not math.isfinite(size) or _is_among(size, values) for size, values in sizes)


def _is_among(value: float, values: Iterable[float]) -> bool:
    return any(math.isclose(value, listed, rel_tol=EQUAL_TOLERANCE, abs_tol=1e-12) for listed in values)


def _rigs(vine: Trial, used: Sequence[Trial], limits: Limits) -> list[tuple[int, Trial]]:
    """The vine on every rig; chamber, connector and angle change one at a time unless the limits require more."""
    half, twice = math.sqrt(0.5), math.sqrt(2.0)
    chambers = _choices(vine.chamber_m3, [t.chamber_m3 for t in used], limits.chamber_l, 1e-3, (0.5, 2.0))
    inlets = _choices(vine.inlet_m, [t.inlet_m for t in used], limits.inlet_mm, 1e-3, (half, twice))
    angles = _choices(vine.growth_angle_rad, [t.growth_angle_rad for t in used], limits.growth_angle_deg, math.pi / 180)
    rigs: list[tuple[int, int, Trial]] = []
    for chamber, inlet, angle in itertools.product(chambers, inlets, angles):
        rig = replace(vine, chamber_m3=chamber, inlet_m=inlet, growth_angle_rad=angle)
        changes = len(_changed(rig, vine))
        if changes == 0 or not inlet > vine.diameter_m:
            at_hand = any(_alike(rig, trial, tuple(RIG_FIELDS.values())) for trial in used)
            rigs.append((changes, SAME_RIG if at_hand else OTHER_RIG, rig))
    fewest = min((changed for changed, _, _ in rigs), default=0)
    return [(effort, rig) for changed, effort, rig in rigs if changed <= max(1, fewest)]


def _choices(
    now: float, used: Sequence[float], given: Sequence[float] | None, unit: float, factors: Sequence[float] = ()
) -> list[float]:
    """Values of one part of the rig: the user's, else those used and multiples of the present one; NaN stays."""
    if not math.isfinite(now):
        return [now]
    if given is not None:
        return [value * unit for value in given]
    values = [now, *(value for value in dict.fromkeys(used) if math.isfinite(value))]
    values += [_rounded(now * factor) for factor in factors]
    return [value for i, value in enumerate(values) if not _is_among(value, values[:i])]


def _loads(rig: Trial, like: int, effort: int, used: Sequence[Trial], limits: Limits) -> list[Condition]:
    """Every pressure and payload for one vine on one rig."""
    return [
        Condition(replace(rig, pressure_Pa=pressure, pressure_sigma_Pa=sigma, payload_kg=payload), like, effort)
        for payload in _payloads(used, limits)
        for pressure, sigma in _pressures(rig, payload, used, limits)
    ]


def _payloads(used: Sequence[Trial], limits: Limits) -> list[float]:
    """No payload (or the lightest allowed), the heaviest, and those used in between."""
    payloads = {trial.payload_kg for trial in used}
    heaviest = max(payloads) if max(payloads) > 0 else PAYLOAD_KG
    low, high = (0.0, heaviest) if limits.payload_g is None else (1e-3 * g for g in limits.payload_g)
    return sorted({low, high, *(payload for payload in payloads if low <= payload <= high)})


def _pressures(rig: Trial, payload_kg: float, used: Sequence[Trial], limits: Limits) -> list[tuple[float, float]]:
    """Set pressures in equal ratios, Pa, each with its standard error."""
    pressures = [trial.pressure_Pa for trial in used if trial.pressure_Pa > 0]
    if not pressures:
        return []
    low, high = min(pressures), HEADROOM * max(pressures)
    if limits.pressure_kPa is not None:
        low, high = (1e3 * kPa for kPa in limits.pressure_kPa)
    stress_Pa = hoop_stress_Pa(1.0, rig.diameter_m, rig.thickness_m)
    if math.isfinite(stress_Pa):
        # The default strength of film must not exclude pressures that this vine has held; a stated strength may.
        is_stated = "hoop_stress_MPa" in limits.model_fields_set
        held = [trial.pressure_Pa for trial in used if trial.vine == rig.vine and not is_stated]
        bursts_Pa = 1e6 * limits.hoop_stress_MPa / stress_Pa
        high = min(high, max([PRESSURE_STEP_PA * math.floor(bursts_Pa / PRESSURE_STEP_PA), *held]))
    if payload_kg == 0 and math.isfinite(rig.yield_pressure_Pa):
        low = max(low, LOWEST_PRESSURE_RATIO * rig.yield_pressure_Pa)
    if not low <= high:
        return []
    steps = np.geomspace(low, high, CANDIDATE_PRESSURES) if high > 1.02 * low else np.array([high])
    relative = [t.pressure_sigma_Pa / t.pressure_Pa for t in used if t.pressure_Pa > 0]
    share = float(np.nanmedian(relative)) if np.isfinite(relative).any() else math.nan
    steps = np.clip(PRESSURE_STEP_PA * np.round(steps / PRESSURE_STEP_PA), low, high)
    return [(float(pressure), share * float(pressure)) for pressure in np.unique(steps.round(3))]


def _new_vines(models: Sequence[tuple[Trial, int]], limits: Limits) -> list[tuple[Trial, int]]:
    """Vines that could be made, each with the index of the trial whose vine is nearest in size."""
    vines = [trial for trial, _ in models]
    diameters = _sizes([v.diameter_m for v in vines], limits.diameter_mm, 1e-3, (0.5, 0.75, 1.5))
    walls = _sizes([v.thickness_m for v in vines], limits.thickness_um, 1e-6, (0.5, 2.0))
    new_vines: list[tuple[Trial, int]] = []
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
                new_vines.append((with_names([sized])[0], like))
    return _most_different(new_vines, MOST_NEW_VINES)


def _sizes(
    before: Sequence[float], given: Sequence[float] | None, unit: float, factors: Sequence[float]
) -> list[float]:
    """Candidate sizes: the user's, else those used and multiples of the smallest and largest."""
    if given is not None:
        return [size * unit for size in given]
    used = {size for size in before if math.isfinite(size)}
    if not used:
        return []
    return sorted(used | {_rounded(f * (min(used) if f < 1 else max(used))) for f in factors})


def _rounded(value: float) -> float:
    """The value to two significant digits, as a person would order it."""
    return float(f"{value:.2g}")


def _distance(vine: Trial, diameter_m: float, thickness_m: float) -> float:
    return math.hypot(math.log(vine.diameter_m / diameter_m), math.log(vine.thickness_m / thickness_m))


def _alike(trial: Trial, other: Trial, names: Sequence[str] = ("diameter_m", "thickness_m", "length_m")) -> bool:
    pairs = [(getattr(trial, name), getattr(other, name)) for name in names]
    return all(_is_among(a, [b]) or (math.isnan(a) and math.isnan(b)) for a, b in pairs)


def _most_different(vines: list[tuple[Trial, int]], most: int) -> list[tuple[Trial, int]]:
    """At most so many vines, by farthest-point sampling in ln diameter, ln thickness and ln length."""
    if len(vines) <= most:
        return vines
    sizes = np.log([[v.diameter_m, v.thickness_m, v.length_m] for v, _ in vines])
    chosen = [int(np.argmax(np.linalg.norm(sizes - sizes.mean(axis=0), axis=1)))]
    while len(chosen) < most:
        distance = np.linalg.norm(sizes[:, None] - sizes[chosen], axis=2).min(axis=1)
        chosen.append(int(np.argmax(distance)))
    return [vines[k] for k in sorted(chosen)]
