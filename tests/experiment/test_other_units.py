"""Columns in other units are converted, and said so."""

from __future__ import annotations

from pathlib import Path

import pytest

from vinetrack.core.units import convert, other_units, split_unit
from vinetrack.experiment.folder import ExperimentError, read_experiment
from vinetrack.experiment.schema import COLUMNS, Column

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
    assert {(problem.code, problem.severity) for problem in said.values()} == {("unit", "warning")}
    assert "6.89476" in said["pressure_psi"].message


def test_the_bounds_of_the_column_hold_after_conversion(tmp_path: Path) -> None:
    header = REST + "diameter_in,pressure_kPa,yield_pressure_kPa"
    read = read_experiment(write(tmp_path / "v", header, "a,a.csv,100,300,25,28,3"))
    assert "diameter_mm '635' is above 300 mm" in read.failed["a"]


def test_a_quantity_in_two_units_keeps_that_of_the_sheet(tmp_path: Path) -> None:
    header = REST + "diameter_mm,diameter_in,pressure_kPa,yield_pressure_kPa"
    read = read_experiment(write(tmp_path / "v", header, "a,a.csv,100,300,24,2,28,3"))
    assert read.trials[0].diameter_m == 24 / 1000
    assert ("twice", "diameter_in") in [(problem.code, problem.column) for problem in read.problems]


def test_a_key_of_the_settings_in_another_unit_is_converted_and_said(tmp_path: Path) -> None:
    header = "trial,track,thickness_um,length_mm,diameter_mm,pressure_kPa"
    folder = write(tmp_path / "v", header, "a,a.csv,100,300,24,28")
    (folder / "experiment.yaml").write_text("yield_pressure_psi: 0.435\n")
    read = read_experiment(folder)
    assert read.trials[0].yield_pressure_Pa == pytest.approx(435 * 6.894757293168361, rel=1e-12)
    (problem,) = [problem for problem in read.problems if problem.file == "experiment.yaml"]
    assert (problem.code, problem.column, problem.line) == ("unit", "yield_pressure_psi", 1)


@pytest.mark.parametrize(
    "blank", ["yield_pressure_kPa:\nyield_pressure_psi: 0.435", "yield_pressure_kPa: 3\nyield_pressure_psi:"]
)
def test_a_blank_key_gives_way_to_the_same_quantity_in_another_unit(tmp_path: Path, blank: str) -> None:
    """As the set-up page writes them: the unit of a quantity is changed, the line of the other one stays."""
    folder = write(tmp_path / "v", REST + "diameter_mm,pressure_kPa", "a,a.csv,100,300,24,28")
    (folder / "experiment.yaml").write_text(blank + "\n")
    assert read_experiment(folder).trials[0].yield_pressure_Pa == pytest.approx(3000, rel=1e-3)


def test_a_blank_column_gives_way_to_the_same_quantity_in_another_unit(tmp_path: Path) -> None:
    header = REST + "diameter_mm,pressure_kPa,pressure_psi,yield_pressure_kPa"
    (trial,) = read_experiment(write(tmp_path / "v", header, "a,a.csv,100,300,24,,4,3")).trials
    assert trial.pressure_Pa == pytest.approx(4 * 6894.757293168361, rel=1e-14)


NUMBERS = [column for column in COLUMNS.values() if column.kind == "number" and other_units(column.name)]


@pytest.mark.parametrize("column", NUMBERS, ids=lambda column: column.name)
@pytest.mark.parametrize("place", ["sheet", "settings"])
def test_every_unit_of_every_column_is_read(tmp_path: Path, column: Column, place: str) -> None:
    usual = {"trial": "a", "track": "a.csv", "thickness_um": "100", "length_mm": "300", "diameter_mm": "24"}
    usual |= {"pressure_kPa": "28", "yield_pressure_kPa": "3"}
    in_own_unit = float(usual.get(column.name) or {"film_density_kg_m3": 1100}.get(column.name, 12))
    usual.pop(column.name, None)
    for name, unit in other_units(column.name).items():
        value = f"{convert(in_own_unit, split_unit(column.name)[1], unit):.15g}"
        cells = usual | ({name: value} if place == "sheet" else {})
        folder = write(tmp_path / name, ",".join(cells), ",".join(cells.values()))
        (folder / "experiment.yaml").write_text(f"{name}: {value}\n{column.name}:\n" if place == "settings" else "")
        assert column.of_trial(read_experiment(folder).trials[0]) == pytest.approx(in_own_unit, rel=1e-12)


def test_keys_of_groups_and_ranges_are_converted(tmp_path: Path) -> None:
    folder = write(tmp_path / "v", REST + "diameter_mm,pressure_kPa,yield_pressure_kPa", "a,a.csv,100,300,24,28,3")
    text = "limits: {pressure_psi: '1:5', diameter_in: [1, 2], hoop_stress_kPa: 7000}\nambient_pressure_bar: 1\n"
    (folder / "experiment.yaml").write_text(text + "axis: {from_px: [1, 2], to_px: [9, 90], width_cm: 2}\n")
    settings = read_experiment(folder).settings
    assert settings.limits.pressure_kPa == pytest.approx((6.894757, 34.473786))
    assert (settings.limits.diameter_mm, settings.limits.hoop_stress_MPa) == ((25.4, 50.8), 7)
    assert (settings.ambient_pressure_kPa, settings.axis.width_mm) == (100, 20)


def test_a_key_in_two_units_is_refused(tmp_path: Path) -> None:
    header = "trial,track,thickness_um,length_mm,diameter_mm,pressure_kPa"
    folder = write(tmp_path / "v", header, "a,a.csv,100,300,24,28")
    (folder / "experiment.yaml").write_text("yield_pressure_psi: 0.435\nyield_pressure_kPa: 3\n")
    with pytest.raises(ExperimentError):
        read_experiment(folder)
