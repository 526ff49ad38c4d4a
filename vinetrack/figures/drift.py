"""Parameters that drift with a condition they should not know, before and after the effects were added.

Each panel is one parameter against one condition: the value that suits a group of trials best, over that of the common
law. A model that lacks nothing leaves all groups at 1.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from vinetrack.figures.before_after import AFTER, BEFORE
from vinetrack.figures.style import INK, MUTED, VINE_MARKERS, blank, look

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MAX_PANELS = 6
AXES = {
    "pressure_Pa": ("pressure (kPa)", 1e-3),
    "payload_kg": ("payload (g)", 1e3),
    "growth_angle_rad": ("growth angle (°)", 180 / math.pi),
    "chamber_m3": ("chamber (l)", 1e3),
    "inlet_m": ("inlet (mm)", 1e3),
    "vine": ("vine", 1.0),
}
"""Conditions: how each is shown, and the factor from SI."""

MODELS = {"before": (BEFORE, "before", -0.06), "after": (AFTER, "after", 0.06)}


def draw_drift(groups: pd.DataFrame, added: str = "") -> Figure:
    """Draw what suits every group best.

    Parameters
    ----------
    groups : one row a group: `model` (`before` or `after`), `parameter, vine, symbol, against, level, ratio,
        ratio_sigma, n_trials`; SI, `level` NaN where the groups are vines. Panels in order of first appearance.
    added : the effects that were added, in words.
    """
    from matplotlib.figure import Figure

    known = groups[np.isfinite(groups["ratio"].astype(float))] if len(groups) else groups
    if not len(known):
        return blank("No parameter could be asked whether it drifts.")
    # What only the larger model has can show no drift that was mended.
    asked = known[known["model"] == "before"] if (known["model"] == "before").any() else known
    panels = list(dict.fromkeys(zip(asked["parameter"], asked["against"], strict=True)))[:MAX_PANELS]
    vines = [vine for vine in dict.fromkeys(known["vine"]) if vine]
    markers = {vine: VINE_MARKERS[i % len(VINE_MARKERS)] for i, vine in enumerate(vines)} | {"": "o"}
    n_columns = min(len(panels), 3)
    n_rows = math.ceil(len(panels) / n_columns)
    with look():
        fig = Figure(figsize=(1.0 + 3.2 * n_columns, 0.9 + 2.6 * n_rows), layout="constrained")
        axes = fig.subplots(n_rows, n_columns, squeeze=False)
        for ax, (parameter, against) in zip(axes.flat, panels, strict=False):
            chosen = known[(known["parameter"] == parameter) & (known["against"] == against)]
            _draw_panel(ax, chosen, str(against), markers)
        for ax in axes.flat[len(panels) :]:
            ax.set_visible(False)
        fig.supylabel("value / common law", fontsize=11)
        _legend(fig, known, markers, added)
    return fig


def _draw_panel(ax: Axes, groups: pd.DataFrame, against: str, markers: dict[str, str]) -> None:
    words, factor = AXES.get(against, (against.replace("_", " "), 1.0))
    names = list(dict.fromkeys(groups["vine"]))
    by_vine = against == "vine"
    for model, (colour, _, offset) in MODELS.items():
        of_model = groups[groups["model"] == model]
        for vine, rows in [("", of_model)] if by_vine else of_model.groupby("vine", sort=False):
            ordered = rows.sort_values("level")
            x = np.array([names.index(name) for name in ordered["vine"]], dtype=float) + offset
            x = x if by_vine else factor * ordered["level"].to_numpy(dtype=float)
            style: dict[str, Any] = {"color": colour, "marker": markers.get(str(vine), "o"), "ms": 5, "elinewidth": 1.0}
            line = "none" if by_vine else "-" if model == "after" else (0, (4, 2))
            ax.errorbar(x, ordered["ratio"], ordered["ratio_sigma"], lw=1.1, ls=line, **style)
    ax.axhline(1, color=INK, lw=0.8)
    symbol = str(groups["symbol"].iloc[0])
    count = int(groups.loc[groups["model"] == groups["model"].iloc[0], "n_trials"].sum())
    ax.set_title(f"{symbol} against {words.split(' (')[0]}, N = {count}", fontsize=9.5, fontweight="normal")
    ax.set_xlabel(words, fontsize=10)
    if by_vine:
        ax.set_xticks(range(len(names)), names, fontsize=8)
        ax.margins(x=0.25)
    ax.locator_params(axis="y", nbins=5)


def _legend(fig: Figure, groups: pd.DataFrame, markers: dict[str, str], added: str) -> None:
    from matplotlib.lines import Line2D

    present = set(groups["model"])
    handles = [
        Line2D(
            [],
            [],
            color=colour,
            marker="o",
            ms=5,
            label=f"{words}: with {added}" if model == "after" and added else words,
        )
        for model, (colour, words, _) in MODELS.items()
        if model in present
    ]
    handles += [
        Line2D([], [], color=MUTED, marker=marker, ls="none", label=vine) for vine, marker in markers.items() if vine
    ]
    fig.legend(handles=handles[:10], loc="outside upper left", ncols=min(len(handles), 4), fontsize=9)
