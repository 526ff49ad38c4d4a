"""Final speed and energy efficiency against numbers worked out by hand."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from vinetrack.core.records import Trial
from vinetrack.kinematics.summary import efficiency_shares, energy_efficiency, lead_velocity_at

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


@pytest.mark.parametrize(("diameter_m", "share"), [(0.012, 0.1816), (0.018, 0.0807)])
def test_the_weight_of_the_payload_works_beside_the_gas(diameter_m: float, share: float) -> None:
    """35.6 g × 9.81 m/s² × 0.3 m = 0.10477 J, beside 34 kPa × 0.15 m × 113.10 or 254.47 mm² = 0.57679 or 1.29777 J."""
    no_film = replace(VINE, diameter_m=diameter_m, thickness_m=1e-12)
    assert efficiency_shares(no_film, 0.15).weight == pytest.approx(share, rel=1e-3)


def test_the_weight_of_the_film_shrinks_as_it_runs_out() -> None:
    """Film of 4.5239 g/m, 0.3 m of it: x = 0.3 m of tail travel leave half, so that 1.01788 g work on the average."""
    bare = replace(VINE, payload_kg=0.0)
    work_J = 1.017876e-3 * 9.81 * 0.3
    assert efficiency_shares(bare, 0.15).weight == pytest.approx(work_J / (34e3 * 1.130973e-4 * 0.15), rel=1e-5)


def test_film_that_has_run_out_weighs_nothing_more() -> None:
    """With c = λ a bare vine is empty half-way: beyond, its weight has done all its work, ½ λ L²."""
    printed = replace(VINE, payload_kg=0.0, mass_loss="as_printed")
    work_J = 0.5 * printed.linear_density_kg_m * 0.3**2 * 9.81
    gas_J = 34e3 * VINE.area_m2 * 0.25
    assert efficiency_shares(printed, 0.25).weight == pytest.approx(work_J / gas_J, rel=1e-12)


@pytest.mark.parametrize(("angle_deg", "factor"), [(0, 1.0), (60, 0.5), (90, 0.0), (180, -1.0)])
def test_only_growth_downwards_is_helped_by_the_weight(angle_deg: float, factor: float) -> None:
    tilted = replace(VINE, growth_angle_rad=math.radians(angle_deg))
    assert efficiency_shares(tilted, 0.15).weight == pytest.approx(
        factor * efficiency_shares(VINE, 0.15).weight, abs=1e-12
    )


def test_the_payload_is_most_of_what_moves() -> None:
    """0.679 g of film are left beside 35.6 g."""
    assert efficiency_shares(VINE, 0.15).payload == pytest.approx(35.6 / 36.2786, rel=1e-4)
    assert efficiency_shares(replace(VINE, payload_kg=0.0), 0.15).payload == 0


def test_without_mass_or_work_there_are_no_shares() -> None:
    empty = replace(VINE, payload_kg=0.0)
    assert math.isnan(efficiency_shares(empty, 0.3).payload)
    assert math.isnan(efficiency_shares(replace(VINE, pressure_Pa=0.0), 0.15).weight)
