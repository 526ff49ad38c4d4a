"""Locate where a model fails by more than the scatter of replicates, and which of its parameters drift.

By condition; along the growth; and by which parameter drifts with a condition on which it should not
depend. A prediction has its own release and origin and no other trial effect, as in `vinetrack.diagnosis.ladder`.
Standard errors are those of the mean over trials, from the scatter of replicates (`vinetrack.diagnosis.ladder`): a
thousand frames of one trial are one trial.
"""

from __future__ import annotations

import itertools
import logging
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from scipy.special import ndtri, stdtr

from vinetrack.core.problems import Remark, remark
from vinetrack.diagnosis.ladder import AlignedTrials, align_trials, orthogonal_part, rms_of, within_groups
from vinetrack.diagnosis.result import MAX_STRETCHES
from vinetrack.dynamics.simulate import SimulationError
from vinetrack.experiment.schema import COLUMNS, LIMITED, RIG
from vinetrack.inference.errors import precision, with_systematics
from vinetrack.inference.fit_data import FitError
from vinetrack.inference.fit_result import DAMPING, YIELD_PRESSURE, Fit, Number
from vinetrack.inference.optimiser import TYPICAL_SPREADS
from vinetrack.inference.sensitivity import DAMPING_DEVIATION, PRESSURE

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Failure:
    """Where a model fails: what is said of the worst condition, the mean residuals (measurement minus model) along the
    growth, SI, and what drifts.
    """

    worst: Remark
    along_position: pd.DataFrame
    drift: Drift

    @property
    def remarks(self) -> tuple[Remark, ...]:
        """Where the model fails most, by how much, and what drifts."""
        return self.worst, *self.drift.remarks


def locate(fit: Fit) -> Failure:
    """Find where a fitted model fails."""
    aligned = align_trials(fit)
    along = _residual_along_growth(aligned)
    return Failure(_worst_condition(aligned, along), along, drift(fit, aligned))


def _worst_condition(aligned: AlignedTrials, along: pd.DataFrame) -> Remark:
    """The condition with the largest root mean square, which all pages call the worst, and the mean residual of the
    stretch where that is largest, with its standard error.
    """
    together = max(aligned.together.values(), key=lambda replicates: rms_of(replicates.trials))
    trial, trials = together.trials[0].trial, [trial.trial for trial in aligned.trials]
    stretches = along[along["condition"] == trial.condition]
    worst = stretches.iloc[int(stretches["mean_residual_m"].abs().argmax())]
    off_m = float(worst["mean_residual_m"]), float(worst["sigma_m"])
    # What names a condition: its pressure, and payload and vine where they vary
    varying = [name for name in ("payload_kg", "vine") if len({getattr(one, name) for one in trials}) > 1]
    return remark(
        "fails_most",
        condition={"unit": trial.pressure_unit} | {name: getattr(trial, name) for name in ("pressure_Pa", *varying)},
        rms_m=rms_of(together.trials),
        floor_m=together.floor_m,
        is_repeated=math.isfinite(together.floor_m),
        off_m=off_m,
        is_ahead=off_m[0] > 0,
    )


def _residual_along_growth(aligned: AlignedTrials) -> pd.DataFrame:
    """Mean residual of each condition in every stretch of the growth of its vine, over the trials that reach it, with
    its standard error.
    """
    multiple, rows = aligned.scatter.multiple, list[tuple[object, ...]]()
    every = list(itertools.chain(*aligned.courses.values()))
    for condition, members in aligned.courses.items():
        vine = members[0].trial.vine
        reach_m = max(float(course.lead_position_m.max()) for course in every if course.trial.vine == vine)
        edges = np.linspace(0.0, reach_m, MAX_STRETCHES + 1)
        for low, high in itertools.pairwise(edges.tolist()):
            inside = [(of, (of.lead_position_m >= low) & (of.lead_position_m <= high)) for of in members]
            there = [(of, of.residual_m[at].mean(), of.response_m[at].mean(axis=0)) for of, at in inside if at.any()]
            if count := len(there):
                mean_m = float(np.mean([residual_m for _, residual_m, _ in there]))
                variances = [multiple**2 * response_m @ response_m + of.noise_m2 for of, _, response_m in there]
                # A lens displaces all trials alike.
                smooth_m2 = float(np.mean([of.smooth_m2 for of, _, _ in there]))
                sigma_m = math.sqrt(sum(variances) / count**2 + smooth_m2)
                rows.append((vine, condition, low, high, (low + high) / 2, mean_m, sigma_m, mean_m / sigma_m, count))
    columns = ("vine", "condition", "from_m", "to_m", "lead_position_m", "mean_residual_m", "sigma_m", "z", "n_trials")
    return pd.DataFrame(rows, columns=list(columns))


