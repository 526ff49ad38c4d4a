"""The force that a model lacks: drawn against growth, speed, time and pressure, and compared with simple laws.

Positions are never differentiated. The responses of the trajectories to a force are known
(`vinetrack.diagnosis.force_inversion`); the force is then estimated by generalised least squares with the noise of the
tracks. Release and origin of every trial are free, its pressure and B are free within the scatter of replicates, and B,
n and all other model parameters are free. The motions are those under the force that is learned
(`vinetrack.diagnosis.learned_force`).

Part of any force can be taken over by B and n: the data do not decide between them and a freely drawn force. Where a
simple law explains most of what is missing, B and n are set as they are with this law; otherwise they stay as fitted.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from vinetrack.core.problems import Remark, remark
from vinetrack.core.records import Floats
from vinetrack.core.threads import in_one_blas_thread
from vinetrack.core.units import GRAVITY_M_S2
from vinetrack.diagnosis.force_inversion import (
    FittedMotion,
    ForceEquations,
    ForceEstimate,
    ForcePoint,
    ForceProblem,
    settled,
)
from vinetrack.diagnosis.force_laws import Law, laws_near, laws_on_grid
from vinetrack.diagnosis.learned_force import (
    VARIABLES,
    Domain,
    LearnedForce,
    amplitudes_N,
    candidate_domains,
    learned_force,
)
from vinetrack.diagnosis.replicates import replicate_scatter, residual_courses
from vinetrack.dynamics.simulate import SimulationError
from vinetrack.inference.fit_data import FitError
from vinetrack.inference.fit_result import Fit
from vinetrack.inference.gaussian_processes import (
    LENGTH_SCALES,
    posterior,
    root_of_covariance,
    standard_error,
)

if TYPE_CHECKING:
    import pandas as pd

# ------------------------------------------------------------------------------
# Simple laws ranked by how well they explain the misfit of a fit.


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


def ranked_laws(problem: ForceProblem, point: ForcePoint, chi2: float, smooth_delta_chi2: float) -> list[RankedLaw]:
    """The best law of each kind, over the grid, near the best of each kind, then nearer to the first: detected ones
    first, then by their Bayesian information criterion (Schwarz, Annals of Statistics 6, 461, 1978). Misfit that not
    even the best force explains is counted as further noise: it inflates the variance of every independent residual.
    `chi2` is that without a force, `smooth_delta_chi2` its fall with a smooth force.
    """
    n_independent = 10.0 * len(problem.data)  # Independent residuals where a model leaves more than noise (chosen)
    largest_N = _largest_N(point.motions)

    def ranked(estimated: Sequence[tuple[Law, ForceEstimate]]) -> list[RankedLaw]:
        largest = max(smooth_delta_chi2, *(estimate.delta_chi2 for _, estimate in estimated))
        noise = 1 + max(chi2 - largest - problem.n_points, 0.0) / n_independent
        laws = [
            RankedLaw(
                law,
                estimate,
                (largest - estimate.delta_chi2) / noise + law.n_parameters * math.log(n_independent),
                largest_N=largest_N,
            )
            for law, estimate in estimated
        ]
        best: dict[str, RankedLaw] = {}
        for each in sorted(laws, key=lambda law: (not law.is_detected, law.bic)):
            best.setdefault(each.law.name, each)
        return list(best.values())

    estimated = _estimates(problem, point, laws_on_grid(point.motions))
    for finer, count in ((1.0, None), (0.25, 1)):
        best = ranked(estimated)[:count]
        near = [law for each in best for law in laws_near(each.law, point.motions, finer)]
        estimated += _estimates(problem, point, near)
    return ranked(estimated)


def _estimates(problem: ForceProblem, point: ForcePoint, laws: Sequence[Law]) -> list[tuple[Law, ForceEstimate]]:
    """Each law estimated alone."""
    if not laws:
        return []
    equations = ForceEquations(problem, point, lambda motion: np.hstack([law.unit_force(motion) for law in laws]))
    ends = np.cumsum([law.n_amplitudes for law in laws]).tolist()
    places = [slice(end - law.n_amplitudes, end) for law, end in zip(laws, ends, strict=True)]
    return [(law, equations.estimate(place)) for law, place in zip(laws, places, strict=True)]


def _largest_N(motions: Sequence[FittedMotion]) -> float:
    """The largest force that is reported: ten times drive, weight and inertia of the trials at their largest."""
    sizes = []
    for motion in motions:
        drive_N = np.nan_to_num(motion.pressure_Pa * motion.trial.area_m2 / motion.trial.travel_ratio)
        body_N = motion.mass_kg * (GRAVITY_M_S2 + np.abs(motion.acceleration))
        sizes.append(float(np.max(drive_N + body_N)))
    return 10.0 * max(sizes)


# ------------------------------------------------------------------------------
# What is missing.

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


def force_problem(fit: Fit) -> ForceProblem:
    """What is asked of forces beside a fit, with the scatter of its replicates."""
    try:
        return ForceProblem(fit, replicate_scatter(fit, residual_courses(fit)[0]))
    except SimulationError as error:
        raise FitError(f"The model cannot be simulated: {error}") from error


@in_one_blas_thread
def missing_force(fit: Fit) -> MissingForce:
    """Estimate the force that a fit lacks as a smooth function, and compare it with simple laws."""
    problem = force_problem(fit)
    # Where the misfit is small, smoothed tracks can be further from the truth than the motions of the model.
    starts = (_misfit_under_law(problem, point) for point in (problem.tracks, problem.fitted))
    seen = min(starts, key=lambda each: each.chi2_with_law)
    chi2, point = seen.along.chi2, seen.along.point
    explained = {"condition": max(seen.constants[0] - seen.constants[1], 0.0)}
    for domain in candidate_domains(point.motions):
        if domain.name in ("growth", "speed", "time"):
            estimate = ForceEquations(problem, point, domain.unit_push).estimate()
            explained[domain.name] = estimate.delta_chi2_beyond_chance
    in_laws = [law.estimate.delta_chi2_beyond_chance for law in seen.laws]
    explicable = max(1e-300, seen.by_condition[0] - seen.by_condition[1], *explained.values(), *in_laws)
    laws = [replace(law, explained=part / explicable) for law, part in zip(seen.laws, in_laws, strict=True)]
    depends_on = {name: explained[name] / explicable for name in ("growth", "speed", "time", "condition")}
    named = laws[0].explained >= LEAST_EXPLAINED_TO_NAME and laws[0].is_detected
    shift = laws[0].estimate.parameter_shift if named else fit.solution.state.theta - point.theta
    curves = _curves(seen, shift, problem.inflation(chi2 - seen.by_condition[0]))
    beyond_noise = chi2 - problem.n_points
    # NaN where the misfit hardly exceeds the noise
    reduction = min(explicable / beyond_noise, 1.0) if beyond_noise > problem.n_points else math.nan
    return MissingForce(
        table=_force_table(curves),
        laws=_law_table(laws),
        depends_on=depends_on,
        sentence=_remark(laws, depends_on, reduction),
        detected=tuple(law for law in laws if law.is_detected),
        learned=_learned(problem),
    )


def _learned(problem: ForceProblem) -> LearnedForce | None:
    try:
        with np.errstate(all="raise", under="ignore"):
            return learned_force(problem)
    except (FloatingPointError, np.linalg.LinAlgError):
        return None


@dataclass(frozen=True)
class _Misfit:
    """What a fit leaves unexplained, seen from one set of motions: the equations of a force of the growth; the fall of
    χ² with one, and with a constant, of its own in every condition, and their expectations; and the laws, best first.
    """

    domain: Domain
    along: ForceEquations
    by_condition: tuple[float, float]
    constants: tuple[float, float]
    laws: list[RankedLaw]

    @property
    def chi2_with_law(self) -> float:
        """χ² that the first law leaves."""
        return self.along.chi2 - self.laws[0].estimate.delta_chi2


def _misfit(problem: ForceProblem, point: ForcePoint) -> _Misfit:
    domain = candidate_domains(point.motions)[0]
    along = ForceEquations(problem, point, domain.unit_push)
    count = along.score.size
    by_condition, constants = (along.gain_by_condition(shape) for shape in (np.eye(count), np.ones((count, 1))))
    return _Misfit(domain, along, by_condition, constants, ranked_laws(problem, point, along.chi2, by_condition[0]))


def _misfit_under_law(problem: ForceProblem, point: ForcePoint) -> _Misfit:
    """The misfit seen from the motions under the law that is best there, where that leaves less. Tracks are smoothed
    too much to show a force over a few millimetres in its place; the vine under a law is not.
    """
    seen, left = _misfit(problem, point), math.inf
    while seen.laws[0].is_detected and seen.chi2_with_law < 0.99 * left:
        left, equations = seen.chi2_with_law, ForceEquations(problem, seen.along.point, seen.laws[0].law.unit_force)
        _, under_law = settled(equations, lambda each: each.coefficients + each.estimate().amplitude)
        seen = min(seen, _misfit(problem, under_law), key=lambda each: each.chi2_with_law)
    return seen


def _curves(seen: _Misfit, parameter_shift: Floats, inflation: float) -> pd.DataFrame:
    """A smooth force in every condition at given model parameters, along its first trial's motion, without the ends
    where it is hardly determined. Columns `VARIABLES`, force, error and condition.
    """
    import pandas as pd

    motions, domain = seen.along.point.motions, seen.domain
    information, score = seen.along.by_condition(parameter_shift)
    priors = [root_of_covariance(score.shape[1], length) for length in LENGTH_SCALES]
    found = posterior(information / inflation, score / inflation, priors, amplitudes_N(motions))
    curves = []
    for condition, mean, covariance in zip(seen.along.problem.conditions, found.mean, found.covariance, strict=True):
        motion = next(motion for motion in motions if motion.trial.condition == condition)
        # 24: points of a curve (chosen)
        y = np.linspace(0.04, 0.96, 24) * motion.lead_position_m.max()
        time_s = np.interp(y, motion.lead_position_m, motion.time_s)
        values = {name: np.interp(time_s, motion.time_s, getattr(motion, name)) for name in VARIABLES.values()}
        basis = domain.basis([y])
        sigma_N = standard_error(basis, covariance)
        curve = pd.DataFrame(values | {"force_N": basis @ mean, "sigma_N": sigma_N, "condition": condition})
        # 2.0: multiple of the median standard error above which a force is not drawn (chosen)
        curves.append(curve[sigma_N < 2.0 * np.median(sigma_N)])
    return pd.concat(curves, ignore_index=True)


def _force_table(curves: pd.DataFrame) -> pd.DataFrame:
    """The force against each variable, by condition and as weighted means over all conditions in ten bins, their errors
    at least as large as conditions differ.
    """
    import pandas as pd

    by_condition, means = [], []
    for against in VARIABLES.values():
        points = curves.rename(columns={against: "value"}).assign(against=against)
        by_condition.append(points)
        low, high = points["value"].min(), points["value"].max()
        for _, inside in points.groupby(np.minimum(10 * (points["value"] - low) // max(high - low, 1e-300), 9)):
            force_N, weight = inside["force_N"], 1 / inside["sigma_N"] ** 2
            mean, at = (float(np.average(each, weights=weight)) for each in (force_N, inside["value"]))
            others = inside["condition"].nunique() - 1
            scatter = math.sqrt(float(np.average((force_N - mean) ** 2, weights=weight)) / others) if others else 0.0
            means.append((against, at, mean, max(float(weight.sum()) ** -0.5, scatter), ""))
    columns = list(FORCE_COLUMNS)
    return pd.concat([*by_condition, pd.DataFrame(means, columns=columns)], ignore_index=True)[columns]


def _law_table(laws: Sequence[RankedLaw]) -> pd.DataFrame:
    import pandas as pd

    rows = []
    for law in laws:
        amplitude, estimate = law.estimate.amplitude, law.estimate
        size_N = float(amplitude[0]) if amplitude.size == 1 else float(np.hypot(*amplitude))
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
