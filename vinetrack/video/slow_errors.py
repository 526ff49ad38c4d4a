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

SLOW_PX = 0.03
"""Slow error of any edge, which nothing in a track shows: blur, level and exposure are shared by all rows. Measured
together with SLOW_GREY and `shared_disagreement` on 59 rendered recordings (tuning seeds 1 to 8 of
`benchmarks/tracking_accuracy.py`, two renderers): errors without noise were 0 to 0.06 px where nothing else indicated
any. At half or twice, that of strong edges is two thirds of it or half as much again."""
SLOW_GREY = 1.0
"""Error of the pictures of film and background, in grey levels of 255. Measured as SLOW_PX: at contrasts of eight to
ten grey levels errors without noise were 0.10 to 0.24 px. At half or twice, the slow error of faint edges halves or
doubles."""
LEAST_CONTRAST_GREY = 1.0
"""Least contrast, in grey levels. Chosen: about the noise of a camera; the error ends at a pixel there."""
CONTRAST_COLUMNS = 21
"""Columns over which the contrast at an edge is taken, px. Chosen: about the length of a tip. At half or twice, errors
along film of uneven brightness change more or less abruptly."""
LAGS = (1, 2)
"""Lags, in frames, at which bands that still disagree alike share a cause. Chosen: pixel noise is independent from
frame to frame. Measured on the same recordings: lags 1, 2, 1 to 3, or 2 to 5 describe the errors equally well (root
mean squares 0.84 to 0.95 of those stated in the harder presets); longer lags miss what comes and goes within ten
frames."""
FEWEST_PRODUCTS = 4
"""Fewest pairs of frames at a lag. Chosen: fewer are inconclusive. By reasoning: half or twice changes the stated
errors of the shortest recordings alone."""
START_RANDOM_PART = 0.4
"""Part of the error near the start that differs from frame to frame. Measured: 0.37 of what is stated, where 0.92 of it
is the whole error, in 34 rendered recordings with a door (the same tuning seeds). At half or twice, the stated random
error of the first frames halves or doubles."""
GUESS_RANDOM_PART = math.sqrt(0.5)
"""The same for an edge that is a guess, since a door or the mouth hides it. Chosen: random and slow error are equal,
for nothing separates them. At half, the stated random error of such frames halves; it cannot be twice."""
ARRIVAL_PX = 1.0
"""Slow error of a tip that sweeps and bends, tracked by when the picture changes for good. Measured: about a pixel, see
`vinetrack.video.kymograph`."""


def slow_error_px(edge_px: Floats, contrast: Floats, shared_px: float) -> Floats:
    """Slow error of each frame's edge, one standard deviation.

    Parameters
    ----------
    edge_px : along the strip, shape (n_frames,), px.
    contrast : mean signed contrast of film and background by column, shape (n_along,), grey levels; NaN where unknown.
    shared_px : `shared_disagreement` of the bands, px.

    Returns
    -------
    shape (n_frames,), px.
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
    """Slow error of the mean of bands, from the part of their disagreement that lasts over several frames.

    Bands that mirror each other about the axis are averaged first, since a tip that tilts moves one ahead and the other
    behind and leaves the mean unchanged. What all frames share is the shape of the tip and is removed. Of the rest,
    products of frames a few apart have the mean (K − 1) σ² for K independent bands with slow error σ each; the mean of
    the bands has the error σ/√K.

    Parameters
    ----------
    lead_px : lead of each band over the edge in moving frames, shape (n_frames, n_bands), px; bands in order across.

    Returns
    -------
    px; 0 where there are too few bands or frames.
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
    """Split what is added to the error of an edge into a random part and a slow part.

    Random errors are independent between frames; slow ones are shared by neighbouring frames.

    Parameters
    ----------
    bands_px : error from the disagreement of bands in one frame, shape (n_frames,), px.
    seen_px : that in quadrature with the errors near the start and of a picture out of focus, shape (n_frames,), px.
    apart_px : that in quadrature with the error of an edge that is a guess, shape (n_frames,), px.

    Returns
    -------
    random and slow error, each of shape (n_frames,), px; their sum in quadrature is `apart_px`.
    """
    near = np.sqrt(np.maximum(seen_px**2 - bands_px**2, 0.0))
    guess = np.sqrt(np.maximum(apart_px**2 - seen_px**2, 0.0))
    noise = np.sqrt(bands_px**2 + (START_RANDOM_PART * near) ** 2 + (GUESS_RANDOM_PART * guess) ** 2)
    slow = np.hypot(math.sqrt(1 - START_RANDOM_PART**2) * near, math.sqrt(1 - GUESS_RANDOM_PART**2) * guess)
    return noise, slow
