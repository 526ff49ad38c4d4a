"""A key is set in place, and nothing else of the file changes."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from vinetrack.core.problems import ExperimentError
from vinetrack.core.tables import parse_yaml, with_value
from vinetrack.experiment.folder import save_model

# A key is set in place, and nothing else of the file changes.


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
    with pytest.raises(ExperimentError):
        with_value("a: &x {p: 1}\nb: *x\n", "b", {"p": 2})


# The model saved to experiment.yaml: one key changes, everything else stays to the byte.


BASE = ["pressure_drive", "gravity", "eversion_damping", "yield_pressure"]
MORE = [*BASE, "reservoir_depletion"]


def test_a_line_for_each_effect_keeps_comments_of_those_that_stay() -> None:
    text = "model:\n  - gravity   # 9.81\n  # found in May\n  - air_drag\n  - leak # no\nchamber_l: 2\n"
    assert with_value(text, "model", ["gravity", "air_drag", "inlet_loss"]) == (
        "model:\n  - gravity   # 9.81\n  # found in May\n  - air_drag\n  - inlet_loss\nchamber_l: 2\n"
    )


def test_a_missing_key_is_added_at_the_end() -> None:
    assert with_value("chamber_l: 2 # blue", "model", ["a"]) == "chamber_l: 2 # blue\nmodel: [a]\n"
    assert with_value("", "model", ["a"]) == "model: [a]\n"
    assert with_value("# nothing yet\n", "model", ["a"]) == "# nothing yet\nmodel: [a]\n"


def test_line_ends_and_the_mark_at_the_beginning_stay(tmp_path: Path) -> None:
    path = tmp_path / "experiment.yaml"
    path.write_bytes(b"\xef\xbb\xbfchamber_l: 2\r\nmodel: [gravity]\r\n")
    save_model(tmp_path, ["gravity", "air_drag"])
    assert path.read_bytes() == b"\xef\xbb\xbfchamber_l: 2\r\nmodel: [gravity, air_drag]\r\n"


def test_a_broken_file_is_left_as_it_is(tmp_path: Path) -> None:
    path = tmp_path / "experiment.yaml"
    path.write_text("model: [gravity\n")
    with pytest.raises(ExperimentError):
        save_model(tmp_path, MORE)
    assert path.read_text() == "model: [gravity\n"
    assert [one.name for one in tmp_path.iterdir()] == ["experiment.yaml"]


# What YAML reads as something else than a word is no name of an effect.
word = st.from_regex(r"[a-z]{1,8}", fullmatch=True).filter(lambda one: yaml.safe_load(one) == one)
words = st.lists(word, min_size=1, max_size=6, unique=True)
comments = st.sampled_from(["", "  # why", " # [a, b]"])


@pytest.mark.slow
@settings(max_examples=200, deadline=None)
@given(old=words, new=words, comment=comments, block=st.booleans(), behind=st.booleans(), indent=st.integers(0, 3))
def test_whatever_stood_there_only_the_list_changes(
    old: list[str], new: list[str], comment: str, block: bool, behind: bool, indent: int
) -> None:
    pad = " " * indent
    listed = "".join(f"\n{pad}- {word}{comment}" for word in old) if block else f" [{', '.join(old)}]{comment}"
    text = f"# head\nfirst: 1  # one\nmodel:{listed}\n" + ("last: {a: [1, 2]}  # two\n" if behind else "")
    after = with_value(text, "model", new)
    assert parse_yaml(after, "f").content == {**parse_yaml(text, "f").content, "model": new}
    assert after.startswith("# head\nfirst: 1  # one\nmodel:")
    assert not behind or after.endswith("last: {a: [1, 2]}  # two\n")
