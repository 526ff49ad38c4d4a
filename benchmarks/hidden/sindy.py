"""Sparse regression on differentiated positions with PySINDy, given every chance.

Positions are smoothed and differentiated by the package's own adaptive Savitzky–Golay filter, which knows its errors.
The library is the balance of forces itself: what the base model leaves of it along the measured motion is regressed on
a column for the damping of each vine (its exponent chosen by least squares beforehand) and a column for each candidate,
faults of the measurement included: the change of the balance per unit of its size, at the sheet's pressures, masses and
chambers. Rows are weighed by the error of the acceleration and of one condition's drive. Terms are
eliminated stepwise by what they explain (`SSR`: thresholds on coefficients, as in STLSQ, keep nearly collinear pairs
whatever they explain, and did worse here); how many stay is chosen by cross-validation that leaves out whole
conditions, with the rule of one standard error.

PySINDy is not among the project's dependencies: `pip install pysindy` before this benchmark, or its column is blank.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

import vinetrack as vt
from vinetrack.core.records import Floats, Track, Trial
from vinetrack.dynamics.audit import evaluate
from vinetrack.dynamics.model import Model
from vinetrack.effects import Effect, EffectError, catalogue
from vinetrack.kinematics.velocity import estimate_kinematics

FOLDS = 5
GAINS = ("length_scale", "time_base", "pressure_gain", "area_scale")
"""Two of these together can multiply the whole balance by nothing, which then balances: one at a time is offered."""

MOST_INSTANTS = 60
EXPONENTS = np.linspace(0.1, 0.9, 41)
SEEN_AS = ("length_scale", "time_base", "perspective", "tail_stretch")
"""What changes what is seen, not the forces."""


def available() -> bool:
    """Whether PySINDy can be imported."""
    from importlib.util import find_spec

    return find_spec("pysindy") is not None


@dataclass(frozen=True)
class Motion:
    """Smoothed motion of one trial from its release on; arrays, shape (n,), SI, of the leading edge."""

    trial: Trial
    time_s: Floats
    position: Floats
    velocity: Floats
    acceleration: Floats
    error: Floats
    pressure: Floats | None


def motion_of(trial: Trial, track: Track) -> Motion | None:
    """Differentiate one track; None where nothing clear is left."""
    seen = estimate_kinematics(track, travel_ratio=2.0)
    v, sigma = seen.lead_velocity_m_s, seen.lead_velocity_sigma_m_s
    moving = (v > 5 * sigma) & (v > 0.05 * np.nanmax(v))
    late = np.flatnonzero(~moving)
    top = int(np.nanargmax(np.where(moving, v, -np.inf)))
    before = late[late < top]
    first = int(before[-1]) + 1 if before.size else 0
    origin = float(np.median(seen.lead_position_m[: max(first - 1, 1)]))
    y = seen.lead_position_m - origin
    keep = moving & (np.arange(v.size) >= first) & (y < 0.95 * trial.length_m) & (y > 0)
    if np.count_nonzero(keep) < 8:
        return None
    places = np.flatnonzero(keep)
    # Smoothed neighbours say the same: every trial counts with so many instants.
    keep = places[np.unique(np.linspace(0, places.size - 1, MOST_INSTANTS).astype(int))]
    step_s = float(np.median(np.diff(seen.time_s)))
    width_s = seen.window_points * step_s
    pressure = None if track.pressure_Pa is None else np.interp(seen.time_s, track.time_s, track.pressure_Pa)[keep]
    return Motion(
        trial,
        seen.time_s[keep] - seen.time_s[first],
        y[keep],
        v[keep],
        seen.lead_acceleration_m_s2[keep],
        # A slope of velocities within a window errs as they do over its half width.
        (2 * sigma / width_s * 2)[keep],
        pressure,
    )


def imbalance(model: Model, m: Motion, damped: bool = True) -> Floats:
    """What the model leaves of m ẍ − Σ forces along a motion, N; without its power law where not `damped`."""
    terms = evaluate(model, m.trial, m.time_s, m.position, m.velocity, measured_Pa=m.pressure)
    left = terms.inertia_kg * 2 * m.acceleration - terms.tension_N - sum(terms.tail_N.values())
    return np.asarray(left if damped else left + terms.tip_N["eversion_damping"] / 2)


def _as_it_was(effect: Effect, size: float, m: Motion, base: Model) -> Motion:
    """The motion that was there if this much of what is seen is the effect's doing."""
    y, v, a = m.position, m.velocity, m.acceleration
    if effect.name == "length_scale":
        return replace(m, position=y / (1 + size), velocity=v / (1 + size), acceleration=a / (1 + size))
    if effect.name == "time_base":
        return replace(m, time_s=m.time_s / (1 + size), velocity=v * (1 + size), acceleration=a * (1 + size) ** 2)
    if effect.name == "perspective":
        bent = a * (1 - 2 * size * y) - 2 * size * v * v
        return replace(m, position=y - size * y * y, velocity=v * (1 - 2 * size * y), acceleration=bent)
    terms = evaluate(base, m.trial, m.time_s, y, v, measured_Pa=m.pressure)
    pull = np.maximum(terms.tension_N, 0)
    trial = m.trial
    forces = trial.length_m * pull + y * (terms.pressure_Pa * terms.area_m2 - 2 * pull)
    stretch = 0.5 * size * forces / (np.pi * trial.diameter_m * trial.thickness_m)
    rate = np.gradient(stretch, m.time_s)
    return replace(m, position=y - stretch + stretch[0], velocity=v - rate)


