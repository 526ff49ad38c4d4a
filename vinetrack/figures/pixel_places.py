"""Distribution of edges within a pixel, which shows pixel locking: a bias of the estimate towards whole or
half pixels.

Without a bias the edges of many frames are distributed uniformly within a pixel. A periodic error ε = −A sin 2πy at the
position y makes their density 1 + 2πA cos 2πy, so that the mean of exp 2πiy has the modulus πA.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from vinetrack.core.numbers import number
from vinetrack.figures.panels import note_below
from vinetrack.figures.style import DASHED, MUTED, VINE_COLOURS, look

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

    from vinetrack.core.records import Floats

MIN_EDGES = 100  # Minimum number of edges for a histogram (chosen)
BINS = 10  # Bins of a pixel (chosen)


def subpixel_positions(tracks: Mapping[str, pd.DataFrame]) -> Floats:
    """Return the positions of the edges of all unflagged frames within their pixel. Shape (n_edges,)."""
    parts = [np.zeros(0)]
    for track in tracks.values():
        sound = (track["flag"].isna() | track["flag"].eq("")) & track["edge_px"].notna()
        parts.append(np.mod(track.loc[sound, "edge_px"].to_numpy(dtype=float), 1.0))
    return np.concatenate(parts)


def periodic_error(subpixel_px: Floats) -> tuple[float, float]:
    """Estimate the error that is periodic with one pixel. Returns amplitude, px, and its 5 % critical value under
    uniformity (Rayleigh test: √(ln 20 / n) / π). Shapes: subpixel_px (n_edges,).
    """
    length = abs(np.mean(np.exp(2j * np.pi * subpixel_px)))
    return float(length) / math.pi, math.sqrt(math.log(20) / len(subpixel_px)) / math.pi


def draw_pixel_places(subpixel_px: Floats) -> Figure:
    """Draw the histogram of edges within a pixel, with the two-standard-deviation band of a uniform distribution.
    Shapes: subpixel_px (n_edges,).
    """
    from matplotlib.figure import Figure

    count = len(subpixel_px)
    even = count / BINS
    half_width = 2 * math.sqrt(even * (1 - 1 / BINS))
    amplitude, chance = periodic_error(subpixel_px)
    comparison = "more than chance" if amplitude > chance else "no more than chance"
    with look():
        fig = Figure(figsize=(6.6, 3.6), layout="constrained")
        ax = fig.subplots()
        ax.hist(subpixel_px, bins=BINS, range=(0, 1), color=VINE_COLOURS[0], alpha=0.7, rwidth=0.92)
        ax.axhspan(even - half_width, even + half_width, color=MUTED, alpha=0.25, lw=0)
        ax.axhline(even, color=MUTED, ls=DASHED)
        ax.set(xlabel="position within a pixel (px)", ylabel="edges", xlim=(0, 1))
        ax.set_title(f"N = {count} frames", loc="left")
        note_below(
            fig,
            f"The error that is periodic with one pixel has an amplitude of {number(amplitude, 2)} px, {comparison}: "
            f"{number(chance, 2)} px are exceeded by chance in 5 % of cases.",
        )
    return fig
