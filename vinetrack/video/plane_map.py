"""Map from pixels to the plane of growth: lens distortion and tilt, with their uncertainty.

A point of the plane, seen through a pinhole, is mapped by a homography (for any pose and focal length), and radial
distortion then moves it outwards or inwards from the centre of the picture (Brown 1966; the form OpenCV uses): q_d = q
(1 + κ₁ q² + κ₂ q⁴), lengths in half-diagonals of the picture. A single view of a flat target determines these ten
parameters. Focal length and distance remain unknown, but are not needed to measure in the plane.

Gaussian priors (PRIOR_SIGMA), from typical lenses and set-ups, constrain parameters that the corners do not determine,
so that a small target neither fails nor claims too much: the covariance of the fit includes the remaining uncertainty.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from vinetrack.core.records import Floats

PRIOR_SIGMA = (0.15, 0.15, 0.10, 0.02)  # Prior standard deviations of the two perspective terms (chosen)
MIN_NOISE_PX = 0.01  # Chosen: no corner is located better

NOISE_ROUNDS = 3  # Iterations of fit and noise estimate (chosen)

NEWTON_STEPS = 12  # Iterations of Newton's method (chosen)

N_PLANE, N_LENS = 8, 2  # Parameters of a plane and of a lens (derived)


@dataclass(frozen=True)
class PlaneMap:
    """Map from pixels to the plane of growth. `parameters` are the first eight entries of the homography from
    undistorted half-diagonals to metres, row by row (the ninth is 1), then κ₁ and κ₂; `covariance`, shape (10, 10), is
    their covariance.
    """

    width_px: int
    height_px: int
    parameters: Floats
    covariance: Floats

    @classmethod
    def from_scale(cls, m_per_px: float, width_px: int, height_px: int) -> PlaneMap:
        """Make the map of a plane seen at right angles, without distortion, known without error."""
        step_m = m_per_px * _half_diagonal_px(width_px, height_px)
        parameters = np.array([step_m, 0, 0, 0, step_m, 0, 0, 0, 0, 0], dtype=float)
        return cls(width_px, height_px, parameters, np.zeros((N_PLANE + N_LENS, N_PLANE + N_LENS)))

    @property
    def distortion(self) -> tuple[float, float]:
        """κ₁ and κ₂: relative outward shifts at the picture's corners, times the second and fourth power of q."""
        return float(self.parameters[8]), float(self.parameters[9])

    def plane_m(self, picture_px: Floats) -> Floats:
        """Map points of the picture to the plane. Shapes: picture_px (..., 2) → (..., 2)."""
        return self._plane_m(self.parameters, np.asarray(picture_px, dtype=float))

    def length_m(self, from_px: Floats | Sequence[float], to_px: Floats | Sequence[float]) -> float:
        """Return the distance in the plane between two points of the picture."""
        ends = self.plane_m(np.array([from_px, to_px], dtype=float))
        return float(np.linalg.norm(ends[1] - ends[0]))

    def length_rel_sigma(self, from_px: Floats | Sequence[float], to_px: Floats | Sequence[float]) -> float:
        """Return the relative standard error of the distance in the plane between two points, from the covariance."""
        return self.path_rel_sigma(np.array([from_px, to_px], dtype=float))

    def path_rel_sigma(self, places_px: Floats) -> float:
        """Return the relative standard error of the length of a path in the plane, from the covariance. Shapes:
        places_px (n, 2).
        """
        gradient = np.zeros(self.parameters.size)
        steps = np.maximum(0.01 * np.sqrt(np.diag(self.covariance)), 1e-9).tolist()
        for k, step in enumerate(steps):
            change = np.zeros(self.parameters.size)
            change[k] = step
            lower, upper = (_length(self._plane_m(self.parameters + sign * change, places_px)) for sign in (-1, 1))
            gradient[k] = (upper - lower) / (2 * step)
        variance = float(gradient @ self.covariance @ gradient)
        return float(np.sqrt(max(variance, 0.0))) / _length(self.plane_m(places_px))

    def _plane_m(self, parameters: Floats, picture_px: Floats) -> Floats:
        size = (self.width_px, self.height_px)
        ideal = _undistorted(_half_diagonals(picture_px, size), parameters[8:])
        homography = np.append(parameters[:8], 1.0).reshape(3, 3)
        projected = np.concatenate([ideal, np.ones((*ideal.shape[:-1], 1))], axis=-1) @ homography.T
        return np.asarray(projected[..., :2] / projected[..., 2:])


@dataclass(frozen=True)
class PlaneFit:
    """Plane maps of several views with a common lens, and the reprojection residuals. `residual_px` holds an array of
    shape (n, 2) per view; `noise_px` is the standard deviation per coordinate.
    """

    maps: tuple[PlaneMap, ...]
    residual_px: tuple[Floats, ...]
    noise_px: float

    @property
    def reprojection_px(self) -> float:
        """Root mean square reprojection error, px."""
        return float(np.sqrt(np.mean(np.concatenate([(view**2).sum(axis=1) for view in self.residual_px]))))


def _length(path_m: Floats) -> float:
    """Length of a path through places of the plane, shape (n, 2), m."""
    return float(sum(np.linalg.norm(step) for step in np.diff(path_m, axis=0)))


