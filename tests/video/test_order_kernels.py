"""Compiled medians, steps and means are those of NumPy and OpenCV."""

import cv2
import numpy as np
import pytest

from vinetrack.video.kymograph import block_means, largest_steps, ratio_medians


@pytest.mark.parametrize("side", [1, 3, 4])
def test_means_of_blocks_are_those_of_opencv(side):
    luma = np.random.default_rng(1).integers(0, 256, (3, 12 * side, 20 * side), dtype=np.uint8)
    small = [cv2.resize(frame, (20, 12), interpolation=cv2.INTER_AREA) for frame in luma]
    np.testing.assert_array_equal(block_means(luma, side), np.stack(small))


def test_ratios_have_the_median_of_numpy():
    rng = np.random.default_rng(2)
    pictures = rng.uniform(0, 255, (4, 30, 41)).astype(np.float32)
    reference = rng.uniform(1, 255, (30, 41)).astype(np.float32)
    expected = np.median((pictures + np.float32(1)) / reference, axis=(1, 2))
    np.testing.assert_allclose(ratio_medians(pictures, reference), expected, rtol=1e-6)


def test_the_largest_step_is_where_means_differ_most():
    rng = np.random.default_rng(4)
    pictures = rng.normal(0, 1, (40, 700)).astype(np.float32)
    begin = rng.integers(10, 30, 700)
    pictures[np.arange(40)[:, None] >= begin] += 50
    when, power = largest_steps(pictures, 6)
    np.testing.assert_array_equal(when, begin)
    # Of the means of six frames on either side: 6 * 6 / 12 * 50².
    assert np.median(power) == pytest.approx(3 * 50**2, rel=0.05)
