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


BLOCK = {"kind": "two_points", "from_px": [10, 20], "to_px": [110, 20], "length_mm": 50}
FLOW = "axis: {from_px: [1,2],   to_px: [30, 2]}"
LISTED = "model:\n  - gravity   # 9.81\n  # found in May\n  - air_drag\n  - leak # no\nchamber_l: 2\n"


@pytest.mark.parametrize(
    ("before", "key", "value", "after"),
    [
        (COMMENTED, "capture_fps", 1069, COMMENTED.replace("1000", "1069")),
        (COMMENTED, "calibration", BLOCK | {"to_px": [210, 20.5]}, COMMENTED.replace("[110, 20]", "[210, 20.5]")),
        ("chamber_l: 2  # of glass\n", "chamber_l", None, "chamber_l:    # of glass\n"),
        (FLOW, "axis", {"from_px": [1, 2], "to_px": [30, 2]}, FLOW),
        ("a: 1", "b", "of: text", "a: 1\nb: 'of: text'\n"),
        (LISTED, "model", ["gravity", "air_drag", "inlet_loss"], LISTED.replace("leak # no", "inlet_loss")),
        ("chamber_l: 2 # blue", "model", ["a"], "chamber_l: 2 # blue\nmodel: [a]\n"),
        ("", "model", ["a"], "model: [a]\n"),
        ("# nothing yet\n", "model", ["a"], "# nothing yet\nmodel: [a]\n"),
    ],
)
def test_a_key_is_set_and_comments_stay(before: str, key: str, value: object, after: str) -> None:
    assert with_value(before, key, value) == after


def test_a_block_is_cleared_and_what_cannot_be_set_without_harm_is_refused() -> None:
    after = with_value(COMMENTED, "calibration", None)
    assert parse_yaml(after, "").content == {"capture_fps": 1000, "calibration": None}
    assert "# the last line" in after
    with pytest.raises(ExperimentError):
        with_value("a: &x {p: 1}\nb: *x\n", "b", {"p": 2})


def test_line_ends_and_the_mark_at_the_beginning_stay(tmp_path: Path) -> None:
    path = tmp_path / "experiment.yaml"
    path.write_bytes(b"\xef\xbb\xbfchamber_l: 2\r\nmodel: [gravity]\r\n")
    save_model(tmp_path, ["gravity", "air_drag"])
    assert path.read_bytes() == b"\xef\xbb\xbfchamber_l: 2\r\nmodel: [gravity, air_drag]\r\n"


def test_a_broken_file_is_left_as_it_is(tmp_path: Path) -> None:
    path = tmp_path / "experiment.yaml"
    path.write_text("model: [gravity\n")
    with pytest.raises(ExperimentError):
        save_model(tmp_path, ["gravity", "leak"])
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
