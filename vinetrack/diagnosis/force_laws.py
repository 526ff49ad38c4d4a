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

from vinetrack.core.records import Floats
from vinetrack.diagnosis.force_inversion import (
    FittedMotion,
    ForceEstimate,
    LinearInversion,
    SmoothForce,
    acceleration_sensitivities,
    scaled_pseudo_inverse,
    trial_of_job,
    with_force,
    with_model_terms,
)
from vinetrack.diagnosis.remarks import remark
from vinetrack.dynamics.audit import evaluate
from vinetrack.dynamics.simulate import SimulationError
from vinetrack.inference.fit_data import FitTrial
from vinetrack.inference.fit_result import YIELD_PRESSURE, Fit
from vinetrack.inference.marginal_likelihood import trial_effect_prior
from vinetrack.inference.sensitivity import N_TRIAL_EFFECTS, ORIGIN, RELEASE, Job
from vinetrack.inference.whitening import whiten

# Number of positions of a local force, and its widths as parts of the growth (chosen)
PATCH_CENTRES, PATCH_WIDTHS = 16, (0.06, 0.12, 0.2, 0.33)


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
        variables = {VARIABLE_OF_KIND[kind] for kind in (self.kind, self.factor) if kind in VARIABLE_OF_KIND}
        return tuple(name for name in ("growth", "speed", "time", "pressure") if name in variables)

    @property
    def is_unresolved(self) -> bool:
        """Whether it acts over less than a millimetre, which no camera that films the whole growth resolves."""
        # 1e-3: least width of a local force that is reported (chosen)
        return self.kind == "patch" and not self.high - max(self.low, 0.0) > 1e-3

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
        return str(remark("law", law=self, amplitude_N=amplitude_N, sigma_N=sigma_N))


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


