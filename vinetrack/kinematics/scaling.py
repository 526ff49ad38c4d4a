"""How the damping coefficient grows with the size of the vine.

Two descriptions of B against the diameter, both reported because neither is known to be right: a power law
(a straight line on log axes) and a straight line. For the published vines (R = 1…4) the first has a slope of 1.80,
the second R² = 0.983 with an intercept of −1.7 N·(s/m)ⁿ.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from vinetrack.core.records import Floats

ISOMETRIC_WITHIN = 0.05
"""Vines whose t/D agree within this fraction count as scaled copies of each other. Chosen: films are sold to ±5 %."""

SAME_WITHIN = 0.02
"""Vines whose diameters agree within this fraction count as of one diameter. Chosen: well below the
steps between sizes; half and twice were not tried."""

FEWEST_VINES = 3
"""Vines of a regression that states an error. Derived: two fix a line exactly."""


def fit_scaling(damping: Mapping[str, Mapping[str, Any]], method: str = "both_axes") -> dict[str, Any]:
    """B against diameter for isometric vines, and against thickness for vines of one diameter.

    Parameters
    ----------
    damping
        Both fits as `vinetrack.kinematics.damping.fit_damping` returns them.
    method
        Which of them the coefficients are taken from.

    Returns
    -------
    dict
        `isometric` and `thickness`, each a list of families: `along` (`diameter_mm` or `thickness_um`), `vines`,
        `sizes`, `B`, `power` and `line` (see `regress`), and `refused` (None, or why there is no regression). Where
        no vines belong together the list is empty and `reason` says so.
    """
    vines = damping[method]["vines"]
    isometric = _families(vines, "diameter_mm", lambda v: v["thickness_um"] / v["diameter_mm"], ISOMETRIC_WITHIN)
    thickness = _families(vines, "thickness_um", lambda v: v["diameter_mm"], SAME_WITHIN)
    reason = None
    if not isometric and not thickness:
        reason = _nothing(len(vines))
    return {"method": method, "isometric": isometric, "thickness": thickness, "reason": reason}


def _nothing(count: int) -> str:
    if count == 0:
        return "no vine has a damping coefficient"
    if count == 1:
        return "one vine alone has a damping coefficient, and growth with size takes two"
    return f"of {count} vines with a damping coefficient no two are scaled copies of each other or of one diameter"


def _families(vines: Mapping[str, Any], along: str, alike: Any, within: float) -> list[dict[str, Any]]:
    """Groups of two or more vines that are alike but for one size."""
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
    """Straight line by least squares: slope and intercept with 95 % intervals (Student's t), R², p-value of the slope.

    Parameters
    ----------
    x, y : shape (n,), n ≥ 3.

    Returns
    -------
    `slope, slope_95, intercept, intercept_95, R2, p, n`.
    """
    from scipy.stats import linregress, t

    line = linregress(x, y)
    reach = float(t.ppf(0.975, x.size - 2))
    return {
        "slope": float(line.slope),
        "slope_95": [float(line.slope - reach * line.stderr), float(line.slope + reach * line.stderr)],
        "intercept": float(line.intercept),
        "intercept_95": [
            float(line.intercept - reach * line.intercept_stderr),
            float(line.intercept + reach * line.intercept_stderr),
        ],
        "R2": float(line.rvalue**2),
        "p": float(line.pvalue) if math.isfinite(line.pvalue) else math.nan,
        "n": int(x.size),
    }
