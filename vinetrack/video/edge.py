"""Tracking of the leading edge through a strip: its position at mid-exposure in every frame, and the standard error.

The tracker alternates between two estimates. Given the edge, the brightness of film and background at every pixel
follows from weighted least squares (a 2 by 2 system per pixel, so that no frame need be free of motion). Given film and
background, the edge in every frame follows by maximum likelihood: a step between the two, blurred by the optics (a
Gaussian) and by its own motion during the exposure (a box), is fitted by Gauss-Newton. The shape of the tip, the
optical blur, the exposure and the light and shade that the tip carries with it are estimated along the way.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from vinetrack.core.records import Bools, Floats
from vinetrack.core.threads import FEWEST_PICTURES, in_parts
from vinetrack.video import edge_kernels as kernels
from vinetrack.video import kymograph as ky
from vinetrack.video.edge_repair import (
    ASTRAY_PX,
    GUESSED_PX,
    NO_EDGE_PX,
    band_disagreement,
    disturbed_start,
    dwell_error_px,
    find_mouth,
    hidden_errors,
    leap_error_px,
    noise_and_slow,
    repair_jumps,
    slow_error_px,
)
from vinetrack.video.edge_state import (
    ASSUMED_EXPOSURE,
    EARLY_FIT_ROUNDS,
    FIT_ROUNDS,
    OPTICAL_BLUR_PX,
    EdgeState,
    blur_lengths,
    core_frames,
    distance_sums,
    estimate_appearance,
    find_exposure,
    find_shading,
    find_shape,
    fit_edges,
    hold_at_rest,
    informative_frames,
    initial_state,
    moving_frames,
    seen_exposure,
)
from vinetrack.video.kymograph import mean_changes
from vinetrack.video.point_quality import growth_end
from vinetrack.video.strip import Strip

# ------------------------------------------------------------------------------
# Initial path of the front through a strip, before film, background or the tip are known.
#
# Two methods of `kymograph` complement each other. The path by change does not know what caused a change: a bright
# door that comes to rest beside the tube outweighs the front. The path by appearance lets every pixel vote on whether
# it looks as in the first or as in the last frames; votes are equal and a door has few rows. But a payload that has
# flown past by the end, or an object that stood in front at the start, has no vote, and the path starts up to three
# frames late and ends up to three frames early, because several frames are averaged at either end. The path that
# leaves the smaller residual sum is used.

# Change of a column, as returned by `kymograph.path_by_change`, from which it counts as changed (chosen)
MIN_LOG_CHANGE = 5.0

AVERAGED_FRAMES = 12  # Frames after and before the front over which film and background are averaged (derived)

_FrontPath = tuple[Floats, tuple[int, int]]  # Column of the front by frame, shape (n_frames,), px


def initial_front_path(strip: Strip) -> tuple[Floats, tuple[int, int]]:
    """Find the initial path of the front, and the columns that it leaves permanently changed. Returns column of the
    front by frame, shape (n_frames,), px, first column passed, and the one behind the last.
    """
    return _cut_at_growth_end(strip, _better_path(strip))


def _cut_at_growth_end(strip: Strip, front_path: _FrontPath) -> _FrontPath:
    """End the passed columns where the film ends: a payload may fly on beyond it."""
    path, (begin, end) = front_path
    end = growth_end(strip, path, (begin, end))
    if end <= begin:
        raise ValueError("what changes along the axis does not stay changed: nothing grows")
    return path, (begin, end)


def _better_path(strip: Strip) -> _FrontPath:
    """Return the path by change or by appearance, whichever leaves the smaller residual sum, and its columns."""
    candidates: list[_FrontPath] = []
    errors: list[ValueError] = []
    for path, change in (ky.path_by_change(strip), ky.path_by_appearance(strip)):
        try:
            candidates.append(_trim_to_changed_runs(path, change))
        except ValueError as error:
            errors.append(error)
    if not candidates:
        raise errors[0]
    if len(candidates) == 1:
        return candidates[0]
    columns = min(passed[0] for _, passed in candidates), max(passed[1] for _, passed in candidates)
    by_change, by_looks = (_residual_of_path(strip, front_path, columns) for front_path in candidates)
    return candidates[1] if by_looks < by_change else candidates[0]


def _residual_of_path(strip: Strip, front_path: _FrontPath, columns: tuple[int, int]) -> float:
    """Residual sum of a path over some columns, with the film and background that follow from it."""
    path, _ = front_path
    pictures = appearance_about_path(strip, path, columns)

    def residuals(first: int, last: int) -> Floats:
        part = slice(first, last)
        return ky.clipped_residual_sums(
            strip.values[part], strip.scale[part], strip.offset[part], strip.noise, path[part], pictures, *columns
        )

    return float(np.concatenate(in_parts(residuals, len(strip.values), FEWEST_PICTURES)).sum())


def appearance_about_path(strip: Strip, path: Floats, columns: tuple[int, int]) -> NDArray[np.float32]:
    """Average each pixel over the AVERAGED_FRAMES frames after (film) and before (background) the front passes it.
    Shapes: path (n_frames,) → (2, n_across, n_columns).
    """
    return ky.mean_appearance(strip.values, strip.scale, strip.offset, path, *columns, AVERAGED_FRAMES)


def _trim_to_changed_runs(path: Floats, change: Floats) -> _FrontPath:
    """Clip a path to the range of columns that changed in runs; prepend a run-up. A late beginning is better than an
    early one: neighbours then stand in for the background, whereas a column that never changed carries no information
    about the edge.
    """
    # Length of a run of columns, and the fraction of it that must have changed for a front to have passed
    # (chosen)
    run_length_px, run_changed_part = 9, 0.6
    strong = change > MIN_LOG_CHANGE
    run = np.convolve(strong, np.ones(run_length_px) / run_length_px, mode="same") > run_changed_part
    if run.sum() < run_length_px:
        raise ValueError("nothing moves along the axis")
    changed_columns = np.flatnonzero(run & strong)
    passed = max(int(changed_columns[0]), ky.column_after_leap(path)), int(changed_columns[-1]) + 1
    if passed[0] >= passed[1]:
        raise ValueError("what changes along the axis does so all at once: nothing grows")
    return _run_up(np.clip(path, *passed)), passed


def _run_up(path: Floats) -> Floats:
    """Replace the beginning of a path by steps that decrease going back in time, as from rest. An object such as a door
    may have stood where growth is first visible, and the tip may have come from further back. If it did not, the
    columns in between turn out to be film from the start, and the second path corrects this.
    """
    steps = np.diff(path)
    onset = int(np.argmax(steps > 0)) if np.any(steps > 0) else 0
    later = path[onset + 1 :]
    if onset < 2 or len(later) < 5:
        return path
    # 0.1, 0.2: minimum decrease from step to step of the run-up, going back in time (chosen)
    fall = max(float(np.median(np.diff(later[:5], 2))), 0.1 * float(later[1] - later[0]), 0.2)
    out, step = path.copy(), float(np.median(np.diff(later[:4])))
    for t in range(onset, -1, -1):
        step = max(step - fall, 0.0)
        out[t] = max(out[t + 1] - step, 0.0)
    return out


START_ERROR_PX = 0.08  # Extra error near the start, where the background is visible only briefly or never (chosen)
# Added to the error near the start if a door crosses the whole strip before growth and the frames do not fit the model
# (chosen)
DOOR_ERROR_PX = 0.5
# Factor on the disagreement of the bands when the fitted blur is at its upper bound (chosen)
OUT_OF_FOCUS_FACTOR = 3.0
# Frames in which the error of the start is at least this part of its full value count as near the start (derived)
NEAR_START_WEIGHT = 0.1
# Excess of the mean misfit ratio near the start at which the error of a door is added in full (chosen)
FULL_DOOR_EXCESS = 0.7
# Error of a width between two sides that are each located to within a blur of about 0.7 px (derived)
WIDTH_ERROR_PX = 1.0
MIN_FRAME_WEIGHT = 0.05  # Weight of a frame identical to the one before it (chosen)


@dataclass(frozen=True)
class EdgeFit:
    """Leading edge in strip pixels; arrays have shape (n_frames,). `edge_px` is the position at mid-exposure and
    `sigma_px` its standard error from the likelihood. `extra_sigma_px` is added in quadrature: it comes from the
    disagreement of bands of rows and, near the start, from START_ERROR_PX.
    """

    edge_px: Floats
    sigma_px: Floats
    extra_sigma_px: Floats
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
    """Track the leading edge through a strip, growing towards higher columns."""
    path, passed = initial_front_path(strip) if sides is None else (sides.path_px, sides.passed)
    path = np.minimum(path, passed[1])
    exposure = float(exposure_frames) if np.isfinite(exposure_frames) else ASSUMED_EXPOSURE
    state = initial_state(strip, path, exposure)
    change = _frame_changes(strip)
    for iteration in range(3):
        before, path = path, _path_from_appearance(strip, state, passed, change)
        # 1.0: two paths are the same if they nowhere differ by more than this (derived)
        if iteration > 0 and np.abs(before - path).max() <= 1.0:
            break
        state = estimate_appearance(strip, replace(state, edge=path, lengths=blur_lengths(path, exposure)), 0.0)
    fit = _fit_frames(strip, state, informative_frames(state.edge))
    for iteration in range(3 * rounds):
        before = fit[:, 0]
        state = _update_state(strip, state, fit, exposure)
        informative = informative_frames(state.edge)
        if iteration == 1 and not np.isfinite(exposure_frames):
            exposure = find_exposure(strip, state, fit)
        state = find_shape(strip, state, fit, iteration == 0)
        if iteration > 0:
            state = find_shading(strip, state, fit)
        steps = FIT_ROUNDS if iteration >= rounds - 1 else EARLY_FIT_ROUNDS
        fit = repair_jumps(strip, state, _fit_frames(strip, state, informative, steps), informative)
        # 0.2: the iteration has converged once no edge of a moving frame changes by more than this (chosen)
        if iteration >= rounds - 1 and float(np.nanmax(np.abs(fit[:, 0] - before)[moving_frames(state.edge)])) < 0.2:
            break
    resting_fit = _fit_frames(strip, state, ~informative)
    fit = repair_jumps(strip, state, np.where(informative[:, None], fit, resting_fit), np.ones(len(fit), dtype=bool))
    finished = _with_errors(strip, state, fit, exposure, passed)
    if not np.isfinite(exposure_frames):
        return finished
    blur_exposure, speed = seen_exposure(strip, state, fit, exposure)
    return replace(finished, seen_exposure_frames=blur_exposure, fast_px_per_frame=speed)


def _fit_frames(strip: Strip, state: EdgeState, chosen: Bools, rounds: int = FIT_ROUNDS) -> Floats:
    """Fit the edge of the chosen frames; shape (n_frames, 6), NaN in the other frames."""
    return fit_edges(strip, replace(state, edge=np.where(chosen, state.edge, np.nan)), rounds)


@dataclass(frozen=True)
class Outline:
    """Outline of the tube that the front leaves behind: its centreline and width, px. `shift_px` and `slope` (px per
    px) describe the centreline across the strip.
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
    """Measure the centreline and width of the tube that the front leaves behind. The contrast of each row between film
    and background gives the sides in `parts` stretches along the axis. This corrects a given axis that is, say, two
    degrees off and would cut the tube obliquely.
    """
    path, passed = initial_front_path(strip)
    film, background = appearance_about_path(strip, path, passed)
    power = (film - background).astype(float) ** 2
    rows = np.arange(len(power)) - (len(power) - 1) / 2
    sides, places, contrasts = [], [], []
    for piece in np.array_split(np.arange(power.shape[1]), min(parts, max(1, power.shape[1] // 12))):
        profile = np.sqrt(np.minimum(power[:, piece], 9 * np.median(power[:, piece]) + 1e3).mean(axis=1))
        low, high = _max_sum_run(profile - max(0.4 * float(np.quantile(profile, 0.75)), 0.25 * float(profile.max())))
        sides.append((rows[0] + low, rows[0] + high))
        contrasts.append(float(np.quantile(profile, 0.75)))
        places.append(passed[0] + float(piece.mean()))
    side, place = np.array(sides), np.array(places)
    width = side[:, 1] - side[:, 0]
    typical = np.abs(width - np.median(width)) <= 0.15 * np.median(width) + 2
    typical |= ~typical.any()  # two widths, equally frequent: neither is typical, so all are used
    place, centre = place[typical], side[typical].mean(axis=1)
    slope, intercept = _robust_line(place, centre)
    median_width = float(np.median(width))
    width_error = 1.4826 * float(np.median(np.abs(width - median_width))) / np.sqrt(len(width))
    # 25.0, 0.15: contrast, in grey levels, below which the sides of a tube fade into the background (measured)
    faint = 0.15 * median_width if float(np.median(contrasts)) < 25.0 else 0.0
    sigma = float(np.linalg.norm([width_error, WIDTH_ERROR_PX, faint]))
    return Outline(intercept, slope, median_width / 2 + 1.5, median_width, sigma, path, passed, place, centre)


def _max_sum_run(excess: Floats) -> tuple[float, float]:
    """Return the ends of the run with the greatest sum, interpolated to a fraction of a row (maximum-subarray search).
    Short gaps do not end the run and isolated glints do not extend it.
    """
    best, run_sum, start, limits = -np.inf, 0.0, 0, (0, len(excess) - 1)
    for i, value in enumerate(excess):
        if run_sum <= 0:
            run_sum, start = 0.0, i
        run_sum += value
        if run_sum > best:
            best, limits = run_sum, (start, i)
    return _zero_crossing(excess, limits[0], -1), _zero_crossing(excess, limits[1], 1)


def _zero_crossing(excess: Floats, row: int, outwards: int) -> float:
    """Return where the line from `row` to its outer neighbour crosses zero; `row` itself at the border."""
    if not 0 <= row + outwards < len(excess) or excess[row] <= 0:
        return float(row)
    return float(row + outwards * excess[row] / (excess[row] - min(excess[row + outwards], 0.0)))


def _robust_line(x: Floats, y: Floats) -> tuple[float, float]:
    """Fit a line by the median of pairwise slopes (Theil-Sen); return slope and intercept."""
    i, j = np.triu_indices(len(x), 1)
    slope = float(np.median((y[j] - y[i]) / (x[j] - x[i]))) if len(i) else 0.0
    return slope, float(np.median(y - slope * x))


def _path_from_appearance(strip: Strip, state: EdgeState, passed: tuple[int, int], change: Floats) -> Floats:
    """Find the monotone path that best divides pixels that look like film from pixels that look like background."""
    # Distance, in standard deviations, at which the difference of a pixel from film or background is clipped
    # (chosen)
    evidence_clip = 2.5
    contrast = np.abs(state.appearance[0] - state.appearance[1])[:, passed[0] : passed[1]]
    width = 0.1 * float(np.quantile(contrast, 0.7)) + strip.noise

    def evidence_of(first: int, last: int) -> NDArray[np.float32]:
        part = slice(first, last)
        return kernels.film_evidence(
            strip.values[part], strip.scale[part], strip.offset[part], state.appearance, width, evidence_clip
        )

    evidence = np.concatenate(in_parts(evidence_of, len(strip.values), FEWEST_PICTURES))
    evidence[:, : max(passed[0] - kernels.COLUMNS_BEHIND, 0)] = evidence[:, passed[1] + kernels.COLUMNS_AHEAD :] = 0.0
    path = ky.dividing_path(evidence * _frame_weights(change, state.edge)[:, None])
    return np.clip(path - 0.5, passed[0] - kernels.COLUMNS_BEHIND, passed[1] + 2)


def _frame_changes(strip: Strip) -> Floats:
    """Return the mean absolute difference of each frame from the one before it, shape (n_frames,)."""
    change = np.zeros(len(strip.values))
    change[1:] = mean_changes(strip.values, 2)
    change[0] = change[1] if len(change) > 1 else 1.0
    return change


def _frame_weights(change: Floats, edge: Floats) -> NDArray[np.float32]:
    """Weight each frame by how much it differs from the one before it, MIN_FRAME_WEIGHT to 1, shape (n_frames,). While
    the tip rests behind a closed door that looks like film, a hundred frames carry no more information than one.
    """
    usual = float(np.median(change[moving_frames(edge)]))
    floor = float(np.quantile(change, 0.05))
    return np.clip((change - floor) / max(usual - floor, 1e-6), MIN_FRAME_WEIGHT, 1.0).astype(np.float32)


def _update_state(strip: Strip, state: EdgeState, fit: Floats, exposure: float) -> EdgeState:
    """Take over the fitted edges; re-estimate blur lengths, film and background, and the correlation of the noise.
    `inflation` is the variance of a column's mean residual over that of white noise, by distance from the edge.
    """
    edge = hold_at_rest(np.where(np.isfinite(fit[:, 0]), fit[:, 0], state.edge), informative_frames(state.edge))
    state = replace(state, edge=edge, lengths=blur_lengths(edge, exposure))
    state = estimate_appearance(strip, state, 4 * strip.noise + 4)
    by_distance = distance_sums(strip, state, fit, core_frames(state, fit))
    counted = by_distance[:, 1] > 4
    ratio = np.where(counted, by_distance[:, 0] / np.maximum(by_distance[:, 1], 1), 1.0)
    smoothed = np.convolve(np.pad(ratio, 2, mode="edge"), np.ones(5) / 5, mode="valid")
    return replace(state, inflation=np.clip(smoothed, 0.3, 50.0))


def _with_errors(strip: Strip, state: EdgeState, fit: Floats, exposure: float, passed: tuple[int, int]) -> EdgeFit:
    """Add to a converged fit the errors of bands, start, doors and leaps, and refer the edge to mid-exposure."""
    core = core_frames(state, fit)
    # Where a frame departs from the model (a door, a glint), the error exceeds that from the curvature of ln L.
    # 100.0: upper limit of a frame's misfit relative to the median (chosen)
    misfit_ratio = np.clip(fit[:, 2] / max(float(np.nanmedian(fit[core, 2])), 1e-3), 1.0, 100.0)
    edge_now = np.where(np.isfinite(fit[:, 0]), fit[:, 0], state.edge)
    edge, sigma = fit[:, 0].copy(), np.minimum(fit[:, 1] * misfit_ratio, ASTRAY_PX)
    # The fitted box assumes constant speed: its centre is the mean position, which leads mid-exposure by aτ²/24.
    acceleration = np.gradient(np.gradient(edge)) if len(edge) > 4 else np.zeros(len(edge))
    edge = edge - np.clip(acceleration, -50, 50) * exposure**2 / 24
    contrast = (state.appearance[0] - state.appearance[1]).mean(axis=0).astype(float)
    contrast[: passed[0]] = np.nan
    contrast[passed[1] :] = np.nan
    # 25.0: growth over which that error falls to 1/e (chosen)
    near_start = np.exp(-np.clip(edge_now - edge_now[0], 0, None) / 25.0)
    near = (near_start > NEAR_START_WEIGHT) & moving_frames(state.edge) & np.isfinite(misfit_ratio)
    door_weight = float(np.clip((np.mean(misfit_ratio[near]) - 1) / FULL_DOOR_EXCESS, 0, 1)) if near.any() else 0.0
    door = DOOR_ERROR_PX * disturbed_start(strip, state) * door_weight
    start_error = (START_ERROR_PX + door) * near_start
    bands, shared = band_disagreement(strip, state, edge_now, core)
    bands = np.hypot(bands * (1 - 0.5 * near_start), dwell_error_px(edge_now, exposure))
    visible_error = np.hypot(bands * (OUT_OF_FOCUS_FACTOR if state.blur >= OPTICAL_BLUR_PX[1] else 1.0), start_error)
    extra = hidden_errors(fit, misfit_ratio, edge_now, visible_error)
    mouth = find_mouth(strip, state, edge_now)
    extra = np.where(mouth.before, np.maximum(extra, NO_EDGE_PX if mouth.moved_behind else GUESSED_PX), extra)
    # A door that adds more than START_ERROR_PX: the tip is half behind it, or was a moment before.
    hidden = (door * near_start > START_ERROR_PX) | mouth.before
    extra = np.maximum(extra, leap_error_px(edge_now, hidden))
    bands, slow_bands = noise_and_slow(bands, visible_error, extra)
    slow = np.hypot(slow_bands, slow_error_px(edge_now, contrast, shared))
    return EdgeFit(
        edge, sigma, extra, fit[:, 2], 1 + fit[:, 3], contrast, state.blur, exposure, passed, hidden,
        bands, slow,
    )  # fmt: skip
