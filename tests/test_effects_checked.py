"""`vinetrack check` on what an experiment says of effects: its model, its candidates, files of its own."""

from __future__ import annotations

from pathlib import Path

import pytest
from hand_sheet import two_vines
from typer.testing import CliRunner

from vinetrack.cli.main import app
from vinetrack.pipeline.effects_stage import model_problems

BASE = "pressure_drive, gravity, eversion_damping, yield_pressure"


def said(folder: Path, settings: str) -> str:
    (folder / "experiment.yaml").write_text(settings, encoding="utf-8")
    problems = model_problems(folder)
    assert all(problem.file == "experiment.yaml" for problem in problems)
    return "\n".join(map(str, problems))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return two_vines(tmp_path)


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ("", ""),
        (f"model: [{BASE}, air_drag]\n", ""),
        (f"model: [{BASE}, air_drg]\n", "model There is no effect named 'air_drg'. Did you mean 'air_drag'?"),
        ("candidates: [leek]\n", "candidates There is no effect named 'leek'. Did you mean 'leak'?"),
        (f"model: [{BASE}, reservoir_depletion]\n", "the effect reservoir_depletion needs `chamber_l`, which is blank"),
        ("effects: [not_there.py]\n", ""),
        ("modle: [gravity]\n", ""),
    ],
)
def test_names_in_the_settings_are_looked_up(folder: Path, settings: str, words: str) -> None:
    text = said(folder, settings)
    assert words in text
    assert bool(words) == bool(text)


def test_a_file_that_is_no_effect_is_named(folder: Path) -> None:
    (folder / "brush.py").write_text("PARAMETERS = ()\n", encoding="utf-8")
    assert "brush.py: defines none of the functions" in said(folder, "effects: [brush.py]\n")


def test_the_command_says_so_and_exits_with_1(folder: Path) -> None:
    (folder / "experiment.yaml").write_text(f"model: [{BASE}, air_drg]\n", encoding="utf-8")
    done = CliRunner().invoke(app, ["check", str(folder)])
    assert done.exit_code == 1
    assert "Did you mean 'air_drag'?" in done.output
