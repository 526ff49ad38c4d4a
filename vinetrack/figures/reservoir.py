"""How much of the gauge pressure a closed chamber loses while a vine grows out of it, against its volume."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from vinetrack.figures.style import BLUE, INK, MUTED, VERMILLION, look, plain_log_ticks

if TYPE_CHECKING:
    from matplotlib.figure import Figure

LEAST_LITRES = 1e-4


@dataclass(frozen=True)
class Law:
    """One gas law: its name, and the share of the gauge pressure lost at every volume, shape (n_volumes,)."""

    name: str
    losses: np.ndarray


def draw_reservoir(
    volumes_m3: np.ndarray, laws: Sequence[Law], loss: float, swept_m3: float, asked_m3: float | None
) -> Figure:
    """Draw the laws, the loss that is allowed, and the chamber that was asked about.

    Parameters
    ----------
    volumes_m3 : array, shape (n_volumes,).
    loss : share of the gauge pressure that may be lost.
    swept_m3 : volume of the grown vine.
    """
    from matplotlib.figure import Figure

    factor, unit = (1e3, "L") if volumes_m3[0] >= LEAST_LITRES / 10 else (1e6, "mL")
    with look():
        fig = Figure(figsize=(7.2, 4.4), layout="constrained")
        ax = fig.subplots()
        for law, colour, style in zip(laws, (BLUE, VERMILLION), ("-", (0, (4, 2))), strict=False):
            ax.plot(factor * volumes_m3, 100 * law.losses, color=colour, ls=style, label=law.name)
        slow, fast = (100 * law.losses for law in laws[:2])
        ax.fill_between(factor * volumes_m3, slow, fast, color=MUTED, alpha=0.12, lw=0)
        ax.axhline(100 * loss, color=INK, lw=1.0)
        ax.annotate(f"allowed: {100 * loss:g} %", (0.99, 100 * loss), (0, 3), ("axes fraction", "data"),
                    textcoords="offset points", ha="right", fontsize=9.5)  # fmt: skip
        if asked_m3 is not None and volumes_m3[0] < asked_m3 < volumes_m3[-1]:
            ax.axvline(factor * asked_m3, color=MUTED, lw=1.2)
            ax.annotate(f"asked about: {factor * asked_m3:.3g} {unit}", (factor * asked_m3, 0.97), (5, 0),
                        ("data", "axes fraction"), textcoords="offset points", va="top", fontsize=9.5)  # fmt: skip
        ax.set_xscale("log")
        ax.set_ylim(0.0, min(8 * 100 * loss, 100.0))
        ax.set_xlim(factor * volumes_m3[0], factor * volumes_m3[-1])
        plain_log_ticks(ax, "x")
        ax.set_xlabel(f"volume of the chamber ({unit}); the vine sweeps {factor * swept_m3:.3g} {unit}")
        ax.set_ylabel("gauge pressure lost (%)")
        ax.legend(loc="upper right", bbox_to_anchor=(1.0, 0.9))
    return fig
