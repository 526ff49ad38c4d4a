"""Settings of an experiment and of a run: every fault named with its key, its line and what is allowed."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import yaml
from pydantic import BaseModel, ValidationError

from vinetrack.core.problems import ExperimentError, Problem
from vinetrack.core.records import Bend
from vinetrack.core.units import BASE_EFFECTS
from vinetrack.core.yaml_document import read_yaml
from vinetrack.experiment.schema import COLUMNS, SHARED
from vinetrack.experiment.settings import ExperimentSettings, RunSettings, read_experiment_settings, run_settings

CONFIG = Path(__file__).parents[2] / "config" / "config.yaml"


def read(tmp_path: Path, text: str) -> ExperimentSettings:
    path = tmp_path / "experiment.yaml"
    path.write_text(text, encoding="utf-8")
    return read_experiment_settings(path)


def draft_problems(tmp_path: Path, text: str) -> tuple[Problem, ...]:
    with pytest.raises(ExperimentError) as caught:
        read(tmp_path, text)
    return caught.value.problems


def test_no_file_gives_the_defaults(tmp_path: Path) -> None:
    settings = read_experiment_settings(tmp_path / "experiment.yaml")
    assert settings.model == ("pressure_drive", "gravity", "eversion_damping", "yield_pressure") == BASE_EFFECTS
    assert (settings.ambient_pressure_kPa, settings.tail_slack, settings.mass_loss) == (101.325, "taut", "geometric")
    assert settings.candidates is None
    assert not settings.strict
    assert settings.calibration is None


def test_an_empty_file_gives_the_defaults(tmp_path: Path) -> None:
    assert read(tmp_path, "# nothing yet\n") == ExperimentSettings()


def test_the_model_does_not_depend_on_columns(tmp_path: Path) -> None:
    assert read(tmp_path, "chamber_l: 3.7\ninlet_mm: 6\n").model == BASE_EFFECTS


def test_every_column_may_be_shared(tmp_path: Path) -> None:
    settings = read(
        tmp_path,
        "capture_fps: 1069\nexposure_us: 100\ndiameter_mm: 24\nthickness_um: 200\nlength_mm: 280\npressure_kPa: 28\n"
        "pressure_sigma_kPa: 0.3\nyield_pressure_kPa: 3\nyield_pressure_sigma_kPa: 0.1\npressure_trace: p.csv\n"
        "payload_g: 35.6\ngrowth_angle_deg: 90\nchamber_l: 3.7\ninlet_mm: 6\nbends: 100:30:20;150:30:20\n"
        "film_density_kg_m3: 1180\nmm_per_px: 0.37\ntravel_ratio: 1\nsteady: 0.05:0.2\nuse: no\n"
        "specimen: a\nday: 1\ncapture_fps_is_playback: yes\ncompare_sizes: no\n",
    )
    assert {name for name in SHARED if getattr(settings, name) is None} == set()
    assert settings.bends == (Bend(0.1, 0.03, 0.02), Bend(0.15, 0.03, 0.02))
    assert settings.steady == (0.05, 0.2)
    assert settings.use is False


def test_settings_cover_exactly_the_columns_of_the_sheet() -> None:
    assert set(SHARED) == set(COLUMNS) - {"trial", "video", "track", "order", "axis", "frames_used", "point_mass"}
    assert set(SHARED) <= set(ExperimentSettings.model_fields)


def test_a_window_is_not_taken_for_a_number_in_base_sixty(tmp_path: Path) -> None:
    assert read(tmp_path, "steady: 1:20\n").steady == (1.0, 20.0)


@pytest.mark.parametrize(
    "text",
    [
        "{kind: mm_per_px, mm_per_px: 0.37}",
        "{kind: two_points, from_px: [1, 2], to_px: [3, 4], length_mm: 100}",
        "{kind: checkerboard, image: calibration/a.png, squares: [9, 6], square_mm: 5}",
        "{kind: charuco, image: a.png, squares: [5, 7], square_mm: 10, marker_mm: 7, dictionary: DICT_4X4_50}",
    ],
)
def test_every_kind_of_calibration(tmp_path: Path, text: str) -> None:
    settings = read(tmp_path, f"calibration: {text}\naxis: {{from_px: [0, 1], to_px: [5, 1], width_mm: 40}}\n")
    assert settings.calibration is not None
    assert settings.calibration.kind in text
    assert settings.axis is not None
    assert settings.axis.to_px == (5.0, 1.0)


def test_limits_of_the_next_experiment_are_ranges_and_choices(tmp_path: Path) -> None:
    text = "{pressure_kPa: 7:40, payload_g: [0, 50], diameter_mm: [24, 12], chamber_l: 3.7, growth_angle_deg: 0:180}"
    limits = read(tmp_path, f"limits: {text}\n").limits
    assert (limits.pressure_kPa, limits.payload_g) == ((7.0, 40.0), (0.0, 50.0))
    assert (limits.diameter_mm, limits.chamber_l) == ((12.0, 24.0), (3.7,))
    assert limits.growth_angle_deg == (0.0, 45.0, 90.0, 135.0, 180.0)
    assert (limits.thickness_um, limits.trials, limits.hoop_stress_MPa) == (None, 4, 7.8)


def test_a_range_of_sizes_is_looked_at_in_equal_ratios(tmp_path: Path) -> None:
    assert read(tmp_path, "limits: {thickness_um: 50:200}\n").limits.thickness_um == (50.0, 70.7, 100.0, 141.0, 200.0)


def test_an_unknown_key_suggests_the_nearest(tmp_path: Path) -> None:
    (problem,) = draft_problems(tmp_path, "strict: true\npresure_kPa: 28\n")
    assert (problem.column, problem.line, problem.file) == ("presure_kPa", 2, "experiment.yaml")
    assert "did you mean pressure_kPa?" in problem.remedy


def test_an_unknown_key_of_a_calibration_suggests_the_nearest(tmp_path: Path) -> None:
    found = draft_problems(tmp_path, "calibration:\n  kind: mm_per_px\n  mm_per_px: 0.3\n  kinds: 3\n")
    assert [(problem.column, problem.line) for problem in found] == [("calibration.kinds", 4)]
    assert "kind?" in found[0].remedy


def test_an_unknown_kind_of_calibration_names_those_there_are(tmp_path: Path) -> None:
    (problem,) = draft_problems(tmp_path, "calibration: {kind: chess}\n")
    assert problem.column == "calibration"
    assert "checkerboard" in str(problem)


def test_a_key_missing_in_a_calibration_is_named(tmp_path: Path) -> None:
    (problem,) = draft_problems(tmp_path, "calibration: {kind: mm_per_px}\n")
    assert (problem.column, problem.message) == ("calibration.mm_per_px", "is missing")


def test_a_key_written_twice_is_refused(tmp_path: Path) -> None:
    (problem,) = draft_problems(tmp_path, "strict: true\npayload_g: 1\nstrict: false\n")
    assert (problem.column, problem.line, problem.message) == ("strict", 3, "is set twice")
    assert "line 1" in problem.remedy


def test_a_syntax_error_names_line_and_remedy(tmp_path: Path) -> None:
    (problem,) = draft_problems(tmp_path, "strict: true\npayload_g: [1, 2\nuse: yes\n")
    assert problem.file == "experiment.yaml"
    assert problem.line >= 2
    assert "quotes" in problem.remedy


@pytest.mark.parametrize("text", ["- a\n- b\n", "just text\n", "3\n"])
def test_what_is_no_mapping_is_refused(tmp_path: Path, text: str) -> None:
    (problem,) = draft_problems(tmp_path, text)
    assert problem.message == "holds no settings"


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("pressure_kPa: 24000", "looks like Pa: 24000 Pa is 24 kPa"),
        ("diameter_mm: 0.024", "looks like metres: 0.024 metres is 24 mm"),
        ("pressure_kPa: .nan", "is not a number"),
        ("pressure_kPa: 12 kPa", "is not a number"),
        ("pressure_kPa: true", "is not a single value"),
        ("pressure_kPa: [1, 2]", "is not a single value"),
        ("travel_ratio: 3", "2 for eversion"),
        ("steady: 0.2:0.1", "ends before it starts"),
        ("bends: 1:2", "three numbers"),
        ("tail_slack: loose", "taut"),
        ("position_systematic_mm: -1", "0"),
        ("mass_loss: none", "as_printed"),
        ("model: [gravity, gravity]", "names 'gravity' twice"),
        ("ambient_pressure_kPa: 101325", "less than or equal to 1000"),
        ("ambient_pressure_kPa: true", "yes or no where a number belongs"),
        ("strict: 3", "boolean"),
        ("model: gravity", "should be a list"),
        ("axis: 3", "should be a group of keys"),
        ("axis: {from_px: [1, 1], to_px: [1, 1]}", "same point"),
        ("axis: {from_px: [1, 1], via_px: [[2, 2]], to_px: [9, 9]}", "less than 2 pixels apart"),
        ("calibration: {kind: mm_per_px, mm_per_px: 0}", "greater than 0"),
        ("limits: {pressure_kPa: 7}", "write low:high"),
        ("limits: {pressure_kPa: 40:7}", "write the lower value first"),
        ("limits: {payload_g: 0:1e6}", "above 100000 g"),
        ("limits: {pressure_kPa: 7000:9000}", "7000 Pa is 7 kPa"),
        ("limits: {diameter_mm: [0.012]}", "0.012 metres is 12 mm"),
        ("limits: {thickness_um: []}", "name at least one value"),
        ("limits: {chamber_l: [[1, 2]]}", "numbers only"),
        ("limits: {trials: 0}", "greater than or equal to 1"),
        ("limits: {presure_kPa: 1:2}", "did you mean pressure_kPa?"),
        (
            "calibration: {kind: charuco, image: a, squares: [5, 5], square_mm: 5, marker_mm: 5, dictionary: DICT_A}",
            "markers lie inside",
        ),
    ],
)
def test_a_value_that_is_not_allowed_is_named_with_its_key(tmp_path: Path, line: str, words: str) -> None:
    (problem,) = draft_problems(tmp_path, f"# first line\n{line}\n")
    assert problem.line == 2
    assert problem.column.startswith(line.split(":")[0])
    assert words in str(problem)


def test_all_problems_are_reported_at_once(tmp_path: Path) -> None:
    found = draft_problems(tmp_path, "strikt: true\npressure_kPa: -1\ntail_slack: x\n")
    assert sorted(problem.line for problem in found) == [1, 2, 3]


def test_settings_cannot_be_changed() -> None:
    with pytest.raises(ValidationError):
        ExperimentSettings().strict = True  # type: ignore[misc]


def test_the_shipped_config_holds_the_defaults() -> None:
    assert run_settings(read_yaml(CONFIG).content) == RunSettings()


def _keys(model: type[BaseModel]) -> dict[str, Any]:
    return {
        name: _keys(type(field.default)) if isinstance(field.default, BaseModel) else None
        for name, field in model.model_fields.items()
    }


def test_the_shipped_config_holds_every_key_with_a_comment_above() -> None:
    text = CONFIG.read_text(encoding="utf-8")
    content = yaml.safe_load(text)
    shipped = {key: dict.fromkeys(value) if isinstance(value, dict) else None for key, value in content.items()}
    assert shipped == _keys(RunSettings)
    lines = text.splitlines()
    explained = [
        lines[i - 1].lstrip().startswith("#") or lines[i - 1].rstrip().endswith(":")
        for i, line in enumerate(lines)
        if line.strip() and not line.lstrip().startswith("#")
    ]
    assert all(explained)


def test_a_run_may_override_one_key() -> None:
    settings = run_settings({"experiment": 2024, "damping": {"seed": 7}})
    assert (settings.experiment, settings.damping.seed, settings.damping.resamples) == ("2024", 7, 2000)


@pytest.mark.parametrize(
    ("values", "column"),
    [
        ({"experimant": "x"}, "experimant"),
        ({"damping": {"sead": 1}}, "damping.sead"),
        ({"velocity": {"order": 0}}, "velocity.order"),
        ({"figures": {"formats": []}}, "figures.formats"),
        ({"figures": {"formats": ["bmp"]}}, "figures.formats.0"),
        ({"final_at_fraction": 1.5}, "final_at_fraction"),
        ({"efficiency_at_mm": float("nan")}, "efficiency_at_mm"),
    ],
)
def test_a_wrong_run_setting_is_named(values: dict[str, Any], column: str) -> None:
    with pytest.raises(ExperimentError) as caught:
        run_settings(values)
    assert [problem.column for problem in caught.value.problems] == [column]


def test_a_run_setting_nearly_right_suggests_the_nearest() -> None:
    with pytest.raises(ExperimentError, match="did you mean seed"):
        run_settings({"damping": {"sead": 1}})


def test_an_unknown_key_shows_the_nearest_three(tmp_path: Path) -> None:
    with pytest.raises(ExperimentError) as refused:
        read(tmp_path, "mm_px: 3\n")
    (problem,) = refused.value.problems
    assert problem.remedy.startswith("did you mean mm_per_px? (or ")
    assert problem.remedy.count(",") == 1
