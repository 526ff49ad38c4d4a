"""The motion of an everting vine, written once more from the equations alone.

    m(y) ẍ = ½ [(P − P_y) A − B (1 + βP) ẋⁿ − ½ρ_air A C_D ẏ² − b ẋ − ½ f ρ_gas A ẏ²] + forces on the tail,  x = 2 y

Nothing here comes from the package under test: other variables (y, ẋ, pressure of the chamber), an adaptive
Runge–Kutta 5(4) of Dormand and Prince that lands on every frame, all effects in one function, each of no size at 0.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

Floats = NDArray[np.float64]

G, AMBIENT_PA, AIR, GAS_R_T = 9.81, 101_325.0, 1.20, 287.0 * 293.0


class Tube(NamedTuple):
    """One trial as it truly is, SI. `chamber` and `inlet_area` are infinite where nothing depends on them."""

    pressure: float
    yield_pressure: float
    diameter: float
    thickness: float
    length: float
    payload: float
    cosine: float
    chamber: float = math.inf
    inlet_area: float = math.inf
    film_density: float = 1200.0
    reel: float = 0.0
    has_bends: float = 0.0


class Physics(NamedTuple):
    """Sizes of everything that can act on the vine, SI; 0 is none."""

    B: float
    n: float
    gamma: float = 0.0  # of a closed chamber
    refill_s: float = 0.0  # time constant of a supply; 0 without one
    leak_rate: float = 0.0
    K: float = 0.0
    gas: float = 0.0
    C_D: float = 0.0
    eta: float = 0.0
    b: float = 0.0
    beta: float = 0.0
    mu_w: float = 0.0
    capstan_C: float = 0.0
    capstan_mu: float = 0.0
    capstan_k: float = 0.0
    mu_p: float = 0.0
    drag_area: float = 0.0
    kappa: float = 0.0
    compliance: float = 0.0
    latch_F: float = 0.0
    latch_reach: float = 1.0
    static_yield: float = 0.0
    reel_kg: float = 0.0
    stribeck_F: float = 0.0
    stribeck_speed: float = 1.0
    stribeck_power: float = 1.0
    ringing: float = 0.0
    ringing_hz: float = 1.0
    ringing_phase: float = 0.0
    stop_k: float = 0.0
    stop_y: float = 0.0
    square_q: float = 0.0
    # What no catalogue has.
    patch_F: float = 0.0
    patch_y: float = 0.0
    patch_width: float = 1.0
    ripple_F: float = 0.0
    ripple_length: float = 1.0
    ripple_phase: float = 0.0
    growing_F: float = 0.0
    growing_s: float = 1.0
    step_B: float = 0.0
    step_y: float = 0.0
    cubic: float = 0.0
    beyond: float = 0.0
    beyond_speed: float = 0.0
    slip_F: float = 0.0
    slip_x: float = 1.0
    slip_speed: float = 1.0
    chirp_F: float = 0.0
    chirp_length: float = 1.0
    chirp_phase: float = 0.0
    squeeze_F: float = 0.0
    squeeze_Pa: float = 1.0
    squeeze_y: float = 0.0
    squeeze_width: float = 1.0


@njit(cache=True, nogil=True)
def _sourced(t, y, chamber_Pa, area, tube, f):
    """Gauge pressure where the gas leaves the chamber: what a gauge there would show."""
    P = chamber_Pa
    if f.refill_s == 0.0:
        P = tube.pressure
        if f.gamma > 0.0:
            swept = tube.chamber / (tube.chamber + area * y)
            P = (tube.pressure + AMBIENT_PA) * swept**f.gamma - AMBIENT_PA
    P *= math.exp(-f.leak_rate * t)
    return P * (1.0 + f.ringing * math.sin(2.0 * math.pi * f.ringing_hz * t + f.ringing_phase))


@njit(cache=True, nogil=True)
def pressures(t, y, w, chamber_Pa, tube, f, trace_t, trace_P):
    """Pressure at the source, at the tip, and the cross-section they leave, consistent with each other."""
    still = math.pi * tube.diameter**2 / 4.0
    area = still
    source = tip = tube.pressure
    speed = 0.5 * w
    for _ in range(60):
        before = area
        source = np.interp(t, trace_t, trace_P) if trace_t.size > 0 else _sourced(t, y, chamber_Pa, area, tube, f)
        gas_density = (source + AMBIENT_PA) / GAS_R_T
        through = speed * area / tube.inlet_area
        tip = source - f.K * 0.5 * gas_density * through * through
        area = still * (1.0 + f.kappa * tip) ** 2
        if abs(area - before) < 1e-13 * still:
            break
    return source, tip, area


@njit(cache=True, nogil=True)
def tip_losses(w, P, area, f, y):
    """All that resists at the tip but the yield pressure, N; the pulley has not halved it yet."""
    speed = 0.5 * w
    B = f.B * max(1.0 + f.beta * P, 0.0)
    if f.step_B != 0.0 and y > f.step_y:
        B *= 1.0 + f.step_B
    loss = B * w**f.n + f.b * w + 0.5 * AIR * area * f.C_D * speed * speed
    return loss + 0.5 * f.gas * (P + AMBIENT_PA) / GAS_R_T * area * speed * speed


@njit(cache=True, nogil=True)
def tail_force(t, y, w, P, film_kg, tube, f, bends):
    """Forces on the tail and the payload themselves, N, positive along growth."""
    density = tube.film_density * math.pi * tube.diameter * tube.thickness
    force = (film_kg + tube.payload) * G * tube.cosine + 0.25 * f.eta * density * w * w
    force -= f.mu_w * (y if tube.reel > 0.0 else min(y, tube.length - y))
    if f.capstan_C > 0.0:
        turned = f.capstan_k * y
        if tube.has_bends > 0.0:
            angle = 0.0
            for i in range(bends.shape[0]):
                angle += min(max(y - bends[i, 0], 0.0), bends[i, 1]) / bends[i, 2]
            turned = f.capstan_mu * angle
        force -= f.capstan_C * (math.exp(turned) - 1.0)
    if tube.payload > 0.0:
        overtaking = 0.5 * w
        force -= f.mu_p * tube.payload * G
        force -= 0.5 * (P + AMBIENT_PA) / GAS_R_T * f.drag_area * overtaking * overtaking
    force -= f.latch_F * math.exp(-y / f.latch_reach)
    force -= f.patch_F * math.exp(-0.5 * ((y - f.patch_y) / f.patch_width) ** 2)
    force -= f.ripple_F * math.sin(2.0 * math.pi * y / f.ripple_length + f.ripple_phase)
    force -= f.stribeck_F * math.exp(-((w / f.stribeck_speed) ** f.stribeck_power))
    force -= f.stop_k * max(y - f.stop_y, 0.0) + f.square_q * y * y
    force -= f.cubic * w**3 + f.beyond * max(w - f.beyond_speed, 0.0) ** 2
    force -= f.slip_F * (2.0 * y / f.slip_x) ** 1.5 * w / (w + f.slip_speed)
    force -= f.chirp_F * math.sin(2.0 * math.pi * (y / f.chirp_length) ** 1.5 + f.chirp_phase)
    force -= f.squeeze_F * (P / f.squeeze_Pa) ** 2 * 0.5 * (1.0 + math.tanh((y - f.squeeze_y) / f.squeeze_width))
    return force - f.growing_F * t / f.growing_s


@njit(cache=True, nogil=True)
def rates(t, y, w, chamber_Pa, tube, f, bends, trace_t, trace_P):
    """ẏ, ẍ and the rate of the chamber's pressure; a vine at rest that nothing moves stays."""
    w, y = max(w, 0.0), min(max(y, 0.0), tube.length)
    _, P, area = pressures(t, y, w, chamber_Pa, tube, f, trace_t, trace_P)
    density = tube.film_density * math.pi * tube.diameter * tube.thickness
    film_kg = max(density * (tube.length - y), 0.0)
    gas_density = (P + AMBIENT_PA) / GAS_R_T
    least_kg = density * math.pi * tube.thickness + 0.25 * gas_density * area * tube.length
    moved_kg = max(film_kg + f.gas * 0.25 * gas_density * area * y, least_kg) + tube.payload + f.reel_kg
    drive = 0.5 * ((P - tube.yield_pressure) * area - tip_losses(w, P, area, f, y))
    accelerated = (drive + tail_force(t, y, w, P, film_kg, tube, f, bends)) / moved_kg
    if w <= 0.0:
        stuck = 0.5 * max(f.static_yield - tube.yield_pressure, 0.0) * area
        if accelerated <= stuck / moved_kg:
            accelerated = 0.0
    filling = 0.0
    if f.refill_s > 0.0:
        drawn = f.gamma * (chamber_Pa + AMBIENT_PA) * area * 0.5 * w / (tube.chamber + area * y)
        filling = (tube.pressure - chamber_Pa) / f.refill_s - drawn
    return 0.5 * w, accelerated, filling


