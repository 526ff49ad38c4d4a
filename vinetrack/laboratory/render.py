"""A motion becomes a recording: pictures of a scene, frame by frame, and the truth about each.

**The leading edge** is the foremost point of the tube on its own centreline. A sharp picture of it would be a step
there; optics and pixel blur that step with a Gaussian of `psf_px`, the exposure with the tip's own motion, so that at
constant speed the half-way point of the blurred step is the tip at mid-exposure, to which the truth refers.
`lead_position_m` is the tip's travel in the plane of growth, `lead_px` its distance from the path's start in plane
pixels, `tip_x_px`, `tip_y_px` where it is in the picture as recorded: after shake, tilt and distortion.
For a body that moves as a whole the same holds for its foremost point.

Everted film stays where it is; the tail inside moves at twice the tip's speed and is blurred accordingly; a body's
texture moves with it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vinetrack.laboratory import shading, textures
from vinetrack.laboratory.scene import Ball, Scene, Tube

Floats = NDArray[np.float64]
Motion = Callable[[Floats], Floats] | tuple[Floats, Floats]
"""Lead position in metres against time in seconds: a function of an array, or samples (time_s, lead_position_m)."""

EXPOSURE_PIECES = 4
"""Straight pieces the tip's path over an exposure is cut into; with 60 m/s and 3000 m/s² over 0.5 ms each is off by
a·(T/4)²/8 = 6 µm at most, a hundredth of a pixel."""
TABLE_STEP_PX = 1 / 16
PROFILE_PER_PX = 16
SLOPES = np.linspace(1.0, 4.0, 7)
"""How much wider the edge's blur is along the path where the tip's outline is slanted (1/cos of the slant)."""
FASTEST_PAYLOAD_M_S = 150.0


@dataclass(frozen=True)
class Truth:
    """What a recording shows. Arrays have shape (n_frames,), one entry for every frame in the file, in order.

    `source_frame` is the frame of the undisturbed recording that is shown; `time_s` its mid-exposure; `in_frame` says
    whether the tip is inside the picture; −1 and NaN where a frame shows nothing. Positions as in the module's text.
    """

    source_frame: NDArray[np.int_]
    time_s: Floats
    lead_position_m: Floats
    lead_px: Floats
    tip_x_px: Floats
    tip_y_px: Floats
    in_frame: NDArray[np.bool_]
    m_per_px: float
    release_s: float
    capture_fps: float
    exposure_s: float

    def write_csv(self, path: Path) -> None:
        """Write one row a frame."""
        names = ("source_frame", "time_s", "lead_position_m", "lead_px", "tip_x_px", "tip_y_px", "in_frame")
        table = np.column_stack([np.asarray(getattr(self, name), dtype=float) for name in names])
        formats = ["%d", "%.9f", "%.9f", "%.6f", "%.6f", "%.6f", "%d"]
        path.parent.mkdir(parents=True, exist_ok=True)
        draft = path.with_name(path.name + ".part")
        np.savetxt(draft, table, fmt=formats, delimiter=",", header=",".join(names), comments="")
        draft.replace(path)


def motion_function(motion: Motion) -> Callable[[Floats], Floats]:
    """Return `motion` as a function; samples are joined by monotone cubics and held before and after."""
    if callable(motion):
        return motion
    from scipy.interpolate import PchipInterpolator

    time_s, lead_position_m = (np.asarray(part, dtype=float) for part in motion)
    cubic = PchipInterpolator(time_s, lead_position_m)

    def position_m(at_s: Floats) -> Floats:
        return np.asarray(cubic(np.clip(at_s, time_s[0], time_s[-1])))

    return position_m


class FrameRenderer:
    """Renders any frame of a recording, in any order; the same frame always comes out the same.

    Parameters
    ----------
    scene, motion
        What is filmed; how the tip (or the body) moves.
    n_frames, capture_fps, exposure_s
        Frame i is exposed from i/capture_fps on for `exposure_s` (None: the scene's share of the frame time).
    seed
        Of everything random: surfaces, shake, noise.
    """

    def __init__(
        self,
        scene: Scene,
        motion: Motion,
        *,
        n_frames: int,
        capture_fps: float,
        exposure_s: float | None = None,
        seed: int = 0,
    ) -> None:
        self.scene, self.n_frames, self.capture_fps, self.seed = scene, n_frames, capture_fps, seed
        self.exposure_s = scene.exposure_fraction / capture_fps if exposure_s is None else exposure_s
        if not 0 < self.exposure_s <= 1 / capture_fps:
            raise ValueError(
                f"An exposure of {self.exposure_s * 1e6:.0f} µs does not fit between frames at {capture_fps:g} a "
                "second; choose a shorter one."
            )
        self._position_m = motion_function(motion)
        self._find_events()
        surfaces, shaking, pixels = (np.random.default_rng([seed, kind]) for kind in range(3))
        self._lay_out(surfaces)
        self._shake_terms = (
            shaking.normal(size=(2, 6)),
            shaking.uniform(0, 2 * np.pi, (2, 6)),
            shaking.uniform(4, 55, 6),
        )
        self._flicker_phase = float(shaking.uniform(0, 2 * np.pi))
        self._prepare_sensor(pixels)

    # --- the motion -------------------------------------------------------------------------------------------------

    def lead_px(self, time_s: Floats) -> Floats:
        """Distance of the tip from the path's start, plane pixels."""
        lead_m = np.asarray(self._position_m(np.asarray(time_s, dtype=float)), dtype=float)
        return np.asarray((self.scene.start_m + lead_m) / self.scene.camera.m_per_px)

    def mid_exposure_s(self, frame: int | NDArray[np.int_]) -> Floats:
        """Middle of the exposure of a frame, s."""
        return np.asarray(np.asarray(frame) / self.capture_fps + self.exposure_s / 2)

    def _find_events(self) -> None:
        """Release (first 10 µm of travel) and, for a tube, when and how fast the tail's end comes out."""
        grid_s = np.arange(0, (self.n_frames + 1) * 10) / (10 * self.capture_fps)
        lead_m = np.asarray(self._position_m(grid_s), dtype=float)
        moving = np.flatnonzero(lead_m > lead_m[0] + 1e-5)
        self.release_s = float(grid_s[moving[0]]) if moving.size else math.inf
        self._exit_s, self._exit_px_s = math.inf, 0.0
        if isinstance(self.scene.subject, Tube):
            out = np.flatnonzero(lead_m >= self.scene.subject.length_m - 1e-4)
            if out.size and out[0] > 1:
                k = out[0]
                self._exit_s = float(grid_s[k])
                speed = (lead_m[k - 1] - lead_m[k - 2]) * 10 * self.capture_fps
                self._exit_px_s = 2 * min(speed, FASTEST_PAYLOAD_M_S / 2) / self.scene.camera.m_per_px

    def _tail_end_px(self, time_s: Floats) -> Floats:
        """Where the tail ends, and the payload is: 2y − L along the path, then on at the speed of the exit."""
        assert isinstance(self.scene.subject, Tube)
        scale = self.scene.camera.m_per_px
        riding = 2 * self.lead_px(time_s) - (self.scene.subject.length_m + self.scene.start_m) / scale
        if not math.isfinite(self._exit_s):
            return np.asarray(riding)
        flying = (self.scene.start_m + self.scene.subject.length_m) / scale + self._exit_px_s * (time_s - self._exit_s)
        return np.asarray(np.where(time_s < self._exit_s, riding, flying))

    def _shake(self, time_s: float) -> tuple[float, float]:
        """Displacement of the whole picture (x, y), px: six slow sinusoids and a kick that rings from release on."""
        if not self.scene.shake_px:
            return 0.0, 0.0
        amplitude, phase, hertz = self._shake_terms
        sway = (amplitude * np.sin(2 * np.pi * hertz * time_s + phase)).sum(axis=1) / math.sqrt(3)
        since = time_s - self.release_s
        if since > 0:
            sway = sway + amplitude[:, 0] * 1.5 * math.exp(-since / 0.04) * math.sin(2 * math.pi * 38 * since)
        return float(self.scene.shake_px * sway[0]), float(self.scene.shake_px * sway[1])

    def _sway_px(self, time_s: float) -> float:
        subject = self.scene.subject
        if not isinstance(subject, Tube) or not subject.wobble_px:
            return 0.0
        since = max(time_s - self.release_s, 0.0)
        grows = min(since / 0.01, 1.0)
        return subject.wobble_px * grows * math.sin(2 * math.pi * subject.wobble_Hz * since)

    # --- what is painted once ---------------------------------------------------------------------------------------

    def _lay_out(self, rng: np.random.Generator) -> None:
        """Coordinates of every pixel along and across the path, the backdrop and the subject's surfaces."""
        scene, camera = self.scene, self.scene.camera
        map_x, map_y = camera.plane_maps()
        ux, uy = scene.direction
        dx, dy = map_x - np.float32(scene.origin[0]), map_y - np.float32(scene.origin[1])
        self._along = (dx * np.float32(ux) + dy * np.float32(uy)).astype(np.float32)
        self._across = (dy * np.float32(ux) - dx * np.float32(uy)).astype(np.float32)
        margin = 4 + math.ceil(4 * scene.shake_px)
        corner = math.floor(map_x.min()) - margin, math.floor(map_y.min()) - margin
        shape = math.ceil(map_y.max()) + margin - corner[1] + 1, math.ceil(map_x.max()) + margin - corner[0] + 1
        self._canvas = textures.backdrop_canvas(scene, rng, shape, corner)
        self._canvas_x, self._canvas_y = map_x - np.float32(corner[0]), map_y - np.float32(corner[1])
        self._still = np.empty(map_x.shape, dtype=np.float32)
        shading.sample_backdrop(self._canvas, self._canvas_x, self._canvas_y, 0.0, 0.0, self._still)
        self._radius_px = scene.subject.diameter_m / 2 / camera.m_per_px
        self._length_px = math.ceil(float(self._along.max())) + 8
        if isinstance(scene.subject, Tube):
            self._prepare_tube(scene.subject, rng)
        else:
            self._surface = textures.ball_surface(scene.subject, rng, self._radius_px)

    def _prepare_tube(self, tube: Tube, rng: np.random.Generator) -> None:
        radius = self._radius_px
        self._wall = textures.film_wall(tube, rng, radius, max(self._length_px, 16))
        self._tail = textures.tail_sums(tube, rng, radius, 4096)
        payload = Ball(diameter_m=1, brightness=tube.payload_brightness * 2, texture=0.1, specular=0.25)
        self._payload_px = tube.payload_diameter_m / 2 / self.scene.camera.m_per_px
        self._payload = textures.ball_surface(payload, rng, max(self._payload_px, 2.0))
        self._profiles = _tip_profiles(tube, radius, self.scene.psf_px)
        self._ghost_across = 1.35 * radius
        reach = radius + 8 + 2.3 * abs(tube.wobble_px) + 4 * self.scene.shake_px
        touched = np.abs(self._across) < reach
        if tube.reflection:
            touched |= np.abs(self._across - self._ghost_across) < reach
        touched &= self._along > -4 - 4 * self.scene.shake_px
        any_in_row = touched.any(axis=1)
        self._first_x = np.where(any_in_row, touched.argmax(axis=1), 0).astype(np.int64)
        last = touched.shape[1] - touched[:, ::-1].argmax(axis=1)
        self._last_x = np.where(any_in_row, last, 0).astype(np.int64)

    def _prepare_sensor(self, rng: np.random.Generator) -> None:
        from scipy.special import ndtri

        sensor, (cx, cy) = self.scene.sensor, self.scene.camera.centre_px
        shape = self._still.shape
        yy, xx = np.mgrid[: shape[0], : shape[1]]
        radius2 = ((xx - cx) ** 2 + (yy - cy) ** 2) / (cx**2 + cy**2)
        pattern = 1 + sensor.fixed_pattern * (rng.standard_normal(shape) + 0.5 * rng.standard_normal((1, shape[1])))
        self._gain = ((1 - self.scene.light.vignetting * radius2) * pattern).astype(np.float32)
        cells = 1 << shading.NORMAL_BITS
        quantiles = ndtri((np.arange(cells) + 0.5) / cells)
        self._normals = (quantiles / quantiles.std()).astype(np.float32)
        steps = 1 if sensor.gamma == 1 else 4096
        self._tone = (np.linspace(0, 1, steps + 1) ** (1 / sensor.gamma)).astype(np.float32)

    # --- one frame --------------------------------------------------------------------------------------------------

    def radiance(self, frame: int) -> NDArray[np.float32]:
        """Light that reaches the sensor in frame `frame`, without noise, shape (height_px, width_px)."""
        begin_s = frame / self.capture_fps
        middle_s = float(self.mid_exposure_s(frame))
        shake = self._shake(middle_s)
        light = np.empty_like(self._still)
        if shake == (0.0, 0.0):
            light[...] = self._still
        else:
            shading.sample_backdrop(self._canvas, self._canvas_x, self._canvas_y, *shake, light)
        ux, uy = self.scene.direction
        shift = shake[0] * ux + shake[1] * uy, shake[1] * ux - shake[0] * uy
        self._hang_door(light, middle_s, shake)
        if isinstance(self.scene.subject, Tube):
            if self._payload_px:
                self._lay_ball(light, self._tail_end_px, begin_s, shift, self._payload_px, self._payload, 0.0)
            self._lay_tube(light, begin_s, middle_s, shift)
        else:
            radius = self._radius_px
            centre = lambda time_s: self.lead_px(time_s) - radius  # noqa: E731
            self._lay_ball(light, centre, begin_s, shift, radius, self._surface, -1e9)
        return light

    def frame(self, frame: int, *, low: float = 0.0, span: float | None = None) -> NDArray[np.uint8 | np.uint16]:
        """Grey levels of frame `frame`, shape (height_px, width_px): black at `low`, full scale `span` above it."""
        sensor = self.scene.sensor
        full = 2**sensor.bit_depth - 1
        out = np.empty(self._still.shape, dtype=np.uint8 if sensor.bit_depth <= 8 else np.uint16)
        well = sensor.full_well_e if sensor.noise else 0.0
        shading.expose(
            self.radiance(frame), self._gain, np.float32(self._lamp(frame)), well, sensor.read_noise_e, self.seed,
            frame, self._normals, self._tone, low, float(full if span is None else span), out,
        )  # fmt: skip
        return out

    def _lamp(self, frame: int) -> float:
        """Brightness of the lamps averaged over the exposure: sin averaged over T is sin at its middle · sinc(fT)."""
        light = self.scene.light
        middle_s = float(self.mid_exposure_s(frame))
        phase = 2 * math.pi * light.flicker_Hz * middle_s + self._flicker_phase
        softened = float(np.sinc(light.flicker_Hz * self.exposure_s))
        return 1 + light.flicker * softened * math.sin(phase)

    def _lay_tube(
        self, light: NDArray[np.float32], begin_s: float, middle_s: float, shift: tuple[float, float]
    ) -> None:
        tube = self.scene.subject
        assert isinstance(tube, Tube)
        times_s = begin_s + self.exposure_s * np.linspace(0, 1, EXPOSURE_PIECES + 1)
        path = self.lead_px(times_s)
        tip = float(self.lead_px(np.array(middle_s)))
        table, first = self._edge_table(path - tip)
        # One pixel at least, so that the tail's texture is as soft at rest as in motion.
        slack = max(0.0, 1.0 - 2 * (path[-1] - path[0])) / 2
        shading.shade_tube(
            light, self._along, self._across, self._first_x, self._last_x, *shift, tip, self._sway_px(middle_s),
            tube.length_m / self.scene.camera.m_per_px, table, first, TABLE_STEP_PX, len(SLOPES), *self._profiles,
            PROFILE_PER_PX, *self._wall, self._tail, 2 * path[0] - slack, 2 * path[-1] + slack,
            float(self._tail_end_px(np.array(middle_s))), tube.tail_opacity, tube.brightness, tube.tail_texture,
            tube.tip_glow, tube.reflection * tube.brightness * 0.25, self._ghost_across,
        )  # fmt: skip

    def _edge_table(self, path_px: Floats) -> tuple[NDArray[np.float32], float]:
        """Coverage for each of SLOPES and, in the last row, the glow of the fold, against distance from the tip."""
        sigma = self.scene.psf_px
        fold_px, fold_sigma = 0.28 * self._radius_px, 0.07 * self._radius_px + sigma
        first = float(path_px.min()) - fold_px - 4.5 * max(sigma * SLOPES[-1], fold_sigma)
        last = float(path_px.max()) + 4.5 * max(sigma * SLOPES[-1], fold_sigma)
        n = math.ceil((last - first) / TABLE_STEP_PX) + 2
        edges = shading.coverage_table(path_px, sigma * SLOPES, first, TABLE_STEP_PX, n)
        width = np.array([fold_sigma])
        front = shading.coverage_table(path_px, width, first, TABLE_STEP_PX, n)
        back = shading.coverage_table(path_px - fold_px, width, first, TABLE_STEP_PX, n)
        return np.concatenate([edges, front - back]), first

    def _lay_ball(
        self,
        light: NDArray[np.float32],
        centre_px: Callable[[Floats], Floats],
        begin_s: float,
        shift: tuple[float, float],
        radius_px: float,
        surface: NDArray[np.float32],
        min_along: float,
    ) -> None:
        """Lay a ball whose centre moves along the path as `centre_px`, averaged over sub-exposures 0.7 px apart."""
        ends = centre_px(begin_s + np.array([0, self.exposure_s]))
        pieces = int(min(max(math.ceil(abs(ends[1] - ends[0]) / 0.7), 3), 80))
        path = centre_px(begin_s + self.exposure_s * (np.arange(pieces) + 0.5) / pieces)
        ux, uy = self.scene.direction
        corners = np.array([[a, b] for a in (path.min(), path.max()) for b in (-1, 1)])
        plane = np.array(self.scene.origin) + corners[:, :1] * np.array([ux, uy])
        reach = (radius_px + 6) * 1.15 + abs(shift[0]) + abs(shift[1])
        rim = np.concatenate([plane + offset for offset in ((reach, reach), (-reach, -reach), (reach, -reach))])
        seen = self.scene.camera.picture_from_plane(rim)
        (x0, y0), (x1, y1) = np.floor(seen.min(axis=0)), np.ceil(seen.max(axis=0))
        height, width = light.shape
        box = np.array([max(x0, 0), max(y0, 0), min(x1, width), min(y1, height)]).astype(np.int64)
        if box[2] > box[0] and box[3] > box[1]:
            sigma = self.scene.psf_px
            shading.shade_ball(
                light, self._along, self._across, *shift, path, radius_px, sigma, surface, box, min_along
            )  # fmt: skip

    def _hang_door(self, light: NDArray[np.float32], middle_s: float, shake: tuple[float, float]) -> None:
        """The door: a plate hinged beside the resting tip, closed across the path, then swung away and quivering."""
        import cv2

        door = self.scene.door
        if door is None:
            return
        opened = (middle_s - self.release_s + door.lead_s) / door.swing_s if math.isfinite(self.release_s) else 0.0
        angles = [_door_angle(opened + part, door.open_deg) for part in (-0.02, 0.0, 0.02)]
        scale = self.scene.camera.m_per_px
        hinge = np.array([self.lead_px(np.array(0.0)) + 2 + door.thickness_m / scale / 2, -1.25 * self._radius_px])
        length, half = door.length_m / scale, door.thickness_m / scale / 2
        plate = np.array([[-half, 0.0], [half, 0.0], [half, length], [-half, length]])
        ux, uy = self.scene.direction
        frame = np.array([[ux, uy], [-uy, ux]])
        masks = []
        for angle in angles:
            turn = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
            plane = (plate @ turn + hinge) @ frame + self.scene.origin + shake
            masks.append(self.scene.camera.picture_from_plane(plane))
        every = np.concatenate(masks)
        low = np.clip(np.floor(every.min(axis=0)).astype(int) - 4, 0, None)
        high = np.clip(np.ceil(every.max(axis=0)).astype(int) + 5, None, [light.shape[1], light.shape[0]])
        if (high <= low).any():
            return
        cover = np.zeros((high[1] - low[1], high[0] - low[0]), dtype=np.float32)
        for outline in masks:
            layer = np.zeros(cover.shape, dtype=np.uint8)
            cv2.fillConvexPoly(layer, np.round((outline - low) * 16).astype(np.int32), 255, cv2.LINE_AA, shift=4)
            cover += layer
        cover = cv2.GaussianBlur(cover / np.float32(255 * len(masks)), (0, 0), self.scene.psf_px)
        region = light[low[1] : high[1], low[0] : high[0]]
        region += cover * (np.float32(door.brightness) - region)

    # --- the truth --------------------------------------------------------------------------------------------------

    def truth(self, source_frame: NDArray[np.int_]) -> Truth:
        """Return what each of `source_frame` shows (−1: nothing), see `Truth`."""
        shown = source_frame >= 0
        time_s = np.where(shown, self.mid_exposure_s(np.maximum(source_frame, 0)), np.nan)
        at_s = np.where(shown, time_s, 0.0)
        along = self.lead_px(at_s)
        ux, uy = self.scene.direction
        subject = self.scene.subject
        sway_length = subject.length_m / self.scene.camera.m_per_px if isinstance(subject, Tube) else 1.0
        across = np.array([self._sway_px(float(t)) for t in at_s]) * np.clip(along / sway_length, 0, 1.5) ** 2
        shake = np.array([self._shake(float(t)) for t in at_s]).reshape(-1, 2)
        plane = np.array(self.scene.origin) + along[:, None] * np.array([ux, uy])
        plane = plane + across[:, None] * np.array([-uy, ux]) + shake
        tip = self.scene.camera.picture_from_plane(plane)
        size = np.array([self.scene.camera.width_px, self.scene.camera.height_px])
        inside = ((tip >= -0.5) & (tip <= size - 0.5)).all(axis=1) & shown
        blank = np.where(shown, 0.0, np.nan)
        lead_m = along * self.scene.camera.m_per_px - self.scene.start_m
        return Truth(
            source_frame=np.asarray(source_frame), time_s=time_s, lead_position_m=lead_m + blank,
            lead_px=along + blank, tip_x_px=tip[:, 0] + blank, tip_y_px=tip[:, 1] + blank, in_frame=inside,
            m_per_px=self.scene.camera.m_per_px, release_s=self.release_s, capture_fps=self.capture_fps,
            exposure_s=self.exposure_s,
        )  # fmt: skip


def _door_angle(opened: float, open_deg: float) -> float:
    """Angle of the door (rad): 0 closed, evenly accelerated, then rebounding a little from its stop."""
    if opened <= 0:
        return 0.0
    if opened < 1:
        return math.radians(open_deg) * opened**2
    after = opened - 1
    return math.radians(open_deg - 12 * math.exp(-after / 1.5) * abs(math.sin(2.2 * after)))


def _tip_profiles(tube: Tube, radius_px: float, psf_px: float) -> tuple[NDArray, NDArray, NDArray, NDArray]:
    """Profiles over the distance v from the axis, PROFILE_PER_PX a pixel: setback, slope row, side and core.

    The tip is flat for |v| < R − ρ and a quarter circle of radius ρ (`tip_roundness` of R) beyond: there its outline
    lies `setback` = ρ − √(ρ² − (|v| − R + ρ)²) behind the foremost point, at a slant 1/cos = ρ/√(…), which picks the
    row of the edge table. `side` is the coverage of the tube's blurred sides, `core` that of the tail.
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


def frame_order(scene: Scene, n_frames: int) -> NDArray[np.int_]:
    """Which frame of the undisturbed recording each frame of the file shows; −1 for rubbish."""
    faults = scene.faults
    order: list[int] = []
    for index in range(n_frames):
        if index not in faults.dropped:
            order += [index] * (2 if index in faults.repeated else 1)
    if faults.wrong_second_frame and len(order) > 2:
        order[1] = order[(2 * len(order)) // 3]
    if faults.corrupt_first_frame and order:
        order[0] = -1
    return np.array(order, dtype=int)


def render_recording(
    scene: Scene,
    motion: Motion,
    *,
    n_frames: int,
    capture_fps: float,
    out_path: Path,
    exposure_s: float | None = None,
    seed: int = 0,
    truth_path: Path | None = None,
) -> Truth:
    """Film `motion` in `scene` and write the recording to `out_path`.

    The ending chooses the form: .mp4, .mov, .mkv, .avi with the scene's codec; .tif, .tiff one stack; no ending a
    folder of numbered pictures (see `encode.write_recording`). `truth_path`, a CSV, should lie outside the folder
    that an experiment's analysis is given. Returns the truth, one entry for each frame of the file.

    Raises
    ------
    ValueError
        If the exposure is longer than the time between frames or the scene cannot be written in that form.
    """
    from vinetrack.laboratory.encode import write_recording

    renderer = FrameRenderer(
        scene, motion, n_frames=n_frames, capture_fps=capture_fps, exposure_s=exposure_s, seed=seed
    )  # fmt: skip
    order = frame_order(scene, n_frames)
    write_recording(renderer, order, Path(out_path))
    truth = renderer.truth(order)
    if truth_path is not None:
        truth.write_csv(Path(truth_path))
    return truth
