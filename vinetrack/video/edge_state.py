"""What the edge tracker alternates between: where the edge is, what lies before and after it, and how it is pictured.

The end of the file estimates the shape of the tip, the optical blur and the exposure from what the edge leaves
unexplained.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from vinetrack.core.records import Floats
from vinetrack.video import edge_kernels as kernels
from vinetrack.video import picture_kernels
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
MARGIN_PX = 6.0
"""Pixels beyond the blurred edge that take part: they hold amplitude and level. Chosen: six pixels on either side know
level and amplitude better than their prior. At half worse, at twice other things come in."""
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
    those variances by distance ahead of the edge, 1 px a bin about its middle.
    """

    edge: Floats
    lengths: Floats
    lag: Floats
    blur: float
    pictures: NDArray[np.float32]
    inflation: Floats


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
        MEMORY_FRAMES, state.pictures, clip,
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


def fit_edges(strip: Strip, state: EdgeState) -> Floats:
    """Most likely edge of every frame, shape (n_frames, 6); see `edge_kernels.fit_edges`.

    Parameters
    ----------
    strip : along the axis.
    state : where the search begins, and what lies before and after the edge.

    Returns
    -------
    a row a frame: edge, its sigma, misfit, amplitude − 1, level, pixels used.
    """
    return kernels.fit_edges(
        strip.values, strip.scale, strip.offset, state.edge, state.lengths, state.lag, state.blur, state.pictures,
        state.inflation, PRIOR_SD, MARGIN_PX, 12,
    )  # fmt: skip


def residuals(strip: Strip, state: EdgeState, fit: Floats, use: NDArray[np.bool_]) -> tuple[Floats, Floats, float]:
    """What the fit leaves in the frames of `use`; see `edge_kernels.residual_sums`.

    Parameters
    ----------
    strip : along the axis.
    state : where the edge is, and what lies before and after it.
    fit : from `fit_edges`, shape (n_frames, 6).
    use : mask, shape (n_frames,).

    Returns
    -------
    sums by distance, by row, and the misfit.
    """
    filled = np.nan_to_num(fit)
    filled[:, 0] = state.edge
    return kernels.residual_sums(
        strip.values, strip.scale, strip.offset, filled, state.lengths, state.lag, state.blur, state.pictures,
        MARGIN_PX, use,
    )  # fmt: skip


BLURS_PX = np.array([0.5, 0.7, 0.9, 1.2, 1.6, 2.1, 2.8])
EXPOSURES = np.array([0.02, 0.05, 0.1, 0.15, 0.2, 0.3, 0.4, 0.5, 0.65, 0.8, 1.0])
ASSUMED_EXPOSURE = 0.25
"""Exposure over frame period until it is estimated. Chosen as usual for high-speed cameras; it is replaced after the
second round."""
FEWEST_FAST = 6
"""Chosen: frames from which a blur is told from the shape of the tip; a clip of eight frames, five of them in motion
and without any blur, showed one of 0.4 frames. The fastest trials of the demonstration have seven."""
CONTRADICTED = 1.01
"""Measured (seeds 20900 and up): the true exposure leaves a misfit within 1.003 of the least of any exposure but in
one recording of eight (1.012); twice the true one or more leaves 1.02 to 1.35 where the edge moves 7 px a frame."""
FASTEST_LAG_STEP_PX = 4.0
"""Largest change of a row's lag in one round. Chosen as trust region; only the number of rounds depends on it."""

DEEPEST_LAG_PX = 60.0
"""Largest lag of a row behind the foremost point. Chosen: above the radius of the widest tip, 36 px at 3 px/mm."""

FEW_FRAMES = 16
"""Frames from which the blur is told. Chosen for time; at half the blur scatters by 1.4 more."""

OPTICAL_BLUR_PX = (0.4, 3.0)
"""From a sharp pixel to a picture out of focus; more is taken for blur only where noise drowns the edge. Chosen;
sharper is not sampled, and wider is noise."""


