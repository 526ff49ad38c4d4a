"""Dependence of damping coefficient, steady speed and efficiency on the size of the vine.

B against diameter is described by a power law (a straight line on log axes) and by a straight line; both are reported,
because neither is known to be right. For the published vines (R = 1…4) the power is 1.80, and the straight line has R²
= 0.983 and an intercept of −1.7 N·(s/m)ⁿ.

Trends over the conditions of an experiment: steady speed against scale, efficiency against wall and diameter. Each size
counts once: replicates share a vine, so the means of vines scatter about a trend, and N is their number. Slopes are
those on log axes with 95 % intervals by Student's t; a p-value is the probability of a slope at least as large if there
is none.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from vinetrack.core.records import Floats

if TYPE_CHECKING:
    import pandas as pd

ISOMETRIC_WITHIN = 0.05  # Vines whose t/D agree within this fraction count as scaled copies of each other (chosen)

SAME_WITHIN = 0.02  # Vines whose diameters agree within this fraction count as equal in diameter (chosen)

FEWEST_VINES = 3  # Fewest vines of a regression with an error (derived)


def fit_scaling(damping: Mapping[str, Mapping[str, Any]], method: str = "both_axes") -> dict[str, Any]:
    """Regress B on diameter for isometric vines, and on thickness for vines of one diameter. Returns `isometric` and
    `thickness`, each a list of families: `along` (`diameter_mm` or `thickness_um`), `vines`, `sizes`, `B`, `power` and
    `line` (see `regress`), and `refused` (None, or why there is no regression).
    """
    vines = damping[method]["vines"]
    isometric = _families(vines, "diameter_mm", lambda v: v["thickness_um"] / v["diameter_mm"], ISOMETRIC_WITHIN)
    thickness = _families(vines, "thickness_um", lambda v: v["diameter_mm"], SAME_WITHIN)
    reason = None
    if not isometric and not thickness:
        reason = _why_no_family(len(vines))
    return {"method": method, "isometric": isometric, "thickness": thickness, "reason": reason}


def _why_no_family(count: int) -> str:
    if count == 0:
        return "no vine has a damping coefficient"
    if count == 1:
        return "only one vine has a damping coefficient, and a dependence on size needs two"
    return f"of {count} vines with a damping coefficient no two are scaled copies of each other or of equal diameter"


def _families(vines: Mapping[str, Any], along: str, alike: Any, within: float) -> list[dict[str, Any]]:
    """Groups of two or more vines that differ only in one size."""
    families = []
    remaining = sorted(vines, key=lambda name: alike(vines[name]))
    while remaining:
        first = alike(vines[remaining[0]])
        group = [name for name in remaining if alike(vines[name]) <= first * (1 + within)]
        remaining = [name for name in remaining if name not in group]
        group.sort(key=lambda name: vines[name][along])
        sizes = np.array([vines[name][along] for name in group], dtype=float)
        if len(np.unique(np.round(sizes, 6))) > 1:
            families.append(_family(group, sizes, vines, along))
    return families


def _family(group: list[str], sizes: Floats, vines: Mapping[str, Any], along: str) -> dict[str, Any]:
    B = np.array([vines[name]["B"] for name in group])
    low, high = np.array([vines[name]["B_95"] for name in group], dtype=float).T
    family: dict[str, Any] = {
        "along": along,
        "vines": group,
        "sizes": sizes.tolist(),
        "B": B.tolist(),
        "B_95": np.column_stack([low, high]).tolist(),
        "power": None,
        "line": None,
        "refused": None,
    }
    if len(group) < FEWEST_VINES:
        family["refused"] = f"{len(group)} vines; a regression with an error needs at least {FEWEST_VINES}"
        return family
    family["power"] = regress(np.log(sizes), np.log(B))
    family["line"] = regress(sizes, B)
    return family


def regress(x: Floats, y: Floats) -> dict[str, Any]:
    """Fit a straight line: slope and intercept with 95 % intervals (Student's t), R², p-value of the slope. Returns
    `slope, slope_95, intercept, intercept_95, R2, p, n`. Shapes: x, y (n,).
    """
    from scipy.stats import linregress, t

    line = linregress(x, y)
    quantile = float(t.ppf(0.975, x.size - 2))
    return {
        "slope": float(line.slope),
        "slope_95": [float(line.slope - quantile * line.stderr), float(line.slope + quantile * line.stderr)],
        "intercept": float(line.intercept),
        "intercept_95": [
            float(line.intercept - quantile * line.intercept_stderr),
            float(line.intercept + quantile * line.intercept_stderr),
        ],
        "R2": float(line.rvalue**2),
        "p": float(line.pvalue) if math.isfinite(line.pvalue) else math.nan,
        "n": int(x.size),
    }


SAME_SETTING_WITHIN = 0.01  # Pressures and payloads that agree within this fraction count as equal (chosen)

SIZES = {"thickness_um": "wall", "diameter_mm": "diameter"}
EFFICIENCIES = ("efficiency", "efficiency_payload", "efficiency_with_weight")


def fit_trends(conditions: pd.DataFrame) -> dict[str, Any]:
    """Find families of conditions that differ only in size, and the trends of speed and efficiency with size. Returns
    `steady_speed`: scaled copies without payload at one pressure, each family with `sizes` (mm), `x_ss_m_s`,
    `x_ss_over_diameter_1_s`, their errors, `power` and `line` of both (see `scaling.regress`; those of the second in
    `over_diameter`), `monotonic`, and `refused`.
    """
    return {"steady_speed": _speed_families(conditions), "efficiency": _efficiency_families(conditions)}


def alike(table: pd.DataFrame, within: Mapping[str, float]) -> list[pd.DataFrame]:
    """Group rows that agree in all given columns within a fraction of the group's first row."""
    groups: list[pd.DataFrame] = []
    left = table
    while len(left):
        first = left.iloc[0]
        same = np.ones(len(left), dtype=bool)
        for column, fraction in within.items():
            values = left[column].to_numpy(float)
            same &= np.abs(values - first[column]) <= fraction * abs(float(first[column])) + 1e-12
        groups.append(left[same])
        left = left[~same]
    return groups


def _speed_families(conditions: pd.DataFrame) -> list[dict[str, Any]]:
    bare = conditions[(conditions["payload_g"] == 0) & (conditions["x_ss_m_s"] > 0)]
    bare = bare.assign(wall_over_diameter=1e-3 * bare["thickness_um"] / bare["diameter_mm"])
    bare = bare[np.isfinite(bare["wall_over_diameter"])]
    settings = {
        "wall_over_diameter": ISOMETRIC_WITHIN,
        "pressure_kPa": SAME_SETTING_WITHIN,
        "growth_angle_deg": SAME_SETTING_WITHIN,
    }
    groups = [group.sort_values("diameter_mm") for group in alike(bare, settings)]
    families = [_speed_family(group) for group in groups if np.unique(group["diameter_mm"]).size > 1]
    return sorted(families, key=lambda family: -len(family["sizes"]))


def _speed_family(group: pd.DataFrame) -> dict[str, Any]:
    columns = ("x_ss_m_s", "x_ss_sigma_m_s", "x_ss_over_diameter_1_s", "x_ss_over_diameter_sigma_1_s", "n_steady")
    sizes, speeds, relative = (
        group[name].to_numpy(float) for name in ("diameter_mm", "x_ss_m_s", "x_ss_over_diameter_1_s")
    )
    return {
        "along": "diameter_mm",
        "pressure_kPa": float(group["pressure_kPa"].iloc[0]),
        "wall_over_diameter": float(group["wall_over_diameter"].mean()),
        "conditions": group["condition"].tolist(),
        "vines": group["vine"].tolist(),
        "sizes": sizes.tolist(),
        **{name: group[name].tolist() for name in columns},
        "monotonic": bool(np.all(np.diff(speeds) > 0)),
        **_lines(sizes, speeds),
        "over_diameter": _lines(sizes, relative),
    }


def _lines(sizes: Floats, values: Floats) -> dict[str, Any]:
    """A power law and a straight line, or why neither."""
    if np.unique(sizes).size < FEWEST_VINES:
        return {"power": None, "line": None, "refused": f"{np.unique(sizes).size} sizes; it takes {FEWEST_VINES}"}
    return {"power": regress(np.log(sizes), np.log(values)), "line": regress(sizes, values), "refused": None}


def _efficiency_families(conditions: pd.DataFrame) -> list[dict[str, Any]]:
    known = conditions[(conditions["efficiency"] > 0) & np.isfinite(conditions["thickness_um"])]
    settings = {
        "pressure_kPa": SAME_SETTING_WITHIN,
        "payload_g": SAME_SETTING_WITHIN,
        "length_mm": SAME_WITHIN,
        "efficiency_at_mm": 0.0,
        "growth_angle_deg": SAME_SETTING_WITHIN,
    }
    groups = [group.sort_values(["diameter_mm", "thickness_um"]) for group in alike(known, settings)]
    several = [group for group in groups if len(group[["diameter_mm", "thickness_um"]].drop_duplicates()) > 1]
    families = [_efficiency_family(group) for group in several]
    return sorted(families, key=lambda family: -len(family["conditions"]))


def _efficiency_family(group: pd.DataFrame) -> dict[str, Any]:
    fixed = ("pressure_kPa", "payload_g", "length_mm", "efficiency_at_mm")
    each = ("diameter_mm", "thickness_um", "n_efficiency", "weight_share")
    values = (name for key in EFFICIENCIES for name in (key, f"{key}_sigma"))
    sizes = {name: group[name].to_numpy(float) for name in ("thickness_um", "diameter_mm")}
    return {
        **{name: float(group[name].iloc[0]) for name in fixed},
        "conditions": group["condition"].tolist(),
        "vines": group["vine"].tolist(),
        **{name: group[name].tolist() for name in (*each, *values)},
        "trend": {key: planes(sizes, group[key].to_numpy(float)) for key in EFFICIENCIES},
    }


def planes(sizes: Mapping[str, Floats], values: Floats) -> dict[str, Any]:
    """Fit powers of all sizes jointly: ln value = a + Σ pᵢ ln sizeᵢ, by least squares. Sizes that do not vary are left
    out. Where diameter and thickness both vary, each power is the partial one at constant other size, which a
    regression on one of them alone would confound. Returns by size `power, power_95, p`; `R2`, `n`; and `refused`:
    None, or why there is no trend. Shapes: sizes, values (n,).
    """
    from scipy.stats import t

    known = np.isfinite(values) & (values > 0)
    varying = {name: np.log(size[known]) for name, size in sizes.items() if np.unique(size[known]).size > 1}
    n, dof = int(known.sum()), int(known.sum()) - len(varying) - 1
    if not varying or dof < 1:
        return {"refused": _too_few(n, list(varying)), "n": n, "R2": None}
    matrix = np.column_stack([np.ones(n), *varying.values()])
    if np.linalg.matrix_rank(matrix) < matrix.shape[1]:
        return {
            "refused": f"{' and '.join(SIZES[name] for name in varying)} vary together: neither power is identifiable",
            "n": n,
            "R2": None,
        }
    y = np.log(values[known])
    coefficients = np.linalg.lstsq(matrix, y, rcond=None)[0]
    residual = y - matrix @ coefficients
    errors = np.sqrt(np.diag(np.linalg.inv(matrix.T @ matrix)) * float(residual @ residual) / dof)
    quantile = float(t.ppf(0.975, dof))
    total = float(np.sum((y - y.mean()) ** 2))
    return {
        **{name: _power(coefficients[i + 1], errors[i + 1], quantile, dof) for i, name in enumerate(varying)},
        "R2": 1 - float(residual @ residual) / total if total > 0 else math.nan,
        "n": n,
        "refused": None,
    }


def _too_few(n: int, varying: Sequence[str]) -> str:
    if n == 0:
        return "no condition has such a value above 0"
    if not varying:
        return "all vines are of one size"
    powers = "a power of " + " and one of ".join(SIZES[name] for name in varying)
    return f"{n} conditions; {powers} with an error take{'s' if len(varying) == 1 else ''} {len(varying) + 2}"


def _power(value: float, error: float, quantile: float, dof: int) -> dict[str, float | Sequence[float]]:
    from scipy.stats import t

    p = 2 * float(t.sf(abs(value) / error, dof)) if error > 0 else 0.0
    return {
        "power": float(value),
        "power_95": [float(value - quantile * error), float(value + quantile * error)],
        "p": p,
    }
