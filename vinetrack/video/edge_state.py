"""What the edge tracker alternates between: where the edge is, and what lies before and after it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from vinetrack.video import edge_kernels as kernels
from vinetrack.video.strip import Strip

Floats = NDArray[np.float64]

MEMORY_FRAMES = 6.0
"""What a pixel showed this long before and after its passing counts 1/e: enough frames to average noise, few enough
that a door that has swung away, or a tube that sways, is forgotten."""
RIDGE = 0.05
"""Weight, in frames, of a pixel's neighbours where it was seen itself: (noise / texture)² of 2 / 9 grey levels."""
MEMORY = 0.93
"""Neighbours' weights fall to 1/e over 14 px, a few times the grain of film and background."""
TEXTURE = 12.0
"""Standard deviation, grey levels, of a pixel about its neighbours, where it was never seen itself."""
PRIOR_SD = 0.15
"""Relative scatter allowed to amplitude and level of the contrast from frame to frame."""
MARGIN_PX = 6.0
"""Pixels beyond the blurred edge that take part: they hold amplitude and level."""
SELFSAME = 0.4
"""Share of the usual contrast under which film and background near the start are the same thing seen twice."""
CLEAR_PX = 60.0
"""Growth after which the surroundings of the start are free of what held the tip there (20 mm at 3 px/mm)."""


@dataclass(frozen=True)
class EdgeState:
    """What alternates.

    The edge (n_frames,) and its blur lengths, the tip's lag by row and optical blur, and the pictures
    (4, n_across, n_along): brightness after and before the edge and the variance about each. `inflation` multiplies
    those variances by distance ahead of the edge, 1 px a bin about its middle.
    """

    edge: Floats
    lengths: Floats
    lag: Floats
    blur: float
    pictures: NDArray[np.float32]
    inflation: Floats


def blur_lengths(edge: Floats, exposure_frames: float) -> Floats:
    """Length of the motion blur in every frame, shape (n_frames,): speed times exposure, px."""
    if len(edge) < 3:
        return np.zeros(len(edge))
    speed = np.gradient(edge)
    smooth = np.convolve(np.pad(speed, 1, mode="edge"), [0.25, 0.5, 0.25], mode="valid")
    return np.clip(smooth, 0, None) * exposure_frames


def moving_frames(edge: Floats) -> NDArray[np.bool_]:
    """Frames in which the edge is on its way, shape (n_frames,); all of them where hardly any is."""
    speed = np.abs(np.gradient(edge)) if len(edge) > 1 else np.zeros(len(edge))
    moving = speed > max(0.2, 0.1 * float(np.quantile(speed, 0.95)))
    return moving if moving.sum() >= 5 else np.ones(len(edge), dtype=bool)


def repicture(strip: Strip, state: EdgeState, clip: float) -> EdgeState:
    """Solve every pixel's brightness before and after, given the edge; `clip` > 0 weighs strays down."""
    early, late = _passing(state, strip.values.shape[2])
    sums = kernels.gather(
        strip.values, strip.scale, strip.offset, state.edge, state.lengths, state.lag, state.blur, early, late,
        MEMORY_FRAMES, state.pictures, clip,
    )  # fmt: skip
    half = len(strip.values) // 2
    middle = float(np.median(strip.values[half])) * float(strip.scale[half]) + float(strip.offset[half])
    pictures = kernels.solve(sums, RIDGE, MEMORY, middle, strip.noise, TEXTURE)
    hidden = _film_from_the_start(state, pictures)
    if hidden.any():
        sums[:, hidden, 5:8] = 0.0
        pictures = kernels.solve(sums, RIDGE, MEMORY, middle, strip.noise, TEXTURE)
    return replace(state, pictures=pictures)


def _film_from_the_start(state: EdgeState, pictures: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Columns about the start whose background looks like their film, shape (n_along,): it was film all along.

    An edge put too far back makes film its own background, without contrast and so without a say against it.
    """
    contrast = np.sqrt(np.mean((pictures[0] - pictures[1]) ** 2, axis=0))
    columns = np.arange(len(contrast))
    near = (columns > state.edge[0] - 5) & (columns < clear_of_start(state.edge))
    later = (columns >= clear_of_start(state.edge)) & (columns < state.edge.max() - 5)
    if later.sum() < 10:
        return np.zeros(len(contrast), dtype=bool)
    return near & (contrast < SELFSAME * float(np.median(contrast[later])))


def _passing(state: EdgeState, columns: int) -> tuple[Floats, Floats]:
    """First and last frame in which the edge is over each column, shapes (n_along,).

    About the start, film counts only once the edge has got clear of it: a door may stand or swing there until then.
    """
    rising = np.maximum.accumulate(state.edge) + 1e-6 * np.arange(len(state.edge))
    frames = np.arange(len(rising), dtype=float)
    moving = np.flatnonzero(moving_frames(state.edge))
    places = np.arange(columns, dtype=float)
    reach = 0.5 * float(np.median(state.lengths)) + 3 * state.blur + 1
    begin, end = frames[moving[0]], frames[moving[-1]]
    behind = np.maximum(places + reach + float(state.lag.max()), clear_of_start(state.edge))
    early = np.clip(np.interp(places - reach, rising, frames), begin, end)
    late = np.clip(np.interp(behind, rising, frames), begin, end)
    return early, late


def clear_of_start(edge: Floats) -> float:
    """Place beyond which nothing that held the tip at its start is near: CLEAR_PX on, or a fifth of the way."""
    return float(edge[0] + min(CLEAR_PX, 0.2 * (edge.max() - edge[0])))


def core_frames(state: EdgeState, fit: Floats) -> NDArray[np.bool_]:
    """Moving frames clear of the start that fit no worse than most, shape (n_frames,): those that tell of the tip."""
    moving = moving_frames(state.edge)
    clear = moving & (state.edge > clear_of_start(state.edge))
    if clear.sum() < 5:
        return moving
    good = clear & (fit[:, 2] <= 1.3 * np.nanmedian(fit[clear, 2]))
    return good if good.sum() >= 5 else clear


def fit_edges(strip: Strip, state: EdgeState) -> Floats:
    """Most likely edge of every frame, shape (n_frames, 6); see `edge_kernels.fit_edges`."""
    return kernels.fit_edges(
        strip.values, strip.scale, strip.offset, state.edge, state.lengths, state.lag, state.blur, state.pictures,
        state.inflation, PRIOR_SD, MARGIN_PX, 12,
    )  # fmt: skip


def residuals(strip: Strip, state: EdgeState, fit: Floats, use: NDArray[np.bool_]) -> tuple[Floats, Floats, float]:
    """What the fit leaves in the frames of `use`; see `edge_kernels.residual_sums`."""
    filled = np.nan_to_num(fit)
    filled[:, 0] = state.edge
    return kernels.residual_sums(
        strip.values, strip.scale, strip.offset, filled, state.lengths, state.lag, state.blur, state.pictures,
        MARGIN_PX, use,
    )  # fmt: skip
