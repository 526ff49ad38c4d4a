"""Parameters that drift with a condition on which they should not depend.

One B should describe a vine at every pressure and with every payload, one γ all trials. The best value is therefore
fitted to each trial, with all other parameters at their common values, by least squares of position with its release
free. Values that follow the pressure point to what is missing. Their scatter by chance is taken from replicates, not
from the between-trial standard deviations and noise of the fit, which a model that fails inflates.

The common parameters were fitted to the same trials and have absorbed part of the drift (n most of it, where B follows
the pressure): what is found is the remainder, and its z is too small rather than too large.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from vinetrack.core.problems import Remark, remark
from vinetrack.core.records import Floats, Trial
from vinetrack.diagnosis.force_inversion import FittedMotion, acceleration_sensitivities, motions_of
from vinetrack.diagnosis.ladder import in_sample
from vinetrack.diagnosis.replicates import (
    LEAST_BETWEEN_TRIAL_SD,
    AlignedTrials,
    PerTrialEstimates,
    Scatter,
    Stretches,
    align_trials,
    find_scatter,
    first_that_counts,
    per_trial_estimates,
    scatter_sensitivities,
    stretch_covariance,
)
from vinetrack.diagnosis.result import MAX_STRETCHES
from vinetrack.dynamics.audit import evaluate
from vinetrack.dynamics.simulate import SimulationError
from vinetrack.experiment.schema import COLUMNS, LIMITED, RIG
from vinetrack.inference.fit import fit_subset, rest_is_seen
from vinetrack.inference.fit_data import FitError, FitTrial
from vinetrack.inference.fit_result import DAMPING, EXPONENT, YIELD_PRESSURE, Fit, Number, TrialFit
from vinetrack.inference.robust_covariance import robust_covariance
from vinetrack.inference.sensitivity import DAMPING_DEVIATION, ORIGIN, RELEASE

if TYPE_CHECKING:
    import pandas as pd


# ------------------------------------------------------------------------------
# Residuals of trials averaged over stretches of the growth, and the scatter of replicates in them.
#
# See `vinetrack.diagnosis.replicates`.


@dataclass(frozen=True)
class ResidualCourse:
    """One trial's residuals, their response to between-trial scatter, and the coordinates along the growth. From the
    first motion on; arrays have shape (n_points,), `scatter_response` (n_points, 2).
    """

    trial: Trial
    residual_m: Floats
    scatter_response: Floats
    time_s: Floats
    lead_position_m: Floats
    lead_velocity_m_s: Floats
    noise_variance_m2: float
    origin_variance_m2: float


def residual_courses(fit: Fit) -> tuple[list[ResidualCourse], tuple[TrialFit, ...]]:
    """Residuals of every trial of a fit, and the trials as predicted with their own release and origin. Returns
    courses, predicted.
    """
    predicted = in_sample(fit).trials
    response = scatter_sensitivities(align_trials(fit))
    return [_course(*members) for members in zip(predicted, response, fit.predictor.data, strict=True)], predicted


def courses_by_condition(courses: Sequence[ResidualCourse]) -> dict[str, list[ResidualCourse]]:
    """Courses by name of condition, in order."""
    names = dict.fromkeys(course.trial.condition for course in courses)
    return {name: [course for course in courses if course.trial.condition == name] for name in names}


def replicate_scatter(fit: Fit, courses: Sequence[ResidualCourse]) -> Scatter:
    """Estimate the scatter of replicates from stretches of time that all trials of a condition were recorded in."""
    groups = courses_by_condition(courses).values()
    return find_scatter(fit, [common_stretches(members, "time_s", common_edges(members)) for members in groups])


def _course(trial: TrialFit, response: Floats, trial_data: FitTrial) -> ResidualCourse:
    noise_variance_m2 = trial_data.mean_noise_m**2 * (1 + trial_data.correlation) / (1 - trial_data.correlation)
    begin = first_that_counts(trial)
    growth = trial.predicted_position_m - trial.origin_m
    return ResidualCourse(
        trial=trial.trial,
        residual_m=trial.residual_m[begin:],
        scatter_response=response[begin:],
        time_s=trial.time_s[begin:] - trial.release_s,
        lead_position_m=growth[begin:],
        lead_velocity_m_s=trial.predicted_velocity_m_s[begin:],
        noise_variance_m2=noise_variance_m2,
        origin_variance_m2=noise_variance_m2 / max(trial_data.n_rest, 1),
    )


def common_edges(members: Sequence[ResidualCourse]) -> Floats:
    """Edges of stretches of time that every replicate was recorded in. Shape (n_stretches + 1,)."""
    start = max(float(member.time_s[0]) for member in members)
    end = min(float(member.time_s[-1]) for member in members)
    frames = min(int(np.count_nonzero((member.time_s >= start) & (member.time_s <= end))) for member in members)
    # 2: least frames of a stretch: a shorter recording is cut into fewer (derived)
    count = max(min(MAX_STRETCHES, frames // 2), 1)
    return np.linspace(start, max(end, start), count + 1)


def stretch_means(course: ResidualCourse, along: str, edges: Floats) -> tuple[Floats, Floats]:
    """Means of [residual, scatter response] in each stretch, NaN where there is no frame, and the numbers of frames.
    Shapes: edges (n_stretches + 1,) → (n_stretches, 3).
    """
    values, at = np.column_stack([course.residual_m, course.scatter_response]), getattr(course, along)
    stretch = np.clip(np.searchsorted(edges, at, side="right") - 1, 0, edges.size - 2)
    inside = (at >= edges[0]) & (at <= edges[-1])
    total, count = np.zeros((edges.size - 1, values.shape[1])), np.zeros(edges.size - 1)
    np.add.at(total, stretch[inside], values[inside])
    np.add.at(count, stretch[inside], 1.0)
    return np.where(count[:, None] > 0, total / np.maximum(count, 1.0)[:, None], math.nan), count


def common_stretches(members: Sequence[ResidualCourse], along: str, edges: Floats) -> Stretches:
    """The stretches in which all members have frames. Shapes: edges (n_stretches + 1,)."""
    parts = [stretch_means(member, along, edges) for member in members]
    all_means = np.array([means for means, _ in parts])
    reached = np.isfinite(all_means).all(axis=(0, 2))
    noise = np.mean([_noise(course, count[reached]) for course, (_, count) in zip(members, parts, strict=True)], axis=0)
    return Stretches(all_means[:, reached, 0], all_means[:, reached, 1:].mean(axis=0), noise)


def _noise(course: ResidualCourse, count: Floats) -> Floats:
    """Covariance of the means of stretches of so many frames; the error of the origin is common to all."""
    return np.asarray(np.diag(course.noise_variance_m2 / np.maximum(count, 1.0)) + course.origin_variance_m2)


def stretch_variances(course: ResidualCourse, part: tuple[Floats, Floats], scatter: Scatter) -> Floats:
    """Variances of the means of one trial's stretches. Shape (n_stretches,)."""
    means, count = part
    single = Stretches(means[None, :, 0], np.nan_to_num(means[:, 1:]), _noise(course, count))
    return np.diag(stretch_covariance(scatter, single))


