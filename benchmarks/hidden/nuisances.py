"""What no physics explains: scatter from trial to trial, noise of positions, errors of the sheet, frames."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

NOISES = ("white", "ar1", "ma", "mixed", "heavy", "outliers")
SHAPES = ("normal", "uniform", "student", "lopsided")


@dataclass(frozen=True)
class Nuisances:
    """How a campaign was spoilt. Scatters are relative standard deviations."""

    damping_scatter: float
    pressure_scatter: float
    scatter_shape: str = "normal"
    noise_m: float = 1e-4
    noise: str = "white"
    rho: float = 0.0
    heavy: bool = False
    unequal_noise: float = 0.0  # standard deviation of ln σ between trials
    yield_sigma_kPa: float = 0.2
    payload_error: float = 0.005
    rest_frames: tuple[int, int] = (10, 40)
    without_rest: float = 0.0  # share of trials filmed from after the release
    cut_short: float = 0.0  # share of trials that end early
    sees_end: bool = False
    rounding_kPa: float = 0.1
    dropped: float = 0.0  # share of trials that lost 1–3 frames, unsaid
    trace_sigma_kPa: float = math.nan  # of a pressure recorded along, NaN without one


def draw_nuisances(draw: np.random.Generator) -> Nuisances:
    """Anything that a real laboratory may bring along."""
    noise = str(draw.choice(NOISES, p=[0.25, 0.3, 0.1, 0.15, 0.15, 0.05]))
    return Nuisances(
        damping_scatter=float(draw.uniform(0, 0.05)),
        pressure_scatter=float(draw.uniform(0, 0.02)),
        scatter_shape=str(draw.choice(SHAPES, p=[0.6, 0.2, 0.1, 0.1])),
        noise_m=float(np.exp(draw.uniform(math.log(3e-5), math.log(3e-4)))),
        noise=noise,
        rho=0.0 if noise in ("white", "outliers") else float(draw.uniform(0, 0.6)),
        unequal_noise=float(draw.choice([0.0, 0.2, 0.4])),
        payload_error=0.005,
        without_rest=float(draw.choice([0.0, 0.0, 0.2])),
        cut_short=float(draw.choice([0.0, 0.1, 0.2])),
        sees_end=bool(draw.uniform() < 0.25),
    )


def regime(name: str, draw: np.random.Generator) -> Nuisances:
    """The nuisances of one named regime of null campaigns: one thing at its worst, the rest as anywhere."""
    plain = replace(draw_nuisances(draw), noise="white", rho=0.0)
    rho = float(draw.uniform(0.3, 0.6))
    changed = {
        "anything": draw_nuisances(draw),
        "white": plain,
        "correlated": replace(plain, noise="ar1", rho=rho),
        "moving_average": replace(plain, noise="ma", rho=rho),
        "mixed_noise": replace(plain, noise="mixed", rho=rho),
        "heavy_tails": replace(plain, noise="heavy", rho=float(draw.uniform(0, 0.6))),
        "outliers": replace(plain, noise="outliers"),
        "unequal_noise": replace(plain, unequal_noise=0.6),
        "large_B_scatter": replace(plain, damping_scatter=0.05),
        "large_P_scatter": replace(plain, pressure_scatter=0.02),
        "odd_scatter": replace(
            plain, damping_scatter=0.04, pressure_scatter=0.015, scatter_shape=str(draw.choice(SHAPES[1:]))
        ),
        "no_scatter": replace(plain, damping_scatter=0.0, pressure_scatter=0.0),
        "low_noise": replace(plain, noise_m=3e-5),
        "high_noise": replace(plain, noise_m=3e-4),
        "few_trials": plain,
        "no_rest": replace(plain, without_rest=1.0),
        "payload_errors": replace(plain, payload_error=0.015),
        "cut_short": replace(plain, cut_short=0.5),
        "rounded": replace(plain, rounding_kPa=0.5),
        "trace": replace(plain, trace_sigma_kPa=0.1),
    }
    return changed[name]


def scatter(draw: np.random.Generator, shape: str, count: int) -> Floats:
    """Deviates of unit variance."""
    if shape == "uniform":
        return draw.uniform(-math.sqrt(3), math.sqrt(3), count)
    if shape == "student":
        return np.clip(draw.standard_t(4, count) / math.sqrt(2), -4, 4)
    if shape == "lopsided":
        return draw.exponential(1, count) - 1
    return draw.standard_normal(count)


def noise(draw: np.random.Generator, how: Nuisances, count: int) -> Floats:
    """Errors of the positions of one trial, m."""
    sigma_m = how.noise_m * math.exp(how.unequal_noise * draw.standard_normal())
    burn = 200
    kicks = draw.standard_normal(count + burn)
    if how.noise == "heavy":
        kicks = draw.standard_t(3, count + burn) / math.sqrt(3)
    if how.noise == "ma":
        # Lag-one correlation a/(1 + a²) goes up to ½.
        a = min(how.rho, 0.48)
        a = 0.0 if a == 0 else (1 - math.sqrt(1 - 4 * a * a)) / (2 * a)
        kicks[1:] = (kicks[1:] + a * kicks[:-1]) / math.sqrt(1 + a * a)
        return sigma_m * kicks[burn:]
    slow = _ar1(kicks, how.rho if how.noise != "mixed" else 0.85)[burn:]
    if how.noise == "mixed":
        share = how.rho / 0.85
        return sigma_m * (math.sqrt(share) * slow + math.sqrt(1 - share) * draw.standard_normal(count))
    if how.noise == "outliers":
        wild = draw.uniform(size=count) < 0.004
        slow[wild] += draw.choice([-1, 1], int(wild.sum())) * draw.uniform(5, 10, int(wild.sum()))
    return sigma_m * slow


def _ar1(kicks: Floats, rho: float) -> Floats:
    out = np.empty_like(kicks)
    before = 0.0
    for k, kick in enumerate((math.sqrt(1 - rho * rho) * kicks).tolist()):
        before = rho * before + kick
        out[k] = before
    return out
