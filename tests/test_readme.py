"""What the README shows works as it stands there."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest
from typer.testing import CliRunner

from vinetrack.cli import app
from vinetrack.effects._own import own_effects
from vinetrack.experiment import read_experiment
from vinetrack.stages.tracks import model_of

README = Path(__file__).parents[1] / "README.md"
SHEET = "trial,track,diameter_mm,thickness_um,length_mm,pressure_kPa,yield_pressure_kPa\na,a.csv,12,100,300,20,3\n"


def block(language: str) -> str:
    found = re.findall(rf"^```{language}\n(.*?)^```", README.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)
    assert len(found) == 1
    return str(found[0])


@pytest.fixture
def experiment(tmp_path: Path) -> Path:
    """A folder with the effect and the settings as the README writes them."""
    (tmp_path / "spring_line.py").write_text(block("python"), encoding="utf-8")
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