def _half_diagonal_px(width_px: int, height_px: int) -> float:
    """Half the picture's diagonal, px: the unit of undistorted coordinates."""
    return 0.5 * float(np.hypot(width_px, height_px))


def fit_planes(views: Sequence[tuple[Floats, Floats]], width_px: int, height_px: int) -> PlaneFit:
    """Fit a plane to each view and a common lens. Shapes: views (n, 2)."""
    from scipy.optimize import least_squares

    size = (width_px, height_px)
    corners = [_half_diagonals(picture, size) for picture, _ in views]
    boards = [board for _, board in views]
    reach_m = max(float(np.ptp(board, axis=0).max()) for board in boards)
    start = [_first_homography(view, board / reach_m) for view, board in zip(corners, boards, strict=True)]
    values = np.concatenate([*start, np.zeros(N_LENS)])
    unit_px = _half_diagonal_px(*size)
    noise_px = 0.1
    for _ in range(NOISE_ROUNDS):
        arguments = (corners, [board / reach_m for board in boards], noise_px / unit_px)
        fit = least_squares(_misfit, values, args=arguments, method="lm", xtol=1e-12, ftol=1e-12)
        values = fit.x
        residuals = _residuals(values, *arguments[:2])
        n_degrees = 2 * sum(len(view) for view in corners) - N_PLANE * len(views) - N_LENS
        sum_of_squares = sum(float((view**2).sum()) for view in residuals)
        noise_px = max(unit_px * np.sqrt(sum_of_squares / max(n_degrees, 1)), MIN_NOISE_PX)
    covariance = np.linalg.inv(fit.jac.T @ fit.jac)
    maps = []
    for k in range(len(views)):
        index = np.r_[k * N_PLANE : (k + 1) * N_PLANE, len(views) * N_PLANE : len(views) * N_PLANE + N_LENS]
        metres = np.array([reach_m] * 6 + [1.0] * 4)
        part = covariance[np.ix_(index, index)] * np.outer(metres, metres)
        maps.append(PlaneMap(width_px, height_px, values[index] * metres, part))
    return PlaneFit(tuple(maps), tuple(view * unit_px for view in residuals), noise_px)


def _half_diagonals(picture_px: Floats, size: tuple[int, int]) -> Floats:
    middle = (np.array(size) - 1) / 2
    return np.asarray((np.asarray(picture_px, dtype=float) - middle) / _half_diagonal_px(*size))


def _undistorted(distorted: Floats, lens: Floats) -> Floats:
    """Solve q(1 + κ₁q² + κ₂q⁴) = q_d by Newton's method; where a strong lens folds over, steps are limited."""
    distorted_radius = np.sqrt((distorted**2).sum(axis=-1, keepdims=True))
    radius = distorted_radius.copy()
    for _ in range(NEWTON_STEPS):
        excess = radius * (1 + lens[0] * radius**2 + lens[1] * radius**4) - distorted_radius
        slope = 1 + 3 * lens[0] * radius**2 + 5 * lens[1] * radius**4
        radius = radius - excess / np.maximum(slope, 0.2)
    return np.asarray(
        distorted * np.divide(radius, distorted_radius, out=np.ones_like(radius), where=distorted_radius > 0)
    )


def _distorted(ideal: Floats, lens: Floats) -> Floats:
    radius2 = (ideal**2).sum(axis=-1, keepdims=True)
    return np.asarray(ideal * (1 + lens[0] * radius2 + lens[1] * radius2**2))


def _first_homography(picture: Floats, board: Floats) -> Floats:
    """Homography from half-diagonals to the board by the direct linear transform; first eight entries, shape (8,)."""
    homogeneous = np.column_stack([picture, np.ones(len(picture))])
    zeros = np.zeros_like(homogeneous)
    system = np.block(
        [[homogeneous, zeros, -board[:, :1] * homogeneous], [zeros, homogeneous, -board[:, 1:] * homogeneous]]
    )
    _, directions = np.linalg.eigh(system.T @ system)
    homography = directions[:, 0]
    return np.asarray(homography[:8] / homography[8])


def _residuals(values: Floats, corners: list[Floats], boards: list[Floats]) -> list[Floats]:
    """Corners minus their predicted positions, half-diagonals, one array per view."""
    lens = values[N_PLANE * len(corners) :]
    residuals = []
    for k, (corner, board) in enumerate(zip(corners, boards, strict=True)):
        homography = np.append(values[k * N_PLANE : (k + 1) * N_PLANE], 1.0).reshape(3, 3)
        projected = np.column_stack([board, np.ones(len(board))]) @ np.linalg.inv(homography).T
        residuals.append(corner - _distorted(projected[:, :2] / projected[:, 2:], lens))
    return residuals


def _misfit(values: Floats, corners: list[Floats], boards: list[Floats], noise: float) -> Floats:
    """Residuals over the noise, followed by the parameters with priors over their prior standard deviations."""
    n_views = len(corners)
    fits = np.concatenate([view.ravel() for view in _residuals(values, corners, boards)]) / noise
    tilts = np.concatenate([values[k * N_PLANE + 6 : k * N_PLANE + 8] for k in range(n_views)])
    lens = values[N_PLANE * n_views :]
    priors = np.concatenate([tilts / np.tile(PRIOR_SIGMA[:2], n_views), lens / np.array(PRIOR_SIGMA[2:])])
    return np.concatenate([fits, priors])
