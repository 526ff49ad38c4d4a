"""Figures of designs: the conditions of a campaign, the fastest vine, and the pressure loss of a chamber."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from vinetrack.figures.panels import plain_log_ticks
from vinetrack.figures.style import BLUE, DASHED, INK, MUTED, VERMILLION, VINE_COLOURS, VINE_MARKERS, look, vine_styles

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Vine, pressure in kPa, payload in g, speed of the leading edge at y/L = 0.95 in m/s, of one trial
PlannedPoint = tuple[str, float, float, float]


def draw_campaign(points: Sequence[PlannedPoint], n_error: float, B_errors: Mapping[str, float]) -> Figure:
    """Draw every condition, with its number of trials, at its expected speed."""
    from matplotlib.figure import Figure

    counts = Counter(points)
    styles = vine_styles([point[0] for point in points])
    loads = sorted({point[2] for point in points})
    with look():
        fig = Figure(figsize=(7.8, 4.8), layout="constrained")
        ax = fig.subplots()
        for vine, style in styles.items():
            curve = sorted({(pressure, speed) for name, pressure, _, speed in points if name == vine})
            ax.plot(*zip(*curve, strict=True), color=style.colour, lw=1.2, alpha=0.6)
            label = f"{vine}\nB ± {100 * B_errors.get(vine, 0.0):.2g} %"
            for (name, pressure, load, speed), count in counts.items():
                if name != vine:
                    continue
                face = style.colour if load == loads[0] else "none"
                ax.plot(pressure, speed, style.marker, color=style.colour, mfc=face, ms=9, label=label)
                label = "_"
                if load == loads[0]:
                    ax.annotate(f"×{count}", (pressure, speed), (7, -4), textcoords="offset points", va="top",
                                fontsize=8.8, color=MUTED)  # fmt: skip
        ax.set_xscale("log")
        ax.set_yscale("log")
        plain_log_ticks(ax, "both")
        ax.set_xlabel("gauge pressure (kPa)")
        ax.set_ylabel("leading edge at y/L = 0.95 (m/s)")
        ax.set_title(f"{len(points)} trials: n ± {n_error:.2g} expected", fontsize=11)
        fig.legend(loc="outside right upper", fontsize=9, labelspacing=0.9)
        if len(loads) > 1:
            words = ", ".join(f"{load:g} g" for load in loads[1:])
            fig.text(0.01, 0.005, f"filled: {loads[0]:g} g, hollow: {words}", color=MUTED, fontsize=9, va="bottom")
    return fig


@dataclass(frozen=True)
class FilmChoice:
    """One film."""

    thickness_um: float
    diameters_mm: np.ndarray
    speeds_m_s: np.ndarray
    best: tuple[float, float]
    band: tuple[float, float]
    odds: float


def draw_choice(films: Sequence[FilmChoice], name: str, y_over_L: float) -> Figure:
    """Draw the films side by side: speed against diameter, and the certainty of the choice."""
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
        bars.set_title("90 % band; percentage of draws in which it is the fastest", fontsize=10, fontweight="normal")
        fig.subplots_adjust(left=0.1, right=0.985, top=0.9, bottom=0.2, wspace=0.08)
        fig.text(0.1, 0.02, "line, marker: median of the prediction; bar: 90 % interval", color=MUTED, fontsize=8.8)
    return fig


_MIN_LITRE_AXIS = 1e-4  # Chosen: below 0.1 mL an axis is in millilitres, so that its ticks need no exponent


@dataclass(frozen=True)
class GasLawLoss:
    """One gas law: its name, and the fraction of the gauge pressure lost at every volume, shape (n_volumes,)."""

    name: str
    losses: np.ndarray


def draw_reservoir(
    volumes_m3: np.ndarray, laws: Sequence[GasLawLoss], loss: float, swept_m3: float, chosen_m3: float | None
) -> Figure:
    """Draw the gauge pressure that a closed chamber loses while a vine grows, against its volume. Shapes: volumes_m3
    (n_volumes,).
    """
    from matplotlib.figure import Figure

    factor, unit = (1e3, "L") if volumes_m3[0] >= _MIN_LITRE_AXIS / 10 else (1e6, "mL")
    with look():
        fig = Figure(figsize=(7.2, 4.4), layout="constrained")
        ax = fig.subplots()
        for law, colour, style in zip(laws, (BLUE, VERMILLION), ("-", DASHED), strict=False):
            ax.plot(factor * volumes_m3, 100 * law.losses, color=colour, ls=style, label=law.name)
        slow, fast = (100 * law.losses for law in laws[:2])
        ax.fill_between(factor * volumes_m3, slow, fast, color=MUTED, alpha=0.12, lw=0)
        ax.axhline(100 * loss, color=INK, lw=1.0)
        ax.annotate(f"allowed: {100 * loss:g} %", (0.99, 100 * loss), (0, 3), ("axes fraction", "data"),
                    textcoords="offset points", ha="right", fontsize=9.5)  # fmt: skip
        if chosen_m3 is not None and volumes_m3[0] < chosen_m3 < volumes_m3[-1]:
            ax.axvline(factor * chosen_m3, color=MUTED, lw=1.2)
            ax.annotate(f"chosen: {factor * chosen_m3:.3g} {unit}", (factor * chosen_m3, 0.97), (5, 0),
                        ("data", "axes fraction"), textcoords="offset points", va="top", fontsize=9.5)  # fmt: skip
        ax.set_xscale("log")
        ax.set_ylim(0.0, min(8 * 100 * loss, 100.0))
        ax.set_xlim(factor * volumes_m3[0], factor * volumes_m3[-1])
        plain_log_ticks(ax, "x")
        ax.set_xlabel(f"volume of the chamber ({unit}); of the grown vine {factor * swept_m3:.3g} {unit}")
        ax.set_ylabel("gauge pressure lost (%)")
        ax.legend(loc="upper right", bbox_to_anchor=(1.0, 0.9))
    return fig
