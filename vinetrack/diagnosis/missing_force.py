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

from vinetrack.core.records import Floats
from vinetrack.core.threads import in_one_blas_thread
from vinetrack.core.units import GRAVITY_M_S2
from vinetrack.diagnosis.drift import replicate_scatter, residual_courses
from vinetrack.diagnosis.force_inversion import (
    FittedMotion,
    ForceEstimate,
    LinearInversion,
    force_sensitivities,
    motions_of,
    splines,
    standard_error,
    uniform_splines,
)
from vinetrack.diagnosis.force_laws import Law, laws_near, laws_on_grid, refine_law
from vinetrack.diagnosis.learned_force import LearnedForce, learned_force
from vinetrack.diagnosis.replicates import align_trials
from vinetrack.dynamics.simulate import SimulationError
from vinetrack.inference.fit_data import FitError
from vinetrack.inference.fit_result import Fit

if TYPE_CHECKING:
    import pandas as pd


# ------------------------------------------------------------------------------
# The misfit of a fit, linearised in a missing force: the starting point of every search for that force.

# Splines of a force along the growth of one condition, and the extra knots in the first tenth of it (chosen)
N_SPLINES, EARLY_KNOTS = 15, (0.01, 0.03, 0.06)


@dataclass(frozen=True)
class LinearMisfit:
    """A fit linearised about one set of trial effects, and a smooth force estimated in every condition."""

    inversion: LinearInversion
    motions: list[FittedMotion]
    longest: dict[str, float]
    sensitivities: list[Floats]
    smooth_force: ForceEstimate


def linear_misfit(fit: Fit) -> LinearMisfit:
    """Linearise about the trial effects of the fit or about those estimated trial by trial. Of the two, the one is
    taken whose misfit a smooth force in every condition explains further.
    """
    try:
        scatter = replicate_scatter(fit, residual_courses(fit)[0])
        starts = [fit.solution.state.trial_effects, align_trials(fit).trial_effects]
        linearised = [_linearised(fit, LinearInversion(fit, trial_effects, scatter)) for trial_effects in starts]
    except SimulationError as error:
        raise FitError(f"The model cannot be simulated: {error}") from error
    return min(linearised, key=lambda each: each.inversion.chi2_without_force - each.smooth_force.delta_chi2)


def growth_splines(part: Floats) -> Floats:
    """Splines of a force along the growth, narrower at the start, where the vine accelerates. Shapes: part (n,) → (n,
    N_SPLINES).
    """
    uniform_knots = np.linspace(0.0, 1.0, N_SPLINES - 2 - len(EARLY_KNOTS))[1:]
    return splines(part, np.concatenate([[0.0, *EARLY_KNOTS], uniform_knots]))


def _linearised(fit: Fit, inversion: LinearInversion) -> LinearMisfit:
    motions = motions_of(fit, inversion.trial_effects)
    # In a condition where the model predicts no motion, every position is at the start of growth.
    longest = {motion.trial.condition: float(np.finfo(float).tiny) for motion in motions}
    for motion in motions:
        longest[motion.trial.condition] = max(longest[motion.trial.condition], float(motion.lead_position_m.max()))
    sensitivities = force_sensitivities(
        fit, inversion.trial_effects, motions, lambda m: growth_splines(m.lead_position_m / longest[m.trial.condition])
    )
    return LinearMisfit(inversion, motions, longest, sensitivities, inversion.estimate_by_condition(sensitivities))


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


def ranked_laws(fit: Fit, linear: LinearMisfit) -> list[RankedLaw]:
    """Rank the best law of each kind: those detected first, then by BIC. All laws of a grid are estimated by the linear
    inversion, then laws near the best of each kind. The first few are fitted by nonlinear least squares and all are
    ranked again.
    """
    inversion, motions = linear.inversion, linear.motions

    def sensitivities(laws: Sequence[Law]) -> list[Floats]:
        return force_sensitivities(
            fit,
            inversion.trial_effects,
            motions,
            lambda motion: np.column_stack([law.unit_force(motion) for law in laws]),
        )

    return _refined(fit, inversion, motions, _ranked(inversion, sensitivities, motions, linear.smooth_force))


