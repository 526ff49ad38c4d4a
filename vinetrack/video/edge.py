"""The leading edge in a strip: where it was at mid-exposure in every frame, and how well that is known.

Alternating least squares. Given the edge, every pixel's brightness before and after its passing follows from a
2 by 2 system (no frame need be free of motion); given those, the edge of every frame follows by maximum likelihood
from a step blurred by optics and by its own motion. Tip shape, optical blur and exposure are estimated on the way.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

SPAN_FRAMES = 25
"""Frames on each side of its passing that speak for a column: long enough to average noise, short enough for sway."""
RIDGE = 0.05
"""Weight, in frames, of a pixel's neighbours where it was never seen itself: (noise / texture)² of 2 / 9 grey levels."""
MEMORY = 0.93
"""Neighbours' weights fall to 1/e over 14 px, a few times the grain of film and background."""
PRIOR_SD = 0.15
"""Relative scatter allowed to amplitude and level of the contrast from frame to frame."""
MARGIN_PX = 6.0
"""Pixels beyond the blurred edge that take part: they hold amplitude and level."""
FLOOR_PX = 0.02
"""No edge in compressed video was ever better than this."""


@dataclass(frozen=True)
class EdgeFit:
    """Leading edge in strip pixels, all arrays of shape (n_frames,).

    `edge_px` at mid-exposure, `sigma_px` its random error, `misfit` the mean squared residual in units of the noise
    (1 is perfect), `level` how far the neighbourhood's contrast strays; `cover` is the kymograph (n_frames, n_along),
    `contrast` the mean signed contrast by column (n_along,), NaN where unknown.
    """

    edge_px: Floats
    sigma_px: Floats
    misfit: Floats
    amplitude: Floats
    cover: NDArray[np.float32]
    contrast: Floats
    blur_px: float
    exposure_frames: float
    tip_lag_px: Floats
    passed: tuple[int, int]


@dataclass(frozen=True)
class _State:
    """What alternates: edge and its blur, and the two pictures."""

    edge: Floats
    lengths: Floats
    lag: Floats
    blur: float
    after: NDArray[np.float32]
    before: NDArray[np.float32]
    spread: Floats


def track_edge(
    strip: NDArray[Any], scale: Floats, offset: Floats, noise: float, exposure_frames: float = np.nan, rounds: int = 4
) -> EdgeFit:
    """Track the leading edge through a strip, shape (n_frames, n_across, n_along), growing towards higher columns.

    Parameters
    ----------
    scale, offset
        Shape (n_frames,): `scale * value + offset` is a frame freed of flicker.
    noise
        Standard deviation of one pixel, grey levels.
    exposure_frames
        Exposure over frame period; NaN to estimate it from the blur.

    Raises
    ------
    ValueError
        Where nothing in the strip changes as a passing front does.
    """
    from vinetrack.video import kymograph as ky

    path, _ = ky.first_path(strip, scale, offset, noise)
    passed = _passed_columns(strip, scale, offset, noise, path)
    path = np.clip(path, *passed)
    known = float(exposure_frames) if np.isfinite(exposure_frames) else 0.25
    state = _first_state(strip, scale, offset, path, known, noise)
    path = _second_path(strip, scale, offset, noise, state, passed)
    state = _repicture(strip, scale, offset, replace(state, edge=path, lengths=_lengths(path, known)), 0.0)
    fit = _fit(strip, scale, offset, state)
    for turn in range(rounds):
        state = _restate(strip, scale, offset, noise, state, fit, known)
        if turn == 1 and not np.isfinite(exposure_frames):
            known = _find_exposure(strip, scale, offset, state, fit)
        if turn < 3:
            state = _find_shape(strip, scale, offset, state, fit, turn)
        fit = _fit(strip, scale, offset, state)
    return _finish(strip, scale, offset, noise, state, fit, known, passed)