# ------------------------------------------------------------------------------
# Tests of whether per-trial estimates of a parameter vary with a condition: linear trend and differences.

FEWEST_DEGREES = 2  # Degrees of freedom of replicates from which they determine the scatter of estimates (chosen)


LEAST_SCATTER = 0.1  # Least scatter of replicates, as part of the expected scatter of pressure and B (chosen)


# Conditions on which a parameter should not depend, as fields of a trial
COVARIATES = tuple(COLUMNS[name].field for name in (*LIMITED["range"], *RIG))


@dataclass(frozen=True)
class BlockedDeviations:
    """Deviations of coordinate x and estimate d from the weighted means of their block, and the scatter of replicates.
    `variance` is that scatter relative to the estimates' own variances, with `dof` degrees of freedom; `chi2` is the
    sum of squares between groups, with `groups` degrees of freedom.
    """

    x: Floats
    d: Floats
    weight: Floats
    variance: float
    dof: int
    chi2: float
    groups: int


def blocked_deviations(
    estimates: PerTrialEstimates, x: Floats, levels: Floats, chosen: NDArray[np.bool_]
) -> BlockedDeviations | None:
    """Deviations from the mean of each vine (or of all), and the scatter of replicates; None without enough trials.
    Shapes: x, levels, chosen (n_trials,).
    """
    conditions = np.array([trial.condition for trial in estimates.trials])
    blocks = (
        np.array([trial.vine for trial in estimates.trials])
        if estimates.per_vine
        else np.full(len(estimates.trials), "")
    )
    weight = 1 / estimates.variance
    from_replicates = np.zeros(len(estimates.trials))
    for condition in dict.fromkeys(conditions[np.isfinite(estimates.deviation)]):
        k = np.flatnonzero((conditions == condition) & np.isfinite(estimates.deviation))
        from_replicates[k] = estimates.deviation[k] - np.average(estimates.deviation[k], weights=weight[k])
    known = np.isfinite(estimates.deviation)
    dof = int(known.sum()) - len(set(conditions[known]))
    xs, ds = x[chosen].copy(), estimates.deviation[chosen].copy()
    w, block = weight[chosen], blocks[chosen]
    for name in dict.fromkeys(block):
        k = block == name
        xs[k] -= np.average(xs[k], weights=w[k])
        ds[k] -= np.average(ds[k], weights=w[k])
    if not np.sum(w * xs**2) > 0:
        return None
    if dof >= FEWEST_DEGREES:
        variance = float(np.sum(weight[known] * from_replicates[known] ** 2)) / dof
    else:
        dof = ds.size - len(set(block)) - 1
        if dof < FEWEST_DEGREES:
            return None
        residual = ds - xs * np.sum(w * xs * ds) / np.sum(w * xs**2)
        variance = float(np.sum(w * residual**2)) / dof
    pairs = list(dict.fromkeys(zip(block, levels[chosen], strict=True)))
    chi2 = 0.0
    for name, level in pairs:
        k = (block == name) & (levels[chosen] == level)
        chi2 += float(np.sum(w[k]) * np.average(ds[k], weights=w[k]) ** 2)
    return BlockedDeviations(xs, ds, w, max(variance, LEAST_SCATTER**2), dof, chi2, len(pairs) - len(set(block)))


