"""Candidates of the diagnosis: their gains, the cosines between them, and parameters that drift with a condition.

Candidates in the answer set are drawn in colour. A hollow bar is a candidate that was not fitted: its length is the
score in standard deviations. A cosine of 1 means that no analysis of these trials can tell two candidates apart, −1
that one is the other with opposite sign.
"""

from __future__ import annotations

import math
import textwrap
from typing import TYPE_CHECKING, Any

import numpy as np

from vinetrack.figures.ladder_figures import AFTER, BEFORE
from vinetrack.figures.panels import fitting_size, line_key, panel_grid
from vinetrack.figures.style import BLUE, DASHED, INK, MUTED, ORANGE, VERMILLION, VINE_MARKERS, blank, look, rows

if TYPE_CHECKING:
    from collections.abc import Sequence

    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MAX_CANDIDATES = 12  # Candidates drawn per round; chosen: 0.33 in each, 4 in of figure; the table in the report has all

_ROLES = {
    "answer": ("in the answer set", BLUE),
    "physical": ("explains less", MUTED),
    "measurement": ("fault of the measurement", ORANGE),
}
_WIDTH_IN = 8.6  # Chosen: bars of 4 in beside names of 22 letters and sizes of 60

_ROW_IN = 0.33  # Chosen: two lines of 9 pt would fit, so rows stay apart


def draw_candidates(rounds: Sequence[tuple[str, pd.DataFrame]]) -> Figure:
    """Draw √Δχ² of every candidate, with its fitted size."""
    from matplotlib.figure import Figure

    drawn = [(title, _drawable(table)) for title, table in rounds]
    drawn = [(title, table) for title, table in drawn if len(table)]
    if not drawn:
        return blank("No candidate could be tested on these data.")
    heights_in = [_ROW_IN * len(table) + 0.95 for _, table in drawn]
    with look():
        fig = Figure(figsize=(_WIDTH_IN, sum(heights_in) + 0.35), layout="constrained")
        axes = fig.subplots(len(drawn), 1, squeeze=False, height_ratios=heights_in)[:, 0]
        for ax, (title, table) in zip(axes, drawn, strict=True):
            _draw_round(ax, title, table)
        axes[-1].set_xlabel("√Δχ²: how much better the trajectories are explained (σ)")
        _candidate_legend(fig, [table for _, table in drawn])
    return fig


def _drawable(table: pd.DataFrame) -> pd.DataFrame:
    """Rows with a finite gain or score: the answer set first, then by bar length."""
    gain = np.sqrt(np.maximum(table["delta_chi2"].to_numpy(dtype=float), 0.0))
    score = np.abs(table["sigma"].to_numpy(dtype=float))
    # A predicted gain may have the wrong sign of the parameter or too small a noise; the score accounts for both.
    fitted = (table["status"] == "refitted").to_numpy() & np.isfinite(gain)
    height = np.where(fitted | ~np.isfinite(score), gain, score)
    ranked = table.assign(height=height, in_answer_set=table["in_answer_set"].astype(bool))
    known = ranked[np.isfinite(height)]
    return known.sort_values(["in_answer_set", "height"], ascending=False, kind="stable").head(MAX_CANDIDATES)


def _role(row: Any) -> str:
    """The key of a candidate in `_ROLES`."""
    if row.in_answer_set:
        return "answer"
    return "measurement" if row.kind == "measurement" else "physical"


