"""Columns in other units are converted, and said so."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from vinetrack.experiment.folder import ExperimentError, read_experiment

REST = "trial,track,thickness_um,length_mm,"
TRACK = "time_s,position_m\n" + "".join(f"{i / 1000},{i / 1000}\n" for i in range(8))


def write(folder: Path, header: str, row: str) -> Path:
    folder.mkdir(exist_ok=True)
    (folder / "trials.csv").write_text(f"{header}\n{row}\n", encoding="utf-8")
    (folder / "a.csv").write_text(TRACK)
    return folder


def test_psi_bar_and_inches_become_kpa_and_millimetres(tmp_path: Path) -> None:
    folder = write(
        tmp_path / "v", REST + "diameter_in,pressure_psi,yield_pressure_bar,payload_oz", "a,a.csv,100,300,1,4,0.03,2"
    )
    read = read_experiment(folder)
    (trial,) = read.trials
    assert trial.diameter_m == pytest.approx(0.0254, rel=1e-14)
    assert trial.pressure_Pa == pytest.approx(4 * 6894.757293168361, rel=1e-14)
    assert trial.yield_pressure_Pa == pytest.approx(3000, rel=1e-14)
    assert trial.payload_kg == pytest.approx(0.05669904625, rel=1e-14)
    said = {problem.column: problem for problem in read.problems}
    assert said["pressure_psi"].severity == "warning"
    assert said["pressure_psi"].message == "is read as pressure_kPa: 1 psi is 6.89476 kPa"
    assert said["diameter_in"].message == "is read as diameter_mm: 1 in is 25.4 mm"


def test_a_sheet_with_decimal_commas_is_converted_as_well(tmp_path: Path) -> None:
    header = (REST + "diameter_cm,pressure_kPa,yield_pressure_kPa").replace(",", ";")
    (trial,) = read_experiment(write(tmp_path / "v", header, "a;a.csv;100;300;2,4;28,5;3")).trials
    assert trial.diameter_m == pytest.approx(0.024, rel=1e-14)
    assert trial.pressure_Pa == 28500


def test_the_bounds_of_the_column_hold_after_conversion(tmp_path: Path) -> None:
    header = REST + "diameter_in,pressure_kPa,yield_pressure_kPa"
    read = read_experiment(write(tmp_path / "v", header, "a,a.csv,100,300,25,28,3"))
    assert "diameter_mm '635' is above 300 mm" in read.failed["a"]


def test_a_quantity_in_two_units_keeps_that_of_the_sheet(tmp_path: Path) -> None:
    header = REST + "diameter_mm,diameter_in,pressure_kPa,yield_pressure_kPa"
    read = read_experiment(write(tmp_path / "v", header, "a,a.csv,100,300,24,2,28,3"))
    assert read.trials[0].diameter_m == 24 / 1000
    assert any("the sheet also has diameter_mm" in problem.message for problem in read.problems)


def test_a_unit_of_another_quantity_is_no_column(tmp_path: Path) -> None:
    header = REST + "diameter_mm,pressure_kPa,yield_pressure_kPa,chamber_in"
    read = read_experiment(write(tmp_path / "v", header, "a,a.csv,100,300,24,28,3,4"))
    assert math.isnan(read.trials[0].chamber_m3)
    assert any(problem.column == "chamber_in" and "not a column" in problem.message for problem in read.problems)


def test_a_key_of_the_settings_in_another_unit_is_converted_and_said(tmp_path: Path) -> None:
    header = "trial,track,thickness_um,length_mm,diameter_mm,pressure_kPa"
    folder = write(tmp_path / "v", header, "a,a.csv,100,300,24,28")
    (folder / "experiment.yaml").write_text("yield_pressure_psi: 0.435\n")
    read = read_experiment(folder)
    assert read.trials[0].yield_pressure_Pa == pytest.approx(435 * 6.894757293168361, rel=1e-12)
    (problem,) = [problem for problem in read.problems if problem.file == "experiment.yaml"]
    assert (problem.column, problem.line, problem.severity) == ("yield_pressure_psi", 1, "warning")
    assert problem.message == "is read as yield_pressure_kPa: 1 psi is 6.89476 kPa"


def test_a_key_in_two_units_is_refused(tmp_path: Path) -> None:
    header = "trial,track,thickness_um,length_mm,diameter_mm,pressure_kPa"
    folder = write(tmp_path / "v", header, "a,a.csv,100,300,24,28")
    (folder / "experiment.yaml").write_text("yield_pressure_psi: 0.435\nyield_pressure_kPa: 3\n")
    with pytest.raises(ExperimentError, match="yield_pressure_psi is not a setting"):
        read_experiment(folder)
