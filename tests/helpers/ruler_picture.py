"""A photograph of a ruler: millimetre marks, longer at 5 and 10, turned, seen askew, blurred, on a grained table."""

import math

import cv2
import numpy as np
from numpy.typing import NDArray


def ruler_picture(
    seed: int, px_mm: float, turned_deg: float, length_mm: int, *, askew: float = 0.0, blur_px: float = 0.9,
    size: tuple[int, int] = (700, 480), marks_mm: float = 1.0, ink: int = 40, wood: int = 200,
) -> NDArray[np.uint8]:  # fmt: skip
    """Grey levels of shape (height, width); at millimetre m from the middle a mark lies at `px_mm` m / (1 + `askew` m)
    px from the middle of the picture, along a line `turned_deg` from +x towards +y.
    """
    rng, fine, (width, height) = np.random.default_rng(seed), 4, size
    across, down = np.meshgrid(np.arange(width * fine) / fine, np.arange(height * fine) / fine)
    c, s = math.cos(math.radians(turned_deg)), math.sin(math.radians(turned_deg))
    x, y = across - width / 2, down - height / 2
    along_px = x * c + y * s
    mm = along_px / (px_mm - askew * along_px)
    aside_mm = (y * c - x * s) / px_mm * (1 + askew * mm)
    grain = cv2.GaussianBlur(rng.normal(size=across.shape).astype(np.float32), (0, 0), 8)
    picture = 110 + 25 * grain / grain.std()
    picture[(abs(mm) < length_mm / 2 + 6) & (aside_mm > -1) & (aside_mm < 24)] = wood
    count = np.round((mm + length_mm / 2) / marks_mm)
    tall_mm = np.where(count % 10 == 0, 9.0, np.where(count % 5 == 0, 6.8, 4.4))
    on = (abs(mm + length_mm / 2 - count * marks_mm) < 0.13) & (count >= 0) & (count * marks_mm <= length_mm + 0.1)
    picture[on & (aside_mm > 0) & (aside_mm < tall_mm)] = ink
    # A lens blurs before pixels sample: blurred after, marks of 2.5 px/mm would alternate as every second mark does.
    small = cv2.resize(cv2.GaussianBlur(picture, (0, 0), fine * blur_px), size, interpolation=cv2.INTER_AREA)
    return np.clip(small + rng.normal(0, 2.5, small.shape), 0, 255).astype(np.uint8)