def _draw_round(ax: Axes, title: str, table: pd.DataFrame) -> None:
    heights = table["height"].to_numpy(dtype=float)
    longest = max(float(heights.max()), 1.0)
    for i, (row, height) in enumerate(zip(rows(table), heights, strict=True)):
        colour = _ROLES[_role(row)][1]
        fill = colour if row.status == "refitted" else "none"
        ax.barh(i, height, height=0.62, color=fill, edgecolor=colour, lw=1.2, alpha=None if row.in_answer_set else 0.75)
        words = " ".join(part for part in (row.size, "" if row.plausible else "(not plausible)") if part)
        if words:
            ax.annotate(
                textwrap.shorten(words, 62, placeholder="…"),
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


def _candidate_legend(fig: Figure, tables: Sequence[pd.DataFrame]) -> None:
    from matplotlib.patches import Patch

    present = {_role(row) for table in tables for row in rows(table)}
    handles = [
        Patch(facecolor=colour, alpha=1.0 if name == "answer" else 0.75, label=words)
        for name, (words, colour) in _ROLES.items()
        if name in present
    ]
    if any((table["status"] == "screened").any() for table in tables):
        handles.append(Patch(facecolor="none", edgecolor=MUTED, label="predicted, not fitted"))
    fig.legend(handles=handles, loc="outside upper left", ncols=len(handles), fontsize=9, handlelength=1.3)


TIED_COSINE = 0.95  # Chosen: above it two candidates count as tied

MAX_EFFECTS = 22  # Chosen: 0.36 in each make a square of 8 in, and cells that hold two digits of 7.5 pt


def draw_cosines(effects: Sequence[str], matrix: Sequence[Sequence[float]]) -> Figure:
    """Draw the matrix of cosines. Shapes: matrix (n_effects, n_effects)."""
    from matplotlib.figure import Figure
    from matplotlib.patches import Rectangle

    n = min(len(effects), MAX_EFFECTS)
    if n < 2:
        return blank("Fewer than two candidates could be tested: there are no pairs to compare.")
    cosines = np.asarray(matrix, dtype=float)[:n, :n]
    names = [str(name).replace("_", " ") for name in effects[:n]]
    with look():
        side_in = 0.36 * n
        fig = Figure(figsize=(side_in + 2.3, side_in + 2.0), layout="constrained")
        ax = fig.add_subplot()
        for i in range(n):
            for j in range(i):
                value = cosines[i, j]
                if not np.isfinite(value):
                    continue
                colour, tied = BLUE if value > 0 else VERMILLION, abs(value) >= TIED_COSINE
                box = Rectangle((j - 0.5, i - 0.5), 1, 1, facecolor=colour, alpha=min(abs(value), 1.0) ** 2 * 0.8, lw=0)
                ax.add_patch(box)
                if tied:
                    outline = Rectangle((j - 0.45, i - 0.45), 0.9, 0.9, facecolor="none", edgecolor=INK, lw=1.4)
                    ax.add_patch(outline)
                words = f"{value:.2f}".replace("0.", ".", 1).replace("-", "−")
                ax.text(j, i, words, ha="center", va="center", fontsize=7.5, fontweight="bold" if tied else "normal")
        size = min(fitting_size(name, 115, 9, bold=False) for name in names)
        ax.set_xticks(range(n - 1), names[:-1], rotation=55, ha="right", rotation_mode="anchor", fontsize=size)
        ax.set_yticks(range(1, n), names[1:], fontsize=size)
        ax.set(xlim=(-0.5, n - 1.5), ylim=(n - 0.5, 0.5), aspect="equal")
        ax.tick_params(length=0)
        ax.grid(visible=False)
        ax.set_title(f"cosine; framed: tied (|cos| ≥ {TIED_COSINE:g})", fontsize=9, fontweight="normal")
    return fig


_MAX_DRIFT_PANELS = 6  # Chosen: two rows of three panels
# Conditions: label, and factor from SI
_CONDITIONS = {
    "pressure_Pa": ("pressure (kPa)", 1e-3),
    "payload_kg": ("payload (g)", 1e3),
    "growth_angle_rad": ("growth angle (°)", 180 / math.pi),
    "chamber_m3": ("chamber (l)", 1e3),
    "inlet_m": ("inlet (mm)", 1e3),
    "vine": ("vine", 1.0),
}

_MODELS = {"before": (BEFORE, "before", -0.06), "after": (AFTER, "after", 0.06)}


def draw_drift(groups: pd.DataFrame, added: str = "") -> Figure:
    """Draw the best value of a parameter in each group of trials, relative to the common law, against a condition. With
    a complete model all groups are at 1.
    """
    from matplotlib.figure import Figure

    known = groups[np.isfinite(groups["ratio"].astype(float))] if len(groups) else groups
    if not len(known):
        return blank("No parameter could be tested for drift.")
    # A parameter that only the larger model has cannot show what adding the effect changed.
    shown = known[known["model"] == "before"] if (known["model"] == "before").any() else known
    panels = list(dict.fromkeys(zip(shown["parameter"], shown["against"], strict=True)))[:_MAX_DRIFT_PANELS]
    vines = [vine for vine in dict.fromkeys(known["vine"]) if vine]
    markers = {vine: VINE_MARKERS[i % len(VINE_MARKERS)] for i, vine in enumerate(vines)} | {"": "o"}
    n_columns = min(len(panels), 3)
    n_rows = math.ceil(len(panels) / n_columns)
    with look():
        fig = Figure(figsize=(1.0 + 3.2 * n_columns, 0.9 + 2.6 * n_rows), layout="constrained")
        for ax, (parameter, against) in zip(panel_grid(fig, len(panels), n_columns), panels, strict=True):
            chosen = known[(known["parameter"] == parameter) & (known["against"] == against)]
            _draw_drift_panel(ax, chosen, str(against), markers)
        fig.supylabel("value / common law", fontsize=11)
        _drift_legend(fig, known, markers, added)
    return fig


def _draw_drift_panel(ax: Axes, groups: pd.DataFrame, against: str, markers: dict[str, str]) -> None:
    words, factor = _CONDITIONS.get(against, (against.replace("_", " "), 1.0))
    names = list(dict.fromkeys(groups["vine"]))
    by_vine = against == "vine"
    for model, (colour, _, offset) in _MODELS.items():
        of_model = groups[groups["model"] == model]
        for vine, of_vine in [("", of_model)] if by_vine else of_model.groupby("vine", sort=False):
            ordered = of_vine.sort_values("level")
            x = np.array([names.index(name) for name in ordered["vine"]], dtype=float) + offset
            x = x if by_vine else factor * ordered["level"].to_numpy(dtype=float)
            style: dict[str, Any] = {"color": colour, "marker": markers.get(str(vine), "o"), "ms": 5, "elinewidth": 1.0}
            line = "none" if by_vine else "-" if model == "after" else DASHED
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


def _drift_legend(fig: Figure, groups: pd.DataFrame, markers: dict[str, str], added: str) -> None:
    present = set(groups["model"])
    handles = [
        line_key(f"{words}: with {added}" if model == "after" and added else words, color=colour, marker="o", ms=5)
        for model, (colour, words, _) in _MODELS.items()
        if model in present
    ]
    handles += [line_key(vine, color=MUTED, marker=marker, ls="none") for vine, marker in markers.items() if vine]
    fig.legend(handles=handles[:10], loc="outside upper left", ncols=min(len(handles), 4), fontsize=9)
