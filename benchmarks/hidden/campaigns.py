"""From a kind and a seed to the pairs of trial and track that an analysis gets, and the truth that it does not."""

from __future__ import annotations

import math
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace

import numpy as np

from hidden.designs import FILM_KG_M3, Setting, Wants, design
from hidden.kinds import EFFECTS, INTERRUPTED, KINDS, OUTSIDERS, Scene
from hidden.kinds import Hidden as Change
from hidden.motion import Floats, Physics, Tube, follow
from hidden.nuisances import Nuisances, draw_nuisances, noise, regime, scatter
from vinetrack.core.records import Bend, Track, Trial
from vinetrack.experiment.schema import with_names

ALL = {**EFFECTS, **INTERRUPTED}
MOST_FRAMES = 1500
FEWEST_MOVING = 12


@dataclass(frozen=True)
class Truth:
    """What is hidden in a campaign.

    `effects` are names of the catalogue, `outsider` something that no catalogue has, `values` the true parameters as
    `effect.parameter`, SI; `B` by vine, `physics` everything that acted, `change` what was wrong with the measurement.
    """

    kind: str
    seed: int
    effects: tuple[str, ...]
    outsider: str
    values: Mapping[str, float]
    B: Mapping[str, float]
    n: float
    physics: Physics
    change: Change
    nuisances: Nuisances
    dropped_frames: Mapping[str, int]
    release_s: Mapping[str, float]

    @property
    def in_trace(self) -> bool:
        """Whether a measured pressure already holds all that was hidden."""
        known = {"reservoir_depletion", "supply_refill", "leak"}
        return math.isfinite(self.nuisances.trace_sigma_kPa) and bool(self.effects) and set(self.effects) <= known


@dataclass(frozen=True)
class Hidden:
    """One campaign: `pairs` for `vinetrack.fit`, and the truth."""

    kind: str
    seed: int
    pairs: tuple[tuple[Trial, Track], ...]
    truth: Truth


def make(kind: str, seed: int, *, filmed: bool = False, trials: int = 0) -> Hidden:
    """The campaign of this kind and seed; the same ones give the same numbers.

    One to be `filmed` has the positions as they were: noise, lost frames and late starts are the camera's business.
    With a number of `trials` the conditions are those of the kind and seed all the same, each repeated as often as it
    takes, and at least once.

    Raises
    ------
    KeyError
        If there is no such kind; see `hidden.KINDS`.
    """
    if kind not in KINDS:
        raise KeyError(kind)
    for attempt in range(50):
        draw = np.random.default_rng([zlib.crc32(kind.encode()), seed, attempt])
        found = _attempt(kind, seed, draw, filmed=filmed, trials=trials)
        if found is not None:
            return found
    raise RuntimeError(f"No campaign of kind {kind} moves with seed {seed}.")


def _parts(kind: str) -> tuple[tuple[str, ...], str, str]:
    """Hidden effects, outsider and null regime (or other prefix) of a kind."""
    prefix, _, name = kind.rpartition(":")
    if prefix == "outsider":
        return (), name, ""
    if prefix == "null":
        return (), "", name
    if prefix == "frames":
        return (), "", ""
    return tuple(name.split("+")), "", ""


def _wants(names: tuple[str, ...], outsider: str, kind: str) -> Wants:
    parts = [ALL[name][1] for name in names] + ([OUTSIDERS[outsider][1]] if outsider else [])
    return Wants(
        payload=True if any(part.payload for part in parts) else None,
        chamber=any(part.chamber for part in parts),
        inlet=any(part.inlet for part in parts),
        bends=kind.startswith("bends:"),
        vines=2 if len(names) > 1 else 1,
        fast=any(part.fast for part in parts),
        wide_chamber=any(part.wide_chamber for part in parts) and len(parts) == 1,
        trials=(8, 12) if kind == "null:few_trials" else (24, 48),
    )


def _nuisances(kind: str, regime_name: str, draw: np.random.Generator) -> Nuisances:
    how = regime(regime_name, draw) if regime_name else draw_nuisances(draw)
    if kind.startswith("trace:"):
        how = replace(how, trace_sigma_kPa=0.1)
    if kind == "frames:dropped":
        how = replace(how, dropped=float(draw.uniform(0.1, 0.5)))
    return how


