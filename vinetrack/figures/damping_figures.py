"""The damping law: points with both fits of F = B·x_ssⁿ, what depends on the size of the vine, and figures of the paper
redrawn, with the consequences of terms neglected in Eq. (2).

On logarithmic axes the law is a straight line of slope n, the same for all vines. Against sizes both straight lines and
power laws are drawn, because neither is known to be right.
"""

from __future__ import annotations

import math
import textwrap
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from vinetrack.core.units import interval, number, pressure_text, with_interval
from vinetrack.figures import style as st
from vinetrack.figures.registry import figure
from vinetrack.kinematics.damping import student_95
from vinetrack.narrative.diagnosis_text import METHOD_NAMES
from vinetrack.paper import motions as published

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from numpy.typing import ArrayLike

_METHOD_LINES = {"log_log": st.DASHED, "both_axes": "-"}


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
    styles = st.vine_styles(points["vine"])
    fig, ax = st.one_panel(8.6, 5.6, xscale="log", yscale="log")
    ax.set(xlabel="steady tail speed x_ss (m/s)", ylabel="force F = B·x_ssⁿ (N)")
    for vine, group in drawable.groupby("vine", sort=False):
        style = styles[str(vine)]
        for used, part in group.groupby("used"):
            x, y = st.column(part, "x_ss_m_s"), st.column(part, "force_N")
            x_sigma, y_sigma = (np.nan_to_num(st.column(part, name)) for name in ("x_ss_sigma_m_s", "force_sigma_N"))
            # The lower bar ends above zero, which logarithmic axes cannot show.
            ax.errorbar(
                x, y, xerr=[np.minimum(x_sigma, 0.9 * x), x_sigma], yerr=[np.minimum(y_sigma, 0.9 * y), y_sigma],
                fmt=style.marker, color=style.colour, mfc=style.colour if used else st.PAPER, ms=5, mew=1.1,
                elinewidth=0.8, alpha=0.85 if used else 0.6, zorder=3,
            )  # fmt: skip
    for method in METHOD_NAMES:
        for vine, law in damping[method]["vines"].items():
            used = drawable[(drawable["vine"] == vine) & drawable["used"]]
            if len(used):
                x_ss_m_s = st.column(used, "x_ss_m_s")
                _draw_law(ax, damping[method], vine, law["B"], x_ss_m_s, styles[vine].colour, method)
    st.plain_log_ticks(ax)
    fit = damping["both_axes"]
    n = "" if fit["refused"] else f"One exponent for all vines: n = {with_interval(fit['n'], fit['n_95_total'])}"
    ax.set_title(n or "Steady force and speed (no fit: see the report)")
    _law_legend(fig, drawable, damping, styles)
    return fig


def _draw_law(
    ax: Axes, fit: dict[str, Any], vine: str, B: float, x_ss_m_s: np.ndarray, colour: str, method: str
) -> None:
    low, high = math.log(x_ss_m_s.min()), math.log(x_ss_m_s.max())
    margin = max(0.06 * (high - low), 0.05)
    x = np.exp(np.linspace(low - margin, high + margin, 60))
    force_N = B * x ** fit["n"]
    ax.plot(x, force_N, color=colour, ls=_METHOD_LINES[method], lw=1.5, zorder=2)
    dof = sum(law["n_trials"] for law in fit["vines"].values()) - len(fit["vines"]) - 1
    factor = np.exp(student_95(dof) * log_force_sigma(fit, vine, x))
    st.band(ax, x, force_N / factor, force_N * factor, colour, 0.16)


def log_force_sigma(fit: dict[str, Any], vine: str, x_ss_m_s: np.ndarray) -> np.ndarray:
    """Return the standard error of ln F = ln B + n·ln x_ss along the law of one vine. With the covariance C of (ln B,
    n): var ln F = C_BB + 2·ln x_ss·C_Bn + (ln x_ss)²·C_nn. Shapes: x_ss_m_s (n_points,) → (n_points,).
    """
    i, j = (fit["covariance"]["parameters"].index(name) for name in ("n", f"ln B {vine}"))
    cov, slope = np.array(fit["covariance"]["matrix"]), np.log(x_ss_m_s)
    variance = cov[j, j] + 2 * slope * cov[i, j] + slope**2 * cov[i, i]
    return np.asarray(np.sqrt(np.maximum(variance, 0.0)))


