"""A straight strip along the axis, cut from every frame, freed of flicker and of camera shake.

The bands beside the tube show what stands still. Each frame's gain and shift come from them, by least squares on the
mean picture and its slopes, robust against what does move there (a door, a hand).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vinetrack.core.records import Floats
from vinetrack.video.axis import Axis

GAP_PX = 5
"""Rows left out between tube and band, for sway and blur. Chosen; at half a swaying tube enters the bands, at twice
small pictures have none."""
BAND_PX = (14, 44)
"""Least and greatest height of a band. Chosen: at the least, two bands hold PIXELS along 320 px of axis. Half or twice
changes how well flicker is known."""
REFERENCE_FRAMES = 15
"""Frames whose mean is what all are compared with. Chosen: its noise is then a quarter of a frame's."""

PIXELS = 9000
"""Pixels of the bands that are used, evenly spread: enough for a shift of 0.01 px. Derived for slopes of 5 grey levels
a pixel and noise of 5: 1/√9000 = 0.01 px."""
SHAKE_FLOOR_PX = 0.04
"""Shake below this is left alone: moving a picture by it costs more than it mends. Chosen as FLOOR_PX of
`point_quality`."""


@dataclass(frozen=True)
class Strip:
    """Pixels along the axis of every frame.

    `values` has shape (n_frames, n_across, n_along), as the camera wrote them; `scale * values + offset` (shape
    (n_frames,) each) is in grey levels of 255, free of flicker. `shift_px`, shape (n_frames, 2), is how far the
    picture had moved along and across (already undone); `noise` the standard deviation of a pixel, grey levels.
    `axis` runs through column 0 and along the middle row.
    """

    values: NDArray[Any]
    scale: Floats
    offset: Floats
    shift_px: Floats
    noise: float
    axis: Axis
    steadied: bool


def cut_strip(luma: NDArray[Any], axis: Axis, half_px: float) -> Strip:
    """Cut, level and steady the strip on both sides of an axis.

    Parameters
    ----------
    luma : grey levels, shape (n_frames, height, width).
    axis : in the picture, px.
    half_px : half the height of the strip, px.

    Returns
    -------
    the strip.
    """
    half = int(np.ceil(half_px))
    bands = _band_rows(luma.shape[1:], axis, half)
    unit = _unit(luma)
    n = len(luma)
    scale, offset, shift = np.full(n, unit), np.zeros(n), np.zeros((n, 2))
    steadied = False
    if bands:
        scale, offset, shift, steadied = _steady(luma, axis, bands, unit)
    values = sample(luma, axis, np.arange(-half, half + 1), shift if steadied else None)
    return Strip(values, scale, offset, shift, _noise(values, scale), axis, steadied)


def recut(strip: Strip, luma: NDArray[Any], axis: Axis, half_px: float) -> Strip:
    """Cut the same frames along a slightly different axis; gain and shift are those of `strip`.

    Parameters
    ----------
    strip : the first cut.
    luma : grey levels, shape (n_frames, height, width).
    axis : in the picture, px.
    half_px : half the height of the strip, px.

    Returns
    -------
    the strip.
    """
    half = int(np.ceil(half_px))
    values = sample(luma, axis, np.arange(-half, half + 1), strip.shift_px if strip.steadied else None)
    return replace(strip, values=values, axis=axis)


def sample(luma: NDArray[Any], axis: Axis, rows_px: NDArray[np.int_], shift_px: Floats | None = None) -> NDArray[Any]:
    """Values at whole pixels along the axis and at `rows_px` (consecutive) across; shape (n, n_rows, n_along).

    An axis along the picture's own rows or columns is cut out without interpolation, moved by less than half a
    pixel for it; `shift_px` (n, 2) moves every frame back by its own shift.

    Parameters
    ----------
    luma : grey levels, shape (n_frames, height, width).
    axis : in the picture, px.
    rows_px : consecutive distances beside the axis, shape (n_rows,), px.
    shift_px : shake of every frame along and across, shape (n_frames, 2), px.

    Returns
    -------
    grey levels, shape (n_frames, n_rows, n_along).
    """
    import cv2

    n_along = int(np.floor(axis.length_px)) + 1
    along, across = axis.direction, axis.normal
    start = axis.points(np.array(0.0), float(rows_px[0]))
    if shift_px is None and max(abs(along)) > 1 - 1e-9:
        return _slice(luma, start, along, across, len(rows_px), n_along)
    out = np.empty((len(luma), len(rows_px), n_along), luma.dtype)
    flags = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
    for i, frame in enumerate(luma):
        origin = start if shift_px is None else start + shift_px[i, 0] * along + shift_px[i, 1] * across
        matrix = np.array([[along[0], across[0], origin[0]], [along[1], across[1], origin[1]]])
        cv2.warpAffine(frame, matrix, (n_along, len(rows_px)), dst=out[i], flags=flags, borderMode=cv2.BORDER_REPLICATE)
    return out


