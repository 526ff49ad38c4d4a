"""Refine where two edges of a printed pattern cross, to under a hundredth of a pixel in a sharp picture.

Around a corner of a checkerboard the picture is modelled as m + A·erf(a/s)·erf(b/s) on a linear ramp of light, with a
and b the distances from the two edges and s the blur (√2 times its standard deviation). Levenberg-Marquardt least
squares for the crossing, both slants, blur, contrast and ramp uses every pixel beside the edges. Symmetry alone
(OpenCV's `cornerSubPix`) leaves 0.03 px in the same pictures.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vinetrack.core.records import Floats

HALF_WINDOW_PX = 12  # Half the side of the window (derived)
EDGE_SHARE = 0.42  # Part of a square over which its edges are followed from the corner (chosen)
LARGEST_MOVE_PX = 2.5  # Largest distance of a refined corner from the detected one (chosen)
FIRST_BLUR_PX = 1.1  # First value of the blur (chosen)

BLURS_PX = (0.4, 8.0)  # Bounds of the blur (chosen)

MOST_STEPS, SETTLED_PX = 20, 1e-4  # Most steps of the fit, and the step at which a corner has converged (chosen)


def refine_saddles(
    picture: NDArray[np.uint8], corners_px: Floats, steps_px: Floats, free_share: float
) -> tuple[Floats, NDArray[np.bool_]]:
    """Refine corners of a pattern of squares. Returns corners, shape (n, 2), and mask of those for which the fit holds,
    shape (n,). Shapes: picture (height, width); corners_px (n, 2); steps_px (n, 2, 2).
    """
    offsets, levels, weights = _windows(picture, corners_px, steps_px, free_share)
    values = _first_values(offsets, levels, weights, steps_px)
    model, slopes = _model(values, offsets)
    cost, damping = (weights * (levels - model) ** 2).sum(axis=1), np.full(len(values), 1e-3)
    for _ in range(MOST_STEPS):
        weighted = slopes * weights[:, :, None]
        normal = np.swapaxes(weighted, 1, 2) @ slopes
        gradient = np.swapaxes(weighted, 1, 2) @ (levels - model)[:, :, None]
        diagonal = np.einsum("nii->ni", normal)
        normal = normal + (damping[:, None] * diagonal + 1e-9)[:, :, None] * np.eye(values.shape[1])
        trial = values + np.linalg.solve(normal, gradient)[:, :, 0]
        trial[:, 4] = np.clip(trial[:, 4], *BLURS_PX)
        trial_model, trial_slopes = _model(trial, offsets)
        trial_cost = (weights * (levels - trial_model) ** 2).sum(axis=1)
        better = trial_cost < cost
        moved_px = np.linalg.norm((trial - values)[:, :2], axis=1)[better]
        values[better], model[better], slopes[better] = trial[better], trial_model[better], trial_slopes[better]
        cost = np.minimum(trial_cost, cost)
        damping = np.where(better, damping / 5, damping * 8)
        if (moved_px < SETTLED_PX).all() and (better | (damping > 1e3)).all():
            break
    crossings = np.rint(corners_px) + values[:, :2]
    usable = (weights.sum(axis=1) > 30) & (np.abs(values[:, 6]) > 3)
    return crossings, usable & (np.linalg.norm(crossings - corners_px, axis=1) < LARGEST_MOVE_PX)


def _windows(
    picture: NDArray[np.uint8], corners_px: Floats, steps_px: Floats, free_share: float
) -> tuple[Floats, Floats, Floats]:
    """Offsets (n, k, 2) of the pixels around each corner from its nearest pixel, their levels and weights (n, k). A
    pixel counts where, in steps of the pattern from the detected corner, it lies within EDGE_SHARE both ways and within
    `free_share`, less the blur, of one of the edges.
    """
    reach = np.arange(-HALF_WINDOW_PX, HALF_WINDOW_PX + 1)
    grid = np.stack(np.meshgrid(reach, reach), axis=-1).reshape(-1, 2)
    nearest = np.rint(corners_px).astype(int)
    places = nearest[:, None, :] + grid[None]
    height, width = picture.shape
    inside = ((places >= 0) & (places < [width, height])).all(axis=2)
    levels = picture[places[..., 1].clip(0, height - 1), places[..., 0].clip(0, width - 1)].astype(float)
    away = places - corners_px[:, None, :]
    shares = np.abs(np.einsum("nij,nkj->nki", np.linalg.inv(np.swapaxes(steps_px, 1, 2)), away))
    square_px = np.linalg.norm(steps_px, axis=2).min(axis=1)[:, None]
    near = shares.max(axis=2) < EDGE_SHARE
    free = shares.min(axis=2) < np.maximum(free_share - 1.5 / square_px, 1.2 / square_px)
    offsets = np.broadcast_to(grid[None].astype(float), (len(corners_px), *grid.shape))
    return offsets, levels, (inside & near & free).astype(float)


def _first_values(offsets: Floats, levels: Floats, weights: Floats, steps_px: Floats) -> Floats:
    """First values: crossing (2), slants of the edge normals (2), blur, level, half contrast, ramp slopes (2)."""
    n = len(levels)
    values = np.zeros((n, 9))
    # The normal of an edge is a quarter turn from the step along it.
    values[:, 2:4] = np.arctan2(steps_px[:, :, 0], -steps_px[:, :, 1])
    values[:, 4] = FIRST_BLUR_PX
    total = weights.sum(axis=1).clip(1)
    values[:, 5] = (levels * weights).sum(axis=1) / total
    sides = np.sign(_distances(values, offsets)).prod(axis=2)
    values[:, 6] = ((levels - values[:, 5:6]) * sides * weights).sum(axis=1) / total
    return values


def _distances(values: Floats, offsets: Floats) -> Floats:
    """Distances from both edges, shape (n, k, 2), px."""
    away = offsets - values[:, None, :2]
    normals = np.stack([np.cos(values[:, 2:4]), np.sin(values[:, 2:4])], axis=-1)
    return np.einsum("nei,nki->nke", normals, away)


def _model(values: Floats, offsets: Floats) -> tuple[Floats, Floats]:
    """Levels (n, k) that the values predict, and their derivatives (n, k, 9)."""
    from scipy.special import erf

    blur, contrast = values[:, 4, None, None], values[:, 6, None]
    away = offsets - values[:, None, :2]
    cosine, sine = np.cos(values[:, 2:4])[:, None, :], np.sin(values[:, 2:4])[:, None, :]
    distance = cosine * away[..., :1] + sine * away[..., 1:]
    turned = -sine * away[..., :1] + cosine * away[..., 1:]
    step = erf(distance / blur)
    bell = 2 / np.sqrt(np.pi) * np.exp(-((distance / blur) ** 2)) / blur
    other = step[..., ::-1]
    rise = contrast[..., None] * bell * other
    ground = values[:, 7, None] * away[..., 0] + values[:, 8, None] * away[..., 1]
    slopes = np.empty((*ground.shape, 9))
    slopes[..., 0] = -_sum_of_edges(rise * cosine) - values[:, 7, None]
    slopes[..., 1] = -_sum_of_edges(rise * sine) - values[:, 8, None]
    slopes[..., 2:4] = rise * turned
    slopes[..., 4] = -_sum_of_edges(rise * distance / blur)
    slopes[..., 5] = 1
    slopes[..., 6] = step[..., 0] * step[..., 1]
    slopes[..., 7:9] = away
    return values[:, 5, None] + contrast * slopes[..., 6] + ground, slopes


def _sum_of_edges(parts: Floats) -> Floats:
    """Sum over the two edges; several times faster than `sum` over an axis of two."""
    return np.asarray(parts[..., 0] + parts[..., 1])
