"""Trials that are only planned: judged as a sheet is, said of the option or of the cell."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
from hand_sheet import GOOD, two_vines, write

from vinetrack.core.problems import ExperimentError
from vinetrack.experiment.sheet import planned_sheet, planned_trial

VINE = {"diameter_mm": "24", "thickness_um": "200", "length_mm": "280", "pressure_kPa": "28"}


def test_a_trial_of_texts_is_in_si() -> None:
    trial = planned_trial({**VINE, "payload_g": "35.6", "chamber_l": "3.7", "growth_angle_deg": "90"}).trials[0]
    assert (trial.diameter_m, trial.thickness_m, trial.length_m) == pytest.approx((0.024, 2e-4, 0.28))
    assert (trial.pressure_Pa, trial.payload_kg, trial.chamber_m3) == pytest.approx((28e3, 0.0356, 3.7e-3))
    assert trial.growth_angle_rad == pytest.approx(math.pi / 2)
    assert (trial.vine, trial.condition) == ("24mm-200um-280mm", "24mm-200um-280mm_28kPa_35.6g")


def test_a_yield_pressure_that_is_not_given_is_not_known() -> None:
    assert math.isnan(planned_trial(VINE).trials[0].yield_pressure_Pa)
    given = planned_trial({**VINE, "yield_pressure_kPa": "3"}).trials[0]
    assert (given.yield_pressure_Pa, given.yield_pressure_sigma_Pa) == (3e3, 200.0)


def test_replicates_are_one_condition_and_rows_not_in_use_none(tmp_path: Path) -> None:
    header, *rows = GOOD.splitlines()
    more = [rows[0].replace("a,a.csv", "c,c.csv"), rows[1].replace("b,b.csv", "d,d.csv")]
    sheet = "\n".join([header + ",use", *(row + "," for row in (*rows, more[0])), more[1] + ",no"]) + "\n"
    trials = planned_sheet(write(two_vines(tmp_path), sheet)).trials
    assert [trial.name for trial in trials] == ["a", "b"]


def test_settings_are_those_of_the_experiment_and_faults_are_named_as_there(tmp_path: Path) -> None:
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


def test_a_sheet_needs_no_recordings_and_an_unknown_column_is_not_passed_over(tmp_path: Path) -> None:
    """A payload under a wrong name would else be taken for none."""
    text = "trial,diameter_mm,thickness_um,length_mm,pressure_kPa,payload_gr\na,24,200,280,28,35.6\n"
    (tmp_path / "ideas.csv").write_text(text, encoding="utf-8")
    planned = planned_sheet(tmp_path / "ideas.csv")
    assert ([trial.name for trial in planned.trials], planned.folder) == (["a"], tmp_path)
    (problem,) = planned.problems
    assert "payload_gr" in str(problem)