def _law_legend(fig: Figure, points: pd.DataFrame, damping: dict[str, Any], styles: dict[str, st.VineStyle]) -> None:
    """Vines with B and N, the first 14 of them, which with the methods fill the height of the figure."""
    laws = damping["both_axes"]["vines"]
    counts = {str(vine): int(used.sum()) for vine, used in points.groupby("vine", sort=False)["used"]}
    breaks = "\n" if len(counts) <= 6 else ", "
    handles = []
    for vine, n_used in list(counts.items())[:14]:
        B = f"{breaks}B = {number(laws[vine]['B'])}, " if vine in laws else breaks
        style = styles[vine]
        handles.append(st.line_key(f"{vine}{B}N = {n_used}", color=style.colour, marker=style.marker, ls="none", ms=6))
    if len(counts) > 14:
        handles.append(st.line_key(f"and {len(counts) - 14} more vines", ls="none"))
    if n_left := len(points) - sum(counts.values()):
        words = f"not in the fit, N = {n_left}"
        handles.append(st.line_key(words, color=st.MUTED, marker="o", mfc=st.PAPER, ls="none", ms=6))
    for method, name in METHOD_NAMES.items():
        if damping[method]["vines"]:
            handles.append(st.line_key(f"{name}\nand its 95 % band", color=st.INK, ls=_METHOD_LINES[method]))
    fig.legend(handles=handles, loc="outside right upper", fontsize=9, labelspacing=0.8, borderaxespad=0.8)


# ------------------------------------------------------------------------------
# Damping, steady speed and efficiency against the size of the vine.

# Label of the axis, name and unit of each size
_SIZES = {"thickness_um": ("wall thickness (µm)", "wall", "µm"), "diameter_mm": ("diameter (mm)", "diameter", "mm")}


@figure("scaling", "damping", "Damping against size", data="scaling.json")
def draw_scaling(scaling: dict[str, Any]) -> Figure | None:
    """B of each vine against its size, on logarithmic axes: against diameter for vines that are scaled copies of
    each other, against wall thickness for vines of one diameter (Fig. 7 of the paper). Full: power law; dashed:
    straight line.
    """
    titles = {"isometric": "Scaled copies (one t/D)", "thickness": "One diameter"}
    kinds = [kind for kind in titles if scaling.get(kind)]
    if not kinds:
        return None
    fig = st.new_figure(6.6 if len(kinds) == 1 else 11.0, 5.2)
    for ax, kind in zip(fig.subplots(1, len(kinds), squeeze=False)[0], kinds, strict=True):
        families = scaling[kind][:4]  # four families have twelve lines of legend above the axes
        ax.set(xscale="log", yscale="log", xlabel=_SIZES[families[0]["along"]][0], ylabel="B (N·(s/m)ⁿ)")
        for i, family in enumerate(families):
            B, B_95 = (np.array(family[name], dtype=float) for name in ("B", "B_95_total"))
            bars = np.clip([B - B_95[:, 0], B_95[:, 1] - B], 0, None)
            _draw_family(ax, family["sizes"], B, bars, family, i, f"B with 95 % interval, N = {B.size} vines")
        sizes = sorted({size for family in families for size in family["sizes"]})
        ax.set_xlim(sizes[0] / 1.3, sizes[-1] * 1.3)
        st.plain_log_ticks(ax)
        if len(sizes) <= 8:
            ax.set_xticks(sizes)
        left_out = len(scaling[kind]) - len(families)
        title = titles[kind] + (f", {left_out} more families in scaling.json" if left_out else "")
        st.legend_above(ax, title=title, alignment="left")
    return fig


def _draw_family(
    ax: Axes, sizes: list[float], values: ArrayLike, errors: ArrayLike, trend: dict[str, Any], index: int, label: str
) -> None:
    """Points of one family of vines, its power law (full) and its straight line (dashed)."""
    refused = f"\nno line: {trend['refused']}" if trend.get("refused") else ""
    st.error_points(ax, sizes, values, errors, index, label + refused, elinewidth=1.3, zorder=3)
    colour, span = st.VINE_COLOURS[index], np.geomspace(min(sizes) / 1.15, 1.15 * max(sizes), 100)
    if power := trend["power"]:
        label = f"power law, slope {number(power['slope'])} ({interval(power['slope_95'])}){_quality(power)}"
        ax.plot(span, np.exp(power["intercept"]) * span ** power["slope"], color=colour, lw=1.5, label=label)
    if line := trend["line"]:
        straight = line["intercept"] + line["slope"] * span
        drawn = straight > 0.5 * np.min(values)
        label = f"straight line, intercept {number(line['intercept'])}{_quality(line)}"
        ax.plot(span[drawn], straight[drawn], color=colour, lw=1.3, ls=st.DASHED, label=label)