def constancy_p_value(deviations: BlockedDeviations) -> tuple[float, float]:
    """F test of whether the groups have the same mean: its p-value, and that as a normal deviate. Returns
    p, z : float.
    """
    from scipy.stats import f as fisher

    if deviations.groups < 1:
        return 1.0, 0.0
    p = float(fisher.sf(deviations.chi2 / deviations.groups / deviations.variance, deviations.groups, deviations.dof))
    return p, normal_deviate(p)


def normal_deviate(p: float) -> float:
    """The normal deviate with this two-sided p-value."""
    from scipy.stats import norm

    return float(norm.isf(max(p, 1e-300) / 2))


DRIFT_COLUMNS = (
    *("parameter", "vine", "symbol", "unit", "against", "from_level", "to_level", "change", "change_sigma"),
    *("relative", "z", "z_constancy", "dof", "n_trials", "significant", "sentence"),
)
GROUP_COLUMNS = (
    *("parameter", "vine", "symbol", "unit", "against", "level", "value", "sigma", "ratio", "ratio_sigma"),
    "n_trials",
)


@dataclass(frozen=True)
class ConstancyTest:
    """A row of the table of drifts with its p-value, and the rows of its groups."""

    row: dict[str, object]
    p: float
    groups: list[dict[str, object]]


def _tested(
    parameter: PerTrialEstimates | Number,
    vine: str,
    against: str,
    levels: tuple[float, float],
    change: tuple[float, float],
    *,
    p: float,
    z: float,
    dof: float,
    n_trials: int,
    relative: bool = False,
    z_constancy: float = math.nan,
    groups: Sequence[dict[str, object]] = (),
    **told: object,
) -> ConstancyTest:
    """A test as a row of the table: levels from and to, the change between them and its standard error; `told` is what
    the sentence about it needs besides.
    """
    of_parameter = (parameter.key, vine, parameter.symbol, parameter.unit, against)
    numbers = (*levels, *change, relative, z, z if math.isnan(z_constancy) else z_constancy, dof, n_trials)
    row = dict(zip(DRIFT_COLUMNS, (*of_parameter, *numbers), strict=False))
    return ConstancyTest({**row, "sentence": remark("drifts", row=row, **told)}, p, list(groups))


def _group(
    parameter: PerTrialEstimates | Number,
    vine: str,
    against: str,
    level: float,
    value: tuple[float, float],
    ratio: tuple[float, float],
    n_trials: int,
) -> dict[str, object]:
    """A row of the table of groups: value and ratio to the common value, each with its standard error."""
    of_parameter = (parameter.key, vine, parameter.symbol, parameter.unit, against)
    return dict(zip(GROUP_COLUMNS, (*of_parameter, level, *value, *ratio, n_trials), strict=True))


