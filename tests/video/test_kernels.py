"""Compiled loops against plain ones, NumPy and OpenCV."""

import os
import subprocess
import sys

import numpy as np
import pytest

from vinetrack.video import edge_kernels as kernels
from vinetrack.video.axis import axis_through
from vinetrack.video.strip import steadied

LAG = 0.02 * (np.arange(9) - 4.0) ** 2
RIM = 40 * np.exp(-0.5 * ((np.arange(65) - 32 + 4.0) / 2.0) ** 2)
"""Shading of a tip with a bright rim 4 px behind its edge, grey levels, by distance ahead of it from −32 px on."""


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
        ahead = x - (edge[:, None, None] - LAG[:, None])
        values = values + np.interp(ahead, np.arange(65) - 32.0, RIM, left=0.0, right=0.0)
    return np.clip(values, 0, 255).astype(np.uint8), edge, pictures


def fitted(strip: np.ndarray, start: np.ndarray, pictures: np.ndarray, shading: np.ndarray) -> np.ndarray:
    fixed = (np.zeros(16), LAG, 0.4, pictures, 0.15, 6.0, 12)
    return kernels.fit_edges(strip, np.ones(16), np.zeros(16), start, *fixed, shading, np.arange(16))


@pytest.mark.parametrize("contrast", [110.0, -15.0, 0.0])
def test_a_rim_that_moves_with_the_tip_tells_of_its_edge_even_where_film_looks_like_background(contrast):
    strip, edge, pictures = stepping(rim=True, contrast=contrast)
    known, ignored = (fitted(strip, edge - 1.4, pictures, shading)[:, 0] - edge for shading in (RIM, 0 * RIM))
    assert np.abs(known).max() < 0.15
    assert np.abs(ignored).max() > 2 * np.abs(known).max()


FITS = "from test_kernels import *; s, e, p = stepping(); print(fitted(s, e + 1.4, p, RIM).tobytes().hex())"


@pytest.mark.slow
def test_a_fit_is_the_same_to_the_last_digit_in_the_process_that_compiles_it_and_in_later_ones(tmp_path):
    where = {"NUMBA_CACHE_DIR": str(tmp_path), "PYTHONPATH": os.pathsep.join(sys.path)}
    run = [sys.executable, "-c", FITS]
    first, later = (subprocess.run(run, env=os.environ | where, capture_output=True, check=True) for _ in range(2))
    assert first.stdout == later.stdout


def test_a_background_that_is_black_along_half_of_the_growth_is_no_flicker():
    picture = np.random.default_rng(1).integers(20, 200, (80, 160)).astype(np.uint8)
    picture[:, :100] = 0
    scale = steadied(np.stack([picture] * 6), axis_through(((10, 40), (150, 40)), 6.0), 5)[0]
    np.testing.assert_allclose(scale, 1.0, atol=1e-3)
