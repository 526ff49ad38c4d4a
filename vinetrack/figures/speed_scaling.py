"""Steady speed against the size of scaled copies, one family a pressure; beside it the same divided by the diameter.

Straight lines are full, power laws dashed; bars are standard errors, those of a single trial its own reading's alone.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from vinetrack.core.numbers import interval, number
from vinetrack.figures.style import (
    VINE_COLOURS,
    VINE_MARKERS,
    blank,
    counted,
    legend_above,
    look,
    note_below,
    up_from_zero,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MAX_FAMILIES = 5
_PANELS = (
    ("x_ss_m_s", "x_ss_sigma_m_s", "steady tail speed x_ss (m/s)", "Speed"),
    ("x_ss_over_diameter_1_s", "x_ss_over_diameter_sigma_1_s", "x_ss / diameter (1/s)", "Speed over diameter"),
)


def draw_speed_scaling(scaling: dict[str, Any], note: str = "") -> Figure:
    """Draw x_ss and x_ss/D against D.

    Parameters
    ----------
    scaling : as in `scaling.json`; its `steady_speed`.
    note : a sentence to set below, such as what somebody else published.
    """
    from matplotlib.figure import Figure

    families = scaling.get("steady_speed") or []
    if not families:
        return blank("No two vines that are scaled copies of each other have a steady speed at one pressure.")
    with look():
        fig = Figure(figsize=(11.0, 5.2 + 0.45 * min(len(families), MAX_FAMILIES)), layout="constrained")
        for ax, (key, sigma, label, title) in zip(fig.subplots(1, 2), _PANELS, strict=True):
            for i, family in enumerate(families[:MAX_FAMILIES]):
                lines = family if key == "x_ss_m_s" else family["over_diameter"]
                _draw_family(ax, family, key, sigma, lines, i)
            ax.set(xlabel="diameter (mm)", ylabel=label)
            up_from_zero(ax, x=True)
            left_out = len(families) - MAX_FAMILIES
            more = f", {left_out} more pressures in scaling.json" if left_out > 0 else ""
            legend_above(ax, n_columns=1, title=title + more, alignment="left", fontsize=9)
        note_below(fig, " ".join(filter(None, [note, _alone(families[:MAX_FAMILIES])])))
    return fig


def _draw_family(ax: Axes, family: dict[str, Any], key: str, sigma: str, lines: dict[str, Any], index: int) -> None:
    colour, marker = VINE_COLOURS[index % len(VINE_COLOURS)], VINE_MARKERS[index % len(VINE_MARKERS)]
    sizes, values = (np.array(family[name], dtype=float) for name in ("sizes", key))
    errors = np.nan_to_num(np.array(family[sigma], dtype=float))
    counts = [int(count) for count in family["n_steady"]]
    trials = counted(min(counts), max(counts), "trial")
    label = f"{family['pressure_kPa']:.4g} kPa, N = {counted(sizes.size, sizes.size, 'vine')} of {trials}"
    ax.errorbar(
        sizes,
        values,
        yerr=errors,
        fmt=marker,
        color=colour,
        ms=6,
        capsize=3,
        elinewidth=1.3,
        label=f"{label}{_statistics(lines)}",
    )
    span = np.linspace(0.8 * sizes.min(), 1.1 * sizes.max(), 100)
    if line := lines["line"]:
        ax.plot(span, line["intercept"] + line["slope"] * span, color=colour, lw=1.5)
    if power := lines["power"]:
        curve = np.exp(power["intercept"]) * span ** power["slope"]
        ax.plot(span, curve, color=colour, lw=1.3, ls=(0, (4, 2)))


def _statistics(lines: dict[str, Any]) -> str:
    if lines["refused"]:
        return f"\nno trend: {lines['refused']}"
    line, power = lines["line"], lines["power"]
    slope = f"{number(power['slope'], 2)} ({interval(power['slope_95'])}), p = {number(power['p'], 2)}"
    return f"\npower (dashed) {slope}\nline (full): R² {number(line['R2'])}, p = {number(line['p'], 2)}"


def _alone(families: list[dict[str, Any]]) -> str:
    if not any(count == 1 for family in families for count in family["n_steady"]):
        return ""
    return "The bar of a single trial is the error of its reading, without what replicates would differ by."
