"""How B grows with the size of the vine: against diameter for scaled copies, against thickness for one diameter.

Two descriptions are drawn because neither is known to be right: a power law, straight on these log axes, and a
straight line, which bends on them.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from vinetrack.core.numbers import interval, number
from vinetrack.figures.style import (
    MUTED,
    VINE_COLOURS,
    VINE_MARKERS,
    blank,
    legend_above,
    look,
    note_below,
    plain_log_ticks,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_LABELS = {"diameter_mm": "diameter (mm)", "thickness_um": "wall thickness (µm)"}
_TITLES = {"isometric": "Scaled copies (one t/D)", "thickness": "One diameter"}
MAX_FAMILIES = 4


def draw_scaling(scaling: dict[str, Any], published: dict[str, Any] | None = None, note: str = "") -> Figure:
    """Draw B against size, one panel for vines that are scaled copies and one for vines of one diameter.

    Parameters
    ----------
    scaling : as in `scaling.json`.
    published : `{"B": {vine: …}, "source": …}` to set beside it; None where there is nothing to set.
    note : a sentence to set below.
    """
    from matplotlib.figure import Figure

    kinds = [kind for kind in _TITLES if scaling.get(kind)]
    if not kinds:
        return blank(f"Nothing to draw B against: {scaling.get('reason') or 'no vine has a damping coefficient'}.")
    with look():
        fig = Figure(figsize=(6.6 if len(kinds) == 1 else 11.0, 5.2), layout="constrained")
        for ax, kind in zip(fig.subplots(1, len(kinds), squeeze=False)[0], kinds, strict=True):
            families = scaling[kind][:MAX_FAMILIES]
            ax.set(xscale="log", yscale="log", xlabel=_LABELS[families[0]["along"]], ylabel="B (N·(s/m)ⁿ)")
            for i, family in enumerate(families):
                _draw_family(ax, family, i)
            _draw_published(ax, families, published)
            _finish(ax, families)
            left_out = len(scaling[kind]) - len(families)
            title = _TITLES[kind] + (f", {left_out} more families in scaling.json" if left_out else "")
            legend_above(ax, n_columns=1, title=title, alignment="left")
        note_below(fig, note)
    return fig


def _draw_family(ax: Axes, family: dict[str, Any], index: int) -> None:
    colour, marker = VINE_COLOURS[index], VINE_MARKERS[index]
    sizes, B = np.array(family["sizes"], dtype=float), np.array(family["B"], dtype=float)
    low, high = np.array(family["B_95"], dtype=float).T
    errors = np.nan_to_num(np.vstack([B - low, high - B])).clip(min=0)
    refused = f"\nno line: {family['refused']}" if family.get("refused") else ""
    label = f"B with 95 % interval, N = {B.size} vines{refused}"
    ax.errorbar(sizes, B, yerr=errors, fmt=marker, color=colour, ms=6, capsize=3, elinewidth=1.3, label=label, zorder=3)
    span = np.geomspace(sizes.min() / 1.15, sizes.max() * 1.15, 100)
    if power := family["power"]:
        label = f"power law, slope {number(power['slope'])} ({interval(power['slope_95'])}), R² {number(power['R2'])}"
        ax.plot(span, np.exp(power["intercept"]) * span ** power["slope"], color=colour, lw=1.5, label=label)
    if line := family["line"]:
        straight = line["intercept"] + line["slope"] * span
        drawn = straight > 0.5 * B.min()
        label = f"straight line, intercept {number(line['intercept'])}, R² {number(line['R2'])}"
        ax.plot(span[drawn], straight[drawn], color=colour, lw=1.3, ls=(0, (4, 2)), label=label)


def _draw_published(ax: Axes, families: list[dict[str, Any]], published: dict[str, Any] | None) -> None:
    given = (published or {}).get("B", {})
    pairs = [
        (size, given[vine])
        for family in families
        for vine, size in zip(family["vines"], family["sizes"], strict=True)
        if vine in given
    ]
    if published and pairs:
        x, B = zip(*pairs, strict=True)
        ax.plot(x, B, "D", mfc="none", mec=MUTED, ms=11, mew=1.3, label=published["source"])


def _finish(ax: Axes, families: list[dict[str, Any]]) -> None:
    sizes = sorted({size for family in families for size in family["sizes"]})
    ax.set_xlim(sizes[0] / 1.3, sizes[-1] * 1.3)
    plain_log_ticks(ax)
    if len(sizes) <= 8:
        ax.set_xticks(sizes)
