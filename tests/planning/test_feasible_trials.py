"""Which trials are looked at for the next experiment: within the limits, held by the film, able to grow."""

from __future__ import annotations

import math
from dataclasses import replace
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


def test_a_pressure_that_a_vine_has_held_is_not_forbidden_by_a_guess_but_by_the_user() -> None:
    high = [trial(100, thickness_m=100e-6, diameter_m=0.03), trial(50, thickness_m=100e-6, diameter_m=0.03)]
    assert max(values(looked_at(high, new_vines=False), "pressure_Pa", 1e3)) == 100
    told = looked_at(high, new_vines=False, hoop_stress_MPa=9.0)
    assert max(values(told, "pressure_Pa", 1e3)) == pytest.approx(60)


def test_a_bare_vine_is_not_asked_to_grow_near_its_yield_pressure() -> None:
    found = looked_at([trial(20)], pressure_kPa=(1.0, 20.0), new_vines=False)
    bare = [one.trial.pressure_Pa for one in found if one.trial.payload_kg == 0]
    assert min(bare) == pytest.approx(1.15 * 3e3)
    assert min(one.trial.pressure_Pa for one in found) == 1e3


def test_payloads_are_none_the_heaviest_used_and_those_between() -> None:
    used = [trial(14, payload_kg=0.02), trial(20, payload_kg=0.0356)]
    assert values(looked_at(used, new_vines=False), "payload_kg", 1e-3) == {0, 20, 35.6}
    assert values(looked_at([trial(14)], new_vines=False), "payload_kg", 1e-3) == {0, 50}
    assert values(looked_at(used, new_vines=False, payload_g=(10.0, 30.0)), "payload_kg", 1e-3) == {10, 20, 30}


def test_a_chamber_is_halved_and_doubled_where_it_is_stated_one_thing_at_a_time() -> None:
    found = looked_at([trial(14, chamber_m3=4e-3, inlet_m=8e-3)], new_vines=False)
    rigs = {(round(one.trial.chamber_m3 * 1e3, 3), round(one.trial.inlet_m * 1e3, 3), one.effort) for one in found}
    assert rigs == {(4, 8, SAME_RIG), (2, 8, OTHER_RIG), (8, 8, OTHER_RIG), (4, 5.7, OTHER_RIG), (4, 11, OTHER_RIG)}
    assert {one.changed for one in found} == {(), ("chamber_l",), ("inlet_mm",)}


def test_a_rig_that_is_not_stated_is_left_alone() -> None:
    found = looked_at([trial(14)], new_vines=False, chamber_l=(1.0, 2.0))
    assert all(math.isnan(one.trial.chamber_m3) and one.effort == SAME_RIG for one in found)


def test_where_nothing_of_the_rig_is_to_be_had_any_more_all_of_it_changes() -> None:
    found = looked_at(
        [trial(14, chamber_m3=4e-3, inlet_m=8e-3)], new_vines=False, chamber_l=(1.0,), inlet_mm=(5.0, 6.0)
    )
    rigs = {(round(one.trial.chamber_m3 * 1e3, 3), round(one.trial.inlet_m * 1e3, 3)) for one in found}
    assert rigs == {(1, 5), (1, 6)}
    assert {one.effort for one in found} == {OTHER_RIG}


def test_a_connector_is_not_wider_than_the_vine() -> None:
    found = looked_at([trial(14, inlet_m=20e-3)], new_vines=False, inlet_mm=(10.0, 20.0, 30.0))
    assert values(found, "inlet_m", 1e-3) == {10, 20}


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


def test_walls_thicker_than_a_quarter_of_the_diameter_are_no_tubes() -> None:
    found = looked_at([trial(14)], diameter_mm=(0.6,), thickness_um=(100.0, 200.0))
    assert values(found, "thickness_m", 1e-6) == {100}


def test_many_new_vines_are_thinned_to_those_that_differ_most() -> None:
    found = looked_at([trial(14)], diameter_mm=tuple(range(5, 25)), thickness_um=(50.0, 100.0, 150.0, 200.0))
    new = {one.trial.vine for one in found if one.effort == NEW_VINE}
    assert len(new) == 10
    assert {"5mm-50um-280mm", "5mm-200um-280mm", "21mm-50um-280mm", "23mm-200um-280mm"} <= new


def test_a_body_that_moves_as_a_whole_has_no_next_trial() -> None:
    ball = Trial(name="ball", travel_ratio=1.0, pressure_Pa=0.0, payload_kg=2.7e-3)
    assert looked_at([ball]) == []
    with_vine = looked_at([replace(ball, vine="ball"), trial(14)], new_vines=False)
    assert {one.like for one in with_vine} == {1}
