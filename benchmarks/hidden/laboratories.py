"""Faults that laboratories have, each a function from one laboratory to another, to be put one after the other.

    laboratory = worn(0.01, 0.03)(in_rising_order(careful(settings, draw), draw), draw)

None of them is physics that a vine lacks, but `effect`, which hides an effect of the catalogue for comparison.
"""

from __future__ import annotations

import math
from collections import defaultdict
from dataclasses import replace
from typing import Any

import numpy as np

from hidden.kinds import EFFECTS, Scene
from hidden.shots import Draw, Fault, Laboratory, Shot

LENS_FIELD = 0.5
"""Half of the field of view in parts of the longest vine: the picture holds it all."""


def together(*faults: Fault) -> Fault:
    """All of these, the first first."""

    def apply(laboratory: Laboratory, draw: Draw) -> Laboratory:
        for fault in faults:
            laboratory = fault(laboratory, draw)
        return laboratory

    return apply


# Order, specimens, days.


def in_rising_order(laboratory: Laboratory, draw: Draw) -> Laboratory:  # noqa: ARG001
    """Vine after vine, and in each the pressures from low to high."""
    first = {shot.setting.vine: i for i, shot in reversed(list(enumerate(laboratory.shots)))}
    shots = sorted(
        laboratory.shots,
        key=lambda s: (first[s.setting.vine], s.setting.pressure_kPa, s.setting.payload_g, s.setting.replicate),
    )
    return replace(laboratory, shots=tuple(shots))


def by_vine(laboratory: Laboratory, draw: Draw) -> Laboratory:  # noqa: ARG001
    """Vine after vine, otherwise as it was."""
    first = {shot.setting.vine: i for i, shot in reversed(list(enumerate(laboratory.shots)))}
    return replace(laboratory, shots=tuple(sorted(laboratory.shots, key=lambda s: first[s.setting.vine])))


def worn(low: float, high: float) -> Fault:
    """B rises by an equal part, between `low` and `high`, with every trial that a tube has seen."""

    def apply(laboratory: Laboratory, draw: Draw) -> Laboratory:
        rate = float(draw.uniform(low, high))
        seen: dict[tuple[object, str], int] = defaultdict(int)
        shots = []
        for shot in laboratory.shots:
            key = shot.setting.vine, shot.specimen
            shots.append(_changed(shot, B=1 + rate * seen[key]))
            seen[key] += 1
        return replace(laboratory, shots=tuple(shots)).known(wear=rate)

    return apply


def new_tubes(every: int, sigma: float) -> Fault:
    """After so many trials of a vine another tube is taken, whose B differs by `sigma`."""

    def apply(laboratory: Laboratory, draw: Draw) -> Laboratory:
        seen: dict[object, int] = defaultdict(int)
        factors: dict[tuple[object, int], float] = {}
        shots = []
        for shot in laboratory.shots:
            vine = shot.setting.vine
            which = seen[vine] // every
            seen[vine] += 1
            factor = factors.setdefault((vine, which), 1 + sigma * float(np.clip(draw.standard_normal(), -2.5, 2.5)))
            shots.append(replace(_changed(shot, B=factor), specimen=chr(ord("a") + which)))
        return replace(laboratory, shots=tuple(shots)).known(specimen_sigma=sigma)

    return apply