def outline(
    strip: NDArray[Any], scale: Floats, offset: Floats, noise: float, parts: int = 8
) -> tuple[float, float, float]:
    """Centreline of what the front leaves behind: shift of its begin and slope (px a px) across, and half width, px.

    From the power of the contrast by row in `parts` stretches along the way: a given axis two degrees off would
    otherwise cut the tube obliquely.

    Raises
    ------
    ValueError
        Where nothing in the strip changes as a passing front does.
    """
    from vinetrack.video import kymograph as ky

    path, _ = ky.first_path(strip, scale, offset, noise)
    passed = _passed_columns(strip, scale, offset, noise, path)
    state = _first_state(strip, scale, offset, np.clip(path, *passed), 0.25, noise)
    power = (state.after - state.before).astype(float)[:, passed[0] : passed[1]] ** 2
    rows = np.arange(len(power)) - (len(power) - 1) / 2
    pieces = np.array_split(np.arange(power.shape[1]), min(parts, max(1, power.shape[1] // 12)))
    middles, weights, places = [], [], []
    for piece in pieces:
        profile = np.convolve(
            np.minimum(power[:, piece], 4 * np.median(power[:, piece]) + 1e3).mean(axis=1), np.ones(3) / 3, "same"
        )
        profile = np.clip(profile - max(float(np.quantile(profile, 0.1)), 0.25 * float(profile.max())), 0, None) > 0
        low, high = np.flatnonzero(profile)[[0, -1]] if profile.any() else (0, len(rows) - 1)
        middles.append(0.5 * (rows[low] + rows[high]))
        places.append(passed[0] + float(piece.mean()))
        weights.append((rows[high] - rows[low]) / 2)
    slope, begin = _robust_line(np.array(places), np.array(middles))
    return begin, slope, float(np.median(weights)) + 1.5


def _robust_line(x: Floats, y: Floats) -> tuple[float, float]:
    """Slope and value at zero by the median of pairwise slopes (Theil and Sen)."""
    i, j = np.triu_indices(len(x), 1)
    slope = float(np.median((y[j] - y[i]) / (x[j] - x[i]))) if len(i) else 0.0
    return slope, float(np.median(y - slope * x))


def _passed_columns(strip: NDArray[Any], scale: Floats, offset: Floats, noise: float, path: Floats) -> tuple[int, int]:
    """First and last column the front passes: where whole runs of columns change along the path."""
    from vinetrack.video import kymograph as ky

    bunch = int(np.clip(strip.shape[1] // 12, 1, 4))
    score = ky.change_score(strip, scale, offset, 10, bunch, noise)
    columns = np.arange(strip.shape[2])
    when = np.clip(np.searchsorted(path, columns + 0.5), 0, len(path) - 1)
    got = np.max([score[np.clip(when + d, 0, len(path) - 1), columns] for d in (-1, 0, 1)], axis=0)
    # Half the usual contrast (0.3 in power): rather begin late (the neighbours then stand in for the background) than
    # early, where a column that never changed would say nothing at all about the edge.
    strong = got > max(5.0, 0.3 * float(np.median(got[got > 5.0])) if np.any(got > 5.0) else 5.0)
    run = np.convolve(strong, np.ones(9) / 9, mode="same") > 0.6
    if run.sum() < 9:
        raise ValueError("nothing moves along the axis")
    where = np.flatnonzero(run & strong)
    return max(int(where[0]), _after_jump(path)), int(where[-1]) + 1


def _after_jump(path: Floats) -> int:
    """Column where growth begins in earnest: a path that leaps at its start and crawls on has not grown that far.

    At release the tail jerks inside the film that already stands, and its columns change without any front. No front
    is three times as fast in its first frames as in those that follow.
    """
    steps = np.diff(path)
    if not np.any(steps > 0):
        return 0
    onset = int(np.argmax(steps > 0))
    begin = 0
    for t in range(onset, min(onset + 4, len(steps) - 4)):
        if steps[t] > 3 * max(float(np.median(steps[t + 1 : t + 5])), 2.0):
            begin = int(path[t + 1])
    return begin


def _lengths(edge: Floats, exposure_frames: float) -> Floats:
    """Length of the motion blur in every frame: speed times exposure, px."""
    if len(edge) < 3:
        return np.zeros(len(edge))
    speed = np.gradient(edge)
    smooth = np.convolve(np.pad(speed, 1, mode="edge"), [0.25, 0.5, 0.25], mode="valid")
    return np.clip(smooth, 0, None) * exposure_frames


def _first_state(
    strip: NDArray[Any], scale: Floats, offset: Floats, path: Floats, exposure: float, noise: float
) -> _State:
    rows, columns = strip.shape[1:]
    blank = np.zeros((rows, columns), np.float32)
    spread = np.full(3, noise**2)
    state = _State(path, _lengths(path, exposure), np.zeros(rows), 3.0, blank, blank, spread)
    return _repicture(strip, scale, offset, state, 0.0)


def _repicture(strip: NDArray[Any], scale: Floats, offset: Floats, state: _State, clip: float) -> _State:
    """Solve every pixel's brightness before and after, given the edge."""
    from vinetrack.video import edge_kernels as kernels

    args = (state.edge, state.lengths, state.lag, state.blur, SPAN_FRAMES, state.after, state.before, clip)
    sums = kernels.gather(strip, scale, offset, *args)
    middle = float(np.median(strip[len(strip) // 2])) * float(np.median(scale)) + float(np.median(offset))
    after, before = kernels.solve(sums, RIDGE, MEMORY, middle)
    return replace(state, after=after, before=before)


def _second_path(
    strip: NDArray[Any], scale: Floats, offset: Floats, noise: float, state: _State, passed: tuple[int, int]
) -> Floats:
    """Front by signed contrast over all columns, with clipped residuals."""
    from vinetrack.video import edge_kernels as kernels
    from vinetrack.video import kymograph as ky

    cover, weight = kernels.kymograph(strip, scale, offset, state.after, state.before, noise)
    # Capped: a few columns of strong contrast must not outvote the rest; what strays 0.6 is neither free nor film.
    weight = np.minimum(weight, 4 * np.median(weight[passed[0] : passed[1]]))
    weight[: max(passed[0] - kernels.BEHIND, 0)] = 0.0
    path = ky.covered_path(cover, weight, 0.6, 2)
    return np.clip(path - 0.5, passed[0] - 30, passed[1] + 2)


def _fit(strip: NDArray[Any], scale: Floats, offset: Floats, state: _State) -> Floats:
    from vinetrack.video import edge_kernels as kernels

    return kernels.fit_edges(
        strip, scale, offset, state.edge, state.lengths, state.lag, state.blur, state.after, state.before,
        state.spread, PRIOR_SD, MARGIN_PX, 12,
    )  # fmt: skip


def _restate(
    strip: NDArray[Any], scale: Floats, offset: Floats, noise: float, state: _State, fit: Floats, exposure: float
) -> _State:
    """Take over the fitted edges and renew blur lengths, pictures and the noise about the edge."""
    from vinetrack.video import edge_kernels as kernels

    edge = np.where(np.isfinite(fit[:, 0]), fit[:, 0], state.edge)
    state = replace(state, edge=edge, lengths=_lengths(edge, exposure))
    state = _repicture(strip, scale, offset, state, 4 * noise + 4)
    by_distance, _, _ = kernels.residual_sums(
        strip, scale, offset, _with_edge(fit, edge), state.lengths, state.lag, state.blur, state.after, state.before,
        MARGIN_PX, _moving(edge),
    )  # fmt: skip
    seen = by_distance[:, 1] > 4
    variance = np.where(seen, by_distance[:, 0] / np.maximum(by_distance[:, 1], 1), noise**2)
    smooth = np.convolve(np.pad(variance, 2, mode="edge"), np.ones(5) / 5, mode="valid")
    return replace(state, spread=np.maximum(smooth, (0.5 * noise) ** 2))


def _with_edge(fit: Floats, edge: Floats) -> Floats:
    filled = np.nan_to_num(fit)
    filled[:, 0] = edge
    return filled


def _moving(edge: Floats) -> NDArray[np.bool_]:
    """Frames in which the edge is on its way; all of them where hardly any is."""
    speed = np.abs(np.gradient(edge)) if len(edge) > 1 else np.zeros(len(edge))
    moving = speed > max(0.2, 0.1 * float(np.quantile(speed, 0.95)))
    return moving if moving.sum() >= 5 else np.ones(len(edge), dtype=bool)


def _find_shape(strip: NDArray[Any], scale: Floats, offset: Floats, state: _State, fit: Floats, turn: int) -> _State:
    """Estimate the optical blur, then how far each row of the tip lags behind its foremost point."""
    from vinetrack.video import edge_kernels as kernels

    moving = _moving(state.edge)
    slow = moving & (state.lengths <= max(2.0, float(np.quantile(state.lengths[moving], 0.3))))

    def leftover(blur: float, lag: Floats) -> tuple[Floats, float]:
        _, by_row, misfit = kernels.residual_sums(
            strip, scale, offset, _with_edge(fit, state.edge), state.lengths, lag, blur, state.after, state.before,
            MARGIN_PX, slow,
        )  # fmt: skip
        return by_row, misfit

    lag = state.lag
    for _ in range(3):
        by_row, _ = leftover(state.blur, lag)
        step = by_row[:, 0] / (by_row[:, 1] + 0.02 * float(by_row[:, 1].max()) + 1e-9)
        lag = _smooth_lag(lag + np.clip(step, -4, 4), by_row[:, 1])
    candidates = (
        np.array([0.5, 0.7, 0.9, 1.2, 1.6, 2.1, 2.8, 3.6])
        if turn == 0
        else state.blur * np.array([0.7, 0.85, 1, 1.2, 1.4])
    )
    misfits = [leftover(blur, lag)[1] for blur in candidates]
    return replace(state, lag=lag, blur=max(0.4, _least(candidates, np.array(misfits))))


def _smooth_lag(lag: Floats, weight: Floats) -> Floats:
    """Smooth slightly along the rows, by weight, and set zero at the foremost point of the tip.

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
    return np.clip(smooth - lead, -3.0, 60.0)


def _least(candidates: Floats, misfits: Floats) -> float:
    """Least misfit, refined by a parabola through its neighbours (in the logarithm of the candidate)."""
    i = int(np.argmin(misfits))
    if i in (0, len(candidates) - 1):
        return float(candidates[i])
    x, y = np.log(candidates[i - 1 : i + 2]), misfits[i - 1 : i + 2]
    curve = np.polyfit(x - x[1], y, 2)
    return (
        float(np.exp(x[1] + np.clip(-curve[1] / (2 * curve[0]), x[0] - x[1], x[2] - x[1])))
        if curve[0] > 0
        else float(candidates[i])
    )


def _find_exposure(strip: NDArray[Any], scale: Floats, offset: Floats, state: _State, fit: Floats) -> float:
    """Exposure in frame periods that explains the blur of the faster frames best; 0 where none moves 2 px a frame."""
    from vinetrack.video import edge_kernels as kernels

    moving = _moving(state.edge)
    speed = _lengths(state.edge, 1.0)
    fast = moving & (speed >= np.quantile(speed[moving], 0.5)) & (speed > 2)
    if not fast.any():
        return 0.25
    candidates = np.array([0.02, 0.05, 0.1, 0.15, 0.2, 0.3, 0.4, 0.5, 0.65, 0.8, 1.0])
    misfits = [
        kernels.residual_sums(
            strip, scale, offset, _with_edge(fit, state.edge), speed * tau, state.lag, state.blur, state.after,
            state.before, MARGIN_PX + float(speed.max()) / 2 * (1 - tau), fast,
        )[2]
        for tau in candidates
    ]  # fmt: skip
    return _least(candidates, np.array(misfits))


def _finish(
    strip: NDArray[Any], scale: Floats, offset: Floats, noise: float, state: _State, fit: Floats, exposure: float,
    passed: tuple[int, int],
) -> EdgeFit:  # fmt: skip
    from vinetrack.video import edge_kernels as kernels

    edge, sigma = fit[:, 0].copy(), np.hypot(fit[:, 1], FLOOR_PX)
    # A box of uniform dwell stands for the exposure: its middle is the mean position, ahead of mid-exposure by aτ²/24.
    bend = np.gradient(np.gradient(edge)) if len(edge) > 4 else np.zeros(len(edge))
    edge = edge - np.clip(bend, -50, 50) * exposure**2 / 24
    cover, _ = kernels.kymograph(strip, scale, offset, state.after, state.before, noise)
    contrast = (state.after - state.before).mean(axis=0).astype(float)
    contrast[: passed[0]] = np.nan
    contrast[passed[1] :] = np.nan
    return EdgeFit(edge, sigma, fit[:, 2], 1 + fit[:, 3], cover, contrast, state.blur, exposure, state.lag, passed)