def _attempt(kind: str, seed: int, draw: np.random.Generator, *, filmed: bool, trials: int) -> Hidden | None:
    """One campaign, or None where too few of its trials move."""
    names, outsider, regime_name = _parts(kind)
    settings = design(draw, _wants(names, outsider, kind))
    if trials:
        by_repeat = sorted(settings, key=lambda setting: setting.replicate)
        conditions = sum(setting.replicate == 0 for setting in settings)
        settings = [by_repeat[k % len(by_repeat)] for k in range(max(trials, conditions))]
    how = _nuisances(kind, regime_name, draw)
    if filmed:
        how = replace(how, noise="white", noise_m=0.0, dropped=0.0, without_rest=0.0, trace_sigma_kPa=math.nan)
    if all(ALL[name][1].quiet for name in names) and names and draw.uniform() < 0.6:
        # What is weak beside the scatter of a laboratory shows in a careful one.
        how = replace(how, damping_scatter=0.2 * how.damping_scatter, pressure_scatter=0.2 * how.pressure_scatter)
    scene = Scene.of(settings)
    makers = [ALL[name][0] for name in names] + ([OUTSIDERS[outsider][0]] if outsider else [])
    change = _joined([maker(draw, scene) for maker in makers])
    stated = _stated(settings, how, change, draw)
    physics = Physics(B=1.0, n=settings[0].vine.n, **change.physics)
    if "tail_stretch" in names:
        how = replace(how, sees_end=False)
    pairs: list[tuple[Trial, Track]] = []
    release, dropped = {}, {}
    draws_B, draws_P = (scatter(draw, how.scatter_shape, len(settings)) for _ in range(2))
    for i, (setting, (trial, tube)) in enumerate(zip(settings, stated, strict=True)):
        true = physics._replace(B=setting.vine.B * max(1 + how.damping_scatter * draws_B[i], 0.2))
        tube = tube._replace(pressure=tube.pressure * (1 + how.pressure_scatter * draws_P[i]))
        measured = _film(trial, tube, true, change, how, draw)
        if measured is not None:
            track, release[trial.name], dropped[trial.name] = measured
            pairs.append((trial, track))
    if len(pairs) < 0.8 * len(settings):
        return None
    truth = Truth(
        kind=kind,
        seed=seed,
        effects=names,
        outsider=outsider,
        values=change.values,
        B={trial.vine: setting.vine.B for setting, (trial, _) in zip(settings, stated, strict=True)},
        n=physics.n,
        physics=physics,
        change=change,
        nuisances=how,
        dropped_frames={name: count for name, count in dropped.items() if count},
        release_s=release,
    )
    return Hidden(kind, seed, tuple(pairs), truth)


def _joined(changes: list[Change]) -> Change:
    """All changes at once."""
    out = Change()
    for one in changes:
        sizes = [each.name for each in fields(Change) if each.name not in ("physics", "values")]
        added = {name: getattr(out, name) + getattr(one, name) for name in sizes}
        out = Change({**out.physics, **one.physics}, {**out.values, **one.values}, **added)
    return out


def _stated(
    settings: list[Setting], how: Nuisances, change: Change, draw: np.random.Generator
) -> list[tuple[Trial, Tube]]:
    """What the sheet says of each trial, and what is true of it before it scatters."""
    vines = dict.fromkeys(one.vine for one in settings)
    yields = {vine: how.yield_sigma_kPa * float(np.clip(draw.standard_normal(), -2, 2)) for vine in vines}
    payloads = {load: 1 + how.payload_error * draw.uniform(-1, 1) for load in {one.payload_g for one in settings}}
    sets = {}
    for one in settings:
        key = one.vine, one.pressure_kPa, one.payload_g
        if key not in sets:
            sets[key] = one.pressure_kPa + how.rounding_kPa * draw.uniform(-0.5, 0.5)
    trials, tubes = [], []
    for i, one in enumerate(settings):
        set_kPa = sets[one.vine, one.pressure_kPa, one.payload_g]
        trial = _trial(one, f"t{i + 1:02d}", how.rounding_kPa * round(set_kPa / how.rounding_kPa))
        gain = 1 + change.pressure_gain
        tube = Tube(
            pressure=1e3 * set_kPa * gain + change.pressure_offset_Pa,
            yield_pressure=1e3 * (one.vine.yield_kPa + yields[one.vine]) * gain,
            diameter=trial.diameter_m * (1 + change.diameter),
            thickness=trial.thickness_m,
            length=trial.length_m,
            payload=trial.payload_kg * payloads[one.payload_g] + (change.payload_kg if one.payload_g else 0.0),
            cosine=math.cos(math.radians(one.angle_deg)),
            chamber=one.chamber_l / 1e3 if math.isfinite(one.chamber_l) else math.inf,
            inlet_area=math.pi * (one.inlet_mm / 1e3) ** 2 / 4 if math.isfinite(one.inlet_mm) else math.inf,
            has_bends=float(bool(one.bends_mm)),
            film_density=FILM_KG_M3 * (1 + change.film),
        )
        trials.append(trial)
        tubes.append(tube)
    return list(zip(with_names(trials), tubes, strict=True))


def _trial(one: Setting, name: str, pressure_kPa: float) -> Trial:
    """The row of the sheet, in SI."""
    return Trial(
        name=name,
        capture_fps=one.capture_hz,
        diameter_m=one.vine.diameter_mm / 1e3,
        thickness_m=one.vine.thickness_um / 1e6,
        length_m=one.vine.length_mm / 1e3,
        pressure_Pa=1e3 * pressure_kPa,
        pressure_sigma_Pa=10 * pressure_kPa,
        yield_pressure_Pa=1e3 * one.vine.yield_kPa,
        yield_pressure_sigma_Pa=200.0,
        payload_kg=one.payload_g / 1e3,
        growth_angle_rad=math.radians(one.angle_deg),
        chamber_m3=one.chamber_l / 1e3,
        inlet_m=one.inlet_mm / 1e3,
        bends=tuple(Bend(*(mm / 1e3 for mm in bend)) for bend in one.bends_mm),
    )


