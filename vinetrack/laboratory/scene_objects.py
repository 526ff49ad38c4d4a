"""Moving objects in front of the backdrop: tube, ball and door, each composited over the light of a frame."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from vinetrack.core.records import Floats
from vinetrack.laboratory import shading, textures
from vinetrack.laboratory.scene import Ball, Door, Scene, Tube
from vinetrack.laboratory.scene_motion import SceneMotion

Image = NDArray[np.float32]

EXPOSURE_PIECES = 4  # Straight pieces that approximate the path of the tip over an exposure (derived)
TABLE_STEP_PX = 1 / 16  # Steps of the table of covers along the path (chosen)

PROFILE_PER_PX = 16  # Entries per pixel of the profiles across (chosen)

# How much wider the edge's blur is along the path where the tip's outline is slanted (1/cos of the slant)
SLOPES = np.linspace(1.0, 4.0, 7)
TAIL_PERIOD_PX = 4096  # Period of the texture of the tail (chosen)

BALL_STEP_PX = 0.7  # Distance of the centres over which a moving ball is averaged (chosen)


class PathMaps:
    """Plane coordinates of every pixel, along the growth axis and across it: each float32 of the picture's shape."""

    def __init__(self, scene: Scene) -> None:
        self.plane_x, self.plane_y = scene.camera.plane_maps()
        ux, uy = (np.float32(part) for part in scene.direction)
        dx, dy = self.plane_x - np.float32(scene.origin[0]), self.plane_y - np.float32(scene.origin[1])
        self.along: Image = (dx * ux + dy * uy).astype(np.float32)
        self.across: Image = (dy * ux - dx * uy).astype(np.float32)

    def rows_within(self, touched: NDArray[np.bool_]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """First and one-past-last column of each row that `touched` marks; equal where it marks none. Returns two
        arrays, shape (height,). Shapes: touched (height, width).
        """
        any_in_row = touched.any(axis=1)
        last = touched.shape[1] - touched[:, ::-1].argmax(axis=1)
        return np.where(any_in_row, touched.argmax(axis=1), 0), np.where(any_in_row, last, 0)


class TubeLayer:
    """Composites the everting tube with its payload over a frame."""

    def __init__(self, scene_motion: SceneMotion, maps: PathMaps, rng: np.random.Generator) -> None:
        scene = scene_motion.scene
        assert isinstance(scene.subject, Tube)
        self._motion, self._maps, self._tube, self._psf_px = scene_motion, maps, scene.subject, scene.psf_px
        self._radius_px = radius = scene.subject.diameter_m / 2 / scene.camera.m_per_px
        length = max(math.ceil(float(maps.along.max())) + 8, 64)
        self._wall = textures.film_wall(self._tube, rng, radius, length)
        self._girth = textures.film_girth(self._tube, rng, length)
        self._tail = textures.tail_sums(self._tube, rng, radius, TAIL_PERIOD_PX)
        self._profiles = tip_profiles(self._tube, radius, self._psf_px)
        self._ghost_across = 1.35 * radius
        shake = 4 * scene.shake_px
        reach = radius + 8 + 2.3 * abs(self._tube.wobble_px) + shake
        touched = np.abs(maps.across) < reach
        if self._tube.reflection:
            touched |= np.abs(maps.across - self._ghost_across) < reach
        self._first_x, self._last_x = maps.rows_within(touched & (maps.along > -4 - shake))
        self._payload: BallLayer | None = None
        if self._tube.payload_diameter_m:
            metal = Ball(
                diameter_m=self._tube.payload_diameter_m,
                brightness=2 * self._tube.payload_brightness,
                texture=0.1,
                specular=0.25,
            )
            self._payload = BallLayer(scene_motion, maps, rng, metal, scene_motion.tail_end_px, emerges_at_px=0.0)

    def lay(self, light: Image, frame: int, shift: tuple[float, float]) -> None:
        """Lay the tube as exposed in one frame over a picture, in place. Shapes: light (height, width)."""
        if self._payload is not None:
            self._payload.lay(light, frame, shift)
        scene_motion, tube = self._motion, self._tube
        middle_s = float(scene_motion.mid_exposure_s(frame))
        part = np.linspace(0, 1, EXPOSURE_PIECES + 1)
        path = scene_motion.lead_px(frame / scene_motion.capture_fps + scene_motion.exposure_s * part)
        tip = float(scene_motion.lead_px(middle_s))
        table, first = self._edge_table(path - tip)
        setback, slope_row, side, core = self._profiles
        tail_from, tail_to = 2 * float(path[0]), 2 * float(path[-1])
        # Averaged over one pixel at least, so that the tail's texture is as soft at rest as in motion.
        slack = max(0.0, 1.0 - (tail_to - tail_from)) / 2
        shading.shade_tube(
            light, self._maps.along, self._maps.across, self._first_x, self._last_x, *shift, tip,
            scene_motion.sway_px(middle_s), scene_motion.sway_length_px, table, first, TABLE_STEP_PX, len(SLOPES),
            setback, slope_row, side, core, PROFILE_PER_PX, *self._wall, self._girth, self._tail, tail_from - slack,
            tail_to + slack,
            float(scene_motion.tail_end_px(middle_s)), tube.tail_opacity, tube.brightness, tube.tail_texture,
            tube.tip_glow, 0.25 * tube.reflection * tube.brightness, self._ghost_across,
        )  # fmt: skip

    def _edge_table(self, path_px: Floats) -> tuple[Image, float]:
        """Coverage for each of SLOPES and, in the last row, the glow of the fold, against distance from the tip."""
        sigma = self._psf_px
        fold_px, fold_sigma = 0.28 * self._radius_px, 0.07 * self._radius_px + sigma
        reach = 4.5 * max(sigma * SLOPES[-1], fold_sigma)
        first, last = float(path_px.min()) - fold_px - reach, float(path_px.max()) + reach
        n = math.ceil((last - first) / TABLE_STEP_PX) + 2
        edges = shading.coverage_table(path_px, sigma * SLOPES, first, TABLE_STEP_PX, n)
        width = np.array([fold_sigma])
        front = shading.coverage_table(path_px, width, first, TABLE_STEP_PX, n)
        back = shading.coverage_table(path_px - fold_px, width, first, TABLE_STEP_PX, n)
        return np.concatenate([edges, front - back]), first


def tip_profiles(tube: Tube, radius_px: float, psf_px: float) -> tuple[Floats, NDArray[np.int64], Image, Image]:
    """Profiles over the distance v from the axis, PROFILE_PER_PX a pixel: setback, slope row, side and core. Returns
    setback, slope row, side, core, each of shape (n_entries,).
    """
    from scipy.special import ndtr

    half = math.ceil((radius_px + 5) * PROFILE_PER_PX)
    v = np.abs(np.arange(-half, half + 1)) / PROFILE_PER_PX
    corner = max(tube.tip_roundness * radius_px, 1e-6)
    into = np.clip((v - radius_px + corner) / corner, 0, 0.985)
    cosine = np.sqrt(1 - into**2)
    slope_row = np.searchsorted(SLOPES, np.clip(1 / cosine, 1, SLOPES[-1]) - 1e-9).astype(np.int64)
    side = ndtr((radius_px - v) / psf_px)
    core_px = tube.tail_width * radius_px
    core = ndtr((core_px - 1 - v) / 1.2) * np.sqrt(np.clip(1.15 - (v / max(core_px, 1e-6)) ** 2, 0.1, 1))
    core[v > core_px + 1] = 0
    return corner * (1 - cosine), slope_row, side.astype(np.float32), core.astype(np.float32)


class BallLayer:
    """Composites a ball whose centre follows `centre_px` over a frame; it is visible from `emerges_at_px` on."""

    def __init__(
        self,
        scene_motion: SceneMotion,
        maps: PathMaps,
        rng: np.random.Generator,
        ball: Ball,
        centre_px: Callable[[Floats], Floats],
        emerges_at_px: float = -1e9,
    ) -> None:
        self._motion, self._maps, self._centre_px, self._from_px = scene_motion, maps, centre_px, emerges_at_px
        self._radius_px = ball.diameter_m / 2 / scene_motion.scene.camera.m_per_px
        self._surface = textures.ball_surface(ball, rng, max(self._radius_px, 2.0))

    def lay(self, light: Image, frame: int, shift: tuple[float, float]) -> None:
        """Lay the ball over a picture, in place, averaged over centres at most BALL_STEP_PX apart. Shapes: light
        (height, width).
        """
        scene_motion = self._motion
        begin_s, span_s = frame / scene_motion.capture_fps, scene_motion.exposure_s
        ends = self._centre_px(begin_s + np.array([0, span_s]))
        pieces = int(min(max(math.ceil(abs(ends[1] - ends[0]) / BALL_STEP_PX), 3), 80))
        path = self._centre_px(begin_s + span_s * (np.arange(pieces) + 0.5) / pieces)
        box = self._box(path, max(abs(part) for part in shift), (light.shape[0], light.shape[1]))
        if box[2] > box[0] and box[3] > box[1]:
            shading.shade_ball(
                light, self._maps.along, self._maps.across, *shift, path, self._radius_px, scene_motion.scene.psf_px,
                self._surface, box, self._from_px,
            )  # fmt: skip

    def _box(self, path: Floats, shake: float, shape: tuple[int, int]) -> NDArray[np.int64]:
        """Columns and rows (x0, y0, x1, y1) that the ball can touch."""
        scene = self._motion.scene
        reach = 1.15 * (self._radius_px + 6) + 1.5 * shake
        ends = np.array([path.min(), path.max()])[:, None] * np.array(scene.direction) + np.array(scene.origin)
        corners = np.array([[-1, -1], [-1, 1], [1, -1], [1, 1]]) * reach
        seen = scene.camera.picture_from_plane(ends[:, None, :] + corners).reshape(-1, 2)
        (x0, y0), (x1, y1) = np.floor(seen.min(axis=0)), np.ceil(seen.max(axis=0))
        limits = [max(x0, 0), max(y0, 0), min(x1, shape[1]), min(y1, shape[0])]
        return np.array(limits).astype(np.int64)


class DoorLayer:
    """Composites the door over a frame: a plate hinged beside the resting tip that swings out of the path."""

    def __init__(self, scene_motion: SceneMotion, door: Door) -> None:
        scene = scene_motion.scene
        scale = scene.camera.m_per_px
        self._motion, self._door = scene_motion, door
        self._length, self._half = door.length_m / scale, door.thickness_m / scale / 2
        radius = scene.subject.diameter_m / 2 / scale
        self._hinge = np.array([float(scene_motion.lead_px(0.0)) + 2 + self._half, -1.25 * radius])

    def lay(self, light: Image, frame: int, shake: tuple[float, float]) -> None:
        """Lay the door over a picture, in place, averaged over the beginning, middle and end of the exposure. Shapes:
        light (height, width).
        """
        times_s = frame / self._motion.capture_fps + self._motion.exposure_s * np.array([0.1, 0.5, 0.9])
        angles = [self._motion.door_angle_rad(float(t)) for t in times_s]
        arm = np.array([[-1, -4], [1, -4], [1, self._length], [-1, self._length]]) * [self._half, 1]
        knuckle = np.array([[-2, -7], [2, -7], [2, 5], [-2, 5]]) * [self._half, 1]
        lit = np.array([[0.3, -4], [1, -4], [1, self._length], [0.3, self._length]]) * [self._half, 1]
        self._paint(light, arm, angles, shake, self._door.brightness)
        self._paint(light, lit, angles, shake, 1.35 * self._door.brightness)
        self._paint(light, knuckle, [0.0], shake, 0.12)

    def _paint(
        self, light: Image, outline: Floats, angles: list[float], shake: tuple[float, float], brightness: float
    ) -> None:
        """Fill the outline, turned by each of `angles` about the hinge, each with its share of the exposure."""
        import cv2

        scene = self._motion.scene
        ux, uy = scene.direction
        axes = np.array([[ux, uy], [-uy, ux]])
        turned = []
        for angle in angles:
            turn = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
            turned.append(scene.camera.picture_from_plane((outline @ turn + self._hinge) @ axes + scene.origin + shake))
        every = np.concatenate(turned)
        low = np.clip(np.floor(every.min(axis=0)).astype(int) - 4, 0, None)
        high = np.clip(np.ceil(every.max(axis=0)).astype(int) + 5, None, [light.shape[1], light.shape[0]])
        if (high <= low).any():
            return
        cover = np.zeros((high[1] - low[1], high[0] - low[0]), dtype=np.float32)
        for corners in turned:
            layer = np.zeros(cover.shape, dtype=np.uint8)
            cv2.fillConvexPoly(layer, np.round((corners - low) * 16).astype(np.int32), 255, cv2.LINE_AA, shift=4)
            cover += layer / np.float32(255 * len(turned))
        cover = np.asarray(cv2.GaussianBlur(cover, (0, 0), scene.psf_px), dtype=np.float32)
        region = light[low[1] : high[1], low[0] : high[0]]
        region += cover * (np.float32(brightness) - region)
