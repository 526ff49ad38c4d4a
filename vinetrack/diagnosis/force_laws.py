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

import numpy as np

from vinetrack.core.problems import remark
from vinetrack.core.records import Floats
from vinetrack.diagnosis.force_inversion import FittedMotion

PATCH_CENTRES = 16  # Number of positions of a local force (chosen)


EDGE_FRACTION = 0.1  # Part of a patch's width over which the force rises at each end (chosen)


@dataclass(frozen=True)
class Law:
    """One form of force along a motion. `kind` names it; `low` and `high` are the ends of a patch (m of growth),
    `scale` its period, decay scale or threshold. `factor` is the variable that it is multiplied by: "position",
    "speed", "pressure" or nothing.
    """

    kind: str
    low: float = math.nan
    high: float = math.nan
    scale: float = math.nan
    reference_area_m2: float = 0.0
    peak: float = 1.0
    factor: str = ""

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
        return {"patch": 2, "inverse_speed": 0}.get(self.kind, int(math.isfinite(self.scale)))

    @property
    def n_parameters(self) -> int:
        """Number of parameters; a factor counts as one, because it was chosen among several."""
        return self.n_amplitudes + self.n_shapes + bool(self.factor)

    @property
    def variables(self) -> tuple[str, ...]:
        """The variables that it depends on: growth, speed, time or pressure; none for a constant."""
        variables = {FORMS[kind].variable for kind in (self.kind, self.factor) if kind}
        return tuple(name for name in ("growth", "speed", "time", "pressure") if name in variables)

    @property
    def is_unresolved(self) -> bool:
        """Whether it acts over less than a millimetre, which no camera that films the whole growth resolves."""
        # 1e-3: least width of a local force that is reported (chosen)
        return self.kind == "patch" and not self.high - max(self.low, 0.0) > 1e-3

    @property
    def shape_values(self) -> tuple[float, ...]:
        """Values of the shape parameters of its form, SI; the phase of a periodic law is free."""
        if self.kind == "patch":
            return self.low, self.high - self.low
        return (self.scale, 0.0) if self.kind == "periodic" else (self.scale,) * len(FORMS[self.kind].shapes)

    def unit_force(self, motion: FittedMotion) -> Floats:
        """The force of each unit amplitude along a motion: as it is and, where periodic, a quarter of a period ahead.
        Shape (n_times, n_amplitudes).
        """
        size = (motion.trial.area_m2 / self.reference_area_m2 if self.reference_area_m2 else 1.0) / self.peak
        phases = [self.shape_values] if self.kind != "periodic" else [(self.scale, 0.0), (self.scale, math.pi / 2)]
        force = np.column_stack([FORMS[self.kind].along(motion, shapes) for shapes in phases])
        return size * (force * FORMS[self.factor].along(motion)[:, None] if self.factor else force)

    def words(self, amplitude_N: Sequence[float], sigma_N: float) -> str:
        """Describe the law with its size."""
        return str(remark("law", law=self, amplitude_N=amplitude_N, sigma_N=sigma_N))


# States of a motion by their names in an effect file
STATE = {
    "lead_position": "lead_position_m", "tail_position": "tail_position_m", "tail_velocity": "tail_velocity_m_s",
    "pressure": "pressure_Pa", "time": "time_s",
}  # fmt: skip


@dataclass(frozen=True)
class LawForm:
    """A kind of law as an effect file holds it: its size (name, symbol, exponents of its unit in N, m, s and Pa), its
    shape as code and as a formula, and its shape parameters (name, symbol, unit). `variable` is what it depends on,
    `times` what it is also tried multiplied by.
    """

    variable: str
    size: tuple[str, str, tuple[int, int, int, int]]
    code: str
    formula: str
    shapes: tuple[tuple[str, str, str], ...] = ()
    times: tuple[str, ...] = ()

    @cached_property
    def _compiled(self) -> CodeType:
        return compile(self.code, "law", "eval")

    def along(self, motion: FittedMotion, shapes: Sequence[float] = ()) -> Floats:
        """The shape along a motion, as its code says, shape (n_times,)."""
        state = SimpleNamespace(**{name: getattr(motion, attribute) for name, attribute in STATE.items()})
        known = dict(zip((name for name, _, _ in self.shapes), shapes, strict=True))
        return np.asarray(eval(self._compiled, {"np": np, "s": state, **known}) + 0.0 * motion.time_s)