@njit(cache=True, nogil=True)
def seen(y, w, t, chamber_Pa, tube, f, trace_t, trace_P):
    """Lead position with the stretch of tail and wall, and the pressure at the source.

    y + ½ε L + ½y(ε_w − ε), ε = T₁/(EπDt), ε_w = (PA − T₁)/(EπDt).
    """
    source, P, area = pressures(t, y, w, chamber_Pa, tube, f, trace_t, trace_P)
    pull = 0.5 * ((P - tube.yield_pressure) * area - tip_losses(max(w, 0.0), P, area, f, y))
    soft = f.compliance / (math.pi * tube.diameter * tube.thickness)
    tail = max(pull, 0.0) * soft
    wall = P * area * soft - tail
    return y + 0.5 * tail * tube.length + 0.5 * y * (wall - tail), source


# Dormand & Prince (1980), J. Comput. Appl. Math. 6, 19–26.
_A = np.array(
    [
        [0, 0, 0, 0, 0, 0],
        [1 / 5, 0, 0, 0, 0, 0],
        [3 / 40, 9 / 40, 0, 0, 0, 0],
        [44 / 45, -56 / 15, 32 / 9, 0, 0, 0],
        [19372 / 6561, -25360 / 2187, 64448 / 6561, -212 / 729, 0, 0],
        [9017 / 3168, -355 / 33, 46732 / 5247, 49 / 176, -5103 / 18656, 0],
        [35 / 384, 0, 500 / 1113, 125 / 192, -2187 / 6784, 11 / 84],
    ]
)
_C = np.array([0, 1 / 5, 3 / 10, 4 / 5, 8 / 9, 1, 1])
_E = np.array([71 / 57600, 0, -71 / 16695, 71 / 1920, -17253 / 339200, 22 / 525, -1 / 40])
_SHORTEST_S = 1e-10


