"""What can be hidden: sizes of every effect of the catalogue, of pairs, and of things that no catalogue has."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np

from hidden.designs import Setting, Wants


@dataclass(frozen=True)
class Hidden:
    """Changes that one hidden thing makes: to the physics, to the tube as stated, to what the camera reports.

    `values` are the true parameters by the names that the catalogue uses, `pressure_*`, `diameter` and `film` what was
    of what was read, `payload_kg` what every payload weighed beside what was read, `scale`, `bow` and `clock` what is
    reported of what was.
    """

    physics: Mapping[str, float] = field(default_factory=dict)
    values: Mapping[str, float] = field(default_factory=dict)
    pressure_gain: float = 0.0
    pressure_offset_Pa: float = 0.0
    diameter: float = 0.0
    film: float = 0.0
    payload_kg: float = 0.0
    scale: float = 0.0
    bow_per_m: float = 0.0
    clock: float = 0.0


@dataclass(frozen=True)
class Scene:
    """What sizes are measured by: drives ½(P − P_y)A, lengths, speeds, payload and pressures."""

    weakest_N: float
    strongest_N: float
    shortest_m: float
    longest_m: float
    slowest_m_s: float
    weakest_B: float
    payload_kg: float
    weakest_Pa: float
    highest_yield_Pa: float
    highest_Pa: float

    @classmethod
    def of(cls, settings: list[Setting]) -> Scene:
        """What these settings come to."""
        drives = [500 * (one.pressure_kPa - one.vine.yield_kPa) * one.vine.area_m2 for one in settings]
        lengths = [one.vine.length_mm / 1e3 for one in settings]
        speeds = [((2 * d) / one.vine.B) ** (1 / one.vine.n) for d, one in zip(drives, settings, strict=True)]
        return cls(
            min(drives),
            max(drives),
            min(lengths),
            max(lengths),
            min(speeds),
            min(one.vine.B for one in settings),
            max(one.payload_g for one in settings) / 1e3,
            1e3 * min(one.pressure_kPa - one.vine.yield_kPa for one in settings),
            1e3 * max(one.vine.yield_kPa for one in settings),
            1e3 * max(one.pressure_kPa for one in settings),
        )


Draw = np.random.Generator
Maker = Callable[[Draw, Scene], Hidden]


def _between(draw: Draw, low: float, high: float) -> float:
    """Evenly spread over orders of magnitude."""
    return float(np.exp(draw.uniform(math.log(low), math.log(high))))


def _either(draw: Draw, low: float, high: float) -> float:
    return float(draw.choice([-1, 1])) * _between(draw, low, high)


def _one(name: str, parameter: str, low: float, high: float, cap: Callable[[Scene], float] | None = None) -> Maker:
    """An effect of one size: where the generator names it as the catalogue does but for the effect's own name."""

    def make(draw: Draw, scene: Scene) -> Hidden:
        most = high if cap is None else min(high, cap(scene))
        size = _between(draw, low if most > 4 * low or cap is None else most / 4, most)
        return Hidden({parameter: size}, {name: size})

    return make


def _depletion(draw: Draw, scene: Scene) -> Hidden:  # noqa: ARG001
    gamma = float(draw.uniform(1.0, 1.4))
    return Hidden({"gamma": gamma}, {"reservoir_depletion.gamma": gamma})


def _refill(draw: Draw, scene: Scene) -> Hidden:  # noqa: ARG001
    tau, gamma = _between(draw, 0.02, 2.0), float(draw.uniform(1.0, 1.4))
    return Hidden({"gamma": gamma, "refill_s": tau}, {"supply_refill.tau": tau, "supply_refill.gamma": gamma})


def _pressure_damping(draw: Draw, scene: Scene) -> Hidden:
    beta = _either(draw, 2e-6, min(1e-5, 0.7 / scene.highest_Pa))
    return Hidden({"beta": beta}, {"pressure_damping.beta": beta})


def _capstan(draw: Draw, scene: Scene) -> Hidden:
    k, mu = float(draw.uniform(2, 10)), float(draw.uniform(0.2, 1.2))
    most = 0.6 * scene.weakest_N / (math.exp(max(k * scene.longest_m, 3.2 * mu)) - 1)
    C = _between(draw, 0.01 * most, most)
    values = {"capstan_friction.C": C, "capstan_friction.mu_c": mu, "capstan_friction.k": k}
    return Hidden({"capstan_C": C, "capstan_mu": mu, "capstan_k": k}, values)


def _latch(draw: Draw, scene: Scene) -> Hidden:
    F, reach = scene.weakest_N * _between(draw, 0.03, 0.9), _between(draw, 2e-3, 30e-3)
    return Hidden({"latch_F": F, "latch_reach": reach}, {"latch_release.F": F, "latch_release.reach": reach})


