"""Motion of a scene over time: tip, end of the tail, sway of the tube, shake of the camera, door; and the lamps.

All positions are in plane pixels (see `camera`), all times in seconds from the start of the first exposure.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from vinetrack.core.records import Floats
from vinetrack.laboratory.scene import Scene, Tube

Motion = Callable[[Floats], Floats] | tuple[Floats, Floats]  # Lead position in metres against time in seconds

FASTEST_PAYLOAD_M_S = 150.0  # Largest speed of a payload that leaves the vine (chosen)

RELEASE_TRAVEL_M = 1e-5  # Travel from which a vine counts as released (chosen)

EVENT_STEPS = 10  # Steps per frame of the search for the release and the exit of the tail (chosen)


def motion_function(motion: Motion) -> Callable[[Floats], Floats]:
    """Return a motion as a function; samples are interpolated by monotone cubics (PCHIP) and constant outside. Returns
    function from times, s, to positions, m. Shapes: motion (n,).
    """
    if callable(motion):
        return motion
    from scipy.interpolate import PchipInterpolator

    time_s, lead_position_m = (np.asarray(part, dtype=float) for part in motion)
    cubic = PchipInterpolator(time_s, lead_position_m)

    def position_m(at_s: Floats) -> Floats:
        return np.asarray(cubic(np.clip(at_s, time_s[0], time_s[-1])))

    return position_m


class SceneMotion:
    """Positions of everything that moves in a scene whose tip, or body, follows a given motion."""

    def __init__(
        self, scene: Scene, motion: Motion, *, n_frames: int, capture_fps: float, exposure_s: float, seed: int
    ) -> None:
        self.scene, self.capture_fps, self.exposure_s = scene, capture_fps, exposure_s
        self._position_m = motion_function(motion)
        grid_s = np.arange(0, (n_frames + 1) * EVENT_STEPS) / (EVENT_STEPS * capture_fps)
        lead_m = np.asarray(self._position_m(grid_s), dtype=float)
        moving = np.flatnonzero(lead_m > lead_m[0] + RELEASE_TRAVEL_M)
        self.release_s = float(grid_s[moving[0]]) if moving.size else math.inf
        self._exit_s, self._exit_px_s = self._find_exit(grid_s, lead_m)
        rng = np.random.default_rng([seed, 1])
        amplitude = rng.normal(size=(2, 6))
        self._amplitude = amplitude / np.sqrt((amplitude**2).sum(axis=1, keepdims=True) / 2)
        self._phase = rng.uniform(0, 2 * np.pi, (2, 6))
        self._hertz = rng.uniform(4, 55, 6)
        self._lamp_phase = float(rng.uniform(0, 2 * np.pi))

    def _find_exit(self, grid_s: Floats, lead_m: Floats) -> tuple[float, float]:
        """Time at which the end of the tail leaves the tip, and its speed there (px/s), twice that of the tip."""
        if not isinstance(self.scene.subject, Tube):
            return math.inf, 0.0
        out = np.flatnonzero(lead_m >= self.scene.subject.length_m - 1e-4)
        if not out.size or out[0] < 2:
            return math.inf, 0.0
        k = out[0]
        lead_speed_m_s = (lead_m[k - 1] - lead_m[k - 2]) / (grid_s[k - 1] - grid_s[k - 2])
        return float(grid_s[k]), min(2 * lead_speed_m_s, FASTEST_PAYLOAD_M_S) / self.scene.camera.m_per_px

    def mid_exposure_s(self, frame: int | NDArray[np.int_]) -> Floats:
        """Return the middle of the exposure of frames."""
        return np.asarray(np.asarray(frame) / self.capture_fps + self.exposure_s / 2)

    def lead_px(self, time_s: Floats | float) -> Floats:
        """Return the distance of the foremost point from the path's start."""
        lead_m = np.asarray(self._position_m(np.asarray(time_s, dtype=float)), dtype=float)
        return np.asarray((self.scene.start_m + lead_m) / self.scene.camera.m_per_px)

    def tail_end_px(self, time_s: Floats | float) -> Floats:
        """Return the position of the tail's end and payload: 2y − L, and at constant speed after the exit."""
        assert isinstance(self.scene.subject, Tube)
        scale = self.scene.camera.m_per_px
        end = (self.scene.subject.length_m + self.scene.start_m) / scale
        riding = 2 * self.lead_px(time_s) - end
        if not math.isfinite(self._exit_s):
            return np.asarray(riding)
        flying = end + self._exit_px_s * (np.asarray(time_s) - self._exit_s)
        return np.asarray(np.where(np.asarray(time_s) < self._exit_s, riding, flying))

    @property
    def sway_length_px(self) -> float:
        """Growth at which the sway is `sway_px`; sway grows with the square of the distance, as for a cantilever."""
        subject = self.scene.subject
        return subject.length_m / self.scene.camera.m_per_px if isinstance(subject, Tube) else 1.0

    def sway_px(self, time_s: float) -> float:
        """Return the lateral displacement of the tube at `sway_length_px`, which starts smoothly at the release."""
        subject = self.scene.subject
        if not isinstance(subject, Tube) or not subject.wobble_px:
            return 0.0
        since = max(time_s - self.release_s, 0.0)
        return subject.wobble_px * min(since / 0.01, 1.0) * math.sin(2 * math.pi * subject.wobble_Hz * since)

    def shake_px(self, time_s: float) -> tuple[float, float]:
        """Return the displacement of the picture (x, y): six sinusoids of joint rms 1, and a damped kick at release.
        Returns plane pixels along x and y.
        """
        if not self.scene.shake_px:
            return 0.0, 0.0
        sway = (self._amplitude * np.sin(2 * np.pi * self._hertz * time_s + self._phase)).sum(axis=1)
        since = time_s - self.release_s
        if since > 0:
            sway = sway + self._amplitude[:, 0] * math.exp(-since / 0.04) * math.sin(2 * math.pi * 38 * since)
        return float(self.scene.shake_px * sway[0]), float(self.scene.shake_px * sway[1])

    def lamp(self, frame: int) -> float:
        """Return the brightness of the lamps averaged over the exposure T: the sine at its middle times sinc(fT)."""
        light = self.scene.light
        phase = 2 * math.pi * light.flicker_Hz * float(self.mid_exposure_s(frame)) + self._lamp_phase
        return 1 + light.flicker * float(np.sinc(light.flicker_Hz * self.exposure_s)) * math.sin(phase)

    def door_angle_rad(self, time_s: float) -> float:
        """Return the angle of the door: 0 closed, then constant acceleration, then a small rebound from its stop."""
        door = self.scene.door
        if door is None or not math.isfinite(self.release_s):
            return 0.0
        opened = (time_s - self.release_s + door.lead_s) / door.swing_s
        if opened <= 0:
            return 0.0
        if opened < 1:
            return math.radians(door.open_deg) * opened**2
        after = opened - 1
        return math.radians(door.open_deg - 12 * math.exp(-after / 1.5) * abs(math.sin(2.2 * after)))

    def tip_plane_px(self, time_s: Floats) -> Floats:
        """Return the tip of the tube or body in plane pixels, with sway and shake. Shapes: time_s (n,) → (n, 2)."""
        along = self.lead_px(time_s)
        across = np.array([self.sway_px(float(t)) for t in time_s]) * np.clip(along / self.sway_length_px, 0, 1.5) ** 2
        shake = np.array([self.shake_px(float(t)) for t in time_s]).reshape(-1, 2)
        ux, uy = self.scene.direction
        plane = (
            np.array(self.scene.origin) + along[:, None] * np.array([ux, uy]) + across[:, None] * np.array([-uy, ux])
        )
        return np.asarray(plane + shake)
