"""Compiled loops against plain ones: the same sums, written without tables, vectors or shortcuts."""

from __future__ import annotations

import math

import numpy as np
import pytest

from vinetrack.video import edge_kernels
from vinetrack.video import edge_kernels as kernels
from vinetrack.video.axis import Axis
from vinetrack.video.kymograph import median, monotone_path_sums
from vinetrack.video.strip import _pixels, reference_pixels, sample


@pytest.mark.parametrize(("length", "blur"), [(0.0, 0.4), (0.02, 3.0), (4.3, 0.8), (17.0, 1.6)])
def test_a_table_of_covers_is_the_normal_distribution_averaged_over_the_motion(length: float, blur: float) -> None:
    half = 6.0 + 0.5 * length + 4 * blur
    table = edge_kernels.coverage_table(length, blur, half)
    middle = math.ceil(half) + 1
    x = (
        middle
        - np.arange(table.shape[2])
        + edge_kernels.TABLE_STEP_PX * np.arange(edge_kernels.SUBPIXEL_STEPS + 1)[:, None]
    )
    # A box of many Gaussian steps, summed one by one.
    places = np.linspace(-0.5, 0.5, 401) * max(length, 0.02)
    expected = np.zeros_like(x)
    for place in places[1:-1:2]:
        expected += np.vectorize(lambda z: 0.5 * math.erfc(-z / math.sqrt(2)))((x - place) / blur) / 200
    assert np.abs(table[0] - expected).max() < 2e-5
    assert (
        np.abs(table[1, :, 1:-1] - np.gradient(expected, edge_kernels.TABLE_STEP_PX, axis=0)[:, 1:-1]).max()
        < 0.01 / blur
    )


LAG = 0.02 * (np.arange(9) - 4.0) ** 2
NO_SHADING = np.zeros(65)
RIM = 40 * np.exp(-0.5 * ((np.arange(65) - 32 + 4.0) / 2.0) ** 2)
"""Shading of a tip with a bright rim 4 px behind its edge, grey levels, by distance ahead of it from −32 px on."""


def shaded(distance: np.ndarray) -> np.ndarray:
    """What the rim adds, linear between whole distances ahead of the edge, grey levels."""
    return np.interp(distance, np.arange(65) - 32.0, RIM, left=0.0, right=0.0)


