"""The candidates: by how much each explains the trajectories better than the model in use, and at which size.

One panel a round. Those that the data cannot tell from the best are filled in colour; a hollow bar was predicted from
the sensitivities and not fitted: then its size is the score in standard deviations.
"""

from __future__ import annotations

import textwrap
from typing import TYPE_CHECKING, Any

import numpy as np

from vinetrack.figures.style import BLUE, INK, MUTED, ORANGE, blank, look, rows

if TYPE_CHECKING:
    from collections.abc import Sequence

    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MAX_ROWS = 12
"""Of a round; the table in the report has them all."""

ROLES = {
    "answer": ("in the answer set", BLUE),
    "physical": ("explains less", MUTED),
    "measurement": ("fault of the measurement", ORANGE),
}
_WIDTH_IN = 8.6
_ROW_IN = 0.33


def draw_candidates(rounds: Sequence[tuple[str, pd.DataFrame]]) -> Figure:
    """Draw √Δχ² of every candidate, with its fitted size.

    Parameters
    ----------
    rounds : of each the question in words, and a table with a row a candidate, best first: `effect, kind, status,
        delta_chi2, sigma, in_answer_set, plausible, size` (fitted numbers in words, blank where there are none).
    """
    from matplotlib.figure import Figure

    drawn = [(title, _drawable(table)) for title, table in rounds]
    drawn = [(title, table) for title, table in drawn if len(table)]
    if not drawn:
        return blank("No candidate could be held against these data.")
    heights_in = [_ROW_IN * len(table) + 0.95 for _, table in drawn]
    with look():
        fig = Figure(figsize=(_WIDTH_IN, sum(heights_in) + 0.35), layout="constrained")
        axes = fig.subplots(len(drawn), 1, squeeze=False, height_ratios=heights_in)[:, 0]
        for ax, (title, table) in zip(axes, drawn, strict=True):
            _draw_round(ax, title, table)
        axes[-1].set_xlabel("√Δχ²: how much better the trajectories are explained (σ)")
        _legend(fig, [table for _, table in drawn])
    return fig


def _drawable(table: pd.DataFrame) -> pd.DataFrame:
    """Rows with a height, the answer first and then the highest."""
    gain = np.sqrt(np.maximum(table["delta_chi2"].to_numpy(dtype=float), 0.0))
    score = np.abs(table["sigma"].to_numpy(dtype=float))
    # What was only predicted may gain with the wrong sign, or where the noise was taken too small: its score knows.
    fitted = (table["status"] == "refitted").to_numpy() & np.isfinite(gain)
    height = np.where(fitted | ~np.isfinite(score), gain, score)
    ranked = table.assign(height=height, in_answer_set=table["in_answer_set"].astype(bool))
    known = ranked[np.isfinite(height)]
    return known.sort_values(["in_answer_set", "height"], ascending=False, kind="stable").head(MAX_ROWS)


def role(row: Any) -> str:
    """Which of `ROLES` a candidate has."""
    if row.in_answer_set:
        return "answer"
    return "measurement" if row.kind == "measurement" else "physical"


def _draw_round(ax: Axes, title: str, table: pd.DataFrame) -> None:
    heights = table["height"].to_numpy(dtype=float)
    longest = max(float(heights.max()), 1.0)
    for i, (row, height) in enumerate(zip(rows(table), heights, strict=True)):
        colour = ROLES[role(row)][1]
        fill = colour if row.status == "refitted" else "none"
        ax.barh(i, height, height=0.62, color=fill, edgecolor=colour, lw=1.2, alpha=None if row.in_answer_set else 0.75)
        said = " ".join(part for part in (row.size, "" if row.plausible else "(not plausible)") if part)
        if said:
            ax.annotate(
                textwrap.shorten(said, 62, placeholder="…"),
                (height, i),
                (5, 0),
                textcoords="offset points",
                va="center",
                fontsize=9,
                color=INK if row.in_answer_set else MUTED,
            )
    ax.set_yticks(range(len(table)), [str(name).replace("_", " ") for name in table["effect"]])
    for label, chosen in zip(ax.get_yticklabels(), table["in_answer_set"], strict=True):
        label.set_fontweight("bold" if chosen else "normal")
    ax.set(ylim=(len(table) - 0.4, -0.6), xlim=(0, 1.75 * longest))
    ax.set_title(title, fontsize=10)
    ax.tick_params(axis="y", length=0)
    ax.grid(axis="y", visible=False)
    ax.set_xticks([tick for tick in ax.get_xticks() if tick <= 1.08 * longest])


def _legend(fig: Figure, tables: Sequence[pd.DataFrame]) -> None:
    from matplotlib.patches import Patch

    found = {role(row) for table in tables for row in rows(table)}
    handles = [
        Patch(facecolor=colour, alpha=1.0 if name == "answer" else 0.75, label=words)
        for name, (words, colour) in ROLES.items()
        if name in found
    ]
    if any((table["status"] == "screened").any() for table in tables):
        handles.append(Patch(facecolor="none", edgecolor=MUTED, label="predicted, not fitted"))
    fig.legend(handles=handles, loc="outside upper left", ncols=len(handles), fontsize=9, handlelength=1.3)
