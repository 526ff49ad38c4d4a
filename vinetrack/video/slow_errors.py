"""Slow errors of an edge: what neighbouring frames share, so that neither roughness nor an average shows or mends it.

Where film and background are not quite what the pictures of both say, by G grey levels, an edge of contrast C is
misplaced by about G/C pixels for as long as it passes that place. Wrinkles and light that the edge passes displace its
bands differently for some frames, and their mean with them. Near the start a door or the mouth may hide the tip
besides, and where a camera's shake was taken off, its slow part stays.
"""

from __future__ import annotations

import math

import numpy as np

from vinetrack.core.records import Floats

SLOW_PX = 0.03
"""Slow error of an edge that is never shown: blur, level and exposure are shared by all rows. Measured together with
SLOW_GREY and `shared_disagreement` on 59 rendered recordings (tuning seeds 1 to 8 of `benchmarks/tracking_accuracy.py`,
two renderers): errors without noise were 0 to 0.06 px where nothing else told of any. At half or twice that of strong
edges is two thirds of it or half as much again."""
SLOW_GREY = 1.0
"""Error of the pictures of film and background, in grey levels of 255. Measured as SLOW_PX: at contrasts of eight to
ten errors without noise were 0.10 to 0.24 px. At half or twice that of faint edges is about so."""
LEAST_CONTRAST = 1.0
"""Grey levels below which a contrast is none. Chosen: about the noise of a camera; the error ends at a pixel there."""
COLUMNS = 21
"""Columns over which the contrast that an edge passes is taken, px. Chosen: about the length of a tip. At half or twice
errors along film of uneven brightness change more abruptly, or less."""
LAGS = (1, 2)
"""Frames apart at which bands that still disagree alike share a cause. Chosen: noise of pixels is another one in the
next frame. Measured on the same recordings: 1, 2, 1 to 3, 2 to 5 frames describe the errors alike (root mean squares
0.84 to 0.95 of those stated in the harder presets); longer lags do not see what comes and goes within ten frames."""
FEWEST_PRODUCTS = 4
"""Pairs of frames at a lag that tell of it. Chosen: fewer say nothing. By reasoning: half or twice changes the stated
errors of the shortest recordings alone."""
START_NOISE = 0.4
"""Part of the error near the start that differs from frame to frame. Measured: 0.37 of what is stated, where 0.92 of it
is the whole error, in 34 rendered recordings with a door (the same tuning seeds). At half or twice the noise that is
stated of the first frames is so."""
GUESS_NOISE = math.sqrt(0.5)
"""The same of an edge that is a guess, since a door or the mouth hides it. Chosen: as much noise as slow error, for
nothing tells them apart. At half the noise stated of such frames is so; it cannot be twice."""
ARRIVAL_PX = 1.0
"""Slow error of a tip that sweeps and bends, followed by when the picture changes for good. Measured: about a pixel,
see `vinetrack.video.kymograph`."""


def slow_error_px(edge_px: Floats, contrast: Floats, shared_px: float) -> Floats:
    """Slow error of each frame's edge, one standard deviation.

    Parameters
    ----------
    edge_px : along the strip, shape (n_frames,), px.
    contrast : mean signed contrast of film and background by column, shape (n_along,), grey levels; NaN where unknown.
    shared_px : what `shared_disagreement` of the bands tells, px.

    Returns
    -------
    shape (n_frames,), px.
    """
    from scipy.ndimage import median_filter

    certain = float(np.hypot(SLOW_PX, shared_px))
    known = np.isfinite(contrast)
    if not known.any():
        return np.full(len(edge_px), certain)
    columns = np.arange(len(contrast))
    strength = median_filter(np.interp(columns, columns[known], np.abs(contrast[known])), COLUMNS, mode="nearest")
    place = np.interp(np.nan_to_num(edge_px), columns, strength)
    return np.asarray(np.hypot(certain, SLOW_GREY / np.maximum(place, LEAST_CONTRAST)))


def shared_disagreement(lead_px: Floats) -> float:
    """Error of the mean of bands by what of their disagreement lasts over frames.

    Bands that mirror each other about the axis are taken together, since a tip that tilts moves one ahead and the other
    behind and the mean not at all. What all frames have is the shape of the tip. Of the rest, products of frames a few
    apart have the mean (K − 1) σ² for K independent bands of slow error σ each, and the mean of all errs by σ/√K.

    Parameters
    ----------
    lead_px : lead of each band over the edge in moving frames, shape (n_frames, n_bands), px, bands in their order.

    Returns
    -------
    px; 0 where there are too few bands or frames to tell.
    """
    frames, bands = lead_px.shape
    if bands < 4 or frames < max(LAGS):
        return 0.0
    uneven = lead_px - lead_px.mean(axis=1, keepdims=True)
    uneven = uneven - np.median(uneven, axis=0)
    pairs = (uneven + uneven[:, ::-1])[:, : bands // 2] / 2
    pairs = pairs - pairs.mean(axis=1, keepdims=True)
    products = [np.sum(pairs[:-lag] * pairs[lag:], axis=1).mean() for lag in LAGS if frames - lag >= FEWEST_PRODUCTS]
    if not products:
        return 0.0
    # A pair's mean has half the variance of a band.
    band_variance = 2 * float(np.mean(products)) / (bands // 2 - 1)
    return float(np.sqrt(max(band_variance, 0.0) / bands))


def noise_and_slow(bands_px: Floats, seen_px: Floats, apart_px: Floats) -> tuple[Floats, Floats]:
    """Share what is added to the error of an edge between frames alone and neighbours together.

    Parameters
    ----------
    bands_px : by how far bands disagree in one frame, shape (n_frames,), px.
    seen_px : that, and what is added near the start and to a picture out of focus, shape (n_frames,), px.
    apart_px : that, and what is added where the edge is a guess, shape (n_frames,), px.

    Returns
    -------
    noise, and slow error, each of shape (n_frames,), px; together they are `apart_px`.
    """
    near = np.sqrt(np.maximum(seen_px**2 - bands_px**2, 0.0))
    guess = np.sqrt(np.maximum(apart_px**2 - seen_px**2, 0.0))
    noise = np.sqrt(bands_px**2 + (START_NOISE * near) ** 2 + (GUESS_NOISE * guess) ** 2)
    slow = np.hypot(math.sqrt(1 - START_NOISE**2) * near, math.sqrt(1 - GUESS_NOISE**2) * guess)
    return noise, slow
