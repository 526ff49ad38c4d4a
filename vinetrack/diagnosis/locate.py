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
from vinetrack.diagnosis.drift import (
    Drift,
    ResidualCourse,
    common_edges,
    common_stretches,
    courses_by_condition,
    drift,
    replicate_scatter,
    residual_courses,
    stretch_means,
    stretch_variances,
)
from vinetrack.diagnosis.ladder import excess, position_errors
from vinetrack.diagnosis.replicates import Scatter, Stretches, replicate_z, replicates_of, stretch_covariance
from vinetrack.diagnosis.result import MAX_STRETCHES
from vinetrack.inference.fit_result import Fit, TrialFit

if TYPE_CHECKING:
    import pandas as pd


_MEANS = ("mean_residual_m", "sigma_m", "z", "n_trials")
TIME_COLUMNS = ("vine", "condition", "from_s", "to_s", "time_s", *_MEANS)
POSITION_COLUMNS = ("vine", "condition", "from_m", "to_m", "lead_position_m", *_MEANS)
SPEED_COLUMNS = ("vine", "condition", "from_m_s", "to_m_s", "lead_velocity_m_s", *_MEANS)


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
        """Whether the worst condition, or all together, deviate by more than the scatter of replicates."""
        return _fail(self.by_condition["z"].to_numpy(float))

    def remarks(self) -> tuple[Remark, ...]:
        """Where the model fails most, by how much, and what drifts."""
        return (*_where(self.by_condition, self.fails), *self.drift.remarks)


def locate(fit: Fit) -> Failure:
    """Find where a fitted model fails."""
    import pandas as pd

    courses, predicted = residual_courses(fit)
    scatter = replicate_scatter(fit, courses)
    of = courses_by_condition(courses)
    conditions = list(of)
    edges = {name: common_edges(members) for name, members in of.items()}
    rows = []
    for name in conditions:
        members = [trial for trial in predicted if trial.trial.condition == name]
        rows.append(_condition_row(members, common_stretches(of[name], "time_s", edges[name]), scatter))
    table = pd.DataFrame(rows)
    vines = list(dict.fromkeys(course.trial.vine for course in courses))
    by_vine = {vine: [course for course in courses if course.trial.vine == vine] for vine in vines}
    return Failure(
        model="+".join(fit.model.names),
        by_condition=table.sort_values("rms_m", ascending=False, kind="stable", ignore_index=True),
        along_time=_table([(of[n], "time_s", edges[n], n) for n in conditions], TIME_COLUMNS, scatter),
        along_position=_along("lead_position_m", of, by_vine, POSITION_COLUMNS, scatter),
        along_speed=_along("lead_velocity_m_s", of, by_vine, SPEED_COLUMNS, scatter),
        scatter=scatter,
        drift=drift(fit, scatter),
    )


def _condition_row(members: Sequence[TrialFit], stretches: Stretches, scatter: Scatter) -> dict[str, object]:
    together = replicates_of(members)
    errors = position_errors(members, together)
    covariance = stretch_covariance(scatter, stretches)
    mean, count = stretches.means_m.mean(axis=0), len(members)
    sigma = np.sqrt(np.diag(covariance) / count)
    # Replicates without enough frames at common times have no stretch means.
    worst = int(np.argmax(np.abs(mean))) if mean.size else None
    trial = members[0].trial
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
        "z": replicate_z(mean, covariance, count, scatter) if mean.size else 0.0,
        "worst_at_s": errors["worst_at_s"],
        "worst_at_m": errors["worst_at_m"],
        "worst_residual_m": math.nan if worst is None else float(mean[worst]),
        "worst_sigma_m": math.nan if worst is None else float(sigma[worst]),
    }


def _along(
    along: str,
    of: dict[str, list[ResidualCourse]],
    by_vine: dict[str, list[ResidualCourse]],
    columns: Sequence[str],
    scatter: Scatter,
) -> pd.DataFrame:
    """Mean residuals of each condition in the same stretches, and of all trials of a vine together."""
    parts = []
    for members in by_vine.values():
        edges = np.linspace(0.0, max(float(getattr(member, along).max()) for member in members), MAX_STRETCHES + 1)
        names = dict.fromkeys(member.trial.condition for member in members)
        parts += [(of[name], along, edges, name) for name in names] + [(members, along, edges, "")]
    return _table(parts, columns, scatter)


def _table(
    parts: Sequence[tuple[Sequence[ResidualCourse], str, Floats, str]], columns: Sequence[str], scatter: Scatter
) -> pd.DataFrame:
    import pandas as pd

    rows = [row for part in parts for row in _mean_rows(*part, scatter)]
    return pd.DataFrame(rows, columns=list(columns))


def _mean_rows(
    members: Sequence[ResidualCourse], along: str, edges: Floats, condition: str, scatter: Scatter
) -> list[tuple[object, ...]]:
    """Mean residual of every stretch over the trials that reach it, with its standard error."""
    parts = [stretch_means(member, along, edges) for member in members]
    both = np.array([means for means, _ in parts])
    present = np.isfinite(both).all(axis=2)
    variances = np.array([stretch_variances(*part, scatter) for part in zip(members, parts, strict=True)])
    rows: list[tuple[object, ...]] = []
    for k in range(edges.size - 1):
        reached = present[:, k]
        if not reached.any():
            continue
        count = int(reached.sum())
        mean = float(both[reached, k, 0].mean())
        sigma = math.sqrt(float(variances[reached, k].sum())) / count
        low, high = float(edges[k]), float(edges[k + 1])
        middle = (low + high) / 2
        rows.append((members[0].trial.vine, condition, low, high, middle, mean, sigma, mean / sigma, count))
    return rows


def _fail(z: Floats) -> bool:
    """Whether the largest deviate (Bonferroni), or all together (Fisher's combined test), are significant."""
    from scipy.stats import chi2, norm

    # 3.0: significance, in standard deviations, from which a model is said to fail
    level = float(norm.sf(3.0))
    p = norm.sf(z)
    together = float(chi2.sf(-2 * np.sum(np.log(np.maximum(p, 1e-300))), 2 * z.size))
    return bool(p.min() < level / z.size or together < level)


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
