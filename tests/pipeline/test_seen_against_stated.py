"""What recordings and speeds contradict in the sheet stands beside the verdict, for it passes for physics."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hand_diagnosis import diagnosis

from vinetrack.core import published
from vinetrack.core.records import Track, Trial, plain_track
from vinetrack.core.tables import write_json
from vinetrack.diagnosis.result import Diagnosis
from vinetrack.pipeline.diagnosis_stage import sheet_contradictions, with_contradictions
from vinetrack.pipeline.run_stage import run_lines
from vinetrack.planning.predictive_inputs import damping_prior
from vinetrack.results.folder_layout import Results, empty_table

PSI = 6.894757
VINE = Trial(
    name="a", diameter_m=0.012, thickness_m=1e-4, length_m=0.14, pressure_Pa=30e3, yield_pressure_Pa=3e3,
    capture_fps=1000,
)  # fmt: skip


def steady(trial: Trial) -> Track:
    """A track at the steady speed of F = B·ẋⁿ with the B that tubes of this size have."""
    force_N = (trial.pressure_Pa - trial.yield_pressure_Pa) * trial.area_m2
    tail_m_s = (force_N / damping_prior(trial.diameter_m, trial.thickness_m)) ** (1 / published.EXPONENT)
    return plain_track(np.arange(40) / 1000, np.arange(40) / 1000 * tail_m_s / 2)


def written(folder: Path, *contradictions: tuple[str, dict[str, str]]) -> Results:
    for name in "ab":
        noted = [entry for trial, entry in contradictions if trial == name]
        write_json(Results(folder).analysed(name), {"row": {}, "contradictions": noted})
    return Results(folder)


def test_right_trials_contradict_nothing(tmp_path: Path) -> None:
    pairs = [(replace(VINE, name=name), steady(VINE)) for name in "ab"]
    results = written(tmp_path)
    assert sheet_contradictions(results, pairs) == {}
    made = Diagnosis.from_json(diagnosis("missing"))
    assert with_contradictions(made, results, pairs) == made


def test_psi_under_the_name_of_kpa_and_a_wrong_scale_stand_beside_the_verdict(tmp_path: Path) -> None:
    typed = replace(VINE, pressure_Pa=VINE.pressure_Pa / PSI, yield_pressure_Pa=VINE.yield_pressure_Pa / PSI)
    pairs = [(replace(typed, name=name), steady(VINE)) for name in "ab"]
    narrow = {"column": "diameter_mm", "reason": "diameter_mm '12' differs: the tube is 9.6 mm wide, a factor 1.25"}
    results = written(tmp_path, ("a", narrow), ("b", narrow))
    seen = sheet_contradictions(results, pairs)
    assert list(seen) == ["diameter_mm", "pressure_kPa"]
    assert seen["diameter_mm"] == f"a: {narrow['reason']} (and 1 more trial)"
    assert "looks like psi, not kPa" in seen["pressure_kPa"]
    told = with_contradictions(Diagnosis.from_json(diagnosis("missing")), results, pairs)
    assert "contradict the sheet in diameter_mm and pressure_kPa" in told.explanation
    assert set(seen.values()) <= set(told.notes)


@pytest.mark.parametrize("slip", [True, False])
def test_the_last_lines_of_a_run_recall_them(tmp_path: Path, slip: bool) -> None:
    narrow = {"column": "diameter_mm", "reason": "diameter_mm '12' differs: a factor 1.25"}
    results = written(tmp_path, *([("a", narrow)] if slip else []))
    made = Diagnosis.from_json(diagnosis("adequate"))
    told = with_contradictions(made, results, [(replace(VINE, name=name), steady(VINE)) for name in "ab"])
    write_json(results.diagnosis, told.to_json())
    results.trials.write_text(",".join(empty_table(("trial", "status", "reason")).columns) + "\na,ok,\n")
    lines = run_lines(tmp_path)
    assert lines[-1].startswith("adequate:")
    assert ("contradict the sheet in diameter_mm" in lines[-1]) == slip
    assert any("a factor 1.25" in line for line in lines) == slip