def _falling(draw: Draw, scene: Scene) -> Hidden:
    F, speed = scene.weakest_N * _between(draw, 0.1, 0.8), _between(draw, 0.1, 3.0)
    power = float(draw.choice([1.0, 2.0]))
    values = {"falling_friction.F_s": F, "falling_friction.v_s": speed, "falling_friction.k": power}
    return Hidden({"stribeck_F": F, "stribeck_speed": speed, "stribeck_power": power}, values)


def _pulsation(draw: Draw, scene: Scene) -> Hidden:
    # From half a period in the time that a slow trial takes, up to where the vine no longer follows.
    lowest = max(5.0, 0.5 * scene.slowest_m_s / (2 * scene.longest_m))
    a, hz, phase = _between(draw, 0.02, 0.2), _between(draw, lowest, 60.0), float(draw.uniform(-math.pi, math.pi))
    values = {"supply_pulsation.a": a, "supply_pulsation.f": hz, "supply_pulsation.phi": phase}
    return Hidden({"ringing": a, "ringing_hz": hz, "ringing_phase": phase}, values)


def _stop(draw: Draw, scene: Scene) -> Hidden:
    y = scene.shortest_m * float(draw.uniform(0.3, 0.8))
    k = scene.weakest_N / (scene.longest_m - y) * _between(draw, 0.2, 10.0)
    return Hidden({"stop_k": k, "stop_y": y}, {"end_stop.k": k, "end_stop.y_0": y})


def _length_scale(draw: Draw, scene: Scene) -> Hidden:  # noqa: ARG001
    eps = _either(draw, 0.005, 0.1)
    return Hidden(values={"length_scale.eps": eps}, scale=eps)


def _time_base(draw: Draw, scene: Scene) -> Hidden:  # noqa: ARG001
    eps = _either(draw, 0.005, 0.1)
    return Hidden(values={"time_base.eps": eps}, clock=eps)


def _pressure_gain(draw: Draw, scene: Scene) -> Hidden:  # noqa: ARG001
    eps = _either(draw, 0.01, 0.05)
    return Hidden(values={"pressure_gain.eps": eps}, pressure_gain=eps)


def _pressure_gauge(draw: Draw, scene: Scene) -> Hidden:
    delta = _either(draw, 400, 2000)
    if delta < -0.3 * scene.weakest_Pa:
        delta = -delta
    return Hidden(values={"pressure_gauge.delta": delta}, pressure_offset_Pa=delta)


def _film_mass(draw: Draw, scene: Scene) -> Hidden:  # noqa: ARG001
    eps = _either(draw, 0.02, 0.2)
    return Hidden(values={"film_mass.eps": eps}, film=eps)


def _payload_mass(draw: Draw, scene: Scene) -> Hidden:
    # A mount that was not weighed along, or a payload that was weighed with more than went in.
    delta = scene.payload_kg * (_between(draw, 0.05, 0.5) if draw.uniform() < 0.7 else -_between(draw, 0.05, 0.3))
    return Hidden(values={"payload_mass.delta": delta}, payload_kg=delta)


def _area_scale(draw: Draw, scene: Scene) -> Hidden:  # noqa: ARG001
    eps = _either(draw, 0.01, 0.05)
    return Hidden(values={"area_scale.eps": eps}, diameter=eps)


def _perspective(draw: Draw, scene: Scene) -> Hidden:  # noqa: ARG001
    k = _either(draw, 0.003, 0.3)
    return Hidden(values={"perspective.k": k}, bow_per_m=k)


def _static_yield(draw: Draw, scene: Scene) -> Hidden:
    P_s = scene.highest_yield_Pa + scene.weakest_Pa * float(draw.uniform(0.1, 0.6))
    return Hidden({"static_yield": P_s}, {"static_yield.P_s": P_s})