def another_for_high_pressures(laboratory: Laboratory, draw: Draw) -> Laboratory:  # noqa: ARG001
    """The upper half of the pressures of each vine was filmed with another tube: B + 8 %, P_y + 0.3 kPa."""
    levels = defaultdict(set)
    for shot in laboratory.shots:
        levels[shot.setting.vine].add(shot.setting.pressure_kPa)
    shots = []
    for shot in laboratory.shots:
        known = sorted(levels[shot.setting.vine])
        high = shot.setting.pressure_kPa >= known[len(known) // 2]
        shots.append(replace(_changed(shot, B=1.08, yield_Pa=300.0), specimen="b") if high else shot)
    return replace(laboratory, shots=tuple(shots)).known(specimen_B=0.08, specimen_yield_Pa=300.0)


def tube_each_condition(laboratory: Laboratory, draw: Draw) -> Laboratory:
    """Every condition has its own tube: B and P_y differ by 8 %."""
    return _tubes_by(laboratory, draw, lambda s: (s.vine, s.pressure_kPa, s.payload_g), 0.08)


def tube_each_replicate(laboratory: Laboratory, draw: Draw) -> Laboratory:
    """The first replicates of all conditions were made with one tube, the second with another, and so on."""
    return _tubes_by(laboratory, draw, lambda s: (s.vine, s.replicate), 0.08)


def tubes_alike(sigma: float) -> Fault:
    """Replicates with a tube each, whose B and P_y differ by so much."""

    def apply(laboratory: Laboratory, draw: Draw) -> Laboratory:
        return _tubes_by(laboratory, draw, lambda s: (s.vine, s.replicate), sigma)

    return apply


def two_rows_exchanged(laboratory: Laboratory, draw: Draw) -> Laboratory:
    """Two trials of a vine have each other's row in the sheet: their pressures differ by a third at least."""
    shots = list(laboratory.shots)
    pairs = [
        (i, j)
        for i, one in enumerate(shots)
        for j, other in enumerate(shots)
        if one.setting.vine == other.setting.vine
        and one.setting.payload_g == other.setting.payload_g
        and other.setting.pressure_kPa > 1.33 * one.setting.pressure_kPa
    ]
    i, j = pairs[draw.integers(len(pairs))]
    shots[i], shots[j] = (replace(shots[i], setting=shots[j].setting), replace(shots[j], setting=shots[i].setting))
    return replace(laboratory, shots=tuple(shots))


def two_tubes_mixed(laboratory: Laboratory, draw: Draw) -> Laboratory:
    """Two tubes of each vine, whichever was at hand: B + 8 %, P_y + 0.3 kPa for the second."""
    shots = []
    for shot in laboratory.shots:
        second = draw.uniform() < 0.5
        shots.append(replace(_changed(shot, B=1.08, yield_Pa=300.0), specimen="b") if second else shot)
    return replace(laboratory, shots=tuple(shots)).known(specimen_B=0.08, specimen_yield_Pa=300.0)


def _tubes_by(laboratory: Laboratory, draw: Draw, key, sigma: float) -> Laboratory:
    """One tube for all trials with the same key; B and P_y of each differ by `sigma`."""
    found: dict[object, tuple[str, float, float]] = {}
    named: dict[object, int] = defaultdict(int)
    shots = []
    for shot in sorted(laboratory.shots, key=lambda s: str(key(s.setting))):
        which = key(shot.setting)
        if which not in found:
            name = chr(ord("a") + named[shot.setting.vine])
            named[shot.setting.vine] += 1
            found[which] = (name, *(1 + sigma * float(np.clip(z, -2, 2)) for z in draw.standard_normal(2)))
    for shot in laboratory.shots:
        name, B, P_y = found[key(shot.setting)]
        changed = _changed(shot, B=B, yield_Pa=(P_y - 1) * 1e3 * shot.setting.vine.yield_kPa)
        shots.append(replace(changed, specimen=name))
    return replace(laboratory, shots=tuple(shots)).known(specimen_sigma=sigma)


def exponents_apart(step: float) -> Fault:
    """The second vine has an exponent larger by `step`; its B is such that its median speed stays."""

    def apply(laboratory: Laboratory, draw: Draw) -> Laboratory:
        vines = list(dict.fromkeys(shot.setting.vine for shot in laboratory.shots))
        sign = float(draw.choice([-1, 1]))
        shots = []
        for shot in laboratory.shots:
            vine = shot.setting.vine
            if vine != vines[1]:
                shots.append(shot)
                continue
            n = vine.n + sign * step
            typical_m_s = 3.0
            B = shot.physics.B * typical_m_s ** (vine.n - n)
            shots.append(replace(shot, physics=shot.physics._replace(B=B, n=n)))
        return replace(laboratory, shots=tuple(shots)).known(n_step=sign * step)

    return apply


def _changed(shot: Shot, B: float = 1.0, yield_Pa: float = 0.0) -> Shot:
    """With B times so much, and so much more of yield pressure."""
    return replace(
        shot,
        physics=shot.physics._replace(B=shot.physics.B * B),
        tube=shot.tube._replace(yield_pressure=max(shot.tube.yield_pressure + yield_Pa, 0.0)),
    )


# Camera and positions.


def wild_points(share: float, low_mm: float, high_mm: float) -> Fault:
    """So many of the points, as a part of all, are off by so much, either way."""

    def apply(laboratory: Laboratory, draw: Draw) -> Laboratory:  # noqa: ARG001
        camera = replace(laboratory.camera, wild_share=share, wild_m=(low_mm / 1e3, high_mm / 1e3))
        return replace(laboratory, camera=camera)

    return apply


def blur(seconds: float) -> Fault:
    """White noise of this time multiplied by the speed of the edge."""

    def apply(laboratory: Laboratory, draw: Draw) -> Laboratory:  # noqa: ARG001
        return replace(laboratory, camera=replace(laboratory.camera, blur_s=seconds))

    return apply


def lens(low_mm: float, high_mm: float, *, quintic: bool = False) -> Fault:
    """A lens that shifts the ends of the picture by so much, outwards or inwards; its middle is near the half-way.

    With `quintic` the law has a fifth power as well, up to a third of the shift, and barrels only.
    """

    def apply(laboratory: Laboratory, draw: Draw) -> Laboratory:
        longest = _longest(laboratory)
        half = LENS_FIELD * longest
        shift = float(draw.uniform(low_mm, high_mm)) / 1e3 * (-1.0 if quintic else float(draw.choice([-1, 1])))
        share = float(draw.choice([0.0, draw.uniform(0, 1 / 3)])) if quintic else 0.0
        centre = longest * float(draw.uniform(0.45, 0.55))
        k3 = shift * (1 - share) / half**3
        camera = replace(
            laboratory.camera, lens_k3=k3, lens_k5=shift * share / half**5, lens_centre_m=centre, sees_end=False
        )
        return replace(laboratory, camera=camera).known(**{"lens.k3": k3, "lens_shift_m": shift})

    return apply


def rolling(laboratory: Laboratory, draw: Draw) -> Laboratory:
    """The rows of a picture are read one after the other, over half of a frame's time to all of it."""
    longest, hz = _longest(laboratory), laboratory.shots[0].setting.capture_hz
    delay = float(draw.choice([-1, 1])) * float(draw.uniform(0.5, 0.95)) / hz / (1.1 * longest)
    camera = replace(laboratory.camera, row_delay_s_m=delay, lens_centre_m=longest / 2)
    return replace(laboratory, camera=camera).known(row_delay_s_m=delay)


def smoothed(frames: tuple[int, ...], degree: int = 0) -> Fault:
    """Positions are smoothed over one of these odd numbers of frames, by polynomials."""

    def apply(laboratory: Laboratory, draw: Draw) -> Laboratory:
        chosen = int(draw.choice(frames))
        camera = replace(laboratory.camera, smoothed=chosen, smoothed_degree=degree)
        hz = laboratory.shots[0].setting.capture_hz
        return replace(laboratory, camera=camera).known(**{"moving_average.T2": (chosen**2 - 1) / hz**2})

    return apply


def clicked(digit_m: float, kept_every: int) -> Fault:
    """Positions are clicked by hand on one frame in several, to whole millimetres, say."""

    def apply(laboratory: Laboratory, draw: Draw) -> Laboratory:  # noqa: ARG001
        camera = replace(laboratory.camera, digit_m=digit_m, kept_every=kept_every)
        return replace(laboratory, camera=camera).known(digit_m=digit_m)

    return apply


def trace_off(low_ms: float, high_ms: float) -> Fault:
    """The pressure is recorded along, by a clock that is off by so much, either way."""

    def apply(laboratory: Laboratory, draw: Draw) -> Laboratory:
        late = float(draw.choice([-1, 1])) * float(draw.uniform(low_ms, high_ms)) / 1e3
        return replace(laboratory, camera=replace(laboratory.camera, trace_late_s=late)).known(trace_late_s=late)

    return apply


def lagging_gauge(low_ms: float, high_ms: float) -> Fault:
    """The pressure is recorded along, by a gauge of such a time constant."""

    def apply(laboratory: Laboratory, draw: Draw) -> Laboratory:
        lag = float(draw.uniform(low_ms, high_ms)) / 1e3
        camera = replace(laboratory.camera, trace_late_s=0.0, gauge_lag_s=lag)
        return replace(laboratory, camera=camera).known(gauge_lag_s=lag)

    return apply


def slow_gauge(low_Hz: float, high_Hz: float, sigma_Pa: float, **how: Any) -> Fault:
    """The pressure is read so many times a second, fewer than there are frames, with noise; `how` as of `Camera`."""

    def apply(laboratory: Laboratory, draw: Draw) -> Laboratory:
        rate = float(draw.uniform(low_Hz, high_Hz))
        camera = replace(laboratory.camera, trace_late_s=0.0, trace_sigma_Pa=sigma_Pa, gauge_Hz=rate, **how)
        return replace(laboratory, camera=camera).known(gauge_Hz=rate)

    return apply


def coarse_gauge(digit_Pa: float, low_sigmas: float, high_sigmas: float) -> Fault:
    """The pressure is read at every frame in steps of a digit, with noise of so many digits."""

    def apply(laboratory: Laboratory, draw: Draw) -> Laboratory:
        sigma_Pa = digit_Pa * float(draw.uniform(low_sigmas, high_sigmas))
        camera = replace(laboratory.camera, trace_late_s=0.0, trace_sigma_Pa=sigma_Pa, gauge_digit_Pa=digit_Pa)
        return replace(laboratory, camera=camera).known(gauge_sigma_Pa=sigma_Pa)

    return apply


def filtered_gauge(low_Hz: float, high_Hz: float, sigma_Pa: float) -> Fault:
    """The noise of the gauge went through a filter of so many hertz, and so lasts for several frames."""

    def apply(laboratory: Laboratory, draw: Draw) -> Laboratory:
        band = float(draw.uniform(low_Hz, high_Hz))
        rho = math.exp(-2 * math.pi * band / laboratory.shots[0].setting.capture_hz)
        camera = replace(laboratory.camera, trace_late_s=0.0, trace_sigma_Pa=sigma_Pa, gauge_rho=rho)
        return replace(laboratory, camera=camera).known(gauge_band_Hz=band)

    return apply


def _longest(laboratory: Laboratory) -> float:
    return max(shot.tube.length for shot in laboratory.shots)


# Rig.


def valve(law: str, low_ms: float, high_ms: float) -> Fault:
    """The pressure comes up through a valve, in so many milliseconds."""

    def apply(laboratory: Laboratory, draw: Draw) -> Laboratory:
        opening = float(draw.uniform(low_ms, high_ms)) / 1e3
        shots = tuple(replace(shot, valve_s=opening, valve_law=law) for shot in laboratory.shots)
        return replace(laboratory, shots=shots).known(valve_s=opening)

    return apply


def slack_tail(laboratory: Laboratory, draw: Draw) -> Laboratory:  # noqa: ARG001
    """No tail pushes."""
    return replace(laboratory, shots=tuple(replace(shot, slack=True) for shot in laboratory.shots))


def chamber_misread(low: float, high: float) -> Fault:
    """A closed chamber whose volume is this many times what the sheet says: hoses, a valve, a tank's nominal size."""

    def apply(laboratory: Laboratory, draw: Draw) -> Laboratory:
        times, gamma = float(draw.uniform(low, high)), float(draw.uniform(1.0, 1.4))
        shots = (replace(s, tube=s.tube._replace(chamber=times * s.tube.chamber)) for s in laboratory.shots)
        return physics(gamma=gamma)(replace(laboratory, shots=tuple(shots)), draw).known(chamber_times=times)

    return apply


def inlet_half(laboratory: Laboratory, draw: Draw) -> Laboratory:  # noqa: ARG001
    """Connectors half as wide as the vine, as the sheet says."""
    shots = []
    for shot in laboratory.shots:
        inlet_mm = round(0.5 * shot.setting.vine.diameter_mm, 2)
        area = math.pi * (inlet_mm / 1e3) ** 2 / 4
        shots.append(
            replace(shot, setting=replace(shot.setting, inlet_mm=inlet_mm), tube=shot.tube._replace(inlet_area=area))
        )
    return replace(laboratory, shots=tuple(shots))


def physics(**sizes: float) -> Fault:
    """These sizes act on every trial, by the names of `hidden.motion.Physics`."""

    def apply(laboratory: Laboratory, draw: Draw) -> Laboratory:  # noqa: ARG001
        shots = tuple(replace(shot, physics=shot.physics._replace(**sizes)) for shot in laboratory.shots)
        return replace(laboratory, shots=shots)

    return apply


def drag_beside_inlet(laboratory: Laboratory, draw: Draw) -> Laboratory:
    """A loss of K = 1 at the connector, and air that drags at the head."""
    C_D = float(draw.uniform(0.8, 1.5))
    return physics(K=1.0, C_D=C_D)(laboratory, draw).known(**{"inlet_loss.K": 1.0, "air_drag.C_D": C_D})


def effect(name: str) -> Fault:
    """An effect of the catalogue, the larger of two sizes drawn."""

    def apply(laboratory: Laboratory, draw: Draw) -> Laboratory:
        scene = Scene.of([shot.setting for shot in laboratory.shots])
        drawn = [EFFECTS[name][0](draw, scene) for _ in range(2)]
        change = max(drawn, key=lambda one: abs(next(iter(one.values.values()))))
        camera = replace(laboratory.camera, scale=change.scale, clock=change.clock)
        if change.scale:
            camera = replace(camera, sees_end=True)
        changed = physics(**change.physics)(replace(laboratory, camera=camera), draw)
        return changed.known(**change.values)

    return apply


def few(low: int, high: int) -> Fault:
    """Only so many of the trials were made, of one vine, at two settings or more."""

    def apply(laboratory: Laboratory, draw: Draw) -> Laboratory:
        vine = laboratory.shots[0].setting.vine
        shots = [shot for shot in laboratory.shots if shot.setting.vine == vine]
        count = min(int(draw.integers(low, high + 1)), len(shots))
        chosen = shots[:count]
        other = [shot for shot in shots if shot.setting.pressure_kPa != shots[0].setting.pressure_kPa]
        if len({shot.setting.pressure_kPa for shot in chosen}) == 1:
            chosen = [*chosen[:-1], other[0]]
        return replace(laboratory, shots=tuple(chosen))

    return apply