def _ranked(
    inversion: LinearInversion,
    sensitivities: Callable[[Sequence[Law]], list[Floats]],
    motions: Sequence[FittedMotion],
    smooth_force: ForceEstimate,
) -> list[RankedLaw]:
    """The best law of each kind by the linear inversion, best first: over the grid, then near the best of each kind."""

    def estimates(laws: Sequence[Law]) -> list[tuple[Law, ForceEstimate]]:
        each = inversion.estimate_each(sensitivities(laws), [law.n_amplitudes for law in laws])
        return [
            (law, estimate)
            for law, estimate in zip(laws, each, strict=True)
            if estimate.degrees_of_freedom or law.kind == "constant"
        ]

    estimated, largest_N = estimates(laws_on_grid(motions)), _largest_N(motions)
    largest_delta_chi2 = max(smooth_force.delta_chi2, *(estimate.delta_chi2 for _, estimate in estimated))
    best = _best_of_kinds(_with_bic(inversion, estimated, largest_delta_chi2, largest_N))
    estimated += estimates([law for ranked in best for law in laws_near(ranked.law, motions)])
    largest_delta_chi2 = max(largest_delta_chi2, *(estimate.delta_chi2 for _, estimate in estimated))
    return sorted(
        _best_of_kinds(_with_bic(inversion, estimated, largest_delta_chi2, largest_N)), key=_detected_then_bic
    )


def _refined(
    fit: Fit, inversion: LinearInversion, motions: Sequence[FittedMotion], laws: list[RankedLaw]
) -> list[RankedLaw]:
    """The laws ranked again, the best of them after a nonlinear fit, if its χ² hardly exceeds that of the linear fit.
    Where the linear fit of the best law leaves only noise, the others keep their linear fits.
    """
    chi2 = inversion.chi2_without_force
    # 3, 1.5: laws that are fitted by nonlinear least squares, if the best linear fit leaves more than this
    # multiple of the noise; otherwise the best alone (chosen)
    rough = chi2 - laws[0].estimate.delta_chi2 > 1.5 * inversion.n_points
    estimates = [law.estimate for law in laws]
    for k, ranked in enumerate(laws[: 3 if rough else 1]):
        linear = ranked.estimate
        # 0.5, 1.5: part of χ² that a law must take away to be refined (chosen)
        if not ranked.is_detected or linear.delta_chi2 < 0.5 * chi2:
            continue
        full = refine_law(fit, inversion, motions, ranked.law, linear, thorough=k == 0)
        if full is not None and full.chi2 < max(1.5 * (chi2 - linear.delta_chi2), inversion.n_points):
            estimates[k] = ForceEstimate(
                chi2 - full.chi2, full.amplitude, full.sigma, full.parameter_shift, linear.degrees_of_freedom
            )
            laws = [*laws[:k], replace(ranked, law=full.law), *laws[k + 1 :]]
    largest_delta_chi2 = max(estimate.delta_chi2 for estimate in estimates)
    estimated = list(zip((law.law for law in laws), estimates, strict=True))
    return sorted(_with_bic(inversion, estimated, largest_delta_chi2, _largest_N(motions)), key=_detected_then_bic)


def _with_bic(
    inversion: LinearInversion,
    estimated: Sequence[tuple[Law, ForceEstimate]],
    largest_delta_chi2: float,
    largest_N: float,
) -> list[RankedLaw]:
    return [
        RankedLaw(
            law,
            estimate,
            inversion.bic(estimate.delta_chi2, law.n_parameters, largest_delta_chi2),
            largest_N=largest_N,
        )
        for law, estimate in estimated
    ]


def _detected_then_bic(law: RankedLaw) -> tuple[bool, float]:
    """Order of laws: those that are detected first, then by BIC."""
    return not law.is_detected, law.bic


def _largest_N(motions: Sequence[FittedMotion]) -> float:
    """The largest force that is reported: MAX_DRIVE_RATIO times drive, weight and inertia at their largest."""
    sizes = []
    for motion in motions:
        drive_N = np.nan_to_num(motion.pressure_Pa * motion.trial.area_m2 / motion.trial.travel_ratio)
        body_N = motion.mass_kg * (GRAVITY_M_S2 + np.abs(motion.acceleration))
        sizes.append(float(np.max(drive_N + body_N)))
    return MAX_DRIVE_RATIO * max(sizes)


