"""docs/own_effect.md: its effect and settings work as they stand there, and its messages are those that are given."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from doc_commands import Shown, pieces
from own_effect import PAGE, block, write_effect
from typer.testing import CliRunner

from vinetrack.cli.main import app
from vinetrack.effects import EffectError, own_effects
from vinetrack.experiment.folder import read_experiment
from vinetrack.pipeline.tracks_stage import model_of

SHEET = "trial,track,diameter_mm,thickness_um,length_mm,pressure_kPa,yield_pressure_kPa\na,a.csv,12,100,300,20,3\n"


@pytest.fixture
def experiment(tmp_path: Path) -> Path:
    """A folder with the effect and the settings as the page writes them."""
    write_effect(tmp_path)
    (tmp_path / "experiment.yaml").write_text(block("yaml"), encoding="utf-8")
    (tmp_path / "trials.csv").write_text(SHEET, encoding="utf-8")
    (tmp_path / "a.csv").write_text("time_s,position_m\n" + "".join(f"{i / 1000},{i / 1e4}\n" for i in range(20)))
    return tmp_path


def test_its_own_effect_is_read_and_keeps_its_worked_number(experiment: Path) -> None:
    assert list(own_effects([experiment / "spring_line.py"])) == ["spring_line"]


def test_its_settings_put_that_effect_in_the_model(experiment: Path) -> None:
    model = model_of(read_experiment(experiment))
    assert model.names == ("pressure_drive", "gravity", "eversion_damping", "yield_pressure", "spring_line")


def test_its_effect_is_explained_by_the_command_it_names(experiment: Path) -> None:
    done = CliRunner().invoke(app, ["effects", "spring_line", "--experiment", str(experiment)])
    assert done.exit_code == 0, done.output
    assert "stiffness of the line" in done.output


def test_its_effect_goes_through_every_stage_and_stands_in_the_provenance(experiment: Path, tmp_path: Path) -> None:
    results = tmp_path / "results"
    for arguments in (
        ["tracks", experiment, results],
        ["gather", experiment, results],
        ["damping", results],
        ["model", experiment, results],
        ["figures", experiment, results, "--settings", '{"figures": {"dpi": 50}}'],
        ["report", experiment, results],
    ):
        done = CliRunner().invoke(app, [str(argument) for argument in arguments], catch_exceptions=False)
        assert done.exit_code == 0, done.output
    assert "spring_line" in json.loads((results / "fit.json").read_text())["model"]
    assert "spring_line.py" in json.loads((results / "provenance.json").read_text())["inputs"]


def test_what_the_page_shows_of_the_effect_is_what_is_printed(experiment: Path) -> None:
    shown = next(piece for piece in pieces(PAGE.read_text(encoding="utf-8")) if isinstance(piece, Shown))
    assert shown.arguments == ("effects", "spring_line", "--experiment", "my_experiment")
    done = CliRunner().invoke(app, ["effects", "spring_line", "--experiment", str(experiment)])
    assert done.stdout.strip().replace(str(experiment), "my_experiment") == shown.output


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ("    tail force −k x\n", "", "the docstring must say what it is and show the formula on an indented line"),
        ("def tail_force", "def pull", "defines none of the functions"),
        ("(s, rig, k)", "(s, rig)", "tail_force(s, rig) must be tail_force(s, rig, k)"),
        ('"N/m", 0.5', '"N/m", 50.0', "the default of k lies outside its bounds"),
        ("from vinetrack", "1 / 0\nfrom vinetrack", "this effect cannot be read ("),
        ("s.tail_position\n", "s.tail_place\n", "tail_force cannot be compiled: "),
        ("-0.1,", "-0.2,", "tail_force gives -0.1 where worked out by hand it is -0.2 ("),
    ],
)
def test_its_messages_are_those_that_are_given(tmp_path: Path, old: str, new: str, told: str) -> None:
    text = block("python")
    assert old in text
    path = tmp_path / "spring_line.py"
    path.write_text(text.replace(old, new), encoding="utf-8")
    with pytest.raises(EffectError) as caught:
        own_effects([path])
    assert told in str(caught.value)
    assert f"`{told}" in PAGE.read_text(encoding="utf-8")