def column(effect: Effect, base: Model, motions: Sequence[Motion]) -> Floats:
    """Change of the balance per unit of an effect's size, N per unit, all trials one after the other."""
    size = effect.parameters[0]
    low, high = size.plausible or (0.0, size.default)
    step = 0.1 * max(abs(low), abs(high)) if size.name != "gamma" else size.default
    if effect.name == "supply_refill":
        step = size.default
    out = []
    for m in motions:
        before = imbalance(base, m)
        if effect.name in SEEN_AS:
            after = imbalance(base, _as_it_was(effect, step, m, base))
        else:
            value = {f"{effect.name}.{size.name}": size.zero + step}
            after = imbalance((base + effect).with_values(value), m)
        out.append((before - after) / step)
    return np.concatenate(out)


def chosen(pairs: Sequence[tuple[Trial, Track]]) -> tuple[str, ...]:
    """Names of the candidates whose coefficient survives."""
    motions = [m for m in (motion_of(trial, track) for trial, track in pairs) if m is not None]
    vines = sorted({m.trial.vine for m in motions})
    n, B = _damping(motions, vines)
    base = vt.base_model().with_values({"eversion_damping.n": n, "eversion_damping.B": B})
    weight = np.concatenate([_weights(base, m) for m in motions])
    target = np.concatenate([imbalance(base, m, damped=False) for m in motions])
    columns = _damping_columns(motions, vines, n)
    names = []
    for effect in catalogue().values():
        if effect.kind == "base" or effect.name == "static_yield":
            continue
        try:
            one = column(effect, base, motions)
        except EffectError:
            continue
        if np.all(np.isfinite(one)) and np.ptp(one) > 0:
            names.append(effect.name)
            columns.append(one)
    always = np.column_stack(columns[: len(vines)]) * weight[:, None]
    asked = _freed_of(always, np.column_stack(columns[len(vines) :]) * weight[:, None])
    asked = asked / np.sqrt(np.mean(asked**2, axis=0))
    target = _freed_of(always, target * weight)
    groups = np.concatenate([[m.trial.condition] * m.time_s.size for m in motions])
    found = []
    for gain in GAINS:
        use = [k for k, name in enumerate(names) if name == gain or name not in GAINS]
        error, coefficients = _sparse(asked[:, use], target, groups)
        found.append((error, tuple(names[k] for k, c in zip(use, coefficients, strict=True) if c != 0)))
    return min(found)[1]


