"""`vinetrack propose`: from a verdict of `unexplained` to an effect file that `vinetrack add` takes."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
from grown import FORCES, effect_file, grown, sheet
from typer.testing import CliRunner

from vinetrack.cli.main import app
from vinetrack.diagnosis import propose as search
from vinetrack.diagnosis.propose import propose
from vinetrack.dynamics.model import Model
from vinetrack.effects import own_effects
from vinetrack.experiment.settings import read_experiment_settings
from vinetrack.laboratory.tracks import write_experiment


def run(*arguments: str | Path) -> tuple[int, str]:
    done = CliRunner().invoke(app, [str(one) for one in arguments])
    return done.exit_code, done.output


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """An experiment whose vines feel a force that grows with time, and its results; one candidate, which is not it."""
    place = tmp_path_factory.mktemp("lawful")
    values = {"hidden.a": -0.3, "hidden.kind": float(list(FORCES).index("growing"))}
    virtual = grown(sheet((4,), replicates=1), 103, own=[effect_file(place)], values=values)
    experiment, results = place / "bench", place / "results"
    write_experiment(virtual, experiment, "candidates: [air_drag]\n")
    for stage in (("tracks", experiment, results), ("gather", experiment, results), ("damping", results)):
        code, output = run(*stage)
        assert code == 0, output
    for stage in ("model", "diagnosis"):
        code, output = run(stage, experiment, results)
        assert code == 0, output
    (results / "provenance.json").write_text(json.dumps({"experiment": str(experiment)}))
    return experiment, results


def test_a_law_is_written_beside_the_experiment_and_added(
    bench: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    experiment, results = bench
    assert json.loads((results / "diagnosis.json").read_text())["verdict"] == "unexplained"
    proposals = []
    monkeypatch.setattr(search, "propose", lambda *given: proposals.append(propose(*given)) or proposals[-1])
    code, output = run("propose", results)
    assert code == 0, output
    assert "Proposed: a force that grows in proportion to time" in output
    path = experiment / "proposed_time.py"
    effect = own_effects([path])["proposed_time"]
    assert "4 trials of bench" in effect.text
    monkeypatch.setattr(search, "propose", lambda *_: proposals[0])  # the same once more, without the search
    code, output = run("propose", results)
    assert code == 1
    assert "exists already" in output
    elsewhere = shutil.copy(path, tmp_path)
    code, output = run("add", elsewhere, results, "--save")
    assert code == 1
    assert f"move the file into {experiment}" in output
    # Without the rest of the catalogue, with which this effect would be compiled once more.
    monkeypatch.setattr("vinetrack.diagnosis.ladder.host_for", lambda model, more: Model((*model.effects, *more)))
    code, output = run("add", path, results, "--save")
    assert code == 0, output
    assert "proposed_time added to" in output
    settings = read_experiment_settings(experiment / "experiment.yaml")
    assert (settings.model[-1], settings.effects) == ("proposed_time", ("proposed_time.py",))


def test_nothing_is_proposed_where_the_verdict_is_another(bench: tuple[Path, Path], tmp_path: Path) -> None:
    copy = shutil.copytree(bench[1], tmp_path / "results")
    diagnosis = json.loads((copy / "diagnosis.json").read_text())
    for asked in diagnosis["rounds"]:
        asked["verdict"] = "adequate"
    (copy / "diagnosis.json").write_text(json.dumps(diagnosis | {"verdict": "adequate", "final_verdict": "adequate"}))
    code, output = run("propose", copy)
    assert code == 1
    assert "its verdict is `adequate`" in output
    assert "Traceback" not in output
