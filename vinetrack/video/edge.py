"""The leading edge in a strip: where it was at mid-exposure in every frame, and how well that is known.

Alternating least squares. Given the edge, every pixel's brightness before and after its passing follows from a
2 by 2 system (no frame need be free of motion); given those, the edge of every frame follows by maximum likelihood
from a step blurred by optics and by its own motion. Tip shape, optical blur, exposure and what of light and shade the
tip carries along are estimated on the way.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from vinetrack.core.records import Bools, Floats
from vinetrack.video import edge_kernels as kernels
from vinetrack.video import kymograph as ky
from vinetrack.video.edge_repair import ASTRAY_PX, band_disagreement, dwell_error_px, repair_jumps
from vinetrack.video.edge_state import (
    FIT_ROUNDS,
    ROUGH_ROUNDS,
    EdgeState,
    blur_lengths,
    core_frames,
    first_state,
    fit_edges,
    frames_that_tell,
    held_at_rest,
    moving_frames,
    repicture,
    residuals,
)
from vinetrack.video.first_path import grown_by_change, grown_path, sides_of_path
from vinetrack.video.hidden_tip import GUESSED_PX, NO_EDGE_PX, disturbed_start, find_mouth, hidden_errors, leap_error_px
from vinetrack.video.slow_errors import noise_and_slow, slow_error_px
from vinetrack.video.strip import Strip
from vinetrack.video.tip_shape import (
    ASSUMED_EXPOSURE,
    OPTICAL_BLUR_PX,
    find_exposure,
    find_shading,
    find_shape,
    seen_exposure,
)

START_PX = 0.08
"""Error near the start, where background is seen briefly or never. Chosen: twice FLOOR_PX of `point_quality`. At half
or twice the stated errors of the first 25 px halve or double."""
START_REACH_PX = 25.0
"""Growth over which that error falls to 1/e. Chosen: about the length of the tip, which hides the background there. At
half or twice the reach changes so."""
DOOR_PX = 0.5
"""What is added to that where a door crosses everything before the start and the picture departs from the model.
Chosen: half a pixel. At half or twice stated errors behind doors halve or double."""
SETTLED_PX = 0.2
"""Largest change of any moving edge from one round to the next at which they are done. Chosen below the error of
blurred frames at the fastest; at half more rounds are made, at twice fewer."""
SAME_PATH_PX = 1.0
"""Largest difference of two paths that are one. Derived: a path is of whole pixels."""
MANY_ROWS = 48
"""Rows from which every second one is enough for all rounds but the last. Chosen: 24 rows show the shape of a tip; only
time depends on it, since the last rounds take all. At half thin vines would be followed by 12 rows at first."""
UNFIT = 3.0
"""Factor of the bands' disagreement where no blur within reason fits: all rows err together then. Chosen: pictures out
of focus then state errors of a pixel. At half or twice they state half or twice as much."""
LARGEST_RATIO = 100.0
"""Misfit over the usual one at most. Chosen: errors end at ASTRAY_PX long before."""
NEAR_START = 0.1
"""Part of the error of the start to which frames count as near it. Derived: e^−2.3, within 2.3 START_REACH_PX."""
FULL_TROUBLE = 0.7
"""Excess of the mean misfit ratio near the start from which a door counts in full. Chosen below 1, where the misfit is
twice the usual one. By reasoning: at half faint doors count in full, at twice common ones by half."""
SIDES_PX = 1.0
"""Error of a width between two sides that are each known to a blur of about 0.7 px. Derived: √2 · 0.7 px."""
FAINT, FAINT_PART = 25.0, 0.15
"""Grey levels of contrast below which the sides of a tube fade away, and the error of its width then, a part of it.
Measured (benchmarks/seen_sizes.py, seeds 20900 and up): 0.76 of the width is seen at 16 levels, 0.96 and more at 70."""
LEAST_NOVELTY = 0.05
"""Weight of a frame that shows nothing new. Chosen: twenty frames of rest weigh as one of motion. At half or twice so
many more or fewer do."""
EVIDENCE_CLIP = 2.5
"""Widths beyond which a pixel is as unlike film (or background) as can be. Chosen as the usual bend of robust
estimates, 2 to 3 standard deviations. By reasoning: at half contrast hardly counts, at twice a bright door outvotes
the film."""


@dataclass(frozen=True)
class EdgeFit:
    """Leading edge in strip pixels, all arrays of shape (n_frames,).

    `edge_px` at mid-exposure, `sigma_px` its random error by the likelihood, `apart_sigma_px` what is to be added to
    it in square: by the disagreement of bands, and near the start (see START_PX). `bands_sigma_px` is the part of that
    which differs from frame to frame, and `slow_px` the error that neighbouring frames share. `misfit` is the mean
    squared residual in units of the noise (1 is perfect), `amplitude` the contrast relative to that of the pixels it
    passes; `contrast` is their mean signed contrast by column (n_along,), NaN where unknown; `passed` the first and
    last column passed; `hidden` marks frames in which a door or the mouth of a launcher may hide the tip.
    `seen_exposure_frames` is what the blur shows where it contradicts a stated exposure, else NaN, and
    `fast_px_per_frame` the speed at which it does.
    """

    edge_px: Floats
    sigma_px: Floats
    apart_sigma_px: Floats
    misfit: Floats
    amplitude: Floats
    contrast: Floats
    blur_px: float
    exposure_frames: float
    passed: tuple[int, int]
    hidden: Bools
    bands_sigma_px: Floats
    slow_px: Floats
    seen_exposure_frames: float = np.nan
    fast_px_per_frame: float = np.nan


def track_edge(strip: Strip, exposure_frames: float = np.nan, rounds: int = 4, sides: Outline | None = None) -> EdgeFit:
    """Track the leading edge through a strip, growing towards higher columns.

    Parameters
    ----------
    strip : along the axis, growth towards higher columns.
    exposure_frames : exposure over frame period; NaN to estimate it from the blur.
    rounds : at least so many, at most three times as many until the edges settle.
    sides : `outline` of this very strip where it is known, which spares a first path.

    Returns
    -------
    edge, errors and flags of every frame, px.

    Raises
    ------
    ValueError
        Where nothing in the strip changes as a passing front does.
    """
    path, passed = grown_path(strip) if sides is None else (sides.path_px, sides.passed)
    path = np.minimum(path, passed[1])
    exposure = float(exposure_frames) if np.isfinite(exposure_frames) else ASSUMED_EXPOSURE
    whole, strip = strip, _every_other_row(strip)
    state = first_state(strip, path, exposure)
    change = _frame_changes(strip)
    for turn in range(3):
        before, path = path, _second_path(strip, state, passed, change)
        if turn > 0 and np.abs(before - path).max() <= SAME_PATH_PX:
            break
        state = repicture(strip, replace(state, edge=path, lengths=blur_lengths(path, exposure)), 0.0)
    fit = _fit_some(strip, state, frames_that_tell(state.edge))
    for turn in range(3 * rounds):
        before = fit[:, 0]
        if turn == rounds - 1:
            strip, state = whole, _on_all_rows(state, whole)
        state = _restate(strip, state, fit, exposure)
        seen = frames_that_tell(state.edge)
        if turn == 1 and not np.isfinite(exposure_frames):
            exposure = find_exposure(strip, state, fit)
        state = find_shape(strip, state, fit, turn == 0)
        if turn > 0:
            state = find_shading(strip, state, fit)
        steps = FIT_ROUNDS if turn >= rounds - 1 else ROUGH_ROUNDS
        fit = repair_jumps(strip, state, _fit_some(strip, state, seen, steps), seen)
        if turn >= rounds - 1 and float(np.nanmax(np.abs(fit[:, 0] - before)[moving_frames(state.edge)])) < SETTLED_PX:
            break
    alone = _fit_some(strip, state, ~seen)
    fit = repair_jumps(strip, state, np.where(seen[:, None], fit, alone), np.ones(len(fit), dtype=bool))
    finished = _finish(strip, state, fit, exposure, passed)
    if not np.isfinite(exposure_frames):
        return finished
    shown, speed = seen_exposure(strip, state, fit, exposure)
    return replace(finished, seen_exposure_frames=shown, fast_px_per_frame=speed)


def _every_other_row(strip: Strip) -> Strip:
    """Every second row of a strip of MANY_ROWS or more, which tell as much of a smooth tip; the strip itself else."""
    if strip.values.shape[1] < MANY_ROWS:
        return strip
    return replace(strip, values=np.ascontiguousarray(strip.values[:, ::2]))


def _on_all_rows(state: EdgeState, strip: Strip) -> EdgeState:
    """The state for all rows of a strip, where it was that of every second one; its pictures are to be made anew."""
    rows = strip.values.shape[1]
    if len(state.lag) == rows:
        return state
    lag = np.interp(np.arange(rows), np.arange(0, rows, 2), state.lag)
    return replace(state, lag=lag, pictures=np.repeat(state.pictures, 2, axis=1)[:, :rows])


def _fit_some(strip: Strip, state: EdgeState, chosen: Bools, rounds: int = FIT_ROUNDS) -> Floats:
    """Most likely edge of the chosen frames, shape (n_frames, 6), NaN in the others."""
    return fit_edges(strip, replace(state, edge=np.where(chosen, state.edge, np.nan)), rounds)


@dataclass(frozen=True)
class Outline:
    """What the front leaves behind: a centreline and a width, px.

    `shift_px` and `slope` (px a px) are of the centreline across the strip; `half_px` is half of what holds all of the
    width, with room for its blur; `width_px` the width between the sides and `width_sigma_px` its standard error.
    `path_px`, shape (n_frames,), is a first path of the front and `passed` the first and last column passed.
    `middles_px`, shape (n_parts,), is where the middle lies across at `places_px` along, of the parts of usual width.
    """

    shift_px: float
    slope: float
    half_px: float
    width_px: float
    width_sigma_px: float
    path_px: Floats
    passed: tuple[int, int]
    places_px: Floats
    middles_px: Floats


def outline(strip: Strip, parts: int = 12) -> Outline:
    """Centreline and width of what the front leaves behind.

    From the contrast by row in `parts` stretches along the way: a given axis two degrees off would otherwise cut the
    tube obliquely.

    Parameters
    ----------
    strip : along a roughly known axis.
    parts : stretches along the way.

    Returns
    -------
    centreline, width and the standard error of that, px.

    Raises
    ------
    ValueError
        Where nothing in the strip changes as a passing front does.
    """
    path, passed = grown_path(strip)
    film, background = sides_of_path(strip, path, passed)
    power = (film - background).astype(float) ** 2
    rows = np.arange(len(power)) - (len(power) - 1) / 2
    sides, places, contrasts = [], [], []
    for piece in np.array_split(np.arange(power.shape[1]), min(parts, max(1, power.shape[1] // 12))):
        profile = np.sqrt(np.minimum(power[:, piece], 9 * np.median(power[:, piece]) + 1e3).mean(axis=1))
        low, high = _bright_run(profile - max(0.4 * float(np.quantile(profile, 0.75)), 0.25 * float(profile.max())))
        sides.append((rows[0] + low, rows[0] + high))
        contrasts.append(float(np.quantile(profile, 0.75)))
        places.append(passed[0] + float(piece.mean()))
    side, place = np.array(sides), np.array(places)
    width = side[:, 1] - side[:, 0]
    alike = np.abs(width - np.median(width)) <= 0.15 * np.median(width) + 2
    alike |= ~alike.any()  # two kinds of width, as many of each: neither is the usual one
    place, centre = place[alike], side[alike].mean(axis=1)
    slope, begin = _robust_line(place, centre)
    middle = float(np.median(width))
    scatter = 1.4826 * float(np.median(np.abs(width - middle))) / np.sqrt(len(width))
    faint = FAINT_PART * middle if float(np.median(contrasts)) < FAINT else 0.0
    sigma = float(np.linalg.norm([scatter, SIDES_PX, faint]))
    return Outline(begin, slope, middle / 2 + 1.5, middle, sigma, path, passed, place, centre)


def rough_growth(strip: Strip) -> tuple[float, float]:
    """Estimate growth and speed from the first path of the front, without a fit.

    Parameters
    ----------
    strip : along the axis, growth towards higher columns.

    Returns
    -------
    columns that the front passes, px, and its mean speed over the middle of them, px a frame.

    Raises
    ------
    ValueError
        Where nothing in the strip changes as a passing front does.
    """
    path, passed = grown_by_change(strip)
    growth = float(passed[1] - passed[0])
    early, late = (int(np.searchsorted(path, passed[0] + part * growth)) for part in (0.2, 0.9))
    return growth, 0.7 * growth / max(late - early, 1)


def _bright_run(excess: Floats) -> tuple[float, float]:
    """Where the run of greatest sum begins and ends, to a fraction of a row: short gaps and glints do not end it."""
    best, total, start, limits = -np.inf, 0.0, 0, (0, len(excess) - 1)
    for i, value in enumerate(excess):
        if total <= 0:
            total, start = 0.0, i
        total += value
        if total > best:
            best, limits = total, (start, i)
    return _crossing(excess, limits[0], -1), _crossing(excess, limits[1], 1)


def _crossing(excess: Floats, row: int, outwards: int) -> float:
    """Where the line from `row` to its neighbour outwards meets zero; `row` itself at the border."""
    if not 0 <= row + outwards < len(excess) or excess[row] <= 0:
        return float(row)
    return float(row + outwards * excess[row] / (excess[row] - min(excess[row + outwards], 0.0)))


def _robust_line(x: Floats, y: Floats) -> tuple[float, float]:
    """Slope and value at zero by the median of pairwise slopes (Theil and Sen)."""
    i, j = np.triu_indices(len(x), 1)
    slope = float(np.median((y[j] - y[i]) / (x[j] - x[i]))) if len(i) else 0.0
    return slope, float(np.median(y - slope * x))


def _second_path(strip: Strip, state: EdgeState, passed: tuple[int, int], change: Floats) -> Floats:
    """Front by what every pixel resembles, film or background."""
    contrast = np.abs(state.pictures[0] - state.pictures[1])[:, passed[0] : passed[1]]
    width = 0.1 * float(np.quantile(contrast, 0.7)) + strip.noise
    evidence = kernels.film_evidence(
        strip.values, strip.scale, strip.offset, state.pictures, width, EVIDENCE_CLIP
    )  # fmt: skip
    evidence[:, : max(passed[0] - kernels.BEHIND, 0)] = evidence[:, passed[1] + kernels.BEYOND :] = 0.0
    path = ky.evident_path(evidence * _novelty(change, state.edge)[:, None])
    return np.clip(path - 0.5, passed[0] - kernels.BEHIND, passed[1] + 2)


def _frame_changes(strip: Strip) -> Floats:
    """How much each frame of a strip differs from the one before it, shape (n_frames,)."""
    import cv2

    change = np.zeros(len(strip.values))
    pairs = pairwise(np.ascontiguousarray(strip.values[:, ::2, ::2]))
    change[1:] = [cv2.absdiff(before, after).mean() for before, after in pairs]
    change[0] = change[1] if len(change) > 1 else 1.0
    return change


def _novelty(change: Floats, edge: Floats) -> NDArray[np.float32]:
    """How much each frame has to say that the one before it had not, 0.05 to 1, shape (n_frames,).

    While the tip rests behind a closed door that looks like film, a hundred frames are no better than one.
    """
    usual = float(np.median(change[moving_frames(edge)]))
    floor = float(np.quantile(change, 0.05))
    return np.clip((change - floor) / max(usual - floor, 1e-6), LEAST_NOVELTY, 1.0).astype(np.float32)


def _restate(strip: Strip, state: EdgeState, fit: Floats, exposure: float) -> EdgeState:
    """Take over the fitted edges and renew blur lengths, pictures and how far noise adds up about the edge."""
    edge = held_at_rest(np.where(np.isfinite(fit[:, 0]), fit[:, 0], state.edge), frames_that_tell(state.edge))
    state = replace(state, edge=edge, lengths=blur_lengths(edge, exposure))
    state = repicture(strip, state, 4 * strip.noise + 4)
    by_distance = residuals(strip, state, fit, core_frames(state, fit)).by_distance
    seen = by_distance[:, 1] > 4
    ratio = np.where(seen, by_distance[:, 0] / np.maximum(by_distance[:, 1], 1), 1.0)
    smooth = np.convolve(np.pad(ratio, 2, mode="edge"), np.ones(5) / 5, mode="valid")
    return replace(state, inflation=np.clip(smooth, 0.3, 50.0))


def _finish(strip: Strip, state: EdgeState, fit: Floats, exposure: float, passed: tuple[int, int]) -> EdgeFit:
    core = core_frames(state, fit)
    # Where the picture departs from the model (a door, a glint) the edge is worse than its curvature says.
    misfit_ratio = np.clip(fit[:, 2] / max(float(np.nanmedian(fit[core, 2])), 1e-3), 1.0, LARGEST_RATIO)
    edge_now = np.where(np.isfinite(fit[:, 0]), fit[:, 0], state.edge)
    edge, sigma = fit[:, 0].copy(), np.minimum(fit[:, 1] * misfit_ratio, ASTRAY_PX)
    # A box of uniform dwell stands for the exposure: its middle is the mean position, ahead of mid-exposure by aτ²/24.
    bend = np.gradient(np.gradient(edge)) if len(edge) > 4 else np.zeros(len(edge))
    edge = edge - np.clip(bend, -50, 50) * exposure**2 / 24
    contrast = (state.pictures[0] - state.pictures[1]).mean(axis=0).astype(float)
    contrast[: passed[0]] = np.nan
    contrast[passed[1] :] = np.nan
    near_start = np.exp(-np.clip(edge_now - edge_now[0], 0, None) / START_REACH_PX)
    close = (near_start > NEAR_START) & moving_frames(state.edge) & np.isfinite(misfit_ratio)
    trouble = float(np.clip((np.mean(misfit_ratio[close]) - 1) / FULL_TROUBLE, 0, 1)) if close.any() else 0.0
    door = DOOR_PX * disturbed_start(strip, state) * trouble
    start_error = (START_PX + door) * near_start
    bands, shared = band_disagreement(strip, state, edge_now, core)
    bands = np.hypot(bands * (1 - 0.5 * near_start), dwell_error_px(edge_now, exposure))
    seen = np.hypot(bands * (UNFIT if state.blur >= OPTICAL_BLUR_PX[1] else 1.0), start_error)
    apart = hidden_errors(fit, misfit_ratio, edge_now, seen)
    mouth = find_mouth(strip, state, edge_now)
    apart = np.where(mouth.before, np.maximum(apart, NO_EDGE_PX if mouth.moved_behind else GUESSED_PX), apart)
    # A door adds more to the error than any start has: the tip is half behind it, or was a moment before.
    hidden = (door * near_start > START_PX) | mouth.before
    apart = np.maximum(apart, leap_error_px(edge_now, hidden))
    bands, lasting = noise_and_slow(bands, seen, apart)
    slow = np.hypot(lasting, slow_error_px(edge_now, contrast, shared))
    return EdgeFit(
        edge, sigma, apart, fit[:, 2], 1 + fit[:, 3], contrast, state.blur, exposure, passed, hidden,
        bands, slow,
    )  # fmt: skip
