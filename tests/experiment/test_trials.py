"""What a sheet says of trials: conditions, order, columns of one alone, other units, corrections; planned ones."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hand_sheet import GOOD, HEADER, TRACK, one, two_vines, write

from vinetrack.core.problems import ExperimentError, InputError
from vinetrack.core.records import Bend, Correction, PictureAxis, Trial
from vinetrack.core.units import convert, other_units, pressure_text, split_unit
from vinetrack.experiment import folder
from vinetrack.experiment.folder import planned_sheet, planned_trial
from vinetrack.experiment.schema import COLUMNS, with_names
from vinetrack.tracks.importers import load_track, read_track


def corrected(folder: Path, text: str) -> Path:
    row = "a.mp4,12,100,140,24,3,"
    (folder / "trials.csv").write_text(f"{HEADER.replace('track', 'video')},capture_fps\na,{row},1000\n")
    (folder / "corrections.csv").write_text(text)
    return folder


def test_corrections_reach_their_trial_and_are_written_as_they_are_read(tmp_path):
    corrected(tmp_path, "trial,frame,action,edge_px\na,12,move,310.5\na,3,drop,\na,40,confirm,\n")
    trial = folder.read_experiment(tmp_path).trial("a")
    assert [(one.frame, one.action) for one in trial.corrections] == [(3, "drop"), (12, "move"), (40, "confirm")]
    assert trial.corrections[1].edge_px == 310.5
    given = {"a": (Correction(3, "drop"), Correction(12, "move", 310.5))}
    (tmp_path / "corrections.csv").write_text(folder.corrections_text(given))
    found, problems = folder.read_corrections(tmp_path)
    assert problems == []
    assert folder.corrections_text(found) == folder.corrections_text(given)


def test_a_line_that_makes_no_sense_stops_with_its_place(tmp_path):
    for line in ("a,3,remove,", "a,3.5,drop,", "a,-1,drop,", "a,3,move,", "a,three,drop,", "a,3,drop,\na,3,confirm,"):
        corrected(tmp_path, f"trial,frame,action,edge_px\n{line}\n")
        with pytest.raises(ExperimentError) as stopped:
            folder.read_experiment(tmp_path)
        assert "corrections.csv" in {problem.file for problem in stopped.value.problems}, line


TRIAL = Trial(
    name="a", diameter_m=0.024, thickness_m=200e-6, length_m=0.28, pressure_Pa=28e3, yield_pressure_Pa=3e3, inlet_m=8e-3
)
ALWAYS_COMPARED = {"diameter_mm", "thickness_um", "length_mm", "pressure_kPa", "yield_pressure_kPa", "payload_g"}
"""Columns of a vine's name and of every condition's name, and the yield pressure, which a vine's trials share."""
OF_A_REPLICATE = {
    *("trial", "use", "order", "specimen", "day"),
    *("video", "track", "point_mass", "frames_used", "axis", "steady", "mm_per_px", "compare_sizes"),
    *("capture_fps", "capture_fps_is_playback", "exposure_us"),
    *("pressure_trace", "pressure_sigma_kPa", "yield_pressure_sigma_kPa"),
}
"""Columns in which replicates may differ: they say how a trial was recorded and read, which trial of several it is, and
how well its numbers are known, not what was done to the vine."""
OTHER_VALUES = {"bends": (Bend(0.1, 0.05, 0.03),), "travel_ratio": 1.0}


def conditions(field: str, value) -> set[str]:
    """Names of the conditions of a trial and of one with another value of a field."""
    return {trial.condition for trial in with_names([TRIAL, replace(TRIAL, **{"name": "b", field: value})])}


def test_every_column_says_whether_it_defines_a_condition() -> None:
    # A new column is either given a `condition_part`, or named above: else different settings count as replicates.
    shown = {name for name, column in COLUMNS.items() if column.condition_part}
    assert shown | ALWAYS_COMPARED | OF_A_REPLICATE == set(COLUMNS)
    assert not shown & (ALWAYS_COMPARED | OF_A_REPLICATE)


def test_trials_that_differ_in_a_setting_are_two_conditions():
    for name, column in COLUMNS.items():
        if name not in OF_A_REPLICATE:
            value = OTHER_VALUES[name] if name in OTHER_VALUES else column.scale.to_si(7.0)
            assert len(conditions(column.field, value)) == 2, name


def test_trials_that_differ_in_how_they_were_recorded_are_replicates():
    numbers = [column for name, column in COLUMNS.items() if name in OF_A_REPLICATE and column.kind == "number"]
    assert {len(conditions(column.field, column.scale.to_si(7.0))) for column in numbers} == {1}


