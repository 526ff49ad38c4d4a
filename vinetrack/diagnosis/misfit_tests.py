"""Tests of one fitted model: is anything missing, and which effect would explain it. No model is refitted.

A model is rejected by any of three kinds of test. Score tests (Rao 1948) are made of each candidate, by linear algebra:
about the fitted model, measured minus predicted positions of trial i are r_i = X_i Δθ + C_i a + Z_i u_i + e_i, with C_i
the sensitivities to the candidates' sizes a. The random effects u_i of each trial, release, origin and the deviations
of pressure and B, are integrated out, and the free parameters θ are projected off. Each candidate then has a score, an
information, and a cosine with every other. Its standard error is computed twice: from the noise and the between-trial
standard deviations of the fit, and from the scatter of the scores of single trials (White, Econometrica 48, 817, 1980,
with trials as clusters), which is valid for many independent trials whatever the noise within a trial is like.

Omnibus tests name no candidate: score tests of smooth probe forces, and a test of the trial effects
(`between_conditions_p`). The last compares the misfit with the noise and the slow errors of the tracks.
"""

from __future__ import annotations

import itertools
import math
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.special import fdtrc, ndtri, ndtri_exp, stdtr, stdtrit

from vinetrack.core.problems import Remark, remark
from vinetrack.core.records import Floats, Trial
from vinetrack.diagnosis.ladder import within_groups
from vinetrack.dynamics.model import Model, check_needs, probe, stated
from vinetrack.dynamics.simulate import SimulationError, Trajectory
from vinetrack.effects import BASE_EFFECTS, Effect, EffectError, Parameter
from vinetrack.inference.errors import cluster_variance, coarsest_groups
from vinetrack.inference.fit_data import FitTrial
from vinetrack.inference.fit_result import Fit, group_names, groups_of
from vinetrack.inference.gaussian_processes import whiten
from vinetrack.inference.marginal_likelihood import FitState, MixedProblem, at_prior_means, eliminated, inverse_of_block
from vinetrack.inference.optimiser import POOR_FIT, relative_residuals, track_correlation
from vinetrack.inference.sensitivity import position_change
from vinetrack.inference.systematics import systematics_of
from vinetrack.tracks.position_noise import rounding_noise

# ------------------------------------------------------------------------------
# Candidates of a diagnosis: which effects the trials can test, and in which shapes each is tried.

NARROW_RANGE = 2.0  # Ratio of the ends of a plausible range from which a size may lie below it (chosen)

REACH_SIGMAS = 2.0  # Standard errors by which a size may lie beyond a plausible range (chosen)

# Fraction of the plausible range within which a size may differ from that of a slip in the sheet (chosen)
RANGE_SHARE_BESIDE_SLIP = 0.5


@dataclass(frozen=True)
class CandidateShape:
    """An effect in the form in which its size is tested: the first parameter is the size, the others are fixed. The
    others are fixed at `other_values`. `step` is the step of the size in the finite difference. Where `whole`, the step
    is a finite size, because the effect has no or another response to small sizes.
    """

    effect: Effect
    other_values: tuple[float, ...]
    step: float
    whole: bool = False
    group: str = ""
    other_groups: tuple[str, ...] = ()

    @property
    def values(self) -> tuple[float, ...]:
        """Parameter values with the size one step from zero."""
        return (self.size.zero + self.step, *self.other_values) if self.effect.parameters else ()

    @property
    def size(self) -> Parameter:
        """The parameter that is the size of the effect."""
        return self.effect.parameters[0]


def testable(candidates: Sequence[Effect], data: Sequence[FitTrial]) -> tuple[tuple[Effect, ...], dict[str, Remark]]:
    """Candidates that these trials can test, and the reason why not by name of each of the others."""
    reasons = {effect.name: why for effect in candidates if (why := _untestable(effect, data))}
    return tuple(effect for effect in candidates if effect.name not in reasons), reasons


def _untestable(effect: Effect, data: Sequence[FitTrial]) -> Remark:
    """The reason why these trials cannot test an effect; blank where they can."""
    trials, has_trace = [trial_data.trial for trial_data in data], [trial_data.trace is not None for trial_data in data]
    of_tube = [column for column in effect.needs if column in ("chamber_l", "inlet_mm", "yield_pressure_kPa")]
    if of_tube and all(trial.travel_ratio == 1 for trial in trials):
        return remark("no_tube", column=of_tube[0])
    if effect.in_trace and all(has_trace):
        return remark("in_measured_pressure")
    if "averaged_over" in effect.functions and not _may_be_averages(data):
        return remark("noise_is_not_averaged")
    if {"trace_time", "trace_pressure"} & set(effect.functions) and not any(has_trace):
        return remark("no_measured_pressure")
    if absent := [column for column in effect.needs if not any(stated(column, trial) for trial in trials)]:
        return remark("column_blank", column=absent[0])
    try:
        check_needs(Model((effect,)), *trials)
    except EffectError:
        return remark("columns_partly_blank", columns=list(effect.needs))
    return Remark()