def stepping(seed: int = 961, rim: bool = False, contrast: float = 110.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A strip with a noisy edge, its place, and brightness and variances on either side."""
    rng = np.random.default_rng(seed)
    edge = 30.31 + 3.73 * np.arange(16)
    x = np.arange(120)
    cover = np.clip(edge[:, None, None] - LAG[:, None] - x + 0.5, 0, 1)
    pictures = np.stack([40 + contrast + rng.normal(0, 9, (9, 120)), 40 + rng.normal(0, 9, (9, 120)),
                         np.full((9, 120), 12.0), np.full((9, 120), 9.0)]).astype(np.float32)  # fmt: skip
    values = pictures[1] + cover * (pictures[0] - pictures[1]) + rng.normal(0, 3, cover.shape)
    if rim:
        values = values + shaded(x - (edge[:, None, None] - LAG[:, None]))
    return np.clip(values, 0, 255).astype(np.uint8), edge, pictures


def test_evidence_of_film_is_the_difference_of_clipped_distances() -> None:
    strip, _, pictures = stepping()
    scale, offset = np.linspace(0.9, 1.1, 16), np.linspace(-2, 2, 16)
    level = strip * scale[:, None, None] + offset[:, None, None]
    a = np.minimum((level - pictures[0]) ** 2 / (pictures[2] + 25.0), kernels.FILM_CLIP_RATIO * 6.25)
    b = np.minimum((level - pictures[1]) ** 2 / (pictures[3] + 25.0), 6.25)
    found = kernels.film_evidence(strip, scale, offset, pictures, 5.0, 2.5)
    assert np.allclose(found, (a - b - kernels.FILM_BIAS).sum(axis=1), atol=1e-3)


def test_what_is_seen_bare_and_covered_is_counted_apart_and_strays_hardly() -> None:
    strip, edge, pictures = stepping()
    strip = strip.copy()
    strip[3, 4, 100] = 255  # a glint on the background, long before the edge comes
    scale, offset, zeros = np.ones(16), np.zeros(16), np.zeros(16)
    early, late = (np.interp(np.arange(120) + d, edge, np.arange(16.0)) for d in (-4, 4))
    seen = [
        edge_kernels.gather(
            strip, scale, offset, edge, zeros, np.zeros(9), 0.5, early, late, 6.0, pictures, clip, NO_SHADING
        )
        for clip in (0.0, 10.0)
    ]
    frames = np.arange(16)
    weight = np.where(frames <= early[100], np.exp(-(early[100] - frames) / 6.0), 1.0)[frames <= early[100]]
    before = strip[: len(weight), 4, 100].astype(float)
    assert seen[0][5, 4, 100] == pytest.approx(weight.sum(), rel=1e-5)
    assert seen[0][6, 4, 100] == pytest.approx((weight * before).sum(), rel=1e-5)
    after = strip[:, 4, 31].astype(float)[frames >= late[31]]
    assert seen[0][10, 4, 31] / seen[0][8, 4, 31] == pytest.approx(np.mean(after**2), rel=0.05)
    level = [sums[6, 4, 100] / sums[5, 4, 100] - pictures[1, 4, 100] for sums in seen]
    assert abs(level[1]) < 2.0 < level[0]


def test_the_edge_of_every_frame_is_found_in_noise() -> None:
    strip, edge, pictures = stepping()
    start = edge + 1.4
    start[5] = np.nan
    fit = kernels.fit_edges(
        strip, np.ones(16), np.zeros(16), start, np.zeros(16), LAG, 0.4, pictures, np.ones(3), 0.15, 6.0, 12,
        NO_SHADING, np.arange(16), (0, 9),
    )  # fmt: skip
    assert np.isnan(fit[5]).all()
    sound = np.arange(16) != 5
    assert np.abs(fit[sound, 0] - edge[sound]).max() < 0.08
    assert np.median(fit[sound, 1]) == pytest.approx(
        0.0112, rel=0.15
    )  # 110 grey levels, variance 10.5: (9 · 110² / 10.5 / 2√π 0.4)^−½


@pytest.mark.parametrize("contrast", [110.0, -15.0, 0.0])
def test_a_rim_that_moves_with_the_tip_tells_of_its_edge_even_where_film_looks_like_background(contrast: float) -> None:
    strip, edge, pictures = stepping(rim=True, contrast=contrast)
    known, ignored = (
        kernels.fit_edges(
            strip, np.ones(16), np.zeros(16), edge - 1.4, np.zeros(16), LAG, 0.4, pictures, np.ones(3), 0.15, 6.0, 12,
            shading, np.arange(16), (0, 9),
        )[:, 0] - edge
        for shading in (RIM, NO_SHADING)
    )  # fmt: skip
    assert np.abs(known).max() < 0.15
    assert np.abs(ignored).max() > 2 * np.abs(known).max()


def test_the_rim_is_no_part_of_what_film_looks_like() -> None:
    bare, edge, pictures = stepping()
    strip, *_ = stepping(rim=True)
    zeros = np.zeros(16)
    early, late = (np.interp(np.arange(120) + d, edge, np.arange(16.0)) for d in (-4, 4))
    clean, freed, ignored = (
        edge_kernels.gather(seen, np.ones(16), zeros, edge, zeros, LAG, 0.5, early, late, 6.0, pictures, 0.0, shading)
        for seen, shading in ((bare, NO_SHADING), (strip, RIM), (strip, NO_SHADING))
    )
    film = slice(31, 80)  # columns that the rim has crossed
    level = [sums[9, 4, film] / sums[8, 4, film] for sums in (clean, freed, ignored)]
    assert np.abs(level[1] - level[0]).max() < 1.0
    assert np.mean(level[2] - level[0]) > 2.0


def test_what_a_fit_leaves_is_summed_by_distance_by_row_and_in_all() -> None:
    strip, edge, pictures = stepping(rim=True)
    blur, margin = 0.8, 6.0
    fit = np.column_stack([edge, np.zeros((16, 2)), np.full(16, 0.03), np.full(16, -0.02), np.zeros(16)])
    use = np.arange(16) % 3 != 0
    steady, frames = (strip, np.ones(16), np.zeros(16)), np.flatnonzero(use)
    arguments = (*steady, fit, np.zeros(16), LAG, blur, pictures, margin, frames, 0.5 * RIM)
    sums = "distance_sums", "row_sums", "misfit_sums", "place_sums"
    found = [getattr(edge_kernels, name)(*arguments).sum(axis=0) for name in sums]
    half = edge_kernels.coverage_reach(0.0, blur) + margin
    by_distance, by_row, by_place, logs = np.zeros_like(found[0]), np.zeros((9, 2)), np.zeros((65, 2)), []
    for t in np.flatnonzero(use):
        columns: dict[int, np.ndarray] = {}
        for u in range(9):
            for s in range(120):
                x = edge[t] - LAG[u] - s
                if abs(x) > half or s > edge[t] + half:
                    continue
                p = 0.5 * math.erfc(-x / blur / math.sqrt(2))
                slope = math.exp(-0.5 * (x / blur) ** 2) / blur / math.sqrt(2 * math.pi)
                after, before, va, vb = pictures[:, u, s].astype(float)
                r = strip[t, u, s] - before - (after - before) * (1.03 * p - 0.02) - 0.5 * float(shaded(np.array(-x)))
                v = p**2 * va + (1 - p) ** 2 * vb
                w, g = 1 / (v + r * r / 9), -(after - before) * slope
                ahead, part = divmod(-x, 1.0)
                by_place[int(ahead) + 32] += (1 - part) * w * np.array([r, 1.0])
                by_place[int(ahead) + 33] += part * w * np.array([r, 1.0])
                i = int(len(by_distance) // 2 - x)
                columns[i] = columns.get(i, np.zeros(2)) + w * (after - before) * np.array([r, after - before])
                by_row[u] += w * g * np.array([r, g])
                logs.append(math.log(1 + r * r / (4.5 * (va + vb))))
        for i, (top, square) in columns.items():
            by_distance[i] += top**2 / square, 1
    assert np.allclose(found[0], by_distance, rtol=0.01, atol=0.02)
    assert np.allclose(found[1], by_row, rtol=0.01, atol=0.02 * np.abs(by_row).max())
    assert found[2] == pytest.approx([np.sum(logs), len(logs)], rel=1e-3)
    assert np.allclose(found[3].T, by_place, rtol=0.01, atol=0.01 * np.abs(by_place).max(axis=0))


def test_paths_across_a_fan_collect_what_a_plain_search_collects() -> None:
    rng = np.random.default_rng(962)
    count, bins, length, n_times = 400, 7, 160, 40
    time = np.sort(rng.integers(0, n_times, count)).astype(float)
    along = np.clip(4 * time + rng.normal(0, 12, count), 0, length)
    across, weight = rng.uniform(0, bins, count), rng.uniform(1, 5, count)
    table = np.zeros((bins, n_times, length // 4 + 1), np.float32)
    for i in range(count):
        table[int(across[i]), int(time[i]), int(along[i] / 4)] += weight[i]
    expected = []
    for pair in table[:-1] + table[1:]:
        best = np.zeros(length // 4 + 2)
        for line in pair:
            for s in range(1, len(best)):
                best[s] = max(best[s], best[s - 1] + line[s - 1])
        expected.append(best[-1])
    assert np.allclose(monotone_path_sums(along, across, time, weight, bins, length, n_times), expected, rtol=1e-5)


@pytest.mark.parametrize("count", [1, 2, 4999, 5000])
@pytest.mark.parametrize("step", [0.0, 1e-3, 0.5], ids=["free", "fine steps", "coarse steps"])
def test_a_median_by_histogram_is_the_median(count: int, step: float) -> None:
    values = np.abs(np.random.default_rng(963).normal(0, 3, count))
    values = np.round(values / step) * step if step else values
    values[0] = 1e4 if count > 2 else values[0]  # beyond the last bin
    for kept in ((values > 0.3) | (count < 3), values >= 0, values < 0.04):
        expected = np.median(values[kept]) if kept.any() else 0.0
        assert median(values, kept.astype(float), 16.0) == expected


def test_a_median_beyond_the_last_bin_is_the_median() -> None:
    values = np.linspace(400, 5000, 1001)
    assert median(values, np.ones(1001), 16.0) == np.median(values)


@pytest.mark.parametrize("shake", [None, np.array([[0.6, -0.3], [0.0, 0.2], [-1.2, 0.4]])])
def test_single_pixels_of_a_strip_are_those_of_the_whole_strip(shake: np.ndarray | None) -> None:
    import cv2

    rng = np.random.default_rng(964)
    luma = cv2.GaussianBlur(rng.uniform(0, 255, (3 * 90, 140)).astype(np.float32), (0, 0), 2.5)
    luma = np.clip((luma - 127) * 6 + 127, 0, 255).astype(np.uint8).reshape(3, 90, 140)
    axis, rows = Axis((10.0, 30.0), (125.0, 52.0)), [np.arange(-18, -10), np.arange(10, 18)]
    views = [sample(luma, axis, band, shake) for band in rows]
    means = [np.median(view, axis=0).astype(np.float32) for view in views]
    reference = reference_pixels(means, rows)
    whole = np.concatenate([view[:, 1:-1, 1:-1].reshape(3, -1) for view in views], axis=1).astype(int)
    apart = np.abs(_pixels(luma, axis, reference, shake).astype(int) - whole)
    assert apart.max() <= 6
    assert apart.mean() < 0.5
