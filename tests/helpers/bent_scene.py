"""Recordings of a tube that grows along a curve, drawn by code that shares nothing with the package.

The curve is a polyline sampled every 1/20 px from its own formula (lines and arcs of circles), the arc length that of
those arcs; every pixel knows its nearest place. `bent_scene` draws frames in memory.
"""

from dataclasses import dataclass, replace

import numpy as np
from plain_scene import Plan, Scene, developed, moving, texture, travel
from scipy.spatial import cKDTree


@dataclass(frozen=True)
class BentPlan(Plan):
    """What is in the picture, as in a plain one: `pieces` are (length, turn in degrees, positive from x towards y) one
    behind the other from `from_px`, where the tube points to `angle_deg`: straight where the turn is 0, else an arc of
    a circle.
    """

    pieces: tuple[tuple[float, float], ...] = ()
    width: int = 640
    height: int = 640
    from_px: tuple[float, float] = (40.0, 80.0)
    rest_frames: int = 10
    speed: float = 14.0
    exposure: float = 0.3
    radius: float = 20.0
    tip_depth: float = 8.0
    film: float = 165.0
    tail_sd: float = 8.0
    noise: float = 2.5


@dataclass(frozen=True)
class BentScene(Scene):
    """As a plain scene, the true edge as arc length from the curve's beginning; and the curve: places (x, y) and their
    arc length, px.
    """

    curve_px: np.ndarray
    arc_px: np.ndarray

    def places(self, along_px: np.ndarray) -> np.ndarray:
        """Places (x, y) of the curve, shape (n, 2), px."""
        return np.stack([np.interp(along_px, self.arc_px, self.curve_px[:, k]) for k in (0, 1)], axis=1)


BENDS: dict[str, dict] = {
    "quarter": {"pieces": ((120.0, 0.0), (471.2, 90.0), (90.0, 0.0))},
    "s_shape": {"pieces": ((80.0, 0.0), (260.0, 60.0), (260.0, -60.0), (80.0, 0.0)), "from_px": (30.0, 120.0)},
    "gentle": {"pieces": ((80.0, 0.0), (480.0, 25.0)), "from_px": (30.0, 200.0)},
    "kink": {"pieces": ((260.0, 0.0), (110.0, 70.0), (240.0, 0.0)), "from_px": (40.0, 120.0)},
}
"""Curves by name: a quarter circle of 300 px radius, an S of 248 px, a gentle bend of 1100 px, a sharp one of 90 px."""


def bent_scene(plan: BentPlan) -> BentScene:
    """Draw the plan: a textured tube with a rounded tip, blurred along its way by the exposure, over a still ground."""
    rng = np.random.default_rng(plan.seed)
    # Places (x, y) of the curve and their arc length, every 1/20 px along the plan's pieces
    x, y, angle, done = *plan.from_px, np.radians(plan.angle_deg), 0.0
    pieces, arcs = [], []
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
    curve, arc = np.concatenate(pieces), np.concatenate(arcs)
    plan = replace(plan, end_px=float(arc[-1]) - 20.0)
    n = int(np.argmax(travel(plan, np.arange(5000.0)) >= plan.end_px)) + plan.end_frames
    h, w = plan.height, plan.width
    yy, xx = np.mgrid[0:h, 0:w].astype(np.float32)
    pixels = np.column_stack([xx.ravel(), yy.ravel()])
    away, nearest = cKDTree(curve).query(pixels, distance_upper_bound=plan.radius + 8)
    near = np.flatnonzero(np.isfinite(away))
    tangent = np.gradient(curve, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    offset, unit = pixels[near] - curve[nearest[near]], tangent[nearest[near]]
    along = arc[nearest[near]] + np.sum(offset * unit, axis=1)
    across = unit[:, 0] * offset[:, 1] - unit[:, 1] * offset[:, 0]
    back = plan.background + texture(rng, (h, w), 2.0, plan.background_sd)
    wall, tail = texture(rng, (h, w), 2.5, plan.wall_sd), texture(rng, (64, 4096), 3.0, plan.tail_sd)
    # Only the tube's own pixels are drawn anew in each of the parts of an exposure.
    drawn = np.abs(across) < plan.radius + 0.5
    tube, off, s = np.unravel_index(near[drawn], (h, w)), across[drawn], along[drawn]
    inside = np.clip(plan.radius - np.abs(off) + 0.5, 0, 1)
    bulge = plan.tip_depth * (1 - np.sqrt(np.clip(1 - (off / plan.radius) ** 2, 0, 1)))
    shade = 1 - 0.25 * np.clip(off / plan.radius, -1, 1) ** 2
    film = plan.opacity * (plan.film * shade + wall[tube]) + (1 - plan.opacity) * back[tube]
    rows, within = np.clip(off + 32, 0, 63).astype(np.int32), np.abs(off) < 0.6 * plan.radius
    phase = rng.uniform(0, 2 * np.pi, 2)
    frames = np.empty((n, h, w), np.uint8)
    for i in range(n):
        places = travel(plan, i + plan.exposure * (np.arange(12) + 0.5) / 12)
        shown = np.flatnonzero(s < places[-1] + 0.5)
        bulge_here, s_here, rows_here, within_here = (part[shown] for part in (bulge, s, rows, within))
        cover, inner = np.zeros(len(shown)), np.zeros(len(shown))
        for now in places:
            cover += np.clip(now - bulge_here - s_here + 0.5, 0, 1) / 12
            inner += tail[rows_here, np.mod((s_here - 2 * now).astype(np.int32), 4096)] * within_here / 12
        picture = back.copy()
        here = tube[0][shown], tube[1][shown]
        picture[here] += cover * inside[shown] * (film[shown] + inner - back[here])
        frames[i] = developed(plan, picture, i, phase, rng)
    edge = travel(plan, np.arange(n) + plan.exposure / 2)
    return BentScene(plan, frames, edge, moving(plan, n), curve, arc)
