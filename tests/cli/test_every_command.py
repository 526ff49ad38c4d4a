"""Every command that reads results, on those of films and of tracks, with a trial left out and an effect saved."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from explorer_campaign import FEW_CANDIDATES, SETTINGS, SMALL, make_experiment, make_results, run

pytestmark = pytest.mark.slow

LEFT_OUT = "d24_36kPa_2"
"""The second replicate of its condition, so that the condition stays."""

VINE = ("--diameter-mm", "24", "--length-mm", "280", "--pressure-kPa", "30", "--chamber-l", "2")
COMMANDS = (
    ("compare", "RESULTS"),
    ("diagnose", "RESULTS"),
    ("power", "RESULTS"),
    ("power", "RESULTS", "--effect", "air_drag"),
    ("add", "air_drag", "RESULTS"),
    ("predict", "--fit", "RESULTS", *VINE, "--thickness-um", "200"),
    ("design", "vine", "--fit", "RESULTS", "--pressure-kPa", "40", "--chamber-l", "2", "--samples", "50"),
    ("design", "reservoir", "--fit", "RESULTS", *VINE),
)


@pytest.fixture(scope="module", params=["films", "tracks"])
def results(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    base = tmp_path_factory.mktemp(request.param)
    settings = SETTINGS + FEW_CANDIDATES + "model: [pressure_drive, gravity, eversion_damping, yield_pressure, leak]\n"
    experiment = make_experiment(base / "vines", SMALL, settings)
    sheet = pd.read_csv(experiment / "trials.csv")
    sheet.assign(use=np.where(sheet["trial"] == LEFT_OUT, "no", "")).to_csv(experiment / "trials.csv", index=False)
    folder = make_results(experiment, base / "results" / "vines")
    if request.param == "films":
        film(experiment, folder)
    run("model", experiment, folder)
    return folder


def film(experiment: Path, folder: Path) -> None:
    """Say that the trials were filmed: their tracks state the slow error of a tracker, which is larger near a door."""
    sheet = pd.read_csv(experiment / "trials.csv").rename(columns={"track": "video"})
    (experiment / "film.mp4").touch()
    sheet.assign(video="film.mp4").to_csv(experiment / "trials.csv", index=False)
    for path in (folder / "tracks").glob("*.csv"):
        table = pd.read_csv(path)
        slow_m = np.where(np.arange(len(table)) < 20, 4e-4, 1e-4)
        table.assign(lead_position_systematic_m=slow_m).to_csv(path, index=False)


@pytest.mark.parametrize("command", COMMANDS, ids=" ".join)
def test_a_command_answers_for_every_kind_of_results(command: tuple[str, ...], results: Path, tmp_path: Path) -> None:
    written = tmp_path / "answer.json"
    run(*(results if word == "RESULTS" else word for word in command), "--json", written)
    assert json.loads(written.read_text())


def test_a_diagnosis_asked_for_again_writes_all_that_the_run_wrote(results: Path) -> None:
    files = {path: path.read_bytes() for path in [results / "diagnosis.json", *(results / "diagnosis").glob("*.csv")]}
    assert results / "diagnosis" / "damping_laws.csv" in files
    run("diagnose", results)
    assert {path: path.read_bytes() for path in files} == files