def _best_of_kinds(laws: Sequence[RankedLaw]) -> list[RankedLaw]:
    best: dict[str, RankedLaw] = {}
    for law in laws:
        before = best.get(law.law.name)
        if before is None or _detected_then_bic(law) < _detected_then_bic(before):
            best[law.law.name] = law
    return list(best.values())


FORCE_COLUMNS = ("against", "value", "force_N", "sigma_N", "condition")
LAW_COLUMNS = ("law", "words", "explained", "amplitude_N", "sigma_N", "delta_chi2", "bic")

# Splines of a force that depends on one variable alone, the same in all trials
SPLINES_OF_VARIABLE = {"growth": 24, "speed": 10, "time": 10}


LEAST_EXPLAINED_TO_NAME = 0.7  # Part of what is missing that a law must explain to be named (chosen)


# Part of the misfit that a smooth force in every condition must take away for the misfit to count as a force (chosen)
LEAST_MISFIT_REDUCTION = 0.5


@dataclass(frozen=True)
class DetectedLaw:
    """A law with its amplitudes, N, the part of the missing force that it explains, and its description."""

    law: Law
    amplitude_N: tuple[float, ...]
    explained: float
    words: str


@dataclass(frozen=True)
class MissingForce:
    """What is missing, as a force on the tail, N. `table`, columns `FORCE_COLUMNS`: the force of every condition
    (blank: mean over all) against `lead_position_m`, `tail_velocity_m_s`, `time_s` and `pressure_Pa`.
    """

    table: pd.DataFrame
    laws: pd.DataFrame
    depends_on: Mapping[str, float]
    sentence: str
    detected: tuple[DetectedLaw, ...] = ()
    learned: LearnedForce | None = None

    def to_json(self) -> dict[str, Any]:
        """As `diagnosis.json` holds it."""
        return {
            "sentence": self.sentence,
            "laws": self.laws.head(6).to_dict("records"),
            "depends_on": dict(self.depends_on),
            "learned": None if self.learned is None else self.learned.to_json(),
        }


@in_one_blas_thread
def missing_force(fit: Fit, *, learn: bool = True) -> MissingForce:
    """Estimate the force that a fit lacks and compare it with simple laws."""
    linear = linear_misfit(fit)
    inversion, motions = linear.inversion, linear.motions
    ranked = ranked_laws(fit, linear)
    by_variable = _explained_by_variable(fit, inversion, motions)
    explicable = max(
        [
            1e-300,
            linear.smooth_force.delta_chi2_beyond_chance,
            *by_variable.values(),
            *(law.estimate.delta_chi2_beyond_chance for law in ranked),
        ]
    )
    laws = [replace(law, explained=law.estimate.delta_chi2_beyond_chance / explicable) for law in ranked]
    depends_on = {name: delta_chi2 / explicable for name, delta_chi2 in by_variable.items()}
    best = laws[0]
    shift = best.estimate.parameter_shift
    named = best.explained >= LEAST_EXPLAINED_TO_NAME and best.is_detected
    curves = inversion.smooth_force_by_condition(linear.sensitivities, shift if named else np.zeros_like(shift))
    return MissingForce(
        table=_force_table(motions, linear.longest, curves),
        laws=_law_table(laws),
        depends_on=depends_on,
        sentence=_sentence(laws, depends_on, _misfit_reduction(inversion, explicable)),
        detected=tuple(_detected(law) for law in laws if law.is_detected),
        learned=_learned(fit, linear) if learn else None,
    )


@in_one_blas_thread
def learn_missing_force(fit: Fit) -> LearnedForce | None:
    """Estimate the force that a fit lacks as a smooth function, without comparing it with laws."""
    return _learned(fit, linear_misfit(fit))


def _learned(fit: Fit, linear: LinearMisfit) -> LearnedForce | None:
    """The force as a smooth function; None also where the motions under it cannot be simulated."""
    try:
        with np.errstate(all="raise", under="ignore"):
            return learned_force(fit, linear.inversion, linear.motions, linear.inversion.scatter.dof)
    except (SimulationError, FloatingPointError, np.linalg.LinAlgError):
        return None


def _detected(ranked: RankedLaw) -> DetectedLaw:
    return DetectedLaw(ranked.law, tuple(ranked.estimate.amplitude.tolist()), ranked.explained, ranked.words)


