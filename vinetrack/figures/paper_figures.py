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
    counted,
    error_points,
    legend_above,
    new_figure,
    note_below,
    plain_log_ticks,
    up_from_zero,
)

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
_DAMPING_PANELS = (
    ("paper", "x_ss_paper_m_s", "force_paper_N", "eligible", "The literal published rule"),
    ("both_axes", "x_ss_m_s", "force_N", "used", "Weight in the force, gated windows, errors on both axes"),
)


@figure("paper_fig6", "paper", "Fig. 6: growth force and steady speed", data="damping_points.csv")
def draw_paper_damping(points: pd.DataFrame, damping: Mapping[str, Any]) -> Figure | None:
    """Growth force above yield against steady tail speed of the four scales. Left: the literal published rule, set
    pressure, no weight, the longest run of velocities that vary by less than 3 %. Right: with the weight in the
    force and windows that are shown to be steady. Full: fitted; dashed: printed.
    """
    sizes = zip(points["diameter_mm"], points["thickness_um"], strict=True)
    scaled = points.assign(scale=[published.scale_of(float(D), float(t)) or 0 for D, t in sizes])
    scaled = scaled[scaled["scale"] > 0]
    if not len(scaled):
        return None
    if not any((scaled[wanted] & (scaled[y] > 0) & (scaled[x] > 0)).any() for _, x, y, wanted, _ in _DAMPING_PANELS):
        return None
    fig = new_figure(12.0, 6.2)
    axes = fig.subplots(1, 2, sharex=True, sharey=True)
    for ax, (method, x, y, wanted, title) in zip(axes, _DAMPING_PANELS, strict=True):
        law = damping.get(method) or {}
        steady = scaled[scaled[wanted] & (scaled[x] > 0) & (scaled[y] > 0)]
        _draw_force_panel(ax, steady, x, y, law)
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
        ax.plot(
            span,
            B * span**published.EXPONENT,
            color=INK,
            lw=1.2,
            ls=DASHED,
            label="printed B and n" if scale == max(published.DAMPING_B) else None,
        )
        if fitted and law.get("n"):
            ax.plot(span, fitted["B"] * span ** law["n"], color=colour, lw=1.4)


_BANDS = (
    ("depletion_slow", "depletion_fast", ORANGE, "chamber not refilled,\nisothermal to adiabatic"),
    ("depletion_slow_slack", "depletion_fast_slack", PURPLE, "both"),
)
_MAX_MEAN_POINTS = 40  # Chosen: circles of 3.2 pt along 3 in of panel touch each other where there are more than 70

_MAX_DURATION_RATIO = 1.9  # Chosen: panels end at 1.9 times the duration of Eq. (2); slower motions are cut off


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
        _draw_mean(ax, paper_means[paper_means["pressure_kPa"] == pressure_kPa])
        ax.set(xlabel="time since release (s)", xlim=(0, _MAX_DURATION_RATIO * float(curves["eq2"]["time_s"].iloc[-1])))
        rms_m = paper_positions.loc[paper_positions["pressure_kPa"] == pressure_kPa, "rms_mean_m"]
        ours = f"ours {100 * float(rms_m.iloc[0]):.2f} cm" if len(rms_m) else "not among the trials"
        ax.set_title(
            f"{pressure_kPa:g} kPa\nrms: printed {published.POSITION_RMS_CM[round(pressure_kPa)]:.2f} cm, {ours}",
            fontsize=10.5,
        )
    axes[0].set_ylabel("growth of the leading edge (cm)")
    handles, labels = axes[-1].get_legend_handles_labels()
    fig.legend(handles, labels, loc="outside lower center", ncols=len(labels), fontsize=9.5)
    return fig


def _draw_departures(ax: Axes, curves: Mapping[str, pd.DataFrame]) -> None:
    """Draw Eq. (2) and departures from it as bands and a line; bands are filled between equal positions."""
    for slow, fast, colour, label in _BANDS:
        position_cm = np.linspace(0, 28, 200)
        first, last = (_time_at(curves[name], position_cm) for name in (slow, fast))
        ax.fill_betweenx(position_cm, first, last, color=colour, alpha=0.3, lw=0, label=label)
    slack = curves["slack"]
    ax.plot(
        slack["time_s"],
        100 * slack["lead_position_m"],
        color=GREEN,
        lw=1.6,
        ls=DASHED,
        label="tail that\ncannot push",
    )
    plain = curves["eq2"]
    ax.plot(
        plain["time_s"], 100 * plain["lead_position_m"], color=INK, lw=1.8, label="Eq. (2) with the\nprinted numbers"
    )