EFFECTS: dict[str, tuple[Maker, Wants]] = {
    "reservoir_depletion": (_depletion, Wants(chamber=True, wide_chamber=True)),
    "supply_refill": (_refill, Wants(chamber=True, wide_chamber=True)),
    "leak": (_one("leak.rate", "leak_rate", 0.005, 5.0, lambda s: s.slowest_m_s / (3 * s.longest_m)), Wants()),
    "inlet_loss": (_one("inlet_loss.K", "K", 0.05, 3.0), Wants(inlet=True, fast=True)),
    "gas_inertia": (_one("gas_inertia.factor", "gas", 0.8, 1.2), Wants(fast=True, quiet=True)),
    "air_drag": (_one("air_drag.C_D", "C_D", 0.7, 3.0), Wants(fast=True, quiet=True)),
    "fold_inertia": (_one("fold_inertia.eta", "eta", 0.2, 1.0), Wants(fast=True)),
    "linear_damping": (_one("linear_damping.b", "b", 0.01, 1.0, lambda s: 0.5 * s.weakest_B), Wants()),
    "pressure_damping": (_pressure_damping, Wants(quiet=True)),
    "tail_friction": (
        _one("tail_friction.mu_w", "mu_w", 0.01, 6.0, lambda s: 1.2 * s.weakest_N / s.longest_m),
        Wants(),
    ),
    "capstan_friction": (_capstan, Wants()),
    "payload_friction": (
        _one("payload_friction.mu_p", "mu_p", 0.1, 1.5, lambda s: 0.5 * s.weakest_N / (s.payload_kg * 9.81)),
        Wants(payload=True),
    ),
    "payload_drag": (
        _one("payload_drag.drag_area", "drag_area", 2e-4, 2e-3),
        Wants(payload=True, fast=True, quiet=True),
    ),
    "wall_stretch": (_one("wall_stretch.kappa", "kappa", 5e-7, 1e-5), Wants()),
    "tail_stretch": (_one("tail_stretch.compliance", "compliance", 2e-8, 1e-7), Wants()),
    "latch_release": (_latch, Wants()),
    "reel_inertia": (_one("reel_inertia.M", "reel_kg", 0.002, 0.1), Wants()),
    "falling_friction": (_falling, Wants()),
    "supply_pulsation": (_pulsation, Wants()),
    "end_stop": (_stop, Wants()),
    "quadratic_length_friction": (
        _one("quadratic_length_friction.q", "square_q", 0.05, 50.0, lambda s: 0.8 * s.weakest_N / s.longest_m**2),
        Wants(),
    ),
    "length_scale": (_length_scale, Wants()),
    "time_base": (_time_base, Wants()),
    "pressure_gain": (_pressure_gain, Wants(quiet=True)),
    "pressure_gauge": (_pressure_gauge, Wants()),
    "area_scale": (_area_scale, Wants(quiet=True)),
    "film_mass": (_film_mass, Wants(quiet=True)),
    "payload_mass": (_payload_mass, Wants(payload=True)),
    "perspective": (_perspective, Wants()),
}
"""Every effect of the catalogue that a vine released at its full pressure can show, at sizes that are plausible."""

INTERRUPTED: dict[str, tuple[Maker, Wants]] = {"static_yield": (_static_yield, Wants())}
"""Effects that show only where the pressure is let down and up again while the camera runs."""

MEASUREMENT = (
    "length_scale",
    "time_base",
    "pressure_gain",
    "pressure_gauge",
    "area_scale",
    "film_mass",
    "payload_mass",
    "perspective",
)

PAIRS: tuple[tuple[str, str], ...] = (
    ("tail_friction", "length_scale"),
    ("reservoir_depletion", "air_drag"),
    ("reservoir_depletion", "tail_stretch"),
    ("latch_release", "air_drag"),
    ("reservoir_depletion", "tail_friction"),
    ("reservoir_depletion", "wall_stretch"),
    ("reservoir_depletion", "fold_inertia"),
    ("tail_friction", "latch_release"),
    ("payload_friction", "reservoir_depletion"),
    ("linear_damping", "tail_stretch"),
    ("reservoir_depletion", "length_scale"),
    ("wall_stretch", "tail_friction"),
)

TRIPLES: tuple[tuple[str, str, str], ...] = (
    ("reservoir_depletion", "tail_friction", "air_drag"),
    ("leak", "inlet_loss", "payload_friction"),
    ("tail_friction", "reel_inertia", "falling_friction"),
    ("reservoir_depletion", "latch_release", "wall_stretch"),
    ("tail_friction", "latch_release", "length_scale"),
)


def _patch(draw: Draw, scene: Scene) -> Hidden:
    y = scene.shortest_m * float(draw.uniform(0.25, 0.7))
    F, width = scene.weakest_N * _between(draw, 0.05, 0.7), scene.shortest_m * float(draw.uniform(0.02, 0.08))
    return Hidden({"patch_F": F, "patch_y": y, "patch_width": width})


def _ripple(draw: Draw, scene: Scene) -> Hidden:
    length = scene.longest_m / float(draw.uniform(3, 9))
    phase = float(draw.uniform(0, 2 * math.pi))
    F = scene.weakest_N * _between(draw, 0.05, 0.6)
    return Hidden({"ripple_F": F, "ripple_length": length, "ripple_phase": phase})


def _growing(draw: Draw, scene: Scene) -> Hidden:
    slowest_s = 2 * scene.longest_m / scene.slowest_m_s
    return Hidden({"growing_F": scene.weakest_N * _between(draw, 0.1, 0.7), "growing_s": slowest_s})


def _changed_film(draw: Draw, scene: Scene) -> Hidden:
    y = scene.shortest_m * float(draw.uniform(0.35, 0.65))
    return Hidden({"step_B": _either(draw, 0.05, 0.3), "step_y": y})


