"""What is filmed and how: camera, calibration target, objects, light, sensor, encoding; scenes by name.

A pinhole with radial distortion looks at a plane that may be tilted. Pixel centres have whole-number coordinates, x to
the right and y down. *Plane pixels* are metres in the plane divided by `m_per_px`, with the origin of the plane at the
centre of the picture: without tilt and distortion they are the pixels of the picture. Lengths ending in `_px` are in
plane pixels, brightness is radiance as a fraction of the sensor's full scale.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from vinetrack.core.records import Floats


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
        # Newton's method on the radius r(1 + k1 r² + k2 r⁴) = r_bent; ten steps (chosen)
        bent = np.sqrt((distorted**2).sum(axis=-1, keepdims=True))
        radius = bent.copy()
        for _ in range(10):
            excess = radius * (1 + self.k1 * radius**2 + self.k2 * radius**4) - bent
            radius -= excess / (1 + 3 * self.k1 * radius**2 + 5 * self.k2 * radius**4)
        straight = distorted * np.divide(radius, bent, out=np.ones_like(radius), where=bent > 0)
        ray = np.concatenate([straight, np.ones((*distorted.shape[:-1], 1))], axis=-1)
        normal = self.rotation[:, 2]
        depth = normal[2] * self.focal_px / (ray @ normal)
        spatial = ray * depth[..., None] - np.array([0.0, 0.0, self.focal_px])
        return np.asarray(spatial @ self.rotation[:, :2] + self.centre_px)

    def pixels(self) -> Floats:
        """Return the coordinates of all pixels, shape (height_px, width_px, 2)."""
        return np.stack(np.meshgrid(np.arange(self.width_px), np.arange(self.height_px)), axis=-1).astype(float)


PATTERN_PX = 120  # Side of a square in the stored pattern of a ChArUco board (chosen)


@dataclass(frozen=True, kw_only=True)
class Target:
    """A board in the plane of growth."""

    kind: str = "charuco"
    squares: Sequence[int] = (12, 5)
    square_m: float = 0.020
    marker_m: float = 0.015
    dictionary: str = "DICT_4X4_100"
    centre_m: tuple[float, float] = (0.0, 0.0)
    angle_deg: float = 0.0
    margin: float = 0.5
    black: float = 0.06
    white: float = 0.70

    def corners_m(self) -> Floats:
        """Inner corners in the plane (x, y), row by row from the board's top left, shape (n, 2), m."""
        across, down = np.meshgrid(np.arange(1, self.squares[0]), np.arange(1, self.squares[1]))
        board = np.column_stack([across.ravel(), down.ravel()]) - np.array(self.squares) / 2
        return np.asarray(board * self.square_m @ self._turn().T + np.array(self.centre_m))

    def board_squares(self, plane_m: Floats) -> Floats:
        """Express points of the plane in squares of the board. Shapes: plane_m (..., 2) → (..., 2)."""
        along_board = (plane_m - np.array(self.centre_m)) @ self._turn()
        return np.asarray(along_board / self.square_m + np.array(self.squares) / 2)

    def pattern(self) -> NDArray[np.uint8]:
        """Printed pattern, 1 where white: PATTERN_PX per square for a ChArUco board, 1 for a checkerboard."""
        if self.kind != "charuco":
            rows, columns = np.mgrid[: self.squares[1], : self.squares[0]]
            return ((rows + columns) % 2).astype(np.uint8)
        words = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, self.dictionary))
        board = cv2.aruco.CharucoBoard(self.squares, self.square_m, self.marker_m, words)
        size = (self.squares[0] * PATTERN_PX, self.squares[1] * PATTERN_PX)
        return np.asarray(board.generateImage(size, marginSize=0, borderBits=1) > 127).astype(np.uint8)

    def _turn(self) -> Floats:
        angle = math.radians(self.angle_deg)
        return np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])


@dataclass(frozen=True, kw_only=True)
class Tube:
    """An everting tube from the side; `opacity` is of both layers at its middle, `brightness` of opaque film."""

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
    """The latched door before the tip. It starts to swing `lead_s` before the tip moves and is open after `swing_s`."""

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
    """Noise and quantisation. `fixed_pattern`: relative scatter of pixel gains."""

    full_well_e: float = 9000.0
    read_noise_e: float = 28.0
    fixed_pattern: float = 0.004
    bit_depth: int = 8
    colour: bool = False
    noise: bool = True


@dataclass(frozen=True, kw_only=True)
class Encoding:
    """How the file is written: `codec` h264 (levels of 16…235) or ffv1 (without loss). With `bitrate_Mbit_s` the bit
    rate is held near that value at 60 frames per second, as in cameras; without it `crf` applies.
    """

    codec: str = "h264"
    bitrate_Mbit_s: float | None = None
    crf: int = 18
    gop: int = 30


