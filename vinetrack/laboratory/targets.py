"""Exactly projected pictures and clips of a calibration target, ChArUco board or checkerboard, in the plane
of growth.

Every picture pixel is sampled at POINTS points, each traced through lens and tilt to the plane, where it is black or
white. Corners are therefore exactly where geometry puts them, and no picture is interpolated.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from vinetrack.core.records import Floats
from vinetrack.laboratory.camera import Camera

if TYPE_CHECKING:
    from vinetrack.laboratory.scene import Scene

Image = NDArray[np.float32]

POINTS, LATTICE = 89, 55  # Points in a pixel, on a Fibonacci lattice (derived)
PATTERN_PX = 120  # Side of a square in the stored pattern of a ChArUco board (chosen)


@dataclass(frozen=True, kw_only=True)
class Target:
    """A board in the plane of growth."""

    kind: str = "charuco"
    squares: tuple[int, int] = (12, 5)
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
        import cv2

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


@njit(cache=True)
def _paint_board(
    board: Floats, step_x: Floats, step_y: Floats, pattern: NDArray[np.uint8], per_square: int, margin: float,
    black: float, white: float, light: Image, share: Image,
) -> None:  # fmt: skip
    """Radiance of the board times its share of each pixel, and that share, into `light` and `share`. `board` are
    squares counted at each pixel's middle, shape (height, width, 2); `step_x`, `step_y` their change over a pixel,
    which is even enough within one: lens and tilt bend it by 10⁻⁵ px at most.
    """
    rows, columns = pattern.shape
    across, down = columns / per_square, rows / per_square
    for y in range(board.shape[0]):
        for x in range(board.shape[1]):
            seen, on = 0.0, 0
            for i in range(POINTS):
                dx = (i + 0.5) / POINTS - 0.5
                dy = ((i * LATTICE) % POINTS + 0.5) / POINTS - 0.5
                bx = board[y, x, 0] + dx * step_x[y, x, 0] + dy * step_y[y, x, 0]
                by = board[y, x, 1] + dx * step_x[y, x, 1] + dy * step_y[y, x, 1]
                if bx < -margin or by < -margin or bx >= across + margin or by >= down + margin:
                    continue
                on += 1
                inside = 0 <= bx < across and 0 <= by < down
                if inside and pattern[int(by * per_square), int(bx * per_square)] == 0:
                    seen += black
                else:
                    seen += white
            light[y, x] = seen / POINTS
            share[y, x] = on / POINTS


def plane_seen(camera: Camera) -> Floats:
    """Return the point of the plane at the centre of each pixel, relative to the optical axis; (height, width, 2), m.
    Shape (height, width, 2).
    """
    grid = np.stack(np.meshgrid(np.arange(camera.width_px), np.arange(camera.height_px)), axis=-1).astype(float)
    return np.asarray((camera.plane_from_picture(grid) - np.array(camera.centre_px)) * camera.m_per_px)


def lay_target(light: Image, target: Target, plane_m: Floats, psf_px: float) -> Image:
    """Lay a target over a picture where pixels see it, blurred by the optics. Shapes: light (height, width); plane_m
    (height, width, 2) → (height, width).
    """
    import cv2

    painted, share = np.zeros(light.shape, np.float32), np.zeros(light.shape, np.float32)
    board = target.board_squares(plane_m)
    step_y, step_x = np.gradient(board, axis=0), np.gradient(board, axis=1)
    per_square = PATTERN_PX if target.kind == "charuco" else 1
    _paint_board(
        board, step_x, step_y, target.pattern(), per_square, target.margin, target.black, target.white, painted, share
    )
    painted, share = (np.asarray(cv2.GaussianBlur(part, (0, 0), psf_px), np.float32) for part in (painted, share))
    return np.asarray(light * (1 - share) + painted, dtype=np.float32)


class TargetRenderer:
    """Frames of a target that is still, or changes from frame to frame as `moves` specifies. Stands in for
    `render.FrameRenderer` where a file is written. `moves` lists, for each frame, what changes: fields of `Target` such
    as `{"centre_m": (0.01, 0)}` or of `Camera` such as `{"tilt_x_deg": 10}`.
    """

    def __init__(
        self, target: Target, scene: Scene, *, seed: int = 0, moves: tuple[dict[str, Any], ...] = (), ramp: float = 0.25
    ) -> None:
        from vinetrack.laboratory.render import FrameRenderer

        self.scene, self.seed, self.capture_fps = scene, seed, 60.0
        self.exposure_s = 1e-3
        self._target, self._moves, self._ramp = target, moves, ramp
        self._empty = FrameRenderer(
            scene, np.zeros_like, n_frames=1, capture_fps=self.capture_fps, exposure_s=self.exposure_s, seed=seed
        )
        self._still: Image | None = None

    def _radiance(self, frame: int) -> Image:
        changes = self._moves[frame] if self._moves else {}
        if self._still is not None and not changes:
            return self._still
        on_target = {key: value for key, value in changes.items() if hasattr(self._target, key)}
        on_camera = {key: value for key, value in changes.items() if key not in on_target}
        plane_m = plane_seen(replace(self.scene.camera, **on_camera))
        light = lay_target(self._empty.backdrop(), replace(self._target, **on_target), plane_m, self.scene.psf_px)
        slope = 1 + self._ramp * (np.linspace(0, 1, light.shape[1], dtype=np.float32)[None, :] - 0.5)
        light = np.asarray(light * slope, dtype=np.float32)
        if not changes:
            self._still = light
        return light

    def frame(self, frame: int, *, low: float = 0.0, span: float | None = None) -> NDArray[np.uint8 | np.uint16]:
        """Render the grey levels of one frame. Shape (height, width)."""
        return self._empty.expose(self._radiance(frame), frame, low=low, span=span)


def _target_scene(scene: Scene) -> Scene:
    """Return `scene` without launcher, door and ruler, as for the picture of a target."""
    backdrop = replace(scene.backdrop, launcher=False, ruler=False, clutter=False)
    return replace(scene, backdrop=backdrop, door=None)


def render_target(target: Target, scene: Scene, *, seed: int = 0, **settings: Any) -> NDArray[np.uint8 | np.uint16]:
    """Render one picture of a target through the camera of a scene, with its noise. The truth is `scene.camera`:
    `plane_from_picture`, times `m_per_px`, says where in the plane each pixel looks. Shape (height, width).
    """
    return TargetRenderer(target, _target_scene(scene), seed=seed, **settings).frame(0)


def render_calibration_clip(
    target: Target,
    scene: Scene,
    n_frames: int,
    out_path: Path,
    *,
    seed: int = 0,
    moves: tuple[dict[str, Any], ...] = (),
) -> None:
    """Write a clip (or, by the path's ending, a folder of pictures) of `target`; see `TargetRenderer` for `moves`."""
    from vinetrack.laboratory.encode import write_recording

    renderer = TargetRenderer(target, _target_scene(scene), seed=seed, moves=moves)
    write_recording(renderer, np.arange(n_frames), Path(out_path))
