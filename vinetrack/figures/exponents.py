"""The damping law's numbers with both methods and all their intervals: n on the left, B of every vine on the right.

B is drawn as the deviation from its best estimate, since its intervals of a per cent vanish on an axis of B itself.

Thick bars come from resampling whole trials; thin ones add the stated error of the yield pressure, which all trials of
a vine share and no resampling sees.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from vinetrack.core.numbers import half_width, with_error
from vinetrack.figures.style import (
    METHOD_COLOURS,
    METHOD_NAMES,
    MUTED,
    blank,
    legend_above,
    look,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_B_KEYS = ("B", "B_95", "B_95_total")
_OFFSETS = {"log_log": -0.17, "both_axes": 0.17}
MAX_VINES = 40


def draw_exponents(damping: dict[str, Any], published: dict[str, Any] | None = None) -> Figure:
    """Draw n and B with their 95 % intervals.

    Parameters
    ----------
    damping : as in `damping.json`.
    published : numbers to set beside them: `{"n": …, "B": {vine: …}, "source": …}`; None where there are none.
    """
    from matplotlib.figure import Figure

    fits = {name: fit for name in METHOD_NAMES if (fit := damping.get(name) or {}).get("vines")}
    if not fits:
        return blank("No damping law could be fitted, so there is no exponent to show.")
    best = {vine: law for fit in fits.values() for vine, law in fit["vines"].items()}
    vines = sorted(best, key=lambda vine: (best[vine]["diameter_mm"], best[vine]["thickness_um"], vine))[:MAX_VINES]
    with look():
        fig = Figure(figsize=(9.4, 1.9 + max(0.5 * len(vines), 1.2)), layout="constrained")
        left, right = fig.subplots(1, 2, width_ratios=(1, 1.35))
        for method, fit in fits.items():
            n = with_error(fit["n"], half_width(fit.get("n_95")))
            label = f"{METHOD_NAMES[method]}: n = {n}"
            _bar(left, method, 0, fit["n"], fit.get("n_95"), fit.get("n_95_total"), label)
            for i, vine in enumerate(vines):
                if law := fit["vines"].get(vine):
                    _bar(right, method, i, *(_deviation(law.get(key), best[vine]["B"]) for key in _B_KEYS))
        _finish(left, right, {vine: best[vine] for vine in vines})
        _draw_published(left, right, vines, best, published)
        legend_above(left, n_columns=1)
    return fig


def _deviation(value: Any, best_B: float) -> Any:
    """B, or an interval of it, as deviation from the best estimate in per cent; None stays None."""
    if value is None:
        return None
    if isinstance(value, list | tuple):
        return [None if bound is None else 100 * (bound / best_B - 1) for bound in value]
    return 100 * (value / best_B - 1)


def _bar(
    ax: Axes,
    method: str,
    row: float,
    value: float,
    resampled: Sequence[float] | None,
    total: Sequence[float] | None,
    label: str | None = None,
) -> None:
    y, colour = row + _OFFSETS[method], METHOD_COLOURS[method]
    for bounds, width in ((total, 1.3), (resampled, 4.0)):
        if bounds is not None and None not in bounds:
            ax.plot(bounds, (y, y), color=colour, lw=width, solid_capstyle="butt", alpha=0.75)
    marker = "s" if method == "log_log" else "o"
    ax.plot([value], [y], marker, color=colour, ms=7, mec="white", mew=0.9, label=label)


def _finish(left: Axes, right: Axes, best: dict[str, dict[str, Any]]) -> None:
    left.set(ylim=(0.75, -0.75), yticks=[], xlabel="exponent n")
    left.spines["left"].set_visible(False)
    right.set(ylim=(len(best) - 0.45, -0.55), xlabel="B, deviation from the value at the left (%)")
    labels = [
        f"{vine}\nB = {with_error(law['B'], half_width(law.get('B_95')))}, N = {law['n_trials']}"
        for vine, law in best.items()
    ]
    right.set_yticks(range(len(best)), labels, fontsize=9)
    right.tick_params(axis="y", length=0)
    right.grid(axis="y", visible=False)
    title = "thick: 95 % by resampling trials; thin: with\nthe yield pressure's stated error; B in N·(s/m)ⁿ"
    right.set_title(title, fontsize=9, fontweight="normal")
    left.locator_params(axis="x", nbins=5)


def _draw_published(
    left: Axes, right: Axes, vines: list[str], best: dict[str, dict[str, Any]], published: dict[str, Any] | None
) -> None:
    if not published:
        return
    line: dict[str, Any] = {"color": MUTED, "ls": (0, (3, 2)), "lw": 1.3, "zorder": 1}
    left.axvline(published["n"], label=f"{published['source']}: n = {published['n']}", **line)
    for i, vine in enumerate(vines):
        if vine in published["B"]:
            deviation = _deviation(published["B"][vine], best[vine]["B"])
            right.plot([deviation, deviation], [i - 0.4, i + 0.4], **line)