def _slice(luma: NDArray[Any], start: Floats, along: Floats, across: Floats, n_rows: int, n_along: int) -> NDArray[Any]:
    """Whole pixels of an axis that runs along rows or columns of the picture; outside it the border repeats."""
    x = np.rint(
        start[0] + np.arange(n_along) * along[0] if abs(along[0]) > 0.5 else start[0] + np.arange(n_rows) * across[0]
    )
    y = np.rint(
        start[1] + np.arange(n_rows) * across[1] if abs(along[0]) > 0.5 else start[1] + np.arange(n_along) * along[1]
    )
    columns = np.clip(x, 0, luma.shape[2] - 1).astype(int)
    rows = np.clip(y, 0, luma.shape[1] - 1).astype(int)
    part = _take(_take(luma, rows, 1), columns, 2)
    return np.ascontiguousarray(part if abs(along[0]) > 0.5 else part.transpose(0, 2, 1))


def _take(luma: NDArray[Any], index: NDArray[np.int_], dim: int) -> NDArray[Any]:
    """Consecutive indices as a view, others as a copy."""
    steps = np.diff(index)
    if len(steps) and np.all(steps == 1):
        chosen = slice(int(index[0]), int(index[-1]) + 1)
        return luma[:, chosen] if dim == 1 else luma[:, :, chosen]
    return np.take(luma, index, axis=dim)


def squared(axis: Axis) -> Axis:
    """The axis turned and moved onto whole rows or columns where it is that already but for 0.2 px of slope.

    Cutting is then exact. The slope is forgiven over the whole length, not per pixel.

    Parameters
    ----------
    axis : in the picture, px.

    Returns
    -------
    the axis, or the same where it slopes by more.
    """
    (x0, y0), (x1, y1) = axis.from_px, axis.to_px
    if abs(y1 - y0) <= 0.4 and abs(x1 - x0) > 10:
        y = round((y0 + y1) / 2)
        return Axis((round(x0), y), (round(x1), y), axis.width_px)
    if abs(x1 - x0) <= 0.4 and abs(y1 - y0) > 10:
        x = round((x0 + x1) / 2)
        return Axis((x, round(y0)), (x, round(y1)), axis.width_px)
    return axis


