"""Which vine is the fastest: speed against diameter for every film, and how sure the choice is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from vinetrack.figures.style import MUTED, VINE_COLOURS, VINE_MARKERS, look

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class Film:
    """One film: best speed at every diameter, m/s, the best of all (diameter in mm, speed), its 90 % band, its odds."""

    thickness_um: float
    diameters_mm: np.ndarray
    speeds_m_s: np.ndarray
    best: tuple[float, float]
    band: tuple[float, float]
    odds: float


def draw_choice(films: Sequence[Film], name: str, y_over_L: float) -> Figure:
    """Draw the films side by side.

    Parameters
    ----------
    films : fastest first.
    name, y_over_L : what speed it is, and where it was taken.
    """
    from matplotlib.figure import Figure

    label = f"{name} (m/s)" if y_over_L == 1 else f"{name}\nat y/L = {y_over_L:g} (m/s)"
    with look():
        fig = Figure(figsize=(9.6, 4.4))
        curves, bars = fig.subplots(1, 2, sharey=True, width_ratios=(3, 2))
        for k, film in enumerate(films):
            colour, marker = VINE_COLOURS[k % len(VINE_COLOURS)], VINE_MARKERS[k % len(VINE_MARKERS)]
            curves.plot(film.diameters_mm, film.speeds_m_s, color=colour, label=f"{film.thickness_um:g} µm")
            curves.plot(*film.best, marker, color=colour, ms=8, clip_on=False)
            bars.plot([k, k], film.band, color=colour, lw=9, alpha=0.35, solid_capstyle="butt")
            bars.plot(k, film.best[1], marker, color=colour, ms=8)
            bars.annotate(f"{film.odds:.0%}", (k, film.band[1]), (0, 5), textcoords="offset points", ha="center",
                          fontsize=10)  # fmt: skip
        curves.set_xlabel("diameter (mm)")
        curves.set_ylabel(label)
        curves.set_ylim(0.0, 1.12 * max(film.band[1] for film in films))
        curves.set_title("best length and pressure at each diameter", fontsize=10, fontweight="normal")
        curves.legend(title="film", fontsize=9.5)
        bars.set_xlim(-0.6, len(films) - 0.4)
        bars.set_xticks(range(len(films)), [f"{film.thickness_um:g}" for film in films])
        bars.set_xlabel("film (µm)")
        bars.set_title("90 % band; how often it is the fastest", fontsize=10, fontweight="normal")
        fig.subplots_adjust(left=0.1, right=0.985, top=0.9, bottom=0.2, wspace=0.08)
        fig.text(
            0.1, 0.02, "line, marker: median of what is believed; bar: nine draws in ten", color=MUTED, fontsize=8.8
        )
    return fig
