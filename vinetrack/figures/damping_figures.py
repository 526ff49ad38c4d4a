"""The damping law: points with both fits of F = B·x_ssⁿ, and the parameters with all their intervals.

On logarithmic axes the law is a straight line of slope n, the same for all vines. Trials not used in a fit
are hollow.
"""

from __future__ import annotations

import math
import textwrap
from typing import TYPE_CHECKING, Any

import numpy as np

from vinetrack.core.units import interval, number, with_interval
from vinetrack.figures.registry import figure
from vinetrack.figures.style import (
    DASHED,
    INK,
    METHOD_COLOURS,
    METHOD_LINES,
    MUTED,
    PAPER,
    VINE_COLOURS,
    VineStyle,
    counted,
    error_points,
    legend_above,
    line_key,
    new_figure,
    note_below,
    plain_log_ticks,
    up_from_zero,
    vine_styles,
)
from vinetrack.narrative.diagnosis_text import METHOD_NAMES

if TYPE_CHECKING:
    from collections.abc import Sequence

    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_TWO_LINE_VINES = 6  # Chosen: a legend with two lines for each of six vines is 2.5 in high, of 5.6 in of figure

_MAX_LEGEND_VINES = 14  # Chosen: with one line each, and those of both methods, they fill the height of the figure


@figure("damping_law", "damping", "Steady force and steady speed", data="damping_points.csv")
def draw_damping_law(points: pd.DataFrame, damping: dict[str, Any]) -> Figure | None:
    """Steady force against steady tail speed of every vine, on logarithmic axes, where F = B·x_ssⁿ is a straight
    line of slope n. Bars are one standard error. Dashed: least squares on logarithms, as in the paper; solid:
    errors on both axes; bands are 95 % confidence bands. Hollow: trials not used in the fit; the table of trials
    states the reason.
    """
    drawable = points[(points["x_ss_m_s"] > 0) & (points["force_N"] > 0)]
    if drawable.empty:
        return None
    styles = vine_styles(points["vine"])
    fig = new_figure(8.6, 5.6)
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
    for used, points in group.groupby("used"):
        ax.errorbar(
            points["x_ss_m_s"],
            points["force_N"],
            xerr=_below(points["x_ss_sigma_m_s"], points["x_ss_m_s"]),
            yerr=_below(points["force_sigma_N"], points["force_N"]),
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


@figure("exponents", "damping", "The exponent and the coefficients, by both methods", data="damping.json")
def draw_exponents(damping: dict[str, Any]) -> Figure | None:
    """The exponent n, one for all vines, and the coefficient B of each, by both methods, with 95 % intervals. Thick
    bars come from a bootstrap of whole trials, or from Student's t if they are too few; thin ones add the stated
    error of the yield pressure.
    """
    fits = {name: fit for name in METHOD_NAMES if (fit := damping.get(name) or {}).get("vines")}
    if not fits:
        return None
    best = {vine: law for fit in fits.values() for vine, law in fit["vines"].items()}
    vines = sorted(best, key=lambda vine: (best[vine]["diameter_mm"], best[vine]["thickness_um"], vine))[:_MAX_VINES]
    fig = new_figure(9.4, 1.9 + max(0.5 * len(vines), 1.2))
    left, right = fig.subplots(1, 2, width_ratios=(1, 1.35))
    for method, fit in fits.items():
        n = with_interval(fit["n"], fit.get("n_95"))
        label = f"{METHOD_NAMES[method]}: n = {n}"
        _draw_estimate(left, method, 0, fit["n"], fit.get("n_95"), fit.get("n_95_total"), label)
        for i, vine in enumerate(vines):
            if law := fit["vines"].get(vine):
                _draw_estimate(right, method, i, *(_deviation(law.get(key), best[vine]["B"]) for key in _B_KEYS))
    _finish_exponents(left, right, {vine: best[vine] for vine in vines})
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


# ------------------------------------------------------------------------------
# Damping, steady speed, efficiency and final speed against the size and the load of the vine.
#
# Both straight lines and power laws are drawn, because neither is known to be right.

_LABELS = {"diameter_mm": "diameter (mm)", "thickness_um": "wall thickness (µm)"}
_TITLES = {"isometric": "Scaled copies (one t/D)", "thickness": "One diameter"}
_MAX_SCALING_FAMILIES = 4  # Chosen: four families have twelve lines of legend above the axes


@figure("scaling", "damping", "Damping against size", data="scaling.json")
def draw_scaling(scaling: dict[str, Any], published: dict[str, Any] | None = None, note: str = "") -> Figure | None:
    """B of each vine against its size, on logarithmic axes: against diameter for vines that are scaled copies of
    each other, against wall thickness for vines of one diameter. Solid: power law; dashed: straight line.
    """
    kinds = [kind for kind in _TITLES if scaling.get(kind)]
    if not kinds:
        return None
    fig = new_figure(6.6 if len(kinds) == 1 else 11.0, 5.2)
    for ax, kind in zip(fig.subplots(1, len(kinds), squeeze=False)[0], kinds, strict=True):
        families = scaling[kind][:_MAX_SCALING_FAMILIES]
        ax.set(xscale="log", yscale="log", xlabel=_LABELS[families[0]["along"]], ylabel="B (N·(s/m)ⁿ)")
        for i, family in enumerate(families):
            _draw_B_family(ax, family, i)
        _draw_published_B(ax, families, published)
        _finish_scaling(ax, families)
        left_out = len(scaling[kind]) - len(families)
        title = _TITLES[kind] + (f", {left_out} more families in scaling.json" if left_out else "")
        legend_above(ax, n_columns=1, title=title, alignment="left")
    note_below(fig, note)
    return fig


def _draw_B_family(ax: Axes, family: dict[str, Any], index: int) -> None:
    colour = VINE_COLOURS[index]
    sizes, B = np.array(family["sizes"], dtype=float), np.array(family["B"], dtype=float)
    low, high = np.array(family["B_95"], dtype=float).T
    errors = np.vstack([B - low, high - B]).clip(min=0)
    refused = f"\nno line: {family['refused']}" if family.get("refused") else ""
    label = f"B with 95 % interval, N = {B.size} vines{refused}"
    error_points(ax, sizes, B, errors, index, label, elinewidth=1.3, zorder=3)
    span = np.geomspace(sizes.min() / 1.15, sizes.max() * 1.15, 100)
    if power := family["power"]:
        label = f"power law, slope {number(power['slope'])} ({interval(power['slope_95'])}), R² {number(power['R2'])}"
        ax.plot(span, np.exp(power["intercept"]) * span ** power["slope"], color=colour, lw=1.5, label=label)
    if line := family["line"]:
        straight = line["intercept"] + line["slope"] * span
        drawn = straight > 0.5 * B.min()
        label = f"straight line, intercept {number(line['intercept'])}, R² {number(line['R2'])}"
        ax.plot(span[drawn], straight[drawn], color=colour, lw=1.3, ls=DASHED, label=label)


def _draw_published_B(ax: Axes, families: list[dict[str, Any]], published: dict[str, Any] | None) -> None:
    given = (published or {}).get("B", {})
    pairs = [
        (size, given[vine])
        for family in families
        for vine, size in zip(family["vines"], family["sizes"], strict=True)
        if vine in given
    ]
    if published and pairs:
        x, B = zip(*pairs, strict=True)
        ax.plot(x, B, "D", mfc="none", mec=MUTED, ms=11, mew=1.3, label=published["source"])


def _finish_scaling(ax: Axes, families: list[dict[str, Any]]) -> None:
    sizes = sorted({size for family in families for size in family["sizes"]})
    ax.set_xlim(sizes[0] / 1.3, sizes[-1] * 1.3)
    plain_log_ticks(ax)
    if len(sizes) <= 8:
        ax.set_xticks(sizes)


_MAX_SPEED_FAMILIES = 5  # Chosen: each pressure has three lines of legend above the axes
_SPEED_PANELS = (
    ("x_ss_m_s", "x_ss_sigma_m_s", "steady tail speed x_ss (m/s)", "Speed"),
    ("x_ss_over_diameter_1_s", "x_ss_over_diameter_sigma_1_s", "x_ss / diameter (1/s)", "Speed over diameter"),
)


@figure("speed_scaling", "damping", "Steady speed against size", data="conditions.csv")
def draw_speed_scaling(scaling: dict[str, Any], note: str = "") -> Figure | None:
    """Steady tail speed of scaled copies (one t/D) at one pressure without payload, against diameter, and the same
    divided by the diameter. Points are means over a vine's steady trials with their standard errors (that of a
    single trial does not include replicate scatter); straight lines (full) and power laws (dashed) are fitted to
    the means of vines, so N is the number of vines, and p is the probability of a slope at least as large if there
    is none. Pressures that agree within 1 % count as one.
    """
    families = scaling.get("steady_speed") or []
    if not families:
        return None
    fig = new_figure(11.0, 5.2 + 0.45 * min(len(families), _MAX_SPEED_FAMILIES))
    for ax, (key, sigma, label, title) in zip(fig.subplots(1, 2), _SPEED_PANELS, strict=True):
        for i, family in enumerate(families[:_MAX_SPEED_FAMILIES]):
            lines = family if key == "x_ss_m_s" else family["over_diameter"]
            _draw_speed_family(ax, family, key, sigma, lines, i)
        ax.set(xlabel="diameter (mm)", ylabel=label)
        up_from_zero(ax, x=True)
        left_out = len(families) - _MAX_SPEED_FAMILIES
        more = f", {left_out} more pressures in scaling.json" if left_out > 0 else ""
        legend_above(ax, n_columns=1, title=title + more, alignment="left", fontsize=9)
    note_below(fig, " ".join(filter(None, [note, _single_trial_note(families[:_MAX_SPEED_FAMILIES])])))
    return fig


def _draw_speed_family(
    ax: Axes, family: dict[str, Any], key: str, sigma: str, lines: dict[str, Any], index: int
) -> None:
    colour = VINE_COLOURS[index % len(VINE_COLOURS)]
    sizes, values, errors = (np.array(family[name], dtype=float) for name in ("sizes", key, sigma))
    counts = [int(count) for count in family["n_steady"]]
    trials = counted(min(counts), max(counts), "trial")
    label = f"{family['pressure_kPa']:.4g} kPa, N = {counted(sizes.size, sizes.size, 'vine')} of {trials}"
    error_points(ax, sizes, values, errors, index, f"{label}{_trend_text(lines)}", elinewidth=1.3)
    span = np.linspace(0.8 * sizes.min(), 1.1 * sizes.max(), 100)
    if line := lines["line"]:
        ax.plot(span, line["intercept"] + line["slope"] * span, color=colour, lw=1.5)
    if power := lines["power"]:
        curve = np.exp(power["intercept"]) * span ** power["slope"]
        ax.plot(span, curve, color=colour, lw=1.3, ls=DASHED)


def _trend_text(lines: dict[str, Any]) -> str:
    if lines["refused"]:
        return f"\nno trend: {lines['refused']}"
    line, power = lines["line"], lines["power"]
    slope = f"{number(power['slope'], 2)} ({interval(power['slope_95'])}), p = {number(power['p'], 2)}"
    return f"\npower (dashed) {slope}\nline (full): R² {number(line['R2'])}, p = {number(line['p'], 2)}"


def _single_trial_note(families: list[dict[str, Any]]) -> str:
    if not any(count == 1 for family in families for count in family["n_steady"]):
        return ""
    return "The error bar of a single trial does not include replicate scatter."


_EFFICIENCIES = {
    "efficiency": "½ m(x) ẋ² / (P₀ A y)",
    "efficiency_payload": "payload's motion alone",
    "efficiency_with_weight": "work of the weight in the denominator",
}
_SIZE_AXES = {"thickness_um": ("wall thickness (µm)", "wall"), "diameter_mm": ("diameter (mm)", "diameter")}
_SIZE_UNITS = {"thickness_um": "µm", "diameter_mm": "mm"}


@figure("efficiency", "damping", "Energy efficiency", data="conditions.csv")
def draw_efficiency(scaling: dict[str, Any], note: str = "") -> Figure | None:
    """Energy efficiency against wall thickness and diameter at one pressure, payload, length and growth: kinetic
    energy of all moving mass divided by the work of the gas P₀Ay; of the payload alone; and with the work of the
    weight added to the denominator. Points are means with standard errors; the powers of wall and diameter are
    fitted together, on logarithms, so that each is that of one size with the other held constant.
    """
    families = scaling.get("efficiency") or []
    if not families:
        return None
    family = families[0]
    along = [name for name in _SIZE_AXES if len(set(family[name])) > 1]
    shown = [key for key in _EFFICIENCIES if np.any(np.array(family[key], dtype=float) > 0)]
    fig = new_figure(0.9 + 3.6 * len(shown), 1.0 + 3.5 * len(along))
    axes = fig.subplots(len(along), len(shown), squeeze=False, sharey=True)
    for row, x in enumerate(along):
        for ax, key in zip(axes[row], shown, strict=True):
            _draw_efficiency(ax, family, key, x)
            ax.set_xlabel(_SIZE_AXES[x][0])
            if row == 0:
                ax.set_title(_EFFICIENCIES[key], fontsize=10.5)
        axes[row][0].set(ylabel="energy efficiency (%)", ylim=(0, 1.08 * max(ax.dataLim.y1 for ax in axes[row])))
        axes[row][-1].legend(loc="upper left", bbox_to_anchor=(1.02, 1.0), borderaxespad=0.0, fontsize=9)
    fig.suptitle(_efficiency_title(family, len(families)), fontsize=11, x=0.01, ha="left")
    note_below(fig, note)
    return fig


def _draw_efficiency(ax: Axes, family: dict[str, Any], key: str, x: str) -> None:
    other = next(name for name in _SIZE_AXES if name != x)
    sizes, others, values, errors = (np.array(family[name], dtype=float) for name in (x, other, key, f"{key}_sigma"))
    for i, size in enumerate(np.unique(others)):
        chosen = np.flatnonzero(others == size)
        chosen = chosen[np.argsort(sizes[chosen])]
        label = f"{size:.4g} {_SIZE_UNITS[other]}"
        error_points(ax, sizes[chosen], 100 * values[chosen], 100 * errors[chosen], i, label, ls="-", ms=5.5, lw=1.2)
    ax.set_xlim(0, 1.12 * sizes.max())
    ax.text(0.03, 0.03, _power_text(family["trend"][key], x), transform=ax.transAxes, fontsize=8.5, color=MUTED)


def _power_text(trend: dict[str, Any], x: str) -> str:
    if trend.get("refused"):
        return f"no trend: {textwrap.fill(str(trend['refused']), 30)}"
    if x not in trend:
        return ""
    power = trend[x]
    spread, p = interval(power["power_95"]), number(power["p"], 2)
    return f"power of the {_SIZE_AXES[x][1]} {number(power['power'], 2)}\n({spread}), p = {p}"


def _efficiency_title(family: dict[str, Any], n_families: int) -> str:
    counts = [int(count) for count in family["n_efficiency"]]
    error = ", ± standard error" if max(counts) > 1 else ""
    load = f" with {family['payload_g']:.4g} g" if family["payload_g"] else " without payload"
    left = n_families - 1
    more = f"; {left} more {'family' if left == 1 else 'families'} in scaling.json" if left else ""
    return (
        f"{family['pressure_kPa']:.4g} kPa{load}, after {family['efficiency_at_mm']:.4g} mm of growth; "
        f"N = {counted(min(counts), max(counts), 'trial')} per point{error}{more}"
    )
