"""A strip along the axis, cut from every frame, corrected for flicker and camera shake.

The background beside the tube stands still: gain, level and shift of every frame follow from it, by robust least
squares on the median picture and its derivatives (Lucas-Kanade). Moving objects, such as a door or a hand, appear as
outliers and are left out.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from vinetrack.core.records import Bools, Floats, Indices
from vinetrack.tracks.position_noise import FOURTH_DIFFERENCE
from vinetrack.video.axis import Axis, SmallPictures, axis_through

BAND_GAP_PX = 5  # Rows left out between tube and background, to allow for sway and blur (chosen)
Picture = NDArray[np.float32]
SLOW_PX = 0.03  # Slow error of any edge, which nothing in a track shows (measured)


@dataclass(frozen=True)
class Strip:
    """Pixels along the axis in every frame. `values`, shape (n_frames, n_across, n_along), are as the camera wrote
    them; `scale * values + offset`, shape (n_frames,) each, is in grey levels of 255 and free of flicker. `shift_px`,
    shape (n_frames, 2), is how far the camera's shake moved each picture in x and y, zero unless `stabilised`.
    """

    values: NDArray[Any]
    scale: Floats
    offset: Floats
    shift_px: Floats
    noise: float
    axis: Axis
    stabilised: bool

    def brightness(self, frames: slice | Indices = slice(None)) -> Picture:
        """Grey levels of 255, free of flicker, of some frames, shape (n_frames, n_across, n_along)."""
        scale, offset = (of_frame[frames, None, None].astype(np.float32) for of_frame in (self.scale, self.offset))
        return np.asarray(self.values[frames] * scale + offset)


@dataclass(frozen=True, kw_only=True)
class Positions:
    """Positions along a `strip` by frame, px, from any of the trackers; arrays of shape (n_frames,). `edge_px` is where
    the edge, or the body, is at mid-exposure, NaN where it is not seen, `sigma_px` its random error, `slow_px` what
    neighbouring frames share. `reach_px` is how far from the end of the strip the last place is
    that can be seen; `end` the frame in which a body turns back; `width_px` that of a tube, with its standard error.
    """

    strip: Strip
    edge_px: Floats
    sigma_px: Floats
    unsure: Bools
    reach_px: float
    slow_px: Floats | float
    exposure_frames: float = math.nan
    end: int | None = None
    seen_exposure_frames: float = math.nan
    fast_px_per_frame: float = math.nan
    is_edge: bool = True
    width_px: float = math.nan
    width_sigma_px: float = math.nan


@dataclass(frozen=True)
class Look:
    """What a tracker looks at: pictures, (n_frames, height, width), the axis, the pictures shrunk, facts of a trial."""

    luma: NDArray[Any]
    axis: Axis
    small: SmallPictures
    travel_ratio: float
    exposure_frames: float


class Tracker(Protocol):
    """Follows what moves along an axis; another one is a class in a file of its own and a name in `track.TRACKERS`."""

    def follow(self, look: Look) -> Positions | None:
        """Positions by frame; None where something moves that is another tracker's."""
        ...


def calibrated_sigma(edge_px: Floats, sigma_px: Floats) -> Floats:
    """Scale the stated errors to the roughness of the track in motion. Fourth differences cancel any cubic motion and
    have the variance Σ c² σ², c = (1, −4, 6, −4, 1). The factor is their median size in units of that standard
    deviation; it stays 1 where there are fewer than eight. Shapes: edge_px, sigma_px (n_frames,) → (n_frames,).
    """
    windows = np.lib.stride_tricks.sliding_window_view
    difference = windows(edge_px, 5) @ FOURTH_DIFFERENCE
    expected = np.sqrt(windows(sigma_px**2, 5) @ FOURTH_DIFFERENCE**2)
    # 0.3: step of a frame from which the frame counts for the roughness of the track (chosen)
    use = (np.gradient(edge_px) > 0.3) & np.isfinite(edge_px)
    inside = windows(use, 5).all(axis=1) & np.isfinite(difference) & (expected > 0)
    if inside.sum() < 8:
        return sigma_px
    factor = 1.4826 * float(np.median(np.abs(difference[inside] / expected[inside])))
    return sigma_px * float(np.clip(factor, 0.5, 6.0))  # 0.5, 6.0: least and largest factor (chosen)


