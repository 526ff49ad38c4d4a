"""The ladder: what every added effect did to the error, in sample and on what the model had not seen, and the floor.

Errors fall by factors, so their axis is logarithmic. What replicates differ by is drawn as ground: below it an error
says nothing about the model.
"""

from __future__ import annotations

import math
import textwrap
from typing import TYPE_CHECKING, Any

import numpy as np

from vinetrack.core.numbers import number
from vinetrack.figures.style import BLUE, GREEN, INK, MUTED, VERMILLION, blank, look, plain_log_ticks

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

ERRORS = {
    "rms_in_sample_m": ("in sample", BLUE, "o", "-"),
    "rms_left_out_m": ("on left-out conditions", VERMILLION, "s", "-"),
    "rms_highest_pressure_m": ("on the left-out highest pressure", GREEN, "^", (0, (4, 2))),
}
"""The three errors: what each is called, and how it is drawn."""

_WIDTH_IN = 5.2
_STEP_IN = 1.55


def draw_ladder(ladder: pd.DataFrame) -> Figure:
    """Draw the errors of the model that the user came with and of every one after it.

    Parameters
    ----------
    ladder : as in `ladder.csv`.
    """
    from matplotlib.figure import Figure

    if not len(ladder):
        return blank("No model was fitted, so there are no errors to show.", _WIDTH_IN)
    steps = np.arange(len(ladder))
    errors_mm = {key: 1e3 * ladder[key].to_numpy(dtype=float) for key in ERRORS}
    floor_mm = 1e3 * ladder["floor_m"].to_numpy(dtype=float)
    with look():
        fig = Figure(figsize=(max(_WIDTH_IN, 2.4 + _STEP_IN * len(ladder)), 3.9), layout="constrained")
        ax = fig.add_subplot()
        ax.set(yscale="log", ylabel="error of position, rms (mm)", xlim=(-0.5, len(ladder) - 0.5))
        ax.set_ylim(*_limits([*errors_mm.values(), floor_mm]))
        _draw_floor(ax, floor_mm)
        for key, (_, colour, marker, line) in ERRORS.items():
            ax.plot(steps, errors_mm[key], marker=marker, color=colour, ls=line, ms=7, zorder=3)
        _write_values(ax, errors_mm)
        ax.set_xticks(steps, [_name(step, added) for step, added in enumerate(ladder["added"])])
        ax.grid(axis="x", visible=False)
        plain_log_ticks(ax, "y")
        _legend(ax, errors_mm)
    return fig


def _name(step: int, added: Any) -> str:
    if step == 0:
        return "the model\nyou came with"
    words = str(added).replace("+", " + ").replace("_", " ")
    return "+ " + "\n".join(textwrap.wrap(words, 18, break_long_words=False))


def _limits(errors_mm: list[np.ndarray]) -> tuple[float, float]:
    """From a little below the least to a little above the largest, at least a factor of four."""
    known = np.concatenate(errors_mm)
    known = known[np.isfinite(known) & (known > 0)]
    if not known.size:
        return 0.1, 1.0
    low, high = float(known.min()), float(known.max())
    middle = math.sqrt(low * high)
    return min(0.72 * low, middle / 2), max(1.35 * high, middle * 2)


def _draw_floor(ax: Axes, floor_mm: np.ndarray) -> None:
    known = floor_mm[np.isfinite(floor_mm) & (floor_mm > 0)]
    if not known.size:
        return
    floor = float(known[-1])
    ax.axhspan(ax.get_ylim()[0], floor, color=MUTED, alpha=0.16, lw=0, zorder=0)
    ax.axhline(floor, color=MUTED, lw=1.3, ls=(0, (1.5, 1.5)), zorder=1)
    words = f"floor: replicates differ by {number(floor)} mm"
    ax.annotate(
        words, (0.015, floor), (0, -4), ("axes fraction", "data"), "offset points", color=MUTED, va="top", fontsize=9
    )


def _write_values(ax: Axes, errors_mm: dict[str, np.ndarray]) -> None:
    """The numbers beside the points where no line runs, moved apart where they would lie on each other."""
    low, high = (math.log10(value) for value in ax.get_ylim())
    apart = 0.075 * (high - low)
    n_steps = len(next(iter(errors_mm.values())))
    for step in range(n_steps):
        shown = [(float(values[step]), ERRORS[key][1]) for key, values in errors_mm.items() if values[step] > 0]
        shown.sort()
        side, sideways = ("right", -9) if step == 0 and n_steps > 1 else ("left", 9)
        lifted = 0.6 * apart if 0 < step < n_steps - 1 else 0.0  # lines come from above left and go on to the right
        levels = [math.log10(value) + lifted for value, _ in shown]
        for i in range(1, len(levels)):
            levels[i] = max(levels[i], levels[i - 1] + apart)
        above = max(levels[-1] - (high - apart / 2), 0.0) if levels else 0.0
        for (value, colour), level in zip(shown, levels, strict=True):
            style: dict[str, Any] = {"color": colour, "fontsize": 9, "fontweight": "bold", "ha": side, "va": "center"}
            ax.annotate(
                number(value), (step, 10 ** (level - above)), (sideways, 0), textcoords="offset points", **style
            )


def _legend(ax: Axes, errors_mm: dict[str, np.ndarray]) -> None:
    from matplotlib.lines import Line2D

    handles = [
        Line2D([], [], color=colour, marker=marker, ls=line, ms=6, label=name)
        for key, (name, colour, marker, line) in ERRORS.items()
        if np.isfinite(errors_mm[key]).any()
    ]
    ax.legend(
        handles=handles, loc="lower left", bbox_to_anchor=(-0.02, 1.0), fontsize=9, labelspacing=0.25, labelcolor=INK
    )
