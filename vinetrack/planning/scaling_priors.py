"""Guesses for vines that nobody has measured, each with the error that its origin leaves it.

    B ≈ 6.44 (t/200 µm) (D/24 mm)^0.75 N·(s/m)ⁿ

joins the four printed values and the printed linear rise with wall thickness. All four lie on one line of t/D, so what
t and D do apart from each other is not in them: `SPLIT_SIGMA` stands for that. Nothing here is a measurement, and
whatever is made of it says so.
"""

from __future__ import annotations

import math

from vinetrack.core import published

DIAMETER_EXPONENT = 0.75
"""Exponent of D in the guessed B. Derived: through the printed B of the smallest and largest vine with that of t at 1
(see `published`); `SPLIT_SIGMA` allows for another split."""

THICKNESS_EXPONENT = 1.0
"""Exponent of t in the guessed B. Published: the rise of B with thickness is printed as near-linear."""

SCATTER_DOF = 2
"""Four printed values less the two numbers of the law that were drawn through them. Derived: 4 − 2."""

SPLIT_SIGMA = 0.25
"""Error of the exponent of t against that of D, their sum kept. The printed rise with t at one diameter is near-linear
and may have an intercept: an exponent between 0.6 and 1.4 in nine of ten cases. Derived: ±0.4 at 90 % is ±0.25 at one
standard deviation (0.4/1.645)."""

PRINTED_ERROR = 0.05
"""Relative error of a printed B, of which nothing is printed but R²: points that scatter by 10 to 20 % about the law,
some ten of them, make 3 to 6 %. Derived: 15 %/√10 = 5 %."""

YIELD_PRESSURE_PA = 1000 * published.YIELD_PRESSURE_KPA
PRINTED_YIELD_SIGMA_PA = 1000 / math.sqrt(12)
"""Of the printed yield pressure, for the vine that it was printed for: "about 3 kPa", so to a whole number."""

YIELD_FACTOR = 3.0
"""One yield pressure is printed, for one vine: nine of ten others are taken to lie within this factor of it. Chosen: at
half (1.5) bands would be as narrow as if films were alike, at twice (6) a band at low pressure says nothing."""

BURST_STRESS_PA = 7.8e6
"""Hoop stress PD/2t at which film bursts, from the fast vine alone, which was grown at 7.75 MPa, just under it. Derived
from one published vine that held; at half of it safe vines are refused, at twice some are planned that burst."""

NINE_OF_TEN = 1.6448536269514722
"""Standard deviations of the normal distribution that hold 90 %."""

PRESSURE_SPREAD, DAMPING_SPREAD = 0.01, 0.03
"""From trial to trial, relative: what a batch of vines shows. Chosen: a regulator repeats to about one per cent, film
and seals to a few; a fit replaces both. At half and twice, bands of speed from this source halve and double (σ_v/v =
σ_B/(nB))."""


def damping_prior(diameter_m: float, thickness_m: float) -> float:
    """B of a vine of this size, N·(s/m)ⁿ.

    Parameters
    ----------
    diameter_m, thickness_m : float
        Size of the tube, m.

    Returns
    -------
    float

    Examples
    --------
    >>> round(damping_prior(25e-3, 100e-6), 2)
    3.32
    """
    largest = max(published.DAMPING_B)
    thickness = thickness_m / (1e-6 * published.THICKNESS_UM[largest])
    diameter = diameter_m / (1e-3 * published.DIAMETER_MM[largest])
    return published.DAMPING_B[largest] * thickness**THICKNESS_EXPONENT * diameter**DIAMETER_EXPONENT


def damping_scatter() -> float:
    """Standard deviation of ln B of the four printed values about the guess.

    >>> round(damping_scatter(), 3)
    0.113
    """
    off = [
        math.log(B / damping_prior(1e-3 * published.DIAMETER_MM[scale], 1e-6 * published.THICKNESS_UM[scale]))
        for scale, B in published.DAMPING_B.items()
    ]
    return math.sqrt(sum(difference**2 for difference in off) / SCATTER_DOF)


def damping_log_sigma(diameter_m: float, thickness_m: float) -> float:
    """Standard error, of Student's t, of the prediction of ln B of a vine with t/D as printed.

    That of a line drawn through the four printed points and read off at another, σ √(1 + ¼ + (z − z̄)²/Σ(zᵢ − z̄)²), z
    being the size in logarithms: it grows beyond the smallest and the largest vine.

    Parameters
    ----------
    diameter_m, thickness_m : float
        Size of the tube, m.

    Returns
    -------
    float

    Examples
    --------
    >>> round(damping_log_sigma(25e-3, 100e-6), 3), round(damping_log_sigma(2.5e-3, 50e-6), 3)
    (0.129, 0.18)
    """
    sizes = [
        math.log(damping_prior(1e-3 * published.DIAMETER_MM[scale], 1e-6 * published.THICKNESS_UM[scale]))
        for scale in published.DAMPING_B
    ]
    middle = sum(sizes) / len(sizes)
    away = math.log(damping_prior(diameter_m, thickness_m)) - middle
    leverage = 1 / len(sizes) + away**2 / sum((size - middle) ** 2 for size in sizes)
    return damping_scatter() * math.sqrt(1 + leverage)


def split_leverage(diameter_m: float, thickness_m: float) -> float:
    """By how much ln B moves when one is added to the exponent of t and taken from that of D; 0 for t/D as printed.

    Parameters
    ----------
    diameter_m, thickness_m : float
        Size of the tube, m.

    Returns
    -------
    float
    """
    largest = max(published.DAMPING_B)
    printed = 1e-6 * published.THICKNESS_UM[largest] / (1e-3 * published.DIAMETER_MM[largest])
    return math.log(thickness_m / diameter_m / printed)


def exponent_sigma() -> float:
    """Standard error of the printed n, from the printed R² of the four fits with about ten pressures each.

    That of a slope n of N points is n √((1 − R²)/R²/(N − 2)); the four together are weighed by it.

    >>> round(exponent_sigma(), 3)
    0.012
    """
    spare = sum(published.CONDITIONS) / len(published.CONDITIONS) - 2
    squares = [published.EXPONENT**2 * (1 - R2) / R2 / spare for R2 in published.DAMPING_R2.values()]
    return 1 / math.sqrt(sum(1 / square for square in squares))


def yield_log_sigma() -> float:
    """Standard deviation of the logarithm of a guessed yield pressure."""
    return math.log(YIELD_FACTOR) / NINE_OF_TEN


def burst_pressure_Pa(diameter_m: float, thickness_m: float) -> float:
    """Gauge pressure at which a vine of this size bursts, 2tσ/D, Pa; a guess from one vine.

    Parameters
    ----------
    diameter_m, thickness_m : float
        Size of the tube, m.

    Returns
    -------
    float

    Examples
    --------
    >>> round(burst_pressure_Pa(25e-3, 100e-6) / 1e3, 1)
    62.4
    """
    return 2 * thickness_m * BURST_STRESS_PA / diameter_m


def hoop_stress_Pa(pressure_Pa: float, diameter_m: float, thickness_m: float) -> float:
    """Hoop stress PD/2t of the wall, Pa.

    Parameters
    ----------
    pressure_Pa : float
        Gauge pressure, Pa.
    diameter_m, thickness_m : float
        Size of the tube, m.

    Returns
    -------
    float
    """
    return pressure_Pa * diameter_m / (2 * thickness_m)
