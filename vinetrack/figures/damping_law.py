"""The damping law: steady force against steady tail speed of every vine, with both fits of F = B·x_ssⁿ.

On log axes the law is a straight line of slope n, the same for all vines. Trials that no fit used are hollow.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from vinetrack.core.numbers import half_width, number, with_error
from vinetrack.figures.style import (
    INK,
    METHOD_LINES,
    METHOD_NAMES,
    MUTED,
    PAPER,
    VineStyle,
    blank,
    look,
    plain_log_ticks,
    vine_styles,
)

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

_TWO_LINE_VINES = 6
_MAX_LEGEND_VINES = 14


def draw_damping_law(points: pd.DataFrame, damping: dict[str, Any]) -> Figure:
    """Draw F against x_ss for every vine.

    Parameters
    ----------
    points : one row a trial with `trial, vine, x_ss_m_s, x_ss_sigma_m_s, force_N, force_sigma_N, used`.
    damping : as in `damping.json`.
    """
    from matplotlib.figure import Figure

    drawable = points[(points["x_ss_m_s"] > 0) & (points["force_N"] > 0)]
    if drawable.empty:
        return blank("No trial has a steady speed and a force above zero, so there is no damping law to draw.")
    styles = vine_styles(points["vine"])
    with look():
        fig = Figure(figsize=(8.6, 5.6), layout="constrained")
        ax = fig.add_subplot()
        ax.set(xscale="log", yscale="log", xlabel="steady tail speed x_ss (m/s)", ylabel="force F = B·x_ssⁿ (N)")
        for vine, group in drawable.groupby("vine", sort=False):
            _draw_points(ax, group, styles[str(vine)])
        for method in METHOD_NAMES:
            fit = damping.get(method) or {}
            for vine, law in (fit.get("vines") or {}).items():
                used = drawable[(drawable["vine"] == vine) & drawable["used"]]
                if len(used):
                    _draw_law(ax, fit, method, vine, law["B"], used["x_ss_m_s"].to_numpy(), styles[vine])
        plain_log_ticks(ax)
        ax.set_title(_title(damping))
        _legend(fig, drawable, damping, styles)
    return fig


def _draw_points(ax: Axes, group: pd.DataFrame, style: VineStyle) -> None:
    for used, rows in group.groupby("used"):
        ax.errorbar(
            rows["x_ss_m_s"],
            rows["force_N"],
            xerr=_below(rows["x_ss_sigma_m_s"], rows["x_ss_m_s"]),
            yerr=_below(rows["force_sigma_N"], rows["force_N"]),
            fmt=style.marker,
            color=style.colour,
            mfc=style.colour if used else PAPER,
            mec=style.colour,
            ms=5,
            mew=1.1,
            elinewidth=0.8,
            alpha=0.85 if used else 0.6,
            zorder=3,
        )


def _below(sigma: pd.Series, value: pd.Series) -> np.ndarray:
    """Two sided 1 σ bars; the lower one stays above zero, which log axes cannot show."""
    bar = np.nan_to_num(sigma.to_numpy(dtype=float))
    return np.vstack([np.minimum(bar, 0.9 * value.to_numpy(dtype=float)), bar])


def _draw_law(
    ax: Axes, fit: dict[str, Any], method: str, vine: str, B: float, x_ss_m_s: np.ndarray, style: VineStyle
) -> None:
    low, high = math.log(x_ss_m_s.min()), math.log(x_ss_m_s.max())
    margin = max(0.06 * (high - low), 0.05)
    x = np.exp(np.linspace(low - margin, high + margin, 60))
    force_N = B * x ** fit["n"]
    ax.plot(x, force_N, color=style.colour, ls=METHOD_LINES[method], lw=1.5, zorder=2)
    sigma = log_force_sigma(fit, vine, x)
    if sigma is not None:
        spread = np.exp(1.96 * sigma)
        ax.fill_between(x, force_N / spread, force_N * spread, color=style.colour, alpha=0.16, lw=0)


def log_force_sigma(fit: dict[str, Any], vine: str, x_ss_m_s: np.ndarray) -> np.ndarray | None:
    """Standard error of ln F = ln B + n ln x_ss along the law of one vine, from the fit's covariance; None without."""
    covariance = fit.get("covariance") or {}
    names, matrix = covariance.get("parameters"), covariance.get("matrix")
    if not names or matrix is None or f"ln B {vine}" not in names:
        return None
    i, j = names.index("n"), names.index(f"ln B {vine}")
    cov = np.asarray(matrix, dtype=float)
    slope = np.log(x_ss_m_s)
    variance = cov[j, j] + 2 * slope * cov[i, j] + slope**2 * cov[i, i]
    return np.sqrt(np.maximum(variance, 0.0)) if np.isfinite(variance).all() else None


def _title(damping: dict[str, Any]) -> str:
    fit = damping.get("both_axes") or {}
    if fit.get("n") is None or fit.get("refused"):
        return "Steady force and speed (no fit: see the report)"
    n = with_error(fit["n"], half_width(fit.get("n_95")))
    return f"One exponent for all vines: n = {n} (95 %)"


def _legend(fig: Figure, points: pd.DataFrame, damping: dict[str, Any], styles: dict[str, VineStyle]) -> None:
    from matplotlib.lines import Line2D

    laws = (damping.get("both_axes") or {}).get("vines") or {}
    handles: list[Line2D] = []
    vines = list(dict.fromkeys(points["vine"]))
    breaks = "\n" if len(vines) <= _TWO_LINE_VINES else ", "
    for vine in vines[:_MAX_LEGEND_VINES]:
        n_used = int(points.loc[points["vine"] == vine, "used"].sum())
        B = f"{breaks}B = {number(laws[vine]['B'])}" if vine in laws else ""
        label = f"{vine}{B}{', ' if B else breaks}N = {n_used}"
        style = styles[vine]
        handles.append(Line2D([], [], color=style.colour, marker=style.marker, ls="none", ms=6, label=label))
    if len(vines) > _MAX_LEGEND_VINES:
        handles.append(Line2D([], [], ls="none", label=f"and {len(vines) - _MAX_LEGEND_VINES} more vines"))
    if not points["used"].all():
        n_left = int((~points["used"].astype(bool)).sum())
        label = f"not in the fit, N = {n_left}"
        handles.append(Line2D([], [], color=MUTED, marker="o", mfc=PAPER, ls="none", ms=6, label=label))
    for method, name in METHOD_NAMES.items():
        if (damping.get(method) or {}).get("vines"):
            handles.append(Line2D([], [], color=INK, ls=METHOD_LINES[method], label=f"{name}\nand its 95 % band"))
    fig.legend(handles=handles, loc="outside right upper", fontsize=9, labelspacing=0.8, borderaxespad=0.8)
