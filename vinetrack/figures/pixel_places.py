"""Where edges fall within a pixel: an estimate that is drawn to whole or half pixels gathers there (pixel locking).

Edges of many frames fall anywhere within a pixel, one place as often as another. A periodic error ε = −A sin 2πy of a
place y makes their density 1 + 2πA cos 2πy, so that the mean of exp 2πiy has the length πA.
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

FEWEST_PLACES = 100
"""Edges from which a histogram is drawn. Chosen: ten in each bin; a locking of 0.05 px is then told from chance. At
half one of 0.08 px is, at twice one of 0.04 px."""
BINS = 10
"""Bins of a pixel. Chosen: locking has one or two humps a pixel; half would hide the second."""


def places_in_pixel(tracks: Mapping[str, pd.DataFrame]) -> Floats:
    """Gather where the edges of all sound moving frames fall within a pixel.

    Parameters
    ----------
    tracks : `tracks/<trial>.csv` by trial.

    Returns
    -------
    shape (n_places,), px, 0 to 1: the fraction of `edge_px`, which counts along the axis.
    """
    parts = [np.zeros(0)]
    for track in tracks.values():
        sound = (track["flag"].isna() | track["flag"].eq("")) & track["edge_px"].notna()
        parts.append(np.mod(track.loc[sound, "edge_px"].to_numpy(dtype=float), 1.0))
    return np.concatenate(parts)


def periodic_error(places_px: Floats) -> tuple[float, float]:
    """Find the error that repeats with every pixel.

    Parameters
    ----------
    places_px : within a pixel, shape (n_places,), px.

    Returns
    -------
    its amplitude, and the one that chance alone exceeds once in twenty, px (Rayleigh: √(ln 20 / n) / π).
    """
    length = abs(np.mean(np.exp(2j * np.pi * places_px)))
    return float(length) / math.pi, math.sqrt(math.log(20) / len(places_px)) / math.pi


def draw_pixel_places(places_px: Floats) -> Figure:
    """Draw how often edges fall into each tenth of a pixel, with what chance makes of an even share.

    Parameters
    ----------
    places_px : within a pixel, shape (n_places,), px.

    Returns
    -------
    Figure
    """
    from matplotlib.figure import Figure

    count = len(places_px)
    even = count / BINS
    spread = 2 * math.sqrt(even * (1 - 1 / BINS))
    amplitude, chance = periodic_error(places_px)
    told = "more than chance" if amplitude > chance else "no more than chance"
    with look():
        fig = Figure(figsize=(6.6, 3.6), layout="constrained")
        ax = fig.subplots()
        ax.hist(places_px, bins=BINS, range=(0, 1), color=VINE_COLOURS[0], alpha=0.7, rwidth=0.92)
        ax.axhspan(even - spread, even + spread, color=MUTED, alpha=0.25, lw=0)
        ax.axhline(even, color=MUTED, ls=DASHED)
        ax.set(xlabel="place within a pixel (px)", ylabel="edges", xlim=(0, 1))
        ax.set_title(f"N = {count} frames", loc="left")
        note_below(
            fig,
            f"An error that repeats with every pixel has an amplitude of {number(amplitude, 2)} px, {told}: "
            f"{number(chance, 2)} px would be exceeded once in twenty.",
        )
    return fig