_FORCE = ("F", "F", (1, 0, 0, 0))
_V_0, _V_1 = (("v_0", "v₀", "m/s"),), (("v_1", "v₁", "m/s"),)
_BY_BOTH, _BY_PRESSURE = ("speed", "pressure"), ("pressure",)
FORMS = {
    "constant": LawForm("", _FORCE, "1.0", "F"),
    "position": LawForm("growth", ("k", "k", (1, -1, 0, 0)), "s.tail_position", "k x", times=_BY_BOTH),
    "speed": LawForm("speed", ("b", "b", (1, -1, 1, 0)), "s.tail_velocity", "b ẋ", times=_BY_PRESSURE),
    "speed_squared": LawForm(
        "speed", ("c", "c", (1, -2, 2, 0)), "s.tail_velocity * s.tail_velocity", "c ẋ²", times=("position", "pressure")
    ),
    "position_squared": LawForm(
        "growth", ("q", "q", (1, -2, 0, 0)), "s.tail_position * s.tail_position", "q x²", times=_BY_BOTH
    ),
    "beyond_a_place": LawForm(
        "growth", ("k", "k", (1, -1, 0, 0)), "np.maximum(s.lead_position - y_0, 0.0)", "k max(0, y − y₀)",
        (("y_0", "y₀", "m"),), _BY_BOTH,
    ),
    "speed_cubed": LawForm(
        "speed", ("c", "c", (1, -3, 3, 0)), "s.tail_velocity * s.tail_velocity * s.tail_velocity", "c ẋ³"
    ),
    "beyond_a_speed": LawForm(
        "speed", ("b", "b", (1, -1, 1, 0)), "np.maximum(s.tail_velocity - v_1, 0.0)", "b max(0, ẋ − v₁)", _V_1
    ),
    "squared_beyond_a_speed": LawForm(
        "speed", ("c", "c", (1, -2, 2, 0)), "np.maximum(s.tail_velocity - v_1, 0.0) ** 2", "c max(0, ẋ − v₁)²", _V_1
    ),
    "pressure": LawForm("pressure", ("a", "a", (1, 0, 0, -1)), "s.pressure", "a P"),
    "time": LawForm("time", ("r", "r", (1, 0, -1, 0)), "s.time", "r t"),
    "inverse_speed": LawForm(
        "speed", _FORCE, "v_0 / np.maximum(s.tail_velocity, v_0)", "F v₀/max(ẋ, v₀)", _V_0, _BY_PRESSURE
    ),
    "falling_with_speed": LawForm(
        "speed", _FORCE, "np.exp(-s.tail_velocity / v_0)", "F exp(−ẋ/v₀)", _V_0, _BY_PRESSURE
    ),
    "fading_in_time": LawForm("time", _FORCE, "np.exp(-s.time / t_0)", "F exp(−t/t₀)", (("t_0", "t₀", "s"),)),
    "fading_along": LawForm(
        "growth", _FORCE, "np.exp(-s.lead_position / reach)", "F exp(−y/ℓ)", (("reach", "ℓ", "m"),), _BY_BOTH
    ),
    "patch": LawForm(
        "growth",
        _FORCE,
        f"0.5 * (np.tanh((s.lead_position - y_1) / ({EDGE_FRACTION} * width))"
        f" - np.tanh((s.lead_position - y_1 - width) / ({EDGE_FRACTION} * width)))",
        f"½F (tanh((y − y₁)/{EDGE_FRACTION}w) − tanh((y − y₁ − w)/{EDGE_FRACTION}w))",
        (("y_1", "y₁", "m"), ("width", "w", "m")),
    ),
    "periodic": LawForm(
        "growth",
        _FORCE,
        "np.sin(2.0 * np.pi * s.lead_position / period + phi)",
        "F sin(2π y/Λ + φ)",
        (("period", "Λ", "m"), ("phi", "φ", "rad")),
    ),
}  # fmt: skip


