"""Track a body that moves as a whole (travel ratio 1) by registering it against itself along the axis.

The body leaves background behind it, perhaps dark on dark, so that there is no film to compare with. A template is cut
where the body is most clearly visible, found in every frame by correlation, to a fraction of a pixel by the enhanced
correlation coefficient, which ignores gain and level (Evangelidis & Psarakis, IEEE TPAMI 30, 1858, 2008), and replaced
by the median of the patches found. The reported point is fixed on the body.
"""

from __future__ import annotations

import contextlib

import numpy as np
from numpy.typing import NDArray

from vinetrack.core.records import Bools, Floats
from vinetrack.tracks.position_noise import rough_noise, turning_point
from vinetrack.video.frames import RecordingError
from vinetrack.video.small_pictures import busy_frames, dividing_path
from vinetrack.video.strip import SLOW_PX, Look, Positions, Tracker, calibrated_sigma, cut_strip

SEARCH_ACROSS_PX = 8  # Distance across the axis by which the body may deviate in the search (chosen)
LEAST_MATCH = 0.6  # Correlation with the template below which the patch found is not the body (chosen)


class BodyTracker(Tracker):
    """Registers what moves along an axis against itself; None where the travel ratio says that a tube everts."""

    def follow(self, look: Look) -> Positions | None:
        """See `Tracker`."""
        if look.travel_ratio != 1:
            return None
        strip = cut_strip(look.luma, look.axis, 0.75 * look.axis.width_px + 12)
        pictures = strip.brightness()
        path, half = _coarse_path(pictures, strip.noise, _near(pictures.shape[1], strip.axis.width_px))
        half = max(half, round(0.75 * strip.axis.width_px))  # as long as it is wide; a glint on it is shorter
        if np.ptp(path) < 3:
            raise RecordingError("nothing moves along the axis")
        # Cut near the middle of the frames in which the whole body is inside and moving
        whole = np.flatnonzero((path > 1.3 * half) & (path < pictures.shape[2] - 1 - 1.3 * half))
        moving = [i for i in whole if 0 < i < len(path) - 1 and path[i + 1] > path[i - 1]]
        chosen = moving or whole.tolist() or [*range(len(path))]
        template_frame = int(chosen[len(chosen) // 2])
        template = _patch(pictures[template_frame], path[template_frame], 0.0, half)
        mask = np.broadcast_to(_near(len(template), strip.axis.width_px), template.shape).astype(np.uint8)
        place, error, match = _registered(pictures, template, mask, _searched(pictures, template, path))
        # 3: times that the template is replaced by the median of the patches found (chosen)
        for _ in range(3):
            template = _median_template(pictures, place, match, half)
            place, error, match = _registered(pictures, template, mask, place)
        inside = (place[:, 0] > 0.6 * half) & (place[:, 0] < pictures.shape[2] - 1 - 0.6 * half)
        off_axis = np.abs(place[:, 1]) > 0.75 * SEARCH_ACROSS_PX
        unseen, end = (match < LEAST_MATCH) | off_axis, None
        recognised = np.flatnonzero(~unseen)
        if len(recognised) >= 3:
            # 3.0, 6.0: distance behind its furthest place where a body has turned back, px and standard errors (chosen)
            back_px = np.maximum(3.0, 6.0 * error[recognised])
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
        return Positions(
            strip=strip, edge_px=edge, sigma_px=calibrated_sigma(edge, error),
            unsure=~inside, reach_px=float(half), slow_px=SLOW_PX, end=end,
            exposure_frames=look.exposure_frames,
        )  # fmt: skip


def hops_between_bodies(along: Floats, seen: Bools) -> bool:
    """Whether places scatter about any smooth motion by as much as they advance. Shapes: along, seen (n_frames,)."""
    places = along[seen & np.isfinite(along)]
    # 3.0, 0.5, 9: scatter of single places, in px and in steps of a frame, above which what is followed is not one
    # body; and the fewest places from which it is estimated (chosen)
    return len(places) >= 9 and rough_noise(places) > max(3.0, 0.5 * float(np.median(np.abs(np.diff(places)))))


def _near(rows: int, width_px: float) -> Bools:
    """Rows within the body's width and 2 px (chosen) beside it, where no neighbour moves, shape (n_rows, 1)."""
    return ~(np.abs(np.arange(rows) - (rows - 1) / 2) > width_px / 2 + 2.0)[:, None]


def _coarse_path(pictures: NDArray[np.float32], noise: float, near: Bools) -> tuple[Floats, int]:
    """Centre of the body by frame, to a few pixels, and half its length along the axis. The background is the median
    over frames spread evenly over the changes, so that a body that rests for long does not become part of it.
    """
    background = np.median(busy_frames(pictures, 41), axis=0)
    foreground = (near * np.clip(np.abs(pictures - background) - 3 * noise, 0, 60)).sum(axis=1)
    # Half the length of what differs from the background, from the width of its autocorrelation along the axis
    clearest = foreground[np.argsort(foreground.sum(axis=1))[len(pictures) // 2 :]]
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


def _searched(pictures: NDArray[np.float32], template: NDArray[np.float32], path: Floats) -> Floats:
    """Place of the best normalised correlation near a path, in whole pixels along and across, (n, 2)."""
    import cv2

    half, place = template.shape[1] // 2, np.zeros((len(path), 2))
    reach = half + 14 + half // 2  # 14: distance along the axis searched about the expected place (chosen)
    for t, picture in enumerate(pictures):
        low = int(np.clip(path[t] - reach, 0, max(picture.shape[1] - 2 * half - 1, 0)))
        score = cv2.matchTemplate(picture[:, low : low + 2 * reach + 1].copy(), template, cv2.TM_CCOEFF_NORMED)
        row, column = np.unravel_index(int(np.argmax(score)), score.shape)
        place[t] = low + column + half, row - SEARCH_ACROSS_PX
    return place


def _registered(
    pictures: NDArray[np.float32], template: NDArray[np.float32], mask: NDArray[np.uint8], place: Floats
) -> tuple[Floats, Floats, Floats]:
    """Place (n, 2) along and across, its error along (n,) and correlation (n,) in every frame."""
    import cv2

    place, match, half = place.copy(), np.full(len(place), 0.01), template.shape[1] // 2
    until = cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 30, 1e-5
    for t, picture in enumerate(pictures):
        whole = np.rint(place[t])
        patch = _patch(picture, whole[0], whole[1], half)  # not interpolated
        with contextlib.suppress(cv2.error):  # where nothing is alike
            found, warp = cv2.findTransformECC(
                patch, template, np.eye(2, 3, dtype=np.float32), cv2.MOTION_TRANSLATION, until, mask, 1
            )
            match[t], place[t] = np.clip(found, 0.01, 1.0), whole - warp[:, 2]
    seen = mask > 0
    slope = np.linalg.norm(np.gradient(template, axis=1)[seen])
    return place, np.std(template[seen]) * np.sqrt(match**-2 - 1) / slope, match


def _median_template(pictures: NDArray[np.float32], place: Floats, match: Floats, half: int) -> NDArray[np.float32]:
    """Median of the patches found, each of unit variance."""
    whole = (place[:, 0] > 1.1 * half) & (place[:, 0] < pictures.shape[2] - 1 - 1.1 * half)
    good = np.flatnonzero(whole & (match >= LEAST_MATCH))
    if len(good) < 3:
        good = np.argsort(match)[-3:]
    good = good[np.unique(np.linspace(0, len(good) - 1, min(len(good), 60)).astype(int))]
    stack = np.stack([_patch(pictures[t], place[t, 0], place[t, 1], half) for t in good])
    stack -= stack.mean(axis=(1, 2), keepdims=True)
    return np.median(stack / stack.std(axis=(1, 2), keepdims=True), axis=0).astype(np.float32)
