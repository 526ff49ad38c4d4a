"""A trial sheet of two vines written by hand, for tests to break."""

import csv
import io
from pathlib import Path

import pytest

from vinetrack.experiment.folder import Experiment, ExperimentError, Problem, read_experiment

HEADER = "trial,track,diameter_mm,thickness_um,length_mm,pressure_kPa,yield_pressure_kPa,payload_g"
GOOD = f"{HEADER}\na,a.csv,24,200,280,28,3,35.6\nb,b.csv,24,200,280,14,3,0\n"
TRACK = "time_s,position_m\n" + "".join(f"{i / 1000},{i * i / 1e6}\n" for i in range(20))


def one_vine(folder: Path, rows: str = "a,a.csv,12,100,300,20,3\n", more: str = "") -> Path:
    """Trials of one track of 20 frames, which is too short for anything; `more` are further columns of the sheet."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "trials.csv").write_text(f"{HEADER.removesuffix(',payload_g')}{more}\n{rows}")
    (folder / "a.csv").write_text("time_s,position_m\n" + "".join(f"{i / 1000},{i / 1e4}\n" for i in range(20)))
    return folder


def two_vines(tmp_path: Path) -> Path:
    path = tmp_path / "my-vines"
    path.mkdir()
    write(path, GOOD)
    for name in "ab":
        (path / f"{name}.csv").write_text(TRACK)
    return path


def write(folder: Path, sheet: str, settings: str | None = None) -> Path:
    (folder / "trials.csv").write_text(sheet, encoding="utf-8")
    if settings is not None:
        (folder / "experiment.yaml").write_text(settings, encoding="utf-8")
    return folder


def one(folder: Path, settings: str | None = None, **cells: str | None) -> Experiment:
    """An experiment of the trial `a` alone, with these cells; a column that is None is not in the sheet."""
    row = dict(zip(HEADER.split(","), GOOD.splitlines()[1].split(","), strict=True)) | cells
    given = {name: cell for name, cell in row.items() if cell is not None}
    text = io.StringIO()
    csv.writer(text).writerows([given, given.values()])
    (folder / "a.csv").write_text(TRACK)
    return read_experiment(write(folder, text.getvalue(), settings))


def stopped(folder: Path, strict: bool | None = None) -> tuple[Problem, ...]:
    with pytest.raises(ExperimentError) as caught:
        read_experiment(folder, strict)
    return caught.value.problems