def _damping_columns(motions: Sequence[Motion], vines: Sequence[str], n: float) -> list[Floats]:
    power = [-0.5 * (2 * m.velocity) ** n for m in motions]
    return [np.concatenate([p * (m.trial.vine == vine) for p, m in zip(power, motions, strict=True)]) for vine in vines]


def _damping(motions: Sequence[Motion], vines: Sequence[str]) -> tuple[float, dict[str, float]]:
    """Exponent and coefficients of the base model by least squares on the balance."""
    base = vt.base_model().with_values({"eversion_damping.B": 1.0})
    target = np.concatenate([imbalance(base, m, damped=False) for m in motions])
    weight = np.concatenate([_weights(base, m) for m in motions])
    best = (np.inf, 0.0, np.zeros(len(vines)))
    for n in EXPONENTS.tolist():
        library = np.column_stack(_damping_columns(motions, vines, n)) * weight[:, None]
        B, *_ = np.linalg.lstsq(library, target * weight, rcond=None)
        left = float(np.sum((target * weight - library @ B) ** 2))
        if left < best[0]:
            best = left, n, B
    return best[1], dict(zip(vines, np.maximum(best[2], 1e-3).tolist(), strict=True))


def _weights(base: Model, m: Motion) -> Floats:
    """One over the error of the balance: that of the acceleration, and a per cent of the drive."""
    terms = evaluate(base, m.trial, m.time_s, m.position, m.velocity, measured_Pa=m.pressure)
    drive = 0.5 * (m.trial.pressure_Pa - m.trial.yield_pressure_Pa) * m.trial.area_m2
    return 1 / np.hypot(terms.inertia_kg * 2 * m.error, 0.02 * drive)


def _sparse(library: Floats, target: Floats, groups: np.ndarray) -> tuple[float, Floats]:
    """Error on left-out conditions, and coefficients, by stepwise elimination cross-validated over conditions.

    Of all numbers of terms that predict left-out conditions within a standard error of the best, the smallest.
    """
    names = sorted(set(groups.tolist()))
    fold_of = {name: k % FOLDS for k, name in enumerate(names)}
    fold = np.array([fold_of[name] for name in groups.tolist()])
    errors = np.empty((FOLDS, library.shape[1] + 1))
    for k in range(FOLDS):
        away = fold == k
        path = _path(library[~away], target[~away])
        errors[k] = np.mean((target[away][:, None] - library[away] @ path.T) ** 2, axis=0)
    mean, spread = errors.mean(axis=0), errors.std(axis=0, ddof=1) / np.sqrt(FOLDS)
    best = int(np.argmin(mean))
    terms = int(np.flatnonzero(mean <= mean[best] + spread[best])[0])
    return float(mean[terms]), _path(library, target)[terms]


def _path(library: Floats, target: Floats) -> Floats:
    """Coefficients with 0, 1, 2 … all terms, shape (n_terms + 1, n_terms), by PySINDy's elimination of terms."""
    import pysindy as ps

    # Least squares knows its rows only through this triangle: as good, and a hundred times as fast.
    triangle = np.linalg.qr(np.column_stack([library, target]), mode="r")
    x, y = triangle[:, :-1], triangle[:, -1:]
    optimizer = ps.SSR(criteria="model_residual", alpha=1e-9, max_iter=x.shape[1], unbias=False)
    optimizer.fit(x, y)
    count = x.shape[1]
    path = np.zeros((count + 1, count))
    path[count] = np.linalg.lstsq(x, y[:, 0], rcond=None)[0]
    for coefficients in optimizer.history_[1:]:
        support = np.flatnonzero(np.ravel(coefficients))
        if 0 < support.size < count:
            path[support.size, support] = np.linalg.lstsq(x[:, support], y[:, 0], rcond=None)[0]
    return path


def _freed_of(always: Floats, columns: Floats) -> Floats:
    """What is left of columns when those that always stay have had their share: they are never thresholded."""
    return columns - always @ np.linalg.lstsq(always, columns, rcond=None)[0]
