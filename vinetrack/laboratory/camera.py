"""Camera model of the laboratory: projection of the plane of growth to the picture, and its inverse.

A pinhole with radial distortion looks at a plane that may be tilted. Pixel centres have whole-number coordinates, x to
the right and y down. *Plane pixels* are metres in the plane divided by `m_per_px`, with the origin of the plane at the
centre of the picture: without tilt and distortion they are the pixels of the picture.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vinetrack.core.records import Floats

UNDISTORT_STEPS = 10  # Newton steps of the inverse of the distortion (chosen)


@dataclass(frozen=True, kw_only=True)
class Camera:
    """Size of the picture, scale, lens and pose. `m_per_px` is the scale at the picture's centre before tilt; the
    camera stands `focal_px · m_per_px` away from the plane of growth.
    """

    width_px: int = 960
    height_px: int = 320
    m_per_px: float = 1 / 2750
    focal_px: float = 2600.0
    k1: float = 0.0
    k2: float = 0.0
    tilt_x_deg: float = 0.0
    tilt_y_deg: float = 0.0

    @property
    def centre_px(self) -> tuple[float, float]:
        """Principal point, the centre of the picture, px."""
        return (self.width_px - 1) / 2, (self.height_px - 1) / 2

    @property
    def is_plain(self) -> bool:
        """Whether plane pixels and picture pixels are the same."""
        return self.k1 == self.k2 == self.tilt_x_deg == self.tilt_y_deg == 0

    @property
    def matrix(self) -> Floats:
        """Camera matrix, shape (3, 3), px."""
        cx, cy = self.centre_px
        return np.array([[self.focal_px, 0, cx], [0, self.focal_px, cy], [0, 0, 1]], dtype=float)

    @property
    def rotation(self) -> Floats:
        """Rotation of the plane against the picture, shape (3, 3)."""
        ax, ay = math.radians(self.tilt_x_deg), math.radians(self.tilt_y_deg)
        about_x = np.array([[1, 0, 0], [0, math.cos(ax), -math.sin(ax)], [0, math.sin(ax), math.cos(ax)]])
        about_y = np.array([[math.cos(ay), 0, math.sin(ay)], [0, 1, 0], [-math.sin(ay), 0, math.cos(ay)]])
        return np.asarray(about_y @ about_x, dtype=float)

    def picture_from_plane(self, plane_px: Floats) -> Floats:
        """Map points of the plane of growth to the picture. Shapes: plane_px (..., 2) → (..., 2)."""
        offset = np.asarray(plane_px, dtype=float) - self.centre_px
        spatial = offset @ self.rotation[:, :2].T + np.array([0.0, 0.0, self.focal_px])
        ray = spatial[..., :2] / spatial[..., 2:]
        radius2 = (ray**2).sum(axis=-1, keepdims=True)
        distorted = ray * (1 + self.k1 * radius2 + self.k2 * radius2**2)
        return np.asarray(distorted * self.focal_px + self.centre_px)

    def plane_from_picture(self, picture_px: Floats) -> Floats:
        """Map points of the picture to the plane of growth. Shapes: picture_px (..., 2) → (..., 2)."""
        distorted = (np.asarray(picture_px, dtype=float) - self.centre_px) / self.focal_px
        ray = np.concatenate([self._undistorted(distorted), np.ones((*distorted.shape[:-1], 1))], axis=-1)
        normal = self.rotation[:, 2]
        depth = normal[2] * self.focal_px / (ray @ normal)
        spatial = ray * depth[..., None] - np.array([0.0, 0.0, self.focal_px])
        return np.asarray(spatial @ self.rotation[:, :2] + self.centre_px)

    def _undistorted(self, distorted: Floats) -> Floats:
        """Newton's method on the radius r(1 + k1 r² + k2 r⁴) = r_bent."""
        distorted_radius = np.sqrt((distorted**2).sum(axis=-1, keepdims=True))
        radius = distorted_radius.copy()
        for _ in range(UNDISTORT_STEPS):
            excess = radius * (1 + self.k1 * radius**2 + self.k2 * radius**4) - distorted_radius
            radius -= excess / (1 + 3 * self.k1 * radius**2 + 5 * self.k2 * radius**4)
        return distorted * np.divide(radius, distorted_radius, out=np.ones_like(radius), where=distorted_radius > 0)

    def plane_maps(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Plane pixel of each picture pixel: x and y, each of shape (height_px, width_px)."""
        grid = np.stack(np.meshgrid(np.arange(self.width_px), np.arange(self.height_px)), axis=-1).astype(float)
        plane = grid if self.is_plain else self.plane_from_picture(grid)
        return plane[..., 0].astype(np.float32), plane[..., 1].astype(np.float32)
