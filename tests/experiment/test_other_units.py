"""Columns in other units are converted, and said so."""

import pytest
from hand_sheet import one

from vinetrack.core.units import convert, other_units, split_unit
from vinetrack.experiment.folder import ExperimentError
from vinetrack.experiment.schema import COLUMNS

PSI = 6894.757293168361


def test_other_units_of_sheet_and_settings_are_converted_and_said(tmp_path):
    own = {"diameter_in": "1", "pressure_psi": "4", "payload_oz": "2", "diameter_mm": None, "pressure_kPa": None}
    read = one(tmp_path, "yield_pressure_psi: 0.435\n", yield_pressure_kPa=None, payload_g=None, **own)
    (trial,) = read.trials
    assert trial.diameter_m == pytest.approx(0.0254, rel=1e-14)
    assert trial.payload_kg == pytest.approx(0.05669904625, rel=1e-14)
    assert (trial.pressure_Pa, trial.yield_pressure_Pa) == pytest.approx((4 * PSI, 0.435 * PSI), rel=1e-12)
    said = {problem.column: problem for problem in read.problems}
    assert {(problem.code, problem.severity) for problem in said.values()} == {("unit", "warning")}
    assert said.keys() == {"diameter_in", "pressure_psi", "payload_oz", "yield_pressure_psi"}
    assert "6.89476" in said["pressure_psi"].message
    assert (said["yield_pressure_psi"].file, said["yield_pressure_psi"].line) == ("experiment.yaml", 1)


def test_the_bounds_hold_after_conversion_and_of_two_units_that_with_a_value_counts(tmp_path):
    assert "diameter_mm '635' is above 300 mm" in one(tmp_path, diameter_mm=None, diameter_in="25").failed["a"]
    read = one(tmp_path, diameter_in="2")
    assert read.trials[0].diameter_m == 24 / 1000
    assert ("twice", "diameter_in") in [(problem.code, problem.column) for problem in read.problems]
    (trial,) = one(tmp_path, pressure_kPa="", pressure_psi="4").trials
    assert trial.pressure_Pa == pytest.approx(4 * PSI, rel=1e-14)
    # As the set-up page writes keys: the unit of a quantity is changed, the line of the other one stays.
    for blank in ("yield_pressure_kPa:\nyield_pressure_psi: 0.435", "yield_pressure_kPa: 3\nyield_pressure_psi:"):
        (trial,) = one(tmp_path, blank, yield_pressure_kPa=None).trials
        assert trial.yield_pressure_Pa == pytest.approx(3000, rel=1e-3)
    with pytest.raises(ExperimentError):
        one(tmp_path, "yield_pressure_psi: 0.435\nyield_pressure_kPa: 3\n", yield_pressure_kPa=None)


NUMBERS = [column for column in COLUMNS.values() if column.kind == "number" and other_units(column.name)]


@pytest.mark.parametrize("column", NUMBERS, ids=lambda column: column.name)
@pytest.mark.parametrize("place", ["sheet", "settings"])
def test_every_unit_of_every_column_is_read(tmp_path, column, place):
    usual = {"diameter_mm": 24, "thickness_um": 200, "length_mm": 280, "pressure_kPa": 28, "yield_pressure_kPa": 3}
    in_own_unit = {**usual, "film_density_kg_m3": 1100}.get(column.name, 12)
    for name, unit in other_units(column.name).items():
        value = f"{convert(in_own_unit, split_unit(column.name)[1], unit):.15g}"
        settings = f"{name}: {value}\n{column.name}:\n" if place == "settings" else ""
        cells = {name: value} if place == "sheet" else {}
        (trial,) = one(tmp_path, settings, **{column.name: None, **cells}).trials
        assert column.of_trial(trial) == pytest.approx(in_own_unit, rel=1e-12)


def test_keys_of_groups_and_ranges_are_converted(tmp_path):
    text = "limits: {pressure_psi: '1:5', diameter_in: [1, 2], hoop_stress_kPa: 7000}\nambient_pressure_bar: 1\n"
    settings = one(tmp_path, text + "axis: {from_px: [1, 2], to_px: [9, 90], width_cm: 2}\n").settings
    assert settings.limits.pressure_kPa == pytest.approx((6.894757, 34.473786))
    assert (settings.limits.diameter_mm, settings.limits.hoop_stress_MPa) == ((25.4, 50.8), 7)
    assert (settings.ambient_pressure_kPa, settings.axis.width_mm) == (100, 20)