# Products in the grid (chosen)
_PRODUCTS = {
    **dict.fromkeys(("position", "position_squared", "fading_along", "beyond_a_place"), ("speed", "pressure")),
    **dict.fromkeys(("speed", "speed_squared", "inverse_speed"), ("pressure",)),
    "speed_squared": ("position", "pressure"),
    "falling_with_speed": ("pressure",),
}


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
    for width in PATCH_WIDTHS:
        for centre in (np.arange(PATCH_CENTRES) + 0.5) / PATCH_CENTRES * visited.growth_m:
            laws.append(_patch_at(float(centre), width * visited.growth_m))
    # 24: periods in the grid (chosen)
    # 0.6, 0.04: as parts of the growth (derived)
    for period in np.geomspace(0.04, 0.6, 24) * visited.growth_m:
        laws.append(Law("periodic", n_amplitudes=2, n_shapes=1, scale=float(period)))
    laws += [replace(law, factor=factor) for law in laws for factor in _PRODUCTS.get(law.kind, ())]
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
        peak_after_start = max(
            float(force[_after_start(motion)].max()) for force, motion in zip(forces, motions, strict=True)
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


def _after_start(motion: FittedMotion) -> NDArray[np.bool_]:
    """Where a vine has grown beyond its start: the size of a law at rest alone is not observed."""
    # 0.05: part of the growth over which a vine accelerates (chosen)
    return motion.lead_position_m >= 0.05 * motion.lead_position_m.max()


def _visited_range(motions: Sequence[FittedMotion]) -> _Range:
    return _Range(
        max(float(motion.lead_position_m.max()) for motion in motions),
        max(float(np.quantile(motion.tail_velocity_m_s, 0.98)) for motion in motions),
        max(float(motion.time_s[-1]) for motion in motions),
    )


# ------------------------------------------------------------------------------
# Nonlinear least squares for a missing force, with model parameters and trial effects free.
#
# The linear inversion (`vinetrack.diagnosis.force_inversion`) tells laws apart; but a force that slows a vine down
# keeps it longer where the force acts, so that the linear estimate of a force of a tenth of the drive comes out a
# fifth too large. Here the motions respond to the force in full (`vinetrack.diagnosis.force_inversion.with_force`),
# and Gauss-Newton steps, damped as by Levenberg and Marquardt where needed, find the amplitudes, the shape parameters
# of the law, the model parameters and the trial effects. The search starts from the fitted motions, which lie near
# the tracks: simulated from the parameters of the model without the force, they would run ahead of the tracks.

MAX_STEPS, MOTION_CORRECTIONS = 12, 2  # Most Gauss-Newton steps, and corrections of the motions at each (chosen)


# Damping factors of Levenberg and Marquardt, for steps that must lower the cost (chosen)
FIRST_DAMPING, LEAST_DAMPING = 1e-3, 1e-5

UNDAMPED_SUCCESS = 0.5  # Part of χ² above which the undamped steps have failed (chosen)

# Step of finite differences, in the fit's scaling of parameters, and relative for shape parameters (derived)
DIFFERENCE_STEP = 1e-3


CONVERGENCE_TOLERANCE = 1e-3  # Relative fall of χ² below which the search ends (chosen)

SHAPE_CUTOFF = 1e-12  # Relative eigenvalue of the scaled normal matrix below which a direction does not move (derived)


@dataclass(frozen=True)
class RefinedLaw:
    """A law after the nonlinear fit: amplitudes and the standard error of one, N, and the χ² that remains.
    `parameter_shift` is how far the model parameters moved, in the fit's own scaling.
    """

    law: Law
    amplitude: Floats
    sigma: float
    chi2: float
    parameter_shift: Floats


@dataclass(frozen=True)
class SearchPoint:
    """The unknowns at one point of a search, and the motions that they are linearised about. Where
    `motions_include_force`, the motions are those of these parameters and this force. Otherwise they are others near
    by, and their defect (by how much they violate the equation of motion) is carried as a residual.
    """

    theta: Floats
    trial_effects: Floats
    law: Law | SmoothForce
    amplitude: Floats
    motions: list[FittedMotion]
    motions_include_force: bool = True


@dataclass(frozen=True)
class NormalEquations:
    """Gauss-Newton equations `matrix` · step = `score` at a point, and the cost there (χ² with all priors). Unknowns in
    order: model parameters, amplitudes, shape parameters, effects of each trial.
    """

    cost: float
    matrix: Floats
    score: Floats


def refine_law(
    fit: Fit,
    inversion: LinearInversion,
    motions: Sequence[FittedMotion],
    law: Law,
    linear: ForceEstimate,
    *,
    thorough: bool = False,
) -> RefinedLaw | None:
    """Fit a law by nonlinear least squares, starting from the linear inversion."""
    start = SearchPoint(inversion.state.theta, inversion.trial_effects, law, 0.0 * linear.amplitude, list(motions))
    best = _gauss_newton(fit, inversion, start, 0.0)
    if thorough and (best is None or best[1].cost > UNDAMPED_SUCCESS * inversion.chi2_without_force):
        best = _gauss_newton(fit, inversion, start, FIRST_DAMPING)
    if best is None:
        return None
    point, normal = best
    p, q = point.theta.size, point.amplitude.size
    inflation = max(1.0, normal.cost / inversion.n_points)
    covariance = scaled_pseudo_inverse(normal.matrix, SHAPE_CUTOFF)
    sigma = np.sqrt(np.maximum(np.diag(covariance), 0.0) * inflation)
    relative = linear.sigma / max(float(np.hypot.reduce(linear.amplitude)), 1e-300)
    return RefinedLaw(
        law=point.law if isinstance(point.law, Law) else law,
        amplitude=point.amplitude,
        sigma=max(float(np.sqrt(np.mean(sigma[p : p + q] ** 2))), relative * float(np.hypot.reduce(point.amplitude))),
        chi2=normal.cost,
        parameter_shift=point.theta - inversion.state.theta,
    )


def optimise_smooth_force(fit: Fit, inversion: LinearInversion, start: SearchPoint) -> SearchPoint | None:
    """Find the most probable smooth force under the prior of its amplitudes, with all other unknowns free."""
    begin = start if start.motions_include_force else _settled_on_tracks(fit, inversion, start)
    best = _gauss_newton(fit, inversion, begin, LEAST_DAMPING)
    return None if best is None else best[0]


def _gauss_newton(
    fit: Fit, inversion: LinearInversion, start: SearchPoint, damping: float
) -> tuple[SearchPoint, NormalEquations] | None:
    """The point of least cost on the way from `start`; without damping the first steps may raise the cost."""
    # The first steps are undamped Gauss-Newton steps, taken even where the cost rises (chosen)
    undamped_steps, steps_with_shape_held = 5, 2
    best: tuple[SearchPoint, NormalEquations] | None = None
    point, undamped = start, 0 if damping else undamped_steps
    for iteration in range(MAX_STEPS):
        try:
            with np.errstate(all="raise", under="ignore"):
                point = _with_updated_motions(fit, point)
                normal = normal_equations(fit, inversion, point)
        except (SimulationError, FloatingPointError, np.linalg.LinAlgError):
            break
        before = best
        if best is None or normal.cost < best[1].cost:
            best = point, normal
        if iteration < undamped:
            point = _step(inversion, point, normal, 0.0, shape_free=iteration >= steps_with_shape_held)
            continue
        if undamped and best[1].cost > UNDAMPED_SUCCESS * inversion.chi2_without_force:
            break
        if before is not None and best is not before:
            damping *= 0.3
            if best[1].cost > before[1].cost * (1 - CONVERGENCE_TOLERANCE):
                break
        elif before is not None and iteration > undamped:
            damping = max(5 * damping, LEAST_DAMPING)
        point = _step(inversion, *best, damping, shape_free=iteration >= steps_with_shape_held)
    return best


def _settled_on_tracks(fit: Fit, inversion: LinearInversion, start: SearchPoint) -> SearchPoint:
    """All unknowns optimised with the motions held on the tracks, where only the parameters enter nonlinearly."""
    damping, best, point = FIRST_DAMPING, None, start
    # 10: most steps on motions that lie on the tracks, before motions respond to the force (chosen)
    for _ in range(10):
        try:
            with np.errstate(all="raise", under="ignore"):
                point = _with_updated_motions(fit, point)
                normal = normal_equations(fit, inversion, point)
        except (SimulationError, FloatingPointError, np.linalg.LinAlgError):
            normal = None
        if normal is not None and (best is None or normal.cost < best[1].cost):
            best, damping = (point, normal), 0.1 * damping
        else:
            damping *= 30
        if best is None:
            break
        point = replace(_step(inversion, *best, damping, shape_free=True), motions_include_force=False)
    return replace(start if best is None else best[0], motions_include_force=True)


def normal_equations(fit: Fit, inversion: LinearInversion, point: SearchPoint) -> NormalEquations:
    """Gauss-Newton equations of all unknowns at a point."""
    theta, trial_effects, q, s = point.theta, point.trial_effects, point.amplitude.size, len(point.law.shape_names)
    problem = inversion.problem
    p, n = theta.size, trial_effects.shape[0]
    sensitivities = acceleration_sensitivities(fit, trial_effects, point.motions, _acceleration_derivatives(fit, point))
    centre, precision = trial_effect_prior(problem, inversion.state)
    size = p + q + s + n * N_TRIAL_EFFECTS
    matrix, score = np.zeros((size + 1, size + 1)), np.zeros(size + 1)
    cost = float(np.sum(precision * (trial_effects - centre) ** 2))
    cost += float(np.sum(problem.prior_precision * (theta - problem.prior_mean) ** 2))
    cost += point.law.amplitude_precision * float(point.amplitude @ point.amplitude)
    for i, trial_data in enumerate(fit.predictor.data):
        position, velocity = _observed(point.motions[i], trial_data.time_s - trial_effects[i, RELEASE])
        residual = trial_data.lead_position_m - trial_effects[i, ORIGIN] - position
        of_trial = sensitivities[i]
        if not point.motions_include_force:
            of_trial, of_defect = of_trial[:, :-1], of_trial[:, -1]
            residual = residual - of_defect
        rows = np.column_stack([of_trial[:, 2:], -velocity, np.ones(residual.size), of_trial[:, :2], residual])
        used = _points_before_end(trial_data, trial_effects[i])
        relative_sd = None if trial_data.relative_sd is None else trial_data.relative_sd[used]
        white = whiten(rows[used], trial_data.first[used], inversion.state.rho, relative_sd) / math.sqrt(
            inversion.state.variance[i]
        )
        gram = white.T @ white
        effects = p + q + s + i * N_TRIAL_EFFECTS + np.arange(N_TRIAL_EFFECTS)
        keys = np.where(problem.index[i] >= 0, problem.index[i], size)
        index = np.concatenate([keys, p + np.arange(q + s), effects])
        matrix[np.ix_(index, index)] += gram[:-1, :-1]
        np.add.at(score, index, gram[:-1, -1])
        matrix[effects, effects] += precision[i]
        score[effects] -= precision[i] * (trial_effects[i] - centre[i])
        cost += float(gram[-1, -1])
    matrix, score = matrix[:size, :size], score[:size]
    matrix[np.arange(p), np.arange(p)] += problem.prior_precision
    score[:p] -= problem.prior_precision * (theta - problem.prior_mean)
    matrix[np.arange(p, p + q), np.arange(p, p + q)] += point.law.amplitude_precision
    score[p : p + q] -= point.law.amplitude_precision * point.amplitude
    held = np.flatnonzero(~problem.free)
    matrix[held, :] = matrix[:, held] = score[held] = 0.0
    return NormalEquations(cost, matrix, score)


def _step(
    inversion: LinearInversion, point: SearchPoint, normal: NormalEquations, damping: float, *, shape_free: bool
) -> SearchPoint:
    """The next point, with steps of shape parameters and releases limited and parameters kept inside their bounds."""
    p, q = point.theta.size, point.amplitude.size
    law = point.law
    matrix = normal.matrix + damping * np.diag(np.diag(normal.matrix))
    if not shape_free:
        held = p + q + np.arange(len(law.shape_names))
        matrix[held, :] = matrix[:, held] = 0.0
    step = scaled_pseudo_inverse(matrix, SHAPE_CUTOFF) @ normal.score
    for k, name in enumerate(law.shape_names):
        # 0.2: part of its size by which a shape parameter may move in one step (chosen)
        limit = 0.2 * law.size_of(name)
        law = law.shifted(name, float(np.clip(step[p + q + k], -limit, limit)))
    law = law.within_growth(max(float(motion.lead_position_m.max()) for motion in point.motions))
    release_limit_s = 2 * np.array([trial_data.frame_s for trial_data in inversion.data])
    trial_effects = point.trial_effects + step[p + q + len(law.shape_names) :].reshape(-1, N_TRIAL_EFFECTS)
    trial_effects[:, RELEASE] = point.trial_effects[:, RELEASE] + np.clip(
        trial_effects[:, RELEASE] - point.trial_effects[:, RELEASE], -release_limit_s, release_limit_s
    )
    theta = np.clip(point.theta + step[:p], inversion.problem.lower, inversion.problem.upper)
    return replace(
        point,
        theta=theta,
        trial_effects=trial_effects,
        law=law,
        amplitude=point.amplitude + step[p : p + q],
    )


def _with_updated_motions(fit: Fit, point: SearchPoint) -> SearchPoint:
    """The point with its motions corrected for its parameters and, where they include it, its force."""
    jobs = fit.predictor.jobs(point.theta, point.trial_effects)
    motions = [with_model_terms(_with_parameters_of_job(fit, *pair)) for pair in zip(point.motions, jobs, strict=True)]
    corrections = MOTION_CORRECTIONS if point.motions_include_force else 0
    return replace(point, motions=with_force(motions, lambda motion: _force_along(point, motion), corrections))


def _force_along(point: SearchPoint, motion: FittedMotion) -> Floats:
    law = point.law
    # Summing many splines with their coefficients costs far less than evaluating each.
    if isinstance(law, SmoothForce):
        return law.force(motion, point.amplitude)
    return law.unit_force(motion) @ point.amplitude


def _points_before_end(trial_data: FitTrial, trial_effects: Floats) -> slice:
    """The points before the end of growth, since a corrected motion does not end where its model would."""
    length_m = trial_data.trial.length_m if math.isfinite(trial_data.trial.length_m) else math.inf
    # 0.96: part of the length up to which points are used (chosen)
    after_end = np.flatnonzero(trial_data.lead_position_m - trial_effects[ORIGIN] > 0.96 * length_m)
    return slice(0, int(after_end[0]) if after_end.size else trial_data.time_s.size)


def _observed(motion: FittedMotion, since_s: Floats) -> tuple[Floats, Floats]:
    """Observed position and velocity of the leading edge, by cubic interpolation between the points of the grid."""
    from scipy.interpolate import CubicHermiteSpline

    curve = CubicHermiteSpline(motion.time_s, motion.lead_position_m, motion.lead_velocity_m_s)
    at = np.clip(since_s, 0.0, motion.time_s[-1])
    moving = (since_s > 0) & (since_s < motion.time_s[-1])
    offset = np.interp(at, motion.time_s, motion.observation_offset_m)
    slope = np.interp(at, motion.time_s, motion.observed_slope)
    return np.asarray(curve(at) + offset), np.where(moving, curve(at, 1) * slope, 0.0)


def _acceleration_derivatives(fit: Fit, point: SearchPoint) -> list[Floats]:
    """Derivatives of the acceleration along each motion, shape (n_times, n). By [pressure and B of the trial, every
    model parameter, amplitudes, shape parameters]. Where the motions do not include the force, a last column holds
    their defect.
    """
    layout, theta = fit.predictor.layout, point.theta
    jobs = fit.predictor.jobs(theta, point.trial_effects)
    damping = fit.predictor.damping_column
    derivatives = []
    for i, (motion, job) in enumerate(zip(point.motions, jobs, strict=True)):
        varied = [job._replace(pressure_deviation=job.pressure_deviation + DIFFERENCE_STEP)]
        varied.append(
            _with_parameter(job, damping, job.row[damping] * math.exp(DIFFERENCE_STEP)) if damping >= 0 else job
        )
        for column, key in enumerate(layout.keys):
            number = layout.free[layout.index[i, column]] if layout.index[i, column] >= 0 else None
            if number is None:
                varied.append(job)
                continue
            at = theta[layout.index[i, column]]
            change = number.from_scaled(at + DIFFERENCE_STEP) - number.from_scaled(at)
            if key == YIELD_PRESSURE:
                varied.append(job._replace(yield_pressure_Pa=job.yield_pressure_Pa + change))
            else:
                k = layout.model.parameter_names.index(key)
                if number.logarithmic:
                    factor = number.from_scaled(at + DIFFERENCE_STEP) / number.from_scaled(at)
                    varied.append(_with_parameter(job, k, job.row[k] * factor))
                else:
                    varied.append(_with_parameter(job, k, job.row[k] + change))
        has_deviation = (fit.predictor.has_pressure_deviation[i], fit.predictor.has_damping_deviation[i])
        affected = [*has_deviation, *[True] * len(layout.keys)]
        columns = [
            (_acceleration(fit, point, motion, changed_job) - motion.model_acceleration) / DIFFERENCE_STEP
            if affects and changed_job is not job
            else 0.0 * motion.model_acceleration
            for changed_job, affects in zip(varied, affected, strict=True)
        ]
        defect = (
            []
            if point.motions_include_force
            else [motion.model_acceleration + _force_along(point, motion) / motion.mass_kg - motion.acceleration]
        )
        derivatives.append(np.column_stack([*columns, _law_derivatives(point, motion), *defect]))
    return derivatives


def _acceleration(fit: Fit, point: SearchPoint, motion: FittedMotion, job: Job) -> Floats:
    """Acceleration along a motion with a job's parameters, with the change of a force that depends on the pressure."""
    changed = _with_parameters_of_job(fit, motion, job)
    y, v = motion.lead_position_m, motion.lead_velocity_m_s
    terms = evaluate(changed.model, changed.trial, motion.time_s, y, v, measured_Pa=motion.measured_Pa)
    if not point.amplitude.any() or np.array_equal(np.broadcast_to(terms.pressure_Pa, y.shape), motion.pressure_Pa):
        return terms.acceleration_m_s2
    at_pressure = replace(motion, pressure_Pa=np.broadcast_to(terms.pressure_Pa, y.shape))
    return terms.acceleration_m_s2 + (_force_along(point, at_pressure) - _force_along(point, motion)) / motion.mass_kg


def _law_derivatives(point: SearchPoint, motion: FittedMotion) -> Floats:
    """Derivatives of the acceleration by each amplitude and each shape parameter of the law."""
    unit_force = point.law.unit_force(motion)
    by_shape = [
        (point.law.shifted(name, step).unit_force(motion) - unit_force) @ point.amplitude / step
        for name, step in ((name, DIFFERENCE_STEP * point.law.size_of(name)) for name in point.law.shape_names)
    ]
    return np.column_stack([unit_force, *by_shape]) / motion.mass_kg[:, None]


def _with_parameters_of_job(fit: Fit, motion: FittedMotion, job: Job) -> FittedMotion:
    """The same motion, its model and trial with the parameters of a job."""
    values = dict(zip(fit.model.parameter_names, job.row.tolist(), strict=True))
    trial = trial_of_job(fit.predictor.data[job.trial].trial, job)
    return replace(motion, model=fit.model.with_values(values), trial=trial)


def _with_parameter(job: Job, column: int, value: float) -> Job:
    row = job.row.copy()
    row[column] = value
    return job._replace(row=row)
