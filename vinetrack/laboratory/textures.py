"""Textures of the virtual laboratory, painted once per recording: backdrop with ruler and launcher, film,
tail, ball.

All are float32 radiances or fractions on a grid of plane pixels. Each has its own random generator, so that changing
one surface does not change the others.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from vinetrack.laboratory.scene import Ball, Scene, Tube

Image = NDArray[np.float32]

OVERSAMPLING = 4  # Sub-pixels per pixel for drawing lines (derived)


def _smooth_noise(rng: np.random.Generator, shape: tuple[int, int], sigma_y: float, sigma_x: float) -> Image:
    """Periodic Gaussian noise with mean 0 and standard deviation 1, smoothed over `sigma_y`, `sigma_x` px."""
    white = np.fft.rfft2(rng.standard_normal(shape))
    fy = np.fft.fftfreq(shape[0])[:, None]
    fx = np.fft.rfftfreq(shape[1])[None, :]
    white *= np.exp(-2 * np.pi**2 * ((fy * sigma_y) ** 2 + (fx * sigma_x) ** 2))
    white[0, 0] = 0
    field = np.fft.irfft2(white, s=shape)
    return (field / field.std()).astype(np.float32)


def _along_and_across(scene: Scene, shape: tuple[int, int], corner: tuple[int, int]) -> tuple[Image, Image]:
    """Coordinates along the path and across it (px) of each canvas pixel, each of shape `shape`."""
    yy, xx = np.mgrid[: shape[0], : shape[1]].astype(np.float32)
    dx, dy = xx + corner[0] - scene.origin[0], yy + corner[1] - scene.origin[1]
    ux, uy = scene.direction
    return (dx * ux + dy * uy).astype(np.float32), (dy * ux - dx * uy).astype(np.float32)


def _wall_paper(scene: Scene, rng: np.random.Generator, along: Image) -> Image:
    """The wall in the background: a gradient along the path, a pool of light, soft blotches and grain."""
    look = scene.backdrop
    shape = (along.shape[0], along.shape[1])
    span = max(float(along.max()), 1.0)
    ramp = look.brightness + look.gradient * (np.clip(along / span, 0, 1) - 0.5)
    blotches = 0.6 * _smooth_noise(rng, shape, 45, 45) + 0.45 * _smooth_noise(rng, shape, 9, 14)
    grain = 0.35 * _smooth_noise(rng, shape, 1.2, 1.2) + 0.25 * _smooth_noise(rng, shape, 0.8, 6)
    yy, xx = np.mgrid[: shape[0], : shape[1]]
    lit = np.exp(-(((xx / shape[1] - 0.45) / 0.65) ** 2) - ((yy / shape[0] - 0.35) / 0.9) ** 2)
    pool = 1 + 2.5 * look.texture * (lit - 0.6)
    return (ramp * pool * (1 + look.texture * (blotches + grain))).astype(np.float32)


def _paste(canvas: Image, patch: Image, mask: Image, matrix: NDArray[np.float64]) -> Image:
    """Lay `patch` over `canvas` through the affine `matrix` (patch to canvas) where `mask` is 1."""
    import cv2

    size = (canvas.shape[1], canvas.shape[0])
    weight = cv2.warpAffine(mask, matrix, size, flags=cv2.INTER_LINEAR)
    laid = cv2.warpAffine(patch * mask, matrix, size, flags=cv2.INTER_LINEAR)
    return np.asarray(canvas * (1 - weight) + laid, dtype=np.float32)


def _axis_matrix(
    scene: Scene, corner: tuple[int, int], along_px: float, across_px: float, turned: bool = False
) -> NDArray[np.float64]:
    """Affine map of a patch drawn along the path to the canvas; its top left is at (along_px, across_px)."""
    ux, uy = scene.direction
    x0 = scene.origin[0] - corner[0] + along_px * ux - across_px * uy
    y0 = scene.origin[1] - corner[1] + along_px * uy + across_px * ux
    if turned:
        return np.array([[-ux, uy, x0], [-uy, -ux, y0]])
    return np.array([[ux, -uy, x0], [uy, ux, y0]])


def _ruler_patch(length_px: int, width_px: int, px_per_mm: float, rng: np.random.Generator) -> Image:
    """Paint a steel ruler, shape (width_px, length_px): tick k mm is centred k·px_per_mm from the first column."""
    import cv2

    k = OVERSAMPLING
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


def _launcher_patch(radius_px: float, rng: np.random.Generator, reach_px: int) -> Image:
    """Paint the block from which the tube grows: dark anodised aluminium with a knurled clamp ring and screws."""
    import cv2

    height, width = int(2.9 * radius_px), reach_px
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
    import cv2

    height, width = canvas.shape
    level = scene.backdrop.brightness
    things = canvas.copy()
    post = int(rng.uniform(0.55, 0.8) * width)
    cv2.rectangle(things, (post, -5), (post + 30, height + 5), 1.5 * level, -1)
    cv2.rectangle(things, (post + 4, -5), (post + 7, height + 5), 1.9 * level, -1)
    cv2.rectangle(things, (post + 12, -5), (post + 19, height + 5), 0.4 * level, -1)
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
    import cv2

    along, _ = _along_and_across(scene, shape, corner)
    canvas = _wall_paper(scene, rng, along)
    if scene.backdrop.clutter:
        canvas = _clutter(canvas, scene, rng)
    radius = scene.subject.diameter_m / scene.camera.m_per_px / 2
    if scene.backdrop.ruler:
        length, width = int(along.max()) + 40, 34
        patch = _ruler_patch(length, width, 1e-3 / scene.camera.m_per_px, rng)
        matrix = _axis_matrix(scene, corner, 0.0, round(1.9 * radius + 14))
        canvas = _paste(canvas, patch, np.ones_like(patch), matrix)
    if scene.backdrop.launcher:
        patch = _launcher_patch(radius, rng, 400)
        matrix = _axis_matrix(scene, corner, -399.0, -patch.shape[0] / 2)
        canvas = _paste(canvas, patch, np.ones_like(patch), matrix)
    return np.asarray(cv2.GaussianBlur(canvas, (0, 0), scene.psf_px), dtype=np.float32).clip(0, 1.5)


def _film_relief(rng: np.random.Generator, shape: tuple[int, int]) -> Image:
    """Relief of crumpled film, mean 0 and standard deviation 1: soft folds along it, creases in all directions. A
    crease is a bright flank beside a dark one; most are short and within 60° of the tube's axis.
    """
    import cv2

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


def film_girth(tube: Tube, rng: np.random.Generator, length_px: int) -> Image:
    """Return the relative stretch of distances from the axis along the everted wall, whose sides ripple. Shape
    (length_px,).
    """
    ripple = 0.7 * _smooth_noise(rng, (4, length_px), 1, 9)[0] + 0.7 * _smooth_noise(rng, (4, length_px), 1, 40)[0]
    return (1 + 0.08 * tube.texture * ripple).astype(np.float32)


def tail_sums(tube: Tube, rng: np.random.Generator, radius_px: float, period_px: int) -> Image:
    """Return running sums along the tail's texture, which is periodic with mean 0; shape (rows, period_px + 1). The
    mean over any stretch, as in motion blur, is then the difference of two entries over the length. Shape (rows,
    period_px + 1).
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
    r2 = np.clip(grid[:, None] ** 2 + grid[None, :] ** 2, 0, 1)
    facing = np.clip(0.55 * np.sqrt(1 - r2) - 0.35 * grid[:, None] - 0.25 * grid[None, :], 0, None)
    marks = _smooth_noise(rng, r2.shape, 2.2, 2.2) + 0.5 * _smooth_noise(rng, r2.shape, 6, 6)
    surface = ball.brightness * (0.45 + 0.9 * facing) * (1 + ball.texture * marks)
    for gy, gx, width in ((-0.25, 0.05, 0.07), (-0.2, -0.12, 0.05)):
        surface = surface + ball.specular * np.exp(
            -((grid[:, None] - gy) ** 2 + (grid[None, :] - gx) ** 2) / (2 * width**2)
        )
    return surface.clip(0, 2).astype(np.float32)
