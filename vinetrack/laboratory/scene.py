"""Settings and presets of a scene in the virtual laboratory: objects, light, camera, sensor, recording.

Brightness is radiance as a fraction of the sensor's full scale. Lengths ending in `_px` are in plane pixels (see
`camera`). `preset(name)` makes a preset; `dataclasses.replace` changes it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

from vinetrack.laboratory.camera import Camera
from vinetrack.laboratory.targets import Target


@dataclass(frozen=True, kw_only=True)
class Tube:
    """An everting tube, seen from the side. `opacity` is that of the everted wall, both layers, at the middle of the
    tube; `brightness` that of opaque film.
    """

    diameter_m: float = 0.024
    length_m: float = 0.280
    opacity: float = 0.50
    brightness: float = 0.80
    texture: float = 0.12
    tail_texture: float = 0.18
    tail_opacity: float = 0.35
    tail_width: float = 0.45
    specular: float = 0.20
    tip_roundness: float = 0.6
    tip_glow: float = 0.08
    reflection: float = 0.0
    wobble_px: float = 0.0
    wobble_Hz: float = 22.0
    payload_diameter_m: float = 0.0
    payload_brightness: float = 0.06


@dataclass(frozen=True, kw_only=True)
class Ball:
    """A body that moves as a whole (travel ratio 1): a textured sphere with two highlights of the lamps."""

    diameter_m: float = 0.020
    brightness: float = 0.45
    texture: float = 0.25
    specular: float = 0.5


@dataclass(frozen=True, kw_only=True)
class Door:
    """The latched door in front of the tip. It starts to swing `lead_s` before the tip moves and is open after
    `swing_s`.
    """

    brightness: float = 0.55
    length_m: float = 0.034
    thickness_m: float = 0.003
    lead_s: float = 0.004
    swing_s: float = 0.012
    open_deg: float = 105.0


@dataclass(frozen=True, kw_only=True)
class Backdrop:
    """The background: brightness, its increase along the path, contrast of its texture, and objects in it."""

    brightness: float = 0.25
    gradient: float = 0.05
    texture: float = 0.12
    ruler: bool = True
    launcher: bool = True
    clutter: bool = True


@dataclass(frozen=True, kw_only=True)
class Light:
    """Flicker of the lamps (relative amplitude, at twice the mains frequency) and vignetting at the corners."""

    flicker: float = 0.0
    flicker_Hz: float = 100.0
    vignetting: float = 0.10


@dataclass(frozen=True, kw_only=True)
class Sensor:
    """Noise and quantisation. `fixed_pattern`: relative scatter of pixel gains; `gamma` 1: linear levels."""

    full_well_e: float = 9000.0
    read_noise_e: float = 28.0
    fixed_pattern: float = 0.004
    bit_depth: int = 8
    gamma: float = 1.0
    colour: bool = False
    noise: bool = True


@dataclass(frozen=True, kw_only=True)
class Encoding:
    """How the file is written; the ending of the path sets the container or image format. `codec`: h264, ffv1, mjpeg or
    raw. With `bitrate_Mbit_s` the bit rate is held near that value at `container_fps`, as in cameras; without it `crf`
    applies. `limited_range` maps full scale to 16…235, as is usual for video.
    """

    codec: str = "h264"
    bitrate_Mbit_s: float | None = None
    crf: int = 18
    gop: int = 30
    preset: str = "superfast"
    container_fps: int = 60
    limited_range: bool = True


@dataclass(frozen=True, kw_only=True)
class Faults:
    """Faults of a recording."""

    dropped: tuple[int, ...] = ()
    repeated: tuple[int, ...] = ()
    wrong_second_frame: bool = False
    corrupt_first_frame: bool = False
    keep_fraction: float = 1.0
    damaged_fraction: float = 0.0


@dataclass(frozen=True, kw_only=True)
class Scene:
    """Everything that defines a recording except the motion and the frame rate. `growth_angle_deg` is the direction of
    growth in the picture, from +x (right) towards +y (down).
    """

    camera: Camera = field(default_factory=Camera)
    subject: Tube | Ball = field(default_factory=Tube)
    door: Door | None = field(default_factory=Door)
    target: Target | None = None
    backdrop: Backdrop = field(default_factory=Backdrop)
    light: Light = field(default_factory=Light)
    sensor: Sensor = field(default_factory=Sensor)
    encoding: Encoding = field(default_factory=Encoding)
    faults: Faults = field(default_factory=Faults)
    growth_angle_deg: float = 0.0
    origin_px: tuple[float, float] | None = None
    start_m: float = 0.012
    psf_px: float = 0.75
    shake_px: float = 0.0
    exposure_fraction: float = 0.10

    @property
    def direction(self) -> tuple[float, float]:
        """Unit vector of growth in the plane, (x, y)."""
        angle = math.radians(self.growth_angle_deg)
        return math.cos(angle), math.sin(angle)

    @property
    def origin(self) -> tuple[float, float]:
        """Start of the path, plane pixels: `origin_px`, or 60 px inside the border, upstream of the middle."""
        if self.origin_px is not None:
            return self.origin_px
        cx, cy = self.camera.centre_px
        ux, uy = self.direction
        reach = min((cx - 60) / abs(ux) if abs(ux) > 1e-9 else math.inf, (cy - 60) / abs(uy) if abs(uy) > 1e-9 else 1e9)
        return cx - ux * reach, cy - uy * reach


def _camera_like(scene: Scene) -> Scene:
    """Set the bit rate to that of a high-speed camera: 60 Mbit/s at 1280 × 720, in proportion to the picture's area."""
    rate = 60.0 * scene.camera.width_px * scene.camera.height_px / (1280 * 720)
    return replace(scene, encoding=replace(scene.encoding, bitrate_Mbit_s=rate))


