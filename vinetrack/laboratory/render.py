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
from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr, ndtri

from vinetrack.core.process import njit
from vinetrack.core.records import Floats
from vinetrack.laboratory.scene import Ball, Door, Scene, Tube

Image = NDArray[np.float32]

# ------------------------------------------------------------------------------
# Textures of the virtual laboratory, painted once per recording: backdrop with ruler and launcher, film, tail, ball.
#
# All are float32 radiances or fractions on a grid of plane pixels. Each has its own random generator, so that
# changing one surface does not change the others.


def _smooth_noise(rng: np.random.Generator, shape: tuple[int, int], sigma_y: float, sigma_x: float) -> Image:
    """Periodic Gaussian noise with mean 0 and standard deviation 1, smoothed over `sigma_y`, `sigma_x` px."""
    white = np.fft.rfft2(rng.standard_normal(shape))
    fy = np.fft.fftfreq(shape[0])[:, None]
    fx = np.fft.rfftfreq(shape[1])[None, :]
    white *= np.exp(-2 * np.pi**2 * ((fy * sigma_y) ** 2 + (fx * sigma_x) ** 2))
    white[0, 0] = 0
    field = np.fft.irfft2(white, s=shape)
    return (field / field.std()).astype(np.float32)


def _paste(
    canvas: Image, patch: Image, scene: Scene, corner: tuple[int, int], along_px: float, across_px: float
) -> Image:
    """Lay a patch drawn along the path over `canvas`, its top left at (along_px, across_px)."""
    ux, uy = scene.direction
    x0 = scene.origin[0] - corner[0] + along_px * ux - across_px * uy
    y0 = scene.origin[1] - corner[1] + along_px * uy + across_px * ux
    matrix, size = np.array([[ux, -uy, x0], [uy, ux, y0]]), (canvas.shape[1], canvas.shape[0])
    weight, laid = (cv2.warpAffine(part, matrix, size, flags=cv2.INTER_LINEAR) for part in (np.ones_like(patch), patch))
    return np.asarray(canvas * (1 - weight) + laid, dtype=np.float32)


