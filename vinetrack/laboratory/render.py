"""Rendering of a motion as a recording: the frames of a scene, and the true positions in each.

**The leading edge** is the foremost point of the tube on its own centreline. A sharp picture of it would be a step
there; optics and pixel blur that step with a Gaussian of `psf_px`, the exposure blurs it with the tip's own motion. At
constant speed, the half-way point of the blurred step is therefore the tip at mid-exposure, to which the truth refers.
`lead_position_m` is the tip's travel in the plane of growth, `lead_px` its distance from the start of the path in plane
pixels, and `tip_x_px`, `tip_y_px` its position in the picture as recorded, including shake, tilt and distortion. For a
body that moves as a whole, the same holds for its foremost point.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vinetrack.core.records import Floats
from vinetrack.laboratory import shading, textures
from vinetrack.laboratory.scene import Scene, Tube
from vinetrack.laboratory.scene_motion import Motion, SceneMotion
from vinetrack.laboratory.scene_objects import BallLayer, DoorLayer, PathMaps, TubeLayer
from vinetrack.laboratory.targets import lay_target, plane_seen

Image = NDArray[np.float32]

TONE_STEPS = 4096  # Entries of the lookup table of a sensor's gamma (derived)


@dataclass(frozen=True)
class Truth:
    """True positions in a recording. Arrays have shape (n_frames,), one entry per frame of the file, in order.
    `source_frame` is the frame of the undisturbed recording that is shown, `time_s` its mid-exposure; `in_frame` tells
    whether the tip is inside the picture. Frames that show nothing have −1 and NaN.
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
        """Write one row per frame."""
        names = ("source_frame", "time_s", "lead_position_m", "lead_px", "tip_x_px", "tip_y_px", "in_frame")
        table = np.column_stack([np.asarray(getattr(self, name), dtype=float) for name in names])
        formats = ["%d", "%.9f", "%.9f", "%.6f", "%.6f", "%.6f", "%d"]
        path.parent.mkdir(parents=True, exist_ok=True)
        draft = path.with_name(path.name + ".part")
        np.savetxt(draft, table, fmt=formats, delimiter=",", header=",".join(names), comments="")
        draft.replace(path)