def cut_strip(
    luma: NDArray[Any], axis: Axis, half_px: float, before: Strip | None = None, nearest: bool = False
) -> Strip:
    """Cut the strip about an axis, no wider than a curve's normals allow, of the `nearest` pixels or interpolated;
    corrected for flicker and shake as `before`, a strip of the same frames. Shapes: luma (n_frames, height, width).
    """
    half = int(np.ceil(min(half_px, max(axis.largest_half_px - 1, 2.0))))
    if before is None:
        scale, offset, shift, stabilised = steadied(luma, axis, half)
    else:
        scale, offset, shift, stabilised = before.scale, before.offset, before.shift_px, before.stabilised
    along, across = np.meshgrid(np.arange(int(axis.length_px) + 1.0), np.arange(-half, half + 1.0))
    places, moved = axis.points(along, across), shift if stabilised else None
    # An axis along rows or columns of the picture is cut without interpolation, moved by less than half a pixel.
    if moved is None and (nearest or (not axis.bends and max(abs(axis.direction)) > 1 - 1e-9)):
        places = np.rint(places).astype(int)
    values = _pixels(luma, places, moved, nearest)
    # Noise of a pixel from differences of neighbouring frames, grey levels. Medians over pixels, since motion affects
    # few of them; at least 1, since compression freezes a picture at rest, while moving pixels are never known better.
    step = max(1, len(values) // 40)
    first, second = (of_pair[::step, ::4, ::4].astype(np.float32) for of_pair in (values[:-1], values[1:]))
    medians = np.median(np.abs(second - first), axis=(1, 2)) if len(first) else np.zeros(1)
    noise = max(1.0, float(np.quantile(medians, 0.7)) * 1.4826 / np.sqrt(2) * float(np.median(scale)))
    return Strip(values, scale, offset, shift, noise, axis, stabilised)


def snap_to_grid(axis: Axis) -> Axis:
    """Move an axis that lies along rows or columns, except for a small slope over its whole length (1.6 px, measured),
    onto whole rows or columns. Cutting then needs no interpolation, and a tenth of the time.
    """
    ends = np.array([axis.from_px, axis.to_px], dtype=float)
    extent = np.abs(ends[1] - ends[0])
    level = int(np.argmin(extent))
    if axis.bends or extent[level] > 1.6 or extent[1 - level] <= 10:
        return axis
    ends[:, level] = ends[:, level].mean()
    return axis_through(np.rint(ends), axis.width_px)


def _pixels(
    luma: NDArray[Any], places: Indices | Floats, shift_px: Floats | None, nearest: bool = False
) -> NDArray[Any]:
    """Pixels (x, y) of every frame, each moved by its own shift, bicubic or `nearest`; beyond the picture its border is
    repeated. Whole places without a shift are read as they are. Shapes: places (..., 2) → (n_frames, ...); OpenCV takes
    no side longer than 32766.
    """
    import cv2

    if shift_px is None and places.dtype.kind == "i":
        x, y = np.moveaxis(np.clip(places, 0, np.array(luma.shape[:0:-1]) - 1), -1, 0)
        return np.take(luma.reshape(len(luma), -1), y * luma.shape[2] + x, axis=1)
    x, y = (np.ascontiguousarray(np.atleast_2d(of_place), np.float32) for of_place in np.moveaxis(places, -1, 0))
    out, how = np.empty((len(luma), *x.shape), luma.dtype), cv2.INTER_NEAREST if nearest else cv2.INTER_CUBIC
    shifts = np.zeros((len(luma), 2)) if shift_px is None else shift_px
    for frame, cut, (dx, dy) in zip(luma, out, shifts.astype(np.float32), strict=True):
        cv2.remap(frame, x + dx, y + dy, how, dst=cut, borderMode=cv2.BORDER_REPLICATE)
    return out.reshape(len(luma), *places.shape[:-1])


# ------------------------------------------------------------------------------
# Flicker and shake of every frame, against the median picture of the background beside the tube.


def camera_unit(luma: NDArray[Any]) -> float:
    """Grey levels of 255 per unit of the camera's values; white is the brightest but for one hot pixel in 10,000."""
    if luma.dtype == np.uint8:
        return 1.0
    top = float(np.quantile(luma[:: max(1, len(luma) // 8), ::2, ::2], 0.9999))
    return 255.0 / max(top, 1.0)


def steadied(luma: NDArray[Any], axis: Axis, half: int) -> tuple[Floats, Floats, Floats, bool]:
    """Scale and offset of every frame that correct flicker, its shift, (n_frames, 2), and whether the camera shook."""
    n, unit = len(luma), camera_unit(luma)
    shift, shaken = np.zeros((n, 2)), False
    places = _beside(axis, half, luma.shape[1:])
    # 15: frames whose median is the reference (derived)
    picks = np.unique(np.linspace(0, n - 1, 15).astype(int))
    basis = _reference(luma[picks], places, None) if len(places) else np.zeros((4, 0))
    if not basis[0].any():  # no background, or black all over
        return np.full(n, unit), np.zeros(n), shift, shaken
    fits, sigmas = register(luma, places, basis, None)
    fit, shifts = fits[2], fits[:, :, 2:]
    # 0.04, 2.5: smaller shake is not removed, px (chosen), and one of so many standard errors is noise (derived)
    least_px = np.maximum(0.04, 2.5 * np.median(sigmas[2], axis=0))
    if (np.median(np.abs(shifts[2]), axis=0) > least_px).any() and shifts_agree(shifts[:2], sigmas[:2]):
        fit, shift = _followed(luma, places, picks, fit)
        shaken = True
    gain = np.clip(fit[:, 0], 0.2, 5.0)
    return unit / gain, -fit[:, 1] * unit / gain, shift, shaken


def _beside(axis: Axis, half: int, shape: tuple[int, ...]) -> Indices:
    """Whole pixels (x, y) of the background on both sides of a tube, shape (n, 2); none where there is hardly any."""
    # 14, 44: rows of background on either side, at least and at most (chosen)
    rows = half + BAND_GAP_PX + np.arange(int(np.clip(half, 14, 44)))
    along, across = np.meshgrid(np.arange(1.0, axis.length_px), np.concatenate([-rows, rows]), indexing="ij")
    places = np.rint(axis.points(along.ravel(), across.ravel())).astype(int)
    places = places[((places >= 2) & (places < np.array(shape[::-1]) - 2)).all(axis=1)]
    # 6: fewest rows, of the whole length together, that tell of flicker and shift (chosen)
    if len(places) < 6 * axis.length_px:
        return places[:0]
    # 9000: pixels used (derived), an odd number apart: rows come in pairs, and none is left out
    places = places[:: max(1, len(places) // 9000) | 1]
    return places[np.abs(axis.along_and_across(places)[1]) > half + BAND_GAP_PX - 1.0]


def _followed(luma: NDArray[Any], places: Indices, picks: Indices, fit: Floats) -> tuple[Floats, Floats]:
    """Register every frame again and again, each time from where it was found, first by `fit`: fit and shift."""
    shift = np.clip(fit[:, 2:], -1.5, 1.5)  # largest shift of one round, px (chosen)
    basis = _reference(luma[picks], places, shift[picks])  # sharper than that of the shaken pictures
    # 3: most registrations, each from the result of the one before (chosen)
    for _ in range(3):
        fit = register(luma, places, basis, shift)[0][2]
        step = np.clip(fit[:, 2:], -1.5, 1.5)
        shift = shift + step
        if np.abs(step).max() < 0.02:  # px (chosen)
            break
    return fit, shift


def shifts_agree(shift: Floats, sigma: Floats) -> bool:
    """Decide whether the camera shook: two halves of the background must then show the same shift. A door, a shadow or
    a mirror image of the tip passes one half after the other. Shapes: shift, sigma (2, n_frames, 2).
    """
    difference, total = np.hypot(*(shift[0] - shift[1]).T), np.hypot(*(shift[0] + shift[1]).T)
    strongest = difference + total >= np.quantile(difference + total, 0.75)
    # 0.7: difference of the shifts in the two halves, over their sum, below which the camera shook (chosen)
    limit = max(0.7 * float(np.mean(total[strongest])), 2 * float(np.median(sigma.sum(axis=0))))
    return float(np.mean(difference[strongest])) < limit


def _reference(luma: NDArray[Any], places: Indices, shift_px: Floats | None) -> Floats:
    """Median over some frames of pixels of the background, ones, and minus the slopes along x and y, (4, n_pixels)."""
    beside = np.array([(0, 0), (-1, 0), (1, 0), (0, -1), (0, 1)])
    middle, left, right, above, below = (
        median_of(_pixels(luma, places + offset, shift_px)).astype(float) for offset in beside
    )
    return np.stack([middle, np.ones(len(places)), (left - right) / 2, (above - below) / 2])


def register(luma: NDArray[Any], places: Indices, basis: Floats, shift_px: Floats | None) -> tuple[Floats, Floats]:
    """Register every frame to the static background by least squares, twice: the second time without outliers (4 sd).
    The model is frame(x) = gain · picture(x − shift) + level, linearised in the shift. A ridge keeps the level near
    zero, the shift where the background has no texture, and the gain where it is black. Returns gain, level, shift in x
    and y of every frame, shape (3, n_frames, 4), and the standard errors of the shift, shape (3, n_frames, 2): by the
    first half of the pixels, by the second, and by all. Shapes: places (n_pixels, 2); basis (4, n_pixels).
    """
    level = float(np.abs(basis[0]).mean()) + 1e-9
    ridge = np.diag([1e-6 * level**2, 25.0 * basis.shape[1] * (2.0 / level) ** 2 * 0.01, 1e-3 * level, 1e-3 * level])
    every = np.flatnonzero(basis[0] > 0)[::4]  # pixels of which medians are taken: black ones tell no gain (derived)
    typical = float(_medians(basis[:1, every])[0])
    products, inverse = (basis[:, None] * basis).reshape(16, -1), np.linalg.inv(basis @ basis.T + ridge)
    parts, found = (slice(basis.shape[1] // 2), slice(basis.shape[1] // 2, None)), []
    for k in range(0, len(luma), 32):  # 32: frames at once, few enough for the processor's cache (derived)
        values = _pixels(luma[k : k + 32], places, None if shift_px is None else shift_px[k : k + 32]).astype(float)
        # outliers of the model, or of a change of brightness alone, where that fits better
        some, models = values[:, every], [values @ basis.T @ inverse, np.zeros((len(values), len(basis)))]
        models[1][:, 0] = _medians(some) / typical
        scales = [_medians(np.abs(some - model @ basis[:, every])) for model in models]
        scale = 1.4826 * np.minimum(*scales) + 0.3  # with rounding to whole grey levels
        model = np.where((scales[1] < scales[0])[:, None], *models[::-1])
        inlier = (np.abs(values - model @ basis) < 4 * scale[:, None]).astype(float)
        normal = np.stack([inlier[:, part] @ products[:, part].T for part in parts])
        right = np.stack([(values * inlier)[:, part] @ basis[:, part].T for part in parts])
        normal, right = (np.concatenate([of_parts, of_parts.sum(axis=0)[None]]) for of_parts in (normal, right))
        of_frame = np.linalg.inv(normal.reshape(3, -1, 4, 4) + ridge * np.reshape([0.5, 0.5, 1.0], (3, 1, 1, 1)))
        error = scale[:, None] * np.sqrt(np.maximum(of_frame[..., [2, 3], [2, 3]], 0.0))
        found.append(np.concatenate([(of_frame @ right[..., None])[..., 0], error], axis=2))
    solution, error = np.split(np.concatenate(found, axis=1), [4], axis=2)
    solution[..., 2:] /= np.maximum(solution[..., :1], 0.05)
    return solution, error


def median_of(pictures: NDArray[Any]) -> NDArray[Any]:
    """Median of a few pictures, the upper of two, sorted by exchanging: ten times as fast as pixel by pixel."""
    order = [*pictures]
    for i, j in itertools.combinations(range(len(order)), 2):
        order[i], order[j] = np.minimum(order[i], order[j]), np.maximum(order[i], order[j])
    return np.asarray(order[len(order) // 2])


def _medians(values: NDArray[Any]) -> Floats:
    """The median of every row, the upper of two: numpy is ten times slower by one place where most are alike."""
    middle = values.shape[1] // 2
    return np.asarray(np.partition(values, (middle - 1, middle), axis=1)[:, middle])
