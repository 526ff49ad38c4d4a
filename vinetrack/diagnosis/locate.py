"""Locate where a model fails by more than the scatter of replicates.

By condition; along time, position and speed; and by which parameter drifts with a condition on which it should not
depend (`vinetrack.diagnosis.drift`). A prediction has its own release and origin and no other trial effect, as in
`vinetrack.diagnosis.ladder`. Standard errors are those of the mean over trials, from the scatter of replicates
(`vinetrack.diagnosis.replicates`): a thousand frames of one trial are one trial.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from vinetrack.core.problems import Remark, remark
from vinetrack.core.records import Floats
from vinetrack.diagnosis.drift import Drift, drift
from vinetrack.diagnosis.ladder import excess, position_errors
from vinetrack.diagnosis.replicates import (
    Replicates,
    ResidualCourse,
    Scatter,
    Stretches,
    by_condition,
    common_edges,
    common_stretches,
    replicate_scatter,
    replicates_by_condition,
    residual_courses,
)
from vinetrack.diagnosis.result import MAX_STRETCHES
from vinetrack.inference.fit_result import Fit

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True)
class Failure:
    """Where a model fails; tables in SI, a residual is measurement minus model. `by_condition` has the largest root
    mean square first, which all pages call the worst condition; `z` is the significance of the mean residual compared
    with the scatter of replicates.
    """

    model: str
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
        return (*_where(self.by_condition, self.fails), *self.drift.remarks)


def locate(fit: Fit) -> Failure:
    """Find where a fitted model fails."""
    import pandas as pd

    courses, predicted = residual_courses(fit)
    scatter, together = replicate_scatter(fit, courses), replicates_by_condition(predicted)
    conditions = by_condition(courses)
    rows = [_condition_row(together[name], common_stretches(of), scatter) for name, of in conditions.items()]
    in_time = [(of, common_edges(of), name) for name, of in conditions.items()]
    return Failure(
        model="+".join(fit.model.names),
        by_condition=pd.DataFrame(rows).sort_values("rms_m", ascending=False, kind="stable", ignore_index=True),
        along_time=_table("time_s", "s", in_time, scatter),
        along_position=_table("lead_position_m", "m", _parts("lead_position_m", courses), scatter),
        along_speed=_table("lead_velocity_m_s", "m_s", _parts("lead_velocity_m_s", courses), scatter),
        scatter=scatter,
        drift=drift(fit, scatter),
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


def _where(table: pd.DataFrame, fails: bool) -> Iterator[Remark]:
    """Remarks about conditions; the table has the worst first."""
    if not fails:
        worst = table.sort_values("z").iloc[-1]
        yield remark("fails_nowhere", z=max(float(worst["z"]), 0.0), condition=_named(worst, table))
        return
    worst = table[np.isfinite(table["worst_residual_m"])].iloc[0]
    numbers = {name: float(worst[name]) for name in ("rms_m", "floor_m", "worst_residual_m", "worst_sigma_m", "z")}
    yield remark("fails_most", condition=_named(worst, table), **numbers)
    # 2.0: significance, in standard deviations, from which it is said to fail in a condition
    count, total = int((table["z"] > min(2.0, float(table["z"].max()) - 1e-9)).sum()), len(table)
    yield remark("fails_everywhere") if count == total else remark("fails_in", count=count, total=total)
    for column in ("pressure_Pa", "payload_kg"):
        usable = table[np.isfinite(table["ratio"])]
        steps = [group.sort_values(column)["ratio"].to_numpy(float) for _, group in usable.groupby("vine")]
        steps = [step for step in steps if step.size > 2]
        if steps and len(set(usable[column])) >= 3:
            ranks = [np.corrcoef(np.arange(step.size), np.argsort(np.argsort(step)))[0, 1] for step in steps]
            if min(ranks) > 0.75 or max(ranks) < -0.75:
                yield remark("misfit_follows", column=column, rises=bool(ranks[0] > 0))


def _named(row: pd.Series, table: pd.DataFrame) -> dict[str, object]:
    """What names a condition: its pressure, and payload and vine where they vary."""
    varying = [name for name in ("payload_kg", "vine") if len(set(table[name])) > 1]
    return {name: row[name] for name in ("pressure_Pa", *varying)}
