"""What `vinetrack settings` lists is what is read."""

from __future__ import annotations

import dataclasses
from pathlib import Path

from vinetrack.core.records import Trial
from vinetrack.experiment.reference import (
    column_entries,
    picture_entries,
    reference_content,
    reference_lines,
    reference_page,
    setting_entries,
)
from vinetrack.experiment.schema import COLUMNS, LIMITED
from vinetrack.experiment.settings import ExperimentSettings, RunSettings


def test_every_column_and_key_has_a_meaning() -> None:
    entries = [*column_entries(), *setting_entries(ExperimentSettings), *setting_entries(RunSettings)]
    assert not [entry.name for entry in entries if not entry.meaning]


def test_every_key_of_both_files_is_listed_once() -> None:
    names = [entry.name for entry in setting_entries(ExperimentSettings)] + [entry.name for entry in column_entries()]
    assert {name for name in names if names.count(name) > 1} == {"axis"}  # of all trials, and of one
    assert set(ExperimentSettings.model_fields) <= set(names)
    assert set(RunSettings.model_fields) <= {entry.name for entry in setting_entries(RunSettings)}


def test_a_column_is_a_field_of_a_trial() -> None:
    fields = {field.name for field in dataclasses.fields(Trial)}
    assert {column.field for column in COLUMNS.values()} <= fields


def test_bounds_and_choices_come_from_the_declarations() -> None:
    entries = {entry.name: entry for entry in (*setting_entries(ExperimentSettings), *setting_entries(RunSettings))}
    assert entries["ambient_pressure_kPa"].allowed == "above 0, at most 1000"
    assert entries["ambient_pressure_kPa"].unit == "kPa"
    assert entries["tail_slack"].allowed == "taut, free"
    assert entries["limits.trials"].default == "4"
    assert entries["figures.formats"].allowed == "png, svg, pdf"
    assert {name for name in entries if name.startswith("limits.")} >= {
        f"limits.{name}" for names in LIMITED.values() for name in names
    }


def test_the_lines_name_units_and_bounds() -> None:
    line = next(line for line in reference_lines() if line.split()[:1] == ["chamber_l"])
    assert "litres" in line
    assert "above 0 to 10000" in line
    assert "Volume of the pressure chamber." in line


def test_the_page_of_the_docs_is_current() -> None:
    page = Path(__file__).parents[2] / "docs" / "settings.md"
    assert page.read_text(encoding="utf-8") == reference_page(), "vinetrack settings --page docs/settings.md"


def test_every_number_of_a_trial_says_how_one_measures_it() -> None:
    measured = {entry.name: entry.measured for entry in column_entries()}
    numbers = {name for name, column in COLUMNS.items() if column.kind == "number" and name != "order"}
    assert not {name for name in numbers if not measured[name]}
    assert "until the tip starts to move" in measured["yield_pressure_kPa"]


def test_keys_of_every_calibration_and_of_the_axis_are_listed() -> None:
    names = {entry.name for entry in picture_entries()}
    assert {"calibration.squares (kind: charuco)", "calibration.length_mm (kind: two_points)", "axis.width_mm"} <= names
    assert all(entry.meaning for entry in picture_entries())
    assert set(reference_content()) == {"columns", "experiment", "picture", "run"}
