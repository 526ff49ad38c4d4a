"""Recordings with a known leading edge, drawn by code that shares nothing with the package: a truth of another hand.
`plain_scene` draws frames in memory, of a tube that grows straight on or along a curve; `write_video` and
`write_images` put them in files.
"""

from dataclasses import dataclass, replace
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
from scipy.spatial import cKDTree


@dataclass(frozen=True)
class Plan:
    """What is in the picture. Lengths in px, speeds in px a frame, brightness in grey levels of 255."""

    seed: int = 0
    width: int = 960
    height: int = 240
    from_px: tuple[float, float] = (40.0, 120.0)
    angle_deg: float = 0.0
    start_px: float = 60.0
    end_px: float = 840.0
    rest_frames: int = 12
    end_frames: int = 8
    speed: float = 20.0
    rise_frames: float = 8.0
    slows_frames: float = 0.0  # In place of both: the time constant with which it creeps to its end
    exposure: float = 0.2
    radius: float = 30.0
    tip_depth: float = 10.0
    background: float = 70.0
    background_sd: float = 8.0
    film: float = 175.0
    opacity: float = 0.75
    wall_sd: float = 10.0
    tail_sd: float = 10.0
    psf: float = 0.9
    noise: float = 2.0
    flicker: float = 0.0
    shake: float = 0.0
    wobble: float = 0.0
    door: bool = False
    gradient: float = 0.0
    payload: bool = False
    mouth: float = 0.0  # How far beyond the resting tip a launcher covers the tube
    mouth_grey: float = 20.0
    pieces: tuple[tuple[float, float], ...] = ()
    """A curve: (length, turn in degrees, positive from x towards y) one behind the other from `from_px`, where the tube
    points to `angle_deg`; straight where the turn is 0, else an arc of a circle."""


BENT = Plan(
    width=640, height=640, from_px=(40.0, 80.0), rest_frames=10, speed=14.0, exposure=0.3, radius=20.0, tip_depth=8.0,
    film=165.0, tail_sd=8.0, noise=2.5,
)  # fmt: skip
BENDS: dict[str, dict] = {
    "quarter": {"pieces": ((120.0, 0.0), (471.2, 90.0), (90.0, 0.0))},
    "gentle": {"pieces": ((80.0, 0.0), (480.0, 25.0)), "from_px": (30.0, 200.0)},
}  # Curves by name: a quarter circle of 300 px radius, a gentle bend of 1100 px


@dataclass(frozen=True)
class Scene:
    """Frames, shape (n, height, width), uint8, and the true edge at mid-exposure, shape (n,), px from `from_px`; of one
    along a curve its places (x, y), and their arc length, px, along which the edge counts.
    """

    plan: Plan
    frames: np.ndarray
    edge_px: np.ndarray
    moving: np.ndarray
    curve_px: np.ndarray
    arc_px: np.ndarray

    def places(self, along_px: np.ndarray) -> np.ndarray:
        """Places (x, y) of the curve, shape (n, 2), px."""
        return np.stack([np.interp(along_px, self.arc_px, self.curve_px[:, k]) for k in (0, 1)], axis=1)


def curve_of(plan: Plan) -> tuple[np.ndarray, np.ndarray]:
    """Places (x, y) of the curve and their arc length, every 1/20 px along the plan's pieces, px."""
    x, y, angle, done = *plan.from_px, np.radians(plan.angle_deg), 0.0
    pieces, arcs = [np.empty((0, 2))], [np.empty(0)]
    for length, turn in plan.pieces:
        s = np.arange(0, length, 0.05)
        bend = np.radians(turn) / length
        if bend:
            turned = angle + bend * np.append(s, length)
            way = np.stack([np.sin(turned) - np.sin(angle), np.cos(angle) - np.cos(turned)], axis=1) / bend
        else:
            way = np.outer(np.append(s, length), [np.cos(angle), np.sin(angle)])
        way += (x, y)
        pieces.append(way[:-1])
        arcs.append(s + done)
        x, y, angle, done = *way[-1], angle + bend * length, done + length
    return np.concatenate(pieces), np.concatenate(arcs)