def _quality(line: dict[str, Any]) -> str:
    return f", R² {number(line['R2'])}, p = {number(line['p'], 2)}"


@figure("speed_scaling", "damping", "Steady speed against size", data="conditions.csv")
def draw_speed_scaling(scaling: dict[str, Any], pressure_unit: str = "kPa") -> Figure | None:
    """Steady tail speed of scaled copies (one t/D) at one pressure without payload, against diameter, and the same
    divided by the diameter (Fig. 8 of the paper). Points are means over a vine's steady trials with their standard
    errors (that of a single trial does not include replicate scatter); power laws (full) and straight lines (dashed)
    are fitted to the means of vines, so N is the number of vines, and p is the probability of a slope at least as
    large if there is none. Pressures that agree within 2 % count as one.
    """
    with_line = [one for one in scaling.get("steady_speed") or [] if not one.get("refused")]
    families = with_line[:5]  # each pressure has three lines of legend above the axes
    if not families:
        return None
    fig = st.new_figure(11.0, 5.2 + 0.45 * len(families))
    left_out = len(with_line) - len(families)
    more = f", {left_out} more pressures in scaling.json" if left_out > 0 else ""
    panels = (
        ("Speed", "steady tail speed x_ss (m/s)", "x_ss{}_m_s"),
        ("Speed over diameter", "x_ss / diameter (1/s)", "x_ss_over_diameter{}_1_s"),
    )
    for ax, (title, label, key) in zip(fig.subplots(1, 2), panels, strict=True):
        ax.set(xlabel="diameter (mm)", ylabel=label)
        for i, family in enumerate(families):
            values, errors = (np.array(family[key.format(part)], dtype=float) for part in ("", "_sigma"))
            n = f"{st.counted([values.size], 'vine')} of {st.counted(family['n_steady'], 'trial')}"
            trend = family["over_diameter"] if "over" in key else family
            pressure = pressure_text(1e3 * family["pressure_kPa"], pressure_unit, 4)
            _draw_family(ax, family["sizes"], values, errors, trend, i, f"{pressure}, N = {n}")
        st.up_from_zero(ax, x=True)
        st.legend_above(ax, title=title + more, alignment="left", fontsize=9)
    return fig


@figure("efficiency", "damping", "Energy efficiency", data="conditions.csv")
def draw_efficiency(scaling: dict[str, Any], pressure_unit: str = "kPa") -> Figure | None:
    """Energy efficiency against wall thickness and diameter at one pressure, payload, length and growth (Fig. 9 of the
    paper): kinetic energy of all moving mass divided by the work of the gas P₀Ay; of the payload alone; and with the
    work of the weight added to the denominator. Points are means with standard errors; the powers of wall and diameter
    are fitted together, on logarithms, so that each is that of one size with the other held constant.
    """
    families = scaling.get("efficiency") or []
    if not families:
        return None
    definitions = {
        "efficiency": "½ m(x) ẋ² / (P₀ A y)",
        "efficiency_payload": "payload's motion alone",
        "efficiency_with_weight": "work of the weight in the denominator",
    }
    family, n_left = families[0], len(families) - 1
    along = [name for name in _SIZES if len(set(family[name])) > 1]
    shown = [key for key in definitions if np.any(np.array(family[key], dtype=float) > 0)]
    fig = st.new_figure(0.9 + 3.6 * len(shown), 1.0 + 3.5 * len(along))
    axes = fig.subplots(len(along), len(shown), squeeze=False, sharey=True)
    for row, x in zip(axes, along, strict=True):
        for ax, key in zip(row, shown, strict=True):
            _draw_efficiency(ax, family, key, x)
        row[0].set(ylabel="energy efficiency (%)", ylim=(0, 1.08 * max(ax.dataLim.y1 for ax in row)))
        row[-1].legend(loc="upper left", bbox_to_anchor=(1.02, 1.0), borderaxespad=0.0, fontsize=9)
    for ax, key in zip(axes[0], shown, strict=True):
        ax.set_title(definitions[key], fontsize=10.5)
    load = f" with {family['payload_g']:.4g} g" if family["payload_g"] else " without payload"
    more = f"; {n_left} more {'family' if n_left == 1 else 'families'} in scaling.json" if n_left else ""
    pressure = pressure_text(1e3 * family["pressure_kPa"], pressure_unit, 4)
    title = f"{pressure}{load}, after {family['efficiency_at_mm']:.4g} mm of growth; "
    fig.suptitle(f"{title}{st.per_point(family['n_efficiency'])}{more}", fontsize=11, x=0.01, ha="left")
    return fig


