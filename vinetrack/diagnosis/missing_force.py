"""The force that a model lacks: drawn against growth, speed, time and pressure, and compared with simple laws.

Positions are never differentiated. The responses of the trajectories to a force are known
(`vinetrack.diagnosis.force_inversion`); the force is then estimated by generalised least squares with the noise of
the tracks (`vinetrack.diagnosis.force_inversion`). Release and origin of every trial are free, its pressure and B are
free within the scatter of replicates, and B, n and all other model parameters are free.

Part of any force can be taken over by B and n: the data do not decide between them and a freely drawn force. Where a
simple law explains most of what is missing, B and n are set as they are with this law; otherwise they stay as fitted.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from vinetrack.core.problems import Remark, remark
from vinetrack.core.records import Floats
from vinetrack.core.threads import in_one_blas_thread
from vinetrack.core.units import GRAVITY_M_S2
from vinetrack.diagnosis.force_inversion import (
    LEAST_INFORMATION,
    PARAMETER_CUTOFF,
    FittedMotion,
    ForceEstimate,
    ForcePoint,
    ForceProblem,
    FreeForce,
    optimise_force,
    scaled_pseudo_inverse,
    splines,
    uniform_splines,
)
from vinetrack.diagnosis.force_laws import Law, laws_near, laws_on_grid, standard_error
from vinetrack.diagnosis.learned_force import LearnedForce, learned_force
from vinetrack.diagnosis.replicates import replicate_scatter, residual_courses
from vinetrack.dynamics.simulate import SimulationError
from vinetrack.inference.fit_data import FitError
from vinetrack.inference.fit_result import Fit

if TYPE_CHECKING:
    import pandas as pd


# ------------------------------------------------------------------------------
# Simple laws ranked by how well they explain the misfit of a fit.

# Multiple of the largest drive, weight and inertia of the trials above which a force is not reported (chosen)
MAX_DRIVE_RATIO = 10.0


@dataclass(frozen=True)
class RankedLaw:
    """A law with its estimate, its BIC, and the largest force that these motions make plausible, N."""

    law: Law
    estimate: ForceEstimate
    bic: float
    explained: float = 0.0
    largest_N: float = math.inf

    @property
    def is_detected(self) -> bool:
        """Whether its amplitude differs significantly from zero, and is plausible for these motions."""
        size_N = math.hypot(*self.estimate.amplitude)
        # 5.0: standard errors that the amplitude of a law must differ from zero to be detected
        return 5.0 * self.estimate.sigma < size_N < self.largest_N and not self.law.is_unresolved

    @property
    def words(self) -> str:
        """Description of the law with its amplitude."""
        return self.law.words(self.estimate.amplitude.tolist(), self.estimate.sigma)


# Splines of a force along the growth of one condition, and the extra knots in the first tenth of it (chosen)
N_SPLINES, EARLY_KNOTS = 15, (0.01, 0.03, 0.06)


def growth_splines(part: Floats) -> Floats:
    """Splines of a force along the growth, narrower at the start, where the vine accelerates. Shapes: part (n,) → (n,
    N_SPLINES).
    """
    uniform_knots = np.linspace(0.0, 1.0, N_SPLINES - 2 - len(EARLY_KNOTS))[1:]
    return splines(part, np.concatenate([[0.0, *EARLY_KNOTS], uniform_knots]))


class ForcesByCondition:
    """A force whose amplitudes are free in every condition: the equations of each condition, with the trial effects
    eliminated. `information` (n_conditions, q, q) and `score` (n_conditions, q) of the amplitudes, `cross`
    (n_conditions, p, q) with the model parameters. `delta_chi2` is the fall of χ² from `chi2_without_force`.
    """

    def __init__(self, problem: ForceProblem, point: ForcePoint, unit_force: Callable[[FittedMotion], Floats]) -> None:
        linear = problem.linearised(point.asking(FreeForce(unit_force)))
        self.linear, self.chi2_without_force = linear, linear.chi2_without_force
        self.names = list(dict.fromkeys(problem.conditions))
        condition = np.array([self.names.index(name) for name in problem.conditions])
        prior, products = problem.prior, linear.eliminated
        k, p, q = prior.index.shape[1], prior.prior_mean.size, linear.point.amplitude.size
        self.information, self.score = np.zeros((len(self.names), q, q)), np.zeros((len(self.names), q))
        cross = np.zeros((len(self.names), p + 1, q))
        np.add.at(self.information, condition, products[:, k:-1, k:-1])
        np.add.at(self.score, condition, products[:, k:-1, -1])
        np.add.at(cross, (condition[:, None], prior.places), products[:, :k, k:-1])
        self.cross = cross[:, :p] * prior.free[:, None]
        parameters, parameter_score = linear.blocks[0], linear.blocks[1][:, -1]
        sizes = np.einsum("nkk->nk", self.information)
        estimable = sizes > LEAST_INFORMATION * max(float(sizes.max()), 1e-300)
        inverses = np.array(
            [
                scaled_pseudo_inverse(information, LEAST_INFORMATION, which)
                for information, which in zip(self.information, estimable, strict=True)
            ]
        )
        response = self.cross @ inverses
        parameters = parameters - np.einsum("npq,nrq->pr", response, self.cross)
        left = parameter_score - np.einsum("npq,nq->p", response, self.score)
        gained = float(left @ scaled_pseudo_inverse(parameters, PARAMETER_CUTOFF) @ left)
        gained -= float(parameter_score @ linear.parameter_response[:, -1])
        self.delta_chi2 = gained + float(np.einsum("nk,nkl,nl->", self.score, inverses, self.score))
        self.delta_chi2_beyond_chance = max(self.delta_chi2 - int(np.count_nonzero(estimable)), 0.0)

    def curves(self, parameter_shift: Floats) -> dict[str, tuple[Floats, Floats]]:
        """A smooth force in every condition at given model parameters: coefficients, N, shape (q,), and their
        covariance. The coefficients minimise χ² plus a penalty on their second differences (a P-spline, Eilers & Marx
        1996). One penalty for all conditions is chosen by generalised cross-validation. Shapes: parameter_shift
        (n_free,).
        """
        information, score = self.information, self.score - np.einsum("npq,p->nq", self.cross, parameter_shift)
        n_points, count = self.linear.problem.n_points, score.shape[1]
        second_difference = np.diff(np.eye(count), 2, axis=0)
        unit = float(np.mean(np.einsum("nkk->n", information))) / count
        roughness = unit * (second_difference.T @ second_difference + 1e-6 * np.eye(count))
        best: tuple[float, Floats, Floats] | None = None
        independent_points = self.linear.problem.independent_points
        unpenalised = np.linalg.solve(information + 1e-9 * roughness, score[:, :, None])[:, :, 0]
        largest_gain = float(np.sum(score * unpenalised))
        # Penalties, relative to the mean information about a coefficient (chosen)
        for penalty in np.geomspace(1e-6, 1e2, 17):
            inverse = np.linalg.inv(information + penalty * roughness)
            coefficients = np.einsum("nkl,nl->nk", inverse, score)
            lost_gain = largest_gain - float(
                np.sum(2 * coefficients * score) - np.einsum("nk,nkl,nl->", coefficients, information, coefficients)
            )
            degrees_of_freedom = float(np.einsum("nkl,nlk->", inverse, information))
            cross_validation = (lost_gain + independent_points) / max(independent_points - degrees_of_freedom, 1.0) ** 2
            if best is None or cross_validation < best[0]:
                best = cross_validation, coefficients, inverse
        assert best is not None
        unmoved = not parameter_shift.any()
        left = (self.chi2_without_force - largest_gain) / max(n_points - score.size, 1.0)
        inflation = max(1.0, left) if unmoved else 1.0
        return {name: (best[1][i], inflation * best[2][i]) for i, name in enumerate(self.names)}


@dataclass(frozen=True)
class Misfit:
    """What a fit leaves unexplained, seen from one set of motions: χ² without a force, that of a smooth force in every
    condition (its fall beyond chance), and the best law of each kind, best first.
    """

    point: ForcePoint
    chi2_without_force: float
    by_condition: ForcesByCondition
    laws: list[RankedLaw]

    @property
    def chi2_with_law(self) -> float:
        """χ² that the first law leaves."""
        return self.chi2_without_force - self.laws[0].estimate.delta_chi2


def misfit_of(problem: ForceProblem) -> Misfit:
    """The misfit seen from the tracks or, where that leaves less, from the motions under the law that is best there.
    Tracks are smoothed too much to show a force over a few millimetres in its place; the vine under a law is not.
    """
    on_tracks = _seen_from(problem, problem.tracks)
    best = on_tracks.laws[0]
    if not best.is_detected:
        return on_tracks
    optimum = optimise_force(problem, on_tracks.point.asking(FreeForce(best.law.unit_force)))
    if optimum is None:
        return on_tracks
    under_law = _seen_from(problem, optimum.point)
    return min(on_tracks, under_law, key=lambda misfit: misfit.chi2_with_law)


def _seen_from(problem: ForceProblem, point: ForcePoint) -> Misfit:
    """The best law of each kind: over the grid, then near the best of each kind."""
    longest = _longest(point.motions)
    smooth = ForcesByCondition(
        problem, point, lambda motion: growth_splines(motion.lead_position_m / longest[motion.trial.condition])
    )
    chi2, largest_N = smooth.chi2_without_force, _largest_N(point.motions)

    def ranked(estimated: Sequence[tuple[Law, ForceEstimate]]) -> list[RankedLaw]:
        largest = max(smooth.delta_chi2, *(estimate.delta_chi2 for _, estimate in estimated))
        laws = [
            RankedLaw(law, one, problem.bic(chi2, one.delta_chi2, law.n_parameters, largest), largest_N=largest_N)
            for law, one in estimated
        ]
        best: dict[str, RankedLaw] = {}
        # Detected ones first, then by BIC
        for law in sorted(laws, key=lambda law: (not law.is_detected, law.bic)):
            best.setdefault(law.law.name, law)
        return list(best.values())

    estimated = _estimates(problem, point, laws_on_grid(point.motions))
    near = [law for best in ranked(estimated) for law in laws_near(best.law, point.motions)]
    laws = ranked(estimated + _estimates(problem, point, near))
    return Misfit(point, chi2, smooth, laws)


def _estimates(problem: ForceProblem, point: ForcePoint, laws: Sequence[Law]) -> list[tuple[Law, ForceEstimate]]:
    """Each law estimated alone."""
    if not laws:
        return []
    all_laws = FreeForce(lambda motion: np.column_stack([law.unit_force(motion) for law in laws]))
    each = problem.linearised(point.asking(all_laws)).estimates([law.n_amplitudes for law in laws])
    return [
        (law, estimate)
        for law, estimate in zip(laws, each, strict=True)
        if estimate.degrees_of_freedom or law.kind == "constant"
    ]


def _largest_N(motions: Sequence[FittedMotion]) -> float:
    """The largest force that is reported: MAX_DRIVE_RATIO times drive, weight and inertia at their largest."""
    sizes = []
    for motion in motions:
        drive_N = np.nan_to_num(motion.pressure_Pa * motion.trial.area_m2 / motion.trial.travel_ratio)
        body_N = motion.mass_kg * (GRAVITY_M_S2 + np.abs(motion.acceleration))
        sizes.append(float(np.max(drive_N + body_N)))
    return MAX_DRIVE_RATIO * max(sizes)


FORCE_COLUMNS = ("against", "value", "force_N", "sigma_N", "condition")
LAW_COLUMNS = ("law", "words", "explained", "amplitude_N", "sigma_N", "delta_chi2", "bic")

LEAST_EXPLAINED_TO_NAME = 0.7  # Part of what is missing that a law must explain to be named (chosen)


# Part of the misfit that a smooth force in every condition must take away for the misfit to count as a force (chosen)
LEAST_MISFIT_REDUCTION = 0.5


@dataclass(frozen=True)
class MissingForce:
    """What is missing, as a force on the tail, N. `table`, columns `FORCE_COLUMNS`: the force of every condition
    (blank: mean over all) against `lead_position_m`, `tail_velocity_m_s`, `time_s` and `pressure_Pa`.
    """

    table: pd.DataFrame
    laws: pd.DataFrame
    depends_on: Mapping[str, float]
    sentence: Remark
    detected: tuple[RankedLaw, ...] = ()
    learned: LearnedForce | None = None

    def to_json(self) -> dict[str, Any]:
        """As `diagnosis.json` holds it."""
        return {
            "sentence": str(self.sentence),
            "laws": self.laws.head(6).to_dict("records"),
            "depends_on": dict(self.depends_on),
            "learned": None if self.learned is None else self.learned.to_json(),
        }


@in_one_blas_thread
def missing_force(fit: Fit, *, learn: bool = True) -> MissingForce:
    """Estimate the force that a fit lacks and compare it with simple laws."""
    problem = force_problem(fit)
    misfit = misfit_of(problem)
    point, best = misfit.point, misfit.laws[0]
    by_variable = _explained_by_variable(problem, point)
    explicable = max(
        [
            1e-300,
            misfit.by_condition.delta_chi2_beyond_chance,
            *by_variable.values(),
            *(law.estimate.delta_chi2_beyond_chance for law in misfit.laws),
        ]
    )
    laws = [replace(law, explained=law.estimate.delta_chi2_beyond_chance / explicable) for law in misfit.laws]
    depends_on = {name: delta_chi2 / explicable for name, delta_chi2 in by_variable.items()}
    best = laws[0]
    named = best.explained >= LEAST_EXPLAINED_TO_NAME and best.is_detected
    as_fitted = fit.solution.state.theta - point.theta
    curves = misfit.by_condition.curves(best.estimate.parameter_shift if named else as_fitted)
    beyond_noise = misfit.chi2_without_force - problem.n_points
    # NaN where the misfit hardly exceeds the noise
    reduction = min(explicable / beyond_noise, 1.0) if beyond_noise > problem.n_points else math.nan
    return MissingForce(
        table=_force_table(point.motions, curves),
        laws=_law_table(laws),
        depends_on=depends_on,
        sentence=_remark(laws, depends_on, reduction),
        detected=tuple(law for law in laws if law.is_detected),
        learned=_learned(problem) if learn else None,
    )


@in_one_blas_thread
def learn_missing_force(fit: Fit) -> LearnedForce | None:
    """Estimate the force that a fit lacks as a smooth function, without comparing it with laws."""
    return _learned(force_problem(fit))


def force_problem(fit: Fit) -> ForceProblem:
    """What is asked of forces beside a fit, with the scatter of its replicates."""
    try:
        return ForceProblem(fit, replicate_scatter(fit, residual_courses(fit)[0]))
    except SimulationError as error:
        raise FitError(f"The model cannot be simulated: {error}") from error


def _learned(problem: ForceProblem) -> LearnedForce | None:
    """The force as a smooth function; None also where the motions under it cannot be simulated."""
    try:
        with np.errstate(all="raise", under="ignore"):
            return learned_force(problem)
    except (SimulationError, FloatingPointError, np.linalg.LinAlgError):
        return None


def _explained_by_variable(problem: ForceProblem, point: ForcePoint) -> dict[str, float]:
    """Fall of χ² beyond chance with a smooth force of one variable, and with a constant force in each condition."""
    values_of = {
        "growth": lambda m: m.lead_position_m,
        "speed": lambda m: m.tail_velocity_m_s,
        "time": lambda m: m.time_s,
    }
    # Splines of a force that depends on one variable alone, the same in all trials (chosen)
    counts = {"growth": 24, "speed": 10, "time": 10}
    highest = {name: max(float(of(motion).max()) for motion in point.motions) for name, of in values_of.items()}
    forces = FreeForce(
        lambda motion: np.hstack(
            [uniform_splines(values_of[name](motion) / highest[name], count) for name, count in counts.items()]
        )
    )
    estimates = problem.linearised(point.asking(forces)).estimates(list(counts.values()))
    explained = {name: one.delta_chi2_beyond_chance for name, one in zip(counts, estimates, strict=True)}
    constant = ForcesByCondition(problem, point, lambda motion: np.ones((motion.time_s.size, 1)))
    return explained | {"condition": constant.delta_chi2_beyond_chance}


def _longest(motions: Sequence[FittedMotion]) -> dict[str, float]:
    """The longest growth of each condition, m; above 0 also where nothing moves."""
    longest: dict[str, float] = {}
    for motion in motions:
        name, growth_m = motion.trial.condition, float(motion.lead_position_m.max())
        longest[name] = max(longest.get(name, float(np.finfo(float).tiny)), growth_m)
    return longest


def _force_table(motions: Sequence[FittedMotion], curves: Mapping[str, tuple[Floats, Floats]]) -> pd.DataFrame:
    """Force of every condition along its first trial's motion, and the mean over all conditions."""
    import pandas as pd

    rows, longest = [], _longest(motions)
    for condition, (coefficients, covariance) in curves.items():
        motion = next(m for m in motions if m.trial.condition == condition)
        # 24: points of a curve (chosen)
        position_m = np.linspace(0.04, 0.96, 24) * motion.lead_position_m.max()
        basis = growth_splines(position_m / longest[condition])
        sigma = standard_error(basis, covariance)
        # 2.0: multiple of the median standard error above which a force is not drawn (chosen)
        drawn = sigma < 2.0 * np.median(sigma)
        position_m, force, sigma = position_m[drawn], (basis @ coefficients)[drawn], sigma[drawn]
        time_s = np.interp(position_m, motion.lead_position_m, motion.time_s)
        axes = {
            "lead_position_m": position_m,
            "tail_velocity_m_s": np.interp(time_s, motion.time_s, motion.tail_velocity_m_s),
            "time_s": time_s,
            "pressure_Pa": np.interp(time_s, motion.time_s, motion.pressure_Pa),
        }
        for against, values in axes.items():
            rows += [(against, *row, condition) for row in zip(values, force, sigma, strict=True)]
    table = pd.DataFrame(rows, columns=list(FORCE_COLUMNS))
    means = [_binned_means(part) for _, part in table.groupby("against", sort=False)]
    return pd.concat([table, *means], ignore_index=True)