def beside_curve(curve: np.ndarray, arc: np.ndarray, xx: np.ndarray, yy: np.ndarray, reach: float):
    """Of every pixel its place along and across the curve by the nearest of its places; far off beyond `reach` px."""
    along, across = np.full(xx.shape, 1e6), np.full(xx.shape, 1e6)
    pixels = np.column_stack([xx.ravel(), yy.ravel()])
    away, nearest = cKDTree(curve).query(pixels, distance_upper_bound=reach)
    near = np.flatnonzero(np.isfinite(away))
    tangent = np.gradient(curve, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    offset, unit = pixels[near] - curve[nearest[near]], tangent[nearest[near]]
    along.flat[near] = arc[nearest[near]] + np.sum(offset * unit, axis=1)
    across.flat[near] = unit[:, 0] * offset[:, 1] - unit[:, 1] * offset[:, 0]
    return along, across


def texture(rng: np.random.Generator, shape: tuple[int, int], scale: float, sd: float) -> np.ndarray:
    """Smooth random brightness of zero mean."""
    field_ = cv2.GaussianBlur(rng.standard_normal(shape).astype(np.float32), (0, 0), scale)
    return (field_ - field_.mean()) / max(float(field_.std()), 1e-6) * sd


def travel(plan: Plan, time: np.ndarray) -> np.ndarray:
    """Edge against time in frames: rest, exponential approach to `speed`, dead stop at `end_px`."""
    t = np.clip(time - plan.rest_frames, 0.0, None)
    run = plan.speed * (t - plan.rise_frames * (1 - np.exp(-t / plan.rise_frames)))
    run = (plan.end_px - plan.start_px) * (0.999 - 0.999 * np.exp(-t / plan.slows_frames)) if plan.slows_frames else run
    return np.minimum(plan.start_px + run, plan.end_px)


def moving(plan: Plan, n_frames: int) -> np.ndarray:
    """Which frames show a tube that moves while they are exposed."""
    later = travel(plan, np.arange(n_frames) + plan.exposure)
    return (later > plan.start_px) & (travel(plan, np.arange(n_frames, dtype=float)) < plan.end_px)


def developed(plan: Plan, picture: np.ndarray, frame: int, phase, rng, light=1.0) -> np.ndarray:
    """A picture as the camera keeps it: blurred, shaken, in this light, with grain."""
    picture = cv2.GaussianBlur(picture.astype(np.float32), (0, 0), plan.psf)
    if plan.shake:
        dx, dy = plan.shake * np.sin(0.55 * frame + phase[0]), plan.shake * np.sin(0.37 * frame + phase[1])
        move, size = np.array([[1, 0, dx], [0, 1, dy]], np.float32), picture.shape[::-1]
        picture = cv2.warpAffine(picture, move, size, flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    picture = picture * light
    white = rng.standard_normal(picture.shape).astype(np.float32)
    grain = white * plan.noise * np.sqrt(np.clip(picture, 1, None) / 100)
    return np.clip(np.rint(picture + grain), 0, 255).astype(np.uint8)


def plain_scene(plan: Plan) -> Scene:
    """Draw the plan."""
    rng, (curve, arc) = np.random.default_rng(plan.seed), curve_of(plan)
    plan = replace(plan, end_px=float(arc[-1]) - 20.0) if plan.pieces else plan
    long_time = np.arange(100_000)
    reached = int(np.argmax(travel(plan, long_time.astype(float)) >= plan.end_px))
    n_frames = (reached if travel(plan, long_time[-1:])[0] >= plan.end_px else 400) + plan.end_frames
    h, w = plan.height, plan.width
    yy, xx = np.mgrid[0:h, 0:w].astype(np.float32)
    if plan.pieces:
        along, across = beside_curve(curve, arc, xx, yy, plan.radius + 8)
    else:
        angle = np.radians(plan.angle_deg)
        along = (xx - plan.from_px[0]) * np.cos(angle) + (yy - plan.from_px[1]) * np.sin(angle)
        across = -(xx - plan.from_px[0]) * np.sin(angle) + (yy - plan.from_px[1]) * np.cos(angle)
    back = plan.background + plan.gradient * (along / w) + texture(rng, (h, w), 2.0, plan.background_sd)
    ticks = (np.mod(along, 27.5) < 2.0) & (np.abs(across - plan.radius - 16) < 6)
    back = np.where(ticks, back - 40, back)
    wall = texture(rng, (h, w), 2.5, plan.wall_sd)
    tail = texture(rng, (64, 8192), 3.0, plan.tail_sd)
    frames = np.empty((n_frames, h, w), np.uint8)
    phase = rng.uniform(0, 2 * np.pi, 4)
    edge = travel(plan, np.arange(n_frames) + plan.exposure / 2)
    speed = travel(plan, np.arange(n_frames) + plan.exposure) - travel(plan, np.arange(n_frames, dtype=float))
    for i in range(n_frames):
        sway = plan.wobble * np.sin(0.4 * i + phase[0]) * np.clip(along / w, 0, 1) if plan.wobble else 0.0
        # What the tube adds to the background while the frame is exposed, where there is some of it
        off, parts = across - sway, int(np.clip(2 * speed[i], 4, 80))
        inside = np.clip(plan.radius - np.abs(off) + 0.5, 0, 1)
        places = [travel(plan, np.array([i + plan.exposure * (j + 0.5) / parts]))[0] for j in range(parts)]
        seen = (inside > 0) & (along < max(places) + 0.5)
        picture = back.astype(float)
        if seen.any():
            rows, columns = (np.flatnonzero(seen.any(axis=axis)) for axis in (1, 0))
            box = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
            ground, s, off = back[box], along[box], off[box]
            bulge = plan.tip_depth * (1 - np.sqrt(np.clip(1 - (off / plan.radius) ** 2, 0, 1)))
            cover, inner = np.zeros(off.shape, np.float32), np.zeros(off.shape, np.float32)
            lines, within = np.clip(off + 32, 0, 63).astype(np.int32), np.abs(off) < 0.6 * plan.radius
            for now in places:
                cover += np.clip(now - bulge - s + 0.5, 0, 1)
                inner += tail[lines, np.mod((s - 2 * now).astype(np.int32), 8192)] * within
            shade = 1 - 0.25 * np.clip(off / plan.radius, -1, 1) ** 2
            tube = plan.opacity * (plan.film * shade + wall[box]) + (1 - plan.opacity) * ground + inner / parts
            picture[box] += cover / parts * inside[box] * (tube - ground)
        if plan.door:
            swing = 14.0 * max(0.0, i - plan.rest_frames + 3)
            panel = (along > plan.start_px + 24 + 0.6 * swing) & (along < plan.start_px + 60 + 0.6 * swing)
            picture = np.where(panel & (across < 60 - swing) & (across > -80), 25.0, picture)
        if plan.mouth:
            cover = np.clip(plan.start_px + plan.mouth - along + 0.5, 0, 1) * (np.abs(across) < plan.radius + 14)
            picture = picture + cover * (plan.mouth_grey - picture)
        if plan.payload and edge[i] > 0.75 * plan.end_px:
            ahead = edge[i] + 3.0 * (edge[i] - 0.75 * plan.end_px)
            picture = np.where((np.abs(along - ahead) < 12) & (np.abs(across) < 10), 230.0, picture)
        frames[i] = developed(plan, picture, i, phase[1:], rng, light=1 + plan.flicker * np.sin(0.9 * i + phase[3]))
    return Scene(plan, frames, edge, moving(plan, n_frames), curve, arc)


def write_video(
    path, frames, codec="libx264", pix_fmt="yuv420p", bit_rate=0, options=None, playback_fps=60, container_options=None
) -> Path:
    """Write frames (n, h, w) as a video whose container claims `playback_fps`."""
    with av.open(str(path), "w", options=container_options or {}) as container:
        stream = container.add_stream(codec, rate=Fraction(playback_fps), options=options or {})
        stream.width, stream.height, stream.pix_fmt = frames.shape[2], frames.shape[1], pix_fmt
        if bit_rate:
            stream.bit_rate = bit_rate
        source = "gray16le" if frames.dtype == np.uint16 else "gray"
        for i, picture in enumerate(frames):
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(picture), format=source)
            frame = frame.reformat(format=pix_fmt)
            frame.pts = i
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return path


def write_images(folder: Path, frames: np.ndarray, suffix: str = ".png", step: int = 1) -> Path:
    """Write frames as a folder of numbered images."""
    folder.mkdir(parents=True, exist_ok=True)
    for i, picture in enumerate(frames):
        cv2.imwrite(str(folder / f"frame_{1 + i * step:04d}{suffix}"), picture)
    return folder