def _cubic(draw: Draw, scene: Scene) -> Hidden:
    return Hidden({"cubic": scene.weakest_N * _between(draw, 0.05, 0.6) / scene.slowest_m_s**3})


def _beyond(draw: Draw, scene: Scene) -> Hidden:
    speed = scene.slowest_m_s * float(draw.uniform(0.3, 0.8))
    return Hidden({"beyond": scene.weakest_N * _between(draw, 0.1, 1.0) / speed**2, "beyond_speed": speed})


def _slip(draw: Draw, scene: Scene) -> Hidden:
    F, speed = scene.weakest_N * _between(draw, 0.2, 0.7), scene.slowest_m_s * float(draw.uniform(0.5, 2.0))
    return Hidden({"slip_F": F, "slip_x": 2 * scene.longest_m, "slip_speed": speed})


def _chirp(draw: Draw, scene: Scene) -> Hidden:
    F, length = scene.weakest_N * _between(draw, 0.1, 0.5), scene.longest_m / float(draw.uniform(1.2, 2.0))
    return Hidden({"chirp_F": F, "chirp_length": length, "chirp_phase": float(draw.uniform(0, 2 * math.pi))})


def _squeeze(draw: Draw, scene: Scene) -> Hidden:
    F, y = scene.weakest_N * _between(draw, 0.05, 0.2), scene.shortest_m * float(draw.uniform(0.3, 0.6))
    pressure_Pa = scene.weakest_Pa + scene.highest_yield_Pa
    return Hidden({"squeeze_F": F, "squeeze_Pa": pressure_Pa, "squeeze_y": y, "squeeze_width": 0.15 * scene.shortest_m})


OUTSIDERS: dict[str, tuple[Maker, Wants]] = {
    "rough_patch": (_patch, Wants()),
    "ripple": (_ripple, Wants()),
    "growing_friction": (_growing, Wants()),
    "changed_film": (_changed_film, Wants()),
    "cubic": (_cubic, Wants()),
    "beyond_a_speed": (_beyond, Wants()),
    "slip": (_slip, Wants()),
    "chirp": (_chirp, Wants()),
    "squeeze": (_squeeze, Wants()),
}
"""Forces that are in no catalogue: a rough patch, a ripple along the film, one that grows with time, a film that
changes half-way, one with the third power of the speed, one with the square of what is beyond a speed. The last three
are in no list of simple laws either: a friction that grows with the travel and levels off with the speed, waves along
the growth that become shorter, and a force with the square of the pressure beyond a place."""

NULLS = (
    "anything",
    "white",
    "correlated",
    "moving_average",
    "mixed_noise",
    "heavy_tails",
    "outliers",
    "unequal_noise",
    "large_B_scatter",
    "large_P_scatter",
    "odd_scatter",
    "no_scatter",
    "low_noise",
    "high_noise",
    "few_trials",
    "no_rest",
    "payload_errors",
    "cut_short",
    "rounded",
    "trace",
)
"""Regimes of campaigns in which nothing is missing."""

KINDS: tuple[str, ...] = (
    *(f"null:{name}" for name in NULLS),
    *EFFECTS,
    *("+".join(pair) for pair in PAIRS),
    *("+".join(triple) for triple in TRIPLES),
    *(f"outsider:{name}" for name in OUTSIDERS),
    "frames:dropped",
    "trace:static_yield",
    "trace:reservoir_depletion",
    "trace:air_drag",
    "trace:tail_friction",
    "bends:capstan_friction",
)


def kinds(group: str) -> tuple[str, ...]:
    """Kinds of a group: nulls, effects, pairs, triples, outsiders, faults, other, all; or kinds in a comma list."""
    groups = {
        "all": KINDS,
        "nulls": tuple(k for k in KINDS if k.startswith("null:")),
        "effects": tuple(EFFECTS),
        "physical": tuple(k for k in EFFECTS if k not in MEASUREMENT),
        "faults": (*MEASUREMENT, "frames:dropped"),
        "pairs": tuple("+".join(pair) for pair in PAIRS),
        "triples": tuple("+".join(triple) for triple in TRIPLES),
        "outsiders": tuple(k for k in KINDS if k.startswith("outsider:")),
        "other": tuple(k for k in KINDS if k.startswith(("trace:", "bends:", "frames:"))),
    }
    chosen: list[str] = []
    for name in group.split(","):
        known = groups.get(name) or ((name,) if name in KINDS else ())
        if not known:
            raise SystemExit(f"There is no kind {name!r}; groups are {', '.join(groups)}; kinds {', '.join(KINDS)}.")
        chosen += [kind for kind in known if kind not in chosen]
    return tuple(chosen)
