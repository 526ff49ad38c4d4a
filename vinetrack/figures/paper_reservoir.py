"""Gauge pressure left in the paper's chamber while its largest vine grows, if nothing refills it."""

from __future__ import annotations

from typing import TYPE_CHECKING

from vinetrack.core import published
from vinetrack.figures.style import INK, MUTED, VINE_COLOURS, look

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure


def draw_paper_reservoir(pressures: pd.DataFrame) -> Figure:
    """Draw the fall of gauge pressure against growth, a band a pressure from slow to fast.

    Parameters
    ----------
    pressures : `pressure_kPa, departure, lead_position_m, gauge_left`; `departure` is `depletion_slow` or `…_fast`.
    """
    from matplotlib.figure import Figure

    with look():
        fig = Figure(figsize=(8.2, 4.8), layout="constrained")
        ax = fig.add_subplot()
        for i, (pressure_kPa, own) in enumerate(pressures.groupby("pressure_kPa")):
            by_name = {str(name): part for name, part in own.groupby("departure")}
            slow, fast = by_name["depletion_slow"], by_name["depletion_fast"]
            growth_mm = 1e3 * slow["lead_position_m"].to_numpy(float)
            low, high = (100 * part["gauge_left"].to_numpy(float) for part in (fast, slow))
            label = f"{float(str(pressure_kPa)):g} kPa: −{100 - high[-1]:.0f} to −{100 - low[-1]:.0f} %"
            ax.fill_between(growth_mm, low, high, color=VINE_COLOURS[i], alpha=0.35, lw=0, label=label)
            ax.plot(growth_mm, high, color=VINE_COLOURS[i], lw=1.4)
        allowed = 100 * (1 - published.CHAMBER_ALLOWED)
        ax.axhline(
            allowed, color=INK, lw=1.0, ls=(0, (4, 2)), label=f"{100 * published.CHAMBER_ALLOWED:g} %, as allowed"
        )
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