# ------------------------------------------------------------------------------
# Tests of whether B changes along the growth, and whether the fitted yield pressure agrees with the sheet.
#
# B is estimated for the first and second half of the growth of each trial. The scatter of pressure and B between
# trials is the same in both halves and cancels in their difference. An effect that builds up along the growth shows
# here even where n and the yield pressure absorb it in every comparison between trials.


HALVES = (0.25, 0.75)  # Midpoints of the halves, as fractions of the growth (defined)


def along_growth(fit: Fit, aligned: AlignedTrials, estimates: PerTrialEstimates) -> Iterator[ConstancyTest]:
    """Test B for a change along the growth, for every vine and for all."""
    if aligned.predictor.damping_column < 0:
        return
    halves = _halves(fit, aligned, estimates.trial_effects)
    vines = np.array([trial.vine for trial in estimates.trials])
    # 3.0: deviation of ln B of a half (chosen)
    usable = (np.abs(halves) <= 3.0).all(axis=1)
    names = list(dict.fromkeys(vines[usable]))
    for vine in [*names, *([""] if len(names) > 1 else [])]:
        chosen = np.flatnonzero(usable & ((vines == vine) | (vine == "")))
        test = _difference_test(fit, estimates, halves, str(vine), chosen)
        if test is not None:
            yield test


def _halves(fit: Fit, aligned: AlignedTrials, trial_effects: Floats) -> Floats:
    """Best-fit deviation of ln B in each half of the growth, by trial, shape (n_trials, 2), linearised about each
    trial's own B. About the common B, the between-trial scatter would enter in second order.
    """
    motions = motions_of(fit, trial_effects)
    data = aligned.predictor.data
    columns = aligned.predictor.linearise(np.empty(0), trial_effects)
    origin_fixed = rest_is_seen(data)
    middles_m = [
        0.5
        * float(np.max(np.interp(trial_data.time_s - trial_effects[i, RELEASE], motion.time_s, motion.lead_position_m)))
        for i, (trial_data, motion) in enumerate(zip(data, motions, strict=True))
    ]
    pushes = [_pushes(*pair) for pair in zip(motions, middles_m, strict=True)]
    deviation = np.full((len(data), 2), math.nan)
    for i, sensitivities in enumerate(acceleration_sensitivities(fit, trial_effects, motions, pushes)):
        others = columns[i][:, [RELEASE]] if origin_fixed[i] else columns[i][:, [RELEASE, ORIGIN]]
        if aligned.predictor.has_damping_deviation[i] and np.all(np.ptp(sensitivities, axis=0) > 0):
            design = np.column_stack([sensitivities, others])
            deviation[i] = np.linalg.lstsq(design, columns[i][:, -1], rcond=1e-9)[0][:2]
    return np.asarray(deviation + trial_effects[:, [DAMPING_DEVIATION]])


def _pushes(motion: FittedMotion, middle_m: float) -> Floats:
    """Derivative of the tail's acceleration by ln B in each half of the growth, m/s², shape (n_times, 2)."""
    step = 1e-3  # Relative step of a finite difference (derived)
    value = motion.model.values[DAMPING]
    assert isinstance(value, float)
    increased = motion.model.with_values({DAMPING: value * math.exp(step)})
    y, v = motion.lead_position_m, motion.lead_velocity_m_s
    changed = evaluate(increased, motion.trial, motion.time_s, y, v, measured_Pa=motion.measured_Pa).acceleration_m_s2
    push = (changed - motion.model_acceleration) / step
    return np.column_stack([np.where(y < middle_m, push, 0.0), np.where(y < middle_m, 0.0, push)])


