"""The disagreement of bands against known jitter; seeds 311 and up, which tuned nothing."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import ndtr

from vinetrack.video.axis import Axis
from vinetrack.video.edge_repair import BANDS, band_disagreement, band_fits
from vinetrack.video.edge_state import EdgeState
from vinetrack.video.strip import Strip

ROWS, COLUMNS, N, BLUR = 40, 400, 80, 1.0


def jittered(sd_px, seed=311):
    """A step edge blurred by BLUR whose bands of ten rows are each misplaced by `sd_px`; the state is exact."""
    rng = np.random.default_rng(seed)
    edge = 30.0 + 4.0 * np.arange(N)
    own = edge[:, None] + rng.normal(0, sd_px, (N, BANDS))
    cover = ndtr((np.repeat(own, ROWS // BANDS, axis=1)[:, :, None] - np.arange(COLUMNS)) / BLUR)
    values = 60 + 100 * cover + rng.normal(0, 1, (N, ROWS, COLUMNS))
    strip = Strip(
        np.rint(values * 200).astype(np.uint16), np.full(N, 1 / 200), np.zeros(N), np.zeros((N, 2)), 1.0,
        Axis((0.0, 0.0), (COLUMNS - 1.0, 0.0), float(ROWS)), False,
    )  # fmt: skip
    appearance = np.ones((4, ROWS, COLUMNS), np.float32)
    appearance[0], appearance[1] = 160, 60
    return strip, EdgeState(edge, np.zeros(N), np.zeros(ROWS), BLUR, appearance, np.ones(3)), own


def test_each_band_finds_its_own_edge():
    strip, state, own = jittered(0.4)
    edges, _ = band_fits(strip, state, state.edge)
    assert edges.shape == (N, BANDS)
    assert np.abs(edges - own).max() < 0.1


@pytest.mark.parametrize("sd_px", [0.2, 0.6])
def test_disagreement_is_the_error_of_the_mean(sd_px):
    strip, state, own = jittered(sd_px)
    found, slow_px = band_disagreement(strip, state, state.edge, np.ones(N, dtype=bool))
    true = float(np.std(own.mean(axis=1) - state.edge))
    assert float(np.sqrt(np.mean(found**2))) == pytest.approx(true, rel=0.35)
    # It is another one in every frame.
    assert slow_px < 0.35 * true


def test_a_band_that_always_lags_adds_no_error():
    strip, state, _ = jittered(0.0)
    lagging = np.repeat([0.0, 0.0, 1.5, 0.0], ROWS // BANDS)
    tilted = EdgeState(state.edge, state.lengths, lagging, BLUR, state.appearance, state.inflation)
    error_px, slow_px = band_disagreement(strip, tilted, state.edge, np.ones(N, dtype=bool))
    assert error_px.max() < 0.1
    assert slow_px < 0.05
