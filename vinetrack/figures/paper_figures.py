"""The paper's figures and Table II redrawn, with the consequences of terms neglected in Eq. (2)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from vinetrack.core import published
from vinetrack.core.units import number, with_interval
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
    blank,
    look,
    plain_log_ticks,
)

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_DAMPING_PANELS = (
    ("paper", "x_ss_paper_m_s", "force_paper_N", "eligible", "The literal published rule"),
    ("both_axes", "x_ss_m_s", "force_N", "used", "Weight in the force, gated windows, errors on both axes"),
)


def draw_paper_damping(
    points: pd.DataFrame, damping: Mapping[str, Any], printed: Mapping[int, float], exponent: float
) -> Figure:
    """Draw growth force against steady speed of the four scales, by the published rule and with errors on both axes."""
    from matplotlib.figure import Figure

    sizes = zip(points["diameter_mm"], points["thickness_um"], strict=True)
    scaled = points.assign(scale=[published.scale_of(float(D), float(t)) or 0 for D, t in sizes])
    scaled = scaled[scaled["scale"] > 0]
    if not len(scaled):
        return blank("No trial of these is of a printed size.")
    if not any((scaled[wanted] & (scaled[y] > 0) & (scaled[x] > 0)).any() for _, x, y, wanted, _ in _DAMPING_PANELS):
        return blank("No trial of a printed size has a steady speed.")
    with look():
        fig = Figure(figsize=(12.0, 6.2), layout="constrained")
        axes = fig.subplots(1, 2, sharex=True, sharey=True)
        for ax, (method, x, y, wanted, title) in zip(axes, _DAMPING_PANELS, strict=True):
            law = damping.get(method) or {}
            steady = scaled[scaled[wanted] & (scaled[x] > 0) & (scaled[y] > 0)]
            _draw_force_panel(ax, steady, x, y, law, printed, exponent)
            n = with_interval(law.get("n"), law.get("n_95"))
            ax.set_title(f"{title}\nn = {n}, printed {exponent:g}", fontsize=10.5)
            ax.set_xlabel("steady tail speed x_ss (m/s)")
        axes[0].set_ylabel("growth force above yield (N)")
        for ax in axes:
            plain_log_ticks(ax)
            if ax.get_legend_handles_labels()[0]:
                ax.legend(loc="upper center", bbox_to_anchor=(0.5, -0.12), ncols=2, fontsize=9)
    return fig


def _draw_force_panel(
    ax: Axes,
    points: pd.DataFrame,
    x: str,
    y: str,
    law: Mapping[str, Any],
    printed: Mapping[int, float],
    exponent: float,
) -> None:
    ax.set(xscale="log", yscale="log")
    for i, (scale, B) in enumerate(printed.items()):
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
            B * span**exponent,
            color=INK,
            lw=1.2,
            ls=DASHED,
            label="printed B and n" if scale == max(printed) else None,
        )
        if fitted and law.get("n"):
            ax.plot(span, fitted["B"] * span ** law["n"], color=colour, lw=1.4)


_BANDS = (
    ("depletion_slow", "depletion_fast", ORANGE, "chamber not refilled,\nisothermal to adiabatic"),
    ("depletion_slow_slack", "depletion_fast_slack", PURPLE, "both"),
)
_MAX_MEAN_POINTS = 40  # Chosen: circles of 3.2 pt along 3 in of panel touch each other where there are more than 70

_MAX_DURATION_RATIO = 1.9  # Chosen: panels end at 1.9 times the duration of Eq. (2); slower motions are cut off


def draw_paper_position(
    motions: pd.DataFrame, means: pd.DataFrame, errors: pd.DataFrame, printed_cm: Mapping[int, float]
) -> Figure:
    """Draw the leading edge at three pressures (Fig. 4), with the consequences of departures from Eq. (2)."""
    from matplotlib.figure import Figure

    pressures = sorted(motions["pressure_kPa"].unique())
    if not pressures:
        return blank("There are no motions to draw.")
    with look():
        fig = Figure(figsize=(12.0, 5.2), layout="constrained")
        axes = fig.subplots(1, len(pressures), squeeze=False, sharey=True)[0]
        for ax, pressure_kPa in zip(axes, pressures, strict=True):
            at_pressure = motions[motions["pressure_kPa"] == pressure_kPa]
            curves = {str(name): part for name, part in at_pressure.groupby("departure", sort=False)}
            _draw_departures(ax, curves)
            _draw_mean(ax, means[means["pressure_kPa"] == pressure_kPa])
            ax.set(
                xlabel="time since release (s)", xlim=(0, _MAX_DURATION_RATIO * float(curves["eq2"]["time_s"].iloc[-1]))
            )
            rms_m = errors.loc[errors["pressure_kPa"] == pressure_kPa, "rms_mean_m"]
            ours = f"ours {100 * float(rms_m.iloc[0]):.2f} cm" if len(rms_m) else "not among the trials"
            ax.set_title(
                f"{pressure_kPa:g} kPa\nrms: printed {printed_cm[round(pressure_kPa)]:.2f} cm, {ours}", fontsize=10.5
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


def draw_paper_reservoir(pressures: pd.DataFrame) -> Figure:
    """Draw the gauge pressure left in the chamber while the largest vine grows, if it is not refilled."""
    from matplotlib.figure import Figure

    with look():
        fig = Figure(figsize=(8.2, 4.8), layout="constrained")
        ax = fig.add_subplot()
        for i, (pressure_kPa, at_pressure) in enumerate(pressures.groupby("pressure_kPa")):
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


def draw_paper_rms(paper: pd.DataFrame, departures: pd.DataFrame) -> Figure:
    """Draw Table II: published errors of Eq. (2), ours, and those that departures from Eq. (2) would cause."""
    from matplotlib.figure import Figure

    with look():
        fig = Figure(figsize=(11.0, 4.9), layout="constrained")
        axes = fig.subplots(1, 2)
        for ax, (figure, row, column, factor, label, printed) in zip(axes, _RMS_PANELS, strict=True):
            ours = {kPa: _ours(paper, f"{row}_{kPa:g}kPa") for kPa in printed}
            of_figure = departures[departures["figure"] == figure]
            _draw_rms_panel(ax, printed, ours, of_figure.assign(size=factor * of_figure[column]))
            ax.set(ylabel=label, title=f"{figure} and Table II")
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