def _difference_test(
    fit: Fit, estimates: PerTrialEstimates, halves: Floats, vine: str, chosen: np.ndarray
) -> ConstancyTest | None:
    """Student's t test of the mean difference of the halves; None without enough degrees of freedom. The groups of a
    vine are its halves, among which the variance of their difference is divided equally.
    """
    from scipy.stats import t as student

    rise = halves[chosen, 1] - halves[chosen, 0]
    scatter, dof = _scatter(rise, [estimates.trials[i].condition for i in chosen])
    if dof < FEWEST_DEGREES:
        return None
    # 2e-3: lower limit of the standard deviation of the rise of ln B in single trials (chosen)
    sigma = max(scatter, 2e-3) / math.sqrt(rise.size)
    mean = float(rise.mean())
    p = float(2 * student.sf(abs(mean) / sigma, dof))
    change, error = math.expm1(abs(mean)), math.exp(abs(mean)) * sigma
    groups = []
    if vine:
        base = float(fit.model.parameters_for(vine)[fit.model.parameter_names.index(DAMPING)])
        for half, level in enumerate(HALVES):
            ratio = math.exp(float(halves[chosen, half].mean()))
            with_error = ratio, ratio * sigma / math.sqrt(2)
            value = base * with_error[0], base * with_error[1]
            groups.append(_group(estimates, vine, "growth", level, value, with_error, int(chosen.size)))
    return _tested(
        estimates,
        vine,
        "growth",
        HALVES if mean >= 0 else HALVES[::-1],
        (change, error),
        relative=True,
        p=p,
        z=normal_deviate(p),
        dof=dof,
        n_trials=int(chosen.size),
        groups=groups,
    )


def _scatter(values: Floats, conditions: list[str]) -> tuple[float, int]:
    """Standard deviation of replicates about their means, or of all trials without replicates; degrees of freedom."""
    names = np.array(conditions)
    deviations = values.copy()
    for name in set(conditions):
        deviations[names == name] -= values[names == name].mean()
    dof = values.size - len(set(conditions))
    if dof < FEWEST_DEGREES:
        deviations, dof = values - values.mean(), values.size - 1
    return math.sqrt(float(np.sum(deviations**2)) / max(dof, 1)), dof


def against_the_sheet(fit: Fit) -> Iterator[ConstancyTest]:
    """Compare fitted yield pressures with the sheet. With σ₀ that of the sheet and σ that of the fit with exact errors,
    the sheet's own value is part of the fitted one, and their difference has the variance σ₀² − σ², not σ₀²; what the
    fit adds to σ² for scatter and shared errors comes on top.
    """
    plain = np.diag(robust_covariance(fit.predictor, fit.solution)[0])
    for number, free, exact in zip(fit.numbers, fit.predictor.layout.free, plain, strict=True):
        variance = free.prior_sd**2 + number.sigma**2 - 2 * float(exact) * free.derivative(number.value) ** 2
        if number.key != YIELD_PRESSURE or not 0 < variance < math.inf:
            continue
        z = abs(number.value - free.start) / math.sqrt(variance)
        yield _tested(
            number,
            number.vine,
            "sheet",
            (free.start, number.value),
            (number.value - free.start, math.sqrt(variance)),
            p=math.erfc(z / math.sqrt(2)),
            z=z,
            dof=math.inf,
            n_trials=sum(trial.trial.vine == number.vine.split(",")[0] for trial in fit.trials),
            stated_sigma_Pa=free.prior_sd,
        )


log = logging.getLogger(__name__)

MOST_ITERATIONS = 15  # Maximum number of iterations of a refit (chosen)


FALSE_ALARM_LEVEL = 0.01  # Family-wise probability that any drift is called significant where nothing drifts (chosen)


@dataclass(frozen=True)
class Drift:
    """Drifts, most significant first, and the values of the groups; SI. `table`, columns `DRIFT_COLUMNS`, has one row
    for each parameter, vine (blank: all) and condition.
    """

    table: pd.DataFrame
    groups: pd.DataFrame
    notes: tuple[Remark, ...] = ()

    @property
    def remarks(self) -> tuple[Remark, ...]:
        """One remark for each parameter and condition with a significant drift, on the most significant row."""
        significant = self.table[self.table["significant"]].drop_duplicates(["parameter", "against"])
        return tuple(significant["sentence"])


def drift(fit: Fit, scatter: Scatter | None = None) -> Drift:
    """Test every parameter for drift with pressure, payload, angle, chamber, inlet, vine or along the growth."""
    import pandas as pd

    notes: list[Remark] = []
    scatter = scatter or replicate_scatter(fit, residual_courses(fit)[0])
    tests = list(_tests(fit, scatter, notes))
    level = 1 - (1 - FALSE_ALARM_LEVEL) ** (1 / max(len(tests), 1))
    tests.sort(key=lambda tested: tested.p)
    rows = [{**test.row, "significant": bool(test.p < level)} for test in tests]
    groups = [group for test in tests for group in test.groups]
    return Drift(
        pd.DataFrame(rows, columns=list(DRIFT_COLUMNS)).astype({"significant": bool, "relative": bool}),
        pd.DataFrame(groups, columns=list(GROUP_COLUMNS)),
        tuple(notes),
    )


