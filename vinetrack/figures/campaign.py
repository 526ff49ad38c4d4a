"""A campaign on one page: which pressures and payloads each vine is grown at, how often, and the errors it leaves."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from vinetrack.figures.style import MUTED, look, plain_log_ticks, vine_styles

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Point = tuple[str, float, float, float]
"""Vine, pressure in kPa, payload in g, speed of the leading edge at y/L = 0.95 in m/s, of one trial."""


def draw_campaign(points: Sequence[Point], n_error: float, B_errors: Mapping[str, float]) -> Figure:
    """Draw every condition, with its number of trials, where it is expected to be.

    Parameters
    ----------
    points : one a trial.
    n_error, B_errors : expected standard errors, of B relative and by vine.
    """
    from matplotlib.figure import Figure

    counts = Counter(points)
    styles = vine_styles([point[0] for point in points])
    loads = sorted({point[2] for point in points})
    with look():
        fig = Figure(figsize=(7.8, 4.8), layout="constrained")
        ax = fig.subplots()
        for vine, style in styles.items():
            mine = sorted({(pressure, speed) for name, pressure, _, speed in points if name == vine})
            ax.plot(*zip(*mine, strict=True), color=style.colour, lw=1.2, alpha=0.6)
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