def _may_be_averages(data: Sequence[FitTrial]) -> bool:
    """Whether the noise of positions as they were measured may be that of averages, which neighbours share."""
    own = [one for one in data if one.smoothing is None and rounding_noise(one.lead_position_m) < 0.5 * one.noise_m]
    return not own or track_correlation(own) > 0.25  # half of that of averages over two frames (derived)


def shapes_of(effect: Effect, trials: Sequence[Trial] = ()) -> list[CandidateShape]:
    """Shapes in which an effect is tried: every combination of typical values of its shape parameters. An effect whose
    size may differ between vines or days is tried with one size for all, and in each group alone.
    """
    if not effect.parameters:
        return [CandidateShape(effect, (), 1.0, whole=True)]
    size, *others = effect.parameters
    combinations = list(itertools.product(*(_typical_values(parameter) for parameter in others)))
    step = 0.01 * max(abs(end - size.zero) for end in plausible_range(size))
    shapes = [CandidateShape(effect, values, step) for values in combinations]
    if others or effect.finite:
        middle = [values for k, values in enumerate(combinations) if k == len(combinations) // 2]
        shapes += whole_shapes(effect, middle)
    groups = group_names(trials, size.shared)
    if len(groups) > 1:
        shapes += [
            replace(shapes[0], group=group, other_groups=tuple(other for other in groups if other != group))
            for group in groups
        ]
    return shapes


def whole_shapes(effect: Effect, other_values: Sequence[tuple[float, ...]] = ((),)) -> list[CandidateShape]:
    """Shapes of an effect at finite sizes within its plausible range."""
    size = effect.parameters[0]
    fractions: tuple[float, ...] = (0.03, 0.2, 0.7)  # of the largest plausible size (chosen)
    low, high = plausible_range(size)
    largest = (high if abs(high) >= abs(low) else low) - size.zero
    if "rest_force" in effect.functions:  # no response to a size below a threshold
        fractions = (0.03, 0.06, 0.1, 0.15, 0.2, 0.28, 0.37, 0.48, 0.6, 0.75)  # (chosen)
    elif _spans_decades(size):
        fractions = tuple((value - size.zero) / largest for value in _typical_values(size))
    steps = [fraction * largest for fraction in fractions]
    return [CandidateShape(effect, values, step, whole=True) for values in other_values for step in steps]


def plausible_range(parameter: Parameter) -> tuple[float, float]:
    """Plausible range of a parameter; where the effect states none, three times its default on either side of zero."""
    if parameter.plausible is not None:
        return parameter.plausible
    low, high = parameter.bounds
    reach = 3 * abs(parameter.default - parameter.zero) or 1.0
    return max(low, parameter.zero - reach), min(high, parameter.zero + reach)


def _spans_decades(parameter: Parameter) -> bool:
    """Whether values that span its plausible range lie in equal ratios."""
    low, high = plausible_range(parameter)
    # 10.0: ratio of the ends of a plausible range from which values are tried in geometric steps (chosen)
    return low > 0 and high / low > 10.0


def _typical_values(parameter: Parameter) -> tuple[float, ...]:
    """Values that the effect names; else three that span the plausible range, or its middle where that is narrow."""
    if parameter.tried:
        return parameter.tried
    low, high = plausible_range(parameter)
    if _spans_decades(parameter):
        return tuple(np.geomspace(low, high, 5)[1:4].tolist())
    if low > 0 and high / low < NARROW_RANGE:
        return ((low + high) / 2,)
    return tuple((low + fraction * (high - low)) for fraction in (0.15, 0.5, 0.85))


def slip_of(parameter: Parameter, value: float, sigma: float) -> tuple[float, str] | None:
    """The size that a common slip in the sheet produces, and what was done, where a fitted size is that up to an
    ordinary error; None where no slip fits, or an ordinary error alone would do.
    """
    if parameter.plausible is None or parameter.plausible[0] <= value <= parameter.plausible[1]:
        return None
    low, high = (RANGE_SHARE_BESIDE_SLIP * end for end in parameter.plausible)
    for size, action in parameter.slips:
        remaining, margin = (1 + value) / (1 + size) - 1, REACH_SIGMAS * sigma / (1 + size)
        if low - margin <= remaining <= high + margin:
            return size, action
    return None


def is_plausible(
    parameter: Parameter, value: float, sigma: float, *, widened: float = 1.0, errors: float = 1.0
) -> bool:
    """Whether a value lies in the plausible range, within so much of its error of it, or is that of a slip."""
    if parameter.plausible is None or value == parameter.zero or slip_of(parameter, value, sigma) is not None:
        return True
    low, high = parameter.plausible
    if math.isfinite(parameter.period):
        value = low + (value - low) % parameter.period
    if low > 0 and high / low > NARROW_RANGE:
        # 3.0: factor by which a size may lie below a range that is not narrow (chosen)
        low /= 3.0
    low, high = min(low / widened, low * widened), max(high * widened, high / widened)
    margin = REACH_SIGMAS * errors * sigma if math.isfinite(sigma) else math.inf
    return bool(low - margin <= value <= high + margin)


# ------------------------------------------------------------------------------
# Sensitivities of a fit's trajectories to effects that are not in its model: each column is the change of a trial's
# positions per unit of an effect's size, all other parameters held.


def _sensitivities(
    fit: Fit, shapes: Sequence[CandidateShape]
) -> tuple[list[tuple[CandidateShape, list[Floats]]], list[str]]:
    """Sensitivities to all shapes of all candidate effects, and the effects to which no trajectory responds at any
    plausible size: without a response to a small step finite sizes are tried.
    """
    baseline = fit.predictor.trajectories_at(fit.solution.state.theta, fit.solution.state.trial_effects)
    responses, silent = list[tuple[CandidateShape, list[Floats]]](), list[str]()
    for name in dict.fromkeys(shape.effect.name for shape in shapes):
        of_effect = [shape for shape in shapes if shape.effect.name == name]
        responding = [each for shape in of_effect if (each := _sensitivity(fit, shape, baseline)) is not None]
        if not responding and any(shape.effect.parameters for shape in of_effect):
            finite = whole_shapes(of_effect[0].effect, [of_effect[0].other_values])
            responding = [each for shape in finite if (each := _sensitivity(fit, shape, baseline)) is not None]
        responses += responding
        silent += [] if responding else [name]
    return responses, silent


def _sensitivity(
    fit: Fit, shape: CandidateShape, baseline: Sequence[Trajectory]
) -> tuple[CandidateShape, list[Floats]] | None:
    """Change of all positions per unit of size, and the shape with the step used; None without a response."""
    # Part of its travel by which a trajectory must change to count as responding, four times the integrator's
    # error (measured)
    least_detectable_response = 3e-6
    try:
        change = _change(fit, shape, baseline)
        response = _response(fit, change)
        if shape.whole:
            # 0.1: part of its travel that a vine must still make: one that hardly starts excludes the size (chosen)
            grows = all(
                float(np.max(before.observed_position_m + moved)) >= 0.1 * float(np.max(before.observed_position_m))
                for before, moved in zip(baseline, change, strict=True)
            )
            usable = response > least_detectable_response and grows
            return (shape, [moved / shape.step for moved in change]) if usable else None
        if response <= least_detectable_response * 1e-3:
            return None
        # 2e-3, 2e-2, 2e-4: A finite-difference step should move a trajectory by the first of these parts of
        # its travel (derived)
        if not 2e-4 < response < 2e-2:
            size = shape.size
            step = shape.step * 2e-3 / response
            available = size.bounds[1] - size.zero if shape.step > 0 else size.zero - size.bounds[0]
            shape = replace(shape, step=min(step, available) if available > 0 else step)
            change = _change(fit, shape, baseline)
            response = _response(fit, change)
    except SimulationError:
        return None
    return (shape, [moved / shape.step for moved in change]) if response > least_detectable_response else None


def _response(fit: Fit, change: Sequence[Floats]) -> float:
    """Largest change of a trial, as part of its travel; infinite where one cannot be simulated."""
    spans = [max(float(np.ptp(trial.lead_position_m)), 1e-9) for trial in fit.trials]
    parts = [float(np.max(np.abs(moved))) / span for moved, span in zip(change, spans, strict=True)]
    worst = max(parts, default=0.0)
    return worst if math.isfinite(worst) else math.inf


def _change(fit: Fit, shape: CandidateShape, baseline: Sequence[Trajectory]) -> list[Floats]:
    """Change of the positions of every trial with the step of the shape added, m."""
    predictor, state = fit.predictor, fit.solution.state
    jobs = predictor.jobs(state.theta, state.trial_effects).with_effect(shape.values)
    groups = groups_of([trial.trial for trial in fit.trials], shape.size.shared) if shape.group else []
    affected = [i for i in range(len(fit.trials)) if not shape.group or groups[i] == shape.group]
    changed = predictor.run(jobs[affected], model=predictor.layout.model + shape.effect)
    change = [np.zeros(before.time_s.size) for before in baseline]
    for i, trajectory in zip(affected, changed, strict=True):
        change[i] = position_change(baseline[i], trajectory)
    return change


# ------------------------------------------------------------------------------
# Columns of a fit and of candidates, and their cross products by trial, in this order: trial effects, unknowns (the
# parameters of the fit and its systematic errors, which have a standard normal prior each), shapes, residual.


@dataclass(frozen=True)
class Products:
    """Cross products of columns of a fit, with its systematic errors, and of candidate shapes, in units of the noise,
    with the residual, the last, at the prior means of trial effects, (n_trials, n_columns, n_columns). `problem` has
    systematic errors as further parameters; to the effects in `silent` no trajectory responds at any plausible size.
    """

    white: Floats
    problem: MixedProblem
    shapes: tuple[CandidateShape, ...] = ()
    silent: tuple[str, ...] = ()

    @property
    def effects(self) -> tuple[str, ...]:
        """Name of the effect of each shape."""
        return tuple(shape.effect.name for shape in self.shapes)

    @property
    def n_unknowns(self) -> int:
        """Number of columns of the unknowns of a trial."""
        return self.problem.index.shape[1]

    def without_trial_effects(self, state: FitState) -> Floats:
        """Those of unknowns, shapes and residual, the trial effects integrated out."""
        return eliminated(self.white, self.problem.effect_priors(state)[1])[0]


def in_noise(fit: Fit, i: int, columns: Floats) -> Floats:
    """Cross products of columns of one trial in units of its noise. Shapes: columns (n_points, k) → (k, k)."""
    trial_data, state = fit.predictor.data[i], fit.state
    white = whiten(columns, trial_data.first, state.rho, trial_data.relative_sd)
    return np.asarray(white.T @ white / state.variance[i])


def products_of(fit: Fit, shapes: Sequence[CandidateShape]) -> Products:
    """Cross products of a fit, of its systematic errors and of the candidates; no trial's columns are held twice."""
    responses, silent = _sensitivities(fit, shapes)
    extended, responding = systematics_of(fit.solution).beside(fit.solution), tuple(shape for shape, _ in responses)
    problem = extended.problem
    size = problem.n_effects + problem.index.shape[1] + len(responding) + 1
    white = np.empty((len(fit.trials), size, size))
    for i, of_fit in enumerate(extended.columns):
        columns = [of_fit[:, :-1], *(moved[i] for _, moved in responses), of_fit[:, -1]]
        white[i] = in_noise(fit, i, np.column_stack(columns))
        for _, moved in responses:
            moved[i] = np.empty(0)
    return Products(at_prior_means(white, problem, fit.state), problem, responding, tuple(silent))


@dataclass(frozen=True)
class Scores:
    """Score statistics of every shape given the fit, per unit of its size; those of trials (n_trials, n_shapes).
    `fitted` counts the parameters of the fit that are estimated; `levers` are the changes of the unknowns by a unit of
    each size, (n_unknowns, n_shapes).
    """

    score: Floats
    information: Floats
    trial_scores: Floats
    trial_informations: Floats
    fitted: int
    groups: Sequence[str]
    levers: Floats

    @property
    def degrees(self) -> float:
        """Degrees of freedom of the scatter of trials."""
        clusters = len(set(self.groups))
        spare = len(self.groups) - self.fitted
        return float(max(min(spare, clusters - 1), 1))

    @property
    def informed(self) -> Floats:
        """Information about every size alone; NaN where the data hold none."""
        diagonal = np.diag(self.information)
        return np.where(diagonal > 0, diagonal, math.nan)

    @property
    def size(self) -> Floats:
        """One-step estimate of every size, each alone; 0 where the data hold no information."""
        return np.nan_to_num(self.score / self.informed)

    @property
    def sigma(self) -> Floats:
        """Standard error of every size, the larger of both kinds; infinite where the data hold no information."""
        return np.maximum(self.plain_sigma, self.robust_sigma)

    @property
    def plain_sigma(self) -> Floats:
        """Standard error from the noise and the between-trial standard deviations of the fit."""
        return np.nan_to_num(1 / np.sqrt(self.informed), nan=math.inf)

    @property
    def robust_sigma(self) -> Floats:
        """Cluster-robust standard error, from the scatter of trial scores about what the size predicts. 0 for few
        trials, see `cluster_variance`.
        """
        residual = self.trial_scores - self.trial_informations * self.size
        scatter = np.sqrt(cluster_variance(residual, self.fitted, self.groups))
        return np.nan_to_num(scatter / self.informed, nan=math.inf)

    def one_sided(self, signs: Sequence[int]) -> Floats:
        """Score of every shape in standard errors (z), 0 where its sign is not allowed (0: either is). The smaller of
        two: by the noise model, and by the scatter of trials, whose Student's t is converted to a normal quantile.
        """
        size, sign = self.size, np.array(signs)
        allowed_size = np.where(sign == 0, np.abs(size), np.maximum(size * sign, 0.0))
        z = allowed_size / self.plain_sigma
        with np.errstate(divide="ignore", invalid="ignore"):
            robust_t = np.where(self.robust_sigma > 0, allowed_size / self.robust_sigma, np.inf)
            log_tail = np.log(stdtr(max(self.degrees, 3.0), -robust_t))
        return np.asarray(np.minimum(z, np.abs(ndtri_exp(log_tail))))

    @property
    def cosines(self) -> Floats:
        """Correlations of the scores, −1 to 1, shape (n_shapes, n_shapes)."""
        root = np.sqrt(np.maximum(np.diag(self.information), 1e-300))
        return np.asarray(np.clip(self.information / root[:, None] / root, -1, 1))


def scores_of(fit: Fit, products: Products, state: FitState | None = None) -> Scores:
    """Compute the scores at a fit, or with other between-trial scatter: shapes and residual with the trial effects
    eliminated and the unknowns projected off.
    """
    state, problem, p = state or fit.state, products.problem, products.n_unknowns
    X, C, r = slice(0, p), slice(p, -1), -1
    blocks = products.without_trial_effects(state)
    # Systematic errors are at their prior means.
    unknowns = np.append(state.theta, problem.prior_mean[state.theta.size :])
    of_fit = np.r_[:p, -1]
    hessian, gradient, _ = problem.summed(blocks[:, of_fit[:, None], of_fit], unknowns)
    # Unknowns to which a trial does not respond are added up in a last row, and dropped.
    cross = np.zeros((problem.prior_mean.size + 1, blocks.shape[-1] - p - 1))
    np.add.at(cross, problem.index, blocks[:, X, C])
    total = blocks[:, C, C].sum(axis=0)
    # Those adapt to an effect that are estimated and not at a bound.
    at_bound = np.zeros(len(hessian), dtype=bool)
    at_bound[: len(fit.numbers)] = [math.isfinite(number.bound) for number in fit.numbers]
    adapting = np.flatnonzero(problem.free & (np.diag(hessian) > 0) & ~at_bound)
    inverse = inverse_of_block(hessian, adapting)
    levers, step = inverse @ cross[:-1], inverse @ gradient
    information = total - cross[:-1].T @ levers
    # 1e-9: share of its information below which what remains of a shape is rounding, because other columns
    # reproduce it exactly (derived)
    empty = np.diag(information) < 1e-9 * np.maximum(np.diag(total), 1e-300)
    information[empty, :] = information[:, empty] = 0.0
    score = np.where(empty, 0.0, blocks[:, C, r].sum(axis=0) - cross[:-1].T @ step)
    # Of single trials; unknowns to which one does not respond point at a last row of zeros.
    of_trial, steps = np.pad(levers, ((0, 1), (0, 0)))[problem.index], np.append(step, 0.0)[problem.index]
    residual = blocks[:, :, r] - np.einsum("nap,np->na", blocks[:, :, X], steps)
    trial_scores = residual[:, C] - np.einsum("npk,np->nk", of_trial, residual[:, X])
    trial_informations = np.einsum("nkk->nk", blocks[:, C, C]) + np.einsum(
        "npk,npk->nk", of_trial, blocks[:, X, X] @ of_trial - 2 * blocks[:, X, C]
    )
    return Scores(
        score,
        information,
        np.where(empty, 0.0, trial_scores),
        trial_informations,
        fitted=int(np.count_nonzero(adapting < state.theta.size)),
        groups=coarsest_groups([trial.trial for trial in fit.trials]),
        levers=levers,
    )


# ------------------------------------------------------------------------------
# Thresholds of all candidates. One with many shapes has many chances of a large score: each candidate has the same
# probability of exceeding its own threshold (Bonferroni), and of its shapes so many count as are independent.


def family_test(cosines: Floats, signs: Sequence[int], effects: Sequence[str], level: float) -> defaultdict[str, float]:
    """Thresholds of candidates, by name, in standard deviations of a score, that any exceeds with a probability of
    about `level`, less where candidates are alike. A candidate without shapes has that of a single score of either
    sign. Shapes: cosines (n_shapes, n_shapes).
    """
    informative = np.diag(cosines) > 0
    shapes = {name: [k for k, other in enumerate(effects) if other == name and informative[k]] for name in effects}
    shapes = {name: of_effect for name, of_effect in shapes.items() if of_effect}
    share = level / max(len(shapes), 1)
    single = -float(ndtri(share / 2))
    thresholds = defaultdict(lambda: single)
    for name, of_effect in shapes.items():
        sides = 2 if signs[of_effect[0]] == 0 else 1
        # Effective number of independent shapes: Galwey, Genetic Epidemiology 33, 559 (2009).
        eigenvalues = np.maximum(np.linalg.eigvalsh(cosines[np.ix_(of_effect, of_effect)]), 0.0)
        count = float(np.sum(np.sqrt(eigenvalues)) ** 2 / np.sum(eigenvalues))
        thresholds[name] = -float(ndtri(share / sides / count))
    return thresholds


# ------------------------------------------------------------------------------
# Omnibus score test of probe forces: would any smooth force improve the fit, whether or not it is in the catalogue.
#
# Probes are bumps of force along the growth, over speed and over time, tested like the shapes of one more candidate.


def _probe_shapes(fit: Fit) -> list[CandidateShape]:
    """Bumps of force along the growth, over speed and over time, with and without a factor P."""
    longest_s = max(float(trial.time_s[-1] - trial.release_s) for trial in fit.trials)
    fastest = max(
        trial.trial.travel_ratio * float(np.quantile(trial.predicted_velocity_m_s, 0.98)) for trial in fit.trials
    )
    # As a part of the length where that is known
    reach = max(
        float(np.max(trial.lead_position_m) - trial.origin_m) / (np.nan_to_num(trial.trial.length_m) or 1.0)
        for trial in fit.trials
    )
    varied = len({round(trial.trial.pressure_Pa, 1) for trial in fit.trials}) > 1
    shapes = []
    # 8, 4, 4: number of probe bumps along growth, speed and time (chosen)
    for kind, count, top in ((0, 8, reach), (1, 4, fastest), (2, 4, longest_s)):
        centres = (np.arange(count) + 0.5) / count * top
        for centre in centres:
            for offset in (0, 3) if varied and kind == 0 else (0,):
                shapes.append(CandidateShape(probe(), (float(kind + offset), float(centre), 0.6 * top / count), 1e-3))
    return shapes


# ------------------------------------------------------------------------------
# Whether trial effects have absorbed what a model lacks. By chance, deviations of pressure and B differ between
# replicates of a condition; those that compensate for the model are the same in all of them.

MIN_REPLICATE_DEGREES = 4  # Degrees of freedom between replicates from which their scatter is estimated (chosen)

CAREFUL_DAMPING_SCATTER = 0.04  # Root mean square of ln B by which conditions may differ (chosen)

CAREFUL_PRESSURE_SCATTER = 0.02  # Relative standard deviation of pressure that is usual between trials (chosen)


def between_conditions_p(fit: Fit) -> float:
    """p-value that conditions differ in pressure or B no more than replicates do. 1 where replicates are too few, or
    where conditions differ by less than is usual in careful work.
    """
    known = [p for p, _ in _by_conditions(fit) if not math.isnan(p)]
    return min(2 * min(known, default=1.0), 1.0)


def has_excess_scatter(fit: Fit) -> bool:
    """Whether trials scatter more than is usual in careful work, so that their effects may have absorbed a misfit. They
    have not where conditions differ by no more than replicates, or than is usual: deviations that compensate for a
    model are the same in replicates.
    """
    # 0.05: p-value from which conditions count as differing no more than their replicates (chosen)
    return any(excess and not p > 0.05 for p, excess in _by_conditions(fit))


def _by_conditions(fit: Fit) -> list[tuple[float, bool]]:
    """Of pressure and of ln B: the p-value that conditions differ no more than replicates do, and whether trials
    scatter more than is usual.
    """
    stated = [
        trial.trial.pressure_sigma_Pa / trial.trial.pressure_Pa for trial in fit.trials if trial.trial.pressure_Pa > 0
    ]
    known = [relative for relative in stated if math.isfinite(relative)]
    # 2.0: root mean square by which conditions may differ, in stated errors of the pressure (chosen)
    pressure = max(2.0 * float(np.median(known)) if known else 0.0, CAREFUL_PRESSURE_SCATTER)
    groups = [trial.trial.condition for trial in fit.trials]
    # Parameters with a prior, such as P_y, hardly adapt to the differences between conditions.
    at_bound = np.isfinite([number.bound for number in fit.numbers])
    fitted = int(np.count_nonzero((fit.predictor.layout.prior_precision == 0) & ~at_bound))
    pressure_sd, damping_sd = fit.state.spread
    p_values = (
        _anova_p(np.array([trial.pressure_deviation for trial in fit.trials]), groups, fitted, pressure),
        _anova_p(np.log1p([trial.damping_deviation for trial in fit.trials]), groups, fitted, CAREFUL_DAMPING_SCATTER),
    )
    excess = pressure_sd > CAREFUL_PRESSURE_SCATTER, damping_sd > CAREFUL_DAMPING_SCATTER
    return list(zip(p_values, excess, strict=True))


def _anova_p(values: Floats, groups: Sequence[str], fitted: int, allowed: float) -> float:
    """p-value of a one-way analysis of variance; 1 where the group means differ by less than `allowed`, rms. NaN where
    too few members tell; with no more groups than parameters fitted to them, no difference between groups can show.
    """
    apart, inner = within_groups(values, groups)
    outer = values.size - inner - fitted
    if inner < MIN_REPLICATE_DEGREES or outer < 1:
        return math.nan
    within, between = float(np.sum(apart**2)), float(np.sum((values - apart) ** 2))
    if not within > 0 or math.sqrt(between / values.size) < allowed:
        return 1.0
    # Replicates that hardly differ would make any difference significant: their variance is at least (allowed / 3)².
    within_variance = max(within / inner, allowed**2 / 9)
    return float(fdtrc(outer, inner, between / outer / within_variance))


# Probability that the best of all candidates exceeds its threshold where nothing is missing (chosen)
FALSE_ALARM_LEVEL_FIRST_ROUND, FALSE_ALARM_LEVEL_LATER_ROUNDS = 3e-3, 1e-4


def level_of(model: Model) -> float:
    """The level of a diagnosis of a model: that of later rounds where something was added to the base model, so that no
    diagnosis contradicts the one which found it adequate.
    """
    is_base = set(model.names) <= set(BASE_EFFECTS)
    return FALSE_ALARM_LEVEL_FIRST_ROUND if is_base else FALSE_ALARM_LEVEL_LATER_ROUNDS


PROBE_LEVEL = 3e-4  # Largest level of the test of all probes (chosen)

# Root mean square misfit of the median trial, as a fraction of its growth, that exceeds the slow errors of any tracker
MISSED_FRACTION = 6e-4

# A model that passes every test is searched nevertheless from this χ² per degree of freedom; an effect must then reach
# this many standard deviations (chosen)
SEARCH_CHI2_PER_DOF, SEARCH_SIGMAS = 1.5, 6.0


LARGEST_MISSED = 0.1  # Misfit of a trial, as a part of its growth, that no error of a track explains (chosen)


def exceeds_slow_errors(fit: Fit) -> bool:
    """Whether the misfit of a fit exceeds the noise and, as a part of the growth of the median trial, the slow errors
    of the tracks, or of all replicates of a condition; or more of any trial than an error of a track explains.
    """
    data = fit.predictor.data
    systematic = float(
        np.median([trial_data.position_systematic_m / np.ptp(trial_data.lead_position_m) for trial_data in data])
    )
    missed = relative_residuals(fit.solution)
    _, places = np.unique([trial_data.trial.condition for trial_data in data], return_inverse=True)
    shared = max((np.min(missed[places == k]) for k in np.flatnonzero(np.bincount(places) > 1)), default=0.0)
    beyond = max(np.median(missed), shared) > max(MISSED_FRACTION, systematic) or np.max(missed) > LARGEST_MISSED
    return bool(fit.chi2_per_dof > POOR_FIT and beyond)


@dataclass(frozen=True)
class MisfitTests:
    """Test statistics of one fit for every candidate. Arrays have shape (n_shapes,), see `Products`."""

    fit: Fit
    effects: tuple[Effect, ...]
    products: Products
    scores: Scores
    level: float

    @cached_property
    def one_sided_z(self) -> Floats:
        """Score of every shape in standard errors, see `Scores.one_sided`."""
        return self.scores.one_sided(self.signs)

    @property
    def signs(self) -> list[int]:
        """Sign of each shape's size: 1 or −1 where physics fixes it, else 0."""
        return [shape.size.sign if shape.effect.parameters else 1 for shape in self.products.shapes]

    @cached_property
    def family(self) -> defaultdict[str, float]:
        """Thresholds of z for the candidates, such that any exceeds its own by chance with probability `level`."""
        return family_test(self.scores.cosines, self.signs, self.products.effects, self.level)

    def any_exceeds(self, level: float) -> bool:
        """Whether any candidate exceeds its threshold at a level that all of them share."""
        family = family_test(self.scores.cosines, self.signs, self.products.effects, level)
        thresholds = np.array([family[name] for name in self.products.effects])
        return bool(np.any(self.one_sided_z > thresholds))

    @property
    def rejects_model(self) -> bool:
        """Whether any test rejects the model: something is missing, in the catalogue or not."""
        return exceeds_slow_errors(self.fit) or self.any_exceeds(self.level) or self.omnibus_rejects

    @property
    def omnibus_rejects(self) -> bool:
        """Whether a test that names no candidate rejects: probe forces, or trial effects."""
        return self.trial_effect_p < 0.1 * self.level or self.of_probes.any_exceeds(self.of_probes.level)

    @cached_property
    def trial_effect_p(self) -> float:
        """p-value of the trial effects: conditions differ no more than replicates."""
        return between_conditions_p(self.fit)

    @property
    def needs_search(self) -> bool:
        """Whether to search even where every test passes: trial effects or noise may have absorbed the misfit."""
        # 1e-2: p-value of the trial effects below which a model that passes every test is searched too (chosen)
        return self.fit.chi2_per_dof > SEARCH_CHI2_PER_DOF or self.trial_effect_p < 1e-2

    @cached_property
    def of_probes(self) -> MisfitTests:
        """The tests of the probe forces alone."""
        products = products_of(self.fit, _probe_shapes(self.fit))
        return MisfitTests(self.fit, (), products, scores_of(self.fit, products), min(PROBE_LEVEL, self.level))

    @cached_property
    def predicted_gains(self) -> Floats:
        """Predicted fall of −2 ln L with each shape (linear); 0 where its sign is not allowed."""
        signs, size = np.array(self.signs), self.scores.size
        return np.where((signs == 0) | (size * signs > 0), self.scores.score * size, 0.0)

    def ranked_shapes(self, name: str) -> list[int]:
        """Indices of an effect's shapes, the largest predicted gain first."""
        indices = [i for i, effect in enumerate(self.products.effects) if effect == name]
        return sorted(indices, key=lambda i: -self.predicted_gains[i])

    def predicted_gain(self, name: str) -> float:
        """Largest fall of −2 ln L that is predicted for any shape of an effect; 0 without shapes."""
        return float(np.max(self.predicted_gains[self.ranked_shapes(name)], initial=0.0))

    def best_z(self, name: str) -> float:
        """Largest z of an effect; 0 where no trial responds to it."""
        return float(np.max(self.one_sided_z[self.ranked_shapes(name)], initial=0.0))

    def upper_limits(self, effect: Effect) -> dict[str, float]:
        """Upper limit (one-sided 95 %) of an undetected size by `effect.parameter`, SI; empty where the trials have no
        information about it. Student's t counts where errors are those of the scatter of trials.
        """
        indices = self.ranked_shapes(effect.name)
        size, sigma = self.scores.size[indices], self.scores.sigma[indices]
        if not indices or not effect.parameters or not np.isfinite(sigma).all():
            return {}
        parameter = self.products.shapes[indices[0]].size
        # The limit of the shape with the largest one holds whatever form the effect has.
        beyond = np.maximum(parameter.sign * size, 0.0) if parameter.sign else np.abs(size)
        by_scatter = (self.scores.robust_sigma > self.scores.plain_sigma)[indices]
        limits = beyond + np.where(by_scatter, stdtrit(max(self.scores.degrees, 3.0), 0.95), ndtri(0.95)) * sigma
        sign = parameter.sign or math.copysign(1.0, size[np.argmax(limits)])
        return {f"{effect.name}.{parameter.name}": parameter.zero + sign * float(limits.max())}


def misfit_tests(fit: Fit, effects: Sequence[Effect], level: float) -> MisfitTests:
    """Test a fit for these candidates and for misfit that none of them describes."""
    effects = tuple(effect for effect in effects if effect.name not in fit.model)
    trials = [trial.trial for trial in fit.trials]
    shapes: list[CandidateShape] = [shape for effect in effects for shape in shapes_of(effect, trials)]
    products = products_of(fit, shapes)
    return MisfitTests(fit, effects, products, scores_of(fit, products), level)