class FrameRenderer:
    """Renders any frame of a recording, in any order; the same frame always comes out the same."""

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
        self.scene_motion = SceneMotion(
            scene, motion, n_frames=n_frames, capture_fps=capture_fps, exposure_s=self.exposure_s, seed=seed
        )
        maps = PathMaps(scene)
        self._hang_backdrop(maps)
        rng = np.random.default_rng([seed, 2])
        self._subject: TubeLayer | BallLayer
        if isinstance(scene.subject, Tube):
            self._subject = TubeLayer(self.scene_motion, maps, rng)
        else:
            radius = scene.subject.diameter_m / 2 / scene.camera.m_per_px
            scene_motion = self.scene_motion
            self._subject = BallLayer(
                scene_motion, maps, rng, scene.subject, lambda time_s: scene_motion.lead_px(time_s) - radius
            )
        self._door = DoorLayer(self.scene_motion, scene.door) if scene.door else None
        self._prepare_sensor()

    def _hang_backdrop(self, maps: PathMaps) -> None:
        """Paint the backdrop on plane pixels; project it through the lens once, for frames without shake."""
        margin = 4 + math.ceil(4 * self.scene.shake_px)
        x0, y0 = (math.floor(part.min()) - margin for part in (maps.plane_x, maps.plane_y))
        x1, y1 = (math.ceil(part.max()) + margin for part in (maps.plane_x, maps.plane_y))
        rng = np.random.default_rng([self.seed, 0])
        self._canvas = textures.backdrop_canvas(self.scene, rng, (y1 - y0 + 1, x1 - x0 + 1), (x0, y0))
        self._canvas_x, self._canvas_y = maps.plane_x - np.float32(x0), maps.plane_y - np.float32(y0)
        target, psf_px = self.scene.target, self.scene.psf_px
        if target is not None and self.scene.shake_px:
            across, down = np.meshgrid(np.arange(x0, x1 + 1), np.arange(y0, y1 + 1))
            offset_px = np.stack([across, down], axis=-1) - np.array(self.scene.camera.centre_px)
            self._canvas = lay_target(self._canvas, target, offset_px * self.scene.camera.m_per_px, psf_px)
        self._still = np.empty(maps.plane_x.shape, dtype=np.float32)
        shading.sample_backdrop(self._canvas, self._canvas_x, self._canvas_y, 0.0, 0.0, self._still)
        if target is not None and not self.scene.shake_px:
            self._still = lay_target(self._still, target, plane_seen(self.scene.camera), psf_px)

    def _prepare_sensor(self) -> None:
        """Prepare the gain of every pixel (vignetting, fixed pattern), normal deviates and the gamma table."""
        from scipy.special import ndtri

        rng = np.random.default_rng([self.seed, 3])
        sensor, (cx, cy) = self.scene.sensor, self.scene.camera.centre_px
        height, width = self.scene.camera.height_px, self.scene.camera.width_px
        yy, xx = np.mgrid[:height, :width]
        radius2 = ((xx - cx) ** 2 + (yy - cy) ** 2) / (cx**2 + cy**2)
        spread = rng.standard_normal((height, width)) + 0.5 * rng.standard_normal((1, width))
        falloff = 1 - self.scene.light.vignetting * radius2
        self._gain = (falloff * (1 + sensor.fixed_pattern * spread)).astype(np.float32)
        cells = 1 << shading.NORMAL_BITS
        quantiles = ndtri((np.arange(cells) + 0.5) / cells)
        self._normals = (quantiles / quantiles.std()).astype(np.float32)
        steps = 1 if sensor.gamma == 1 else TONE_STEPS
        self._tone = (np.linspace(0, 1, steps + 1) ** (1 / sensor.gamma)).astype(np.float32)

    def radiance(self, frame: int) -> Image:
        """Return the radiance at the sensor, before lamps, gain and noise. Shape (height, width)."""
        shake = self.scene_motion.shake_px(float(self.scene_motion.mid_exposure_s(frame)))
        light = self._still.copy()
        if shake != (0.0, 0.0):
            shading.sample_backdrop(self._canvas, self._canvas_x, self._canvas_y, *shake, light)
        if self._door is not None:
            self._door.lay(light, frame, shake)
        ux, uy = self.scene.direction
        self._subject.lay(light, frame, (shake[0] * ux + shake[1] * uy, shake[1] * ux - shake[0] * uy))
        return light

    def backdrop(self) -> Image:
        """Radiance of the static scene, shape (height, width)."""
        return self._still.copy()

    def frame(self, frame: int, *, low: float = 0.0, span: float | None = None) -> NDArray[np.uint8 | np.uint16]:
        """Render the grey levels of one frame. Shape (height, width)."""
        return self.expose(self.radiance(frame), frame, low=low, span=span)

    def expose(
        self, light: Image, frame: int, *, low: float = 0.0, span: float | None = None
    ) -> NDArray[np.uint8 | np.uint16]:
        """Convert radiance to grey levels with the lamps, gain and noise of one frame. Shapes: light (height, width) →
        (height, width).
        """
        sensor = self.scene.sensor
        out = np.empty(light.shape, dtype=np.uint8 if sensor.bit_depth <= 8 else np.uint16)
        well_e = sensor.full_well_e if sensor.noise else 0.0
        full = float(2**sensor.bit_depth - 1 if span is None else span)
        shading.expose(
            light, self._gain, self.scene_motion.lamp(frame), well_e, sensor.read_noise_e, self.seed, frame,
            self._normals, self._tone, low, full, out,
        )  # fmt: skip
        return out

    def truth(self, source_frame: NDArray[np.int_]) -> Truth:
        """Return the true positions in given frames. Shapes: source_frame (n,)."""
        shown = source_frame >= 0
        blank = np.where(shown, 0.0, np.nan)
        time_s = self.scene_motion.mid_exposure_s(np.maximum(source_frame, 0))
        along = self.scene_motion.lead_px(time_s)
        camera = self.scene.camera
        tip = camera.picture_from_plane(self.scene_motion.tip_plane_px(time_s))
        inside = ((tip >= -0.5) & (tip <= np.array([camera.width_px, camera.height_px]) - 0.5)).all(axis=1)
        return Truth(
            source_frame=np.asarray(source_frame),
            time_s=time_s + blank,
            lead_position_m=along * camera.m_per_px - self.scene.start_m + blank,
            lead_px=along + blank,
            tip_x_px=tip[:, 0] + blank,
            tip_y_px=tip[:, 1] + blank,
            in_frame=inside & shown,
            m_per_px=camera.m_per_px,
            release_s=self.scene_motion.release_s,
            capture_fps=self.capture_fps,
            exposure_s=self.exposure_s,
        )


def frame_order(scene: Scene, n_frames: int) -> NDArray[np.int_]:
    """Return the frame of the undisturbed recording that each frame of the file shows; −1 for a corrupt frame. Shape
    (n_frames of the file,).
    """
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
    """Film `motion` in `scene` and write the recording to `out_path`. The ending sets the form: .mp4, .mov, .mkv, .avi
    a film with the scene's codec; .tif, .tiff one stack; no ending a folder of numbered images (see
    `encode.write_recording`).
    """
    from vinetrack.laboratory.encode import write_recording

    renderer = FrameRenderer(
        scene, motion, n_frames=n_frames, capture_fps=capture_fps, exposure_s=exposure_s, seed=seed
    )
    order = frame_order(scene, n_frames)
    write_recording(renderer, order, Path(out_path))
    truth = renderer.truth(order)
    if truth_path is not None:
        truth.write_csv(Path(truth_path))
    return truth
