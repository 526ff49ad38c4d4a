"""The two files are made, completed and never overwritten."""

from __future__ import annotations

from pathlib import Path

import pytest

from vinetrack.core.problems import ExperimentError
from vinetrack.core.tables import read_table
from vinetrack.core.yaml_document import parse_yaml
from vinetrack.experiment.folder import check_experiment
from vinetrack.pages.draft_files import (
    Draft,
    SheetDraft,
    draft_folder,
    first_settings,
    open_draft,
    shared_values,
    with_shared,
    write_draft,
)
from vinetrack.pages.setup_server import write_templates

SHEET = "trial;video;pressure_kPa;note\nold;a.mp4;24,5;keep me\n"
SETTINGS = "# of the lab\nyield_pressure_kPa: 3  # measured twice\nthickness_um: 100\n"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name in ("a.mp4", "d12_30kPa_1.mp4"):
        (tmp_path / name).write_bytes(b"x")
    return tmp_path


def test_a_folder_of_recordings_gets_both_files_with_blanks(folder: Path) -> None:
    lines: list[str] = []
    write_templates(folder, lines.append)
    table = read_table(folder / "trials.csv")
    assert table.rows[1]["diameter_mm"] == "12"
    assert table.rows[1]["pressure_kPa"] == "30"
    assert table.rows[0]["pressure_kPa"] == ""
    assert (folder / "experiment.yaml").read_text() == first_settings()
    assert any("capture_fps" in line and "calibration" in line for line in lines if line.startswith("To fill in"))
    assert sorted(path.name for path in folder.iterdir()) == [
        "a.mp4", "d12_30kPa_1.mp4", "experiment.yaml", "trials.csv",
    ]  # fmt: skip


def test_a_sheet_that_is_there_keeps_every_cell_and_gains_a_row(folder: Path) -> None:
    (folder / "trials.csv").write_text(SHEET)
    (folder / "experiment.yaml").write_text(SETTINGS)
    write_templates(folder, lambda _line: None)
    text = (folder / "trials.csv").read_text()
    assert text.startswith("trial;video;pressure_kPa;note")
    assert "old;a.mp4;24,5;keep me" in text
    assert "d12_30kPa_1;d12_30kPa_1.mp4;30" in text
    assert (folder / "experiment.yaml").read_text() == SETTINGS


def test_a_second_run_changes_no_byte(folder: Path) -> None:
    write_templates(folder, lambda _line: None)
    before = [(folder / name).read_bytes() for name in ("trials.csv", "experiment.yaml")]
    write_templates(folder, lambda _line: None)
    assert [(folder / name).read_bytes() for name in ("trials.csv", "experiment.yaml")] == before


def test_files_that_changed_since_are_left_alone(folder: Path) -> None:
    draft = open_draft(folder)
    (folder / "trials.csv").write_text(SHEET)
    with pytest.raises(ExperimentError, match="has changed since"):
        write_draft(folder, draft)
    assert (folder / "trials.csv").read_text() == SHEET


def test_cells_without_a_column_are_refused_not_lost(folder: Path) -> None:
    (folder / "trials.csv").write_text("trial,video\nold,a.mp4,stray\n")
    with pytest.raises(ExperimentError, match="without a column"):
        open_draft(folder)


def test_a_folder_without_recordings_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ExperimentError, match="holds no recording"):
        open_draft(tmp_path)


def test_shared_values_are_set_in_place_and_in_the_unit_chosen() -> None:
    after = with_shared(SETTINGS, {"yield_pressure_psi": "0.5", "thickness_um": "100", "capture_fps": "1069"})
    assert after.startswith("# of the lab\nyield_pressure_psi: 0.5 # measured twice\n")
    assert parse_yaml(after, "").content == {
        "yield_pressure_psi": 0.5, "thickness_um": 100, "capture_fps": 1069,
    }  # fmt: skip
    assert shared_values(after) == {"thickness_um": 100, "yield_pressure_psi": 0.5, "capture_fps": 1069}


def test_no_blank_key_is_written_beside_the_same_quantity_in_another_unit() -> None:
    """A new file has a blank `yield_pressure_kPa:`; that of an older version of the page has both."""
    after = with_shared(first_settings(), {"yield_pressure_psi": "0.42", "capture_fps": "1000"})
    assert parse_yaml(after, "").content["yield_pressure_psi"] == 0.42
    assert "yield_pressure_kPa" not in parse_yaml(after, "").content
    assert after.count("#") == first_settings().count("#")
    both = with_shared("yield_pressure_psi: 0.4\nyield_pressure_kPa:\n", {"yield_pressure_psi": "0.42"})
    assert parse_yaml(both, "").content == {"yield_pressure_psi": 0.42}
    back = with_shared(after, {"yield_pressure_kPa": "3"})
    assert parse_yaml(back, "").content["yield_pressure_kPa"] == 3


def test_shared_values_that_do_not_change_leave_the_text() -> None:
    assert with_shared(SETTINGS, {"yield_pressure_kPa": "3", "chamber_l": ""}) == SETTINGS


def test_a_draft_is_checked_without_touching_the_folder(folder: Path) -> None:
    sheet = SheetDraft(
        ("trial", "video", "pressure_kPa"), ({"trial": "a", "video": "a.mp4", "pressure_kPa": "12 kPa"},)
    )
    with draft_folder(folder, Draft(sheet, SETTINGS, "")) as copy:
        problems = check_experiment(copy)
    assert [problem.trial for problem in problems if problem.column == "pressure_kPa"] == ["a"]
    assert not (folder / "trials.csv").exists()
