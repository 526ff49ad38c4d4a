"""Locate where a model fails by more than the scatter of replicates, and which of its parameters drift.

By condition; along time, position and speed; and by which parameter drifts with a condition on which it should not
depend. A prediction has its own release and origin and no other trial effect, as in `vinetrack.diagnosis.ladder`.
Standard errors are those of the mean over trials, from the scatter of replicates (`vinetrack.diagnosis.replicates`): a
thousand frames of one trial are one trial.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from vinetrack.core.problems import Remark, remark
from vinetrack.core.records import Floats, Trial
from vinetrack.diagnosis.ladder import excess, position_errors
from vinetrack.diagnosis.replicates import (
    AlignedTrials,
    Replicates,
    ResidualCourse,
    Scatter,
    Stretches,
    align_trials,
    by_condition,
    common_edges,
    common_stretches,
    orthogonal_part,
    replicate_scatter,
    replicates_by_condition,
    residual_courses,
)
from vinetrack.diagnosis.result import MAX_STRETCHES
from vinetrack.dynamics.simulate import SimulationError
from vinetrack.experiment.schema import COLUMNS, LIMITED, RIG
from vinetrack.inference.fit_data import FitError
from vinetrack.inference.fit_result import DAMPING, YIELD_PRESSURE, Fit, Number
from vinetrack.inference.robust_covariance import robust_covariance
from vinetrack.inference.sensitivity import DAMPING_DEVIATION, ORIGIN, PRESSURE, RELEASE

if TYPE_CHECKING:
    import pandas as pd

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Failure:
    """Where a model fails; tables in SI, a residual is measurement minus model. `by_condition` has the largest root
    mean square first, which all pages call the worst condition; `z` is the significance of the mean residual compared
    with the scatter of replicates.
    """

    model: str
    pressure_unit: str
    by_condition: pd.DataFrame
    along_time: pd.DataFrame
    along_position: pd.DataFrame
    along_speed: pd.DataFrame
    scatter: Scatter
    drift: Drift

    @property
    def fails(self) -> bool:
        """Whether the largest deviate (Bonferroni), or all together (Fisher's combined test), are significant."""
        from scipy.stats import chi2, norm

        # 3.0: significance, in standard deviations, from which a model is said to fail
        level, p = float(norm.sf(3.0)), norm.sf(self.by_condition["z"].to_numpy(float))
        together = float(chi2.sf(-2 * np.sum(np.log(np.maximum(p, 1e-300))), 2 * p.size))
        return bool(p.min() < level / p.size or together < level)

    def remarks(self) -> tuple[Remark, ...]:
        """Where the model fails most, by how much, and what drifts."""
        return (*_where(self.by_condition, self.fails, self.pressure_unit), *self.drift.remarks)


def locate(fit: Fit) -> Failure:
    """Find where a fitted model fails."""
    import pandas as pd

    courses, predicted, _ = residual_courses(fit)
    scatter, together = replicate_scatter(fit, courses), replicates_by_condition(predicted)
    conditions = by_condition(courses)
    rows = [_condition_row(together[name], common_stretches(of), scatter) for name, of in conditions.items()]
    in_time = [(of, common_edges(of), name) for name, of in conditions.items()]
    return Failure(
        model="+".join(fit.model.names),
        pressure_unit=predicted[0].trial.pressure_unit,
        by_condition=pd.DataFrame(rows).sort_values("rms_m", ascending=False, kind="stable", ignore_index=True),
        along_time=_table("time_s", "s", in_time, scatter),
        along_position=_table("lead_position_m", "m", _parts("lead_position_m", courses), scatter),
        along_speed=_table("lead_velocity_m_s", "m_s", _parts("lead_velocity_m_s", courses), scatter),
        scatter=scatter,
        drift=drift(fit),
    )


def _condition_row(together: Replicates, stretches: Stretches, scatter: Scatter) -> dict[str, object]:
    errors, trial, count = position_errors(together), together.trials[0].trial, len(together.trials)
    covariance = scatter.covariance(stretches.response_m, stretches.noise_m2)
    mean_m, sigma_m = stretches.means_m.mean(axis=0), np.sqrt(np.diag(covariance) / count)
    # Replicates without enough frames at common times have no stretch means.
    worst = int(np.argmax(np.abs(mean_m))) if mean_m.size else None
    return {
        "vine": trial.vine,
        "condition": trial.condition,
        "pressure_Pa": trial.pressure_Pa,
        "payload_kg": trial.payload_kg,
        "n_trials": count,
        "rms_m": errors["rms_position_m"],
        "floor_m": errors["replicate_floor_m"],
        "ratio": errors["ratio"],
        "excess_m": excess(errors["rms_position_m"], errors["replicate_floor_m"]),
        "z": _replicate_z(mean_m / sigma_m, covariance, scatter) if mean_m.size else 0.0,
        "worst_at_s": errors["worst_at_s"],
        "worst_at_m": errors["worst_at_m"],
        "worst_residual_m": math.nan if worst is None else float(mean_m[worst]),
        "worst_sigma_m": math.nan if worst is None else float(sigma_m[worst]),
    }


def _replicate_z(deviates: Floats, covariance: Floats, scatter: Scatter) -> float:
    """Test whether between-trial scatter explains stretch means as large as observed; the p-value as a normal deviate.
    The test statistic is the mean square of the deviates, with the effective degrees of freedom of Satterthwaite's
    approximation, because stretches are correlated. Shapes: deviates (n,); covariance (n, n).
    """
    from scipy.stats import chi2, norm
    from scipy.stats import f as fisher

    sigma, square = np.sqrt(np.diag(covariance)), float(np.mean(deviates**2))
    degrees = deviates.size**2 / float(np.sum((covariance / sigma[:, None] / sigma) ** 2))
    p = float(fisher.sf(square, degrees, scatter.dof) if scatter.dof else chi2.sf(square * degrees, degrees))
    return float(norm.isf(max(p, 1e-300)))


Part = tuple[Sequence[ResidualCourse], Floats, str]


def _parts(along: str, courses: Sequence[ResidualCourse]) -> list[Part]:
    """Trials to average in stretches of so many edges: those of each condition, and all of a vine together (blank)."""
    parts: list[Part] = []
    for vine in dict.fromkeys(course.trial.vine for course in courses):
        members = [course for course in courses if course.trial.vine == vine]
        edges = np.linspace(0.0, max(float(getattr(member, along).max()) for member in members), MAX_STRETCHES + 1)
        parts += [(of, edges, name) for name, of in (*by_condition(members).items(), ("", members))]
    return parts


def _table(along: str, unit: str, parts: Sequence[Part], scatter: Scatter) -> pd.DataFrame:
    """Mean residual of every stretch over the trials that reach it, with its standard error."""
    import pandas as pd

    rows: list[tuple[object, ...]] = []
    for members, edges, condition in parts:
        in_stretches = [member.means(along, edges) for member in members]
        means_m = np.array([means for means, _ in in_stretches])
        variances = np.array(
            [
                np.diag(scatter.covariance(np.nan_to_num(means[:, 1:]), member.noise(count)))
                for member, (means, count) in zip(members, in_stretches, strict=True)
            ]
        )
        present = np.isfinite(means_m).all(axis=2)
        for k in np.flatnonzero(present.any(axis=0)).tolist():
            reached, low, high = present[:, k], float(edges[k]), float(edges[k + 1])
            count = int(reached.sum())
            mean_m = float(means_m[reached, k, 0].mean())
            sigma_m = math.sqrt(float(variances[reached, k].sum())) / count
            middle = (low + high) / 2
            rows.append((members[0].trial.vine, condition, low, high, middle, mean_m, sigma_m, mean_m / sigma_m, count))
    columns = ("vine", "condition", f"from_{unit}", f"to_{unit}", along, "mean_residual_m", "sigma_m", "z", "n_trials")
    return pd.DataFrame(rows, columns=list(columns))


def _where(table: pd.DataFrame, fails: bool, unit: str) -> Iterator[Remark]:
    """Remarks about conditions; the table has the worst first."""
    if not fails:
        worst = table.sort_values("z").iloc[-1]
        yield remark("fails_nowhere", z=max(float(worst["z"]), 0.0), condition=_named(worst, table, unit))
        return
    worst = table[np.isfinite(table["worst_residual_m"])].iloc[0]
    numbers = {name: float(worst[name]) for name in ("rms_m", "floor_m", "worst_residual_m", "worst_sigma_m", "z")}
    yield remark("fails_most", condition=_named(worst, table, unit), **numbers)
    # 2.0: significance, in standard deviations, from which it is said to fail in a condition
    count, total = int((table["z"] > min(2.0, float(table["z"].max()) - 1e-9)).sum()), len(table)
    yield remark("fails_in", count=count, total=total)


def _named(row: pd.Series, table: pd.DataFrame, unit: str) -> dict[str, object]:
    """What names a condition: its pressure, and payload and vine where they vary."""
    varying = [name for name in ("payload_kg", "vine") if len(set(table[name])) > 1]
    return {"unit": unit} | {name: row[name] for name in ("pressure_Pa", *varying)}


# ------------------------------------------------------------------------------
# Parameters that drift with a condition on which they should not depend.
#
# One B should describe a vine at every pressure and with every payload. The best value is therefore fitted to each
# trial, with all other parameters at their common values, by least squares of position with its release free: it takes
# upon itself whatever a model lacks. Values that follow the pressure point to what is missing. Their scatter by chance
# is taken from replicates, not from the between-trial standard deviations and noise of the fit, which a model that
# fails inflates.
#
# The common parameters were fitted to the same trials and have absorbed part of the drift (n most of it, where B
# follows the pressure): what is found is the remainder, and its z is too small rather than too large.

FALSE_ALARM_LEVEL = 0.01  # Family-wise probability that any drift is called significant where nothing drifts (chosen)
FEWEST_DEGREES = 2  # Degrees of freedom of replicates from which they determine the scatter of estimates (chosen)
LEAST_SCATTER = 0.1  # Least scatter of replicates, as part of the expected scatter of pressure and B (chosen)
HALVES = (0.25, 0.75)  # Midpoints of the halves of the growth, as fractions of it (defined)

# Conditions on which a parameter should not depend, as fields of a trial
COVARIATES = tuple(COLUMNS[name].field for name in (*LIMITED["range"], *RIG))

DRIFT_COLUMNS = (
    *("parameter", "vine", "symbol", "unit", "against", "from_level", "to_level", "change", "change_sigma"),
    *("z", "z_constancy", "dof", "n_trials", "significant", "sentence"),
)
GROUP_COLUMNS = (
    *("parameter", "vine", "symbol", "unit", "against", "level", "value", "sigma", "ratio", "ratio_sigma"),
    "n_trials",
)


@dataclass(frozen=True)
class Drift:
    """Drifts, most significant first, and the values of the groups; SI. `table`, columns `DRIFT_COLUMNS`, has one row
    for each parameter, vine (blank: all) and condition.
    """

    table: pd.DataFrame
    groups: pd.DataFrame

    @property
    def remarks(self) -> tuple[Remark, ...]:
        """One remark for each parameter and condition with a significant drift, on the most significant row."""
        significant = self.table[self.table["significant"]].drop_duplicates(["parameter", "against"])
        return tuple(significant["sentence"])


def drift(fit: Fit) -> Drift:
    """Test B for drift with pressure, payload, angle, chamber, inlet or along the growth, and P_y against the sheet."""
    import pandas as pd

    tests = sorted(_tests(fit), key=lambda tested: tested.p)
    level = 1 - (1 - FALSE_ALARM_LEVEL) ** (1 / max(len(tests), 1))
    rows = [{**test.row, "significant": bool(test.p < level)} for test in tests]
    groups = [group for test in tests for group in test.groups]
    return Drift(
        pd.DataFrame(rows, columns=list(DRIFT_COLUMNS)).astype({"significant": bool}),
        pd.DataFrame(groups, columns=list(GROUP_COLUMNS)),
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


@dataclass(frozen=True)
class ConstancyTest:
    """A row of the table of drifts with its p-value, and the rows of its groups."""

    row: dict[str, object]
    p: float
    groups: Sequence[dict[str, object]]


def _tests(fit: Fit) -> Iterator[ConstancyTest]:
    if DAMPING in fit.predictor.layout.keys:
        estimates = per_trial_estimates(fit, align_trials(fit))
        for against in COVARIATES:
            yield from _against(estimates, against)
        yield from _along_growth(fit, estimates)
    yield from against_the_sheet(fit)


def _tested(
    number: Number,
    vine: str,
    against: str,
    levels: tuple[float, float],
    change: tuple[float, float],
    p: tuple[float, ...],
    dof: float,
    n_trials: int,
    groups: Sequence[dict[str, object]] = (),
    **told: Any,
) -> ConstancyTest:
    """A test as a row of the table: levels from and to, the change between them and its standard error. `p` are the
    p-values of a steady change and, where it is asked, of any; `told` is what the sentence about it needs besides.
    """
    of_parameter = (number.key, vine, number.symbol, number.unit, against)
    numbers = (*levels, *change, _normal_deviate(p[0]), _normal_deviate(p[-1]), dof, n_trials)
    row = dict(zip(DRIFT_COLUMNS, (*of_parameter, *numbers), strict=False))
    sentence = remark("drifts", row=row, steady=p[0] <= p[-1], **told)
    return ConstancyTest({**row, "sentence": sentence}, min(1.0, len(p) * min(p)), groups)


def _normal_deviate(p: float) -> float:
    """The normal deviate with this two-sided p-value."""
    from scipy.stats import norm

    return float(norm.isf(max(p, 1e-300) / 2))


def _group(
    number: Number, vine: str, against: str, level: float, base: float, deviation: float, sigma: float, n_trials: int
) -> dict[str, object]:
    """A row of the table of groups: B and its ratio to the common value `base`, each with its standard error, from the
    deviation of ln B and its standard error.
    """
    ratio = math.exp(deviation)
    of_parameter = (number.key, vine, number.symbol, number.unit, against)
    numbers = (level, base * ratio, base * ratio * sigma, ratio, ratio * sigma, n_trials)
    return dict(zip(GROUP_COLUMNS, (*of_parameter, *numbers), strict=True))


# ------------------------------------------------------------------------------
# B of each trial, with all other parameters at their common values.

MAX_DEVIATION = 3.0  # Largest deviation of ln B from the common value (chosen)


@dataclass(frozen=True)
class PerTrialEstimates:
    """B of each trial; arrays of shape (n_trials,). `number` is B as fitted, `base` the common value, `deviation` that
    of the best ln B of the trial from it, NaN where a trial does not depend on it; `variance` is that from a typical
    scatter of pressure and B, up to a factor. At the best fit, `trial_effects` have shape (n_trials, 4), and `columns`
    are the sensitivities, `nuisances` those of release and origin among them.
    """

    number: Number
    trials: tuple[Trial, ...]
    base: Floats
    deviation: Floats
    variance: Floats
    trial_effects: Floats
    columns: Sequence[Floats]
    nuisances: list[list[int]]

    @property
    def vines(self) -> NDArray[np.str_]:
        """Names of the vines of the trials; blank where all have one B."""
        return np.array([trial.vine if self.number.vine else "" for trial in self.trials])

    @property
    def conditions(self) -> NDArray[np.str_]:
        """Names of the conditions of the trials."""
        return np.array([trial.condition for trial in self.trials])


def per_trial_estimates(fit: Fit, aligned: AlignedTrials) -> PerTrialEstimates:
    """Fit B to each trial by least squares of position, with its release free."""
    predictor, data = aligned.predictor, aligned.predictor.data
    nuisances = [aligned.nuisances(i) for i in range(len(data))]
    trial_effects, columns = aligned.trial_effects.copy(), aligned.columns
    # 0.3, 2.0: largest step of ln B, and of the release, frames (chosen)
    limits = {DAMPING_DEVIATION: 0.3, ORIGIN: math.inf}
    try:
        # 5: Gauss–Newton steps (chosen)
        for _ in range(5):
            for i, (of_trial, others) in enumerate(zip(columns, nuisances, strict=True)):
                free = [DAMPING_DEVIATION, *others]
                most = [limits.get(place, 2.0 * data[i].frame_s) for place in free]
                step = np.linalg.lstsq(of_trial[:, free], of_trial[:, -1], rcond=1e-9)[0]
                trial_effects[i, free] += np.clip(step, np.negative(most), most)
            of_B = trial_effects[:, DAMPING_DEVIATION]
            trial_effects[:, DAMPING_DEVIATION] = np.clip(of_B, -MAX_DEVIATION, MAX_DEVIATION)
            columns = tuple(predictor.linearise(np.empty(0), trial_effects))
    except SimulationError as error:
        raise FitError(f"The model cannot be simulated: {error}") from error
    response, variance = np.empty(len(data)), np.empty(len(data))
    for i, (of_trial, others) in enumerate(zip(columns, nuisances, strict=True)):
        sensitivity = orthogonal_part(of_trial[:, DAMPING_DEVIATION], of_trial[:, others])
        response[i] = max(float(np.sum(sensitivity**2)), 1e-300)
        deviations = aligned.columns[i][:, [PRESSURE, DAMPING_DEVIATION]]
        levers = sensitivity @ orthogonal_part(deviations, aligned.columns[i][:, others]) / response[i]
        # (0.01, 0.03): typical standard deviations of pressure and ln B between trials (chosen)
        scatter = float(np.sum((np.array((0.01, 0.03)) * levers) ** 2))
        variance[i] = scatter + data[i].mean_noise_m ** 2 / response[i] + 1e-12
    known = response > 1e-12 * np.array([np.ptp(each.lead_position_m) ** 2 * each.time_s.size for each in data])
    known &= np.abs(trial_effects[:, DAMPING_DEVIATION]) < 0.99 * MAX_DEVIATION
    return PerTrialEstimates(
        number=next(number for number in fit.numbers if number.key == DAMPING),
        trials=tuple(trial_data.trial for trial_data in data),
        base=predictor.layout.base[:, fit.model.parameter_names.index(DAMPING)],
        deviation=np.where(known, trial_effects[:, DAMPING_DEVIATION], np.nan),
        variance=variance,
        trial_effects=trial_effects,
        columns=columns,
        nuisances=nuisances,
    )


# ------------------------------------------------------------------------------
# Tests of whether B of single trials varies with a condition: linear trend and differences.


def _against(estimates: PerTrialEstimates, against: str) -> Iterator[ConstancyTest]:
    """Tests against one condition: of each vine alone, and of all."""
    levels = np.array([float(getattr(trial, against)) for trial in estimates.trials])
    usable, vines = np.isfinite(levels) & np.isfinite(estimates.deviation), estimates.vines
    varying = [vine for vine in dict.fromkeys(vines) if np.unique(levels[usable & (vines == vine)]).size > 1]
    choices = [(vine, usable & (vines == vine)) for vine in varying]
    choices += [("", usable & np.isin(vines, varying))] if len(varying) > 1 else []
    for vine, chosen in choices:
        test = _trend(estimates, against, levels, vine, chosen)
        if test is not None:
            yield test


def _trend(
    estimates: PerTrialEstimates, against: str, levels: Floats, vine: str, chosen: NDArray[np.bool_]
) -> ConstancyTest | None:
    """Student's t test of a linear trend of the chosen estimates, and Fisher's F test of whether all levels have the
    same mean, about the mean of each vine or of all; None without enough trials. Shapes: levels, chosen (n_trials,).
    """
    from scipy.stats import f as fisher
    from scipy.stats import t as student

    linear = against in ("payload_kg", "growth_angle_rad") or not np.all(levels > 0)
    coordinate = levels if linear else np.log(levels)
    weight, blocks = 1 / estimates.variance, estimates.vines
    w, block, level = weight[chosen], blocks[chosen], levels[chosen]
    x, d = (_centred(values[chosen], w, block) for values in (coordinate, estimates.deviation))
    square = float(np.sum(w * x**2))
    if not square > 0:
        return None
    slope = float(np.sum(w * x * d)) / square
    variance, dof = _of_replicates(estimates.deviation, weight, estimates.conditions)
    if dof < FEWEST_DEGREES:
        dof = d.size - np.unique(block).size - 1
        if dof < FEWEST_DEGREES:
            return None
        variance = float(np.sum(w * (d - x * slope) ** 2)) / dof
    variance = max(variance, LEAST_SCATTER**2)
    sigma = math.sqrt(variance / square)
    p = float(2 * student.sf(abs(slope) / sigma, dof))
    cells = [f"{name} {value!r}" for name, value in zip(block, level.tolist(), strict=True)]
    between = len(set(cells)) - np.unique(block).size
    means = d - _centred(d, w, np.array(cells))
    chi2 = float(np.sum(w * means**2))
    p_constancy = float(fisher.sf(chi2 / between / variance, between, dof)) if between else 1.0
    low, high = float(level.min()), float(level.max())
    ends = (low, high) if slope >= 0 else (high, low)
    reach = float(np.ptp(coordinate[chosen]))
    change = math.expm1(abs(slope) * reach), math.exp(abs(slope) * reach) * sigma * reach
    alone = len(set(block.tolist())) == 1
    groups = _groups(estimates, against, levels, vine, chosen, variance) if alone else ()
    return _tested(estimates.number, vine, against, ends, change, (p, p_constancy), dof, d.size, groups)


def _centred(values: Floats, weight: Floats, groups: NDArray[np.str_]) -> Floats:
    """Deviations from the weighted mean of each group. Shapes: values, weight, groups (n,) → (n,)."""
    _, group = np.unique(groups, return_inverse=True)
    return np.asarray(values - (np.bincount(group, weight * values) / np.bincount(group, weight))[group])


def _of_replicates(values: Floats, weight: Floats, conditions: NDArray[np.str_]) -> tuple[float, int]:
    """Variance of replicates about the mean of their condition, relative to 1/weight, and its degrees of freedom."""
    known = np.isfinite(values)
    dof = int(np.count_nonzero(known)) - np.unique(conditions[known]).size
    apart = _centred(values[known], weight[known], conditions[known])
    return float(np.sum(weight[known] * apart**2)) / max(dof, 1), dof


def _groups(
    estimates: PerTrialEstimates,
    against: str,
    levels: Floats,
    vine: str,
    chosen: NDArray[np.bool_],
    variance: float,
) -> list[dict[str, object]]:
    """Mean value of every group, with its standard error from the scatter of replicates."""
    rows = []
    for level in np.unique(levels[chosen]).tolist():
        k = np.flatnonzero(chosen & (levels == level))
        w, bases = 1 / estimates.variance[k], estimates.base[k]
        base = float(np.mean(bases)) if np.ptp(bases) <= 1e-9 * abs(bases[0]) else math.nan
        mean, sigma = float(np.average(estimates.deviation[k], weights=w)), math.sqrt(variance / float(np.sum(w)))
        rows.append(_group(estimates.number, vine, against, level, base, mean, sigma, k.size))
    return rows


def _along_growth(fit: Fit, estimates: PerTrialEstimates) -> Iterator[ConstancyTest]:
    """Test ln B for a change along the growth, for every vine and for all: Student's t test of the mean difference of
    the halves, each fitted by itself. The scatter of pressure and B between trials is the same in both halves and
    cancels. An effect that builds up along the growth shows here even where n and the yield pressure absorb it in every
    comparison between trials. The groups of a vine are its halves, which share the variance of their difference.
    """
    from scipy.stats import t as student

    halves, vines = _halves(fit, estimates), estimates.vines
    usable = (np.abs(halves) <= MAX_DEVIATION).all(axis=1)
    names = list(dict.fromkeys(vines[usable].tolist()))
    for vine in [*names, *([""] if len(names) > 1 else [])]:
        chosen = np.flatnonzero(usable & ((vines == vine) | (vine == "")))
        rise = halves[chosen, 1] - halves[chosen, 0]
        variance, dof = _of_replicates(rise, np.ones(rise.size), estimates.conditions[chosen])
        if dof < FEWEST_DEGREES:
            variance, dof = float(np.var(rise, ddof=1)) if rise.size > 1 else 0.0, rise.size - 1
        if dof < FEWEST_DEGREES:
            continue
        # 2e-3: lower limit of the standard deviation of the rise of ln B in single trials (chosen)
        mean, sigma = float(rise.mean()), max(math.sqrt(variance), 2e-3) / math.sqrt(rise.size)
        base = float(estimates.base[chosen[0]])
        groups = [
            _group(estimates.number, vine, "growth", level, base, half, sigma / math.sqrt(2), rise.size)
            for level, half in zip(HALVES, halves[chosen].mean(axis=0).tolist(), strict=True)
        ]
        p = float(2 * student.sf(abs(mean) / sigma, dof))
        change, levels = (math.expm1(abs(mean)), math.exp(abs(mean)) * sigma), HALVES if mean >= 0 else HALVES[::-1]
        shown = groups if vine or len(names) == 1 else ()
        yield _tested(estimates.number, vine, "growth", levels, change, (p,), dof, rise.size, shown)


def _halves(fit: Fit, estimates: PerTrialEstimates) -> Floats:
    """Best-fit deviation of ln B in each half of the growth, by trial, shape (n_trials, 2), linearised about each
    trial's own B. About the common B, the between-trial scatter would enter in second order. What B does in the first
    half is carried through the second as a shift in time, as where inertia is small.
    """
    halves = np.full((len(estimates.trials), 2), math.nan)
    for i, (trial_data, columns) in enumerate(zip(fit.predictor.data, estimates.columns, strict=True)):
        response, speed, residual = columns[:, DAMPING_DEVIATION], -columns[:, RELEASE], columns[:, -1]
        growth = trial_data.lead_position_m - residual - estimates.trial_effects[i, ORIGIN]
        middle = int(np.argmax(growth >= 0.5 * growth.max()))
        if speed[middle] > 0 and response[middle] != 0:
            first = response.copy()
            first[middle:] = response[middle] * speed[middle:] / speed[middle]
            design = np.column_stack([first, response - first, columns[:, estimates.nuisances[i]]])
            halves[i] = np.linalg.lstsq(design, residual, rcond=1e-9)[0][:2]
    return halves + estimates.trial_effects[:, [DAMPING_DEVIATION]]


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
        pulled_Pa, sigma_Pa = number.value - free.start, math.sqrt(variance)
        p = math.erfc(abs(pulled_Pa) / sigma_Pa / math.sqrt(2))
        n_trials = sum(trial.trial.vine == number.vine.split(",")[0] for trial in fit.trials)
        levels, change = (free.start, number.value), (pulled_Pa, sigma_Pa)
        yield _tested(
            number, number.vine, "sheet", levels, change, (p,), math.inf, n_trials, stated_sigma_Pa=free.prior_sd
        )