def test_the_name_of_a_condition_shows_what_differs():
    base = "24mm-200um-280mm_28kPa_0g"
    for field, value, parts in (
        ("growth_angle_rad", 1.5707963267948966, {"0deg", "90deg"}),
        ("chamber_m3", 3.7e-3, {"", "chamber3.7l"}),
        ("inlet_m", 5.7e-3, {"inlet8mm", "inlet5.7mm"}),
        ("bends", (Bend(0.1, 0.05, 0.03), Bend(0.2, 0.06, 0.04)), {"", "bends100x50x30-200x60x40"}),
        ("film_density_kg_m3", 920.0, {"film1200", "film920"}),
        ("travel_ratio", 1.0, {"ratio2", "ratio1"}),
        ("yield_pressure_Pa", 5e3, {"yield3kPa", "yield5kPa"}),
    ):
        assert conditions(field, value) == {f"{base}_{part}".rstrip("_") for part in parts}
    in_psi = [replace(TRIAL, pressure_unit="psi", yield_pressure_Pa=psi * 6894.757293168361) for psi in (0.5, 0.7)]
    assert [trial.condition.split("_")[-1] for trial in with_names(in_psi)] == ["yield0.5psi", "yield0.7psi"]
    # Another vine has a yield pressure of its own.
    named = with_names([TRIAL, replace(TRIAL, name="b", diameter_m=0.012, thickness_m=1e-4, yield_pressure_Pa=5e3)])
    assert [trial.condition for trial in named] == [base, "12mm-100um-280mm_28kPa_0g"]


def test_frames_and_axis_of_one_trial_alone(tmp_path):
    (trial,) = one(tmp_path, frames_used="5:15", axis="161,40:151.5,799:20").trials
    assert trial.axis == PictureAxis((161.0, 40.0), (151.5, 799.0), pytest.approx(0.02))
    track = load_track(trial)
    assert np.flatnonzero(track.usable).tolist() == list(range(5, 16))
    assert (track.flag[0], track.flag[-1]) == ("rejected", "after_end")


@pytest.mark.real
def test_either_of_two_point_masses_of_a_real_project(real):
    path = real / "falling_cups" / "cups.trk"
    with pytest.raises(InputError, match="no point named 'cup': point_mass is one of 'cup 3', 'cup 7'"):
        read_track(path, point_mass="cup")
    third, seventh = (read_track(path, point_mass=name) for name in ("cup 3", "Cup 7"))
    # The heavier stack falls further over the same frames.
    common = min(third.time_s.size, seventh.time_s.size)
    assert np.ptp(seventh.lead_position_m[:common]) > np.ptp(third.lead_position_m[:common])
    assert 5 <= read_track(path, point_mass="cup 3", frames_used=(2, 8)).time_s.size < third.time_s.size


PRESSURES = (20, 20, 24, 24, 28, 28, 32, 32, 36, 36)


def written(folder: Path, columns: str = "", cells: tuple[str, ...] = ("",) * 10) -> Path:
    """Ten trials of one vine at five rising pressures."""
    (folder / "a.csv").write_text(TRACK)
    lines = [f"t{i},a.csv,24,200,280,{PRESSURES[i]},3,{cells[i]}" for i in range(10)]
    return write(folder, f"{HEADER}{columns}\n" + "\n".join(lines) + "\n")


def test_times_in_milliseconds_are_asked_about(tmp_path):
    written(tmp_path)
    for factor, codes in ((1.0, []), (1e3, ["times"] * 10)):
        lines = [f"{factor * i / 1069},{1e-5 * i**2}" for i in range(60)]
        (tmp_path / "a.csv").write_text("time_s,position_m\n" + "\n".join(lines) + "\n")
        assert [problem.code for problem in folder.check_experiment(tmp_path) if problem.trial] == codes


def test_the_order_is_that_of_the_sheet_or_else_of_its_rows(tmp_path):
    cells = tuple(f",tube {i % 2},monday,{10 - i}" for i in range(10))
    trials = folder.read_experiment(written(tmp_path, ",specimen,day,order", cells)).trials
    ranks, stated = folder.trial_order(trials)
    assert (stated, ranks.tolist()) == (True, list(range(9, -1, -1)))
    assert len({trial.condition for trial in trials}) == 5, "they are replicates all the same"
    trials = folder.read_experiment(written(tmp_path)).trials
    ranks, stated = folder.trial_order(trials)
    assert (stated, ranks.tolist()) == (False, list(range(10)))
    assert folder.order_pressure_correlation(trials) == pytest.approx(0.985, abs=0.005)


def test_check_warns_of_an_order_or_a_specimen_that_follows_the_pressure(tmp_path):
    for column, cells, codes in (
        ("", ("",) * 10, ["confounded"]),  # the rows are in order of pressure
        ("order", tuple(f",{i + 1}" for i in range(10)), ["confounded"]),
        ("order", tuple(f",{i + 1}" for i in np.random.default_rng(1).permutation(10)), []),
        ("specimen", tuple(f",{pressure}" for pressure in PRESSURES), ["confounded"]),
        ("specimen", tuple(f",{i % 2}" for i in range(10)), []),
    ):
        found = folder.check_experiment(written(tmp_path, f",{column}" if column else "", cells))
        assert [problem.code for problem in found if problem.column == (column or "order")] == codes


