"""The guesses for vines nobody has measured: they join what is printed, and say how far they may be off."""

from __future__ import annotations

import math

import numpy as np
import pytest

from vinetrack.core import published
from vinetrack.experiment.settings import Limits
from vinetrack.planning import predictive_inputs as guess


def printed(scale: int) -> tuple[float, float]:
    return 1e-3 * published.DIAMETER_MM[scale], 1e-6 * published.THICKNESS_UM[scale]


def test_the_guess_is_exact_for_the_largest_printed_vine_and_within_a_fifth_for_all() -> None:
    assert guess.damping_prior(*printed(4)) == pytest.approx(6.44)
    for scale, B in published.DAMPING_B.items():
        assert guess.damping_prior(*printed(scale)) == pytest.approx(B, rel=0.18)


def test_b_rises_linearly_with_the_wall_at_one_diameter() -> None:
    assert guess.damping_prior(12e-3, 200e-6) == pytest.approx(2 * guess.damping_prior(12e-3, 100e-6))


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


def test_exchanging_exponents_leaves_every_printed_vine_where_it_is() -> None:
    assert all(abs(guess.split_leverage(*printed(scale))) < 1e-12 for scale in published.DAMPING_B)
    # 100 µm on 25 mm against 200 µm on 24 mm: ln(4/8.333) = −0.734.
    assert guess.split_leverage(25e-3, 100e-6) == pytest.approx(-0.734, abs=1e-3)


def test_the_fast_vine_was_grown_just_under_its_burst_pressure() -> None:
    stress = guess.hoop_stress_Pa(62e3, 25e-3, 100e-6)
    assert stress == pytest.approx(7.75e6)
    assert 0.99 < stress / guess.BURST_STRESS_PA < 1
    assert guess.hoop_stress_Pa(guess.burst_pressure_Pa(18e-3, 150e-6), 18e-3, 150e-6) == pytest.approx(7.8e6)


def test_the_next_experiment_trusts_film_to_hold_as_much_as_a_design_does() -> None:
    assert 1e6 * Limits().hoop_stress_MPa == guess.BURST_STRESS_PA
