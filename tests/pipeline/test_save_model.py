"""The model saved to experiment.yaml: one key changes, everything else stays to the byte."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from vinetrack.core.problems import ExperimentError
from vinetrack.core.yaml_document import parse_yaml, with_value
from vinetrack.experiment.settings import read_experiment_settings
from vinetrack.pipeline.effects_stage import save_model

BASE = ["pressure_drive", "gravity", "eversion_damping", "yield_pressure"]
MORE = [*BASE, "reservoir_depletion"]


def test_a_list_in_brackets_keeps_its_line_and_every_comment() -> None:
    text = "# spring campaign\nchamber_l: 2  # the blue one\nmodel: [gravity]   # only for now\n\nstrict: no # never\n"
    after = with_value(text, "model", ["gravity", "air_drag"])
    assert after == text.replace("[gravity]  ", "[gravity, air_drag]")


def test_a_list_over_several_lines_is_replaced_whole() -> None:
    text = "model: [pressure_drive, gravity,\n        eversion_damping]\nchamber_l: 2\n"
    assert with_value(text, "model", BASE) == f"model: [{', '.join(BASE)}]\nchamber_l: 2\n"


def test_a_line_for_each_effect_keeps_comments_of_those_that_stay() -> None:
    text = "model:\n  - gravity   # 9.81\n  # found in May\n  - air_drag\n  - leak # no\nchamber_l: 2\n"
    assert with_value(text, "model", ["gravity", "air_drag", "inlet_loss"]) == (
        "model:\n  - gravity   # 9.81\n  # found in May\n  - air_drag\n  - inlet_loss\nchamber_l: 2\n"
    )


def test_effects_in_another_order_are_written_anew() -> None:
    after = with_value("model:\n- a\n- b\nx: 1\n", "model", ["b", "a"])
    assert parse_yaml(after, "f").content == {"model": ["b", "a"], "x": 1}


def test_a_missing_key_is_added_at_the_end() -> None:
    assert with_value("chamber_l: 2 # blue", "model", ["a"]) == "chamber_l: 2 # blue\nmodel: [a]\n"
    assert with_value("", "model", ["a"]) == "model: [a]\n"
    assert with_value("# nothing yet\n", "model", ["a"]) == "# nothing yet\nmodel: [a]\n"


def test_an_empty_value_is_filled() -> None:
    assert parse_yaml(with_value("model:\nx: 1\n", "model", ["a"]), "f").content == {"model": ["a"], "x": 1}


def test_a_list_at_the_end_without_a_line_end_is_kept_whole() -> None:
    assert parse_yaml(with_value("x: 1\nmodel:\n - a", "model", ["a", "b"]), "f").content == {
        "x": 1,
        "model": ["a", "b"],
    }


def test_what_cannot_be_set_without_harm_is_refused_with_the_line_to_write() -> None:
    with pytest.raises(ExperimentError, match="set it by hand"):
        with_value("base: &m [x]\nmodel: *m\n", "model", ["a"])


def test_line_ends_and_the_mark_at_the_beginning_stay(tmp_path: Path) -> None:
    path = tmp_path / "experiment.yaml"
    path.write_bytes(b"\xef\xbb\xbfchamber_l: 2\r\nmodel: [gravity]\r\n")
    save_model(tmp_path, ["gravity", "air_drag"])
    assert path.read_bytes() == b"\xef\xbb\xbfchamber_l: 2\r\nmodel: [gravity, air_drag]\r\n"


def test_settings_that_are_not_there_are_made(tmp_path: Path) -> None:
    path = save_model(tmp_path, MORE)
    assert read_experiment_settings(path).model == tuple(MORE)


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