def _film(
    trial: Trial, tube: Tube, physics: Physics, change: Change, how: Nuisances, draw: np.random.Generator
) -> tuple[Track, float, int] | None:
    """What camera and gauge make of one trial: track, release on its clock, frames lost; None where it hardly moves."""
    step_s = 1 / trial.capture_fps
    resting = int(draw.integers(how.rest_frames[0], how.rest_frames[1] + 1))
    if draw.uniform() < how.without_rest:
        resting = -int(draw.integers(0, 4))
    release_s = (resting - 1 + float(draw.uniform())) * step_s
    times = np.arange(MOST_FRAMES) * step_s
    # A clock that is wrong by ε shows (1 + ε) t: the frames themselves are that much closer.
    true_times = times / (1 + change.clock) - release_s / (1 + change.clock)
    bends = np.array([(bend.start_m, bend.arc_m, bend.radius_m) for bend in trial.bends]).reshape(-1, 3)
    program = _interrupted(true_times, tube, physics, bends, draw) if physics.static_yield else (None, None)
    out, ended_s = follow(true_times, tube, physics, bends, *program)
    stop = _last_frame(out, true_times, ended_s, tube, how, draw)
    moving = np.flatnonzero(out[:stop, 1] > 0)
    if moving.size < FEWEST_MOVING or out[stop - 1, 1] < 0.25 * tube.length:
        return None
    y = out[:stop, 0]
    position = y * (1 + change.bow_per_m * y) * (1 + change.scale)
    position = position + float(draw.uniform(-0.05, 0.05)) + noise(draw, how, stop)
    keep = np.ones(stop, dtype=bool)
    lost = 0
    if draw.uniform() < how.dropped:
        lost = int(draw.integers(1, 4))
        at = int(draw.integers(moving[0] + 4, max(moving[-1] - 4 - lost, moving[0] + 5)))
        keep[at : at + lost] = False
    return _track(times[: keep.sum()], position[keep], out[:stop, 3][keep], how, draw), release_s, lost


def _interrupted(
    times: Floats, tube: Tube, physics: Physics, bends: Floats, draw: np.random.Generator
) -> tuple[Floats, Floats]:
    """A pressure that is let down when a third is grown, and comes back slowly: times since release, and Pa."""
    plain, _ = follow(times, tube, physics, bends)
    reached = np.flatnonzero(plain[:, 1] > float(draw.uniform(0.25, 0.45)) * tube.length)
    stop_s = times[reached[0]] if reached.size else times[-1] / 2
    fall_s, pause_s, rise_s = 0.02, float(draw.uniform(0.02, 0.06)), float(draw.uniform(0.15, 0.35))
    corners = np.cumsum([stop_s, fall_s, pause_s, rise_s])
    low = 0.5 * tube.yield_pressure
    grid = np.linspace(times[0], times[-1], 4 * times.size)
    return grid, np.interp(grid, corners, [tube.pressure, low, low, tube.pressure])


def _last_frame(
    out: Floats, times: Floats, ended_s: float, tube: Tube, how: Nuisances, draw: np.random.Generator
) -> int:
    """How many frames were kept: to the end of growth and a little more, or to somewhere before it."""
    part, cut, after = float(draw.uniform(0.8, 0.97)), float(draw.uniform(0.35, 0.7)), int(draw.integers(3, 9))
    if draw.uniform() < how.cut_short:
        part = cut
    elif how.sees_end and math.isfinite(ended_s):
        return min(times.size, int(np.searchsorted(times, ended_s)) + after)
    stop = int(np.searchsorted(out[:, 1], part * tube.length))
    # One that stops for good is filmed a little longer; one whose pressure is let down and up again starts anew.
    last_move = int(np.flatnonzero(out[:, 2] > 0)[-1]) if np.any(out[:, 2] > 0) else 0
    halted = np.flatnonzero((np.arange(times.size) > last_move) & (times > 0))
    return min(stop, int(halted[0]) + 30 if halted.size else times.size, times.size)


def _track(time_s: Floats, position_m: Floats, pressure_Pa: Floats, how: Nuisances, draw: np.random.Generator) -> Track:
    gauge = None
    if math.isfinite(how.trace_sigma_kPa):
        gauge = pressure_Pa + 1e3 * how.trace_sigma_kPa * draw.standard_normal(pressure_Pa.size)
    return Track(
        time_s=time_s,
        lead_position_m=position_m,
        lead_position_sigma_m=np.full(time_s.size, math.nan),
        flag=np.full(time_s.size, "", dtype="<U32"),
        edge_px=np.full(time_s.size, math.nan),
        pressure_Pa=gauge,
    )
