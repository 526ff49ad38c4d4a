"""Compiled loops of the renderer: tube, ball and sensor, one pass each over the pixels that it touches."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from vinetrack.core.records import Floats

Image = NDArray[np.float32]
Whole = NDArray[np.int64]

NORMAL_BITS = 12  # Bits of a random number per normal deviate (chosen)
TAIL_TAPER_PX = 30.0  # Length over which the end of the tail, a crumpled bunch of film, fades out (chosen)


@njit(cache=True)
def _ramp(z: float) -> float:
    """Integral of the normal distribution function Φ from −∞ to z: zΦ(z) + φ(z)."""
    if z > 8:
        return z
    if z < -8:
        return 0.0
    return 0.5 * z * (1 + math.erf(z / math.sqrt(2.0))) + math.exp(-0.5 * z * z) / math.sqrt(2 * math.pi)


@njit(cache=True)
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


@njit(cache=True, fastmath=True, nogil=True)
def sample_backdrop(canvas: Image, map_x: Image, map_y: Image, shift_x: float, shift_y: float, out: Image) -> None:
    """Sample the backdrop, displaced by (shift_x, shift_y) px, at every pixel of the camera; bilinear, into `out`.
    Shapes: canvas (canvas_height, canvas_width); map_x, map_y, out (height, width).
    """
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


@njit(cache=True, fastmath=True, nogil=True)
def shade_tube(
    out: Image, along: Image, across: Image, first_x: Whole, last_x: Whole, shift_along: float, shift_across: float,
    tip_px: float, sway: float, sway_length: float, table: Image, table_first: float, table_step: float, fold_row: int,
    setback: Floats, slope_row: Whole, side: Image, core: Image, per_px: int, transmission: Image, glow: Image,
    girth: Image, tail: Image, tail_from: float, tail_to: float, tail_end: float, tail_opacity: float,
    tail_level: float, tail_contrast: float, fold_glow: float, ghost: float, ghost_across: float,
) -> None:  # fmt: skip
    """Draw the tube over `out`, in place. For each pixel: the mirror image is added, the tail is laid over the
    backdrop, then the film over both, in proportion to the coverage by the moving edge. Shapes: out, along, across
    (height, width); first_x, last_x (height,).
    """
    half_profile = (setback.size - 1) // 2
    reach = (half_profile - 1) / per_px
    half_rows = (transmission.shape[0] - 1) // 2
    half_tail = (tail.shape[0] - 1) // 2
    period = tail.shape[1] - 1
    columns = transmission.shape[1]
    n = table.shape[1]
    for y in range(out.shape[0]):
        for x in range(first_x[y], last_x[y]):
            u = along[y, x] - shift_along
            v = across[y, x] - shift_across
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
                weight = tail_opacity * core[i] * min((u - tail_end) / TAIL_TAPER_PX, 1.0)
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


@njit(cache=True, fastmath=True, nogil=True)
def shade_ball(
    out: Image, along: Image, across: Image, shift_along: float, shift_across: float, path_px: Floats,
    radius_px: float, sigma_px: float, surface: Image, box: Whole, min_along: float,
) -> None:  # fmt: skip
    """Draw a ball over `out` within `box`, averaged over its positions `path_px` during the exposure. Shapes: out,
    along, across (height, width); path_px (n_pieces,).
    """
    half = (surface.shape[0] - 1) // 2
    for y in range(box[1], box[3]):
        for x in range(box[0], box[2]):
            v = across[y, x] - shift_across
            if abs(v) >= half - 1:
                continue
            coverage_sum = 0.0
            light_sum = 0.0
            place = along[y, x] - shift_along
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


@njit(cache=True)
def _mixed(z: np.uint64) -> np.uint64:
    """Splitmix64's finaliser (Steele et al. 2014): neighbouring seeds give unrelated streams."""
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return z ^ (z >> np.uint64(31))


@njit(cache=True, fastmath=True, nogil=True)
def expose(
    light: Image, gain: Image, lamp: float, full_well_e: float, read_noise_e: float, seed: int, frame: int,
    normals: Image, tone: Image, low: float, span: float, out: NDArray[np.uint8 | np.uint16],
) -> None:  # fmt: skip
    """Convert radiance to grey levels with shot and read noise, into `out`. Level = low + span · tone(signal); the
    noise of a signal s has standard deviation √(s·well + read²)/well. Shapes: light, gain, out (height, width); normals
    (2^NORMAL_BITS,).
    """
    rows, columns = out.shape
    mask = np.uint64((1 << NORMAL_BITS) - 1)
    steps = tone.size - 1
    per_well = np.float32(1.0 / full_well_e) if full_well_e > 0 else np.float32(0.0)
    read2 = np.float32((read_noise_e * per_well) ** 2)
    linear = steps < 2
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
            if not linear:
                place = signal * steps
                k = min(int(place), steps - 1)
                signal = tone[k] + (place - k) * (tone[k + 1] - tone[k])
            out[y, x] = np.int64(low + span * signal + 0.5)
