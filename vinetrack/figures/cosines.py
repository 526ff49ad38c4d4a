"""What can be taken for what: how alike the traces of two candidates are once all that is fitted anyway is taken away.

A cosine of 1 means that no analysis of these trials can tell the two apart, −1 that one is the other with its sign
turned.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from vinetrack.figures.style import BLUE, INK, VERMILLION, blank, fitting_size, look

if TYPE_CHECKING:
    from collections.abc import Sequence

    from matplotlib.figure import Figure

TIED = 0.95
MAX_EFFECTS = 22


def draw_cosines(effects: Sequence[str], matrix: Sequence[Sequence[float]]) -> Figure:
    """Draw the matrix of cosines.

    Parameters
    ----------
    effects : names, the best candidate first.
    matrix : cosines in their order, shape (n_effects, n_effects).
    """
    from matplotlib.figure import Figure
    from matplotlib.patches import Rectangle

    n = min(len(effects), MAX_EFFECTS)
    if n < 2:
        return blank("Fewer than two candidates could be tested, so there is nothing to take for another.")
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
                colour, tied = BLUE if value > 0 else VERMILLION, abs(value) >= TIED
                box = Rectangle((j - 0.5, i - 0.5), 1, 1, facecolor=colour, alpha=min(abs(value), 1.0) ** 2 * 0.8, lw=0)
                ax.add_patch(box)
                if tied:
                    frame = Rectangle((j - 0.45, i - 0.45), 0.9, 0.9, facecolor="none", edgecolor=INK, lw=1.4)
                    ax.add_patch(frame)
                words = f"{value:.2f}".replace("0.", ".", 1).replace("-", "−")
                ax.text(j, i, words, ha="center", va="center", fontsize=7.5, fontweight="bold" if tied else "normal")
        size = min(fitting_size(name, 115, 9, bold=False) for name in names)
        ax.set_xticks(range(n - 1), names[:-1], rotation=55, ha="right", rotation_mode="anchor", fontsize=size)
        ax.set_yticks(range(1, n), names[1:], fontsize=size)
        ax.set(xlim=(-0.5, n - 1.5), ylim=(n - 0.5, 0.5), aspect="equal")
        ax.tick_params(length=0)
        ax.grid(visible=False)
        ax.set_title(f"cosine; framed: tied (|cos| ≥ {TIED:g})", fontsize=9, fontweight="normal")
    return fig
