"""What the edge tracker alternates between: where the edge is, what lies before and after it, and how it is pictured.

What the tip looks like, the optical blur and the exposure are estimated in `vinetrack.video.tip_shape`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from vinetrack.core.records import Floats
from vinetrack.video import edge_kernels as kernels
from vinetrack.video import picture_kernels
from vinetrack.video.edge_cover import VECTOR, cover_reach
from vinetrack.video.strip import Strip

MEMORY_FRAMES = 6.0
"""What a pixel showed this long before and after its passing counts 1/e: enough frames to average noise, few enough
that a door that has swung away, or a tube that sways, is forgotten. Chosen. By reasoning: at half noise of the
pictures grows by 1.4; at twice things that moved stay in them."""
RIDGE = 0.05
"""Weight, in frames, of a pixel's neighbours where it was seen itself: (noise / texture)² of 2 / 9 grey levels.
Derived from TEXTURE and usual noise: (2/9)² = 0.05."""
MEMORY = 0.93
"""Neighbours' weights fall to 1/e over 14 px, a few times the grain of film and background. Derived: −1/ln 0.93 =
13.8."""
TEXTURE = 12.0
"""Standard deviation, grey levels, of a pixel about its neighbours, where it was never seen itself."""
PRIOR_SD = 0.15
"""Relative scatter allowed to amplitude and level of the contrast from frame to frame. Chosen: flicker and shading of
a tip. By reasoning: at half changes of light displace the edge, at twice a payload before it passes for one."""
FIT_ROUNDS, ROUGH_ROUNDS = 12, 4
"""Steps of Gauss-Newton at most, and those of fits of which others follow. Measured (`flicker` and `light_stream` of
`benchmarks/decoding.py`): steps fall below 0.001 px after six on average. At half of the first noisy frames stay off by
hundredths of a pixel; the second changes only how soon the alternation settles."""
MARGIN_PX = 6.0
"""Pixels beyond the blurred edge that take part: they hold amplitude and level. Chosen: six pixels on either side know
level and amplitude better than their prior. At half worse, at twice other things come in."""
SHADED_PX = 24
"""Distance from the edge within which the tip may show light and shade of its own. Chosen: about the length of the tip
of the smallest vines. Measured (`contrast_reversal`, tuning seeds 3 to 6): errors of 0.41, 0.43, 0.32 and 0.68 px, at
half 0.96, 0.60, 0.76 and 1.02, at twice 0.41, 0.44, 0.31 and 0.65; elsewhere the same to 0.01 px at all three."""
SELFSAME = 0.4
"""Share of the usual contrast under which film and background near the start are the same thing seen twice. Chosen
below half. By reasoning: at half film over itself is tracked as an edge; near 1 every start is taken for it."""
CLEAR_PX = 60.0
"""Growth after which the surroundings of the start are free of what held the tip there (20 mm at 3 px/mm). Chosen: the
length of a latch. At half doors still count as shape of the tip; at twice short growth leaves no frames, hence a fifth
of the way at most."""


@dataclass(frozen=True)
class EdgeState:
    """What alternates.

    The edge (n_frames,) and its blur lengths, the tip's lag by row and optical blur, and the pictures
    (4, n_across, n_along): brightness after and before the edge and the variance about each. `inflation` multiplies
    those variances by distance ahead of the edge, 1 px a bin about its middle. `shading` (2 SHADED_PX + 1,) is what the
    tip shows beyond film and background, such as a bright rim that moves with it, grey levels, in bins like those.
    """

    edge: Floats
    lengths: Floats
    lag: Floats
    blur: float
    pictures: NDArray[np.float32]
    inflation: Floats
    shading: Floats = field(default_factory=lambda: np.zeros(2 * SHADED_PX + 1))


def blur_lengths(edge: Floats, exposure_frames: float) -> Floats:
    """Length of the motion blur in every frame, shape (n_frames,): speed times exposure, px.

    Parameters
    ----------
    edge : shape (n_frames,), px.
    exposure_frames : exposure over frame period.

    Returns
    -------
    shape (n_frames,), px.
    """
    if len(edge) < 3:
        return np.zeros(len(edge))
    speed = np.gradient(edge)
    smooth = np.convolve(np.pad(speed, 1, mode="edge"), [0.25, 0.5, 0.25], mode="valid")
    return np.clip(smooth, 0, None) * exposure_frames


def moving_frames(edge: Floats) -> NDArray[np.bool_]:
    """Frames in which the edge is on its way, shape (n_frames,); all of them where hardly any is.

    Parameters
    ----------
    edge : shape (n_frames,), px.

    Returns
    -------
    mask, shape (n_frames,).
    """
    speed = np.abs(np.gradient(edge)) if len(edge) > 1 else np.zeros(len(edge))
    moving = speed > max(0.2, 0.1 * float(np.quantile(speed, 0.95)))
    return moving if moving.sum() >= 5 else np.ones(len(edge), dtype=bool)


def frames_that_tell(edge: Floats) -> NDArray[np.bool_]:
    """Frames from which pictures and shape are known: those in motion, and as many about them as are remembered.

    Parameters
    ----------
    edge : shape (n_frames,), px.

    Returns
    -------
    mask, shape (n_frames,).
    """
    moving, reach = np.flatnonzero(moving_frames(edge)), math.ceil(MEMORY_FRAMES * picture_kernels.FORGOTTEN)
    frames = np.arange(len(edge))
    return np.asarray((frames >= moving[0] - reach) & (frames <= moving[-1] + reach))


def held_at_rest(edge: Floats, tell: NDArray[np.bool_]) -> Floats:
    """The edge with what rests long before and after the motion where it is at the borders of `tell`.

    Parameters
    ----------
    edge : shape (n_frames,), px.
    tell : from `frames_that_tell`, shape (n_frames,).

    Returns
    -------
    shape (n_frames,), px.
    """
    frames = np.flatnonzero(tell)
    return np.asarray(edge[np.clip(np.arange(len(edge)), frames[0], frames[-1])])


def repicture(strip: Strip, state: EdgeState, clip: float) -> EdgeState:
    """Solve every pixel's brightness before and after, given the edge; `clip` > 0 weighs strays down.

    Parameters
    ----------
    strip : along the axis.
    state : where the edge is and how it is blurred.
    clip : grey levels beyond which a stray value counts less; 0 to count all alike.

    Returns
    -------
    the state with new `pictures`.
    """
    early, late = _passing(state, strip.values.shape[2])
    sums = picture_kernels.gather(
        strip.values, strip.scale, strip.offset, state.edge, state.lengths, state.lag, state.blur, early, late,
        MEMORY_FRAMES, state.pictures, clip, state.shading,
    )  # fmt: skip
    half = len(strip.values) // 2
    middle = float(np.median(strip.values[half])) * float(strip.scale[half]) + float(strip.offset[half])
    pictures = picture_kernels.solve(sums, RIDGE, MEMORY, middle, strip.noise, TEXTURE)
    hidden = _film_from_the_start(state, pictures)
    if hidden.any():
        sums[5:8, :, hidden] = 0.0
        pictures = picture_kernels.solve(sums, RIDGE, MEMORY, middle, strip.noise, TEXTURE)
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
    """Place beyond which nothing that held the tip at its start is near: CLEAR_PX on, or a fifth of the way.

    Parameters
    ----------
    edge : shape (n_frames,), px.

    Returns
    -------
    column, px.
    """
    return float(edge[0] + min(CLEAR_PX, 0.2 * (edge.max() - edge[0])))


def core_frames(state: EdgeState, fit: Floats) -> NDArray[np.bool_]:
    """Moving frames clear of the start that fit no worse than most, shape (n_frames,): those that tell of the tip.

    Parameters
    ----------
    state : where the edge is.
    fit : from `fit_edges`, shape (n_frames, 6).

    Returns
    -------
    mask, shape (n_frames,).

    Raises
    ------
    ValueError
        If no edge was found in any of them.
    """
    moving = moving_frames(state.edge)
    clear = moving & (state.edge > clear_of_start(state.edge))
    if not np.isfinite(fit[clear if clear.sum() >= 5 else moving, 2]).any():
        raise ValueError("something moves along the axis, but nothing like an edge is seen in any frame")
    if clear.sum() < 5:
        return moving
    good = clear & (fit[:, 2] <= 1.3 * np.nanmedian(fit[clear, 2]))
    return good if good.sum() >= 5 else clear


def fit_edges(strip: Strip, state: EdgeState, rounds: int = FIT_ROUNDS) -> Floats:
    """Most likely edge of every frame, shape (n_frames, 6); see `edge_kernels.fit_edges`.

    Parameters
    ----------
    strip : along the axis.
    state : where the search begins, NaN to leave a frame out, and what lies before and after the edge.
    rounds : steps of Gauss-Newton at most.

    Returns
    -------
    a row a frame: edge, its sigma, misfit, amplitude − 1, level, pixels used.
    """
    frames = np.flatnonzero(np.isfinite(state.edge))
    out = np.full((len(state.edge), 6), np.nan)
    out[frames] = search_edges(strip, state, frames, state.edge[frames], rounds)
    return out


def search_edges(
    strip: Strip, state: EdgeState, frames: NDArray[np.int_], starts: Floats, rounds: int = FIT_ROUNDS
) -> Floats:
    """Search the edge from one start after another, in whichever frames; see `edge_kernels.fit_edges`.

    Parameters
    ----------
    strip : along the axis.
    state : what lies before and after the edge.
    frames : frame of each search, shape (n_searches,).
    starts : where each begins, shape (n_searches,), px.
    rounds : steps of Gauss-Newton at most.

    Returns
    -------
    a row a search, as in `fit_edges`.
    """
    return kernels.fit_edges(
        strip.values, strip.scale, strip.offset, starts, state.lengths, state.lag, state.blur, state.pictures,
        state.inflation, PRIOR_SD, MARGIN_PX, rounds, _shading_as_wide(state, MARGIN_PX), frames,
    )  # fmt: skip


def _shading_as_wide(state: EdgeState, margin_px: float) -> Floats:
    """The shading of the tip with zeros about it, as wide as the compiled loops read."""
    longest = float(np.nanmax(state.lengths, initial=0.0))
    reach = math.ceil(cover_reach(longest, state.blur) + margin_px) + VECTOR + 4
    more = max(reach - SHADED_PX, 0)
    wide = np.zeros(len(state.shading) + 2 * more)
    wide[more : len(wide) - more] = state.shading
    return wide


class Residuals(NamedTuple):
    """What a fit leaves, in sums that `edge_kernels.residual_sums` describes."""

    by_distance: Floats
    by_row: Floats
    misfit: float
    by_place: Floats


def residuals(
    strip: Strip, state: EdgeState, fit: Floats, use: NDArray[np.bool_], margin_px: float = MARGIN_PX
) -> Residuals:
    """What the fit leaves in the frames of `use`; see `edge_kernels.residual_sums`.

    Parameters
    ----------
    strip : along the axis.
    state : where the edge is, and what lies before and after it.
    fit : from `fit_edges`, shape (n_frames, 6).
    use : mask, shape (n_frames,).
    margin_px : pixels beyond the blurred edge that take part.

    Returns
    -------
    Residuals
    """
    filled = np.nan_to_num(fit)
    filled[:, 0] = state.edge
    sums = kernels.residual_sums(
        strip.values, strip.scale, strip.offset, filled, state.lengths, state.lag, state.blur, state.pictures,
        margin_px, use, _shading_as_wide(state, margin_px),
    )  # fmt: skip
    return Residuals(*sums)


def first_state(strip: Strip, path: Floats, exposure: float) -> EdgeState:
    """Picture film and background from a first path of the front, with a tip that is even and a usual blur.

    Parameters
    ----------
    strip : along the axis.
    path : shape (n_frames,), px.
    exposure : of a frame, over the frame period.

    Returns
    -------
    the state to begin with.
    """
    rows, columns = strip.values.shape[1:]
    blank = np.zeros((4, rows, columns), np.float32)
    state = EdgeState(path, blur_lengths(path, exposure), np.zeros(rows), 2.0, blank, np.ones(3))
    return repicture(strip, state, 0.0)
