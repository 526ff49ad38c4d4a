"""Scaling priors for vines that have not been measured, each with a standard error.

    B ≈ 6.44 (t/200 µm) (D/24 mm)^0.75 N·(s/m)ⁿ

describes the four printed values and the printed linear rise with wall thickness. All four have nearly the same t/D, so
they do not determine the exponents of t and D separately: `SPLIT_SIGMA` allows for that. None of these values is a
measurement, and every output that uses them says so.
"""

from __future__ import annotations

import math

from vinetrack.core import published

DIAMETER_EXPONENT = 0.75  # Exponent of D in the prior of B (derived)

THICKNESS_EXPONENT = 1.0  # Exponent of t in the prior of B (published)

SCATTER_DOF = 2  # Degrees of freedom of the scatter about the prior (derived)

SPLIT_SIGMA = 0.25  # Standard error of the exponent of t against that of D, at constant sum

PRINTED_ERROR = 0.05  # Relative standard error of a printed B, for which only R² is printed (derived)

YIELD_PRESSURE_PA = 1000 * published.YIELD_PRESSURE_KPA
PRINTED_YIELD_SIGMA_PA = 1000 / math.sqrt(12)  # Standard error of the printed yield pressure, Pa

# Factor of the one printed yield pressure within which nine of ten other vines are assumed to lie (chosen)
YIELD_FACTOR = 3.0

BURST_STRESS_PA = 7.8e6  # Assumed hoop stress PD/2t at burst, Pa (derived)

NINE_OF_TEN = 1.6448536269514722  # Half width of the central 90 % of the normal distribution, in standard deviations

PRESSURE_SPREAD, DAMPING_SPREAD = 0.01, 0.03  # Relative between-trial standard deviations of pressure and B (chosen)


def damping_prior(diameter_m: float, thickness_m: float) -> float:
    """Return the prior of B of a vine of this size, N·(s/m)ⁿ."""
    largest = max(published.DAMPING_B)
    thickness = thickness_m / (1e-6 * published.THICKNESS_UM[largest])
    diameter = diameter_m / (1e-3 * published.DIAMETER_MM[largest])
    return published.DAMPING_B[largest] * thickness**THICKNESS_EXPONENT * diameter**DIAMETER_EXPONENT


def damping_scatter() -> float:
    """Return the standard deviation of ln B of the four printed values about the prior.

    >>> round(damping_scatter(), 3)
    0.113
    """
    residuals = [
        math.log(B / damping_prior(1e-3 * published.DIAMETER_MM[scale], 1e-6 * published.THICKNESS_UM[scale]))
        for scale, B in published.DAMPING_B.items()
    ]
    return math.sqrt(sum(residual**2 for residual in residuals) / SCATTER_DOF)


def damping_log_sigma(diameter_m: float, thickness_m: float) -> float:
    """Return the standard error (scale of Student's t) of the predicted ln B of a vine with t/D as printed. It is the
    prediction error of a line fitted to the four printed points, σ √(1 + ¼ + (z − z̄)²/Σ(zᵢ − z̄)²) with z the
    logarithm of the size; it grows beyond the smallest and the largest vine.
    """
    sizes = [
        math.log(damping_prior(1e-3 * published.DIAMETER_MM[scale], 1e-6 * published.THICKNESS_UM[scale]))
        for scale in published.DAMPING_B
    ]
    middle = sum(sizes) / len(sizes)
    distance = math.log(damping_prior(diameter_m, thickness_m)) - middle
    leverage = 1 / len(sizes) + distance**2 / sum((size - middle) ** 2 for size in sizes)
    return damping_scatter() * math.sqrt(1 + leverage)


def split_leverage(diameter_m: float, thickness_m: float) -> float:
    """Return the change of ln B if 1 is added to the exponent of t and subtracted from that of D; 0 for t/D
    as printed.
    """
    largest = max(published.DAMPING_B)
    printed = 1e-6 * published.THICKNESS_UM[largest] / (1e-3 * published.DIAMETER_MM[largest])
    return math.log(thickness_m / diameter_m / printed)


def exponent_sigma() -> float:
    """Return the standard error of the printed n, from the printed R² of the four fits with about ten pressures each.
    The standard error of a slope n of N points is n √((1 − R²)/R²/(N − 2)); the four are combined with inverse-variance
    weights.

    >>> round(exponent_sigma(), 3)
    0.012
    """
    dof = sum(published.CONDITIONS) / len(published.CONDITIONS) - 2
    variances = [published.EXPONENT**2 * (1 - R2) / R2 / dof for R2 in published.DAMPING_R2.values()]
    return 1 / math.sqrt(sum(1 / variance for variance in variances))


def yield_log_sigma() -> float:
    """Return the standard deviation of the logarithm of the prior of a yield pressure."""
    return math.log(YIELD_FACTOR) / NINE_OF_TEN


def burst_pressure_Pa(diameter_m: float, thickness_m: float) -> float:
    """Return the gauge pressure at which a vine of this size bursts, 2tσ/D, Pa; a guess from one vine."""
    return 2 * thickness_m * BURST_STRESS_PA / diameter_m


def hoop_stress_Pa(pressure_Pa: float, diameter_m: float, thickness_m: float) -> float:
    """Return the hoop stress PD/2t of the wall, Pa."""
    return pressure_Pa * diameter_m / (2 * thickness_m)
