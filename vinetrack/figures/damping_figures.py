"""The damping law: points with both fits of F = B·x_ssⁿ, and the parameters with all their intervals.

On logarithmic axes the law is a straight line of slope n, the same for all vines. Trials not used in a fit
are hollow.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from vinetrack.core.numbers import number, with_interval
from vinetrack.figures.panels import legend_above, line_key, plain_log_ticks
from vinetrack.figures.style import INK, METHOD_COLOURS, METHOD_LINES, MUTED, PAPER, VineStyle, blank, look, vine_styles
from vinetrack.narrative.law_text import METHOD_NAMES

if TYPE_CHECKING:
    from collections.abc import Sequence

    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_TWO_LINE_VINES = 6  # Chosen: a legend with two lines for each of six vines is 2.5 in high, of 5.6 in of figure

_MAX_LEGEND_VINES = 14  # Chosen: with one line each, and those of both methods, they fill the height of the figure


def draw_damping_law(points: pd.DataFrame, damping: dict[str, Any]) -> Figure:
    """Draw F against x_ss for every vine."""
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
        ax.set_title(_law_title(damping))
        _law_legend(fig, drawable, damping, styles)
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
    """Error bars of one standard error; the lower one ends above zero, which logarithmic axes cannot show."""
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
        factor = np.exp(1.96 * sigma)
        ax.fill_between(x, force_N / factor, force_N * factor, color=style.colour, alpha=0.16, lw=0)


def log_force_sigma(fit: dict[str, Any], vine: str, x_ss_m_s: np.ndarray) -> np.ndarray | None:
    """Return the standard error of ln F = ln B + n·ln x_ss along the law of one vine. With the covariance C of (ln B,
    n): var ln F = C_BB + 2·ln x_ss·C_Bn + (ln x_ss)²·C_nn. Shapes: x_ss_m_s (n_points,) → (n_points,).
    """
    covariance = fit.get("covariance") or {}
    names, matrix = covariance.get("parameters"), covariance.get("matrix")
    if not names or matrix is None or f"ln B {vine}" not in names:
        return None
    i, j = names.index("n"), names.index(f"ln B {vine}")
    cov = np.asarray(matrix, dtype=float)
    slope = np.log(x_ss_m_s)
    variance = cov[j, j] + 2 * slope * cov[i, j] + slope**2 * cov[i, i]
    return np.sqrt(np.maximum(variance, 0.0)) if np.isfinite(variance).all() else None


def _law_title(damping: dict[str, Any]) -> str:
    fit = damping.get("both_axes") or {}
    if fit.get("n") is None or fit.get("refused"):
        return "Steady force and speed (no fit: see the report)"
    n = with_interval(fit["n"], fit.get("n_95"))
    return f"One exponent for all vines: n = {n}"


def _law_legend(fig: Figure, points: pd.DataFrame, damping: dict[str, Any], styles: dict[str, VineStyle]) -> None:
    laws = (damping.get("both_axes") or {}).get("vines") or {}
    handles = []
    vines = list(dict.fromkeys(points["vine"]))
    breaks = "\n" if len(vines) <= _TWO_LINE_VINES else ", "
    for vine in vines[:_MAX_LEGEND_VINES]:
        n_used = int(points.loc[points["vine"] == vine, "used"].sum())
        B = f"{breaks}B = {number(laws[vine]['B'])}" if vine in laws else ""
        label = f"{vine}{B}{', ' if B else breaks}N = {n_used}"
        style = styles[vine]
        handles.append(line_key(label, color=style.colour, marker=style.marker, ls="none", ms=6))
    if len(vines) > _MAX_LEGEND_VINES:
        handles.append(line_key(f"and {len(vines) - _MAX_LEGEND_VINES} more vines", ls="none"))
    if not points["used"].all():
        n_left = int((~points["used"].astype(bool)).sum())
        label = f"not in the fit, N = {n_left}"
        handles.append(line_key(label, color=MUTED, marker="o", mfc=PAPER, ls="none", ms=6))
    for method, name in METHOD_NAMES.items():
        if (damping.get(method) or {}).get("vines"):
            handles.append(line_key(f"{name}\nand its 95 % band", color=INK, ls=METHOD_LINES[method]))
    fig.legend(handles=handles, loc="outside right upper", fontsize=9, labelspacing=0.8, borderaxespad=0.8)


_B_KEYS = ("B", "B_95", "B_95_total")
_OFFSETS = {"log_log": -0.17, "both_axes": 0.17}
_MAX_VINES = 40  # Chosen: at half an inch per vine, 40 make a figure of 22 in, the longest that a page shows whole


def draw_exponents(damping: dict[str, Any], published: dict[str, Any] | None = None) -> Figure:
    """Draw n and B with their 95 % intervals, B as deviation from its best estimate. Thick bars come from a bootstrap
    of whole trials, or from Student's t if they are too few; thin ones add the stated error of the yield pressure,
    which all trials of a vine share and a bootstrap cannot show.
    """
    from matplotlib.figure import Figure

    fits = {name: fit for name in METHOD_NAMES if (fit := damping.get(name) or {}).get("vines")}
    if not fits:
        return blank("No damping law could be fitted, so there is no exponent to show.")
    best = {vine: law for fit in fits.values() for vine, law in fit["vines"].items()}
    vines = sorted(best, key=lambda vine: (best[vine]["diameter_mm"], best[vine]["thickness_um"], vine))[:_MAX_VINES]
    with look():
        fig = Figure(figsize=(9.4, 1.9 + max(0.5 * len(vines), 1.2)), layout="constrained")
        left, right = fig.subplots(1, 2, width_ratios=(1, 1.35))
        for method, fit in fits.items():
            n = with_interval(fit["n"], fit.get("n_95"))
            label = f"{METHOD_NAMES[method]}: n = {n}"
            _draw_estimate(left, method, 0, fit["n"], fit.get("n_95"), fit.get("n_95_total"), label)
            for i, vine in enumerate(vines):
                if law := fit["vines"].get(vine):
                    _draw_estimate(right, method, i, *(_deviation(law.get(key), best[vine]["B"]) for key in _B_KEYS))
        _finish_exponents(left, right, {vine: best[vine] for vine in vines})
        _draw_published_law(left, right, vines, best, published)
        legend_above(left, n_columns=1)
    return fig


def _deviation(value: Any, best_B: float) -> Any:
    """B, or its interval, as deviation from the best estimate in per cent; None remains None."""
    if value is None:
        return None
    if isinstance(value, list | tuple):
        return [None if bound is None else 100 * (bound / best_B - 1) for bound in value]
    return 100 * (value / best_B - 1)


def _draw_estimate(
    ax: Axes,
    method: str,
    row: float,
    value: float,
    resampled: Sequence[float] | None,
    total: Sequence[float] | None,
    label: str | None = None,
) -> None:
    y, colour = row + _OFFSETS[method], METHOD_COLOURS[method]
    for bounds, width in ((total, 1.3), (resampled, 4.0)):
        if bounds is not None and None not in bounds:
            ax.plot(bounds, (y, y), color=colour, lw=width, solid_capstyle="butt", alpha=0.75)
    marker = "s" if method == "log_log" else "o"
    ax.plot([value], [y], marker, color=colour, ms=7, mec="white", mew=0.9, label=label)


def _finish_exponents(left: Axes, right: Axes, best: dict[str, dict[str, Any]]) -> None:
    left.set(ylim=(0.75, -0.75), yticks=[], xlabel="exponent n")
    left.spines["left"].set_visible(False)
    right.set(ylim=(len(best) - 0.45, -0.55), xlabel="B, deviation from the value at the left (%)")
    labels = [
        f"{vine}\nB = {with_interval(law['B'], law.get('B_95')).partition(' (')[0]}, N = {law['n_trials']}"
        for vine, law in best.items()
    ]
    right.set_yticks(range(len(best)), labels, fontsize=9)
    right.tick_params(axis="y", length=0)
    right.grid(axis="y", visible=False)
    title = "thick: 95 %, from the scatter of trials; thin: with\nthe yield pressure's stated error; B in N·(s/m)ⁿ"
    right.set_title(title, fontsize=9, fontweight="normal")
    left.locator_params(axis="x", nbins=5)


def _draw_published_law(
    left: Axes, right: Axes, vines: list[str], best: dict[str, dict[str, Any]], published: dict[str, Any] | None
) -> None:
    if not published:
        return
    line: dict[str, Any] = {"color": MUTED, "ls": (0, (3, 2)), "lw": 1.3, "zorder": 1}
    left.axvline(published["n"], label=f"{published['source']}: n = {published['n']}", **line)
    for i, vine in enumerate(vines):
        if vine in published["B"]:
            deviation = _deviation(published["B"][vine], best[vine]["B"])
            right.plot([deviation, deviation], [i - 0.4, i + 0.4], **line)