@njit(cache=True, nogil=True)
def _step(t, h, state, k, tube, f, bends, trace_t, trace_P, tolerance):
    """One trial step: the new state and its error in tolerances. `k[0]` holds the rates at its beginning."""
    new = state.copy()
    for s in range(1, 7):
        new = state.copy()
        for j in range(s):
            new += h * _A[s, j] * k[j]
        k[s, 0], k[s, 1], k[s, 2] = rates(t + _C[s] * h, new[0], new[1], new[2], tube, f, bends, trace_t, trace_P)
    error = 0.0
    scale = (tube.length, 1.0 + abs(state[1]), tube.pressure + 1.0)
    for i in range(3):
        gap = 0.0
        for s in range(7):
            gap += h * _E[s] * k[s, i]
        error = max(error, abs(gap) / (tolerance * scale[i]))
    return new, error


MOST_STEPS = 25_000
"""A vine that creeps to a halt is too stiff for explicit steps: beyond these the rest is left to LSODA."""


@njit(cache=True, nogil=True)
def _explicit(times, tube, f, bends, trace_t, trace_P, tolerance):
    """States (y, ẋ, chamber) at the times, when all film was everted (NaN if it was not), the number of good rows."""
    out = np.empty((times.size, 3))
    state = np.array([0.0, 0.0, tube.pressure])
    k = np.zeros((7, 3))
    t, h, ended, steps = 0.0, 1e-7, math.nan, 0
    for i in range(times.size):
        while t < times[i] and math.isnan(ended):
            steps += 1
            if steps > MOST_STEPS:
                return out, ended, i
            k[0, 0], k[0, 1], k[0, 2] = rates(t, state[0], state[1], state[2], tube, f, bends, trace_t, trace_P)
            step = min(h, times[i] - t)
            new, error = _step(t, step, state, k, tube, f, bends, trace_t, trace_P, tolerance)
            if error > 1.0 and step > _SHORTEST_S:
                h = step * max(0.2, 0.9 * error**-0.2)
                continue
            if new[0] >= tube.length:
                ended = t + step * (tube.length - state[0]) / (new[0] - state[0])
                new[0], new[1] = tube.length, 0.0
            state, t = new, t + step
            state[1] = max(state[1], 0.0)
            if step >= h:
                h = step * min(5.0, 0.9 * max(error, 1e-10) ** -0.2)
        out[i] = state
    return out, ended, times.size


