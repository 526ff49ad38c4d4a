"""Final speed and energy efficiency against numbers worked out by hand."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from vinetrack.motion.efficiency import energy_efficiency, lead_velocity_at
from vinetrack.records import Trial

VINE = Trial(
    name="v", diameter_m=0.012, thickness_m=100e-6, length_m=0.3, pressure_Pa=34e3, payload_kg=0.0356, travel_ratio=2.0
)


def test_velocity_where_a_position_is_passed_is_interpolated() -> None:
    y, v = np.array([0.0, 0.1, 0.2, 0.4]), np.array([0.0, 1.0, 3.0, 4.0])
    assert lead_velocity_at(y, v, 0.15) == pytest.approx(2.0)
    assert lead_velocity_at(y, v, 0.3) == pytest.approx(3.5)
    assert lead_velocity_at(y, v, 0.2) == pytest.approx(3.0)


def test_velocity_counts_at_the_first_passage() -> None:
    y, v = np.array([0.0, 0.1, 0.21, 0.19, 0.3]), np.array([0.0, 1.0, 2.1, 9.0, 9.0])
    assert lead_velocity_at(y, v, 0.2) == pytest.approx(2.0)


@pytest.mark.parametrize("target_m", [0.41, -0.1, 0.0])
def test_a_place_never_reached_or_behind_the_start_has_no_velocity(target_m: float) -> None:
    assert math.isnan(lead_velocity_at(np.array([0.0, 0.4]), np.array([0.0, 4.0]), target_m))


def test_a_still_pair_of_points_gives_a_velocity_all_the_same() -> None:
    assert lead_velocity_at(np.array([0.0, 0.2, 0.2]), np.array([1.0, 2.0, 5.0]), 0.2) == pytest.approx(2.0)


def test_efficiency_by_hand() -> None:
    """Film of 4.5239 g/m: 0.15 m of 0.3 m left, 0.679 g, and 35.6 g at 2 × 3 m/s, over 34 kPa × 113.1 mm² × 0.15 m."""
    film_kg = 1200 * math.pi * 0.012 * 100e-6 * 0.15
    assert film_kg == pytest.approx(0.679e-3, rel=1e-3)
    truth = 0.5 * (0.0356 + film_kg) * 36 / (34e3 * math.pi * 0.006**2 * 0.15)
    assert energy_efficiency(VINE, 0.15, 3.0) == pytest.approx(truth, rel=1e-12)
    assert truth == pytest.approx(1.132, rel=1e-3)


def test_efficiency_grows_with_the_square_of_the_speed() -> None:
    assert energy_efficiency(VINE, 0.15, 2.0) == pytest.approx(4 * energy_efficiency(VINE, 0.15, 1.0))


def test_a_travel_ratio_of_one_moves_at_the_speed_of_the_edge() -> None:
    whole = replace(VINE, travel_ratio=1.0, thickness_m=math.nan, length_m=math.nan)
    assert energy_efficiency(whole, 0.1, 3.0) == pytest.approx(0.5 * 0.0356 * 9 / (34e3 * VINE.area_m2 * 0.1))


@pytest.mark.parametrize(
    ("trial", "travel_m"),
    [(replace(VINE, pressure_Pa=0.0), 0.15), (VINE, 0.0), (replace(VINE, diameter_m=math.nan), 0.15)],
    ids=["no pressure", "no travel", "no diameter"],
)
def test_without_work_there_is_no_efficiency(trial: Trial, travel_m: float) -> None:
    assert math.isnan(energy_efficiency(trial, travel_m, 3.0))


def test_an_unknown_velocity_has_no_efficiency() -> None:
    assert math.isnan(energy_efficiency(VINE, 0.15, math.nan))