def drift_groups(before: Drift, after: Fit | None) -> pd.DataFrame:
    """Return the best values of each group of trials under the first model and, where something was added, the last."""
    import pandas as pd

    parts = [before.groups.assign(model="before")]
    if after is not None:
        try:
            parts.append(drift(after).groups.assign(model="after"))
        except (FitError, SimulationError, np.linalg.LinAlgError) as error:
            log.info("the drift under the last model is not known: %s", error)
    return pd.concat([part for part in parts if len(part)] or parts, ignore_index=True)


def _tests(fit: Fit, scatter: Scatter, notes: list[Remark]) -> Iterator[ConstancyTest]:
    keys = [key for key in fit.predictor.layout.keys if key not in (YIELD_PRESSURE, EXPONENT)]
    aligned, damping = align_trials(fit), None
    for key in keys:
        try:
            estimates = per_trial_estimates(fit, key, aligned)
        except SimulationError:
            notes.append(remark("not_fitted_to_trials", key=key))
            continue
        damping = estimates if key == DAMPING else damping
        for against in COVARIATES:
            yield from _against(estimates, against)
    yield from _between_vines(fit, scatter)
    yield from against_the_sheet(fit)
    if damping is not None:
        try:
            yield from along_growth(fit, aligned, damping)
        except SimulationError:
            notes.append(remark("not_fitted_along_growth"))


def _against(estimates: PerTrialEstimates, against: str) -> Iterator[ConstancyTest]:
    """Tests of one parameter against one condition: each vine alone where the parameter is per vine, and all."""
    levels = np.array([float(getattr(trial, against)) for trial in estimates.trials])
    usable = np.isfinite(levels) & np.isfinite(estimates.deviation)
    vines = np.array([trial.vine for trial in estimates.trials])
    varying = [vine for vine in dict.fromkeys(vines) if np.unique(levels[usable & (vines == vine)]).size > 1]
    if not varying:
        if estimates.per_vine or np.unique(levels[usable]).size < 2:
            return
        choices = [("", usable)]
    elif estimates.per_vine:
        choices = [(vine, usable & (vines == vine)) for vine in varying]
        choices += [("", usable & np.isin(vines, varying))] if len(varying) > 1 else []
    else:
        choices = [("", usable)]
    for vine, chosen in choices:
        sums = blocked_deviations(estimates, _coordinate(against, levels), levels, chosen)
        if sums is None:
            continue
        shown = [] if estimates.per_vine and not vine else _groups(estimates, against, levels, chosen, sums, vine)
        yield _slope(estimates, against, levels[chosen], sums, vine, shown)


def _coordinate(against: str, levels: Floats) -> Floats:
    """The coordinate in which a trend is linear. Shapes: levels (n_trials,) → (n_trials,)."""
    linear = against in ("payload_kg", "growth_angle_rad") or not np.all(levels > 0)
    return levels if linear else np.log(levels)


def _slope(
    estimates: PerTrialEstimates,
    against: str,
    levels: Floats,
    sums: BlockedDeviations,
    vine: str,
    groups: list[dict[str, object]],
) -> ConstancyTest:
    from scipy.stats import t as student

    square = float(np.sum(sums.weight * sums.x**2))
    slope = float(np.sum(sums.weight * sums.x * sums.d)) / square
    sigma = math.sqrt(sums.variance / square)
    low, high = float(levels.min()), float(levels.max())
    reach = float(np.diff(_coordinate(against, np.array([low, high])))[0])
    start, stop = (low, high) if slope >= 0 else (high, low)
    change, error = abs(slope) * reach, sigma * reach
    if estimates.logarithmic:
        change, error = math.expm1(change), math.exp(change) * error
    p = float(2 * student.sf(abs(slope) / sigma, sums.dof))
    p_groups, z_constancy = constancy_p_value(sums)
    return _tested(
        estimates,
        vine,
        against,
        (start, stop),
        (change, error),
        relative=estimates.logarithmic,
        p=min(1.0, 2 * min(p, p_groups)),
        z=normal_deviate(p),
        z_constancy=z_constancy,
        dof=sums.dof,
        n_trials=int(sums.x.size),
        groups=groups,
        steady=p <= p_groups,
    )


