"""The guesses for vines nobody has measured: they join what is printed, and say how far they may be off."""

from __future__ import annotations

import math

import numpy as np
import pytest

from vinetrack.core import published
from vinetrack.planning import predictive_inputs as guess


def printed(scale: int) -> tuple[float, float]:
    return 1e-3 * published.DIAMETER_MM[scale], 1e-6 * published.THICKNESS_UM[scale]


def test_the_guess_is_exact_for_the_largest_printed_vine_and_within_a_fifth_for_all() -> None:
    assert guess.damping_prior(*printed(4)) == pytest.approx(6.44)
    for scale, B in published.DAMPING_B.items():
        assert guess.damping_prior(*printed(scale)) == pytest.approx(B, rel=0.18)


def test_the_scatter_is_that_of_the_four_printed_values_by_hand() -> None:
    # 6.44 (R/4)^1.75 = 0.5692, 1.9146, 3.8927, 6.44 against 0.57, 1.83, 4.54, 6.44; two of four numbers are used up.
    off = np.log([0.57 / 0.5692, 1.83 / 1.9146, 4.54 / 3.8927, 1.0])
    assert guess.damping_scatter() == pytest.approx(math.sqrt(np.sum(off**2) / 2), rel=1e-3)


def test_the_error_of_the_guess_is_that_of_a_regression_read_off_beyond_its_points() -> None:
    z = np.log([guess.damping_prior(*printed(scale)) for scale in published.DAMPING_B])
    design = np.column_stack([np.ones(4), z])
    for size in ((25e-3, 100e-6), (2.5e-3, 50e-6), (100e-3, 400e-6)):
        row = np.array([1.0, math.log(guess.damping_prior(*size))])
        expected = guess.damping_scatter() * math.sqrt(1 + row @ np.linalg.inv(design.T @ design) @ row)
        assert guess.damping_log_sigma(*size) == pytest.approx(expected)
