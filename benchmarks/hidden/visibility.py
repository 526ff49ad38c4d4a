"""How visible a fault is: what is left of it, in standard deviations, once all that is fitted anyway has adapted.

The base model (its own simulator, `hidden.motion`) is fitted to the positions as they would be without noise. Free are
B of each vine and a shared n; P_y of each vine within its error; B and pressure of each trial within their scatter;
release and origin of each trial. √χ² at the minimum is the most that any test of the base model can see.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hidden.motion import Floats, Physics, follow
from hidden.shots import Camera, Laboratory, Shot, gauge, reported

POINTS = 40
YIELD_SIGMA_PA = 200.0
LEAST_SCATTER = 0.002
MOST_ROUNDS = 25
MOST_DAMPING = 1e10
NO_BENDS = np.empty((0, 3))


@dataclass(frozen=True)
class _Trial:
    """One trial as filmed without noise: times since release, positions, weight of a position, pressure recorded."""

    shot: Shot
    since: Floats
    position: Floats
    weight: float
    trace: tuple[Floats, Floats] | None

    def moved(self, B: float, n: float, yield_Pa: float, pressure: float, late_s: float) -> Floats:
        """Lead position, m, of the base model with these in place of what was true; B and pressure relative."""
        shot = self.shot
        tube = shot.tube._replace(
            pressure=shot.tube.pressure * pressure, yield_pressure=max(shot.tube.yield_pressure + yield_Pa, 0.0)
        )
        f = Physics(B=shot.physics.B * B, n=n)
        traced = () if self.trace is None else (self.trace[0], self.trace[1] * pressure)
        out, _ = follow(self.since - late_s, tube, f, NO_BENDS, *traced, tolerance=1e-8)
        return out[:, 0]


def visible_sigma(laboratory: Laboratory) -> float:
    """√χ² of the best base model, without noise."""
    trials = [_filmed(shot, laboratory.camera) for shot in laboratory.shots]
    vines = list(dict.fromkeys(shot.setting.vine for shot in laboratory.shots))
    which = [vines.index(shot.setting.vine) for shot in laboratory.shots]
    scatter = [max(laboratory.truths[name], LEAST_SCATTER) for name in ("B_scatter", "pressure_scatter")]
    return _fitted(trials, which, len(vines), *scatter)


def _filmed(shot: Shot, camera: Camera) -> _Trial:
    step_s = 1 / shot.setting.capture_hz
    since = np.arange(-3, 1500) * step_s
    y, _, gauge_Pa = reported(shot, camera, since)
    inside = (1.0 if camera.sees_end else 0.9) * shot.tube.length
    stop = max(int(np.searchsorted(y, inside)) + 3 * camera.sees_end, 8)
    stop = min(stop, since.size)
    every = np.unique(np.linspace(0, stop - 1, POINTS).astype(int))
    # Noise that is correlated by ρ from frame to frame tells as little as (1 + ρ)/(1 − ρ) times as few points.
    count = stop / every.size * (1 - camera.rho) / (1 + camera.rho)
    trace = None
    if math.isfinite(camera.trace_late_s):
        trace = since, gauge(since, gauge_Pa, camera)
    return _Trial(shot, since[every], y[every], math.sqrt(count) / camera.noise_m, trace)


def _fitted(
    trials: Sequence[_Trial], which: Sequence[int], vines: int, damping_scatter: float, pressure_scatter: float
) -> float:
    """√χ² of the best fit. Parameters: ln B and P_y by vine, n, then four by trial."""
    exponent = float(np.mean([trial.shot.physics.n for trial in trials]))
    values = np.zeros(2 * vines + 1 + 4 * len(trials))
    prior = np.full(values.size, math.inf)
    prior[vines : 2 * vines] = 1.0
    prior[2 * vines + 1 :: 4], prior[2 * vines + 2 :: 4] = damping_scatter, pressure_scatter

    def own(values: Floats, i: int) -> tuple[float, ...]:
        first = 2 * vines + 1 + 4 * i
        B = math.exp(values[which[i]] + values[first])
        n = exponent + values[2 * vines]
        yield_Pa = YIELD_SIGMA_PA * values[vines + which[i]]
        return B, n, yield_Pa, math.exp(values[first + 1]), values[first + 2] / 1e3

    def misfit(values: Floats) -> Floats:
        parts = [
            trial.weight * (trial.position - trial.moved(*own(values, i)) - values[2 * vines + 4 + 4 * i] / 1e3)
            for i, trial in enumerate(trials)
        ]
        return np.concatenate([*parts, -values / prior])

    def slopes(values: Floats) -> Floats:
        rows = sum(trial.since.size for trial in trials)
        out = np.zeros((rows + values.size, values.size))
        row = 0
        for i, trial in enumerate(trials):
            here = slice(row, row + trial.since.size)
            row += trial.since.size
            first = 2 * vines + 1 + 4 * i
            start = trial.moved(*own(values, i))
            for column in (which[i], vines + which[i], 2 * vines, first + 1, first + 2):
                ahead = values.copy()
                step = 0.01 if vines <= column < 2 * vines or column == first + 2 else 3e-4
                ahead[column] += step
                out[here, column] = trial.weight * (trial.moved(*own(ahead, i)) - start) / step
            out[here, first] = out[here, which[i]]
            out[here, first + 3] = trial.weight / 1e3
        out[rows:] = np.diag(1 / prior)
        return out

    # Sizes of ln B, P_y (in its σ) and n, and by trial of ln B, ln P, release (ms) and origin (mm).
    own_sizes = [damping_scatter, pressure_scatter, 1.0, 1.0]
    sizes = np.array([0.1] * vines + [1.0] * vines + [0.02] + own_sizes * len(trials))
    left, damping = misfit(values), 1e3
    for _ in range(MOST_ROUNDS):
        J = slopes(values)
        gained = 0.0
        while gained <= 0 and damping < MOST_DAMPING:
            step = np.linalg.solve(J.T @ J + np.diag(damping / sizes**2), J.T @ left)
            step = np.clip(step, -5 * sizes, 5 * sizes)
            tried = misfit(values + step)
            gained = float(left @ left - tried @ tried)
            damping *= 0.05 if gained > 0 else 20
            if gained > 0:
                values, left = values + step, tried
        if gained < 0.01 + 1e-3 * float(left @ left) and (gained <= 0 or damping < 1e-2):
            break
    return math.sqrt(float(left @ left))
