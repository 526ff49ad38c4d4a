"""The paper's Table II drawn: published errors of Eq. (2), ours, and what is left out of it would cause."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from vinetrack.core import published
from vinetrack.figures.style import BLUE, GREEN, INK, ORANGE, PURPLE, look, plain_log_ticks

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_PANELS = (
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
_LEAST = 0.01
"""Below this nothing is drawn: a departure that does nothing there has no place on a log axis."""


def draw_paper_rms(paper: pd.DataFrame, departures: pd.DataFrame) -> Figure:
    """Draw errors by pressure, positions and speeds.

    Parameters
    ----------
    paper : as in `paper.csv`.
    departures : as in `paper_departures.csv`.
    """
    from matplotlib.figure import Figure

    with look():
        fig = Figure(figsize=(11.0, 4.9), layout="constrained")
        axes = fig.subplots(1, 2)
        for ax, (figure, row, column, factor, label, printed) in zip(axes, _PANELS, strict=True):
            ours = {kPa: _ours(paper, f"{row}_{kPa:g}kPa") for kPa in printed}
            own = departures[departures["figure"] == figure]
            _draw_panel(ax, printed, ours, own.assign(size=factor * own[column]))
            ax.set(ylabel=label, title=f"{figure} and Table II")
        handles, labels = axes[0].get_legend_handles_labels()
        fig.legend(handles, labels, loc="outside lower center", ncols=len(labels), fontsize=9.5)
    return fig


def _ours(paper: pd.DataFrame, row: str) -> float:
    found = paper.loc[paper["row"] == row, "ours"]
    return float(found.iloc[0]) if len(found) else float("nan")


def _draw_panel(ax: Axes, printed: dict[int, float], ours: dict[int, float], departures: pd.DataFrame) -> None:
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
        low, high = (np.array([_size(departures, kPa, name) for kPa in printed]) for name in (low_name, high_name))
        shown = high >= _LEAST
        middle = np.sqrt(np.maximum(low, _LEAST) * np.maximum(high, _LEAST))
        ax.errorbar(
            (places + 0.15 * k)[shown],
            middle[shown],
            yerr=[(middle - np.maximum(low, _LEAST))[shown], (high - middle)[shown]],
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


def _size(departures: pd.DataFrame, pressure_kPa: float, name: str) -> float:
    own = departures[(departures["departure"] == name) & np.isclose(departures["pressure_kPa"], pressure_kPa)]
    return float(own["size"].iloc[0]) if len(own) else float("nan")