def find_shape(strip: Strip, state: EdgeState, fit: Floats, anew: bool) -> EdgeState:
    """Estimate how far each row of the tip lags behind its foremost point, then the optical blur.

    From the core frames with less blur by motion: not those in which a door may still stand before the tip.

    Parameters
    ----------
    strip : along the axis.
    state : the last estimate.
    fit : from `fit_edges`, shape (n_frames, 6).
    anew : whether the blur is looked for everywhere, not only near the last one.

    Returns
    -------
    the state with new `lag` and `blur`, and the edge moved to the foremost point.
    """
    core = core_frames(state, fit)
    slow = core & (state.lengths <= max(2.0, float(np.quantile(state.lengths[core], 0.5))))
    for _ in range(3):
        _, by_row, _ = residuals(strip, state, fit, slow)
        step = by_row[:, 0] / (by_row[:, 1] + 0.02 * float(by_row[:, 1].max()) + 1e-9)
        step = np.clip(step, -FASTEST_LAG_STEP_PX, FASTEST_LAG_STEP_PX)
        lag, lead = _smooth_lag(state.lag + step, by_row[:, 1])
        state = replace(state, lag=lag, edge=state.edge - lead)
    candidates = BLURS_PX if anew else state.blur * np.array([0.7, 0.85, 1, 1.2, 1.4])
    few = np.flatnonzero(slow)[:: max(1, int(slow.sum()) // FEW_FRAMES)]
    misfits = [_misfit_refitted(strip, replace(state, blur=float(blur)), few) for blur in candidates]
    return replace(state, blur=float(np.clip(_least(candidates, np.array(misfits)), *OPTICAL_BLUR_PX)))


def _misfit_refitted(strip: Strip, state: EdgeState, frames: NDArray[np.int_]) -> float:
    """Misfit of some frames with their edges sought anew: a blur must not be judged by edges fitted with another."""
    edge = np.full(len(state.edge), np.nan)
    edge[frames] = state.edge[frames]
    fit = fit_edges(strip, replace(state, edge=edge))
    use = np.isfinite(fit[:, 0])
    edge[use] = fit[use, 0]
    return residuals(strip, replace(state, edge=edge), fit, use)[2]


def find_exposure(strip: Strip, state: EdgeState, fit: Floats) -> float:
    """Exposure in frame periods that explains the blur of the faster frames best; a guess where none moves 2 px.

    Parameters
    ----------
    strip : along the axis.
    state : the last estimate.
    fit : from `fit_edges`, shape (n_frames, 6).

    Returns
    -------
    exposure over frame period.
    """
    core = core_frames(state, fit)
    speed = blur_lengths(state.edge, 1.0)
    fast = core & (speed >= np.quantile(speed[core], 0.5)) & (speed > 2)
    if not fast.any():
        return ASSUMED_EXPOSURE
    misfits = [residuals(strip, replace(state, lengths=speed * tau), fit, fast)[2] for tau in EXPOSURES]
    return _least(EXPOSURES, np.array(misfits))


def seen_exposure(strip: Strip, state: EdgeState, fit: Floats, stated_frames: float) -> tuple[float, float]:
    """Find the exposure that the blur shows in place of a stated one.

    The exposure is NaN where the stated one explains the blur as well (misfit within CONTRADICTED).

    Parameters
    ----------
    strip : along the axis.
    state : the last estimate.
    fit : from `fit_edges`, shape (n_frames, 6).
    stated_frames : stated exposure over frame period.

    Returns
    -------
    exposure over frame period, NaN where the stated one explains the blur as well (misfit within CONTRADICTED); and the
        median speed of the frames used, px a frame.
    """
    core = core_frames(state, fit)
    speed = blur_lengths(state.edge, 1.0)
    fast = core & (speed >= np.quantile(speed[core], 0.5)) & (speed > 2) if core.any() else core
    if fast.sum() < FEWEST_FAST:
        return np.nan, np.nan
    tried = np.append(EXPOSURES, stated_frames)
    misfits = np.array([residuals(strip, replace(state, lengths=speed * tau), fit, fast)[2] for tau in tried])
    contradicted = misfits[-1] > CONTRADICTED * misfits.min()
    seen = _least(EXPOSURES, misfits[:-1]) if contradicted else np.nan
    return seen, float(np.median(speed[fast]))


def _smooth_lag(lag: Floats, weight: Floats) -> tuple[Floats, float]:
    """Smooth slightly along the rows, by weight, and set zero at the foremost point of the tip; what was taken off.

    That point is the vertex of a parabola through the foremost third of the rows that show an edge at all: the least
    of them would follow their noise.
    """
    kernel = np.exp(-0.5 * (np.arange(-3, 4) / 0.8) ** 2)
    weight = weight + 1e-6 * float(weight.max() + 1e-12)
    top = np.convolve(np.pad(lag * weight, 3, mode="edge"), kernel, mode="valid")
    smooth = top / np.convolve(np.pad(weight, 3, mode="edge"), kernel, mode="valid")
    seen = np.flatnonzero(weight > 0.1 * float(np.median(weight[weight >= np.median(weight)])))
    front = seen[np.argsort(smooth[seen])[: max(len(seen) // 3, 3)]]
    lead = float(np.average(smooth[front], weights=weight[front]))
    if len(front) >= 6:
        middle = float(front.mean())
        curve = np.polyfit(front - middle, smooth[front], 2, w=np.sqrt(weight[front]))
        vertex = -curve[1] / (2 * curve[0]) if curve[0] > 1e-6 else np.inf
        if front.min() <= vertex + middle <= front.max():
            lead = float(np.polyval(curve, vertex))
    return np.clip(smooth - lead, -3.0, DEEPEST_LAG_PX), lead


def _least(candidates: Floats, misfits: Floats) -> float:
    """Candidate of least misfit, refined by a parabola through its neighbours in its logarithm."""
    i = int(np.argmin(misfits))
    if i in (0, len(candidates) - 1):
        return float(candidates[i])
    x, y = np.log(candidates[i - 1 : i + 2]), misfits[i - 1 : i + 2]
    curve = np.polyfit(x - x[1], y, 2)
    if curve[0] <= 0:
        return float(candidates[i])
    return float(np.exp(x[1] + np.clip(-curve[1] / (2 * curve[0]), x[0] - x[1], x[2] - x[1])))
