"""The damping law F = B·x_ssⁿ: one exponent n for all vines, one coefficient B for each.

Two fits of ln F = ln B_v + n ln x_ss. `log_log` is that of the paper: least squares of the force residuals. However,
the experimenter sets the force, and the vine responds with a speed: a vine with 3 % more damping is 8 % slower. Scatter
of the regressor biases such a fit towards zero, by σ_B²/var(ln F) of n (regression dilution). `both_axes` assigns every
error to the variable where it arises: the error of a measured pressure to F; to x_ss the error of the measured speed,
the scatter between vines, and the scatter of a pressure that was set, since there the true force deviates from the
stated one and takes the speed with it (Berkson error). York's estimator then gives n (D. York et al., Am. J. Phys. 72,
367, 2004). The scatter is estimated as what the stated errors do not explain.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from scipy.special import stdtr, stdtrit

from vinetrack.core.records import Floats

LEAST_STEADY_SHARE = 0.5  # Fraction of a condition's trials that must be steady for any of them to enter a fit (chosen)


@dataclass(frozen=True)
class Points:
    """Steady points in logarithms, shape (n_points,); errors are relative, `yield_error` is in N. `vine` is the index
    of the vine of each point in `names`. `force_error` is the error of a measured pressure, `set_error` that of a set
    one, `scale_error` that of the scale, shared by all points.
    """

    log_speed: Floats
    log_force: Floats
    speed_error: Floats
    force_error: Floats
    set_error: Floats
    yield_error: Floats
    scale_error: Floats
    force: Floats
    vine: np.ndarray
    names: tuple[str, ...]

    @property
    def member(self) -> Floats:
        """Indicator matrix, shape (n_points, n_vines): 1 where a point belongs to a vine."""
        return np.eye(len(self.names))[self.vine]


def fit_laws(points: pd.DataFrame, *, resamples: int = 2000, seed: int = 0) -> dict[str, Any]:
    """Fit the law to the steady windows by both methods, and exactly as published (`log_log`, `both_axes`, `paper`)."""
    fits = fit_damping(points[points["used"]], resamples=resamples, seed=seed)
    literal = points[points["eligible"] & (points["x_ss_paper_m_s"] > 0)]
    literal = literal.assign(x_ss_m_s=literal["x_ss_paper_m_s"], force_N=literal["force_paper_N"])
    return fits | {"paper": fit_damping(literal, resamples=resamples, seed=seed)["log_log"]}


def mark_half_steady(points: pd.DataFrame) -> pd.DataFrame:
    """Exclude conditions of which less than half of the trials are steady, in `used` and `reason`: where a vine barely
    gets steady within its length, only the slower trials do, whose larger B would bias the upper end of the fit.
    """
    eligible = points[points["eligible"]]
    share = eligible.groupby("condition", sort=False)["used"].mean()
    few = points["condition"].isin(share[(share > 0) & (share < LEAST_STEADY_SHARE)].index) & points["used"]
    marked, steady = points.copy(), points.loc[few, "condition"].map(share)
    marked.loc[few, "reason"] = [f"only {part:.0%} of the trials of this condition are steady" for part in steady]
    marked.loc[few, "used"] = False
    return marked


def mark_left_out(points: pd.DataFrame, left_out: Mapping[str, str]) -> pd.DataFrame:
    """Exclude the points of vines that a law left out, each with the reason, in `used` and `reason`."""
    marked = points.copy()
    for vine, why in left_out.items():
        of_vine = marked["used"] & (marked["vine"] == vine)
        marked.loc[of_vine, "reason"] = f"its vine carries no slope: {why}"
        marked.loc[of_vine, "used"] = False
    return marked


def fit_damping(points: pd.DataFrame, *, resamples: int = 2000, seed: int = 0) -> dict[str, Any]:
    """Fit the law by both methods. Returns `log_log` and `both_axes`, each with `n`, `n_95` (from resampling whole
    trials), `n_95_total` (with the stated errors of yield pressures and scale too), `vines` (B, B_95, B_95_total, R2 of
    ln F, diameter, thickness, number of trials), `covariance` of n and ln B, `scatter` (relative, of a single force),
    `n_trials`, `interval` (its method), `left_out`, and `refused`: None, or why there is no fit.
    """
    kept, left_out = _admit(points)
    methods = {"log_log": False, "both_axes": True}
    if kept.empty:
        reasons = "; ".join(f"{vine}: {why}" for vine, why in left_out.items())
        reason = reasons or "that of each trial is in damping_points.csv"
        refused = f"no vine has enough steady trials for a slope ({reason})"
        return {method: _refusal(refused, left_out) for method in methods}
    data, vines = _logarithms(kept), kept.groupby("vine", sort=False).first()
    return {
        method: _fit(data, vines, left_out, resamples, seed, both_axes=both_axes)
        for method, both_axes in methods.items()
    }


def _admit(points: pd.DataFrame) -> tuple[pd.DataFrame, dict[str, str]]:
    """Points of vines that determine a slope, and the reasons why others do not."""
    usable = points[(points["x_ss_m_s"] > 0) & (points["force_N"] > 0)]
    left_out = {}
    # 3, 1.2: fewest points of a vine, and least ratio of its largest to its smallest force (derived)
    for vine in dict.fromkeys(points["vine"]):
        force = usable.loc[usable["vine"] == vine, "force_N"]
        if len(force) < 3:
            left_out[str(vine)] = f"{len(force)} steady trials, at least 3 are needed"
        elif force.max() < 1.2 * force.min():
            span = f"{force.max() / force.min():.3g}"
            left_out[str(vine)] = f"forces span a factor {span}, at least 1.2 is needed: vary the pressure"
    return usable[~usable["vine"].isin(list(left_out))].sort_values("vine", kind="stable"), left_out


def _refusal(reason: str, left_out: dict[str, str]) -> dict[str, Any]:
    return {
        "n": None, "n_95": [None, None], "n_95_total": [None, None], "vines": {},
        "covariance": {"parameters": [], "matrix": []}, "scatter": None, "n_trials": 0, "interval": None,
        "left_out": left_out, "refused": reason,
    }  # fmt: skip


def _logarithms(points: pd.DataFrame) -> Points:
    sigmas = ["x_ss_sigma_m_s", "force_sigma_N", "yield_force_sigma_N", "scale_rel_sigma"]
    numbers = points.reindex(columns=["x_ss_m_s", "force_N", *sigmas]).to_numpy(float).T
    speed, force, speed_sigma, force_sigma, yield_sigma, scale_sigma = np.nan_to_num(numbers)
    measured = points.reindex(columns=["pressure_source"])["pressure_source"].eq("trace").to_numpy()
    vine, names = pd.factorize(points["vine"].astype(str))
    force_error = force_sigma / force
    return Points(
        np.log(speed), np.log(force), speed_sigma / speed, np.where(measured, force_error, 0.0),
        np.where(measured, 0.0, force_error), yield_sigma, scale_sigma, force, vine, tuple(names),
    )  # fmt: skip


def slope(counts: Floats, data: Points, speed_variance: Floats, force_variance: Floats) -> tuple[Floats, Floats]:
    """York's slope n, (n_resamples,), with one intercept ln B for each vine, for many resamples at once. Shapes:
    counts (n_resamples, n_points); speed_variance, force_variance (n_points,).
    """
    member = data.member
    n = np.full(counts.shape[0], 0.4)
    drawn = counts > 0
    multiplicity = np.where(drawn, counts, 1.0)
    # A resample that repeats a single point has no slope: it diverges here, and the caller drops it.
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        for _ in range(60):
            weight = counts / (force_variance + n[:, None] ** 2 * speed_variance)
            total = weight @ member
            mean_x = (weight * data.log_speed) @ member / total
            mean_y = (weight * data.log_force) @ member / total
            dx = np.where(drawn, data.log_speed - mean_x[:, data.vine], 0.0)
            dy = np.where(drawn, data.log_force - mean_y[:, data.vine], 0.0)
            lever = weight**2 * (dx * force_variance + n[:, None] * dy * speed_variance) / multiplicity
            update = np.sum(lever * dy, axis=1) / np.sum(lever * dx, axis=1)
            has_converged = np.nanmax(np.abs(update - n), initial=0.0) < 1e-10
            n = update
            if has_converged:
                break
    return n, mean_y - n[:, None] * mean_x


def _fit(
    data: Points, vines: pd.DataFrame, left_out: dict[str, str], resamples: int, seed: int, *, both_axes: bool
) -> dict[str, Any]:
    n_points, n_vines = data.log_force.size, len(data.names)
    dof = n_points - n_vines - 1
    speed_variance, force_variance = _variances(data, dof, both_axes)
    ones = np.ones(n_points)
    exponents, log_B = slope(ones[None], data, speed_variance, force_variance)
    n, log_B = float(exponents[0]), log_B[0]
    if not (math.isfinite(n) and n > 0):
        return _refusal("the speeds do not rise with the force, so there is no power law to fit", left_out)
    residual = data.log_force - log_B[data.vine] - n * data.log_speed
    scatter = math.sqrt(float(residual @ residual) / dof)
    # Covariance of n and ln B, from the curvature of χ² at its minimum
    design = np.column_stack([data.log_speed, data.member])
    variance = force_variance + n**2 * speed_variance if both_axes else np.full(n_points, scatter**2)
    covariance = np.asarray(np.linalg.pinv(design.T @ (design / variance[:, None])))
    # What trials share: a yield pressure moves all forces of its vine, the scale all speeds
    shared = np.column_stack([data.member * (data.yield_error / data.force)[:, None], n * data.scale_error])
    moved = covariance @ (design.T / variance) @ shared
    estimate = np.concatenate([[n], log_B])
    # 10: fewest points for bootstrap intervals (chosen)
    if n_points >= 10:
        interval = "resampling whole trials"
        draws = _resample(data, speed_variance, force_variance, resamples, seed)
        # Resampling N points about p fitted parameters reduces their variance by (N − p)/N, and an estimated scatter
        # needs Student's t instead of the normal distribution: percentile intervals are widened by as much.
        sizes = np.array([n_points / (1 + n_vines), *np.bincount(data.vine)])
        student = student_95(dof) / 1.959964
        widening = np.sqrt(sizes / np.maximum(sizes - 1, 0.5)) * student
        low, high = np.percentile(draws, [2.5, 97.5], axis=0)
        low, high = estimate - widening * (estimate - low), estimate + widening * (high - estimate)
    else:
        interval = "least squares and Student's t: too few trials to resample"
        half_width = student_95(dof) * np.sqrt(np.diag(covariance))
        low, high = estimate - half_width, estimate + half_width
    if not both_axes:
        # N and ln B of a fit with all scatter in the speed, minus the estimate by least squares in ln F
        steep, steep_B = slope(ones[None], data, ones, 1e-14 * ones)
        shift = np.concatenate([steep, steep_B[0]]) - estimate
        low, high = np.minimum(low + shift, estimate), np.maximum(high + shift, estimate)
    by_shared = 1.959964 * np.sqrt(np.sum(moved**2, axis=1))
    total = estimate - np.hypot(estimate - low, by_shared), estimate + np.hypot(high - estimate, by_shared)
    own_95, total_95 = np.column_stack([low, high]), np.column_stack(total)
    return {
        "n": n,
        "n_95": own_95[0].tolist(),
        "n_95_total": total_95[0].tolist(),
        "vines": {
            name: {
                "B": float(np.exp(log_B[i])),
                "B_95": np.exp(own_95[i + 1]).tolist(),
                "B_95_total": np.exp(total_95[i + 1]).tolist(),
                "R2": _r_squared(data.log_force[data.vine == i], residual[data.vine == i]),
                "diameter_mm": float(vines["diameter_mm"][name]),
                "thickness_um": float(vines["thickness_um"][name]),
                "n_trials": int(np.sum(data.vine == i)),
            }
            for i, name in enumerate(data.names)
        },
        "covariance": {
            "parameters": ["n", *(f"ln B {name}" for name in data.names)],
            "matrix": (covariance + moved @ moved.T).tolist(),
        },
        "scatter": scatter,
        "n_trials": n_points,
        "interval": interval,
        "left_out": left_out,
        "refused": None,
    }


def _variances(data: Points, dof: int, both_axes: bool) -> tuple[Floats, Floats]:
    """Variance of ln x_ss and of ln F for each point, shape (n_points,) each."""
    if not both_axes:
        return np.zeros_like(data.log_force), np.ones_like(data.log_force)
    from scipy.optimize import brentq

    def scatter_of(residual: Floats, stated: Floats) -> float:
        """Variance s with Σ residual²/(stated + s) = dof, or nearly 0 where the stated variances suffice."""
        squares, ends = residual**2, (1e-12, float(residual @ residual) / dof + 1e-12)

        def excess(s: float) -> float:
            return float(np.sum(squares / (stated + s))) - dof

        return float(brentq(excess, *ends)) if excess(ends[0]) > 0 > excess(ends[1]) else ends[0]

    ones = np.ones((1, data.log_force.size))
    force_variance = data.force_error**2
    scatter, n = 1e-3, np.array([0.4])
    for _ in range(60):
        speed_variance = data.speed_error**2 + (data.set_error**2 + scatter) / n[0] ** 2
        n, log_B = slope(ones, data, speed_variance, force_variance)
        if not (math.isfinite(n[0]) and n[0] > 0):
            break
        residual = data.log_force - log_B[0][data.vine] - n[0] * data.log_speed
        # The scatter of ln F, beyond the stated errors, for which χ² equals its degrees of freedom.
        stated = force_variance + n[0] ** 2 * data.speed_error**2 + data.set_error**2
        before, scatter = scatter, scatter_of(residual, stated)
        if abs(scatter - before) <= 1e-6 * (scatter + 1e-12):
            break
    return speed_variance, np.maximum(force_variance, 1e-14)


def _resample(data: Points, speed_variance: Floats, force_variance: Floats, resamples: int, seed: int) -> Floats:
    """Fits to trials drawn with replacement within each vine, columns n and ln B; draws without a slope are dropped."""
    random = np.random.default_rng(seed)
    counts = np.zeros((resamples, data.log_force.size))
    for i in range(len(data.names)):
        rows = np.flatnonzero(data.vine == i)
        counts[:, rows] = random.multinomial(rows.size, np.full(rows.size, 1 / rows.size), size=resamples)
    n, log_B = slope(counts, data, speed_variance, force_variance)
    draws = np.column_stack([n, log_B])
    return draws[np.isfinite(draws).all(axis=1) & (n > 0)]


def student_95(dof: int) -> float:
    """Half width of a 95 % interval, in standard errors."""
    return float(stdtrit(dof, 0.975)) if dof > 0 else math.inf


def _r_squared(log_force: Floats, residual: Floats) -> float:
    total = float(np.sum((log_force - log_force.mean()) ** 2))
    return 1 - float(residual @ residual) / total if total > 0 else math.nan


# ------------------------------------------------------------------------------
# Dependence of damping coefficient, steady speed and efficiency on the size of the vine.
#
# B against diameter is described by a power law (a straight line on log axes) and by a straight line; both are
# reported, because neither is known to be right. For the published vines (R = 1…4) the power is 1.80, and the
# straight line has R² = 0.983 and an intercept of −1.7 N·(s/m)ⁿ.
#
# Trends over the conditions of an experiment: steady speed against scale, efficiency against wall and diameter. Each
# size counts once: replicates share a vine, so the means of vines scatter about a trend, and N is their number. Slopes
# are those on log axes with 95 % intervals by Student's t; p is the probability of one as large if there is none.

SAME_WITHIN = 0.02  # Sizes and settings that agree within this fraction count as equal, ratios within twice it (chosen)


def fit_scaling(damping: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """Regress B on diameter for isometric vines, and on thickness for vines of one diameter. Returns `isometric` and
    `thickness`, each a list of families: `along` (`diameter_mm` or `thickness_um`), `vines`, `sizes`, `B`, `power` and
    `line` (see `regress`), and `refused` (None, or why there is no regression).
    """
    vines = damping["both_axes"]["vines"]
    table = pd.DataFrame(
        [{"vine": name, **law} for name, law in vines.items()],
        columns=["vine", "diameter_mm", "thickness_um", "B", "B_95_total"],
    )
    table["wall_over_diameter"] = table["thickness_um"] / table["diameter_mm"]
    isometric = _families(table, "diameter_mm", "wall_over_diameter")
    thickness = _families(table, "thickness_um", "diameter_mm")
    reason = None
    if not isometric and not thickness:
        reason = f"of the vines with a B, {len(vines)}, no two are scaled copies of each other or of equal diameter"
    return {"method": "both_axes", "isometric": isometric, "thickness": thickness, "reason": reason}


def _families(table: pd.DataFrame, along: str, other: str) -> list[dict[str, Any]]:
    """Groups of vines of several sizes that are alike in another, with the dependence of B on the size."""
    ordered = table.dropna(subset=[along, other]).sort_values(other, kind="stable")
    return [
        {"along": along, "sizes": group[along].tolist(), **_values(group, (), ("vine", "B", "B_95_total"))}
        | _lines(group[along].to_numpy(float), group["B"].to_numpy(float), len(group))
        for group in _of_several_sizes(ordered, [other], [along])
    ]


def _values(group: pd.DataFrame, shared: Iterable[str], each: Iterable[str]) -> dict[str, Any]:
    """Columns of a family: values that all rows share, and those of each row."""
    plural = {"vine": "vines", "condition": "conditions"}
    return {name: float(group[name].iloc[0]) for name in shared} | {
        plural.get(name, name): group[name].tolist() for name in each
    }


def _lines(sizes: Floats, values: Floats, count: int) -> dict[str, Any]:
    """A power law and a straight line, or why neither; `count` is the number of sizes, or of vines."""
    if count < 3:
        return {"power": None, "line": None, "refused": f"{count} sizes; an error takes 3"}
    return {"power": regress(np.log(sizes), np.log(values)), "line": regress(sizes, values), "refused": None}


def regress(x: Floats, y: Floats) -> dict[str, Any]:
    """Fit a straight line: slope and intercept with 95 % intervals (Student's t), R², p of the slope. Shapes (n,)."""
    (intercept, slope), (intercept_95, slope_95), (_, p), r_squared = _least_squares([x], y)
    line = {"slope": slope, "slope_95": slope_95, "intercept": intercept, "intercept_95": intercept_95}
    return line | {"R2": r_squared, "p": p, "n": int(x.size)}


def _least_squares(columns: Iterable[Floats], y: Floats) -> tuple[list[float], list[list[float]], list[float], float]:
    """Coefficients of a constant and of columns, their 95 % intervals and p-values by Student's t; and R²."""
    matrix = np.column_stack([np.ones(y.size), *columns])
    coefficients = np.linalg.lstsq(matrix, y, rcond=None)[0]
    residual, dof = y - matrix @ coefficients, y.size - matrix.shape[1]
    errors = np.sqrt(np.diag(np.linalg.inv(matrix.T @ matrix)) * float(residual @ residual) / dof)
    half_widths = student_95(dof) * errors
    intervals = np.column_stack([coefficients - half_widths, coefficients + half_widths])
    p = np.where(errors > 0, 2 * stdtr(dof, -np.abs(coefficients) / np.maximum(errors, 1e-300)), 0.0)
    return coefficients.tolist(), intervals.tolist(), p.tolist(), _r_squared(y, residual)


def fit_trends(conditions: pd.DataFrame) -> dict[str, Any]:
    """Find families of conditions that differ only in size, with the trends of speed and efficiency. `steady_speed` are
    scaled copies without payload at one pressure, with `sizes` (mm), `x_ss_m_s`, `x_ss_over_diameter_1_s`, their
    errors, `power` and `line` of both (see `regress`), `monotonic`, and `refused`.
    """
    return {"steady_speed": _speed_families(conditions), "efficiency": _efficiency_families(conditions)}


def alike(table: pd.DataFrame, columns: Iterable[str]) -> list[pd.DataFrame]:
    """Group rows that agree in all these columns with the group's first row."""
    groups: list[pd.DataFrame] = []
    left = table
    while len(left):
        first = left.iloc[0]
        same = np.ones(len(left), dtype=bool)
        for column in columns:
            within = (2 if column == "wall_over_diameter" else 1) * SAME_WITHIN
            same &= np.isclose(left[column].to_numpy(float), float(first[column]), rtol=within, atol=1e-12)
        groups.append(left[same])
        left = left[~same]
    return groups


def _speed_families(conditions: pd.DataFrame) -> list[dict[str, Any]]:
    bare = conditions[(conditions["payload_g"] == 0) & (conditions["x_ss_m_s"] > 0)]
    bare = bare.assign(wall_over_diameter=1e-3 * bare["thickness_um"] / bare["diameter_mm"])
    bare = bare[np.isfinite(bare["wall_over_diameter"])]
    settings = ["wall_over_diameter", "pressure_kPa", "growth_angle_deg"]
    speeds = ("x_ss_m_s", "x_ss_sigma_m_s", "x_ss_over_diameter_1_s", "x_ss_over_diameter_sigma_1_s", "n_steady")
    families = []
    for group in _of_several_sizes(bare, settings, ["diameter_mm"]):
        sizes, speed, relative = (
            group[name].to_numpy(float) for name in ("diameter_mm", "x_ss_m_s", "x_ss_over_diameter_1_s")
        )
        count = np.unique(sizes).size
        families.append(
            {"along": "diameter_mm", "sizes": sizes.tolist(), "monotonic": bool(np.all(np.diff(speed) > 0))}
            | _values(group, ("pressure_kPa",), ("condition", "vine", *speeds))
            | {"wall_over_diameter": float(group["wall_over_diameter"].mean())}
            | _lines(sizes, speed, count)
            | {"over_diameter": _lines(sizes, relative, count)}
        )
    return families


def _of_several_sizes(table: pd.DataFrame, same: list[str], sizes: list[str]) -> list[pd.DataFrame]:
    """Groups of rows that are alike but for their sizes, in the order of size; the largest group first."""
    groups = [group.sort_values(sizes) for group in alike(table, same)]
    return sorted((group for group in groups if len(group[sizes].drop_duplicates()) > 1), key=lambda group: -len(group))


def _efficiency_families(conditions: pd.DataFrame) -> list[dict[str, Any]]:
    known = conditions[(conditions["efficiency"] > 0) & np.isfinite(conditions["thickness_um"])]
    settings = ["pressure_kPa", "payload_g", "length_mm", "efficiency_at_mm", "growth_angle_deg"]
    efficiencies = ("efficiency", "efficiency_payload", "efficiency_with_weight")
    shared = ("pressure_kPa", "payload_g", "length_mm", "efficiency_at_mm")
    each = ("condition", "vine", "diameter_mm", "thickness_um", "n_efficiency", "weight_share")
    errors = [name for key in efficiencies for name in (key, f"{key}_sigma")]
    families = []
    for group in _of_several_sizes(known, settings, ["diameter_mm", "thickness_um"]):
        sizes = {name: group[name].to_numpy(float) for name in ("thickness_um", "diameter_mm")}
        trend = {key: planes(sizes, group[key].to_numpy(float)) for key in efficiencies}
        families.append({**_values(group, shared, (*each, *errors)), "trend": trend})
    return families


def planes(sizes: Mapping[str, Floats], values: Floats) -> dict[str, Any]:
    """Fit powers of all sizes jointly: ln value = a + Σ pᵢ ln sizeᵢ, by least squares. Sizes that do not vary are left
    out. Where diameter and thickness both vary, each power is the partial one at constant other size, which a
    regression on one of them alone would confound. Returns by size `power, power_95, p`; `R2`, `n`; and `refused`:
    None, or why there is no trend. Shapes: sizes, values (n,).
    """
    known = np.isfinite(values) & (values > 0)
    varying = {name: np.log(size[known]) for name, size in sizes.items() if np.unique(size[known]).size > 1}
    words = " and ".join({"thickness_um": "wall", "diameter_mm": "diameter"}[name] for name in varying)
    n, dof = int(known.sum()), int(known.sum()) - len(varying) - 1
    matrix = np.column_stack([np.ones(n), *varying.values()])
    refused = None
    if n == 0:
        refused = "no condition has such a value above 0"
    elif dof < 1:
        refused = f"{n} conditions are too few for powers of {words} with errors: it takes {len(varying) + 2}"
    elif np.linalg.matrix_rank(matrix) < matrix.shape[1]:
        refused = f"{words} vary together: neither power is identifiable"
    if refused:
        return {"refused": refused, "n": n, "R2": None}
    powers, intervals, p, r_squared = _least_squares(varying.values(), np.log(values[known]))
    of_sizes = zip(varying, powers[1:], intervals[1:], p[1:], strict=True)
    powers_of = {name: {"power": power, "power_95": both, "p": one} for name, power, both, one in of_sizes}
    return {**powers_of, "R2": r_squared, "n": n, "refused": None}