@dataclass(frozen=True, kw_only=True)
class Scene:
    """Everything that defines a recording except the motion and the frame rate. `growth_angle_deg` is the direction of
    growth in the picture, from +x (right) towards +y (down).
    """

    camera: Camera = field(default_factory=Camera)
    subject: Tube | Ball = field(default_factory=Tube)
    door: Door | None = field(default_factory=Door)
    backdrop: Backdrop = field(default_factory=Backdrop)
    light: Light = field(default_factory=Light)
    sensor: Sensor = field(default_factory=Sensor)
    encoding: Encoding = field(default_factory=Encoding)
    growth_angle_deg: float = 0.0
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
        """Start of the path, plane pixels: 60 px inside the border, upstream of the middle."""
        cx, cy = self.camera.centre_px
        ux, uy = self.direction
        reach = min((cx - 60) / abs(ux) if abs(ux) > 1e-9 else math.inf, (cy - 60) / abs(uy) if abs(uy) > 1e-9 else 1e9)
        return cx - ux * reach, cy - uy * reach


def preset(name: str) -> Scene:
    """Return a scene by name: `clean`, `demo`, or a harder one."""
    plain = Backdrop(brightness=0.1, gradient=0, texture=0, ruler=False, launcher=False, clutter=False)
    opaque = Tube(opacity=1.0, brightness=0.8, texture=0, tail_texture=0, tail_opacity=0, specular=0, tip_glow=0)
    raw, lossless = Sensor(noise=False, fixed_pattern=0, bit_depth=16), Encoding(codec="ffv1")
    clean = Scene(subject=opaque, door=None, backdrop=plain, light=Light(vignetting=0), sensor=raw, encoding=lossless)
    demo = Scene()

    def hard(**changes: Any) -> Scene:
        """A scene at the bit rate of a high-speed camera: 60 Mbit/s at 1280 × 720, in proportion to the area."""
        scene = replace(demo, **changes)
        rate = 60.0 * scene.camera.width_px * scene.camera.height_px / (1280 * 720)
        return replace(scene, encoding=Encoding(bitrate_Mbit_s=rate))

    faint = Tube(opacity=0.22, brightness=0.42, texture=0.08, specular=0.03, tip_glow=0.03)
    dark = Tube(opacity=0.75, brightness=0.10, texture=0.2, specular=0.08, tip_glow=0.02)
    bright_wall = Backdrop(brightness=0.42, gradient=0.55)
    upright, plain_wall = Camera(width_px=384, height_px=800, m_per_px=1 / 3660), Backdrop(launcher=False)
    ball = Scene(camera=upright, subject=Ball(), door=None, growth_angle_deg=90.0, backdrop=plain_wall)
    dark_wall = Backdrop(brightness=0.07, gradient=-0.04, texture=0.3, launcher=False)
    scenes = {
        "clean": clean,
        "demo": demo,
        "door": hard(door=Door(brightness=0.85, length_m=0.05, thickness_m=0.006, swing_s=0.03)),
        "wobble": hard(subject=Tube(wobble_px=7.0)),
        "flicker": hard(light=Light(flicker=0.15)),
        "low_contrast": hard(subject=faint, backdrop=Backdrop(brightness=0.22, gradient=0.0, texture=0.08)),
        "dark_tube": hard(subject=dark, backdrop=Backdrop(brightness=0.55, gradient=-0.1)),
        "half_frame_exposure": hard(exposure_fraction=0.5),
        "contrast_reversal": hard(subject=Tube(opacity=0.65, brightness=0.42, specular=0.05), backdrop=bright_wall),
        "shake": hard(shake_px=0.8),
        "reflections": hard(subject=Tube(specular=0.5, reflection=0.3)),
        "noisy": hard(sensor=Sensor(full_well_e=1500, read_noise_e=35)),
        "strong_tail": hard(subject=Tube(tail_texture=0.6, tail_opacity=0.6, opacity=0.3)),
        "diagonal": hard(camera=Camera(width_px=640, height_px=640), growth_angle_deg=37.0),
        "downward": hard(camera=Camera(width_px=320, height_px=960), growth_angle_deg=90.0),
        "payload": hard(subject=Tube(payload_diameter_m=0.014)),
        "light_stream": replace(demo, encoding=Encoding(crf=26, gop=250)),
        "twelve_bit": replace(demo, sensor=Sensor(bit_depth=12), encoding=lossless),
        "colour": hard(sensor=Sensor(colour=True)),
        "falling_ball": ball,
        "dark_ball": replace(ball, subject=Ball(brightness=0.06, texture=0.2, specular=0.8), backdrop=dark_wall),
    }
    return scenes[name]