def _explained_by_variable(fit: Fit, inversion: LinearInversion, motions: Sequence[FittedMotion]) -> dict[str, float]:
    """Fall of χ² beyond chance with a smooth force of one variable, and with a constant force in each condition."""
    values_of = {
        "growth": lambda m: m.lead_position_m,
        "speed": lambda m: m.tail_velocity_m_s,
        "time": lambda m: m.time_s,
    }
    explained = {}
    for name, count in SPLINES_OF_VARIABLE.items():
        highest = max(float(values_of[name](motion).max()) for motion in motions)
        sensitivities = force_sensitivities(
            fit,
            inversion.trial_effects,
            motions,
            lambda m, values=values_of[name], h=highest, n=count: uniform_splines(values(m) / h, n),  # type: ignore[misc]
        )
        explained[name] = inversion.estimate_jointly(sensitivities).delta_chi2_beyond_chance
    constant = force_sensitivities(fit, inversion.trial_effects, motions, lambda m: np.ones((m.time_s.size, 1)))
    explained["condition"] = inversion.estimate_by_condition(constant).delta_chi2_beyond_chance
    return explained


def _force_table(
    motions: Sequence[FittedMotion], longest: Mapping[str, float], curves: Mapping[str, tuple[Floats, Floats]]
) -> pd.DataFrame:
    """Force of every condition along its first trial's motion, and the mean over all conditions."""
    import pandas as pd

    rows = []
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

    rows = [
        (
            law.law.name,
            law.words,
            law.explained,
            float(law.estimate.amplitude[0]) if law.law.n_amplitudes == 1 else float(np.hypot(*law.estimate.amplitude)),
            law.estimate.sigma,
            law.estimate.delta_chi2,
            law.bic,
        )
        for law in laws
    ]
    return pd.DataFrame(rows, columns=list(LAW_COLUMNS))


def _misfit_reduction(inversion: LinearInversion, explicable: float) -> float:
    """Part of the misfit that a force can take away; NaN where the misfit hardly exceeds the noise."""
    misfit = inversion.chi2_without_force - inversion.n_points
    return min(explicable / misfit, 1.0) if misfit > inversion.n_points else math.nan


def _sentence(laws: Sequence[RankedLaw], depends_on: Mapping[str, float], misfit_reduction: float) -> str:
    """What the missing force looks like, in a sentence or two."""
    best = laws[0]
    if misfit_reduction < LEAST_MISFIT_REDUCTION:
        return (
            "No smooth force on the tail explains the misfit: a separate one in every condition takes away"
            f" {max(misfit_reduction, 0.0):.0%} of it. Either it is no force, or the model is too far off to say."
        )
    if not best.is_detected and math.isfinite(misfit_reduction):
        return "What is missing is no simple law of force that single trials agree on."
    if not best.is_detected:
        return "No further force on the tail is significant beyond the scatter between trials."
    if best.explained < LEAST_EXPLAINED_TO_NAME:
        return _no_law_sentence(best, depends_on)
    # Misfit that not even a free force takes away limits how well laws can be told apart.
    # 0.05: difference of the explained parts within which other laws are named with the best (chosen)
    margin = 0.05 + float(np.nan_to_num(1 - misfit_reduction))
    others = [
        law
        for law in laws[1:]
        if law.is_detected and law.explained > best.explained - margin and law.law.n_shapes <= best.law.n_shapes
    ]
    sentence = f"What is missing looks like {best.words}; that explains {best.explained:.0%} of what any force could."
    if others:
        sentence += f" These data fit nearly as well with: {'; '.join(other.words for other in others[:2])}."
    return sentence


def _no_law_sentence(best: RankedLaw, depends_on: Mapping[str, float]) -> str:
    name, part = max(depends_on.items(), key=lambda each: each[1])
    variable = {
        "growth": "the growth",
        "speed": "the speed",
        "time": "the time",
        "condition": "the condition, and not on what happens within a trial",
    }
    sentence = (
        f"What is missing looks like none of the simple laws: the best, {best.words},"
        f" explains {best.explained:.0%} of it."
    )
    if part >= LEAST_EXPLAINED_TO_NAME:
        sentence += f" It depends on {variable[name]}: a force of that alone explains {part:.0%}."
    return sentence