def _draw_efficiency(ax: Axes, family: dict[str, Any], key: str, x: str) -> None:
    other = next(name for name in _SIZES if name != x)
    sizes, others, values, errors = (np.array(family[name], dtype=float) for name in (x, other, key, f"{key}_sigma"))
    for i, size in enumerate(np.unique(others)):
        chosen = np.flatnonzero(others == size)
        chosen = chosen[np.argsort(sizes[chosen])]
        label = f"{size:.4g} {_SIZES[other][2]}"
        st.error_points(ax, sizes[chosen], 100 * values[chosen], 100 * errors[chosen], i, label, ls="-", ms=5.5, lw=1.2)
    ax.set(xlabel=_SIZES[x][0], xlim=(0, 1.12 * sizes.max()))
    trend, words = family["trend"][key], ""
    if trend.get("refused"):
        words = f"no trend: {textwrap.fill(str(trend['refused']), 30)}"
    elif x in trend:
        power, spread, p = trend[x]["power"], interval(trend[x]["power_95"]), number(trend[x]["p"], 2)
        words = f"power of the {_SIZES[x][1]} {number(power, 2)}\n({spread}), p = {p}"
    ax.text(0.03, 0.03, words, transform=ax.transAxes, color=st.MUTED, fontsize=8.5)


# ------------------------------------------------------------------------------
# Figures of the paper redrawn, with the consequences of terms neglected in Eq. (2).


@figure("paper_fig6", "paper", "Fig. 6: growth force and steady speed", data="damping_points.csv")
def draw_paper_damping(points: pd.DataFrame, damping: Mapping[str, Any]) -> Figure | None:
    """Growth force above yield against steady tail speed of the four scales. Left: the literal published rule, set
    pressure, no weight, the longest run of velocities that vary by less than 3 %. Right: with the weight in the
    force and windows that are shown to be steady. Full: fitted; dashed: printed.
    """
    panels = (
        ("paper", "x_ss_paper_m_s", "force_paper_N", "eligible", "The literal published rule"),
        ("both_axes", "x_ss_m_s", "force_N", "used", "Weight in the force, gated windows, errors on both axes"),
    )
    sizes = zip(points["diameter_mm"], points["thickness_um"], strict=True)
    scaled = points.assign(scale=[published.scale_of(float(D), float(t)) or 0 for D, t in sizes])
    scaled = scaled[scaled["scale"] > 0]
    steady = [scaled[scaled[wanted] & (scaled[x] > 0) & (scaled[y] > 0)] for _, x, y, wanted, _ in panels]
    if not any(map(len, steady)):
        return None
    fig = st.new_figure(12.0, 6.2)
    axes = fig.subplots(1, 2, sharex=True, sharey=True)
    for ax, part, (method, x, y, _, title) in zip(axes, steady, panels, strict=True):
        law = damping.get(method) or {}
        ax.set(xscale="log", yscale="log", xlabel="steady tail speed x_ss (m/s)")
        for i, (scale, vine) in enumerate(published.TABLE_I.items()):
            of_scale, colour = part[part["scale"] == scale], st.VINE_COLOURS[i]
            if not len(of_scale):
                continue
            fitted = (law.get("vines") or {}).get(str(of_scale["vine"].iloc[0])) or {}
            label = f"R = {scale}: B {number(fitted.get('B'))}, printed {vine.B:g}; N = {len(of_scale)}"
            style: dict[str, Any] = {"mfc": st.PAPER, "mec": colour, "ms": 5, "mew": 1.1, "ls": "none"}
            ax.plot(of_scale[x], of_scale[y], st.VINE_MARKERS[i], label=label, **style)
            span = np.geomspace(float(of_scale[x].min()) / 1.2, float(of_scale[x].max()) * 1.2, 50)
            printed = "printed B and n" if scale == max(published.TABLE_I) else None
            ax.plot(span, vine.B * span**published.PRINTED_EXPONENT, color=st.INK, lw=1.2, ls=st.DASHED, label=printed)
            if fitted and law.get("n"):
                ax.plot(span, fitted["B"] * span ** law["n"], color=colour, lw=1.4)
        n = with_interval(law.get("n"), law.get("n_95_total"))
        ax.set_title(f"{title}\nn = {n}, printed {published.PRINTED_EXPONENT:g}", fontsize=10.5)
    axes[0].set_ylabel("growth force above yield (N)")
    for ax in axes:
        st.plain_log_ticks(ax)
        if ax.get_legend_handles_labels()[0]:
            ax.legend(loc="upper center", bbox_to_anchor=(0.5, -0.12), ncols=2, fontsize=9)
    return fig


