"""Smooth forces over one variable or two: cubic B-splines with a Gaussian-process prior on their coefficients.

The coefficients are the values of a Gaussian process at the centres of the splines, with covariance

    a² Π_d (1 + s_d + s_d²/3) exp(−s_d),   s_d = √5 |u_d − u'_d|/ℓ_d

where u are the variables scaled to the range that the trials visited: the Matérn kernel of order 5/2 (Rasmussen &
Williams 2006, §4.2). Its functions are twice differentiable. The squared-exponential kernel exp(−½ s²), whose functions
are infinitely smooth, gives bands that are far too narrow for a force such as a power of the growth: in a linear fit to
draws they contain a third of the points instead of nearly all. The model is a penalised spline with an amplitude a, N,
and length scales ℓ_d as hyperparameters (Wahba, JASA 73, 364, 1978; Wilson & Nickisch, ICML 2015).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from vinetrack.core.records import Floats
from vinetrack.diagnosis.force_inversion import N_NONZERO, FittedMotion, nonzero_splines, uniform_knots

# What a force may depend on, and the attribute of a motion that holds it
VARIABLES = {
    "growth": "lead_position_m",
    "speed": "tail_velocity_m_s",
    "time": "time_s",
    "pressure": "pressure_Pa",
}

SPLINES_ALONE = {"growth": 24, "speed": 16, "time": 16, "pressure": 7}
# Splines along a variable, when it is alone and when it is one of two (chosen)
SPLINES_IN_PAIR = {"growth": 20, "speed": 8, "time": 8, "pressure": 5}

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

    @property
    def shape_names(self) -> tuple[str, ...]:
        """No shape parameters: the amplitudes are the only unknowns."""
        return ()

    def size_of(self, name: str) -> float:  # pragma: no cover
        """Not applicable: there are no shape parameters."""
        raise KeyError(name)

    def shifted(self, name: str, by: float) -> SmoothForce:  # pragma: no cover
        """Not applicable: there are no shape parameters."""
        raise KeyError(name, by)

    def within_growth(self, growth_m: float) -> SmoothForce:  # noqa: ARG002
        """Return itself: the force is constant beyond the visited range."""
        return self

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

    return [domain((name,), SPLINES_ALONE) for name in ranges] + [
        domain(pair, SPLINES_IN_PAIR) for pair in itertools.combinations(ranges, 2)
    ]