def _groups(
    estimates: PerTrialEstimates,
    against: str,
    levels: Floats,
    chosen: NDArray[np.bool_],
    sums: BlockedDeviations,
    vine: str,
) -> list[dict[str, object]]:
    """Mean value of every group, with its standard error from the scatter of replicates."""
    rows = []
    for level in np.unique(levels[chosen]):
        k = np.flatnonzero(chosen & (levels == level))
        w, bases = 1 / estimates.variance[k], estimates.base[k]
        mean = float(np.average(estimates.deviation[k], weights=w))
        sigma = math.sqrt(sums.variance / float(np.sum(w)))
        base = float(np.mean(bases)) if np.ptp(bases) <= 1e-9 * abs(bases[0]) else math.nan
        if estimates.logarithmic:
            ratio = math.exp(mean), math.exp(mean) * sigma
            value = base * ratio[0], base * ratio[1]
        else:
            value = base + mean, sigma
            ratio = (value[0] / base, sigma / abs(base)) if base != 0 else (math.nan, math.nan)
        rows.append(_group(estimates, vine, against, float(level), value, ratio, int(k.size)))
    return rows


def _between_vines(fit: Fit, scatter: Scatter) -> Iterator[ConstancyTest]:
    """Test whether parameters shared by all trials differ between vines, each vine fitted alone."""
    shared = [n.key for n in fit.numbers if not n.vine and n.key != YIELD_PRESSURE]
    parts = list(_fit_vines(fit, scatter)) if shared else []
    for key in shared:
        estimates = [(vine, alone[key], len(alone.trials)) for vine, alone in parts]
        estimates = [estimate for estimate in estimates if math.isfinite(estimate[1].sigma) and estimate[1].sigma > 0]
        if len(estimates) > 1:
            yield _compare_vines(fit[key], estimates)


def _fit_vines(fit: Fit, scatter: Scatter) -> Iterator[tuple[str, Fit]]:
    """Fits of each vine with several pressures alone; the between-trial scatter is that of replicates."""
    spread = (max(scatter.pressure, LEAST_BETWEEN_TRIAL_SD[0]), max(scatter.damping, LEAST_BETWEEN_TRIAL_SD[1]))
    state = replace(fit.solution.state, spread=spread)
    rescaled = replace(fit, solution=replace(fit.solution, state=state))
    for vine in dict.fromkeys(trial.trial.vine for trial in fit.trials):
        members = [trial for trial in fit.trials if trial.trial.vine == vine]
        if len({trial.trial.pressure_Pa for trial in members}) < 2:
            continue
        names = [trial.name for trial in members]
        try:
            yield (
                vine,
                fit_subset(rescaled, names, hold_spreads=True, hold_noise=True, most_iterations=MOST_ITERATIONS),
            )
        except FitError:
            continue


def _compare_vines(common: Number, estimates: Sequence[tuple[str, Number, int]]) -> ConstancyTest:
    """χ² test of the values of single vines against their mean; the change is from the lowest to the highest value."""
    from scipy.stats import chi2 as chi_square

    value, sigma = (np.array([getattr(number, name) for _, number, _ in estimates]) for name in ("value", "sigma"))
    mean = float(np.average(value, weights=1 / sigma**2))
    p = float(chi_square.sf(float(np.sum((value - mean) ** 2 / sigma**2)), len(estimates) - 1))
    scale = common.value or math.nan
    ordered = sorted(estimates, key=lambda estimate: estimate[1].value)
    (_, low, _), (_, high, _) = ordered[0], ordered[-1]
    return _tested(
        common,
        "",
        "vine",
        (math.nan, math.nan),
        (high.value - low.value, math.hypot(high.sigma, low.sigma)),
        p=p,
        z=normal_deviate(p),
        dof=math.inf,
        n_trials=sum(count for _, _, count in estimates),
        ends=[(vine, number) for vine, number, _ in (ordered[0], ordered[-1])],
        groups=[
            _group(
                number,
                vine,
                "vine",
                math.nan,
                (number.value, number.sigma),
                (number.value / scale, number.sigma / scale),
                count,
            )
            for vine, number, count in estimates
        ],
    )