@figure("paper_fig4", "paper", "Fig. 4: the leading edge with the payload", data="paper_motions.csv")
def draw_paper_position(
    paper_motions: pd.DataFrame, paper_means: pd.DataFrame, paper_positions: pd.DataFrame
) -> Figure | None:
    """The leading edge of the 24 mm × 200 µm vine with 35.6 g. Black: Eq. (2) with the printed B, n and yield
    pressure. Blue: the mean of our trials, each counted from its own release, with one trial's scatter. Orange:
    with a chamber that is not refilled, from isothermal to adiabatic; green: a tail that cannot push; purple: both.
    None of these is claimed to be what was measured; the length, 280 mm, is that of the paper's longest vine.
    """
    pressures = sorted(paper_motions["pressure_kPa"].unique())
    if not pressures:
        return None
    fig = st.new_figure(12.0, 5.2)
    axes = fig.subplots(1, len(pressures), squeeze=False, sharey=True)[0]
    for ax, pressure_kPa in zip(axes, pressures, strict=True):
        motions, mean, errors = (
            table[table["pressure_kPa"] == pressure_kPa] for table in (paper_motions, paper_means, paper_positions)
        )
        curves = _by_departure(motions)
        _draw_departures(ax, curves)
        if len(mean):
            n_trials, mean = int(mean["n_trials"].iloc[0]), st.thinned(mean, 40)
            time_s, position_cm = st.column(mean, "time_s"), st.column(mean, "lead_position_m", 100)
            sigma_cm = np.nan_to_num(st.column(mean, "lead_position_sigma_m", 100))
            st.band(ax, time_s, position_cm - sigma_cm, position_cm + sigma_cm, st.BLUE, 0.2)
            label = f"mean of {n_trials} trials,\n± one trial's scatter"
            ax.plot(time_s, position_cm, "o", color=st.BLUE, ms=3.2, mec=st.MUTED, mew=0.3, label=label)
        # Slower motions are cut off.
        ax.set(xlabel="time since release (s)", xlim=(0, 1.9 * float(curves["eq2"]["time_s"].iloc[-1])))
        ours = f"ours {100 * errors['rms_mean_m'].iloc[0]:.2f} cm" if len(errors) else "not among the trials"
        printed_cm = published.POSITION_RMS_CM[round(pressure_kPa)]
        ax.set_title(f"{pressure_kPa:g} kPa\nrms: printed {printed_cm:.2f} cm, {ours}", fontsize=10.5)
    axes[0].set_ylabel("growth of the leading edge (cm)")
    handles, labels = axes[-1].get_legend_handles_labels()
    fig.legend(handles, labels, loc="outside lower center", ncols=len(labels), fontsize=9.5)
    return fig


def _by_departure(table: pd.DataFrame) -> dict[str, pd.DataFrame]:
    return {str(name): part for name, part in table.groupby("departure", sort=False)}


def _draw_departures(ax: Axes, curves: Mapping[str, pd.DataFrame]) -> None:
    """Draw Eq. (2) and departures from it as bands and a line; bands are filled between equal positions."""
    position_cm = np.linspace(0, 28, 200)

    def time_at(curve: pd.DataFrame) -> np.ndarray:
        """Times at which a motion passes each position; 1000 s for positions that it does not reach."""
        grown_cm = st.column(curve, "lead_position_m", 100)
        when = np.interp(position_cm, grown_cm, st.column(curve, "time_s"))
        return np.where(position_cm <= grown_cm.max() + 1e-9, when, 1e3)

    refilled = "chamber not refilled,\nisothermal to adiabatic"
    for slack, colour, label in (("", st.ORANGE, refilled), ("_slack", st.PURPLE, "both")):
        slow, fast = (time_at(curves[f"depletion_{pace}{slack}"]) for pace in ("slow", "fast"))
        ax.fill_betweenx(position_cm, slow, fast, color=colour, alpha=0.3, lw=0, label=label)
    for name, colour, width, line, label in (
        ("slack", st.GREEN, 1.6, st.DASHED, "tail that\ncannot push"),
        ("eq2", st.INK, 1.8, "-", "Eq. (2) with the\nprinted numbers"),
    ):
        at = curves[name]["time_s"], 100 * curves[name]["lead_position_m"]
        ax.plot(*at, color=colour, lw=width, ls=line, label=label)


