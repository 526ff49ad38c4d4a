"""How much of the work became motion: energy efficiency against wall and diameter, counted in three ways."""

from __future__ import annotations

import textwrap
from typing import TYPE_CHECKING, Any

import numpy as np

from vinetrack.core.numbers import interval, number
from vinetrack.figures.style import MUTED, VINE_COLOURS, VINE_MARKERS, blank, counted, look, note_below

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

VARIANTS = {
    "efficiency": "½ m(x) ẋ² / (P₀ A y)",
    "efficiency_payload": "payload's motion alone",
    "efficiency_with_weight": "work of the weight in the denominator",
}
_AXES = {"thickness_um": ("wall thickness (µm)", "wall"), "diameter_mm": ("diameter (mm)", "diameter")}
_UNITS = {"thickness_um": "µm", "diameter_mm": "mm"}


def draw_efficiency(scaling: dict[str, Any], note: str = "") -> Figure:
    """Draw the largest family of conditions that differ in size alone.

    Parameters
    ----------
    scaling : as in `scaling.json`; its `efficiency`.
    note : a sentence to set below, such as what somebody else published.
    """
    from matplotlib.figure import Figure

    families = scaling.get("efficiency") or []
    if not families:
        return blank("No two vines of different size were grown to one place at one pressure with one payload.")
    family = families[0]
    along = [name for name in _AXES if len(set(family[name])) > 1]
    shown = [key for key in VARIANTS if np.any(np.array(family[key], dtype=float) > 0)]
    with look():
        fig = Figure(figsize=(0.9 + 3.6 * len(shown), 1.0 + 3.5 * len(along)), layout="constrained")
        axes = fig.subplots(len(along), len(shown), squeeze=False, sharey=True)
        for row, x in enumerate(along):
            for ax, key in zip(axes[row], shown, strict=True):
                _draw_panel(ax, family, key, x)
                ax.set_xlabel(_AXES[x][0])
                if row == 0:
                    ax.set_title(VARIANTS[key], fontsize=10.5)
            axes[row][0].set(ylabel="energy efficiency (%)", ylim=(0, 1.08 * max(ax.dataLim.y1 for ax in axes[row])))
            axes[row][-1].legend(loc="upper left", bbox_to_anchor=(1.02, 1.0), borderaxespad=0.0, fontsize=9)
        fig.suptitle(_title(family, len(families)), fontsize=11, x=0.01, ha="left")
        note_below(fig, note)
    return fig


def _draw_panel(ax: Axes, family: dict[str, Any], key: str, x: str) -> None:
    other = next(name for name in _AXES if name != x)
    sizes, others, values, errors = (np.array(family[name], dtype=float) for name in (x, other, key, f"{key}_sigma"))
    for i, size in enumerate(np.unique(others)):
        chosen = np.flatnonzero(others == size)
        chosen = chosen[np.argsort(sizes[chosen])]
        ax.errorbar(
            sizes[chosen],
            100 * values[chosen],
            yerr=100 * np.nan_to_num(errors[chosen]),
            fmt=VINE_MARKERS[i % len(VINE_MARKERS)],
            ls="-",
            color=VINE_COLOURS[i % len(VINE_COLOURS)],
            ms=5.5,
            lw=1.2,
            capsize=3,
            label=f"{size:.4g} {_UNITS[other]}",
        )
    ax.set_xlim(0, 1.12 * sizes.max())
    ax.text(0.03, 0.03, _words(family["trend"][key], x), transform=ax.transAxes, fontsize=8.5, color=MUTED)


def _words(trend: dict[str, Any], x: str) -> str:
    if trend.get("refused"):
        return f"no trend: {textwrap.fill(str(trend['refused']), 30)}"
    if x not in trend:
        return ""
    power = trend[x]
    spread, p = interval(power["power_95"]), number(power["p"], 2)
    return f"power of the {_AXES[x][1]} {number(power['power'], 2)}\n({spread}), p = {p}"


def _title(family: dict[str, Any], n_families: int) -> str:
    counts = [int(count) for count in family["n_efficiency"]]
    error = ", ± standard error" if max(counts) > 1 else ""
    load = f" with {family['payload_g']:.4g} g" if family["payload_g"] else " without payload"
    left = n_families - 1
    more = f"; {left} more {'family' if left == 1 else 'families'} in scaling.json" if left else ""
    return (
        f"{family['pressure_kPa']:.4g} kPa{load}, after {family['efficiency_at_mm']:.4g} mm of growth; "
        f"N = {counted(min(counts), max(counts), 'trial')} a point{error}{more}"
    )
