"""Simulated motions: predictions for vines not yet built, designs of them, one effect, and the power to detect it."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from vinetrack.figures import style as st
from vinetrack.narrative.diagnosis_text import size_text
from vinetrack.narrative.verdict_text import spaced_name

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from vinetrack.diagnosis.result import Power
    from vinetrack.planning.prediction import Choice, VinePrediction

_LOG_RATIO = 6.0  # Chosen: at a larger ratio of slowest to fastest the latter takes less than a sixth of a linear axis

# ------------------------------------------------------------------------------
# Figures of designs: the fastest vine, and the pressure loss of a chamber.


@st.look()
def draw_choice(choices: Sequence[Choice]) -> Figure:
    """Draw the films side by side: speed against diameter, and the certainty of the choice."""
    fig = st.new_figure(9.6, 4.4, layout=None)
    curves, bars = fig.subplots(1, 2, sharey=True, width_ratios=(3, 2))
    films = [f"{1e6 * choice.prediction.inputs.trial.thickness_m:g}" for choice in choices]
    for k, (choice, film) in enumerate(zip(choices, films, strict=True)):
        colour, marker = st.VINE_COLOURS[k % len(st.VINE_COLOURS)], st.VINE_MARKERS[k % len(st.VINE_MARKERS)]
        final, diameter_mm = choice.prediction.final, 1e3 * choice.prediction.inputs.trial.diameter_m
        curves.plot(1e3 * choice.others[:, 0], choice.others[:, 1], color=colour, label=f"{film} µm")
        curves.plot(diameter_mm, final.median, marker, color=colour, ms=8, clip_on=False)
        bars.plot([k, k], [final.low, final.high], color=colour, lw=9, alpha=0.35, solid_capstyle="butt")
        bars.plot(k, final.median, marker, color=colour, ms=8)
        at = (k, final.high), (0, 5)
        bars.annotate(f"{choice.odds:.0%}", *at, textcoords="offset points", ha="center", fontsize=10)
    final = choices[0].prediction.final
    label = f"{final.name} (m/s)" if final.y_over_L == 1 else f"{final.name}\nat y/L = {final.y_over_L:g} (m/s)"
    fastest = max(choice.prediction.final.high for choice in choices)
    curves.set(xlabel="diameter (mm)", ylabel=label, ylim=(0.0, 1.12 * fastest))
    st.small_title(curves, "best length and pressure at each diameter", fontsize=10)
    curves.legend(title="film", fontsize=9.5)
    bars.set(xlabel="film (µm)", xlim=(-0.6, len(films) - 0.4))
    bars.set_xticks(range(len(films)), films)
    st.small_title(bars, "90 % band; percentage of draws in which it is the fastest", fontsize=10)
    fig.subplots_adjust(left=0.1, right=0.985, top=0.9, bottom=0.2, wspace=0.08)
    fig.text(0.1, 0.02, "line, marker: median of the prediction; bar: 90 % interval", color=st.MUTED, fontsize=8.8)
    return fig


@st.look()
def draw_reservoir(
    volumes_m3: np.ndarray, losses: Mapping[str, np.ndarray], loss: float, swept_m3: float, chosen_m3: float
) -> Figure:
    """Draw the part of its gauge pressure that a closed chamber loses to a vine. Shapes (n_volumes,)."""
    # Below 10 mL the axis is in millilitres, so that its ticks need no exponent.
    factor, unit = (1e3, "L") if volumes_m3[0] >= 1e-5 else (1e6, "mL")
    fig, ax = st.one_panel(7.2, 4.4, xscale="log", ylabel="gauge pressure lost (%)")
    ax.set_xlabel(f"volume of the chamber ({unit}); of the grown vine {factor * swept_m3:.3g} {unit}")
    for (law, lost), colour, style in zip(losses.items(), (st.BLUE, st.VERMILLION), ("-", st.DASHED), strict=True):
        ax.plot(factor * volumes_m3, 100 * lost, color=colour, ls=style, label=law)
    slow, fast = losses.values()
    st.band(ax, factor * volumes_m3, 100 * slow, 100 * fast, st.MUTED, 0.12)
    words: dict[str, Any] = {"textcoords": "offset points", "fontsize": 9.5}
    ax.axhline(100 * loss, color=st.INK, lw=1.0)
    at = (0.99, 100 * loss), (0, 3), ("axes fraction", "data")
    ax.annotate(f"allowed: {100 * loss:g} %", *at, ha="right", **words)
    if volumes_m3[0] < chosen_m3 < volumes_m3[-1]:
        ax.axvline(factor * chosen_m3, color=st.MUTED, lw=1.2)
        at = (factor * chosen_m3, 0.97), (5, 0), ("data", "axes fraction")
        ax.annotate(f"chosen: {factor * chosen_m3:.3g} {unit}", *at, va="top", **words)
    ax.set(xlim=(factor * volumes_m3[0], factor * volumes_m3[-1]), ylim=(0.0, min(800 * loss, 100.0)))
    st.plain_log_ticks(ax, "x")
    ax.legend(loc="upper right", bbox_to_anchor=(1.0, 0.9))
    return fig


# ------------------------------------------------------------------------------
# Predictions, and the motion with and without one effect.


@st.look()
def draw_predictions(predictions: Sequence[VinePrediction], titles: Sequence[str], at_fraction: float) -> Figure:
    """Draw one condition with the uncertainty budget of its final speed, or several conditions superposed."""
    drawn = predictions[: len(st.VINE_COLOURS)]
    width_in = 9.6
    fig = st.new_figure(width_in, 7.2, layout=None)
    axes = fig.subplots(2, 2)
    for colour, prediction in zip(st.VINE_COLOURS, drawn, strict=False):
        _draw_curves(axes, prediction.curve, colour)
    _label_prediction(axes, drawn, at_fraction)
    if len(drawn) == 1:
        _draw_shares(axes[1, 1], drawn[0])
    else:
        named = zip(st.VINE_COLOURS, titles, strict=False)  # the condition of each colour, instead of the bars
        keys = [st.line_key(textwrap.fill(title, 50), color=colour, lw=3) for colour, title in named]
        if (n_more := len(titles) - len(st.VINE_COLOURS)) > 0:
            keys.append(st.line_key(f"and {n_more} more, not drawn", ls="none"))
        axes[1, 1].set_axis_off()
        axes[1, 1].legend(handles=keys, loc="upper left", fontsize=9.2, labelspacing=1.0, borderaxespad=0.0)
    title = titles[0] if len(drawn) == 1 else f"{len(titles)} conditions"
    fig.text(0.075, 0.955, title, fontweight="bold", fontsize=st.fitting_size(title, 0.9 * 72 * width_in, 12))
    words = "line: median; band: 90 % interval; simulated from the distributions of the inputs"
    fig.text(0.075, 0.012, words, color=st.MUTED, fontsize=8.8)
    fig.align_ylabels(axes[:, 0])
    fig.subplots_adjust(left=0.075, right=0.985, top=0.91, bottom=0.105, hspace=0.3, wspace=0.27)
    return fig


def _draw_curves(axes: np.ndarray, table: pd.DataFrame, colour: str) -> None:
    """Position against time; speed and tension against growth."""
    position, speed, tension = axes.flat[:3]
    y_mm, along = st.column(table, "lead_position_m", 1e3), st.column(table, "y_over_L")
    low_ms, median_ms, high_ms = (st.column(table, name, 1e3) for name in ("time_low_90_s", "time_s", "time_high_90_s"))
    # The axis ends with the slow limit, but at most at four times the end of the median.
    early, middle, late = (float(np.max(t[np.isfinite(t)], initial=0.0)) for t in (low_ms, median_ms, high_ms))
    last = min(late, 4 * middle) if middle > 0 else early or 1.0
    ends = (np.where(np.isfinite(t), t, last) for t in (low_ms, high_ms))
    position.fill_betweenx(y_mm, *ends, color=colour, alpha=0.18, lw=0)
    come = np.isfinite(median_ms)
    position.plot(median_ms[come], y_mm[come], color=colour)
    position.set_xlim(0.0, max(last, position.get_xlim()[1] if position.lines[1:] else 0.0))
    for ax, name, unit in ((speed, "lead_velocity", "m_s"), (tension, "tension", "N")):
        low, high = (st.column(table, f"{name}_{side}_90_{unit}") for side in ("low", "high"))
        st.band(ax, along, low, high, colour, 0.18)
        ax.plot(along, table[f"{name}_{unit}"], color=colour)


def _label_prediction(axes: np.ndarray, drawn: Sequence[VinePrediction], at_fraction: float) -> None:
    position, speed, tension = axes.flat[:3]
    position.set(xlabel="time since release (ms)", ylabel="leading edge y (mm)", ylim=(0.0, None))
    for ax, label in ((speed, "speed of the leading edge ẏ (m/s)"), (tension, "tension of the tail (N)")):
        ax.set(xlabel="growth y/L", ylabel=label, xlim=(0.0, 1.0))
        ax.axvline(at_fraction, color=st.MUTED, lw=0.9, ls=st.DASHED)
    speed.set_ylim(max(speed.get_ylim()[0], 0.0))
    at: dict[str, Any] = {"transform": speed.get_xaxis_transform(), "ha": "right", "fontsize": 9, "color": st.MUTED}
    speed.text(at_fraction - 0.015, 0.03, f"y/L = {at_fraction:g}", **at)
    lowest = min(prediction.curve["tension_low_90_N"].min() for prediction in drawn)
    # Compression below 1 % of the largest tension is rounding of the simulation.
    if lowest < -0.01 * max(prediction.curve["tension_high_90_N"].max() for prediction in drawn):
        tension.axhline(0.0, color=st.INK, lw=0.8)
        st.small_title(tension, "below 0 the model predicts compression in the tail", fontsize=9.5, color=st.MUTED)
    ends = [float(prediction.curve["time_s"].replace(np.inf, np.nan).max()) for prediction in drawn]
    if max(ends) > _LOG_RATIO * min(ends):
        position.set_xscale("log")
        position.set_xlim(left=10.0 * min(ends))
        st.plain_log_ticks(position, "x")


def _draw_shares(ax: Axes, prediction: VinePrediction) -> None:
    """Bars of the final speed: with all uncertainties, then with each alone."""
    low, median, high = prediction.final.low, prediction.final.median, prediction.final.high
    bars = [("all inputs", low, high), *((share.name, share.low, share.high) for share in prediction.shares)]
    for k, (_, start, stop) in enumerate(bars):
        ax.barh(k, stop - start, left=start, height=0.55, color=st.BLUE, alpha=0.85 if k == 0 else 0.4, lw=0)
    ax.axvline(median, color=st.INK, lw=1.0)
    names = [textwrap.fill(name if len(name) <= 15 else name.replace("_", " "), 15) for name, _, _ in bars]
    ax.set_yticks(range(len(bars)), names, fontsize=8.8)
    ax.invert_yaxis()
    ax.margins(x=0.06)
    ax.use_sticky_edges = False
    if low > 0 and high > _LOG_RATIO * low:
        ax.set_xscale("log")
        st.plain_log_ticks(ax, "x")
    ax.grid(visible=False, axis="y")
    ax.set_xlabel(f"{prediction.final.name} (m/s)")
    ax.set_title("Uncertainty budget", fontsize=10.5)


# ------------------------------------------------------------------------------
# Detection power of a campaign: the probability of detecting each effect against its size, as a map.
#
# One row per effect; columns are sizes relative to the largest plausible one. The sizes of 50 and 90 % power are listed
# at the end of each row in the unit of the effect.


@st.look()
def draw_power(power: Power) -> Figure | None:
    """Draw the power to detect each effect against its size, in the order of what is detected first."""
    from matplotlib.colors import LinearSegmentedColormap

    entries = sorted(power.effects, key=lambda one: abs((one.size_at(0.9) - one.zero) / (one.largest - one.zero)))
    if not entries or power.wary:
        return None
    n = len(entries)
    least, most, n_columns = 1e-4, 3.0, 108  # sizes relative to the largest plausible one, 24 to a decade (chosen)
    parts = np.geomspace(least, most, n_columns)
    probabilities = np.array([
        [one.probability_at(one.zero + part * (one.largest - one.zero)) for part in parts] for one in entries
    ])  # fmt: skip
    fig = st.new_figure(9.6, 0.31 * n + 1.75)  # in: a line of letters for each row, and title, scale and legend
    ax, sizes = fig.subplots(1, 2, width_ratios=(1.45, 1.0))
    shades = LinearSegmentedColormap.from_list("power", ["#ffffff", "#d7e6f2", "#7fb2d8", st.BLUE, "#003f66"])
    mesh = ax.pcolormesh(parts, np.arange(n), probabilities, cmap=shades, vmin=0, vmax=1, rasterized=True)
    ax.set(xscale="log", xlim=(least, most), ylim=(n - 0.5, -0.5), xlabel="size relative to the largest plausible")
    ax.grid(visible=False)
    ax.set_xticks([0.0001, 0.001, 0.01, 0.1, 1.0], labels=["0.0001", "0.001", "0.01", "0.1", "1"])
    # A white line below the dots keeps them visible on the dark part of the map.
    ax.axvline(1.0, color="white", linewidth=2.2)
    ax.axvline(1.0, color=st.INK, linewidth=1.2, linestyle=":")
    st.names_beside(ax, [f"{spaced_name(entry.effect)}, {entry.symbol}" for entry in entries])
    for row in range(1, n):
        ax.axhline(row - 0.5, color=st.GRID, linewidth=0.7)
    # Sizes in the unit of each effect; grey beyond the plausible range
    sizes.set_axis_off()
    sizes.set(xlim=(0, 1), ylim=(n - 0.5, -0.5))
    for x, words in ((0.0, "50 %\npower"), (0.35, "90 %\npower"), (0.7, "largest\nplausible")):
        sizes.text(x, -0.65, words, va="bottom", fontsize=9, color=st.INK)
    for row, one in enumerate(entries):
        for x, value in ((0.0, one.size_at(0.5)), (0.35, one.size_at(0.9)), (0.7, one.largest)):
            beyond = x == 0.7 or abs(value - one.zero) > abs(one.largest - one.zero)
            sizes.text(x, row, size_text(one, value), va="center", fontsize=9, color=st.MUTED if beyond else st.INK)
    bar = fig.colorbar(mesh, ax=ax, location="bottom", fraction=0.06, pad=0.02, aspect=50)
    bar.set_label("power: probability of detection (%)")
    bar.set_ticks([0, 0.5, 0.9, 1], labels=["0", "50", "90", "100"])
    bar.outline.set_visible(False)
    trials = f"{power.n_trials} trial{'s' if power.n_trials != 1 else ''}"
    ax.set_title(f"What {trials} can detect", loc="left", pad=26)
    return fig
