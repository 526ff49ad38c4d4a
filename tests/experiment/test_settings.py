"""Settings of an experiment and of a run, refused with key and line; the reference lists what is read."""

from pathlib import Path
from typing import Any

import pytest
import yaml
from pydantic import BaseModel

from vinetrack.core.problems import ExperimentError, Problem
from vinetrack.core.tables import read_yaml
from vinetrack.experiment.reference import reference_content, reference_page, setting_entries
from vinetrack.experiment.schema import COLUMNS, SHARED
from vinetrack.experiment.settings import ExperimentSettings, RunSettings, read_experiment_settings, run_settings

CONFIG = Path(__file__).parents[2] / "config" / "config.yaml"


def read(tmp_path: Path, text: str) -> ExperimentSettings:
    (tmp_path / "experiment.yaml").write_text(text, encoding="utf-8")
    return read_experiment_settings(tmp_path / "experiment.yaml")


def draft_problems(tmp_path: Path, text: str) -> tuple[Problem, ...]:
    with pytest.raises(ExperimentError) as caught:
        read(tmp_path, text)
    return caught.value.problems


def test_settings_cover_exactly_the_columns_of_the_sheet():
    assert set(SHARED) == set(COLUMNS) - {"trial", "video", "track", "order", "axis", "frames_used", "point_mass"}
    assert set(SHARED) <= set(ExperimentSettings.model_fields)


def test_every_kind_of_calibration(tmp_path):
    for text in (
        "{kind: mm_per_px, mm_per_px: 0.37}",
        "{kind: two_points, from_px: [1, 2], to_px: [3, 4], length_mm: 100}",
        "{kind: checkerboard, image: calibration/a.png, squares: [9, 6], square_mm: 5}",
        "{kind: charuco, image: a.png, squares: [5, 7], square_mm: 10, marker_mm: 7, dictionary: DICT_4X4_50}",
    ):
        settings = read(tmp_path, f"calibration: {text}\naxis: {{from_px: [0, 1], to_px: [5, 1], width_mm: 40}}\n")
        assert settings.calibration is not None
        assert settings.calibration.kind in text
        assert settings.axis is not None
        assert settings.axis.to_px == (5.0, 1.0)
    assert read(tmp_path, "steady: 1:20\n").steady == (1.0, 20.0)  # no number in base sixty


def test_limits_of_the_next_experiment_are_ranges_and_choices(tmp_path):
    text = "{pressure_kPa: 7:40, payload_g: [0, 50], diameter_mm: [24, 12], chamber_l: 3.7, growth_angle_deg: 0:180}"
    limits = read(tmp_path, f"limits: {text}\n").limits
    assert (limits.pressure_kPa, limits.payload_g) == ((7.0, 40.0), (0.0, 50.0))
    assert (limits.diameter_mm, limits.chamber_l) == ((12.0, 24.0), (3.7,))
    assert limits.growth_angle_deg == (0.0, 45.0, 90.0, 135.0, 180.0)
    assert (limits.thickness_um, limits.trials, limits.hoop_stress_MPa) == (None, 4, 7.8)


def test_what_is_no_mapping_is_refused(tmp_path):
    for text in ("- a\n- b\n", "just text\n", "3\n", "payload_g: [1, 2\nuse: yes\n"):
        (problem,) = draft_problems(tmp_path, text)
        assert problem.file == "experiment.yaml"
    (problem,) = draft_problems(tmp_path, "strict: true\npayload_g: 1\nstrict: false\n")
    assert (problem.column, problem.line) == ("strict", 3)


NOT_ALLOWED = {
    "pressure_kPa": ("24000", ".nan", "12 kPa", "true", "[1, 2]"),
    "diameter_mm": ("0.024",),
    "travel_ratio": ("3",),
    "steady": ("0.2:0.1",),
    "bends": ("1:2",),
    "tail_slack": ("loose",),
    "position_systematic_mm": ("-1",),
    "mass_loss": ("none",),
    "model": ("[gravity, gravity]", "gravity"),
    "ambient_pressure_kPa": ("101325", "true"),
    "strict": ("3",),
    "axis": ("3", "{from_px: [1, 1], to_px: [1, 1]}", "{from_px: [1, 1], via_px: [[2, 2]], to_px: [9, 9]}"),
    "calibration": (
        "{kind: mm_per_px, mm_per_px: 0}",
        "{kind: mm_per_px}",
        "{kind: chess}",
        "{kind: mm_per_px, mm_per_px: 0.3, kinds: 3}",
        "{kind: charuco, image: a, squares: [5, 5], square_mm: 5, marker_mm: 5, dictionary: DICT_A}",
    ),
    "limits": (
        *("{pressure_kPa: 7}", "{pressure_kPa: 40:7}", "{payload_g: 0:1e6}", "{pressure_kPa: 7000:9000}"),
        *("{diameter_mm: [0.012]}", "{thickness_um: []}", "{chamber_l: [[1, 2]]}", "{trials: 0}", "{presure_kPa: 1:2}"),
    ),
}


@pytest.mark.parametrize(("key", "value"), [(key, value) for key, values in NOT_ALLOWED.items() for value in values])
def test_a_value_that_is_not_allowed_is_named_with_its_key(tmp_path, key, value):
    (problem,) = draft_problems(tmp_path, f"# first line\n{key}: {value}\n")
    assert problem.line == 2
    assert problem.column.startswith(key)


def _keys(model: type[BaseModel]) -> dict[str, Any]:
    return {
        name: _keys(type(field.default)) if isinstance(field.default, BaseModel) else None
        for name, field in model.model_fields.items()
    }


def test_the_shipped_config_holds_every_key_at_its_default():
    assert run_settings(read_yaml(CONFIG).content) == RunSettings()
    content = yaml.safe_load(CONFIG.read_text(encoding="utf-8"))
    shipped = {key: dict.fromkeys(value) if isinstance(value, dict) else None for key, value in content.items()}
    assert shipped == _keys(RunSettings)
    assert run_settings({"experiment": 2024}).experiment == "2024"


def test_a_wrong_run_setting_is_named():
    for column, values in {
        "experimant": {"experimant": "x"},
        "damping.sead": {"damping": {"sead": 1}},
        "velocity.order": {"velocity": {"order": 0}},
        "figures.formats": {"figures": {"formats": []}},
        "figures.formats.0": {"figures": {"formats": ["bmp"]}},
        "final_at_fraction": {"final_at_fraction": 1.5},
        "efficiency_at_mm": {"efficiency_at_mm": float("nan")},
    }.items():
        with pytest.raises(ExperimentError) as caught:
            run_settings(values)
        assert [problem.column for problem in caught.value.problems] == [column]


def test_every_key_of_both_files_is_listed_once():
    names = [entry["name"] for part in ("experiment", "columns") for entry in reference_content()[part]]
    assert {name for name in names if names.count(name) > 1} == {"axis"}  # of all trials, and of one
    assert set(ExperimentSettings.model_fields) <= set(names)
    assert set(RunSettings.model_fields) <= {entry.name for entry in setting_entries(RunSettings)}


def test_the_page_of_the_docs_is_current():
    page = Path(__file__).parents[2] / "docs" / "settings.md"
    assert page.read_text(encoding="utf-8") == reference_page(), "vinetrack settings --page docs/settings.md"