def _unit(luma: NDArray[Any]) -> float:
    """Grey levels of 255 in one unit of the camera's."""
    if luma.dtype == np.uint8:
        return 1.0
    top = float(np.max(luma[:: max(1, len(luma) // 8), ::2, ::2]))
    return 255.0 / max(top, 1.0)


def _band_rows(shape: tuple[int, ...], axis: Axis, half: int) -> list[NDArray[np.int_]]:
    """Rows of the bands on both sides, as far as they lie inside the picture along the whole axis."""
    height, width = shape
    bands = []
    deep = int(np.clip(half, *BAND_PX))
    for side in (-1, 1):
        rows = np.arange(half + GAP_PX, half + GAP_PX + deep) * side
        ends = axis.points(np.array([[0.0], [axis.length_px]]), rows[None, :].astype(float))
        inside = ((ends > -0.5) & (ends < [width - 0.5, height - 0.5])).all(axis=(0, 2))
        kept = np.sort(rows[inside])
        if len(kept) >= 6:
            bands.append(kept)
    return bands


def _steady(
    luma: NDArray[Any], axis: Axis, bands: list[NDArray[np.int_]], unit: float
) -> tuple[Floats, Floats, Floats, bool]:
    """Gain, level and shift of every frame against the mean picture of its bands."""
    n = len(luma)
    shift = np.zeros((n, 2))
    fit, steadied = np.zeros((n, 4)), False
    picks = np.unique(np.linspace(0, n - 1, REFERENCE_FRAMES).astype(int))
    for turn in range(4):
        views = [sample(luma, axis, rows, shift if turn else None) for rows in bands]
        if turn == 0:
            basis = [_basis(np.median(view[picks], axis=0)) for view in views]
        fit, sd = _register(views, basis)
        if turn == 0:
            strength = float(np.median(np.abs(fit[:, 2:]))), float(np.median(sd))
            if not np.isfinite(strength[1]) or strength[0] < max(SHAKE_FLOOR_PX, 2.5 * strength[1]):
                break
            if not _halves_agree(views, basis):
                break
            steadied = True
        shift = shift + np.clip(fit[:, 2:], -1.5, 1.5)
        if turn == 1:
            views = [sample(luma, axis, rows, shift) for rows in bands]
            basis = [_basis(np.median(view[picks], axis=0)) for view in views]
        if turn > 1 and float(np.abs(fit[:, 2:]).max()) < 0.02:
            break
    gain = np.clip(fit[:, 0], 0.2, 5.0)
    return unit / gain, -fit[:, 1] * unit / gain, shift, steadied


def _halves_agree(views: list[NDArray[Any]], basis: list[NDArray[np.float32]]) -> bool:
    """Whether the near and the far half of the bands tell of the same shift along the axis: a shaken camera moves both.

    A door, a shadow or a mirror image of the tip that passes moves one after the other.
    """
    columns = views[0].shape[2]
    parts = []
    for low, high in ((0, columns // 2), (columns // 2, columns)):
        basis_here = [part.reshape(4, -1, columns - 2)[:, :, low : high - 2].reshape(4, -1) for part in basis]
        parts.append(_register([view[:, :, low:high] for view in views], basis_here))
    (first, first_sd), (second, second_sd) = parts
    apart, both = np.abs(first[:, 2] - second[:, 2]), np.abs(first[:, 2] + second[:, 2])
    most = apart + both >= np.quantile(apart + both, 0.75)
    doubt = 2 * float(np.median(first_sd + second_sd))
    return float(np.mean(apart[most])) < max(0.7 * float(np.mean(both[most])), doubt)


def _basis(reference: NDArray[Any]) -> NDArray[np.float32]:
    """Mean picture, one, and its slopes along and across, shape (4, n_pixels)."""
    picture = reference.astype(np.float32)
    across, along = np.gradient(picture, axis=0), np.gradient(picture, axis=1)
    inner = (slice(1, -1), slice(1, -1))
    parts = (picture[inner], np.ones_like(picture[inner]), -along[inner], -across[inner])
    return np.stack([part.ravel() for part in parts])


def _register(views: list[NDArray[Any]], basis: list[NDArray[np.float32]]) -> tuple[Floats, Floats]:
    """Gain, level, shift along and across of every frame (n, 4), and the error of the shift (n,), robustly.

    frame(x) = gain · picture(x − shift) + level. Where the bands show no texture the level is held near zero and the
    shift is left at zero.
    """
    every = max(1, sum(part.shape[1] for part in basis) // PIXELS)
    design = np.concatenate(basis, axis=1)[:, ::every].astype(np.float64)
    n = len(views[0])
    out, error = np.zeros((n, 4)), np.full(n, np.inf)
    gram = design @ design.T
    level = float(np.abs(design[0]).mean()) + 1e-9
    ridge = np.diag([0.0, 25.0 * gram[1, 1] * (2.0 / level) ** 2 * 0.01, 1e-3 * level, 1e-3 * level])
    for t in range(n):
        data = np.concatenate([view[t, 1:-1, 1:-1].ravel() for view in views])[::every].astype(np.float64)
        keep = None
        for _ in range(3):
            d, g, v = (design, gram, data) if keep is None else (design[:, keep], None, data[keep])
            g = d @ d.T if g is None else g
            solution = np.linalg.solve(g + ridge, d @ v)
            residual = data - solution @ design
            size = 1.4826 * float(np.median(np.abs(residual))) + 0.3
            fresh = np.abs(residual) < 4 * size
            if keep is not None or fresh.mean() > 0.99:
                break
            keep = fresh
        gain = max(float(solution[0]), 0.05)
        out[t] = gain, solution[1], -solution[2] / gain * -1.0, -solution[3] / gain * -1.0
        error[t] = size * float(np.sqrt(max(np.linalg.inv(g + ridge)[2, 2], 0.0)))
    return out, error


def _noise(values: NDArray[Any], scale: Floats) -> float:
    """Standard deviation of a pixel from the differences of neighbouring frames, grey levels, at least 1.

    The median over frames and pixels: motion touches few of them. Compression freezes a resting picture; what moves
    is never known better than a grey level.
    """
    step = max(1, len(values) // 40)
    first, second = values[:-1:step, ::2, ::2], values[1::step, ::2, ::2]
    n = min(len(first), len(second))
    change = np.abs(second[:n].astype(np.float32) - first[:n].astype(np.float32))
    middle = np.median(change, axis=(1, 2)) if n else np.zeros(1)
    return max(1.0, float(np.quantile(middle, 0.7)) * 1.4826 / np.sqrt(2) * float(np.median(scale)))
