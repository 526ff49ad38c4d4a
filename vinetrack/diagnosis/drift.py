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
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from vinetrack.core.numbers import decimals
from vinetrack.core.records import Floats
from vinetrack.core.units import display_unit
from vinetrack.diagnosis.constancy_tests import (
    COVARIATES,
    BlockedDeviations,
    ConstancyTest,
    Covariate,
    blocked_deviations,
    constancy_p_value,
    normal_deviate,
)
from vinetrack.diagnosis.drift_along import against_the_sheet, along_growth
from vinetrack.diagnosis.per_trial_estimates import PerTrialEstimates, align_trials, per_trial_estimates
from vinetrack.diagnosis.replicate_scatter import LEAST_BETWEEN_TRIAL_SD, Scatter
from vinetrack.diagnosis.stretches import replicate_scatter, residual_courses
from vinetrack.dynamics.simulate import SimulationError
from vinetrack.inference.fit_data import FitError
from vinetrack.inference.fit_result import Fit, Number
from vinetrack.inference.parameters import DAMPING, EXPONENT, YIELD_PRESSURE
from vinetrack.inference.subset import fit_subset

if TYPE_CHECKING:
    import pandas as pd

log = logging.getLogger(__name__)

DRIFT_COLUMNS = (
    "parameter",
    "vine",
    "symbol",
    "unit",
    "against",
    "from_level",
    "to_level",
    "change",
    "change_sigma",
    "relative",
    "z",
    "z_constancy",
    "dof",
    "n_trials",
    "significant",
    "sentence",
)
GROUP_COLUMNS = (
    "parameter",
    "vine",
    "symbol",
    "unit",
    "against",
    "level",
    "value",
    "sigma",
    "ratio",
    "ratio_sigma",
    "n_trials",
)

MOST_ITERATIONS = 15  # Maximum number of iterations of a refit (chosen)


FALSE_ALARM_LEVEL = 0.01  # Family-wise probability that any drift is called significant where nothing drifts (chosen)


@dataclass(frozen=True)
class Drift:
    """Drifts, most significant first, and the values of the groups; SI. `table`, columns `DRIFT_COLUMNS`, has one row
    for each parameter, vine (blank: all) and condition.
    """

    table: pd.DataFrame
    groups: pd.DataFrame
    notes: tuple[str, ...] = ()

    @property
    def sentences(self) -> tuple[str, ...]:
        """One sentence for each parameter and condition with a significant drift, of the most significant row."""
        significant = self.table[self.table["significant"]].drop_duplicates(["parameter", "against"])
        return tuple(significant["sentence"])


def drift(fit: Fit, scatter: Scatter | None = None) -> Drift:
    """Test every parameter for drift with pressure, payload, angle, chamber, inlet, vine or along the growth."""
    import pandas as pd

    notes: list[str] = []
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


def _tests(fit: Fit, scatter: Scatter, notes: list[str]) -> Iterator[ConstancyTest]:
    keys = [key for key in fit.predictor.layout.keys if key not in (YIELD_PRESSURE, EXPONENT)]
    aligned, damping = align_trials(fit), None
    for key in keys:
        try:
            estimates = per_trial_estimates(fit, key, aligned)
        except SimulationError:
            notes.append(f"{key} could not be fitted to single trials: the simulation fails there.")
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
            notes.append("B along the growth could not be estimated: the simulation fails there.")


def _against(estimates: PerTrialEstimates, against: Covariate) -> Iterator[ConstancyTest]:
    """Tests of one parameter against one condition: each vine alone where the parameter is per vine, and all."""
    levels = np.array([against.level(trial) for trial in estimates.trials])
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
        sums = blocked_deviations(estimates, against.coordinate(levels), levels, chosen)
        if sums is None:
            continue
        shown = [] if estimates.per_vine and not vine else _groups(estimates, against, levels, chosen, sums, vine)
        yield _slope(estimates, against, levels[chosen], sums, vine, shown)


