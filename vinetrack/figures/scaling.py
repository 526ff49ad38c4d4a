"""How B grows with the size of the vine: on log axes, with the power law through it.

The abscissa is whatever differs most between the vines: the diameter, or the thickness where all have one diameter.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from vinetrack.figures.style import METHOD_COLOURS, METHOD_NAMES, MUTED, blank, legend_above, look, plain_log_ticks

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_LABELS = {"diameter_mm": "diameter (mm)", "thickness_um": "wall thickness (µm)"}


def draw_scaling(damping: dict[str, Any], published: dict[str, Any] | None = None) -> Figure:
    """Draw B of every vine against its size.

    Parameters
    ----------
    damping : as in `damping.json`.
    published : `{"B": {vine: …}, "source": …}` to set beside it; None where there is nothing to set.
    """
    from matplotlib.figure import Figure

    fits = {name: fit for name in METHOD_NAMES if (fit := damping.get(name) or {}).get("vines")}
    if not fits:
        return blank("No damping law could be fitted, so there is no B to compare between vines.")
    vines = next(iter(fits.values()))["vines"]
    if len(vines) < 2:
        return blank("B against size needs at least two vines; this experiment has one with a damping law.")
    size = abscissa(vines)
    if size is None:
        return blank("All vines have the same diameter and wall thickness, so there is no scale to plot B against.")
    with look():
        fig = Figure(figsize=(6.4, 5.0), layout="constrained")
        ax = fig.add_subplot()
        ax.set(xscale="log", yscale="log", xlabel=_LABELS[size], ylabel="B (N·(s/m)ⁿ)")
        for method, fit in fits.items():
            _draw_fit(ax, method, fit["vines"], size)
        _draw_published(ax, vines, size, published)
        sizes = [law[size] for law in vines.values()]
        ax.set_xlim(min(sizes) / 1.3, max(sizes) * 1.3)
        plain_log_ticks(ax)
        if len(set(sizes)) <= 8:
            ax.set_xticks(sorted(set(sizes)))
        legend_above(ax, n_columns=1)
    return fig


def abscissa(vines: dict[str, dict[str, Any]]) -> str | None:
    """The size to plot B against, `diameter_mm` or `thickness_um`; None where vines differ in neither."""
    spread = {
        size: max(law[size] for law in vines.values()) / min(law[size] for law in vines.values()) for size in _LABELS
    }
    best = max(spread, key=lambda size: spread[size])
    return best if spread[best] > 1 else None


def _draw_fit(ax: Axes, method: str, vines: dict[str, dict[str, Any]], size: str) -> None:
    x = np.array([law[size] for law in vines.values()], dtype=float)
    B = np.array([law["B"] for law in vines.values()], dtype=float)
    bounds = [law.get("B_95_total") or law.get("B_95") or (law["B"], law["B"]) for law in vines.values()]
    low, high = np.array([(b if b is not None else np.nan) for pair in bounds for b in pair], float).reshape(-1, 2).T
    errors = np.nan_to_num(np.vstack([B - low, high - B])).clip(min=0)
    slope, log_B = np.polyfit(np.log(x), np.log(B), 1)
    label = f"{METHOD_NAMES[method]}: B ∝ {_LABELS[size].split(' (')[0]} to the {slope:.2f}, N = {len(B)} vines"
    shift = 0.985 if method == "log_log" else 1.015
    marker = "s" if method == "log_log" else "o"
    colour = METHOD_COLOURS[method]
    ax.errorbar(shift * x, B, yerr=errors, fmt=marker, color=colour, ms=6, capsize=2.5, elinewidth=1.2, label=label)
    span = np.geomspace(x.min() / 1.15, x.max() * 1.15, 50)
    ax.plot(span, np.exp(log_B) * span**slope, color=colour, lw=1.2, alpha=0.8)


def _draw_published(ax: Axes, vines: dict[str, dict[str, Any]], size: str, published: dict[str, Any] | None) -> None:
    pairs = [(law[size], published["B"][vine]) for vine, law in vines.items() if published and vine in published["B"]]
    if published and pairs:
        x, B = zip(*pairs, strict=True)
        ax.plot(x, B, "D", mfc="none", mec=MUTED, ms=10, mew=1.3, label=published["source"])
