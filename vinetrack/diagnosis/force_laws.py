"""Simple laws that a missing force may follow, each with its description in words.

Every law is scaled to a peak of 1 along the fitted motions, so that its amplitude is the largest force, N. A periodic
law has two amplitudes, of a sine and a cosine. Laws with a position or a scale come in a grid of them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from vinetrack.core.numbers import decimals
from vinetrack.core.records import Floats
from vinetrack.diagnosis.force_sensitivities import FittedMotion

# Number of positions of a local force, and its widths as parts of the growth (chosen)
PATCH_CENTRES, PATCH_WIDTHS = 16, (0.06, 0.12, 0.2, 0.33)

N_PERIODS = 24  # Periods in the grid (chosen)

LONGEST_PERIOD, SHORTEST_PERIOD = 0.6, 0.04  # As parts of the growth (derived)

# Decay scales in the grid, as parts of the largest growth, speed or time (chosen)
RELATIVE_SCALES = (0.04, 0.1, 0.2, 0.4)

# Part of the highest speed below which 1/ẋ is held constant, because a vine starts from rest (chosen)
LEAST_RELATIVE_SPEED = 0.05

EDGE_FRACTION = 0.1  # Part of a patch's width over which the force rises at each end (chosen)

START_FRACTION = 0.05  # Part of the growth over which a vine accelerates (chosen)

LEAST_PATCH_M = 1e-3  # Least width of a local force that is reported (chosen)

# Positions and speeds in the grid above which a force may set in (chosen)
N_THRESHOLD_POSITIONS, N_THRESHOLD_SPEEDS = 8, 8

SAME_AREA_RATIO = 1.02  # Ratio of cross-sections up to which two vines count as equally wide (chosen)


@dataclass(frozen=True)
class Law:
    """One form of force along a motion. `kind` names it; `low` and `high` are the ends of a patch (m of growth),
    `scale` its period, decay scale or threshold. `factor` is the variable that it is multiplied by: "position",
    "speed", "pressure" or nothing.
    """

    kind: str
    n_amplitudes: int = 1
    n_shapes: int = 0
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
    def n_parameters(self) -> int:
        """Number of parameters; a factor counts as one, because it was chosen among several."""
        return self.n_amplitudes + self.n_shapes + bool(self.factor)

    @property
    def variables(self) -> tuple[str, ...]:
        """The variables that it depends on: growth, speed, time or pressure; none for a constant."""
        variables = {VARIABLE_OF_KIND[kind] for kind in (self.kind, self.factor) if kind in VARIABLE_OF_KIND}
        return tuple(name for name in ("growth", "speed", "time", "pressure") if name in variables)

    @property
    def is_unresolved(self) -> bool:
        """Whether it acts over less than a millimetre, which no camera that films the whole growth resolves."""
        return self.kind == "patch" and not self.high - max(self.low, 0.0) > LEAST_PATCH_M

    @property
    def amplitude_precision(self) -> float:
        """Prior precision of its amplitudes, 1/N²: 0, because they are free."""
        return 0.0

    @property
    def shape_names(self) -> tuple[str, ...]:
        """Names of its shape parameters."""
        return ("low", "high") if self.kind == "patch" else ("scale",) * self.n_shapes

    def size_of(self, name: str) -> float:
        """Scale on which a shape parameter changes the law."""
        return self.high - self.low if self.kind == "patch" else float(getattr(self, name))

    def shifted(self, name: str, by: float) -> Law:
        """The law with one shape parameter changed."""
        return replace(self, **{name: getattr(self, name) + by})

    def within_growth(self, growth_m: float) -> Law:
        """The law with the ends of a patch kept inside the growth, apart from its rounded edges."""
        if self.kind != "patch":
            return self
        edge = EDGE_FRACTION * (self.high - self.low)
        return replace(self, low=max(self.low, -edge), high=min(self.high, growth_m + edge))

    def unit_force(self, motion: FittedMotion) -> Floats:
        """The force of each unit amplitude along a motion. Shape (n_times, n_amplitudes)."""
        size = (motion.trial.area_m2 / self.reference_area_m2 if self.reference_area_m2 else 1.0) / self.peak
        force = size * _EXPRESSIONS[self.kind](self, motion)
        return force * _EXPRESSIONS[self.factor](self, motion) if self.factor else force

    def words(self, amplitude_N: Sequence[float], sigma_N: float) -> str:
        """Describe the law with its size."""
        if self.kind == "periodic":
            size = f"with an amplitude of {_with_error(math.hypot(*amplitude_N), sigma_N)}"
        else:
            size = f"{'+' if amplitude_N[0] > 0 else ''}{_with_error(amplitude_N[0], sigma_N)}".replace("-", "−")
        by_area = ", in proportion to the cross-section of the vine" if self.reference_area_m2 else ""
        words = _WORDS[self.kind]
        if self.factor:
            words = f"{words.partition(', {size}')[0]}, times {_FACTOR_WORDS[self.factor]}, {{size}} at its largest"
        return (
            words.format(
                size=size,
                low=f"{1e3 * max(self.low, 0.0):.0f}",
                high=f"{1e3 * self.high:.0f}",
                scale_mm=_round(1e3 * self.scale),
                scale_ms=_round(1e3 * self.scale),
                scale=f"{self.scale:.2g}",
            )
            + by_area
        )


def _round(value: float) -> str:
    return f"{value:.0f}" if value >= 10 else f"{value:.2g}"


def _with_error(value_N: float, sigma_N: float) -> str:
    if not math.isfinite(sigma_N):
        return "any size"
    digits = decimals(sigma_N)
    return f"{value_N:.{digits}f} ± {sigma_N:.{digits}f} N"


def _patch(law: Law, motion: FittedMotion) -> Floats:
    edge = EDGE_FRACTION * (law.high - law.low)
    y = motion.lead_position_m
    return (0.5 * (np.tanh((y - law.low) / edge) - np.tanh((y - law.high) / edge)))[:, None]


def _periodic(law: Law, motion: FittedMotion) -> Floats:
    phase = 2 * math.pi * motion.lead_position_m / law.scale
    return np.column_stack([np.sin(phase), np.cos(phase)])


_EXPRESSIONS = {
    "constant": lambda _, m: np.ones((m.time_s.size, 1)),
    "position": lambda _, m: m.tail_position_m[:, None],
    "speed": lambda _, m: m.tail_velocity_m_s[:, None],
    "speed_squared": lambda _, m: m.tail_velocity_m_s[:, None] ** 2,
    "position_squared": lambda _, m: m.tail_position_m[:, None] ** 2,
    "beyond_a_place": lambda law, m: np.maximum(m.lead_position_m - law.scale, 0.0)[:, None],
    "speed_cubed": lambda _, m: m.tail_velocity_m_s[:, None] ** 3,
    "beyond_a_speed": lambda law, m: np.maximum(m.tail_velocity_m_s - law.scale, 0.0)[:, None],
    "squared_beyond_a_speed": lambda law, m: np.maximum(m.tail_velocity_m_s - law.scale, 0.0)[:, None] ** 2,
    "pressure": lambda _, m: m.pressure_Pa[:, None],
    "time": lambda _, m: m.time_s[:, None],
    "inverse_speed": lambda law, m: 1 / np.maximum(m.tail_velocity_m_s, law.scale)[:, None],
    "falling_with_speed": lambda law, m: np.exp(-m.tail_velocity_m_s / law.scale)[:, None],
    "fading_in_time": lambda law, m: np.exp(-m.time_s / law.scale)[:, None],
    "fading_along": lambda law, m: np.exp(-m.lead_position_m / law.scale)[:, None],
    "patch": _patch,
    "periodic": _periodic,
}
# The variable that each kind but the constant depends on
VARIABLE_OF_KIND = {
    **dict.fromkeys(("position", "position_squared", "beyond_a_place", "fading_along", "patch", "periodic"), "growth"),
    **dict.fromkeys(("speed", "speed_squared", "speed_cubed", "beyond_a_speed", "squared_beyond_a_speed"), "speed"),
    **dict.fromkeys(("inverse_speed", "falling_with_speed"), "speed"),
    **dict.fromkeys(("time", "fading_in_time"), "time"),
    "pressure": "pressure",
}

# Kinds that peak at rest, where positions do not determine the speed: their size is stated at the lowest speed observed
_LARGEST_AT_REST = ("inverse_speed", "falling_with_speed")

_WORDS = {
    "constant": "a constant force of {size}",
    "position": "a force in proportion to the tail's travel x, {size} at the end",
    "speed": "a force in proportion to the speed ẋ, {size} at the highest",
    "speed_squared": "a force in proportion to ẋ², {size} at the highest speed",
    "position_squared": "a force in proportion to x², {size} at the end",
    "beyond_a_place": "a force that rises in proportion to the growth beyond {scale_mm} mm, {size} at the end",
    "speed_cubed": "a force in proportion to ẋ³, {size} at the highest speed",
    "beyond_a_speed": "a force in proportion to the excess of ẋ over {scale} m/s, {size} at the highest speed",
    "squared_beyond_a_speed": (
        "a force in proportion to the square of the excess of ẋ over {scale} m/s, {size} at the highest speed"
    ),
    "pressure": "a force in proportion to the pressure, {size} at the highest",
    "time": "a force that grows in proportion to time, {size} at the end of the longest trial",
    "inverse_speed": "a force that falls with speed as 1/ẋ, {size} at {scale} m/s and below",
    "falling_with_speed": (
        "a force that falls with speed, {size} at the lowest speed, by a factor of e every {scale} m/s of ẋ"
    ),
    "fading_in_time": "a force that decays in time, {size} at release, by a factor of e every {scale_ms} ms",
    "fading_along": "a force that decays along the growth, {size} at the start, by a factor of e every {scale_mm} mm",
    "patch": "a force that acts between {low} and {high} mm of growth, {size}",
    "periodic": "a force that repeats every {scale_mm} mm of growth, {size}",
}


# Products in the grid (chosen)
_PRODUCTS = {
    **dict.fromkeys(("position", "position_squared", "fading_along", "beyond_a_place"), ("speed", "pressure")),
    **dict.fromkeys(("speed", "speed_squared", "inverse_speed"), ("pressure",)),
    "speed_squared": ("position", "pressure"),
    "falling_with_speed": ("pressure",),
}

_FACTOR_WORDS = {"position": "the tail's travel x", "speed": "the speed ẋ", "pressure": "the pressure"}


@dataclass(frozen=True)
class _Range:
    """The largest growth, speed and time among the motions."""

    growth_m: float
    speed_m_s: float
    time_s: float


def laws_on_grid(motions: Sequence[FittedMotion]) -> list[Law]:
    """The grid of all laws; where vines differ in width, also each in proportion to the cross-section."""
    visited = _visited_range(motions)
    plain = ["constant", "position", "speed", "speed_squared", "pressure", "time", "position_squared", "speed_cubed"]
    laws = [Law(kind) for kind in plain]
    for k in range(N_THRESHOLD_POSITIONS):
        laws.append(Law("beyond_a_place", n_shapes=1, scale=(k + 0.5) / N_THRESHOLD_POSITIONS * visited.growth_m))
    for k in range(N_THRESHOLD_SPEEDS):
        threshold_m_s = (k + 0.5) / N_THRESHOLD_SPEEDS * visited.speed_m_s
        laws += [Law(kind, n_shapes=1, scale=threshold_m_s) for kind in ("beyond_a_speed", "squared_beyond_a_speed")]
    laws.append(Law("inverse_speed", scale=LEAST_RELATIVE_SPEED * visited.speed_m_s))
    for part in RELATIVE_SCALES:
        laws.append(Law("falling_with_speed", n_shapes=1, scale=part * visited.speed_m_s))
        laws.append(Law("fading_in_time", n_shapes=1, scale=part * visited.time_s))
        laws.append(Law("fading_along", n_shapes=1, scale=part * visited.growth_m))
    for width in PATCH_WIDTHS:
        for centre in (np.arange(PATCH_CENTRES) + 0.5) / PATCH_CENTRES * visited.growth_m:
            laws.append(_patch_at(float(centre), width * visited.growth_m))
    for period in np.geomspace(SHORTEST_PERIOD, LONGEST_PERIOD, N_PERIODS) * visited.growth_m:
        laws.append(Law("periodic", n_amplitudes=2, n_shapes=1, scale=float(period)))
    laws += [replace(law, factor=factor) for law in laws for factor in _PRODUCTS.get(law.kind, ())]
    areas = [motion.trial.area_m2 for motion in motions]
    if max(areas) > SAME_AREA_RATIO * min(areas):
        mean_m2 = float(np.mean(areas))
        laws += [replace(law, reference_area_m2=mean_m2) for law in laws if "pressure" not in law.variables]
    return _with_unit_peak(laws, motions)


def laws_near(law: Law, motions: Sequence[FittedMotion]) -> list[Law]:
    """Laws near the best of the grid: its position, width, period or scale varied by less than a step of the grid."""
    if law.kind == "patch":
        centre, width = (law.low + law.high) / 2, law.high - law.low
        step = _visited_range(motions).growth_m / PATCH_CENTRES
        near = [law] if law.factor else [replace(law, factor="speed"), replace(law, factor="pressure")]
        near += [
            replace(_patch_at(centre + shift * step, stretch * width), factor=law.factor)
            for shift in np.linspace(-0.75, 0.75, 7)
            for stretch in (0.5, 0.7, 0.85, 1.0, 1.2, 1.45, 1.8)
        ]
    elif law.n_shapes:
        near = [
            replace(law, scale=law.scale * factor)
            for factor in (
                np.geomspace(0.9, 1.11, 17) if law.kind == "periodic" else np.geomspace(0.5, 2.0, 13)
            ).tolist()
        ]
    else:
        return []
    if law.reference_area_m2:
        near = [replace(near_law, reference_area_m2=law.reference_area_m2) for near_law in near]
    return _with_unit_peak(near, motions)


def _patch_at(centre: float, width: float) -> Law:
    return Law("patch", n_shapes=2, low=centre - width / 2, high=centre + width / 2)


def _with_unit_peak(laws: Sequence[Law], motions: Sequence[FittedMotion]) -> list[Law]:
    """The laws scaled to a peak of 1 along the motions, without patches that act only at the start."""
    scaled = []
    for law in (replace(law, peak=1.0) for law in laws):
        forces = [np.abs(law.unit_force(motion)) for motion in motions]
        peak = max(float(force.max()) for force in forces)
        peak_after_start = max(
            float(force[_after_start(motion)].max()) for force, motion in zip(forces, motions, strict=True)
        )
        if law.n_amplitudes > 1:
            peak = 1.0
        elif law.kind in _LARGEST_AT_REST:
            peak = peak_after_start
        elif law.kind == "patch" and peak_after_start < 0.5 * peak:
            continue
        scaled.append(replace(law, peak=peak or 1.0))
    return scaled


def _after_start(motion: FittedMotion) -> NDArray[np.bool_]:
    """Where a vine has grown beyond its start: the size of a law at rest alone is not observed."""
    return motion.lead_position_m >= START_FRACTION * motion.lead_position_m.max()


def _visited_range(motions: Sequence[FittedMotion]) -> _Range:
    return _Range(
        max(float(motion.lead_position_m.max()) for motion in motions),
        max(float(np.quantile(motion.tail_velocity_m_s, 0.98)) for motion in motions),
        max(float(motion.time_s[-1]) for motion in motions),
    )