def laws_on_grid(motions: Sequence[FittedMotion]) -> list[Law]:
    """The grid of all laws; where vines differ in width, also each in proportion to the cross-section."""
    growth_m, speed_m_s, time_s = _visited(motions)
    plain = ["constant", "position", "speed", "speed_squared", "pressure", "time", "position_squared", "speed_cubed"]
    laws = [Law(kind) for kind in plain]
    # Positions and speeds above which a force may set in, as parts of the highest (chosen)
    for part in ((np.arange(8) + 0.5) / 8).tolist():
        laws.append(Law("beyond_a_place", scale=part * growth_m))
        laws += [Law(kind, scale=part * speed_m_s) for kind in ("beyond_a_speed", "squared_beyond_a_speed")]
    # 0.05: part of the highest speed below which 1/ẋ is held constant, because a vine starts from rest (chosen)
    laws.append(Law("inverse_speed", scale=0.05 * speed_m_s))
    # Decay scales as parts of the largest growth, speed or time (chosen)
    for part in (0.04, 0.1, 0.2, 0.4):
        scales = {"falling_with_speed": speed_m_s, "fading_in_time": time_s, "fading_along": growth_m}
        laws += [Law(kind, scale=part * largest) for kind, largest in scales.items()]
    # Widths of a local force as parts of the growth (chosen)
    for width, place in itertools.product((0.06, 0.12, 0.2, 0.33), range(PATCH_CENTRES)):
        laws.append(_patch_at((place + 0.5) / PATCH_CENTRES * growth_m, width * growth_m))
    # 24 periods, as parts of the growth (chosen)
    laws += [Law("periodic", scale=period * growth_m) for period in np.geomspace(0.04, 0.6, 24).tolist()]
    laws += [replace(law, factor=factor) for law in laws for factor in FORMS[law.kind].times]
    areas = [motion.trial.area_m2 for motion in motions]
    # 1.02: ratio of cross-sections up to which two vines count as equally wide (chosen)
    if max(areas) > 1.02 * min(areas):
        mean_m2 = float(np.mean(areas))
        laws += [replace(law, reference_area_m2=mean_m2) for law in laws if "pressure" not in law.variables]
    return _with_unit_peak(laws, motions)


def laws_near(law: Law, motions: Sequence[FittedMotion], part: float = 1.0) -> list[Law]:
    """Laws near another: its position, width, period or scale varied by less than a step of the grid, or by part of
    that.
    """
    if law.kind == "patch":
        centre, width = (law.low + law.high) / 2, law.high - law.low
        step = part * _visited(motions)[0] / PATCH_CENTRES
        near = [law] if law.factor else [replace(law, factor="speed"), replace(law, factor="pressure")]
        for shift, stretch in itertools.product(np.linspace(-0.75, 0.75, 7), (0.5, 0.7, 0.85, 1.0, 1.2, 1.45, 1.8)):
            moved = _patch_at(centre + float(shift) * step, stretch**part * width)
            near.append(replace(law, low=moved.low, high=moved.high))
    elif law.n_shapes:
        factors = np.geomspace(0.9, 1.11, 17) if law.kind == "periodic" else np.geomspace(0.5, 2.0, 13)
        near = [replace(law, scale=law.scale * factor) for factor in (factors**part).tolist()]
    else:
        return []
    return _with_unit_peak(near, motions)


def _patch_at(centre: float, width: float) -> Law:
    return Law("patch", low=centre - width / 2, high=centre + width / 2)


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


def _visited(motions: Sequence[FittedMotion]) -> tuple[float, float, float]:
    """The largest growth, m, speed of the tail, m/s, and time, s, among the motions."""
    return (
        max(float(motion.lead_position_m[motion.is_visited].max()) for motion in motions),
        max(float(np.quantile(motion.tail_velocity_m_s[motion.is_visited], 0.98)) for motion in motions),
        max(float(motion.time_s[motion.is_visited].max()) for motion in motions),
    )