def _presets() -> dict[str, Scene]:
    """All presets by name; `clean` and `demo` come first, harder ones follow."""
    plain = Backdrop(brightness=0.1, gradient=0, texture=0, ruler=False, launcher=False, clutter=False)
    opaque = Tube(
        opacity=1.0, brightness=0.8, texture=0, tail_texture=0, tail_opacity=0, specular=0, tip_glow=0
    )  # fmt: skip
    clean = Scene(
        subject=opaque,
        door=None,
        backdrop=plain,
        light=Light(vignetting=0),
        sensor=Sensor(noise=False, fixed_pattern=0, bit_depth=16),
        encoding=Encoding(codec="ffv1"),
    )
    demo = Scene()
    hard = _camera_like(demo)
    tube = Tube()
    square = Camera(width_px=640, height_px=640)
    return {
        "clean": clean,
        "demo": demo,
        "door": replace(hard, door=Door(brightness=0.85, length_m=0.05, thickness_m=0.006, swing_s=0.03)),
        "wobble": replace(hard, subject=replace(tube, wobble_px=7.0)),
        "flicker": replace(hard, light=Light(flicker=0.15)),
        "low_contrast": replace(
            hard,
            subject=replace(tube, opacity=0.22, brightness=0.42, texture=0.08, specular=0.03, tip_glow=0.03),
            backdrop=Backdrop(brightness=0.22, gradient=0.0, texture=0.08),
        ),
        "dark_tube": replace(
            hard,
            subject=replace(tube, opacity=0.75, brightness=0.10, texture=0.2, specular=0.08, tip_glow=0.02),
            backdrop=Backdrop(brightness=0.55, gradient=-0.1),
        ),
        "half_frame_exposure": replace(hard, exposure_fraction=0.5),
        "contrast_reversal": replace(
            hard,
            subject=replace(tube, opacity=0.65, brightness=0.42, specular=0.05),
            backdrop=Backdrop(brightness=0.42, gradient=0.55),
        ),
        "shake": replace(hard, shake_px=0.8),
        "reflections": replace(hard, subject=replace(tube, specular=0.5, reflection=0.3)),
        "noisy": replace(hard, sensor=Sensor(full_well_e=1500, read_noise_e=35)),
        "strong_tail": replace(hard, subject=replace(tube, tail_texture=0.6, tail_opacity=0.6, opacity=0.3)),
        "distorted": replace(hard, camera=Camera(focal_px=1400, k1=-0.25, k2=0.08)),
        "tilted": replace(hard, camera=Camera(tilt_x_deg=2.0, tilt_y_deg=-4.0, k1=-0.15)),
        "diagonal": _camera_like(replace(demo, camera=square, growth_angle_deg=37.0)),
        "downward": _camera_like(replace(demo, camera=Camera(width_px=320, height_px=960), growth_angle_deg=90.0)),
        "payload": replace(hard, subject=replace(tube, payload_diameter_m=0.014)),
        "light_stream": replace(demo, encoding=Encoding(crf=26, gop=250)),
        "twelve_bit": replace(demo, sensor=Sensor(bit_depth=12), encoding=Encoding(codec="ffv1")),
        "colour": replace(hard, sensor=Sensor(colour=True)),
        "falling_ball": Scene(
            camera=Camera(width_px=384, height_px=800, m_per_px=1 / 3660),
            subject=Ball(),
            door=None,
            growth_angle_deg=90.0,
            backdrop=Backdrop(launcher=False),
        ),
        "dark_ball": Scene(
            camera=Camera(width_px=384, height_px=800, m_per_px=1 / 3660),
            subject=Ball(brightness=0.06, texture=0.2, specular=0.8),
            door=None,
            growth_angle_deg=90.0,
            backdrop=Backdrop(brightness=0.07, gradient=-0.04, texture=0.3, launcher=False),
        ),
    }


PRESETS = tuple(_presets())  # Names of the presets


def preset(name: str) -> Scene:
    """Return a scene by name (see `PRESETS`)."""
    scenes = _presets()
    if name not in scenes:
        raise ValueError(f"No scene is called {name!r}; choose one of {', '.join(scenes)}.")
    return scenes[name]
