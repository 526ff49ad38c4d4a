"""A pressure in psi under the name of kPa shows in the speeds; other films do not."""

from __future__ import annotations

from dataclasses import replace

import pytest

from vinetrack.core import published
from vinetrack.core.records import Trial
from vinetrack.planning.predictive_inputs import damping_prior, pressure_problems

PSI = 6.894757


def campaign(damping: float = 1.0) -> list[tuple[Trial, float]]:
    """Speeds by F = B·ẋⁿ with the prior's B times `damping`, at three pressures."""
    pairs = []
    for i, kPa in enumerate((24, 30, 60)):
        trial = Trial(
            name=f"t{i}", diameter_m=0.012, thickness_m=1e-4, length_m=0.14, pressure_Pa=1e3 * kPa,
            yield_pressure_Pa=3e3,
        )  # fmt: skip
        force = (trial.pressure_Pa - trial.yield_pressure_Pa) * trial.area_m2
        tail = (force / (damping * damping_prior(0.012, 1e-4))) ** (1 / published.EXPONENT)
        pairs.append((trial, tail / 2))
    return pairs


@pytest.mark.parametrize("damping", [0.3, 1.0, 3.0])
def test_a_right_campaign_brings_nothing(damping: float) -> None:
    assert pressure_problems(campaign(damping)) == []


@pytest.mark.parametrize("yield_factor", [1.0, PSI])
def test_psi_under_the_name_of_kpa_is_suspected(yield_factor: float) -> None:
    wrong = [
        (replace(t, pressure_Pa=t.pressure_Pa / PSI, yield_pressure_Pa=t.yield_pressure_Pa / yield_factor), v)
        for t, v in campaign()
    ]
    (problem,) = pressure_problems(wrong)
    assert problem.severity == "warning"
    assert "looks like psi, not kPa (1 psi is 6.895 kPa)" in problem.message


def test_kpa_under_the_name_of_psi_is_suspected() -> None:
    wrong = [(replace(t, pressure_Pa=t.pressure_Pa * PSI), v) for t, v in campaign()]
    (problem,) = pressure_problems(wrong)
    assert "looks like kPa, not psi" in problem.message


def test_absolute_pressures_are_suspected() -> None:
    (problem,) = pressure_problems(
        [(replace(t, pressure_Pa=t.pressure_Pa + t.ambient_pressure_Pa), v) for t, v in campaign()]
    )
    assert "looks like absolute pressure" in problem.message
    assert problem.severity == "warning"


def test_high_gauge_pressures_of_stiff_film_are_not_absolute() -> None:
    assert pressure_problems([(replace(t, pressure_Pa=t.pressure_Pa + 101_325.0), v) for t, v in campaign(100.0)]) == []


def test_a_film_that_no_unit_explains_brings_nothing() -> None:
    assert pressure_problems(campaign(100.0)) == []


def test_falling_bodies_are_passed_over() -> None:
    ball = Trial(name="b", diameter_m=0.02, travel_ratio=1, pressure_Pa=0.0, yield_pressure_Pa=0.0)
    assert pressure_problems([(ball, 2.0)]) == []
