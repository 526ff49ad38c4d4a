"""A key is set in place, and nothing else of the file changes."""

from __future__ import annotations

import pytest

from vinetrack.core.problems import ExperimentError
from vinetrack.core.yaml_document import parse_yaml, with_value

COMMENTED = """# by hand
capture_fps: 1000  # the camera's
calibration:
  # taken on Monday
  kind: two_points  # a ruler
  from_px: [10, 20]
  to_px: [110, 20]
  length_mm: 50

# the last line
"""


def test_a_number_keeps_the_comment_behind_it() -> None:
    after = with_value(COMMENTED, "capture_fps", 1069)
    assert after == COMMENTED.replace("1000", "1069")


def test_of_a_block_only_what_differs_changes() -> None:
    value = {"kind": "two_points", "from_px": [10, 20], "to_px": [210, 20.5], "length_mm": 50}
    assert with_value(COMMENTED, "calibration", value) == COMMENTED.replace("[110, 20]", "[210, 20.5]")


def test_another_kind_of_calibration_takes_the_place_of_the_first() -> None:
    after = with_value(COMMENTED, "calibration", {"kind": "mm_per_px", "mm_per_px": 0.25})
    assert "# taken on Monday" in after
    assert "# the last line" in after
    assert parse_yaml(after, "").content["calibration"] == {"kind": "mm_per_px", "mm_per_px": 0.25}


def test_a_blank_key_takes_a_block() -> None:
    after = with_value("axis:  # found where blank\nx: 1\n", "axis", {"from_px": [1, 2], "to_px": [30, 2]})
    assert after == "axis:  # found where blank\n  from_px: [1, 2]\n  to_px: [30, 2]\nx: 1\n"


def test_a_value_is_cleared_and_its_comment_stays() -> None:
    assert with_value("chamber_l: 2  # of glass\n", "chamber_l", None) == "chamber_l:    # of glass\n"


def test_a_block_is_cleared() -> None:
    after = with_value(COMMENTED, "calibration", None)
    assert parse_yaml(after, "").content == {"capture_fps": 1000, "calibration": None}
    assert "# the last line" in after


def test_the_same_value_leaves_every_character() -> None:
    text = "axis: {from_px: [1,2],   to_px: [30, 2]}"
    assert with_value(text, "axis", {"from_px": [1, 2], "to_px": [30, 2]}) == text


def test_a_key_is_added_to_a_file_without_a_last_line_end() -> None:
    assert with_value("a: 1", "b", "of: text") == "a: 1\nb: 'of: text'\n"


def test_what_cannot_be_set_without_harm_is_refused() -> None:
    with pytest.raises(ExperimentError, match="without altering other settings"):
        with_value("a: &x {p: 1}\nb: *x\n", "b", {"p": 2})