# ------------------------------------------------------------------------------
# Parameters that drift with a condition on which they should not depend.
#
# One B should describe a vine at every pressure and with every payload. The best value is fitted to each trial, all
# other parameters at their common values: it takes upon itself whatever a model lacks. Scatter by chance is taken from
# replicates, not from the fit, which a model that fails inflates. The common parameters have absorbed part of the drift
# (n most of it, where B follows the pressure): z is too small rather than too large.

FALSE_ALARM_LEVEL = 0.01  # Family-wise probability that any drift is called significant where nothing drifts (chosen)
FEWEST_DEGREES = 2  # Degrees of freedom of replicates from which they determine the scatter of estimates (chosen)
LEAST_SCATTER = 0.1  # Least scatter of replicates, as part of the expected scatter of pressure and B (chosen)

DRIFT_COLUMNS = (
    *("parameter", "vine", "symbol", "against", "from_level", "to_level", "change", "change_sigma", "z"),
    *("significant", "sentence"),
)
GROUP_COLUMNS = ("parameter", "vine", "symbol", "against", "level", "ratio", "ratio_sigma", "n_trials")


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


def drift(fit: Fit, aligned: AlignedTrials | None = None) -> Drift:
    """Test B for drift with pressure, payload, angle, chamber or inlet, and P_y against the sheet."""
    tests = list(against_the_sheet(fit))
    if DAMPING in fit.predictor.layout.keys:
        of_trials = per_trial_estimates(fit, aligned or align_trials(fit))
        damping = next(number for number in fit.numbers if number.key == DAMPING)
        covariates = [COLUMNS[name].field for name in (*LIMITED["range"], *RIG)]
        tests = [*(test for against in covariates for test in _against(of_trials, damping, against)), *tests]
    level = 1 - (1 - FALSE_ALARM_LEVEL) ** (1 / max(len(tests), 1))
    table = pd.DataFrame(tests, columns=[*DRIFT_COLUMNS, "p", "groups"]).sort_values(
        "p", kind="stable", ignore_index=True
    )
    groups = [group for of_test in table["groups"] for group in of_test]
    table["significant"] = table["p"] < level
    return Drift(table[list(DRIFT_COLUMNS)], pd.DataFrame(groups, columns=list(GROUP_COLUMNS)))


def drift_groups(before: Drift, after: Fit | None) -> pd.DataFrame:
    """Return the best values of each group of trials under the first model and, where something was added, the last."""
    parts = [before.groups.assign(model="before")]
    if after is not None:
        try:
            parts.append(drift(after).groups.assign(model="after"))
        except (FitError, SimulationError, np.linalg.LinAlgError) as error:
            log.info("the drift under the last model is not known: %s", error)
    return pd.concat([part for part in parts if len(part)] or parts, ignore_index=True)


Row = dict[str, object]


def _tested(
    number: Number,
    vine: str,
    against: str,
    levels: tuple[float, float],
    change: tuple[float, float],
    p: float,
    groups: Sequence[Row] = (),
    **told: Any,
) -> Row:
    """A test as a row of the table, with its p-value and its `groups`: levels from and to, the change between them and
    its standard error. `told` is what the sentence about it needs besides.
    """
    subject: Row = {"parameter": number.key, "vine": vine, "symbol": number.symbol, "against": against}
    row = subject | dict(zip(DRIFT_COLUMNS[4:], (*levels, *change, -float(ndtri(max(p, 1e-300) / 2))), strict=False))
    sentence = remark("drifts", row=row, pressure_unit=number.pressure_unit, **told)
    return row | {"sentence": sentence, "p": p, "groups": [subject | group for group in groups]}


# ------------------------------------------------------------------------------
# B of each trial, with all other parameters at their common values, and tests of whether it changes with a condition: a
# linear trend.