def _slope(
    estimates: PerTrialEstimates,
    against: Covariate,
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
    reach = float(np.diff(against.coordinate(np.array([low, high])))[0])
    start, stop = (low, high) if slope >= 0 else (high, low)
    change, error = abs(slope) * reach, sigma * reach
    if estimates.logarithmic:
        change, error = math.expm1(change), math.exp(change) * error
    p = float(2 * student.sf(abs(slope) / sigma, sums.dof))
    p_groups, z_constancy = constancy_p_value(sums)
    row: dict[str, object] = {
        "parameter": estimates.key,
        "vine": vine,
        "symbol": estimates.symbol,
        "unit": estimates.unit,
        "against": against.column,
        "from_level": start,
        "to_level": stop,
        "change": change,
        "change_sigma": error,
        "relative": estimates.logarithmic,
        "z": normal_deviate(p),
        "z_constancy": z_constancy,
        "dof": sums.dof,
        "n_trials": int(sums.x.size),
    }
    row["sentence"] = _sentence(estimates, against, row, steadily=p <= p_groups)
    return ConstancyTest(row, min(1.0, 2 * min(p, p_groups)), groups)


def _sentence(estimates: PerTrialEstimates, against: Covariate, row: Mapping[str, Any], *, steadily: bool) -> str:
    """A row in words; `steadily` where the slope is more significant than the differences between groups."""
    who = f"{estimates.symbol} of {row['vine']}" if row["vine"] else estimates.symbol
    start, stop = against.formatted(row["from_level"]), against.formatted(row["to_level"])
    if steadily:
        return (
            f"{who} rises by {_amount(estimates, row['change'], row['change_sigma'])} from {start} to {stop}"
            f" of {against.label} ({row['z']:.1f} σ), though it should not depend on the {against.label}."
        )
    low, high = sorted((row["from_level"], row["to_level"]))
    return (
        f"{who} is not the same at every {against.label} ({row['z_constancy']:.1f} σ), without rising or falling"
        f" steadily from {against.formatted(low)} to {against.formatted(high)}."
    )


def _amount(estimates: PerTrialEstimates, change: float, error: float) -> str:
    """A change with its standard error, in per cent or in its display unit."""
    unit, factor = ("%", 100.0) if estimates.logarithmic else display_unit(estimates.unit)
    digits = max(decimals(error * factor) - 1, 0)
    return f"{change * factor:.{digits}f} ± {error * factor:.{digits}f} {unit}".rstrip()


def _groups(
    estimates: PerTrialEstimates,
    against: Covariate | None,
    levels: Floats,
    chosen: NDArray[np.bool_],
    sums: BlockedDeviations,
    vine: str,
) -> list[dict[str, object]]:
    """Mean value of every group, with its standard error from the scatter of replicates."""
    rows = []
    for level in np.unique(levels[chosen]):
        k = np.flatnonzero(chosen & (levels == level))
        w = 1 / estimates.variance[k]
        mean = float(np.average(estimates.deviation[k], weights=w))
        sigma = math.sqrt(sums.variance / float(np.sum(w)))
        rows.append(_group_row(estimates, against, float(level), vine, mean, sigma, k))
    return rows


def _group_row(
    estimates: PerTrialEstimates,
    against: Covariate | None,
    level: float,
    vine: str,
    mean: float,
    sigma: float,
    k: NDArray[np.int_],
) -> dict[str, object]:
    base = (
        float(np.mean(estimates.base[k])) if np.ptp(estimates.base[k]) <= 1e-9 * abs(estimates.base[k][0]) else math.nan
    )
    if estimates.logarithmic:
        ratio, ratio_sigma = math.exp(mean), math.exp(mean) * sigma
        value, value_sigma = base * ratio, base * ratio_sigma
    else:
        value, value_sigma = base + mean, sigma
        ratio, ratio_sigma = (value / base, sigma / abs(base)) if base != 0 else (math.nan, math.nan)
    return {
        "parameter": estimates.key,
        "vine": vine,
        "symbol": estimates.symbol,
        "unit": estimates.unit,
        "against": against.column if against else "vine",
        "level": level if against else math.nan,
        "value": value,
        "sigma": value_sigma,
        "ratio": ratio,
        "ratio_sigma": ratio_sigma,
        "n_trials": int(k.size),
    }


def _vine_row(
    key: str, symbol: str, unit: str, groups: Sequence[dict[str, object]], z: float, dof: float, n_trials: int
) -> dict[str, object]:
    """Row for a parameter that differs between vines; the change is from the lowest to the highest value."""
    ordered = sorted(groups, key=lambda group: float(str(group["value"])))
    low, high = ordered[0], ordered[-1]
    shown, factor = display_unit(unit)
    ends = " and ".join(
        f"{float(str(end['value'])) * factor:.3g} ± {float(str(end['sigma'])) * factor:.1g} {shown}".rstrip()
        + f" ({end['vine']})"
        for end in (low, high)
    )
    return {
        "parameter": key,
        "vine": "",
        "symbol": symbol,
        "unit": unit,
        "against": "vine",
        "from_level": math.nan,
        "to_level": math.nan,
        "change": float(str(high["value"])) - float(str(low["value"])),
        "change_sigma": math.hypot(float(str(high["sigma"])), float(str(low["sigma"]))),
        "relative": False,
        "z": z,
        "z_constancy": z,
        "dof": dof,
        "n_trials": n_trials,
        "sentence": f"{symbol} differs between the vines ({z:.1f} σ), though one value should describe all: {ends}.",
    }


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
    """χ² test of the values of single vines against their mean."""
    from scipy.stats import chi2 as chi_square

    value, sigma = (np.array([getattr(number, name) for _, number, _ in estimates]) for name in ("value", "sigma"))
    mean = float(np.average(value, weights=1 / sigma**2))
    p = float(chi_square.sf(float(np.sum((value - mean) ** 2 / sigma**2)), len(estimates) - 1))
    groups = [_vine_group(*estimate, common.value) for estimate in estimates]
    count = sum(estimate[2] for estimate in estimates)
    row = _vine_row(common.key, common.symbol, common.unit, groups, normal_deviate(p), math.inf, count)
    return ConstancyTest(row, p, groups)


def _vine_group(vine: str, number: Number, count: int, common: float) -> dict[str, object]:
    return {
        "parameter": number.key,
        "vine": vine,
        "symbol": number.symbol,
        "unit": number.unit,
        "against": "vine",
        "level": math.nan,
        "value": number.value,
        "sigma": number.sigma,
        "ratio": number.value / common if common else math.nan,
        "ratio_sigma": number.sigma / common if common else math.nan,
        "n_trials": count,
    }
