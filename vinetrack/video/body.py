"""Track a body that moves as a whole (travel ratio 1) by registering it against itself along the axis.

The body leaves background behind it, perhaps dark on dark, so that there is no film to compare with. A template is cut
where the body is most clearly visible, found in every frame by correlation, refined by robust least squares with gain
and level free, and replaced by the median of the patches found. Each pixel of the template is weighted by the inverse
of its variance from frame to frame: the body's own marks count much, background visible beside it little. The reported
point is fixed on the body.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vinetrack.core.records import Bools, Floats
from vinetrack.tracks.position_noise import rough_noise, turning_point
from vinetrack.video.frames import RecordingError
from vinetrack.video.kymograph import dividing_path
from vinetrack.video.point_quality import calibrated_sigma
from vinetrack.video.strip import SLOW_PX, Look, Positions, Tracker, cut_strip

SEARCH_ACROSS_PX = 8  # Distance across the axis by which the body may deviate in the search (chosen)
POOR_MATCH = 0.6  # Correlation with the template below which a point is doubtful (chosen)


class BodyTracker(Tracker):
    """Registers what moves along an axis against itself; None where the travel ratio says that a tube everts."""

    def follow(self, look: Look) -> Positions | None:
        """See `Tracker`."""
        if look.travel_ratio != 1:
            return None
        strip = cut_strip(look.luma, look.axis, 0.75 * look.axis.width_px + 12)
        pictures = strip.brightness()
        path, half = _coarse_path(pictures, strip.noise, _row_weights(pictures.shape[1], strip.axis.width_px))
        if np.isfinite(strip.axis.width_px):
            # A body is about as long as it is wide; a glint on it is shorter.
            half = max(half, round(0.75 * strip.axis.width_px))
        if np.ptp(path) < 3:
            raise RecordingError("nothing moves along the axis")
        # Cut near the middle of the frames in which the whole body is inside and moving
        whole = np.flatnonzero((path > 1.3 * half) & (path < pictures.shape[2] - 1 - 1.3 * half))
        moving = [i for i in whole if 0 < i < len(path) - 1 and path[i + 1] > path[i - 1]]
        chosen = moving or whole.tolist() or [*range(len(path))]
        template_frame = int(chosen[len(chosen) // 2])
        template = _patch(pictures[template_frame], path[template_frame], 0.0, half)
        body_rows = _row_weights(template.shape[0], strip.axis.width_px)
        weight = np.ones_like(template) * body_rows
        place = np.column_stack([path, np.zeros(len(path))])
        # 3: times that the template is replaced by the median of the patches found (chosen)
        for turn in range(3 + 1):
            place, error, match = _register_all(pictures, template, weight, place, half, first=turn == 0)
            if turn < 3:
                template, weight = _median_template(pictures, place, match, half, strip.noise)
                weight = weight * body_rows
        inside = (place[:, 0] > 0.6 * half) & (place[:, 0] < pictures.shape[2] - 1 - 0.6 * half)
        off_axis = np.abs(place[:, 1]) > SEARCH_ACROSS_PX - 0.5
        # 0.4: correlation below which the patch found is not the body (chosen)
        unseen = (match < 0.4) | off_axis
        recognised, end = np.flatnonzero(~unseen & (match >= POOR_MATCH)), None
        if len(recognised) >= 3:
            # 3.0, 6.0: distance behind its furthest place where a body has turned back, px and standard errors (chosen)
            back_px = np.maximum(3.0, 6.0 * np.nan_to_num(error[recognised], nan=0.0))
            turned = turning_point(place[recognised, 0], back_px)
            last = int(recognised[-1 if turned is None else turned])
            unseen |= np.arange(len(unseen)) > last
            end = None if turned is None else last
        found = np.flatnonzero(~unseen)
        # 0.5: part of the frames, from the first to the last in which it is seen, that must show a body (chosen)
        hardly_seen = len(found) > 0 and len(found) < 0.5 * (1 + np.ptp(found))
        if hardly_seen or hops_between_bodies(place[:, 0], ~unseen):
            raise RecordingError(
                "what is followed hops between several bodies that move along the axis: give the axis, with a smaller "
                "width"
            )
        edge = np.where(unseen, np.nan, place[:, 0])
        # 20.0: largest factor on an error whose likelihood does not know the interpolation between pixels (measured)
        return Positions(
            strip=strip, edge_px=edge, sigma_px=calibrated_sigma(edge, error, 20.0),
            unsure=~inside | (match < POOR_MATCH), reach_px=float(half), slow_px=SLOW_PX, end=end,
            exposure_frames=look.exposure_frames,
        )  # fmt: skip


def hops_between_bodies(along: Floats, seen: Bools) -> bool:
    """Whether places scatter about any smooth motion by as much as they advance. Shapes: along, seen (n_frames,)."""
    places = along[seen & np.isfinite(along)]
    # 3.0, 0.5, 9: scatter of single places, in px and in steps of a frame, above which what is followed is not one
    # body; and the fewest places from which it is estimated (chosen)
    return len(places) >= 9 and rough_noise(places) > max(3.0, 0.5 * float(np.median(np.abs(np.diff(places)))))


def _row_weights(rows: int, width_px: float) -> NDArray[np.float32]:
    """Weight of each row of the template, shape (n_rows, 1), falling outside the body, where a neighbour may move."""
    if not np.isfinite(width_px):
        return np.ones((rows, 1), dtype=np.float32)
    outside = np.abs(np.arange(rows) - (rows - 1) / 2) - width_px / 2
    # 2.0: distance beside the body's width at which a row counts half (chosen)
    return (1 / (1 + (np.clip(outside, 0, None) / 2.0) ** 2)).astype(np.float32)[:, None]


def _coarse_path(pictures: NDArray[np.float32], noise: float, rows: NDArray[np.float32]) -> tuple[Floats, int]:
    """Centre of the body by frame, to a few pixels, and half its length along the axis. The background is the median
    over frames spread evenly over the changes, so that a body that rests for long does not become part of it.
    """
    n = len(pictures)
    change = np.zeros(n)
    change[1:] = np.abs(np.diff(pictures[:, ::2, ::2], axis=0)).clip(max=40).mean(axis=(1, 2))
    cumulative = np.cumsum(np.clip(change - 1.2 * float(np.quantile(change, 0.1)), 0, None) + 1e-3)
    sampled = np.unique(
        np.searchsorted(cumulative, np.linspace(cumulative[0], cumulative[-1], min(n, 41))).clip(0, n - 1)
    )
    background = np.median(pictures[sampled], axis=0)
    foreground = (rows * np.clip(np.abs(pictures - background) - 3 * noise, 0, 60)).sum(axis=1)
    # Half the length of what differs from the background, from the width of its autocorrelation along the axis
    clearest = foreground[np.argsort(foreground.sum(axis=1))[n // 2 :]]
    clearest = clearest - clearest.mean(axis=1, keepdims=True)
    columns = foreground.shape[1]
    spectrum = np.abs(np.fft.rfft(clearest, n=2 * columns, axis=1)) ** 2
    correlation = np.fft.irfft(spectrum.mean(axis=0))[: columns // 3]
    below = np.flatnonzero(correlation < 0.35 * correlation[0])
    width = int(below[0]) if len(below) else columns // 6
    half = int(np.clip(0.8 * width, 6, columns // 5))
    box = np.ones(2 * half + 1)
    score = np.stack([np.convolve(row, box, mode="same") for row in foreground])
    # The path that collects most score without a step back divides minus the slope of the score.
    return dividing_path(-np.diff(score, axis=1, prepend=0.0)) - 1, half


def _patch(picture: NDArray[np.float32], along: float, across: float, half: int) -> NDArray[np.float32]:
    """Patch of 2 half + 1 columns about (along, across), all rows but SEARCH_ACROSS_PX on each side, bicubic."""
    import cv2

    rows, middle = picture.shape[0] - 2 * SEARCH_ACROSS_PX, (picture.shape[0] - 1) / 2 + float(across)
    matrix = np.array([[1.0, 0.0, float(along) - half], [0.0, 1.0, middle - (rows - 1) / 2]])
    flags = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
    patch = cv2.warpAffine(picture, matrix, (2 * half + 1, rows), flags=flags, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(patch)


def _register_all(
    pictures: NDArray[np.float32], template: NDArray[np.float32], weight: NDArray[np.float32], place: Floats, half: int,
    first: bool,
) -> tuple[Floats, Floats, Floats]:  # fmt: skip
    """Place (n, 2) along and across, its error along (n,) and correlation (n,) in every frame."""
    import cv2

    out, error, match = place.copy(), np.full(len(place), np.nan), np.zeros(len(place))
    slope_across, slope_along = np.gradient(template, axis=0), np.gradient(template, axis=1)
    # 14: distance along the axis searched about the expected place (chosen)
    width, reach = template.shape[1], half + 14 + half // 2
    for t, picture in enumerate(pictures):
        guess = place[t]
        low = int(np.clip(guess[0] - reach, 0, max(picture.shape[1] - width, 0)))
        high = int(np.clip(guess[0] + reach + 1, low + width, picture.shape[1]))
        if first and high - low >= width:  # whole-pixel place of the best normalised correlation
            score = cv2.matchTemplate(np.ascontiguousarray(picture[:, low:high]), template, cv2.TM_CCOEFF_NORMED)
            row, column = np.unravel_index(int(np.argmax(score)), score.shape)
            guess = np.array([low + column + half, row - SEARCH_ACROSS_PX], dtype=float)
        out[t], error[t], match[t] = _register(picture, template, weight, slope_along, slope_across, guess, half)
    return out, error, match


def _register(
    picture: NDArray[np.float32], template: NDArray[np.float32], weight: NDArray[np.float32],
    slope_along: NDArray[np.float32], slope_across: NDArray[np.float32], guess: Floats, half: int,
) -> tuple[Floats, float, float]:  # fmt: skip
    """Gauss-Newton on place, gain and level with Cauchy weights 1/(1 + (r/3s)²). Returns the place, its error along the
    axis and the correlation.
    """
    place = guess.astype(float).copy()
    design = np.stack([slope_along, slope_across, template, np.ones_like(template)]).reshape(4, -1).astype(float)
    flat = weight.ravel().astype(float)
    robust = flat
    # 8: most Gauss-Newton steps of a registration (chosen)
    for _ in range(8):
        patch = _patch(picture, place[0], place[1], half).ravel().astype(float)
        weighted = design * robust
        normal = weighted @ design.T + np.diag([1e-9, 1e-9, 1e-9, 1e-9])
        solution = np.linalg.solve(normal, weighted @ patch)
        residual = patch - solution @ design
        scale_of_residuals = 1.4826 * float(np.median(np.abs(residual * np.sqrt(flat)))) + 1e-6
        robust = flat / (1 + residual**2 * flat / (9 * scale_of_residuals**2))
        gain = max(float(solution[2]), 0.1)
        step = solution[:2] / gain
        # patch(x) = gain · template(x + step): the body lies `step` behind the assumed place.
        place -= np.clip(step, -2, 2)
        place[1] = np.clip(place[1], -SEARCH_ACROSS_PX, SEARCH_ACROSS_PX)
        if np.abs(step).max() < 2e-3:
            break
    inverse = np.linalg.pinv(normal)
    variance = float(np.sum(robust * residual**2) / max(np.sum(robust > 0.2 * flat) - 4, 1))
    sigma = float(np.sqrt(max(inverse[0, 0], 0.0) * variance)) / gain
    model = solution[2] * design[2] + solution[3]
    patch_deviation, model_deviation = patch - np.average(patch, weights=flat), model - np.average(model, weights=flat)
    power = np.sqrt(np.sum(flat * patch_deviation**2) * np.sum(flat * model_deviation**2))
    correlation = float(np.sum(flat * patch_deviation * model_deviation) / power) if power > 0 else 0.0
    return place, sigma, correlation


def _median_template(
    pictures: NDArray[np.float32], place: Floats, match: Floats, half: int, noise: float
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Median of the patches found, and each pixel's weight: the inverse of its variance from frame to frame."""
    whole = (place[:, 0] > 1.1 * half) & (place[:, 0] < pictures.shape[2] - 1 - 1.1 * half)
    good = np.flatnonzero(whole & (match >= np.quantile(match, 0.3)))
    if len(good) < 3:
        good = np.argsort(match)[-3:]
    good = good[np.unique(np.linspace(0, len(good) - 1, min(len(good), 60)).astype(int))]
    stack = np.stack([_patch(pictures[t], place[t, 0], place[t, 1], half) for t in good])
    first = np.median(stack, axis=0)
    pattern = first - first.mean()
    gains = np.einsum("tij,ij->t", stack, pattern) / float(np.sum(pattern**2) + 1e-9)
    stack = stack / np.clip(gains, 0.3, 3.0)[:, None, None]
    stack -= np.median(stack - first, axis=(1, 2), keepdims=True)
    template = np.median(stack, axis=0).astype(np.float32)
    scatter = (1.4826 * np.median(np.abs(stack - template), axis=0)) ** 2
    # A glint varies by its slope times the misplacement: that is the signal of the registration, not noise.
    slope = np.sum(np.square(np.gradient(template)), axis=0)
    # 0.5: misplacement that the weights of the template allow for (chosen)
    variance = np.maximum(scatter - 0.5**2 * slope, 0.0) + 2 * noise**2
    return template, (1.0 / variance).astype(np.float32)
