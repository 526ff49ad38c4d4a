"""Slow errors of an edge: errors that neighbouring frames share, which neither roughness nor averaging reveals.

Where film or background differ by G grey levels from their estimated pictures, an edge of contrast C is misplaced by
about G/C pixels for as long as it passes that place. Wrinkles and light displace the bands of an edge differently for
some frames, and their mean with them. Near the start a door or a mouth may hide the tip as well, and where a shaken
camera was stabilised the slow part of the shake stays.
"""

from __future__ import annotations

import math

import numpy as np

from vinetrack.core.records import Floats

SLOW_PX = 0.03  # Slow error of any edge, which nothing in a track shows (measured)
SLOW_GREY = 1.0  # Error of the pictures of film and background, in grey levels of 255 (measured)
LEAST_CONTRAST_GREY = 1.0  # Least contrast, in grey levels (chosen)
CONTRAST_COLUMNS = 21  # Columns over which the contrast at an edge is taken, px (chosen)
LAGS = (1, 2)  # Lags, in frames, at which bands that still disagree alike share a cause (chosen)
FEWEST_PRODUCTS = 4  # Fewest pairs of frames at a lag (chosen)
START_RANDOM_PART = 0.4  # Part of the error near the start that differs from frame to frame (measured)
GUESS_RANDOM_PART = math.sqrt(0.5)  # The same for an edge that is a guess, since a door or the mouth hides it (chosen)
ARRIVAL_PX = 1.0  # Slow error of a tip that sweeps and bends, tracked by when the picture changes for good (measured)


def slow_error_px(edge_px: Floats, contrast: Floats, shared_px: float) -> Floats:
    """Slow error of each frame's edge, one standard deviation. Shapes: edge_px (n_frames,); contrast (n_along,) →
    (n_frames,).
    """
    from scipy.ndimage import median_filter

    everywhere_px = float(np.hypot(SLOW_PX, shared_px))
    finite = np.isfinite(contrast)
    if not finite.any():
        return np.full(len(edge_px), everywhere_px)
    columns = np.arange(len(contrast))
    smooth_contrast = median_filter(
        np.interp(columns, columns[finite], np.abs(contrast[finite])), CONTRAST_COLUMNS, mode="nearest"
    )
    local_contrast = np.interp(np.nan_to_num(edge_px), columns, smooth_contrast)
    return np.asarray(np.hypot(everywhere_px, SLOW_GREY / np.maximum(local_contrast, LEAST_CONTRAST_GREY)))


def shared_disagreement(lead_px: Floats) -> float:
    """Slow error of the mean of bands, from the part of their disagreement that lasts over several frames. Bands that
    mirror each other about the axis are averaged first, since a tip that tilts moves one ahead and the other behind and
    leaves the mean unchanged. What all frames share is the shape of the tip and is removed. Shapes: lead_px (n_frames,
    n_bands).
    """
    frames, bands = lead_px.shape
    if bands < 4 or frames < max(LAGS):
        return 0.0
    deviation = lead_px - lead_px.mean(axis=1, keepdims=True)
    deviation = deviation - np.median(deviation, axis=0)
    pairs = (deviation + deviation[:, ::-1])[:, : bands // 2] / 2
    pairs = pairs - pairs.mean(axis=1, keepdims=True)
    products = [np.sum(pairs[:-lag] * pairs[lag:], axis=1).mean() for lag in LAGS if frames - lag >= FEWEST_PRODUCTS]
    if not products:
        return 0.0
    # The mean of a pair has half the variance of a band.
    band_variance = 2 * float(np.mean(products)) / (bands // 2 - 1)
    return float(np.sqrt(max(band_variance, 0.0) / bands))


def noise_and_slow(bands_px: Floats, seen_px: Floats, apart_px: Floats) -> tuple[Floats, Floats]:
    """Split what is added to the error of an edge into a random part and a slow part. Random errors are independent
    between frames; slow ones are shared by neighbouring frames. Returns random and slow error, each of shape
    (n_frames,), px; their sum in quadrature is `apart_px`. Shapes: bands_px, seen_px, apart_px (n_frames,).
    """
    near = np.sqrt(np.maximum(seen_px**2 - bands_px**2, 0.0))
    guess = np.sqrt(np.maximum(apart_px**2 - seen_px**2, 0.0))
    noise = np.sqrt(bands_px**2 + (START_RANDOM_PART * near) ** 2 + (GUESS_RANDOM_PART * guess) ** 2)
    slow = np.hypot(math.sqrt(1 - START_RANDOM_PART**2) * near, math.sqrt(1 - GUESS_RANDOM_PART**2) * guess)
    return noise, slow