@figure("paper_reservoir", "paper", "Pressure lost by a chamber", data="paper_pressures.csv")
def draw_paper_reservoir(paper_pressures: pd.DataFrame) -> Figure:
    """Gauge pressure left in the paper's chamber while its largest vine grows, if it is not refilled: Boyle's law
    applies to absolute pressure, so that a change of volume by 3.4 % reduces the gauge pressure by 15 to 71 %, not
    by 3.4 %. The refill rate of the regulator is not published.
    """
    fig, ax = st.one_panel(8.2, 4.8)
    for i, pressure_kPa in enumerate(sorted(paper_pressures["pressure_kPa"].unique())):
        by_name = _by_departure(paper_pressures[paper_pressures["pressure_kPa"] == pressure_kPa])
        low, high = (st.column(by_name[f"depletion_{pace}"], "gauge_left", 100) for pace in ("fast", "slow"))
        growth_mm = st.column(by_name["depletion_slow"], "lead_position_m", 1e3)
        label = f"{pressure_kPa:g} kPa: −{100 - high[-1]:.0f} to −{100 - low[-1]:.0f} %"
        st.band(ax, growth_mm, low, high, st.VINE_COLOURS[i], 0.35, label=label)
        ax.plot(growth_mm, high, color=st.VINE_COLOURS[i], lw=1.4)
    allowed = 100 * (1 - published.CHAMBER_ALLOWED)
    ax.axhline(allowed, color=st.INK, lw=1.0, ls=st.DASHED, label=f"{100 * published.CHAMBER_ALLOWED:g} %, as allowed")
    relative = 100 / (1 + published.CHAMBER_CHANGE)
    ax.axhline(relative, color=st.MUTED, lw=1.0, ls=":", label=f"as printed: P₁V₁/V₂, {100 - relative:.1f} %")
    ax.set(xlabel="growth (mm)", ylabel="gauge pressure left (%)", ylim=(0, 104), xlim=(0, None))
    ax.set_title(
        f"{published.CHAMBER_L:g} L, 24 mm × {published.LONGEST_VINE_MM:g} mm vine, nothing refilling it:\n"
        "the gas law in absolute pressure, isothermal (line) to adiabatic",
        fontsize=10.5,
    )
    ax.legend(loc="center left", bbox_to_anchor=(1.01, 0.5), fontsize=9.5)
    return fig


@figure("paper_fig5", "paper", "Fig. 5: final speed and payload", data="paper_speeds.csv")
def draw_paper_speeds(paper_speeds: pd.DataFrame, paper_speed_curves: pd.DataFrame) -> Figure | None:
    """Speed of the leading edge after 12 cm of growth against payload, 24 mm × 150 µm: means of our trials with
    standard errors, and Eq. (2). B of this vine is not published and is scaled in proportion to the wall. Payloads
    other than 35.6 g are ours.
    """
    reached = paper_speeds[paper_speeds["final_lead_velocity_m_s"] > 0]
    reached = reached[reached.groupby("pressure_kPa")["payload_g"].transform("nunique") > 1]
    if not len(reached):
        return None
    fig, ax = st.one_panel(6.6, 4.8, xlabel="payload (g)", ylabel="speed of the leading edge (m/s)")
    for i, pressure_kPa in enumerate(sorted(reached["pressure_kPa"].unique())):
        group = reached[reached["pressure_kPa"] == pressure_kPa]
        speed, sigma = (group[f"final_lead_velocity{part}_m_s"] for part in ("", "_sigma"))
        st.error_points(ax, group["payload_g"], speed, sigma, i, f"{pressure_kPa:.4g} kPa")
        near = np.isclose(paper_speed_curves["pressure_kPa"], pressure_kPa)
        curve = paper_speed_curves[near].sort_values("payload_g")
        label = "Eq. (2), B proportional to the wall" if i == 0 else None
        colour = st.VINE_COLOURS[i % len(st.VINE_COLOURS)]
        ax.plot(curve["payload_g"], curve["final_lead_velocity_m_s"], color=colour, lw=1.5, label=label)
    st.up_from_zero(ax)
    counts = reached["n_final"].astype(int).tolist()
    title = f"{reached['vine'].iloc[0]}, after {reached['final_at_mm'].iloc[0]:.4g} mm\n{st.per_point(counts)}"
    st.legend_above(ax, 2, title=title, alignment="left", fontsize=9)
    return fig