VINE = {"diameter_mm": "24", "thickness_um": "200", "length_mm": "280", "pressure_kPa": "28"}


def test_replicates_are_one_condition_and_rows_not_in_use_none(tmp_path):
    header, a, b = GOOD.splitlines()
    more = a.replace("a,a", "c,a"), b.replace("b,b.csv,24", "d,b.csv,30")
    sheet = f"{header},use\n{a},\n{b},\n{more[0]},\n{more[1]},no\n"
    trials = planned_sheet(write(two_vines(tmp_path), sheet)).trials
    assert [trial.name for trial in trials] == ["a", "b"]


def test_settings_are_those_of_the_experiment_and_faults_are_named_as_there(tmp_path):
    folder = write(two_vines(tmp_path), GOOD, "chamber_l: 2\nmodel: [pressure_drive, gravity, leak]\n")
    planned = planned_sheet(folder)
    assert planned.trials[0].chamber_m3 == pytest.approx(2e-3)
    assert planned.settings.model[-1] == "leak"
    write(folder, GOOD.replace(",28,", ",28000,"))
    with pytest.raises(ExperimentError) as caught:
        planned_sheet(folder)
    (problem,) = caught.value.problems
    assert (problem.file, problem.line, problem.trial, problem.column) == ("trials.csv", 2, "a", "pressure_kPa")
    with pytest.raises(ExperimentError) as caught:
        planned_trial({**VINE, "travel_ratio": "1"})  # a body that moves as a whole is not predicted
    assert any("--travel-ratio" in str(problem) for problem in caught.value.problems)


def test_a_sheet_needs_no_recordings_and_an_unknown_column_is_not_passed_over(tmp_path):
    """A payload under a wrong name would else be taken for none."""
    text = "trial,diameter_mm,thickness_um,length_mm,pressure_kPa,payload_gr\na,24,200,280,28,35.6\n"
    (tmp_path / "ideas.csv").write_text(text, encoding="utf-8")
    planned = planned_sheet(tmp_path / "ideas.csv")
    assert ([trial.name for trial in planned.trials], planned.folder) == (["a"], tmp_path)
    (problem,) = planned.problems
    assert "payload_gr" in str(problem)


PSI = 6894.757293168361


def test_other_units_of_sheet_and_settings_are_converted_and_said(tmp_path):
    own = {"diameter_in": "1", "pressure_psi": "4", "payload_oz": "2", "diameter_mm": None, "pressure_kPa": None}
    read = one(tmp_path, "yield_pressure_psi: 0.435\n", yield_pressure_kPa=None, payload_g=None, **own)
    (trial,) = read.trials
    assert trial.diameter_m == pytest.approx(0.0254, rel=1e-14)
    assert trial.payload_kg == pytest.approx(0.05669904625, rel=1e-14)
    assert (trial.pressure_Pa, trial.yield_pressure_Pa) == pytest.approx((4 * PSI, 0.435 * PSI), rel=1e-12)
    said = {problem.column: problem for problem in read.problems}
    assert {(problem.code, problem.severity) for problem in said.values()} == {("unit", "note")}
    assert said.keys() == {"diameter_in", "pressure_psi", "payload_oz", "yield_pressure_psi"}
    assert "6.89476" in said["pressure_psi"].message
    pressure = pressure_text(trial.pressure_Pa, trial.pressure_unit)
    assert (pressure, trial.condition.split("_")[1]) == ("4 psi (27.6 kPa)", "4psi")
    assert (said["yield_pressure_psi"].file, said["yield_pressure_psi"].line) == ("experiment.yaml", 1)


def test_the_bounds_hold_after_conversion_and_of_two_units_that_with_a_value_counts(tmp_path):
    assert "diameter_mm '25 in' is above 300 mm" in one(tmp_path, diameter_mm=None, diameter_in="25").failed["a"]
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
    text = "limits: {pressure_psi: '1:5', diameter_in: [1, 2], hoop_stress_kPa: '7000,0'}\nambient_pressure_bar: 1,0\n"
    settings = one(tmp_path, text + "axis: {from_px: [1, 2], to_px: [9, 90], width_cm: 2}\n").settings
    assert settings.limits.pressure_kPa == pytest.approx((6.894757, 34.473786))
    assert (settings.limits.diameter_mm, settings.limits.hoop_stress_MPa) == ((25.4, 50.8), 7)
    assert (settings.ambient_pressure_kPa, settings.axis.width_mm) == (100, 20)