def _ruler_patch(length_px: int, width_px: int, px_per_mm: float, rng: np.random.Generator) -> Image:
    """Paint a steel ruler, shape (width_px, length_px): tick k mm is centred k·px_per_mm from the first column."""
    k = 4  # sub-pixels per pixel
    big = np.full((width_px * k, length_px * k), 0.62, dtype=np.float32)
    ink = np.zeros(big.shape, dtype=np.uint8)
    finest_mm = next((step for step in (1, 2, 5, 10) if step * px_per_mm >= 2.2), 10)
    for mm in range(0, int(length_px / px_per_mm), finest_mm):
        height = 0.45 if mm % 10 == 0 else (0.34 if mm % 5 == 0 else 0.22)
        # Sub-pixel j covers [(j − k/2 − 0.5)/k, …]: pixel 0 is centred on 0, its sub-pixels straddle it.
        middle = (mm * px_per_mm + 0.5) * k
        thick = 0.75 * k
        lo, hi = round(middle - thick / 2), round(middle + thick / 2)
        big[: int(height * width_px * k), max(lo, 0) : max(hi, 0)] = 0.10
        if mm % 10 == 0 and mm:
            place = (int(middle - 3.5 * k * (1 if mm < 100 else 2)), int(0.83 * width_px * k))
            cv2.putText(ink, str(mm // 10), place, cv2.FONT_HERSHEY_SIMPLEX, 0.30 * k, 255, max(k - 2, 1))
    big[ink > 127] = 0.13
    fine = cv2.resize(big, (length_px, width_px), interpolation=cv2.INTER_AREA)
    brushed = 1 + 0.03 * _smooth_noise(rng, (width_px, length_px), 0.6, 60)
    glare = 1 + 0.25 * np.sin(np.linspace(0, 5.0, length_px) + rng.uniform(0, 6))[None, :] ** 4
    return (fine * brushed * glare).astype(np.float32)


def _launcher_patch(radius_px: float, rng: np.random.Generator) -> Image:
    """Paint the block from which the tube grows: dark anodised aluminium with a knurled clamp ring and screws."""
    height, width = int(2.9 * radius_px), 400
    across = np.linspace(-1, 1, height, dtype=np.float32)[:, None]
    patch = 0.10 + 0.10 * np.exp(-(((across + 0.6) / 0.16) ** 2)) + np.zeros((1, width), dtype=np.float32)
    patch *= 1 + 0.06 * _smooth_noise(rng, (height, width), 0.7, 25)
    patch[[0, 1, -2, -1], :] = 0.26
    ring = max(int(0.5 * radius_px), 5)
    round_light = 0.16 + 0.42 * np.exp(-(((across + 0.45) / 0.22) ** 2)) + 0.12 * np.exp(-(((across - 0.6) / 0.2) ** 2))
    knurls = 1 + 0.25 * np.sign(np.sin(np.arcsin(across.clip(-0.99, 0.99)) * 34))
    patch[:, width - ring :] = round_light * knurls * np.linspace(0.75, 1.1, ring)
    patch[:, width - ring - 3 : width - ring] = 0.03
    for back in (1.0, 2.6):
        for side in (0.17, 0.83):
            centre = (int(width - ring - back * radius_px), int(side * height))
            cv2.circle(patch, centre, max(int(0.17 * radius_px), 2), 0.34, -1)
            cv2.circle(patch, centre, max(int(0.09 * radius_px), 1), 0.02, -1)
    return patch.astype(np.float32)


def _clutter(canvas: Image, scene: Scene, rng: np.random.Generator) -> Image:
    """Add out-of-focus objects on the wall: an aluminium profile with its slot, a hose, a label."""
    height, width = canvas.shape
    level = scene.backdrop.brightness
    things = canvas.copy()
    post = int(rng.uniform(0.55, 0.8) * width)
    for left, right, factor in ((0, 30, 1.5), (4, 7, 1.9), (12, 19, 0.4)):
        cv2.rectangle(things, (post + left, -5), (post + right, height + 5), factor * level, -1)
    turns = np.linspace(-0.05, 1.05, 90)
    start, end = rng.uniform(-0.1, 0.25) * width, rng.uniform(0.35, 0.6) * width
    hose_x = start + (end - start) * turns
    hose_y = height * (1.06 - 0.2 * np.sin(np.pi * turns.clip(0, 1)) + 0.3 * (np.abs(turns - 0.5) > 0.5))
    hose = np.stack([hose_x, hose_y], axis=-1).astype(np.int32)
    cv2.polylines(things, [hose], isClosed=False, color=0.3 * level, thickness=9)
    cv2.polylines(things, [hose - [0, 2]], isClosed=False, color=0.9 * level, thickness=2)
    left, top = int(0.86 * width), int(0.12 * height)
    cv2.rectangle(things, (left, top), (left + 62, top + 34), min(2.2 * level, 0.9), -1)
    for line in range(4):
        stop = left + 8 + int(rng.uniform(20, 46))
        cv2.line(things, (left + 8, top + 7 + 7 * line), (stop, top + 7 + 7 * line), 0.6 * level, 2)
    return np.asarray(cv2.GaussianBlur(things, (0, 0), 2.4), dtype=np.float32)


def backdrop_canvas(scene: Scene, rng: np.random.Generator, shape: tuple[int, int], corner: tuple[int, int]) -> Image:
    """Paint the static scene, blurred by the optics."""
    yy, xx = np.mgrid[: shape[0], : shape[1]].astype(np.float32)
    dx, dy = xx + corner[0] - scene.origin[0], yy + corner[1] - scene.origin[1]
    along = (dx * scene.direction[0] + dy * scene.direction[1]).astype(np.float32)
    # The wall: a gradient along the path, a pool of light, soft blotches and grain
    look = scene.backdrop
    ramp = look.brightness + look.gradient * (np.clip(along / max(float(along.max()), 1.0), 0, 1) - 0.5)
    blotches = 0.6 * _smooth_noise(rng, shape, 45, 45) + 0.45 * _smooth_noise(rng, shape, 9, 14)
    grain = 0.35 * _smooth_noise(rng, shape, 1.2, 1.2) + 0.25 * _smooth_noise(rng, shape, 0.8, 6)
    rows, columns = np.mgrid[: shape[0], : shape[1]]
    lit = np.exp(-(((columns / shape[1] - 0.45) / 0.65) ** 2) - ((rows / shape[0] - 0.35) / 0.9) ** 2)
    pool = 1 + 2.5 * look.texture * (lit - 0.6)
    canvas = (ramp * pool * (1 + look.texture * (blotches + grain))).astype(np.float32)
    if look.clutter:
        canvas = _clutter(canvas, scene, rng)
    radius = scene.subject.diameter_m / scene.camera.m_per_px / 2
    if look.ruler:
        patch = _ruler_patch(int(along.max()) + 40, 34, 1e-3 / scene.camera.m_per_px, rng)
        canvas = _paste(canvas, patch, scene, corner, 0.0, round(1.9 * radius + 14))
    if look.launcher:
        patch = _launcher_patch(radius, rng)
        canvas = _paste(canvas, patch, scene, corner, -399.0, -patch.shape[0] / 2)
    return np.asarray(cv2.GaussianBlur(canvas, (0, 0), scene.psf_px), dtype=np.float32).clip(0, 1.5)


def _film_relief(rng: np.random.Generator, shape: tuple[int, int]) -> Image:
    """Relief of crumpled film, mean 0 and standard deviation 1: soft folds along it, creases in all directions. A
    crease is a bright flank beside a dark one; most are short and within 60° of the tube's axis.
    """
    rows, columns = shape
    lines = np.zeros((2 * rows, 2 * columns), dtype=np.float32)
    for _ in range(max(columns // 3, 8)):
        slant, length = rng.normal(0, 0.7), rng.gamma(2.0, 14.0)
        across, along = rng.uniform(0, 2 * rows), rng.uniform(0, 2 * columns)
        bend = rng.normal(0, 4)
        turn = np.array([[math.cos(slant), math.sin(slant)], [-math.sin(slant), math.cos(slant)]])
        curve = np.array([[-length, 0], [-length / 3, bend], [length / 3, bend], [length, 0]]) @ turn + [along, across]
        cv2.polylines(lines, [curve.astype(np.int32)], isClosed=False, color=float(rng.standard_t(3)), thickness=1)
    creases = cv2.resize(cv2.GaussianBlur(lines, (0, 0), 1.9), (columns, rows), interpolation=cv2.INTER_AREA)
    flanks = creases - np.roll(creases, 2, axis=0)
    folds = 0.8 * _smooth_noise(rng, shape, 3.5, 60) + 0.5 * _smooth_noise(rng, shape, 2.0, 18)
    folds += 0.45 * _smooth_noise(rng, shape, 9, 9) + 0.15 * _smooth_noise(rng, shape, 0.9, 1.5)
    relief = folds + 0.3 * creases / max(float(creases.std()), 1e-6) + 0.45 * flanks / max(float(flanks.std()), 1e-6)
    return np.asarray((relief - relief.mean()) / relief.std(), dtype=np.float32)


def film_wall(tube: Tube, rng: np.random.Generator, radius_px: float, length_px: int) -> tuple[Image, Image]:
    """Paint the everted wall at rest: transmission and glow, each of shape (2·ceil(radius)+15, length_px). Row `i` lies
    `i − (rows − 1)/2` px off the axis. Towards the limb the line of sight crosses more film: the transmission is (1 −
    opacity) to the power of 1/√(1 − (v/R)²), kept finite. Returns transmission, glow.
    """
    half = math.ceil(radius_px) + 7
    shape = (2 * half + 1, length_px)
    v = (np.arange(shape[0]) - half)[:, None] / radius_px
    depth = 1 / np.sqrt(np.clip(1 - v**2, 0, 1) + 0.04)
    wrinkles = tube.texture * _film_relief(rng, shape)
    clear = np.clip(1 - tube.opacity * (1 + wrinkles), 0.0, 1.0) if tube.opacity < 1 else np.zeros(shape)
    transmission = clear**depth
    light = 0.86 - 0.16 * v + 0.08 * np.cos(2.6 * v) if tube.texture else 1.0
    glow = (1 - transmission) * tube.brightness * light * (1 + 1.3 * wrinkles)
    for place, width, strength in ((-0.55, 0.075, 1.4), (0.34, 0.05, 0.6), (-0.05, 0.03, 0.3)):
        wander = place + 0.03 * _smooth_noise(rng, (4, length_px), 1, 60)[:1]
        broken = np.clip(0.35 + 0.6 * _smooth_noise(rng, (4, length_px), 1, 7)[:1], 0, 1.6)
        glow = glow + tube.specular * strength * broken * np.exp(-(((v - wander) / width) ** 2))
    return transmission.astype(np.float32), glow.astype(np.float32)


def tail_sums(tube: Tube, rng: np.random.Generator, radius_px: float, period_px: int) -> Image:
    """Return running sums along the tail's texture, which is periodic with mean 0; shape (rows, period_px + 1). The
    mean over any stretch, as in motion blur, is then the difference of two entries over the length.
    """
    rows = 2 * math.ceil(radius_px * tube.tail_width) + 5
    shape = (rows, period_px)
    texture = 0.7 * _smooth_noise(rng, shape, 1.4, 9) + 0.7 * _smooth_noise(rng, shape, 3.0, 2.5)
    texture -= texture.mean(axis=1, keepdims=True)
    sums = np.zeros((rows, period_px + 1))
    np.cumsum(texture, axis=1, dtype=float, out=sums[:, 1:])
    return sums.astype(np.float32)


def ball_surface(ball: Ball, rng: np.random.Generator, radius_px: float) -> Image:
    """Paint a sphere lit from the upper left, with texture and two highlights; square of side 2·(ceil(radius)+4)+1."""
    half = math.ceil(radius_px) + 4
    grid = np.arange(-half, half + 1) / radius_px
    y, x = grid[:, None], grid[None, :]
    r2 = np.clip(y**2 + x**2, 0, 1)
    facing = np.clip(0.55 * np.sqrt(1 - r2) - 0.35 * y - 0.25 * x, 0, None)
    marks = _smooth_noise(rng, r2.shape, 2.2, 2.2) + 0.5 * _smooth_noise(rng, r2.shape, 6, 6)
    surface = ball.brightness * (0.45 + 0.9 * facing) * (1 + ball.texture * marks)
    for gy, gx, width in ((-0.25, 0.05, 0.07), (-0.2, -0.12, 0.05)):
        surface = surface + ball.specular * np.exp(-((y - gy) ** 2 + (x - gx) ** 2) / (2 * width**2))
    return surface.clip(0, 2).astype(np.float32)


# ------------------------------------------------------------------------------
# A calibration target in the plane of growth, projected exactly.
#
# Every pixel is sampled at POINTS points, each traced through lens and tilt to the plane, where it is black or white:
# corners are exactly where geometry puts them.

POINTS, LATTICE = 89, 55  # Points in a pixel, on a Fibonacci lattice (derived)


@njit()
def paint_board(
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


# ------------------------------------------------------------------------------
# Compiled loops of the renderer: tube, ball and sensor, one pass each over the pixels that it touches.

NORMAL_BITS = 12  # Bits of a random number per normal deviate (chosen)


@njit()
def _ramp(z: float) -> float:
    """Integral of the normal distribution function Φ from −∞ to z: zΦ(z) + φ(z)."""
    if z > 8:
        return z
    if z < -8:
        return 0.0
    return 0.5 * z * (1 + math.erf(z / math.sqrt(2.0))) + math.exp(-0.5 * z * z) / math.sqrt(2 * math.pi)


@njit()
def coverage_table(path_px: Floats, sigmas_px: Floats, first_px: float, step_px: float, n: int) -> Image:
    """Return the fraction of the exposure during which a blurred edge covers a point, shape (len(sigmas_px), n). Column
    i is the point `first_px + i·step_px` ahead of the edge's reference position. `path_px` are positions of the edge
    relative to that reference at equal time steps. Shapes: path_px (n_pieces + 1,) → (n_sigmas, n).
    """
    table = np.empty((sigmas_px.size, n), dtype=np.float32)
    pieces = path_px.size - 1
    for j in range(sigmas_px.size):
        sigma = sigmas_px[j]
        for i in range(n):
            e = first_px + i * step_px
            total = 0.0
            before = _ramp((path_px[0] - e) / sigma)
            for k in range(pieces):
                after = _ramp((path_px[k + 1] - e) / sigma)
                length = (path_px[k + 1] - path_px[k]) / sigma
                if abs(length) > 1e-3:
                    total += (after - before) / length
                else:
                    middle = (0.5 * (path_px[k + 1] + path_px[k]) - e) / sigma
                    total += 0.5 * (1 + math.erf(middle / math.sqrt(2.0)))
                before = after
            table[j, i] = total / pieces
    return table


@njit(fastmath=True, nogil=True)
def sample_backdrop(canvas: Image, map_x: Image, map_y: Image, shift_x: float, shift_y: float, out: Image) -> None:
    """Sample the backdrop, displaced by (shift_x, shift_y) px, bilinear; maps and `out` have shape (height, width)."""
    rows, columns = canvas.shape
    for y in range(out.shape[0]):
        for x in range(out.shape[1]):
            fx = min(max(map_x[y, x] - shift_x, 0.0), columns - 1.001)
            fy = min(max(map_y[y, x] - shift_y, 0.0), rows - 1.001)
            ix, iy = int(fx), int(fy)
            ax, ay = np.float32(fx - ix), np.float32(fy - iy)
            top = canvas[iy, ix] + ax * (canvas[iy, ix + 1] - canvas[iy, ix])
            bottom = canvas[iy + 1, ix] + ax * (canvas[iy + 1, ix + 1] - canvas[iy + 1, ix])
            out[y, x] = top + ay * (bottom - top)


@njit(fastmath=True, nogil=True)
def shade_tube(
    out: Image, along: Image, across: Image, nearest: Image, shift_along: float, shift_across: float,
    tip_px: float, sway: float, sway_length: float, table: Image, table_first: float, table_step: float, fold_row: int,
    setback: Floats, slope_row: NDArray[np.int64], side: Image, core: Image, per_px: int, transmission: Image,
    glow: Image, girth: Image, tail: Image, tail_from: float, tail_to: float, tail_end: float, tail_opacity: float,
    tail_level: float, tail_contrast: float, fold_glow: float, ghost: float, ghost_across: float,
) -> None:  # fmt: skip
    """Draw the tube over `out`, in place. For each pixel: the mirror image is added, the tail is laid over the
    backdrop, then the film over both, in proportion to the coverage by the moving edge. Shapes: out, along, across
    (height, width); nearest (height,), the least distance across in each row.
    """
    half_profile = (setback.size - 1) // 2
    reach = (half_profile - 1) / per_px
    half_rows = (transmission.shape[0] - 1) // 2
    half_tail = (tail.shape[0] - 1) // 2
    period = tail.shape[1] - 1
    columns = transmission.shape[1]
    n = table.shape[1]
    widest = reach / girth.min() + 2.25 * abs(sway) + (ghost_across if ghost > 0 else 0.0)
    farthest = tip_px + table_first + n * table_step if ghost <= 0 else np.inf
    for y in range(out.shape[0]):
        if nearest[y] > widest + abs(shift_across):
            continue
        for x in range(out.shape[1]):
            u = along[y, x] - shift_along
            v = across[y, x] - shift_across
            if abs(v) > widest or u > farthest:
                continue
            grown = min(max(u / sway_length, 0.0), 1.5)
            v -= sway * grown * grown
            if ghost > 0 and abs(v - ghost_across) < reach:
                i = int((v - ghost_across) * per_px + half_profile + 0.5)
                place = (u + setback[i] - tip_px - table_first) / table_step
                reflected = table[slope_row[i], min(max(int(place), 0), n - 1)] if u > 0 else 0.0
                out[y, x] += ghost * reflected * side[i]
            if u < -1:
                continue
            v *= girth[min(int(u) + 1, columns - 1)]
            if abs(v) >= reach:
                continue
            i = int(v * per_px + half_profile)
            fraction = np.float32(v * per_px + half_profile - i)
            setback_here = setback[i] + fraction * (setback[i + 1] - setback[i])
            side_here = side[i] + fraction * (side[i + 1] - side[i])
            place = (u + setback_here - tip_px - table_first) / table_step
            if place >= n - 1:
                continue
            if place <= 0:
                coverage, fold = np.float32(1.0), np.float32(0.0)
            else:
                k = int(place)
                part = np.float32(place - k)
                row = slope_row[i]
                coverage = table[row, k] + part * (table[row, k + 1] - table[row, k])
                fold = table[fold_row, k] + part * (table[fold_row, k + 1] - table[fold_row, k])
            coverage *= side_here * min(max(u + 0.5, 0.0), 1.0)
            backdrop = out[y, x]
            if core[i] > 0 and u > tail_end:
                a, b = (u - tail_to) % period, (u - tail_from) % period
                if b < a:
                    b += period
                tail_row = int(v + half_tail + 0.5)
                ia = int(a)
                low = tail[tail_row, ia] + (a - ia) * (tail[tail_row, ia + 1] - tail[tail_row, ia])
                c = b - period if b >= period else b
                ic = int(c)
                high = tail[tail_row, ic] + (c - ic) * (tail[tail_row, ic + 1] - tail[tail_row, ic])
                # 30.0: length over which the end of the tail, a crumpled bunch of film, fades out (chosen)
                weight = tail_opacity * core[i] * min((u - tail_end) / 30.0, 1.0)
                backdrop += weight * (tail_level * (1 + tail_contrast * (high - low) / (b - a)) - backdrop)
            fu, fv = min(max(u, 0.0), columns - 1.001), v + half_rows
            iu, iv = int(fu), int(fv)
            au, av = np.float32(fu - iu), np.float32(fv - iv)
            t0 = transmission[iv, iu] + au * (transmission[iv, iu + 1] - transmission[iv, iu])
            t1 = transmission[iv + 1, iu] + au * (transmission[iv + 1, iu + 1] - transmission[iv + 1, iu])
            g0 = glow[iv, iu] + au * (glow[iv, iu + 1] - glow[iv, iu])
            g1 = glow[iv + 1, iu] + au * (glow[iv + 1, iu + 1] - glow[iv + 1, iu])
            film = backdrop * (t0 + av * (t1 - t0)) + g0 + av * (g1 - g0) + fold_glow * fold
            out[y, x] += coverage * (film - out[y, x])


@njit(fastmath=True, nogil=True)
def shade_ball(
    out: Image, along: Image, across: Image, shift_along: float, shift_across: float, path_px: Floats,
    radius_px: float, sigma_px: float, surface: Image, min_along: float,
) -> None:  # fmt: skip
    """Draw a ball over `out`, (height, width), averaged over its positions `path_px`, (n_pieces,), in the exposure."""
    half = (surface.shape[0] - 1) // 2
    first, last = path_px.min() - half, path_px.max() + half
    for y in range(out.shape[0]):
        for x in range(out.shape[1]):
            v = across[y, x] - shift_across
            place = along[y, x] - shift_along
            if abs(v) >= half - 1 or place < first or place > last:
                continue
            coverage_sum = 0.0
            light_sum = 0.0
            for k in range(path_px.size):
                u = place - path_px[k]
                inside = (radius_px - math.sqrt(u * u + v * v)) / sigma_px
                if inside < -3.5 or place < min_along or abs(u) >= half - 1:
                    continue
                coverage = 1.0 if inside > 3.5 else 0.5 * (1 + math.erf(inside * 0.7071067811865476))
                fu, fv = u + half, v + half
                iu, iv = int(fu), int(fv)
                au, av = fu - iu, fv - iv
                s0 = surface[iv, iu] + au * (surface[iv, iu + 1] - surface[iv, iu])
                s1 = surface[iv + 1, iu] + au * (surface[iv + 1, iu + 1] - surface[iv + 1, iu])
                coverage_sum += coverage
                light_sum += coverage * (s0 + av * (s1 - s0))
            out[y, x] += np.float32((light_sum - coverage_sum * out[y, x]) / path_px.size)


@njit()
def _mixed(z: np.uint64) -> np.uint64:
    """Splitmix64's finaliser (Steele et al. 2014): neighbouring seeds give unrelated streams."""
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return z ^ (z >> np.uint64(31))


@njit(fastmath=True, nogil=True)
def expose(
    light: Image, gain: Image, lamp: float, full_well_e: float, read_noise_e: float, seed: int, frame: int,
    normals: Image, low: float, span: float, out: NDArray[np.uint8 | np.uint16],
) -> None:  # fmt: skip
    """Convert radiance to grey levels, low + span · signal, with shot and read noise, into `out`. The noise of a signal
    s has standard deviation √(s·well + read²)/well. Shapes: light, gain, out (height, width); normals (2^NORMAL_BITS,).
    """
    rows, columns = out.shape
    mask = np.uint64((1 << NORMAL_BITS) - 1)
    per_well = np.float32(1.0 / full_well_e) if full_well_e > 0 else np.float32(0.0)
    read2 = np.float32((read_noise_e * per_well) ** 2)
    lamp32 = np.float32(lamp)
    for y in range(rows):
        state = _mixed(np.uint64(seed) * np.uint64(0x9E3779B97F4A7C15) + _mixed(np.uint64(frame * 65536 + y + 1)))
        bits = np.uint64(0)
        for x in range(columns):
            signal = max(light[y, x] * gain[y, x] * lamp32, np.float32(0.0))
            if full_well_e > 0:
                if x % 4 == 0:
                    state ^= state << np.uint64(13)
                    state ^= state >> np.uint64(7)
                    state ^= state << np.uint64(17)
                    bits = state
                deviate = normals[np.int64(bits & mask)]
                bits >>= np.uint64(16)
                signal += deviate * np.sqrt(signal * per_well + read2)
            signal = min(max(signal, np.float32(0.0)), np.float32(1.0))
            out[y, x] = np.int64(low + span * signal + 0.5)


# ------------------------------------------------------------------------------
# Motion of a scene over time: tip, end of the tail, sway of the tube, shake of the camera, door; and the lamps.
#
# All positions are in plane pixels (see `camera`), all times in seconds from the start of the first exposure.

Motion = Callable[[Floats], Floats]  # Lead position in metres against time in seconds


class SceneMotion:
    """Positions of everything that moves in a scene whose tip, or body, follows a given motion."""

    def __init__(
        self, scene: Scene, motion: Motion, *, n_frames: int, capture_fps: float, exposure_s: float, seed: int
    ) -> None:
        self.scene, self.capture_fps, self.exposure_s, self._position_m = scene, capture_fps, exposure_s, motion
        grid_s = np.arange(0, (n_frames + 1) * 10) / (10 * capture_fps)
        lead_m = np.asarray(self._position_m(grid_s), dtype=float)
        moving = np.flatnonzero(lead_m > lead_m[0] + 1e-5)
        self.release_s = float(grid_s[moving[0]]) if moving.size else math.inf
        # When the end of the tail leaves the tip, and its speed there (px/s), twice that of the tip
        self._exit_s, self._exit_px_s, scale = math.inf, 0.0, scene.camera.m_per_px
        length_m = scene.subject.length_m if isinstance(scene.subject, Tube) else math.inf
        out = np.flatnonzero(lead_m >= length_m - 1e-4)
        if out.size and out[0] >= 2:
            k = out[0]
            lead_speed_m_s = (lead_m[k - 1] - lead_m[k - 2]) / (grid_s[k - 1] - grid_s[k - 2])
            self._exit_s, self._exit_px_s = float(grid_s[k]), min(2 * lead_speed_m_s, 150.0) / scale
        rng = np.random.default_rng([seed, 1])
        amplitude = rng.normal(size=(2, 6))
        self._amplitude = amplitude / np.sqrt((amplitude**2).sum(axis=1, keepdims=True) / 2)
        self._phase = rng.uniform(0, 2 * np.pi, (2, 6))
        self._hertz = rng.uniform(4, 55, 6)
        self._lamp_phase = float(rng.uniform(0, 2 * np.pi))
        # Growth at which the sway is `sway_px`; sway grows with the square of the distance, as for a cantilever.
        self.sway_length_px = length_m / scale

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

    def sway_px(self, time_s: float) -> float:
        """Return the displacement of the tube at `sway_length_px`, at 22 Hz, which starts smoothly at the release."""
        subject = self.scene.subject
        if not isinstance(subject, Tube) or not subject.wobble_px:
            return 0.0
        since = max(time_s - self.release_s, 0.0)
        return subject.wobble_px * min(since / 0.01, 1.0) * math.sin(2 * math.pi * 22.0 * since)

    def shake_px(self, time_s: float) -> tuple[float, float]:
        """Return the shift of the picture (x, y), plane px: six sinusoids of joint rms 1, a damped kick at release."""
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
        assert door is not None
        opened = (time_s - self.release_s + door.lead_s) / door.swing_s
        if opened <= 0:
            return 0.0
        if opened < 1:
            return math.radians(door.open_deg) * opened**2
        after = opened - 1
        return math.radians(door.open_deg - 12 * math.exp(-after / 1.5) * abs(math.sin(2.2 * after)))


# ------------------------------------------------------------------------------
# Moving objects in front of the backdrop: tube, ball and door, each composited over the light of a frame.

PER_PX = 16  # Entries per pixel of the table of covers along the path and of the profiles across (chosen)
# How much wider the edge's blur is along the path where the tip's outline is slanted (1/cos of the slant)
SLOPES = np.linspace(1.0, 4.0, 7)


class TubeLayer:
    """Composites the everting tube with its payload over a frame."""

    def __init__(self, scene_motion: SceneMotion, maps: tuple[Image, Image], rng: np.random.Generator) -> None:
        scene = scene_motion.scene
        assert isinstance(scene.subject, Tube)
        self._motion, self._maps, self._tube, self._psf_px = scene_motion, maps, scene.subject, scene.psf_px
        self._radius_px = radius = scene.subject.diameter_m / 2 / scene.camera.m_per_px
        length = max(math.ceil(float(maps[0].max())) + 8, 64)
        self._wall = film_wall(self._tube, rng, radius, length)
        # Stretch of distances from the axis along the everted wall, whose sides ripple
        ripple = 0.7 * _smooth_noise(rng, (4, length), 1, 9)[0] + 0.7 * _smooth_noise(rng, (4, length), 1, 40)[0]
        self._girth = (1 + 0.08 * self._tube.texture * ripple).astype(np.float32)
        self._tail = tail_sums(self._tube, rng, radius, period_px=4096)
        self._nearest = np.abs(maps[1]).min(axis=1)
        self._profiles = tip_profiles(self._tube, radius, self._psf_px)
        self._ghost_across = 1.35 * radius
        self._payload: BallLayer | None = None
        if self._tube.payload_diameter_m:
            size_m, brightness = self._tube.payload_diameter_m, 2 * self._tube.payload_brightness
            metal = Ball(diameter_m=size_m, brightness=brightness, texture=0.1, specular=0.25)
            self._payload = BallLayer(scene_motion, maps, rng, metal, scene_motion.tail_end_px, emerges_at_px=0.0)

    def lay(self, light: Image, frame: int, shift: tuple[float, float]) -> None:
        """Lay the tube as exposed in one frame over a picture, in place. Shapes: light (height, width)."""
        if self._payload is not None:
            self._payload.lay(light, frame, shift)
        scene_motion, tube = self._motion, self._tube
        middle_s = float(scene_motion.mid_exposure_s(frame))
        part = np.linspace(0, 1, 5)  # the path of the tip over an exposure in four straight pieces
        path = scene_motion.lead_px(frame / scene_motion.capture_fps + scene_motion.exposure_s * part)
        tip = float(scene_motion.lead_px(middle_s))
        table, first = self._edge_table(path - tip)
        setback, slope_row, side, core = self._profiles
        tail_from, tail_to = 2 * float(path[0]), 2 * float(path[-1])
        # Averaged over one pixel at least, so that the tail's texture is as soft at rest as in motion.
        slack = max(0.0, 1.0 - (tail_to - tail_from)) / 2
        shade_tube(
            light, *self._maps, self._nearest, *shift, tip,
            scene_motion.sway_px(middle_s), scene_motion.sway_length_px, table, first, 1 / PER_PX, len(SLOPES),
            setback, slope_row, side, core, PER_PX, *self._wall, self._girth, self._tail, tail_from - slack,
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
        grid = first, 1 / PER_PX, math.ceil((last - first) * PER_PX) + 2
        ahead = coverage_table(path_px, np.array([*(sigma * SLOPES), fold_sigma]), *grid)
        ahead[-1:] -= coverage_table(path_px - fold_px, np.array([fold_sigma]), *grid)
        return ahead, first


def tip_profiles(tube: Tube, radius_px: float, psf_px: float) -> tuple[Floats, NDArray[np.int64], Image, Image]:
    """Profiles across the axis, PER_PX a pixel, shape (n_entries,): setback, slope row, side, core."""
    half = math.ceil((radius_px + 5) * PER_PX)
    v = np.abs(np.arange(-half, half + 1)) / PER_PX
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
        self, scene_motion: SceneMotion, maps: tuple[Image, Image], rng: np.random.Generator, ball: Ball,
        centre_px: Callable[[Floats], Floats], emerges_at_px: float = -1e9,
    ) -> None:  # fmt: skip
        self._motion, self._maps, self._centre_px, self._from_px = scene_motion, maps, centre_px, emerges_at_px
        self._radius_px = ball.diameter_m / 2 / scene_motion.scene.camera.m_per_px
        self._surface = ball_surface(ball, rng, max(self._radius_px, 2.0))

    def lay(self, light: Image, frame: int, shift: tuple[float, float]) -> None:
        """Lay the ball over a picture, shape (height, width), in place, averaged over centres at most 0.7 px apart."""
        scene_motion = self._motion
        begin_s, span_s = frame / scene_motion.capture_fps, scene_motion.exposure_s
        ends = self._centre_px(begin_s + np.array([0, span_s]))
        pieces = int(min(max(math.ceil(abs(ends[1] - ends[0]) / 0.7), 3), 80))
        path = self._centre_px(begin_s + span_s * (np.arange(pieces) + 0.5) / pieces)
        shade_ball(
            light, *self._maps, *shift, path, self._radius_px, scene_motion.scene.psf_px,
            self._surface, self._from_px,
        )  # fmt: skip


def lay_door(light: Image, scene_motion: SceneMotion, door: Door, frame: int, shake: tuple[float, float]) -> None:
    """Lay the door over a picture, (height, width), in place: it swings out of the path; averaged over the exposure."""
    scene = scene_motion.scene
    scale, (ux, uy) = scene.camera.m_per_px, scene.direction
    axes = np.array([[ux, uy], [-uy, ux]])
    length, half = door.length_m / scale, door.thickness_m / scale / 2
    radius = scene.subject.diameter_m / 2 / scale
    hinge = np.array([float(scene_motion.lead_px(0.0)) + 2 + half, -1.25 * radius])
    times_s = frame / scene_motion.capture_fps + scene_motion.exposure_s * np.array([0.1, 0.5, 0.9])
    swing = [scene_motion.door_angle_rad(float(t)) for t in times_s]
    # Plate, lit edge and knuckle of the hinge: sides in half thicknesses, ends in px, angles, brightness
    for left, right, back, front, angles, level in (
        (-1.0, 1, -4, length, swing, door.brightness),
        (0.3, 1, -4, length, swing, 1.35 * door.brightness),
        (-2.0, 2, -7, 5, [0.0], 0.12),
    ):
        outline = np.array([[left, back], [right, back], [right, front], [left, front]]) * [half, 1]
        turned = []
        for angle in angles:
            turn = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
            on_plane = (outline @ turn + hinge) @ axes + scene.origin + shake
            turned.append(scene.camera.picture_from_plane(on_plane))
        every = np.concatenate(turned)
        low = np.clip(np.floor(every.min(axis=0)).astype(int) - 4, 0, None)
        high = np.clip(np.ceil(every.max(axis=0)).astype(int) + 5, None, [light.shape[1], light.shape[0]])
        if (high <= low).any():
            continue
        cover = np.zeros((high[1] - low[1], high[0] - low[0]), dtype=np.float32)
        for corners in turned:
            layer = np.zeros(cover.shape, dtype=np.uint8)
            cv2.fillConvexPoly(layer, np.round((corners - low) * 16).astype(np.int32), 255, cv2.LINE_AA, shift=4)
            cover += layer / np.float32(255 * len(turned))
        cover = np.asarray(cv2.GaussianBlur(cover, (0, 0), scene.psf_px), dtype=np.float32)
        region = light[low[1] : high[1], low[0] : high[0]]
        region += cover * (np.float32(level) - region)


@dataclass(frozen=True)
class Truth:
    """True positions, shapes (n_frames,); `time_s` is mid-exposure, `in_frame` whether the tip is in the picture."""

    time_s: Floats
    lead_position_m: Floats
    lead_px: Floats
    tip_x_px: Floats
    tip_y_px: Floats
    in_frame: NDArray[np.bool_]
    release_s: float
    exposure_s: float


class FrameRenderer:
    """Renders any frame of a recording, in any order; the same frame always comes out the same."""

    def __init__(
        self, scene: Scene, motion: Motion, *, n_frames: int, capture_fps: float, exposure_s: float | None = None,
        seed: int = 0,
    ) -> None:  # fmt: skip
        self.scene, self._seed = scene, seed
        self.exposure_s = scene.exposure_fraction / capture_fps if exposure_s is None else exposure_s
        self._motion = SceneMotion(
            scene, motion, n_frames=n_frames, capture_fps=capture_fps, exposure_s=self.exposure_s, seed=seed
        )
        # The backdrop, painted on plane pixels, and projected through the lens once, for frames without shake
        camera = scene.camera
        is_plain = camera.k1 == camera.k2 == camera.tilt_x_deg == camera.tilt_y_deg == 0
        plane = camera.pixels() if is_plain else camera.plane_from_picture(camera.pixels())
        plane_x, plane_y = plane[..., 0].astype(np.float32), plane[..., 1].astype(np.float32)
        margin = 4 + math.ceil(4 * scene.shake_px)
        x0, y0 = (math.floor(part.min()) - margin for part in (plane_x, plane_y))
        x1, y1 = (math.ceil(part.max()) + margin for part in (plane_x, plane_y))
        canvas = backdrop_canvas(scene, np.random.default_rng([seed, 0]), (y1 - y0 + 1, x1 - x0 + 1), (x0, y0))
        self._backdrop = canvas, plane_x - np.float32(x0), plane_y - np.float32(y0)
        self.still: Image = np.empty(plane_x.shape, np.float32)  # radiance of the static scene, shape (height, width)
        sample_backdrop(*self._backdrop, 0.0, 0.0, self.still)
        # What moves, on distances along the path and across it, px
        ox, oy, ux, uy = np.array([*scene.origin, *scene.direction], dtype=np.float32)
        dx, dy = plane_x - ox, plane_y - oy
        maps, rng = (dx * ux + dy * uy, dy * ux - dx * uy), np.random.default_rng([seed, 2])
        self._subject: TubeLayer | BallLayer
        if isinstance(scene.subject, Tube):
            self._subject = TubeLayer(self._motion, maps, rng)
        else:
            radius = scene.subject.diameter_m / 2 / scene.camera.m_per_px
            centre = lambda time_s: self._motion.lead_px(time_s) - radius  # noqa: E731
            self._subject = BallLayer(self._motion, maps, rng, scene.subject, centre)
        # The sensor: gain of every pixel (vignetting, fixed pattern), and normal deviates
        rng = np.random.default_rng([seed, 3])
        radius2 = ((camera.pixels() - camera.centre_px) ** 2).sum(axis=-1) / np.square(camera.centre_px).sum()
        spread = rng.standard_normal(radius2.shape) + 0.5 * rng.standard_normal((1, camera.width_px))
        falloff = 1 - scene.light.vignetting * radius2
        self._gain = (falloff * (1 + scene.sensor.fixed_pattern * spread)).astype(np.float32)
        quantiles = ndtri((np.arange(1 << NORMAL_BITS) + 0.5) / (1 << NORMAL_BITS))
        self._normals = (quantiles / quantiles.std()).astype(np.float32)

    def frame(self, frame: int, **levels: float) -> NDArray[np.uint8 | np.uint16]:
        """Render the grey levels of one frame. Shape (height, width)."""
        shake = self._motion.shake_px(float(self._motion.mid_exposure_s(frame)))
        light = self.still.copy()
        if shake != (0.0, 0.0):
            sample_backdrop(*self._backdrop, *shake, light)
        if self.scene.door is not None:
            lay_door(light, self._motion, self.scene.door, frame, shake)
        ux, uy = self.scene.direction
        self._subject.lay(light, frame, (shake[0] * ux + shake[1] * uy, shake[1] * ux - shake[0] * uy))
        return self.expose(light, frame, **levels)

    def expose(
        self, light: Image, frame: int, *, low: float = 0.0, span: float | None = None
    ) -> NDArray[np.uint8 | np.uint16]:
        """Convert radiance, shape (height, width), to grey levels with the lamps, gain and noise of one frame."""
        sensor = self.scene.sensor
        out = np.empty(light.shape, dtype=np.uint8 if sensor.bit_depth <= 8 else np.uint16)
        well_e = sensor.full_well_e if sensor.noise else 0.0
        full = float(2**sensor.bit_depth - 1 if span is None else span)
        expose(
            light, self._gain, self._motion.lamp(frame), well_e, sensor.read_noise_e, self._seed, frame,
            self._normals, low, full, out,
        )  # fmt: skip
        return out

    def truth(self, frames: NDArray[np.int_]) -> Truth:
        """Return the true positions in these frames. Shapes: frames (n,)."""
        time_s = self._motion.mid_exposure_s(frames)
        along, camera, (ux, uy) = self._motion.lead_px(time_s), self.scene.camera, self.scene.direction
        sway = np.array([self._motion.sway_px(float(t)) for t in time_s])
        across = sway * np.clip(along / self._motion.sway_length_px, 0, 1.5) ** 2
        shake = np.array([self._motion.shake_px(float(t)) for t in time_s]).reshape(-1, 2)
        on_path = np.array(self.scene.origin) + along[:, None] * np.array([ux, uy])
        tip = camera.picture_from_plane(on_path + across[:, None] * np.array([-uy, ux]) + shake)
        return Truth(
            time_s=time_s,
            lead_position_m=along * camera.m_per_px - self.scene.start_m,
            lead_px=along,
            tip_x_px=tip[:, 0],
            tip_y_px=tip[:, 1],
            in_frame=np.all((tip >= -0.5) & (tip <= np.array([camera.width_px, camera.height_px]) - 0.5), axis=1),
            release_s=self._motion.release_s,
            exposure_s=self.exposure_s,
        )
