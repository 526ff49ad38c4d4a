"""The paper's Fig. 6 in our drawing: growth force against steady speed of four scales, by its rule and by ours."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from vinetrack.core import published
from vinetrack.core.numbers import half_width, number, with_error
from vinetrack.figures.style import INK, PAPER, VINE_COLOURS, VINE_MARKERS, blank, look, plain_log_ticks

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_PANELS = (
    ("paper", "x_ss_paper_m_s", "force_paper_N", "eligible", "The published rule to the letter"),
    ("both_axes", "x_ss_m_s", "force_N", "used", "Weight in the force, gated windows, errors on both axes"),
)


def draw_paper_damping(
    points: pd.DataFrame, damping: Mapping[str, Any], printed: Mapping[int, float], exponent: float
) -> Figure:
    """Draw two panels.

    Parameters
    ----------
    points : as in `damping_points.csv`.
    damping : as in `damping.json`.
    printed, exponent : published B by scale, and n.
    """
    from matplotlib.figure import Figure

    sizes = zip(points["diameter_mm"], points["thickness_um"], strict=True)
    scaled = points.assign(scale=[published.scale_of(float(D), float(t)) or 0 for D, t in sizes])
    scaled = scaled[scaled["scale"] > 0]
    if not len(scaled):
        return blank("No trial of these is of a printed size.")
    if not any((scaled[wanted] & (scaled[y] > 0) & (scaled[x] > 0)).any() for _, x, y, wanted, _ in _PANELS):
        return blank("No trial of a printed size has a steady speed.")
    with look():
        fig = Figure(figsize=(12.0, 6.2), layout="constrained")
        axes = fig.subplots(1, 2, sharex=True, sharey=True)
        for ax, (method, x, y, wanted, title) in zip(axes, _PANELS, strict=True):
            law = damping.get(method) or {}
            own = scaled[scaled[wanted] & (scaled[x] > 0) & (scaled[y] > 0)]
            _draw_panel(ax, own, x, y, law, printed, exponent)
            n = with_error(law.get("n"), half_width(law.get("n_95")))
            ax.set_title(f"{title}\nn = {n} (95 %), printed {exponent:g}", fontsize=10.5)
            ax.set_xlabel("steady tail speed x_ss (m/s)")
        axes[0].set_ylabel("growth force above yield (N)")
        for ax in axes:
            plain_log_ticks(ax)
            if ax.get_legend_handles_labels()[0]:
                ax.legend(loc="upper center", bbox_to_anchor=(0.5, -0.12), ncols=2, fontsize=9)
    return fig


def _draw_panel(
    ax: Axes,
    own: pd.DataFrame,
    x: str,
    y: str,
    law: Mapping[str, Any],
    printed: Mapping[int, float],
    exponent: float,
) -> None:
    ax.set(xscale="log", yscale="log")
    for i, (scale, B) in enumerate(printed.items()):
        part = own[own["scale"] == scale]
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
            ls=(0, (4, 2)),
            label="printed B and n" if scale == max(printed) else None,
        )
        if fitted and law.get("n"):
            ax.plot(span, fitted["B"] * span ** law["n"], color=colour, lw=1.4)
