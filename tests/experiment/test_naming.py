"""Which columns of the sheet make two trials different conditions, and which leave them replicates."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from vinetrack.core.records import Bend, Trial
from vinetrack.experiment.schema import COLUMNS, with_names

TRIAL = Trial(
    name="a", diameter_m=0.024, thickness_m=200e-6, length_m=0.28, pressure_Pa=28e3, yield_pressure_Pa=3e3, inlet_m=8e-3
)

ALWAYS_COMPARED = {"diameter_mm", "thickness_um", "length_mm", "pressure_kPa", "yield_pressure_kPa", "payload_g"}
"""Columns of a vine's name and of every condition's name, and the yield pressure, which a vine's trials share."""

OF_A_REPLICATE = {
    "trial",
    "use",
    "order",
    "specimen",
    "day",
    *("video", "track", "point_mass", "frames_used", "axis", "steady", "mm_per_px", "compare_sizes"),
    *("capture_fps", "capture_fps_is_playback", "exposure_us"),
    *("pressure_trace", "pressure_sigma_kPa", "yield_pressure_sigma_kPa"),
}
"""Columns in which replicates may differ: they say how a trial was recorded and read, which trial of several it is, and
how well its numbers are known, not what was done to the vine."""

OTHER_VALUES = {"bends": (Bend(0.1, 0.05, 0.03),), "travel_ratio": 1.0}


def conditions(field: str, value: Any) -> set[str]:
    """Names of the conditions of a trial and of one with another value of a field."""
    return {trial.condition for trial in with_names([TRIAL, replace(TRIAL, **{"name": "b", field: value})])}


def test_every_column_says_whether_it_defines_a_condition() -> None:
    # A new column is either given a `condition_part`, or named above: else different settings count as replicates.
    shown = {name for name, column in COLUMNS.items() if column.condition_part}
    assert shown | ALWAYS_COMPARED | OF_A_REPLICATE == set(COLUMNS)
    assert not shown & (ALWAYS_COMPARED | OF_A_REPLICATE)


@pytest.mark.parametrize("name", [name for name in COLUMNS if name not in OF_A_REPLICATE])
def test_trials_that_differ_in_a_setting_are_two_conditions(name: str) -> None:
    column = COLUMNS[name]
    value = OTHER_VALUES[name] if name in OTHER_VALUES else column.to_si(7.0)
    assert len(conditions(column.field, value)) == 2


@pytest.mark.parametrize("name", sorted(name for name in OF_A_REPLICATE if COLUMNS[name].kind == "number"))
def test_trials_that_differ_in_how_they_were_recorded_are_replicates(name: str) -> None:
    assert len(conditions(COLUMNS[name].field, COLUMNS[name].to_si(7.0))) == 1


@pytest.mark.parametrize(
    ("field", "value", "parts"),
    [
        ("growth_angle_rad", 1.5707963267948966, {"0deg", "90deg"}),
        ("chamber_m3", 3.7e-3, {"", "chamber3.7l"}),
        ("inlet_m", 5.7e-3, {"inlet8mm", "inlet5.7mm"}),
        ("bends", (Bend(0.1, 0.05, 0.03), Bend(0.2, 0.06, 0.04)), {"", "bends100x50x30-200x60x40"}),
        ("film_density_kg_m3", 920.0, {"film1200", "film920"}),
        ("travel_ratio", 1.0, {"ratio2", "ratio1"}),
    ],
)
def test_the_name_of_a_condition_shows_what_differs(field: str, value: Any, parts: set[str]) -> None:
    base = "24mm-200um-280mm_28kPa_0g"
    assert conditions(field, value) == {f"{base}_{part}".rstrip("_") for part in parts}


def test_bends_stand_last_in_the_name_of_a_condition() -> None:
    other = replace(TRIAL, name="b", bends=(Bend(0.1, 0.05, 0.03),), film_density_kg_m3=920.0, growth_angle_rad=0.0)
    assert with_names([TRIAL, other])[1].condition == "24mm-200um-280mm_28kPa_0g_film920_bends100x50x30"