def per_trial_estimates(fit: Fit, aligned: AlignedTrials) -> pd.DataFrame:
    """Ln B of each trial that depends on it, by least squares of position with its release free: the trial, its vine
    (blank where all have one B), the `deviation` of the best ln B from the common value, and its `weight`, the inverse
    of its variance by a typical scatter of pressure and B, up to a factor.
    """
    has_own = any(number.vine for number in fit.numbers if number.key == DAMPING)
    rows = list[tuple[object, ...]]()
    for i, (trial_data, columns) in enumerate(zip(aligned.predictor.data, aligned.columns, strict=True)):
        trial, others = trial_data.trial, columns[:, aligned.nuisances(i)]
        sensitivity = orthogonal_part(columns[:, DAMPING_DEVIATION], others)
        response = float(np.sum(sensitivity**2))
        # 1e-12: least response of a trial, relative to its travel, from which it tells its B (derived)
        if response > 1e-12 * float(np.ptp(trial_data.lead_position_m)) ** 2 * len(columns):
            levers = sensitivity @ orthogonal_part(columns[:, [PRESSURE, DAMPING_DEVIATION]], others) / response
            variance = np.sum(np.square(TYPICAL_SPREADS * levers)) + trial_data.mean_noise_m**2 / response + 1e-12
            vine = trial.vine if has_own else ""
            rows.append((trial, vine, trial.condition, sensitivity @ columns[:, -1] / response, 1 / variance))
    return pd.DataFrame(rows, columns=["trial", "vine", "condition", "deviation", "weight"])


def _against(of_trials: pd.DataFrame, number: Number, against: str) -> Iterator[Row]:
    """Tests of a linear trend against one condition, of each vine alone and of all, about the mean of each vine
    (Student's t). The variance is that of replicates, or about the slope where there are too few.
    """
    levels = np.array([float(getattr(trial, against)) for trial in of_trials["trial"]])
    linear = against in ("payload_kg", "growth_angle_rad") or not np.all(levels > 0)
    known = of_trials.assign(level=levels, x=levels if linear else np.log(levels))[np.isfinite(levels)]
    apart, replicates = within_groups(*(of_trials[name].to_numpy() for name in ("deviation", "condition", "weight")))
    varying = [of_vine for _, of_vine in known.groupby("vine", sort=False) if np.ptp(of_vine["level"]) > 0]
    for tested in [*varying, *([pd.concat(varying)] if len(varying) > 1 else [])]:
        vines, w = tested["vine"].to_numpy(), tested["weight"].to_numpy()
        x, d = (within_groups(tested[name].to_numpy(), vines, w)[0] for name in ("x", "deviation"))
        square, n_vines = float(np.sum(w * x**2)), len(set(vines))
        dof = replicates if replicates >= FEWEST_DEGREES else d.size - n_vines - 1
        if dof < FEWEST_DEGREES or not square > 0:
            continue
        slope = float(np.sum(w * x * d)) / square
        by_slope = np.sum(w * (d - x * slope) ** 2)
        variance = float(np.sum(of_trials["weight"] * apart**2) if replicates >= FEWEST_DEGREES else by_slope) / dof
        variance = max(variance, LEAST_SCATTER**2)
        sigma = math.sqrt(variance / square)
        groups: list[Row] = []
        for level, alike in tested.groupby("level") if n_vines == 1 else ():
            ratio = math.exp(float(np.average(alike["deviation"], weights=alike["weight"])))
            error = ratio * math.sqrt(variance / float(alike["weight"].sum()))
            groups.append({"level": level, "ratio": ratio, "ratio_sigma": error, "n_trials": len(alike)})
        reach, ends = float(np.ptp(tested["x"])), (float(tested["level"].min()), float(tested["level"].max()))
        # Relative change from the smaller value, with its standard error
        larger, p = math.exp(abs(slope) * reach), float(2 * stdtr(dof, -abs(slope) / sigma))
        of_test = (ends if slope >= 0 else ends[::-1], (larger - 1, larger * sigma * reach), p, groups)
        yield _tested(number, vines[0] if n_vines == 1 else "", against, *of_test)


def against_the_sheet(fit: Fit) -> Iterator[Row]:
    """Compare fitted yield pressures with the sheet. With σ₀ that of the sheet and σ that of the fit with exact errors,
    the sheet's own value is part of the fitted one, and their difference has the variance σ₀² − σ², not σ₀²; what the
    fit adds to σ² for scatter comes on top.
    """
    extended = with_systematics(fit.predictor, fit.solution).solution
    plain = np.diag(precision(extended).covariance)[: len(fit.numbers)]
    for number, free, exact in zip(fit.numbers, fit.predictor.layout.free, plain, strict=True):
        variance = free.prior_sd**2 + number.sigma**2 - 2 * float(exact) * free.derivative(number.value) ** 2
        if number.key != YIELD_PRESSURE or not 0 < variance < math.inf:
            continue
        pulled_Pa, sigma_Pa = number.value - free.start, math.sqrt(variance)
        p = math.erfc(abs(pulled_Pa) / sigma_Pa / math.sqrt(2))
        of_test = (free.start, number.value), (pulled_Pa, sigma_Pa), p
        yield _tested(number, number.vine, "sheet", *of_test, stated_sigma_Pa=free.prior_sd)
