"""From pixels to the plane of growth: lens distortion and tilt, with the errors of both.

A point of the plane, seen through a pinhole, lands where a homography puts it (any pose, any focal length), and radial
distortion moves it outwards or inwards from the picture's middle (Brown 1966; the form OpenCV uses):
q_d = q (1 + κ₁ q² + κ₂ q⁴), lengths in half-diagonals of the picture. A single view of a flat target fixes these ten
numbers; focal length and distance, which it does not, are not needed to measure in the plane.

Numbers that the corners cannot fix are held by what lenses and rigs are like (PRIOR_SIGMA), so that a small target
neither fails nor pretends: the covariance of the fit says what is left open.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from vinetrack.core.records import Floats

PRIOR_SIGMA = (0.15, 0.15, 0.10, 0.02)
"""Standard deviations, before any corner is seen, of the two perspective terms (0.15: 25° of tilt at a focal length of
three half-diagonals), κ₁ (0.1: 10 % at the picture's corners) and κ₂."""
SMALLEST_NOISE_PX = 0.01
"""Chosen: no corner is known better; a rendered picture without noise would else claim to be exact."""

NOISE_ROUNDS = 3
"""Chosen: each round leaves a small part of the change of the one before; more cost time alone."""

NEWTON_STEPS = 12
"""Chosen: the inverse of the distortion converges quadratically; more cost time alone."""

N_PLANE, N_LENS = 8, 2
"""Numbers of a plane and of a lens. Derived: a homography has eight, κ₁ and κ₂ are two."""


@dataclass(frozen=True)
class PlaneMap:
    """Where in the plane of growth each pixel looks.

    `parameters` are the first eight entries of the homography from undistorted half-diagonals (the ninth is 1) to
    metres, row by row, then κ₁, κ₂; `covariance`, shape (10, 10), is theirs.
    """

    width_px: int
    height_px: int
    parameters: Floats
    covariance: Floats

    @classmethod
    def from_scale(cls, m_per_px: float, width_px: int, height_px: int) -> PlaneMap:
        """Make a plane seen square on, without distortion, known without error.

        Parameters
        ----------
        m_per_px : scale.
        width_px, height_px : size of the picture.

        Returns
        -------
        the map.
        """
        step_m = m_per_px * _half_diagonal_px(width_px, height_px)
        parameters = np.array([step_m, 0, 0, 0, step_m, 0, 0, 0, 0, 0], dtype=float)
        return cls(width_px, height_px, parameters, np.zeros((N_PLANE + N_LENS, N_PLANE + N_LENS)))

    @property
    def distortion(self) -> tuple[float, float]:
        """κ₁ and κ₂: relative outward shifts at the picture's corners, times the second and fourth power of q."""
        return float(self.parameters[8]), float(self.parameters[9])

    def plane_m(self, picture_px: Floats) -> Floats:
        """Map points of the picture to the plane.

        Parameters
        ----------
        picture_px : (x, y), shape (..., 2), px.

        Returns
        -------
        shape (..., 2), m.
        """
        return self._plane_m(self.parameters, np.asarray(picture_px, dtype=float))

    def length_m(self, from_px: Floats | Sequence[float], to_px: Floats | Sequence[float]) -> float:
        """Return the distance in the plane between two points of the picture.

        Parameters
        ----------
        from_px, to_px : (x, y), px.

        Returns
        -------
        m.
        """
        ends = self.plane_m(np.array([from_px, to_px], dtype=float))
        return float(np.linalg.norm(ends[1] - ends[0]))

    def length_rel_sigma(self, from_px: Floats | Sequence[float], to_px: Floats | Sequence[float]) -> float:
        """Return the relative standard error of such a distance, from the covariance of the fit.

        Parameters
        ----------
        from_px, to_px : (x, y), px.

        Returns
        -------
        a fraction.
        """
        return self.path_rel_sigma(np.array([from_px, to_px], dtype=float))

    def path_rel_sigma(self, places_px: Floats) -> float:
        """Return the relative standard error of the length of a path in the plane, from the covariance of the fit.

        Parameters
        ----------
        places_px : (x, y) along the path, shape (n, 2), px.

        Returns
        -------
        a fraction.
        """
        gradient = np.zeros(self.parameters.size)
        steps = np.maximum(0.01 * np.sqrt(np.diag(self.covariance)), 1e-9).tolist()
        for k, step in enumerate(steps):
            change = np.zeros(self.parameters.size)
            change[k] = step
            less, more = (_length(self._plane_m(self.parameters + sign * change, places_px)) for sign in (-1, 1))
            gradient[k] = (more - less) / (2 * step)
        variance = float(gradient @ self.covariance @ gradient)
        return float(np.sqrt(max(variance, 0.0))) / _length(self.plane_m(places_px))

    def _plane_m(self, parameters: Floats, picture_px: Floats) -> Floats:
        size = (self.width_px, self.height_px)
        ideal = _undistorted(_half_diagonals(picture_px, size), parameters[8:])
        homography = np.append(parameters[:8], 1.0).reshape(3, 3)
        carried = np.concatenate([ideal, np.ones((*ideal.shape[:-1], 1))], axis=-1) @ homography.T
        return np.asarray(carried[..., :2] / carried[..., 2:])


@dataclass(frozen=True)
class PlaneFit:
    """A plane map for each view (one lens for all), and how far corners lie from where it puts them.

    `residual_px` holds an array of shape (n, 2) for each view; `noise_px` their standard deviation per coordinate.
    """

    maps: tuple[PlaneMap, ...]
    residual_px: tuple[Floats, ...]
    noise_px: float

    @property
    def reprojection_px(self) -> float:
        """Root mean square distance of corners from where the fit puts them, px."""
        return float(np.sqrt(np.mean(np.concatenate([(view**2).sum(axis=1) for view in self.residual_px]))))


def _length(path_m: Floats) -> float:
    """Length of a path through places of the plane, shape (n, 2), m."""
    return float(sum(np.linalg.norm(step) for step in np.diff(path_m, axis=0)))


def _half_diagonal_px(width_px: int, height_px: int) -> float:
    """Half the picture's diagonal, px: the unit of undistorted coordinates."""
    return 0.5 * float(np.hypot(width_px, height_px))


def fit_planes(views: Sequence[tuple[Floats, Floats]], width_px: int, height_px: int) -> PlaneFit:
    """Fit a plane to each view and one lens to all.

    Parameters
    ----------
    views : for each view corners in the picture (px) and on the target (m), both of shape (n, 2), n ≥ 4.
    width_px, height_px : size of the picture.

    Returns
    -------
    maps, residuals in px, and the noise of a corner, px.

    Notes
    -----
    Least squares on distances in the picture, in units of the corners' noise, which is taken from the residuals
    (NOISE_ROUNDS times over), plus the priors; the covariance is the inverse of JᵀJ.
    """
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
        freedom = 2 * sum(len(view) for view in corners) - N_PLANE * len(views) - N_LENS
        total = sum(float((view**2).sum()) for view in residuals)
        noise_px = max(unit_px * np.sqrt(total / max(freedom, 1)), SMALLEST_NOISE_PX)
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


def _undistorted(bent: Floats, lens: Floats) -> Floats:
    """Newton's method on q(1 + κ₁q² + κ₂q⁴) = q_d; beyond the fold of a strong lens the step is held back."""
    bent_radius = np.sqrt((bent**2).sum(axis=-1, keepdims=True))
    radius = bent_radius.copy()
    for _ in range(NEWTON_STEPS):
        excess = radius * (1 + lens[0] * radius**2 + lens[1] * radius**4) - bent_radius
        slope = 1 + 3 * lens[0] * radius**2 + 5 * lens[1] * radius**4
        radius = radius - excess / np.maximum(slope, 0.2)
    return np.asarray(bent * np.divide(radius, bent_radius, out=np.ones_like(radius), where=bent_radius > 0))


def _distorted(ideal: Floats, lens: Floats) -> Floats:
    radius2 = (ideal**2).sum(axis=-1, keepdims=True)
    return np.asarray(ideal * (1 + lens[0] * radius2 + lens[1] * radius2**2))


def _first_homography(picture: Floats, board: Floats) -> Floats:
    """Homography from half-diagonals to the board, by the direct linear transform; first eight entries, shape (8,)."""
    there = np.column_stack([picture, np.ones(len(picture))])
    nothing = np.zeros_like(there)
    system = np.block([[there, nothing, -board[:, :1] * there], [nothing, there, -board[:, 1:] * there]])
    _, directions = np.linalg.eigh(system.T @ system)
    homography = directions[:, 0]
    return np.asarray(homography[:8] / homography[8])


def _residuals(values: Floats, corners: list[Floats], boards: list[Floats]) -> list[Floats]:
    """Corners minus where the values put them, half-diagonals, one array a view."""
    lens = values[N_PLANE * len(corners) :]
    residuals = []
    for k, (corner, board) in enumerate(zip(corners, boards, strict=True)):
        homography = np.append(values[k * N_PLANE : (k + 1) * N_PLANE], 1.0).reshape(3, 3)
        carried = np.column_stack([board, np.ones(len(board))]) @ np.linalg.inv(homography).T
        residuals.append(corner - _distorted(carried[:, :2] / carried[:, 2:], lens))
    return residuals


def _misfit(values: Floats, corners: list[Floats], boards: list[Floats], noise: float) -> Floats:
    """Residuals in units of the noise, then the priors in units of theirs."""
    n_views = len(corners)
    fits = np.concatenate([view.ravel() for view in _residuals(values, corners, boards)]) / noise
    tilts = np.concatenate([values[k * N_PLANE + 6 : k * N_PLANE + 8] for k in range(n_views)])
    lens = values[N_PLANE * n_views :]
    held = np.concatenate([tilts / np.tile(PRIOR_SIGMA[:2], n_views), lens / np.array(PRIOR_SIGMA[2:])])
    return np.concatenate([fits, held])
