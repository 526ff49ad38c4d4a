"""A vine followed by SciPy in another formulation than the package's: truth for tests of the integrator.

m ẍ = ½(P − P_y)A + m g cosθ − ½B ẋⁿ is written in u = ẋⁿ and a made-up time s with dt = m/(n k) u^(1/n − 1) ds, k = ½B:

    du/ds = F(x, t)/k − u,    dx/ds = m/(n k) u^(2/n − 1),    dt/ds = m/(n k) u^(1/n − 1)

The start from rest, singular in t, is smooth in s, and what is left is integrated at rtol 10⁻¹²: DOP853, or Radau where
the speed follows the drive so closely that an explicit method crawls. Masses are written out here once more by hand.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import OdeSolution, solve_ivp

from vinetrack.core.records import Trial

G = 9.81
AIR = 287.0 * 293.0  # J/kg, R·T of air

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Masses:
    """Film per metre, film at rest, what a tail loses per metre, the floor of fold and gas, the payload: kg, kg/m."""

    film: float
    lost_per_m: float
    floor: float
    payload: float

    def moving(self, x: Floats | float) -> Floats:
        return np.maximum(self.film - self.lost_per_m * x, self.floor) + self.payload

    @property
    def break_m(self) -> float:
        """Tail travel at which the film reaches its floor."""
        return (self.film - self.floor) / self.lost_per_m


def masses(trial: Trial) -> Masses:
    """By hand: λ = ρπDt, c = λ/2, and a floor of the fold (λ over πt) and a quarter of the gas."""
    density = trial.film_density_kg_m3 * math.pi * trial.diameter_m * trial.thickness_m
    gas = (trial.pressure_Pa + 101_325) / AIR * math.pi * trial.diameter_m**2 / 4 * trial.length_m
    return Masses(
        density * trial.length_m, density / 2, density * math.pi * trial.thickness_m + gas / 4, trial.payload_kg
    )


@dataclass(frozen=True)
class Reference:
    """Pieces of the solution (u, x, t)(s), one on each side of the breakpoint of the mass."""

    pieces: tuple[OdeSolution, ...]
    n: float
    rate: Callable[[Floats, Floats], Floats]
    """dt/ds from (u, x)."""

    @property
    def end_s(self) -> float:
        """Time at which it reaches the end of growth, or the last time asked for."""
        return float(self.pieces[-1](self.pieces[-1].t_max)[2])

    def state(self, times_s: Floats) -> Floats:
        """Rows (x, ẋ) of the tail at times not past the end, shape (2, n): Newton on t(s)."""
        out = np.zeros((2, len(times_s)))
        for piece in self.pieces:
            knots = piece(piece.ts)[2]
            inside = (times_s > knots[0]) & (times_s <= knots[-1])
            if not inside.any():
                continue
            s = np.interp(times_s[inside], knots, piece.ts)
            for _ in range(20):
                u, x, t = piece(s)
                s = np.clip(s + (times_s[inside] - t) / self.rate(u, x), piece.t_min, piece.t_max)
            u, x, t = piece(s)
            assert np.allclose(t, times_s[inside], rtol=1e-12, atol=1e-14)
            out[:, inside] = x, np.maximum(u, 0.0) ** (1 / self.n)
        return out


def reference(
    trial: Trial,
    B: float,
    n: float,
    until_s: float,
    *,
    pressure: Callable[[float, float], float] | None = None,
    stiff: bool = False,
) -> Reference:
    """Follow `trial` from rest to the end of its growth or to `until_s`; `pressure(t, y)` replaces the set pressure."""
    mass, k, stop = masses(trial), B / 2, 2 * trial.length_m
    area, cosine = math.pi * trial.diameter_m**2 / 4, math.cos(trial.growth_angle_rad)
    drive = pressure or (lambda _t, _y: trial.pressure_Pa)

    def rate(u: Floats | float, x: Floats | float) -> Floats:
        return mass.moving(x) / (n * k) * np.maximum(u, 0.0) ** (1 / n - 1)

    def slope(_s: float, state: Floats) -> tuple[float, float, float]:
        u, x, t = state
        force = (drive(t, x / 2) - trial.yield_pressure_Pa) * area / 2 + mass.moving(x) * G * cosine
        w = rate(u, x)
        return force / k - u, w * max(u, 0.0) ** (1 / n), w

    def late(_s: float, state: Floats) -> float:
        return state[2] - until_s

    late.terminal = True
    pieces, start, state = [], 0.0, np.zeros(3)
    edges = [edge for edge in (mass.break_m, stop) if 0 < edge <= stop]
    for edge in edges:

        def reached(_s: float, state: Floats, edge: float = edge) -> float:
            return state[1] - edge

        reached.terminal = True
        done = solve_ivp(
            slope,
            (start, 1e15),
            state,
            "Radau" if stiff else "DOP853",
            rtol=1e-11 if stiff else 1e-12,
            atol=[1e-14, 1e-15 * stop, 1e-15 * min(until_s, 1e3)],
            dense_output=True,
            events=(reached, late),
        )
        assert done.status == 1, done.message
        pieces.append(done.sol)
        start, state = float(done.t[-1]), done.y[:, -1].copy()
        if done.t_events[1].size:
            break
        state[1] = edge
    return Reference(tuple(pieces), n, rate)