def follow(
    times: Floats,
    tube: Tube,
    f: Physics,
    bends: Floats,
    trace_t: Floats | None = None,
    trace_P: Floats | None = None,
    tolerance: float = 1e-10,
) -> tuple[Floats, float]:
    """Follow one trial from rest.

    Parameters
    ----------
    times : array, shape (n_times,), s since release; before 0 the vine is at rest
    bends : array, shape (n_bends, 3): start, arc, radius, m
    trace_t, trace_P : pressure that a gauge showed, Pa, in place of what the chamber would do

    Returns
    -------
    array, shape (n_times, 4)
        Lead position as seen (with the stretch of the tail), as it is, tail speed, pressure at the source; SI.
    float
        When all film was everted, NaN if it was not.
    """
    nothing = np.empty(0)
    trace = (nothing if trace_t is None else trace_t), (nothing if trace_P is None else trace_P)
    states, ended, good = _explicit(times, tube, f, bends, *trace, tolerance)
    if good < times.size:
        first = max(good - 1, 0)
        states[first:] = _stiffly(times[first:], states[first], tube, f, bends, *trace)
        reached = np.flatnonzero(states[:, 0] >= tube.length)
        ended = float(times[reached[0]]) if reached.size else math.nan
    return _all_seen(times, states, tube, f, *trace), ended


@njit(cache=True, nogil=True)
def _all_seen(times, states, tube, f, trace_t, trace_P):
    out = np.empty((times.size, 4))
    for i in range(times.size):
        y, w, chamber_Pa = states[i]
        out[i, 0], out[i, 3] = seen(y, w, max(times[i], 0.0), chamber_Pa, tube, f, trace_t, trace_P)
        out[i, 1], out[i, 2] = y, w
    return out


def _stiffly(
    times: Floats, start: Floats, tube: Tube, f: Physics, bends: Floats, trace_t: Floats, trace_P: Floats
) -> Floats:
    """States at the times, from the first on, by an implicit method."""
    found = solve_ivp(
        lambda t, s: rates(t, s[0], s[1], s[2], tube, f, bends, trace_t, trace_P),
        (times[0], times[-1]),
        start,
        method="LSODA",
        t_eval=times,
        rtol=1e-7,
        atol=(1e-9, 1e-7, 1e-2),
    )
    states = np.repeat(found.y[:, -1:].T, times.size, axis=0)
    states[: found.y.shape[1]] = found.y.T
    states[:, 0] = np.minimum(states[:, 0], tube.length)
    return states
