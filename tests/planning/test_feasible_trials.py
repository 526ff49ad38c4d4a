"""Which trials are looked at for the next experiment: within the limits, held by the film, able to grow."""

from __future__ import annotations

from typing import Any

import pytest

from vinetrack.core.records import Trial
from vinetrack.experiment.schema import with_names
from vinetrack.experiment.settings import Limits
from vinetrack.planning.discriminating_design import NEW_VINE, OTHER_RIG, SAME_RIG, Condition, feasible_conditions


def trial(pressure_kPa: float, **more: Any) -> Trial:
    """A trial of a 24 mm × 200 µm × 280 mm vine, P_y 3 kPa."""
    sizes: dict[str, Any] = {
        "diameter_m": 0.024,
        "thickness_m": 200e-6,
        "length_m": 0.28,
        "pressure_Pa": 1e3 * pressure_kPa,
        "pressure_sigma_Pa": 10 * pressure_kPa,
        "yield_pressure_Pa": 3e3,
        "yield_pressure_sigma_Pa": 200.0,
    }
    return Trial(name=f"t{pressure_kPa:g}", **{**sizes, **more})


def looked_at(trials: list[Trial], **limits: Any) -> list[Condition]:
    """Conditions for an experiment of these trials."""
    return feasible_conditions(with_names(trials), Limits(**limits))


def values(found: list[Condition], name: str, unit: float) -> set[float]:
    return {round(getattr(one.trial, name) / unit, 6) for one in found}


def test_pressures_go_from_the_lowest_used_to_a_quarter_above_the_highest() -> None:
    found = looked_at([trial(14), trial(40)], new_vines=False)
    pressures = values(found, "pressure_Pa", 1e3)
    assert (min(pressures), max(pressures)) == (14, 50)
    assert len(pressures) == 6


def test_no_pressure_bursts_a_vine_by_what_film_is_thought_to_hold() -> None:
    found = looked_at([trial(14), trial(60)], thickness_um=(40.0, 200.0), diameter_mm=(24.0,))
    stress = [one.trial.pressure_Pa * one.trial.diameter_m / 2 / one.trial.thickness_m for one in found]
    assert max(stress) <= 7.8e6 * (1 + 1e-9)
    assert any(one.trial.thickness_m == pytest.approx(40e-6) for one in found)


def test_a_bare_vine_is_not_asked_to_grow_near_its_yield_pressure() -> None:
    found = looked_at([trial(20)], pressure_kPa=(1.0, 20.0), new_vines=False)
    bare = [one.trial.pressure_Pa for one in found if one.trial.payload_kg == 0]
    assert min(bare) == pytest.approx(1.15 * 3e3)
    assert min(one.trial.pressure_Pa for one in found) == 1e3


def test_a_chamber_is_halved_and_doubled_where_it_is_stated_one_thing_at_a_time() -> None:
    found = looked_at([trial(14, chamber_m3=4e-3, inlet_m=8e-3)], new_vines=False)
    rigs = {(round(one.trial.chamber_m3 * 1e3, 3), round(one.trial.inlet_m * 1e3, 3), one.effort) for one in found}
    assert rigs == {(4, 8, SAME_RIG), (2, 8, OTHER_RIG), (8, 8, OTHER_RIG), (4, 5.7, OTHER_RIG), (4, 11, OTHER_RIG)}
    assert {one.changed for one in found} == {(), ("chamber_l",), ("inlet_mm",)}


def test_new_vines_come_only_in_the_sizes_that_are_listed_and_where_wanted() -> None:
    found = looked_at([trial(14)], diameter_mm=(12.0, 24.0), thickness_um=(100.0,), length_mm=(140.0,))
    assert {one.trial.vine for one in found} == {"12mm-100um-140mm", "24mm-100um-140mm"}
    assert {one.effort for one in found} == {NEW_VINE}
    assert looked_at([trial(14)], diameter_mm=(12.0,), new_vines=False) == []


def test_a_vine_of_the_experiment_keeps_its_name_and_a_new_one_is_like_the_nearest() -> None:
    two = [trial(14), trial(30, diameter_m=0.012, thickness_m=100e-6, length_m=0.14)]
    found = looked_at(two, diameter_mm=(12.0, 13.0, 24.0), thickness_um=(100.0, 200.0))
    assert {one.trial.vine for one in found if one.effort == SAME_RIG} == {"24mm-200um-280mm", "12mm-100um-140mm"}
    thirteen = [one for one in found if one.trial.vine.startswith("13mm-100um")]
    assert {one.trial.length_m for one in thirteen} == {0.14}
    assert {one.like for one in thirteen} == {1}