def _binned_means(part: pd.DataFrame) -> pd.DataFrame:
    """Weighted means over all conditions in bins of an axis; errors at least as large as conditions differ."""
    import pandas as pd

    n_bins = 10  # Bins along each axis in which the mean over all conditions is taken (chosen)
    values = part["value"].to_numpy(float)
    edges = np.linspace(values.min(), values.max(), n_bins + 1)
    bin_of = np.clip(np.searchsorted(edges, values, side="right") - 1, 0, n_bins - 1)
    rows = []
    for k in np.unique(bin_of):
        inside = part[bin_of == k]
        weight = 1 / inside["sigma_N"].to_numpy(float) ** 2
        force = inside["force_N"].to_numpy(float)
        mean = float(np.average(force, weights=weight))
        conditions = len(set(inside["condition"]))
        scatter = math.sqrt(float(np.average((force - mean) ** 2, weights=weight)) / max(conditions - 1, 1))
        formal = float(np.sqrt(1 / np.sum(weight)))
        at = float(np.average(inside["value"].to_numpy(float), weights=weight))
        rows.append((part["against"].iloc[0], at, mean, max(formal, scatter if conditions > 1 else 0.0), ""))
    return pd.DataFrame(rows, columns=list(FORCE_COLUMNS))


def _law_table(laws: Sequence[RankedLaw]) -> pd.DataFrame:
    import pandas as pd

    rows = []
    for law in laws:
        amplitude, estimate = law.estimate.amplitude, law.estimate
        size_N = float(amplitude[0]) if law.law.n_amplitudes == 1 else float(np.hypot(*amplitude))
        rows.append((law.law.name, law.words, law.explained, size_N, estimate.sigma, estimate.delta_chi2, law.bic))
    return pd.DataFrame(rows, columns=list(LAW_COLUMNS))


