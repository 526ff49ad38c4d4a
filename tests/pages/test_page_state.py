"""State sent to the page, and drafts sent back."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from vinetrack.core.yaml_document import parse_yaml
from vinetrack.pages.setup_server import draft_from_json, draft_problems, page_state


def sent(folder: Path, **more: Any) -> dict[str, Any]:
    """The content that an unchanged page sends."""
    state = page_state(folder)
    return {key: state[key] for key in ("sheet", "shared", "calibration", "axis", "stamp")} | more


def fields(folder: Path, **more: Any) -> set[tuple[str, str, str]]:
    draft = draft_from_json(folder, sent(folder, **more))
    return {(one["field"], one["trial"], one["column"]) for one in draft_problems(folder, draft)["problems"]}


def test_a_new_folder_is_unsaved_and_filled_in_from_names(clips: Path) -> None:
    state = page_state(clips)
    assert state["unsaved"]
    assert [row["pressure_kPa"] for row in state["sheet"]["rows"]] == ["24", "30"]
    assert state["known"]["pressure_kPa"]["units"][0] == "kPa"


def test_problems_stand_with_their_fields(clips: Path) -> None:
    found = fields(clips)
    assert ("shared", "", "capture_fps") in found
    assert ("calibration", "", "calibration") in found


def test_a_wrong_cell_is_named_by_its_trial_and_its_column_in_the_unit_of_the_sheet(clips: Path) -> None:
    sheet = page_state(clips)["sheet"]
    sheet["columns"] = [name if name != "pressure_kPa" else "pressure_psi" for name in sheet["columns"]]
    for row in sheet["rows"]:
        row["pressure_psi"] = "four"
    shared = {"capture_fps": "1000", "thickness_um": "100", "length_mm": "300", "yield_pressure_kPa": "3"}
    found = fields(clips, sheet=sheet, shared=shared)
    assert ("cell", "d15_24kPa_1", "pressure_psi") in found


def test_a_whole_draft_has_no_errors(clips: Path) -> None:
    shared = {"capture_fps": "1000", "thickness_um": "100", "length_mm": "300", "yield_pressure_kPa": "3"}
    scale = {"kind": "two_points", "from_px": [10, 150], "to_px": [460, 150], "length_mm": 337.5}
    draft = draft_from_json(clips, sent(clips, shared=shared, calibration=scale))
    found = draft_problems(clips, draft)["problems"]
    assert [one for one in found if one["severity"] == "error"] == []
    assert parse_yaml(draft.settings, "").content["calibration"] == scale


def test_an_axis_is_set_and_cleared(clips: Path) -> None:
    axis = {"from_px": [10, 80], "to_px": [460, 80]}
    text = draft_from_json(clips, sent(clips, axis=axis)).settings
    assert parse_yaml(text, "").content["axis"] == axis
    (clips / "experiment.yaml").write_text(text + "# mine\n")
    cleared = draft_from_json(clips, sent(clips, axis=None)).settings
    assert parse_yaml(cleared, "").content["axis"] is None
    assert cleared.endswith("# mine\n")


@pytest.mark.parametrize("text", ["trial,video,note\nold,d15 24kPa 1.mp4,of Monday\n"])
def test_a_sheet_that_is_there_is_shown_with_its_unknown_columns(clips: Path, text: str) -> None:
    (clips / "trials.csv").write_text(text)
    state = page_state(clips)
    assert state["kept"] == ["trial", "video", "note"]
    assert state["sheet"]["rows"][0] == {"trial": "old", "video": "d15 24kPa 1.mp4", "note": "of Monday"}
    assert state["sheet"]["rows"][1]["video"] == "d15 30kPa 1.mp4"
