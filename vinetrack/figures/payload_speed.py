"""Final speed of the leading edge against payload, measured and as the model in use has it; a panel a vine."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from vinetrack.figures.style import (
    VINE_COLOURS,
    VINE_MARKERS,
    blank,
    counted,
    legend_above,
    look,
    note_below,
    rows,
    up_from_zero,
)

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MAX_PANELS = 6
MODEL = "model and its 95 %"


def draw_payload_speed(conditions: pd.DataFrame, model: pd.DataFrame, note: str = "", line: str = MODEL) -> Figure:
    """Draw final speeds of vines that were grown with more than one payload.

    Parameters
    ----------
    conditions : one row a condition with `vine, pressure_kPa, payload_g, n_final, final_at_mm,
        final_lead_velocity_m_s, final_lead_velocity_sigma_m_s`.
    model : the same along payloads, without `n_final`; may be empty.
    note : a sentence to set below, such as what somebody else published.
    line : what the curve is.
    """
    from matplotlib.figure import Figure

    moved = conditions[conditions["final_lead_velocity_m_s"] > 0]
    moved = moved[moved.groupby(["vine", "pressure_kPa"])["payload_g"].transform("nunique") > 1]
    vines = [str(vine) for vine in dict.fromkeys(moved["vine"])][:MAX_PANELS]
    if not vines:
        return blank("No vine was grown with more than one payload at one pressure.")
    with look():
        n_columns = min(len(vines), 3)
        n_rows = math.ceil(len(vines) / n_columns)
        width_in = 6.6 if len(vines) == 1 else 4.4 * n_columns
        fig = Figure(figsize=(width_in, 0.6 + 4.2 * n_rows), layout="constrained")
        axes = fig.subplots(n_rows, n_columns, squeeze=False)
        for ax, vine in zip(axes.flat, vines, strict=False):
            _draw_vine(ax, moved[moved["vine"] == vine], model[model["vine"] == vine], line)
        for ax in axes.flat[len(vines) :]:
            ax.set_visible(False)
        note_below(fig, note)
    return fig


def _draw_vine(ax: Axes, measured: pd.DataFrame, model: pd.DataFrame, line: str) -> None:
    for i, (pressure_kPa, group) in enumerate(measured.groupby("pressure_kPa")):
        colour = VINE_COLOURS[i % len(VINE_COLOURS)]
        ax.errorbar(
            group["payload_g"],
            group["final_lead_velocity_m_s"],
            yerr=np.nan_to_num(group["final_lead_velocity_sigma_m_s"].to_numpy(float)),
            fmt=VINE_MARKERS[i % len(VINE_MARKERS)],
            color=colour,
            ms=6,
            capsize=3,
            label=f"{float(str(pressure_kPa)):.4g} kPa",
        )
        curve = model[np.isclose(model["pressure_kPa"], float(str(pressure_kPa)))].sort_values("payload_g")
        if len(curve):
            _draw_curve(ax, curve, colour, line if i == 0 else "")
    first = next(rows(measured))
    counts = measured["n_final"].astype(int)
    times = counted(int(counts.min()), int(counts.max()), "trial")
    ax.set(xlabel="payload (g)", ylabel="speed of the leading edge (m/s)")
    up_from_zero(ax)
    error = ", ± standard error" if counts.max() > 1 else ""
    title = f"{first.vine}, after {first.final_at_mm:.4g} mm\nN = {times} a point{error}"
    legend_above(ax, n_columns=2, title=title, alignment="left", fontsize=9)


def _draw_curve(ax: Axes, curve: pd.DataFrame, colour: str, label: str) -> None:
    payload_g, speed_m_s, sigma_m_s = (
        curve[name].to_numpy(float)
        for name in ("payload_g", "final_lead_velocity_m_s", "final_lead_velocity_sigma_m_s")
    )
    reach = 1.96 * np.nan_to_num(sigma_m_s)
    ax.plot(payload_g, speed_m_s, color=colour, lw=1.5, label=label or None)
    ax.fill_between(payload_g, speed_m_s - reach, speed_m_s + reach, color=colour, alpha=0.2, lw=0)