def _remark(laws: Sequence[RankedLaw], depends_on: Mapping[str, float], misfit_reduction: float) -> Remark:
    """What the missing force looks like."""
    best = laws[0]
    if misfit_reduction < LEAST_MISFIT_REDUCTION:
        return remark("no_smooth_force", reduction=max(misfit_reduction, 0.0))
    if not best.is_detected:
        return remark("no_law_agreed_on" if math.isfinite(misfit_reduction) else "no_further_force")
    told = {"law": best.words, "explained": best.explained}
    if best.explained < LEAST_EXPLAINED_TO_NAME:
        variable = max(depends_on, key=depends_on.__getitem__)
        alone = depends_on[variable] if depends_on[variable] >= LEAST_EXPLAINED_TO_NAME else 0.0
        return remark("like_no_law", **told, variable=variable, alone=alone)
    # Misfit that not even a free force takes away limits how well laws can be told apart.
    # 0.05: difference of the explained parts within which other laws are named with the best (chosen)
    margin = 0.05 + float(np.nan_to_num(1 - misfit_reduction))
    others = [
        law.words
        for law in laws[1:]
        if law.is_detected and law.explained > best.explained - margin and law.law.n_shapes <= best.law.n_shapes
    ]
    return remark("like_a_law", **told, others=others[:2])
