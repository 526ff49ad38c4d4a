"""Sloped strips cut by compiled loops are OpenCV's but for rounding."""

import cv2
import numpy as np
import pytest

from vinetrack.video.strip import warp_all


@pytest.mark.parametrize("slope", [0.004, -0.03, 0.7])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_a_sloped_strip_is_that_of_opencv(slope, dtype):
    most = np.iinfo(dtype).max
    luma = np.random.default_rng(5).integers(0, most, (3, 90, 200), dtype=dtype, endpoint=True)
    along = np.array([np.cos(slope), np.sin(slope)])
    # From outside the picture, through it, out of it again.
    matrix = np.array([[along[0], -along[1], -4.3], [along[1], along[0], 30.6]])
    strips = warp_all(luma, matrix, 40, 230)
    flags = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
    for frame, strip in zip(luma, strips, strict=True):
        expected = cv2.warpAffine(frame, matrix, (230, 40), flags=flags, borderMode=cv2.BORDER_REPLICATE)
        apart = np.abs(strip.astype(int) - expected)
        assert apart.max() <= 1
        assert np.mean(apart > 0) < (0.001 if dtype == np.uint8 else 0.1)


def test_whole_steps_leave_values_as_they_are():
    luma = np.random.default_rng(6).integers(0, 256, (2, 50, 120), dtype=np.uint8)
    matrix = np.array([[1.0, 0.0, 7.0], [0.0, 1.0, 9.0]])
    np.testing.assert_array_equal(warp_all(luma, matrix, 30, 100), luma[:, 9:39, 7:107])
