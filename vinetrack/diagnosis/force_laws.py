"""Simple laws that a missing force may follow, each with its description in words.

Every law is scaled to a peak of 1 along the fitted motions, so that its amplitude is the largest force, N. A periodic
law has two amplitudes, of a sine and a cosine. Laws with a position or a scale come in a grid of them.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from vinetrack.core.problems import remark
from vinetrack.core.records import Floats
from vinetrack.diagnosis.force_inversion import N_NONZERO, FittedMotion, nonzero_splines, uniform_knots

PATCH_CENTRES = 16  # Number of positions of a local force (chosen)


EDGE_FRACTION = 0.1  # Part of a patch's width over which the force rises at each end (chosen)


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
        variables = {FORMS[kind].variable for kind in (self.kind, self.factor) if kind}
        return tuple(name for name in ("growth", "speed", "time", "pressure") if name in variables)

    @property
    def is_unresolved(self) -> bool:
        """Whether it acts over less than a millimetre, which no camera that films the whole growth resolves."""
        # 1e-3: least width of a local force that is reported (chosen)
        return self.kind == "patch" and not self.high - max(self.low, 0.0) > 1e-3

    def unit_force(self, motion: FittedMotion) -> Floats:
        """The force of each unit amplitude along a motion. Shape (n_times, n_amplitudes)."""
        size = (motion.trial.area_m2 / self.reference_area_m2 if self.reference_area_m2 else 1.0) / self.peak
        force = size * FORMS[self.kind].along(self, motion).reshape(motion.time_s.size, -1)
        return force * FORMS[self.factor].along(self, motion)[:, None] if self.factor else force

    def words(self, amplitude_N: Sequence[float], sigma_N: float) -> str:
        """Describe the law with its size."""
        return str(remark("law", law=self, amplitude_N=amplitude_N, sigma_N=sigma_N))


def _patch(law: Law, motion: FittedMotion) -> Floats:
    edge = EDGE_FRACTION * (law.high - law.low)
    y = motion.lead_position_m
    return np.asarray(0.5 * (np.tanh((y - law.low) / edge) - np.tanh((y - law.high) / edge)))


def _periodic(law: Law, motion: FittedMotion) -> Floats:
    phase = 2 * math.pi * motion.lead_position_m / law.scale
    return np.column_stack([np.sin(phase), np.cos(phase)])


@dataclass(frozen=True)
class LawForm:
    """How a kind of law is computed along motions, and how it is written in an effect file: its size (name, symbol,
    exponents of its unit in N, m, s and Pa), its shape as code and as a formula, and its shape parameters (name,
    symbol, unit). `variable` is what it depends on, `times` what it is also tried multiplied by.
    """

    along: Callable[[Law, FittedMotion], Floats]
    variable: str
    size: tuple[str, str, tuple[int, int, int, int]]
    code: str
    formula: str
    shapes: tuple[tuple[str, str, str], ...] = ()
    times: tuple[str, ...] = ()


_FORCE = ("F", "F", (1, 0, 0, 0))
_V_0, _V_1 = (("v_0", "v₀", "m/s"),), (("v_1", "v₁", "m/s"),)
_BY_BOTH, _BY_PRESSURE = ("speed", "pressure"), ("pressure",)
FORMS = {
    "constant": LawForm(lambda _, m: np.ones(m.time_s.size), "", _FORCE, "1.0", "F"),
    "position": LawForm(
        lambda _, m: m.tail_position_m, "growth", ("k", "k", (1, -1, 0, 0)), "s.tail_position", "k x", times=_BY_BOTH
    ),
    "speed": LawForm(
        lambda _, m: m.tail_velocity_m_s,
        "speed", ("b", "b", (1, -1, 1, 0)), "s.tail_velocity", "b ẋ", times=_BY_PRESSURE,
    ),
    "speed_squared": LawForm(
        lambda _, m: m.tail_velocity_m_s**2,
        "speed", ("c", "c", (1, -2, 2, 0)), "s.tail_velocity * s.tail_velocity", "c ẋ²", times=("position", "pressure"),
    ),
    "position_squared": LawForm(
        lambda _, m: m.tail_position_m**2,
        "growth", ("q", "q", (1, -2, 0, 0)), "s.tail_position * s.tail_position", "q x²", times=_BY_BOTH,
    ),
    "beyond_a_place": LawForm(
        lambda law, m: np.maximum(m.lead_position_m - law.scale, 0.0),
        "growth", ("k", "k", (1, -1, 0, 0)), "np.maximum(s.lead_position - y_0, 0.0)", "k max(0, y − y₀)",
        (("y_0", "y₀", "m"),), _BY_BOTH,
    ),
    "speed_cubed": LawForm(
        lambda _, m: m.tail_velocity_m_s**3,
        "speed", ("c", "c", (1, -3, 3, 0)), "s.tail_velocity * s.tail_velocity * s.tail_velocity", "c ẋ³",
    ),
    "beyond_a_speed": LawForm(
        lambda law, m: np.maximum(m.tail_velocity_m_s - law.scale, 0.0),
        "speed", ("b", "b", (1, -1, 1, 0)), "np.maximum(s.tail_velocity - v_1, 0.0)", "b max(0, ẋ − v₁)", _V_1,
    ),
    "squared_beyond_a_speed": LawForm(
        lambda law, m: np.maximum(m.tail_velocity_m_s - law.scale, 0.0) ** 2,
        "speed", ("c", "c", (1, -2, 2, 0)), "np.maximum(s.tail_velocity - v_1, 0.0) ** 2", "c max(0, ẋ − v₁)²", _V_1,
    ),
    "pressure": LawForm(lambda _, m: m.pressure_Pa, "pressure", ("a", "a", (1, 0, 0, -1)), "s.pressure", "a P"),
    "time": LawForm(lambda _, m: m.time_s, "time", ("r", "r", (1, 0, -1, 0)), "s.time", "r t"),
    "inverse_speed": LawForm(
        lambda law, m: 1 / np.maximum(m.tail_velocity_m_s, law.scale),
        "speed", _FORCE, "v_0 / np.maximum(s.tail_velocity, v_0)", "F v₀/max(ẋ, v₀)", _V_0, _BY_PRESSURE,
    ),
    "falling_with_speed": LawForm(
        lambda law, m: np.exp(-m.tail_velocity_m_s / law.scale),
        "speed", _FORCE, "np.exp(-s.tail_velocity / v_0)", "F exp(−ẋ/v₀)", _V_0, _BY_PRESSURE,
    ),
    "fading_in_time": LawForm(
        lambda law, m: np.exp(-m.time_s / law.scale),
        "time", _FORCE, "np.exp(-s.time / t_0)", "F exp(−t/t₀)", (("t_0", "t₀", "s"),),
    ),
    "fading_along": LawForm(
        lambda law, m: np.exp(-m.lead_position_m / law.scale),
        "growth", _FORCE, "np.exp(-s.lead_position / reach)", "F exp(−y/ℓ)", (("reach", "ℓ", "m"),), _BY_BOTH,
    ),
    "patch": LawForm(
        _patch,
        "growth",
        _FORCE,
        f"0.5 * (np.tanh((s.lead_position - y_1) / ({EDGE_FRACTION} * width))"
        f" - np.tanh((s.lead_position - y_1 - width) / ({EDGE_FRACTION} * width)))",
        f"½F (tanh((y − y₁)/{EDGE_FRACTION}w) − tanh((y − y₁ − w)/{EDGE_FRACTION}w))",
        (("y_1", "y₁", "m"), ("width", "w", "m")),
    ),
    "periodic": LawForm(
        _periodic,
        "growth",
        _FORCE,
        "np.sin(2.0 * np.pi * s.lead_position / period + phi)",
        "F sin(2π y/Λ + φ)",
        (("period", "Λ", "m"), ("phi", "φ", "rad")),
    ),
}  # fmt: skip


@dataclass(frozen=True)
class _Range:
    """The largest growth, speed and time among the motions."""

    growth_m: float
    speed_m_s: float
    time_s: float


def laws_on_grid(motions: Sequence[FittedMotion]) -> list[Law]:
    """The grid of all laws; where vines differ in width, also each in proportion to the cross-section."""
    # Positions and speeds in the grid above which a force may set in (chosen)
    n_threshold_positions, n_threshold_speeds = 8, 8
    visited = _visited_range(motions)
    plain = ["constant", "position", "speed", "speed_squared", "pressure", "time", "position_squared", "speed_cubed"]
    laws = [Law(kind) for kind in plain]
    for k in range(n_threshold_positions):
        laws.append(Law("beyond_a_place", n_shapes=1, scale=(k + 0.5) / n_threshold_positions * visited.growth_m))
    for k in range(n_threshold_speeds):
        threshold_m_s = (k + 0.5) / n_threshold_speeds * visited.speed_m_s
        laws += [Law(kind, n_shapes=1, scale=threshold_m_s) for kind in ("beyond_a_speed", "squared_beyond_a_speed")]
    # 0.05: part of the highest speed below which 1/ẋ is held constant, because a vine starts from rest (chosen)
    laws.append(Law("inverse_speed", scale=0.05 * visited.speed_m_s))
    # (0.04, 0.1, 0.2, 0.4): decay scales in the grid, as parts of the largest growth, speed or time (chosen)
    for part in (0.04, 0.1, 0.2, 0.4):
        laws.append(Law("falling_with_speed", n_shapes=1, scale=part * visited.speed_m_s))
        laws.append(Law("fading_in_time", n_shapes=1, scale=part * visited.time_s))
        laws.append(Law("fading_along", n_shapes=1, scale=part * visited.growth_m))
    # Widths of a local force as parts of the growth (chosen)
    for width in (0.06, 0.12, 0.2, 0.33):
        for centre in (np.arange(PATCH_CENTRES) + 0.5) / PATCH_CENTRES * visited.growth_m:
            laws.append(_patch_at(float(centre), width * visited.growth_m))
    # 24: periods in the grid (chosen)
    # 0.6, 0.04: as parts of the growth (derived)
    for period in np.geomspace(0.04, 0.6, 24) * visited.growth_m:
        laws.append(Law("periodic", n_amplitudes=2, n_shapes=1, scale=float(period)))
    laws += [replace(law, factor=factor) for law in laws for factor in FORMS[law.kind].times]
    areas = [motion.trial.area_m2 for motion in motions]
    # 1.02: ratio of cross-sections up to which two vines count as equally wide (chosen)
    if max(areas) > 1.02 * min(areas):
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
        # 0.05: part of the growth over which a vine accelerates; the size of a law at rest is not observed (chosen)
        peak_after_start = max(
            float(force[motion.lead_position_m >= 0.05 * motion.lead_position_m.max()].max())
            for force, motion in zip(forces, motions, strict=True)
        )
        if law.n_amplitudes > 1:
            peak = 1.0
        # ("inverse_speed", "falling_with_speed"): kinds that peak at rest, where positions do not determine
        # the speed: their size is stated at the lowest speed observed
        elif law.kind in ("inverse_speed", "falling_with_speed"):
            peak = peak_after_start
        elif law.kind == "patch" and peak_after_start < 0.5 * peak:
            continue
        scaled.append(replace(law, peak=peak or 1.0))
    return scaled


def _visited_range(motions: Sequence[FittedMotion]) -> _Range:
    return _Range(
        max(float(motion.lead_position_m.max()) for motion in motions),
        max(float(np.quantile(motion.tail_velocity_m_s, 0.98)) for motion in motions),
        max(float(motion.time_s[-1]) for motion in motions),
    )


# ------------------------------------------------------------------------------
# Smooth forces over one variable or two: cubic B-splines with a Gaussian-process prior on their coefficients.
#
# The coefficients are the values of a Gaussian process at the centres of the splines, with covariance
#
#     a² Π_d (1 + s_d + s_d²/3) exp(−s_d),   s_d = √5 |u_d − u'_d|/ℓ_d
#
# where u are the variables scaled to the range that the trials visited: the Matérn kernel of order 5/2 (Rasmussen &
# Williams 2006, §4.2). Its functions are twice differentiable. The squared-exponential kernel exp(−½ s²), whose
# functions
# are infinitely smooth, gives bands that are far too narrow for a force such as a power of the growth: in a linear fit
# to
# draws they contain a third of the points instead of nearly all. The model is a penalised spline with an amplitude a,
# N,
# and length scales ℓ_d as hyperparameters (Wahba, JASA 73, 364, 1978; Wilson & Nickisch, ICML 2015).

# What a force may depend on, and the attribute of a motion that holds it
VARIABLES = {
    "growth": "lead_position_m",
    "speed": "tail_velocity_m_s",
    "time": "time_s",
    "pressure": "pressure_Pa",
}


# Length scales that are averaged over, as parts of the visited range (chosen)
LENGTH_SCALES = (0.05, 0.08, 0.14, 0.25, 0.45, 0.8, 1.6)

# Amplitudes that are averaged over, as parts of the largest drive (chosen)
RELATIVE_AMPLITUDES = np.geomspace(0.003, 0.3, 9)

KEPT_VARIANCE, SEARCHED_VARIANCE = 1e-6, 1e-4  # Relative variances below which a mode is dropped (chosen)

# What a force may be where growth begins
ZERO_AT_START, CONSTANT_AT_START, FREE_AT_START = "nothing", "a constant", "anything"


def standard_error(basis: Floats, covariance: Floats) -> Floats:
    """Standard error of a linear combination of coefficients, for each row of a basis. Shapes: basis (n, n_splines);
    covariance (n_splines, n_splines) → (n,).
    """
    return np.asarray(np.sqrt(np.einsum("nk,kl,nl->n", basis, covariance, basis)))


@lru_cache(maxsize=256)
def covariance_modes(count: int, length: float, *, zero_at_start: bool = False) -> tuple[Floats, Floats]:
    """Eigenvectors and eigenvalues of the covariance of a unit-variance process at the centres of the splines. Returns
    eigenvectors, variances. Shape (count, count).
    """
    knots = np.concatenate([[0.0] * 3, np.linspace(0.0, 1.0, count - 2), [1.0] * 3])
    at = np.array([knots[k + 1 : k + 4].mean() for k in range(count)])
    distance = math.sqrt(5) * np.abs(at[:, None] - at) / length
    covariance = (1 + distance + distance**2 / 3) * np.exp(-distance)
    if zero_at_start:
        covariance = covariance - np.outer(covariance[:, 0], covariance[0])
    variances, eigenvectors = np.linalg.eigh(covariance)
    variances = np.maximum(variances, 0.0)
    # Cached and shared, so made read-only: the same few are needed thousands of times.
    for array in (eigenvectors, variances):
        array.flags.writeable = False
    return eigenvectors, variances


@dataclass(frozen=True)
class Domain:
    """The variables of a force, their visited ranges (SI), and the number of splines along each. `log_scale` is the
    distance above the lowest value from which a variable is taken as its logarithm; infinite for never.
    """

    variables: tuple[str, ...]
    low: tuple[float, ...]
    high: tuple[float, ...]
    counts: tuple[int, ...]
    log_scale: tuple[float, ...]

    def normalised(self, values: Sequence[Floats]) -> list[Floats]:
        """The variables scaled to 0 to 1 over the visited range, logarithmically beyond `log_scale`. Speeds and
        durations of a campaign span decades, and forces change over fractions of them. Shapes: values (n,).
        """
        limits = zip(values, self.low, self.high, self.log_scale, strict=True)
        return [
            np.log1p(np.maximum(at - low, 0.0) / log_scale) / math.log1p((high - low) / log_scale)
            if math.isfinite(log_scale)
            else (at - low) / (high - low)
            for at, low, high, log_scale in limits
        ]

    @property
    def name(self) -> str:
        """The variables joined by +: `growth`, `growth+speed`."""
        return "+".join(self.variables)

    @property
    def size(self) -> int:
        """Total number of splines (products of splines, for two variables)."""
        return math.prod(self.counts)

    def values_along(self, motion: FittedMotion) -> list[Floats]:
        """The variables along a motion, SI, each of shape (n_times,)."""
        return [np.asarray(getattr(motion, VARIABLES[name])) for name in self.variables]

    def basis(self, values: Sequence[Floats]) -> Floats:
        """Design matrix: all splines, or products of splines, at these values. Shapes: values (n,) → (n, size)."""
        indices, products = self._nonzero_products(values)
        design = np.zeros((len(indices), self.size))
        np.put_along_axis(design, indices, products, axis=1)
        return design

    def evaluate(self, values: Sequence[Floats], coefficients: Floats) -> Floats:
        """Sum of all splines times their coefficients at these values. Shapes: values (n,); coefficients (size,) →
        (n,).
        """
        indices, products = self._nonzero_products(values)
        return np.asarray(np.einsum("ns,ns->n", products, coefficients[indices]))

    def _nonzero_products(self, values: Sequence[Floats]) -> tuple[np.ndarray, Floats]:
        """Indices and values of the nonzero products of splines, shape (n, 4^n_variables)."""
        indices, products = np.zeros((len(values[0]), 1), dtype=int), np.ones((len(values[0]), 1))
        for position, count in zip(self.normalised(values), self.counts, strict=True):
            first, splines = nonzero_splines(position, uniform_knots(count))
            along_axis = first[:, None] + np.arange(N_NONZERO)
            indices = (indices[:, :, None] * count + along_axis[:, None, :]).reshape(len(position), -1)
            products = (products[:, :, None] * splines[:, None, :]).reshape(len(position), -1)
        return indices, products

    @property
    def start_axis(self) -> int:
        """Index of the variable that marks the start of growth: growth, else time since release; else −1."""
        return next((self.variables.index(name) for name in ("growth", "time") if name in self.variables), -1)

    @property
    def start_conditions(self) -> tuple[str, ...]:
        """What a force over these variables may be where growth begins."""
        if self.start_axis < 0:
            return (FREE_AT_START,)
        return (
            (ZERO_AT_START, CONSTANT_AT_START)
            if len(self.variables) == 1
            else (ZERO_AT_START, CONSTANT_AT_START, FREE_AT_START)
        )

    def prior_modes(
        self, lengths: Sequence[float], at_start: str = FREE_AT_START, least_variance: float = KEPT_VARIANCE
    ) -> Floats:
        """Square root of the prior covariance: coefficients of the splines for each mode at unit amplitude. Shape
        (size, n_modes).
        """
        start_axis = self.start_axis
        by_axis = [
            covariance_modes(count, length, zero_at_start=k == start_axis)
            for k, (count, length) in enumerate(zip(self.counts, lengths, strict=True))
        ]
        columns = [_product(by_axis, least_variance)]
        if start_axis >= 0 and at_start == CONSTANT_AT_START:
            columns.append(np.ones((self.size, 1)))
        if start_axis >= 0 and at_start == FREE_AT_START:
            # 3.0: prior amplitude of the force where growth begins, as a multiple of that of the rest of
            # the surface (chosen)
            constant_along_start_axis = [
                (np.ones((count, 1)), np.array([3.0**2])) if k == start_axis else modes
                for k, (count, modes) in enumerate(zip(self.counts, by_axis, strict=True))
            ]
            columns.append(_product(constant_along_start_axis, least_variance))
        return np.hstack(columns)


def _product(by_axis: Sequence[tuple[Floats, Floats]], least_variance: float) -> Floats:
    """Modes of a product of processes, scaled by the root of their variance, shape (n_splines, n_modes kept)."""
    variances: Floats = np.ones(1)
    for _, of_axis in by_axis:
        variances = np.asarray(np.kron(variances, of_axis))
    kept = np.flatnonzero(variances > least_variance * variances.max())
    vectors: Floats = np.ones((1, kept.size))
    indices = np.unravel_index(kept, [of_axis.size for _, of_axis in by_axis])
    for (eigenvectors, _), index in zip(by_axis, indices, strict=True):
        vectors = (vectors[:, None, :] * eigenvectors[None, :, index]).reshape(-1, kept.size)
    return np.asarray(vectors * np.sqrt(variances[kept]))


@dataclass(frozen=True)
class SmoothForce:
    """A force over a domain whose amplitudes have independent normal priors of standard deviation `sd_N`. `modes`,
    shape (n_splines, n_amplitudes), are the spline coefficients for unit amplitudes. An infinite `sd_N` leaves the
    amplitudes free.
    """

    domain: Domain
    modes: Floats
    sd_N: float = math.inf

    @property
    def amplitude_precision(self) -> float:
        """Prior precision of each amplitude, 1/N²."""
        return self.sd_N**-2

    def force(self, motion: FittedMotion, amplitude: Floats) -> Floats:
        """The force with these amplitudes along a motion. Shapes: amplitude (n_columns,) → (n_times,)."""
        return self.domain.evaluate(self.domain.values_along(motion), self.modes @ amplitude)

    def unit_force(self, motion: FittedMotion) -> Floats:
        """The force of each unit amplitude along a motion. Shape (n_times, n_columns)."""
        return np.asarray(self.domain.basis(self.domain.values_along(motion)) @ self.modes)


def candidate_domains(motions: Sequence[FittedMotion]) -> list[Domain]:
    """Every variable alone, then every pair, over the ranges that the motions visit."""
    pressure_margin = 0.03  # Part by which the range of pressures is extended at both ends (chosen)
    ranges: dict[str, tuple[float, float, float]] = {}
    for name, attribute in VARIABLES.items():
        by_trial = [
            np.asarray(getattr(motion, attribute))[motion.time_s <= motion.counts_until_s] for motion in motions
        ]
        # 0.98: quantile of a trial's speeds that counts as its highest (chosen)
        high = max(float(np.quantile(values, 0.98) if name == "speed" else values.max()) for values in by_trial)
        low = min(float(values.min()) for values in by_trial) if name == "pressure" else 0.0
        # 0.02: part of the highest pressure by which pressures must differ for pressure to be a variable (chosen)
        if high - low > 0.02 * abs(high):
            if name == "pressure":
                low, high = (1 - pressure_margin) * low, (1 + pressure_margin) * high
            typical = float(np.median([np.median(values) for values in by_trial]))
            # ("speed", "time"): variables on a logarithmic scale above their median (chosen)
            ranges[name] = low, high, typical if name in ("speed", "time") else math.inf

    def domain(names: tuple[str, ...], counts: dict[str, int]) -> Domain:
        lows, highs, log_scales = zip(*(ranges[name] for name in names), strict=True)
        return Domain(names, lows, highs, tuple(counts[name] for name in names), log_scales)

    # Splines along a variable, when it is alone and when it is one of two (chosen)
    alone = {"growth": 24, "speed": 16, "time": 16, "pressure": 7}
    in_pair = {"growth": 20, "speed": 8, "time": 8, "pressure": 5}
    return [domain((name,), alone) for name in ranges] + [
        domain(pair, in_pair) for pair in itertools.combinations(ranges, 2)
    ]
