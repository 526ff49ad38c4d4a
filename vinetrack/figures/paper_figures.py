"""The paper's figures and Table II redrawn, with the consequences of terms neglected in Eq. (2)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from vinetrack.core import published
from vinetrack.core.units import number, with_interval
from vinetrack.figures.damping_figures import draw_efficiency, draw_scaling, draw_speed_scaling
from vinetrack.figures.registry import figure
from vinetrack.figures.style import (
    BLUE,
    DASHED,
    GREEN,
    INK,
    MUTED,
    ORANGE,
    PAPER,
    PURPLE,
    VINE_COLOURS,
    VINE_MARKERS,
    band,
    column,
    counted,
    error_points,
    legend_above,
    new_figure,
    note_below,
    plain_log_ticks,
    thinned,
    up_from_zero,
)

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


# Departures from Eq. (2) that the paper's errors are compared with; where they are two, the smaller effect first
CAUSES = {
    "chamber not refilled": ("depletion_slow", "depletion_fast"),
    "tail that cannot push": ("slack",),
    "both": ("depletion_slow_slack", "depletion_fast_slack"),
}


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
    fig = new_figure(12.0, 6.2)
    axes = fig.subplots(1, 2, sharex=True, sharey=True)
    for ax, part, (method, x, y, _, title) in zip(axes, steady, panels, strict=True):
        law = damping.get(method) or {}
        _draw_force_panel(ax, part, x, y, law)
        n = with_interval(law.get("n"), law.get("n_95"))
        ax.set_title(f"{title}\nn = {n}, printed {published.EXPONENT:g}", fontsize=10.5)
        ax.set_xlabel("steady tail speed x_ss (m/s)")
    axes[0].set_ylabel("growth force above yield (N)")
    for ax in axes:
        plain_log_ticks(ax)
        if ax.get_legend_handles_labels()[0]:
            ax.legend(loc="upper center", bbox_to_anchor=(0.5, -0.12), ncols=2, fontsize=9)
    return fig


def _draw_force_panel(ax: Axes, points: pd.DataFrame, x: str, y: str, law: Mapping[str, Any]) -> None:
    ax.set(xscale="log", yscale="log")
    for i, (scale, B) in enumerate(published.DAMPING_B.items()):
        part = points[points["scale"] == scale]
        if not len(part):
            continue
        colour = VINE_COLOURS[i % len(VINE_COLOURS)]
        fitted = (law.get("vines") or {}).get(str(part["vine"].iloc[0])) or {}
        label = f"R = {scale}: B {number(fitted.get('B'))}, printed {B:g}; N = {len(part)}"
        ax.plot(part[x], part[y], VINE_MARKERS[i], mfc=PAPER, mec=colour, ms=5, mew=1.1, ls="none", label=label)
        span = np.geomspace(float(part[x].min()) / 1.2, float(part[x].max()) * 1.2, 50)
        printed = "printed B and n" if scale == max(published.DAMPING_B) else None
        ax.plot(span, B * span**published.EXPONENT, color=INK, lw=1.2, ls=DASHED, label=printed)
        if fitted and law.get("n"):
            ax.plot(span, fitted["B"] * span ** law["n"], color=colour, lw=1.4)


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
    fig = new_figure(12.0, 5.2)
    axes = fig.subplots(1, len(pressures), squeeze=False, sharey=True)[0]
    for ax, pressure_kPa in zip(axes, pressures, strict=True):
        at_pressure = paper_motions[paper_motions["pressure_kPa"] == pressure_kPa]
        curves = {str(name): part for name, part in at_pressure.groupby("departure", sort=False)}
        _draw_departures(ax, curves)
        mean = paper_means[paper_means["pressure_kPa"] == pressure_kPa]
        if len(mean):
            _draw_mean(ax, mean)
        # Slower motions are cut off.
        ax.set(xlabel="time since release (s)", xlim=(0, 1.9 * float(curves["eq2"]["time_s"].iloc[-1])))
        rms_m = paper_positions.loc[paper_positions["pressure_kPa"] == pressure_kPa, "rms_mean_m"]
        ours = f"ours {100 * float(rms_m.iloc[0]):.2f} cm" if len(rms_m) else "not among the trials"
        printed_cm = published.POSITION_RMS_CM[round(pressure_kPa)]
        ax.set_title(f"{pressure_kPa:g} kPa\nrms: printed {printed_cm:.2f} cm, {ours}", fontsize=10.5)
    axes[0].set_ylabel("growth of the leading edge (cm)")
    _legend_below(fig, axes[-1])
    return fig


def _legend_below(fig: Figure, ax: Axes) -> None:
    handles, labels = ax.get_legend_handles_labels()
    fig.legend(handles, labels, loc="outside lower center", ncols=len(labels), fontsize=9.5)


def _draw_departures(ax: Axes, curves: Mapping[str, pd.DataFrame]) -> None:
    """Draw Eq. (2) and departures from it as bands and a line; bands are filled between equal positions."""
    position_cm = np.linspace(0, 28, 200)

    def time_at(curve: pd.DataFrame) -> np.ndarray:
        """Times at which a motion passes each position; 1000 s for positions that it does not reach."""
        grown_cm = column(curve, "lead_position_m", 100)
        when = np.interp(position_cm, grown_cm, column(curve, "time_s"))
        return np.where(position_cm <= grown_cm.max() + 1e-9, when, 1e3)

    refilled = "chamber not refilled,\nisothermal to adiabatic"
    for slack, colour, label in (("", ORANGE, refilled), ("_slack", PURPLE, "both")):
        slow, fast = (time_at(curves[f"depletion_{pace}{slack}"]) for pace in ("slow", "fast"))
        ax.fill_betweenx(position_cm, slow, fast, color=colour, alpha=0.3, lw=0, label=label)
    for name, style, label in (
        ("slack", {"color": GREEN, "lw": 1.6, "ls": DASHED}, "tail that\ncannot push"),
        ("eq2", {"color": INK, "lw": 1.8}, "Eq. (2) with the\nprinted numbers"),
    ):
        ax.plot(curves[name]["time_s"], 100 * curves[name]["lead_position_m"], label=label, **style)


def _draw_mean(ax: Axes, mean: pd.DataFrame) -> None:
    part = thinned(mean, 40)
    time_s, position_cm = column(part, "time_s"), column(part, "lead_position_m", 100)
    sigma_cm = np.nan_to_num(column(part, "lead_position_sigma_m", 100))
    band(ax, time_s, position_cm - sigma_cm, position_cm + sigma_cm, BLUE, 0.2)
    label = f"mean of {int(mean['n_trials'].iloc[0])} trials,\n± one trial's scatter"
    ax.plot(time_s, position_cm, "o", color=BLUE, ms=3.2, mec=MUTED, mew=0.3, label=label)


@figure("paper_reservoir", "paper", "Pressure lost by a chamber", data="paper_pressures.csv")
def draw_paper_reservoir(paper_pressures: pd.DataFrame) -> Figure:
    """Gauge pressure left in the paper's chamber while its largest vine grows, if it is not refilled: Boyle's law
    applies to absolute pressure, so that a change of volume by 3.4 % reduces the gauge pressure by 15 to 71 %, not
    by 3.4 %. The refill rate of the regulator is not published.
    """
    fig = new_figure(8.2, 4.8)
    ax = fig.add_subplot()
    for i, (pressure_kPa, at_pressure) in enumerate(paper_pressures.groupby("pressure_kPa")):
        by_name = {str(name): part for name, part in at_pressure.groupby("departure")}
        low, high = (column(by_name[f"depletion_{pace}"], "gauge_left", 100) for pace in ("fast", "slow"))
        growth_mm = column(by_name["depletion_slow"], "lead_position_m", 1e3)
        label = f"{float(str(pressure_kPa)):g} kPa: −{100 - high[-1]:.0f} to −{100 - low[-1]:.0f} %"
        band(ax, growth_mm, low, high, VINE_COLOURS[i], 0.35, label=label)
        ax.plot(growth_mm, high, color=VINE_COLOURS[i], lw=1.4)
    allowed = 100 * (1 - published.CHAMBER_ALLOWED)
    ax.axhline(allowed, color=INK, lw=1.0, ls=DASHED, label=f"{100 * published.CHAMBER_ALLOWED:g} %, as allowed")
    relative = 100 / (1 + published.CHAMBER_CHANGE)
    ax.axhline(relative, color=MUTED, lw=1.0, ls=":", label=f"as printed: P₁V₁/V₂, {100 - relative:.1f} %")
    ax.set(xlabel="growth (mm)", ylabel="gauge pressure left (%)", ylim=(0, 104), xlim=(0, None))
    ax.set_title(
        f"{published.CHAMBER_L:g} L, 24 mm × {published.LONGEST_VINE_MM:g} mm vine, nothing refilling it:\n"
        "the gas law in absolute pressure, isothermal (line) to adiabatic",
        fontsize=10.5,
    )
    ax.legend(loc="center left", bbox_to_anchor=(1.01, 0.5), fontsize=9.5)
    return fig


@figure("paper_table2", "paper", "Table II, drawn", data="paper.csv")
def draw_paper_rms(paper: pd.DataFrame, paper_departures: pd.DataFrame) -> Figure:
    """Errors of Eq. (2): published, ours, and those that departures from Eq. (2) would cause. Ours, with trials
    simulated by Eq. (2), come only from scatter of vines and pressures. A departure that changes nothing at a
    pressure is not drawn there.
    """
    fig = new_figure(11.0, 4.9)
    left, right = fig.subplots(1, 2)
    ours = paper.drop_duplicates("row").set_index("row")["ours"]
    of_figure = dict(iter(paper_departures.groupby("figure")))
    left.set(ylabel="rms of position (cm)", title="Fig. 4 and Table II")
    position_cm = of_figure["Fig. 4"].assign(size=lambda table: 100 * table["rms_position_m"])
    _draw_rms_panel(left, published.POSITION_RMS_CM, ours, "position_rms_{:g}kPa", position_cm)
    right.set(ylabel="rms of speed at 12 cm (m/s)", title="Fig. 5 and Table II")
    speed_m_s = of_figure["Fig. 5"].assign(size=lambda table: table["rms_final_lead_velocity_m_s"])
    _draw_rms_panel(right, published.FINAL_SPEED_RMS_M_S, ours, "final_speed_rms_{:g}kPa", speed_m_s)
    _legend_below(fig, left)
    return fig


def _draw_rms_panel(ax: Axes, printed: dict[int, float], ours: pd.Series, row: str, departures: pd.DataFrame) -> None:
    least = 0.01  # 0.1 mm and 1 cm/s, a hundredth of the printed errors
    places = np.arange(len(printed), dtype=float)
    ax.set_yscale("log")
    ax.plot(places - 0.3, list(printed.values()), "D", color=INK, ms=8, label="published")
    found = [float(ours.get(row.format(kPa), np.nan)) for kPa in printed]
    ax.plot(places - 0.15, found, "o", mfc="none", mec=BLUE, mew=1.8, ms=8, label="ours")

    def sizes(name: str) -> np.ndarray:
        of_name = departures[departures["departure"] == name]
        near = [of_name.loc[np.isclose(of_name["pressure_kPa"], kPa), "size"] for kPa in printed]
        return np.array([float(size.iloc[0]) if len(size) else np.nan for size in near])

    for k, ((label, names), colour) in enumerate(zip(CAUSES.items(), (ORANGE, GREEN, PURPLE), strict=True)):
        low, high = np.maximum(sizes(names[0]), least), sizes(names[-1])
        shown = high >= least
        middle = np.sqrt(low * np.maximum(high, least))
        bars = [(middle - low)[shown], (high - middle)[shown]]
        style: dict[str, Any] = {"fmt": "_", "color": colour, "ms": 11, "mew": 2, "elinewidth": 7, "label": label}
        ax.errorbar((places + 0.15 * k)[shown], middle[shown], yerr=bars, **style)
    ax.set_xticks(places, [f"{kPa:g} kPa" for kPa in printed])
    ax.grid(visible=False, axis="x")
    ax.set_xlim(-0.6, len(printed) - 0.4)
    plain_log_ticks(ax, "y")


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
    fig = new_figure(6.6, 4.8)
    ax = fig.add_subplot()
    for i, (pressure_kPa, group) in enumerate(reached.groupby("pressure_kPa")):
        speed, sigma = (group[f"final_lead_velocity{part}_m_s"] for part in ("", "_sigma"))
        error_points(ax, group["payload_g"], speed, sigma, i, f"{float(str(pressure_kPa)):.4g} kPa")
        near = np.isclose(paper_speed_curves["pressure_kPa"], float(str(pressure_kPa)))
        curve = paper_speed_curves[near].sort_values("payload_g")
        label = "Eq. (2), B proportional to the wall" if i == 0 else None
        style: dict[str, Any] = {"color": VINE_COLOURS[i % len(VINE_COLOURS)], "lw": 1.5, "label": label}
        ax.plot(curve["payload_g"], curve["final_lead_velocity_m_s"], **style)
    counts = reached["n_final"].astype(int).tolist()
    ax.set(xlabel="payload (g)", ylabel="speed of the leading edge (m/s)")
    up_from_zero(ax)
    error = ", ± standard error" if max(counts) > 1 else ""
    title = f"{reached['vine'].iloc[0]}, after {reached['final_at_mm'].iloc[0]:.4g} mm\n"
    title += f"N = {counted(counts, 'trial')} per point{error}"
    legend_above(ax, 2, title=title, alignment="left", fontsize=9)
    note = (
        "B of this vine and the payloads other than 35.6 g are not printed; the paper shows its points only in a plot"
    )
    note_below(fig, note)
    return fig


@figure("paper_fig7", "paper", "Fig. 7: B against scale and wall", data="scaling.json")
def draw_paper_sizes(scaling: dict[str, Any], damping: dict[str, Any], paper: pd.DataFrame) -> Figure | None:
    """B against diameter for scaled copies, and against wall thickness for 12 mm vines, with 95 % intervals;
    diamonds are published values. On logarithmic axes a power law is straight. Only one of the walls has a
    published B: simulated vines have B in proportion to the wall.
    """
    laws = {name: vine for law in damping.values() for name, vine in (law.get("vines") or {}).items()}
    scales = {name: published.scale_of(vine["diameter_mm"], vine["thickness_um"]) for name, vine in laws.items()}
    B = {name: published.DAMPING_B[scale] for name, scale in scales.items() if scale is not None}
    note = (
        "Of the 12 mm vines only that of 100 µm has a printed B. Virtual vines with other walls were simulated with B "
        "proportional to the wall: their straight line is an input"
    )
    printed = {"B": B, "source": f"{published.SOURCE}, printed"}
    return draw_scaling(scaling, printed, note if _is_virtual(paper) else "")


@figure("paper_fig8", "paper", "Fig. 8: steady speed and scale", data="conditions.csv")
def draw_paper_steady_speeds(scaling: dict[str, Any], paper: pd.DataFrame) -> Figure | None:
    """Steady tail speed of the four scales at 24 kPa, and divided by the diameter, with straight lines (full) and
    power laws (dashed) through the means of vines.
    """
    families = _near(scaling["steady_speed"], published.STEADY_SPEED_KPA)
    note = (
        "Alvarez et al. (2025): linear, R² = 0.935, from which p = 0.033 (printed: 0.32). The B printed in Fig. 6 do "
        "not give linearly increasing speeds"
    )
    virtual = ": virtual vines simulated with them cannot test one figure against the other"
    return draw_speed_scaling({"steady_speed": families}, note + (virtual if _is_virtual(paper) else ""))


@figure("paper_fig9", "paper", "Fig. 9: energy efficiency", data="conditions.csv")
def draw_paper_efficiency(scaling: dict[str, Any]) -> Figure | None:
    """Energy efficiency at 34 kPa with 35.6 g after 150 mm of growth, defined in three ways. Simulated vines of
    other walls than those of Table I have B in proportion to the wall.
    """
    note = "Alvarez et al. (2025): higher for thinner walls, no clear trend with diameter; values are only plotted"
    return draw_efficiency({"efficiency": _near(scaling["efficiency"], published.EFFICIENCY_KPA)}, note)


def _is_virtual(paper: pd.DataFrame) -> bool:
    """Whether the trials were simulated from the paper's numbers."""
    return bool(paper["mark"].str.startswith("simulated").any())


def _near(families: list[dict[str, Any]], pressure_kPa: float) -> list[dict[str, Any]]:
    return [family for family in families if abs(family["pressure_kPa"] / pressure_kPa - 1) < 0.02]
