"""Simple laws that a missing force may follow, each with its description in words.

Every law is scaled to a peak of 1 along the fitted motions, so that its amplitude is the largest force, N. A periodic
law has two amplitudes, of a sine and a cosine. Laws with a position or a scale come in a grid of them.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from types import CodeType, SimpleNamespace
from typing import NamedTuple

import numpy as np

from vinetrack.core.records import Floats
from vinetrack.diagnosis.force_inversion import FittedMotion

EDGE_FRACTION = 0.1  # Part of a patch's width over which the force rises at each end (chosen)


@dataclass(frozen=True)
class Law:
    """One form of force along a motion: its kind, by its name in `FORMS`, the values of its shape parameters, SI, and
    the kind that it is multiplied by: "position", "speed", "pressure" or nothing. The phase of a periodic law is free.
    """

    kind: str
    shapes: tuple[float, ...] = ()
    factor: str = ""
    reference_area_m2: float = 0.0
    peak: float = 1.0

    @property
    def name(self) -> str:
        """Name of the law: its kind and factor."""
        return f"{self.kind}_by_{self.factor}" if self.factor else self.kind

    @property
    def n_amplitudes(self) -> int:
        """Number of its amplitudes."""
        return 2 if self.kind == "periodic" else 1

    @property
    def n_shapes(self) -> int:
        """Number of shape parameters that are searched over."""
        return sum(len(shape.parts) > 1 for shape in FORMS[self.kind].shapes)

    @property
    def is_unresolved(self) -> bool:
        """Whether it acts over less than a millimetre, which no camera that films the whole growth resolves."""
        # 1e-3: least width of a local force that is reported (chosen)
        return self.kind == "patch" and not sum(self.shapes) - max(self.shapes[0], 0.0) > 1e-3

    def unit_force(self, motion: FittedMotion) -> Floats:
        """The force of each unit amplitude along a motion: as it is and, where periodic, a quarter of a period ahead.
        Shape (n_times, n_amplitudes).
        """
        size = (motion.trial.area_m2 / self.reference_area_m2 if self.reference_area_m2 else 1.0) / self.peak
        phases = [self.shapes, (*self.shapes[:1], math.pi / 2)][: self.n_amplitudes]
        force = np.column_stack([FORMS[self.kind].along(motion, shapes) for shapes in phases])
        return size * (force * FORMS[self.factor].along(motion)[:, None] if self.factor else force)


# States of a motion by their names in an effect file
STATE = {
    "lead_position": "lead_position_m", "tail_position": "tail_position_m", "tail_velocity": "tail_velocity_m_s",
    "pressure": "pressure_Pa", "time": "time_s",
}  # fmt: skip


class Shape(NamedTuple):
    """A shape parameter of a law as an effect file holds it, and the values that are tried, as parts of the largest
    growth, speed or time; values beyond 0 are spaced by ratios.
    """

    name: str
    symbol: str
    unit: str
    parts: tuple[float, ...]


@dataclass(frozen=True)
class LawForm:
    """A kind of law as an effect file holds it: its size (name, symbol, unit), its
    shape as code and as a formula, and its shape parameters, of the dimension of `largest`. `times` is what it is also
    tried multiplied by.
    """

    size: tuple[str, str, str]
    code: str
    formula: str
    largest: str = ""
    shapes: tuple[Shape, ...] = ()
    times: tuple[str, ...] = ()

    @cached_property
    def _compiled(self) -> CodeType:
        return compile(self.code, "law", "eval")

    def along(self, motion: FittedMotion, shapes: Sequence[float] = ()) -> Floats:
        """The shape along a motion, as its code says, shape (n_times,)."""
        state = SimpleNamespace(**{name: getattr(motion, attribute) for name, attribute in STATE.items()})
        known = dict(zip((shape.name for shape in self.shapes), shapes, strict=True))
        return np.asarray(eval(self._compiled, {"np": np, "s": state, **known}) + 0.0 * motion.time_s)


_FORCE = ("F", "F", "N")
_BY_BOTH, _BY_PRESSURE = ("speed", "pressure"), ("pressure",)
_SETS_IN, _DECAYS = tuple(((np.arange(8) + 0.5) / 8).tolist()), (0.04, 0.1, 0.2, 0.4)
_V_1 = (Shape("v_1", "v₁", "m/s", _SETS_IN),)
# All parts that are tried are chosen; below 0.05 of the highest speed 1/ẋ is held constant, as a vine starts from rest.
FORMS = {
    "constant": LawForm(_FORCE, "1.0", "F"),
    "position": LawForm(("k", "k", "N/m"), "s.tail_position", "k x", times=_BY_BOTH),
    "speed": LawForm(("b", "b", "N·s/m"), "s.tail_velocity", "b ẋ", times=_BY_PRESSURE),
    "speed_squared": LawForm(
        ("c", "c", "N·s²/m²"), "s.tail_velocity * s.tail_velocity", "c ẋ²", times=("position", "pressure")
    ),
    "position_squared": LawForm(("q", "q", "N/m²"), "s.tail_position * s.tail_position", "q x²", times=_BY_BOTH),
    "beyond_a_place": LawForm(
        ("k", "k", "N/m"), "np.maximum(s.lead_position - y_0, 0.0)", "k max(0, y − y₀)", "growth",
        (Shape("y_0", "y₀", "m", _SETS_IN),), _BY_BOTH,
    ),
    "speed_cubed": LawForm(("c", "c", "N·s³/m³"), "s.tail_velocity * s.tail_velocity * s.tail_velocity", "c ẋ³"),
    "beyond_a_speed": LawForm(
        ("b", "b", "N·s/m"), "np.maximum(s.tail_velocity - v_1, 0.0)", "b max(0, ẋ − v₁)", "speed", _V_1
    ),
    "squared_beyond_a_speed": LawForm(
        ("c", "c", "N·s²/m²"), "np.maximum(s.tail_velocity - v_1, 0.0) ** 2", "c max(0, ẋ − v₁)²", "speed", _V_1
    ),
    "pressure": LawForm(("a", "a", "N/Pa"), "s.pressure", "a P"),
    "time": LawForm(("r", "r", "N/s"), "s.time", "r t"),
    "inverse_speed": LawForm(
        _FORCE, "v_0 / np.maximum(s.tail_velocity, v_0)", "F v₀/max(ẋ, v₀)", "speed",
        (Shape("v_0", "v₀", "m/s", (0.05,)),), _BY_PRESSURE,
    ),
    "falling_with_speed": LawForm(
        _FORCE, "np.exp(-s.tail_velocity / v_0)", "F exp(−ẋ/v₀)", "speed",
        (Shape("v_0", "v₀", "m/s", _DECAYS),), _BY_PRESSURE,
    ),
    "fading_in_time": LawForm(
        _FORCE, "np.exp(-s.time / t_0)", "F exp(−t/t₀)", "time", (Shape("t_0", "t₀", "s", _DECAYS),)
    ),
    "fading_along": LawForm(
        _FORCE, "np.exp(-s.lead_position / reach)", "F exp(−y/ℓ)", "growth",
        (Shape("reach", "ℓ", "m", _DECAYS),), _BY_BOTH,
    ),
    "patch": LawForm(
        _FORCE,
        f"0.5 * (np.tanh((s.lead_position - y_1) / ({EDGE_FRACTION} * width))"
        f" - np.tanh((s.lead_position - y_1 - width) / ({EDGE_FRACTION} * width)))",
        f"½F (tanh((y − y₁)/{EDGE_FRACTION}w) − tanh((y − y₁ − w)/{EDGE_FRACTION}w))",
        "growth",
        (
            Shape("y_1", "y₁", "m", tuple(((np.arange(17) - 1) / 16).tolist())),
            Shape("width", "w", "m", (0.06, 0.12, 0.2, 0.33)),
        ),
        _BY_BOTH,
    ),
    "periodic": LawForm(
        _FORCE, "np.sin(2.0 * np.pi * s.lead_position / period + phi)", "F sin(2π y/Λ + φ)", "growth",
        (Shape("period", "Λ", "m", tuple(np.geomspace(0.04, 0.6, 24).tolist())), Shape("phi", "φ", "rad", (0.0,))),
    ),
}  # fmt: skip


def laws_on_grid(motions: Sequence[FittedMotion]) -> list[Law]:
    """The grid of all laws; where vines differ in width, also each in proportion to the cross-section."""
    largest = _largest(motions)
    laws = [
        Law(kind, tuple(part * largest[form.largest] for part in parts), factor)
        for kind, form in FORMS.items()
        for parts in itertools.product(*(shape.parts for shape in form.shapes))
        for factor in ("", *form.times)
    ]
    areas = [motion.trial.area_m2 for motion in motions]
    # 1.02: ratio of cross-sections up to which two vines count as equally wide (chosen)
    if max(areas) > 1.02 * min(areas):
        mean_m2 = float(np.mean(areas))
        laws += [replace(law, reference_area_m2=mean_m2) for law in laws if "pressure" not in (law.kind, law.factor)]
    return _with_unit_peak(laws, motions)


def laws_near(law: Law, motions: Sequence[FittedMotion], part: float) -> list[Law]:
    """Laws near another: each shape that is searched over varied by less than this part of a step of the grid."""
    form, varied = FORMS[law.kind], []
    for value, shape in zip(law.shapes, form.shapes, strict=True):
        first, last, steps = shape.parts[0], shape.parts[-1], max(len(shape.parts) - 1, 1)
        change = part * np.linspace(-0.75, 0.75, 9 if len(shape.parts) > 1 else 1) / steps
        if first > 0:
            varied.append(value * (last / first) ** change)
        else:
            varied.append(value + _largest(motions)[form.largest] * (last - first) * change)
    return _with_unit_peak(
        [replace(law, shapes=tuple(map(float, each))) for each in itertools.product(*varied)], motions
    )


def _with_unit_peak(laws: Sequence[Law], motions: Sequence[FittedMotion]) -> list[Law]:
    """The laws scaled to a peak of 1 along the motions, without patches that act only at the start. Those that peak at
    rest, where positions do not determine the speed, are scaled to 1 at the lowest speed observed.
    """
    # 0.05: part of the growth over which a vine accelerates; the size of a law at rest is not observed (chosen)
    started = [(motion.lead_position_m >= 0.05 * motion.lead_position_m.max())[motion.is_visited] for motion in motions]
    scaled = []
    for law in (replace(law, peak=1.0) for law in laws):
        forces = [np.abs(law.unit_force(motion))[motion.is_visited] for motion in motions]
        peak = 1.0 if law.kind == "periodic" else max(float(force.max()) for force in forces)
        peak_after_start = max(
            float(np.max(force[after], initial=0.0)) for force, after in zip(forces, started, strict=True)
        )
        if law.kind in ("inverse_speed", "falling_with_speed"):
            peak = peak_after_start
        if law.kind != "patch" or peak_after_start >= 0.5 * peak:
            scaled.append(replace(law, peak=peak or 1.0))
    return scaled


def _largest(motions: Sequence[FittedMotion]) -> dict[str, float]:
    """The largest growth, m, speed of the tail, m/s, and time, s, among the motions."""
    return {
        "growth": max(float(motion.lead_position_m[motion.is_visited].max()) for motion in motions),
        "speed": max(float(np.quantile(motion.tail_velocity_m_s[motion.is_visited], 0.98)) for motion in motions),
        "time": max(float(motion.time_s[motion.is_visited].max()) for motion in motions),
    }