def _time_at(curve: pd.DataFrame, position_cm: np.ndarray) -> np.ndarray:
    """Times at which a motion passes each position; 1000 s for positions that it does not reach."""
    time_s, grown_cm = curve["time_s"].to_numpy(float), 100 * curve["lead_position_m"].to_numpy(float)
    when = np.interp(position_cm, grown_cm, time_s)
    return np.where(position_cm <= grown_cm.max() + 1e-9, when, 1e3)


def _draw_mean(ax: Axes, mean: pd.DataFrame) -> None:
    if not len(mean):
        return
    part = mean.iloc[:: max(len(mean) // _MAX_MEAN_POINTS, 1)]
    time_s, position_cm, sigma_cm = (
        part["time_s"].to_numpy(float),
        100 * part["lead_position_m"].to_numpy(float),
        100 * np.nan_to_num(part["lead_position_sigma_m"].to_numpy(float)),
    )
    n_trials = int(mean["n_trials"].iloc[0])
    ax.fill_between(time_s, position_cm - sigma_cm, position_cm + sigma_cm, color=BLUE, alpha=0.2, lw=0)
    ax.plot(
        time_s,
        position_cm,
        "o",
        color=BLUE,
        ms=3.2,
        mec=MUTED,
        mew=0.3,
        label=f"mean of {n_trials} trials,\n± one trial's scatter",
    )


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
        slow, fast = by_name["depletion_slow"], by_name["depletion_fast"]
        growth_mm = 1e3 * slow["lead_position_m"].to_numpy(float)
        low, high = (100 * part["gauge_left"].to_numpy(float) for part in (fast, slow))
        label = f"{float(str(pressure_kPa)):g} kPa: −{100 - high[-1]:.0f} to −{100 - low[-1]:.0f} %"
        ax.fill_between(growth_mm, low, high, color=VINE_COLOURS[i], alpha=0.35, lw=0, label=label)
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


_RMS_PANELS = (
    ("Fig. 4", "position_rms", "rms_position_m", 100.0, "rms of position (cm)", published.POSITION_RMS_CM),
    (
        "Fig. 5",
        "final_speed_rms",
        "rms_final_lead_velocity_m_s",
        1.0,
        "rms of speed at 12 cm (m/s)",
        published.FINAL_SPEED_RMS_M_S,
    ),
)
_DEPARTURES = (
    ("chamber not refilled", "depletion_slow", "depletion_fast", ORANGE),
    ("tail that cannot push", "slack", "slack", GREEN),
    ("both", "depletion_slow_slack", "depletion_fast_slack", PURPLE),
)
_MIN_RMS = 0.01  # Chosen: 0.1 mm and 1 cm/s, a hundredth of the printed errors


@figure("paper_table2", "paper", "Table II, drawn", data="paper.csv")
def draw_paper_rms(paper: pd.DataFrame, paper_departures: pd.DataFrame) -> Figure:
    """Errors of Eq. (2): published, ours, and those that departures from Eq. (2) would cause. Ours, with trials
    simulated by Eq. (2), come only from scatter of vines and pressures. A departure that changes nothing at a
    pressure is not drawn there.
    """
    fig = new_figure(11.0, 4.9)
    axes = fig.subplots(1, 2)
    for ax, (shown, row, column, factor, label, printed) in zip(axes, _RMS_PANELS, strict=True):
        ours = {kPa: _ours(paper, f"{row}_{kPa:g}kPa") for kPa in printed}
        of_figure = paper_departures[paper_departures["figure"] == shown]
        _draw_rms_panel(ax, printed, ours, of_figure.assign(size=factor * of_figure[column]))
        ax.set(ylabel=label, title=f"{shown} and Table II")
    handles, labels = axes[0].get_legend_handles_labels()
    fig.legend(handles, labels, loc="outside lower center", ncols=len(labels), fontsize=9.5)
    return fig


def _ours(paper: pd.DataFrame, row: str) -> float:
    values = paper.loc[paper["row"] == row, "ours"]
    return float(values.iloc[0]) if len(values) else float("nan")


def _draw_rms_panel(ax: Axes, printed: dict[int, float], ours: dict[int, float], departures: pd.DataFrame) -> None:
    places = np.arange(len(printed), dtype=float)
    ax.set_yscale("log")
    ax.plot(places - 0.3, list(printed.values()), "D", color=INK, ms=8, label="published")
    ax.plot(
        places - 0.15,
        list(ours.values()),
        "o",
        mfc="none",
        mec=BLUE,
        mew=1.8,
        ms=8,
        label="ours",
    )
    for k, (label, low_name, high_name, colour) in enumerate(_DEPARTURES):
        low, high = (
            np.array([_departure_size(departures, kPa, name) for kPa in printed]) for name in (low_name, high_name)
        )
        shown = high >= _MIN_RMS
        middle = np.sqrt(np.maximum(low, _MIN_RMS) * np.maximum(high, _MIN_RMS))
        ax.errorbar(
            (places + 0.15 * k)[shown],
            middle[shown],
            yerr=[(middle - np.maximum(low, _MIN_RMS))[shown], (high - middle)[shown]],
            fmt="_",
            color=colour,
            ms=11,
            mew=2,
            elinewidth=7,
            label=label,
        )
    ax.set_xticks(places, [f"{kPa:g} kPa" for kPa in printed])
    ax.grid(visible=False, axis="x")
    ax.set_xlim(-0.6, len(printed) - 0.4)
    plain_log_ticks(ax, "y")


def _departure_size(departures: pd.DataFrame, pressure_kPa: float, name: str) -> float:
    chosen = departures[(departures["departure"] == name) & np.isclose(departures["pressure_kPa"], pressure_kPa)]
    return float(chosen["size"].iloc[0]) if len(chosen) else float("nan")


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
        colour = VINE_COLOURS[i % len(VINE_COLOURS)]
        speed, sigma = (group[f"final_lead_velocity{part}_m_s"] for part in ("", "_sigma"))
        error_points(ax, group["payload_g"], speed, sigma, i, f"{float(str(pressure_kPa)):.4g} kPa")
        near = np.isclose(paper_speed_curves["pressure_kPa"], float(str(pressure_kPa)))
        curve = paper_speed_curves[near].sort_values("payload_g")
        label = "Eq. (2), B proportional to the wall" if i == 0 else None
        ax.plot(curve["payload_g"], curve["final_lead_velocity_m_s"], color=colour, lw=1.5, label=label)
    counts = reached["n_final"].astype(int)
    ax.set(xlabel="payload (g)", ylabel="speed of the leading edge (m/s)")
    up_from_zero(ax)
    error = ", ± standard error" if counts.max() > 1 else ""
    title = f"{reached['vine'].iloc[0]}, after {reached['final_at_mm'].iloc[0]:.4g} mm\n"
    title += f"N = {counted(int(counts.min()), int(counts.max()), 'trial')} per point{error}"
    legend_above(ax, n_columns=2, title=title, alignment="left", fontsize=9)
    note_below(fig, _FIG5_NOTE)
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
    printed = {"B": B, "source": f"{published.SOURCE}, printed"}
    return draw_scaling(scaling, printed, _FIG7_VIRTUAL if _is_virtual(paper) else "")


@figure("paper_fig8", "paper", "Fig. 8: steady speed and scale", data="conditions.csv")
def draw_paper_steady_speeds(scaling: dict[str, Any], paper: pd.DataFrame) -> Figure | None:
    """Steady tail speed of the four scales at 24 kPa, and divided by the diameter, with straight lines (full) and
    power laws (dashed) through the means of vines.
    """
    families = _near(scaling["steady_speed"], published.STEADY_SPEED_KPA)
    return draw_speed_scaling({"steady_speed": families}, _FIG8_NOTE + (_FIG8_VIRTUAL if _is_virtual(paper) else ""))


@figure("paper_fig9", "paper", "Fig. 9: energy efficiency", data="conditions.csv")
def draw_paper_efficiency(scaling: dict[str, Any]) -> Figure | None:
    """Energy efficiency at 34 kPa with 35.6 g after 150 mm of growth, defined in three ways. Simulated vines of
    other walls than those of Table I have B in proportion to the wall.
    """
    return draw_efficiency({"efficiency": _near(scaling["efficiency"], published.EFFICIENCY_KPA)}, _FIG9_NOTE)


_FIG5_NOTE = (
    "B of this vine and the payloads other than 35.6 g are not printed; the paper shows its points only in a plot"
)
_FIG7_VIRTUAL = (
    "Of the 12 mm vines only that of 100 µm has a printed B. Virtual vines with other walls were simulated with B "
    "proportional to the wall: their straight line is an input"
)
_FIG8_NOTE = (
    "Alvarez et al. (2025): linear, R² = 0.935, from which p = 0.033 (printed: 0.32). The B printed in Fig. 6 do not "
    "give linearly increasing speeds"
)
_FIG8_VIRTUAL = ": virtual vines simulated with them cannot test one figure against the other"
_FIG9_NOTE = "Alvarez et al. (2025): higher for thinner walls, no clear trend with diameter; values are only plotted"


def _is_virtual(paper: pd.DataFrame) -> bool:
    """Whether the trials were simulated from the paper's numbers."""
    return bool(paper["mark"].str.startswith("simulated").any())


def _near(families: list[dict[str, Any]], pressure_kPa: float) -> list[dict[str, Any]]:
    return [family for family in families if abs(family["pressure_kPa"] / pressure_kPa - 1) < 0.02]
