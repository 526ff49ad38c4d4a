"""Prose stands in one room, a sentence for every code; one stored text of each kind shows a change of words."""

import csv
import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hand_diagnosis import diagnosis

import vinetrack
from vinetrack.core.problems import remark
from vinetrack.core.units import display_unit
from vinetrack.diagnosis import result
from vinetrack.diagnosis.result import VERDICTS, Candidate, Diagnosis, EffectPower, Power, Round
from vinetrack.inference.fit_result import Number
from vinetrack.narrative import templates
from vinetrack.narrative.diagnosis_text import REMARKS, drift_text, further_lines
from vinetrack.narrative.verdict_text import bounds_text, estimate_text, verdict_line, verdict_sentence, verdict_table

PACKAGE = Path(vinetrack.__file__).parent
FILES = [path for path in PACKAGE.rglob("*.py") if path.relative_to(PACKAGE).parts[0] != "narrative"]
TOLD = "reason|explanation|note|sentence|words|why|answer|question"  # Names of what holds a sentence
CUT = re.compile(
    rf"""(?:\b(?:{TOLD})\)?|_text\([^()]*\))\.(?:startswith|endswith|r?partition|remove(?:pre|suf)fix|find|index)\(["']"""
    rf"""|["'] (?:not )?in (?:str\()?(?:\w+\.)*(?:{TOLD})\b"""
)


def test_no_module_outside_the_room_of_prose_parses_it():
    assert [(path.name, found) for path in FILES for found in CUT.findall(path.read_text(encoding="utf-8"))] == []


def test_every_code_has_a_sentence_and_every_sentence_a_code():
    makers = ("tracks", "inference", "diagnosis", "planning", "pipeline")
    source = "".join(path.read_text(encoding="utf-8") for path in FILES if path.parent.name in makers)
    assert set(re.findall(r'\b[Rr]emark\(\s*["\'](\w+)["\']', source)) <= templates().keys() | REMARKS.keys()
    assert [code for code in REMARKS if not re.search(rf"""["']{code}["']""", source)] == []
    source += "".join(path.read_text(encoding="utf-8") for path in (PACKAGE / "narrative").glob("*_text.py"))
    assert [code for code in templates() if not re.search(rf"""["']{code}["']""", source)] == []


def test_no_sentence_is_cut_at_a_comma():
    with (PACKAGE / "narrative" / "sentences.csv").open(encoding="utf-8", newline="") as file:
        assert {len(row) for row in csv.reader(file)} == {2}


def test_a_size_that_is_named_though_implausible_is_said_to_be_so_beside_it():
    told, reason = Diagnosis.from_json(diagnosis("missing")), remark("at_bound", title="γ", key="γ", bound=2.4)
    first = replace(told.rounds[0], ranking=(replace(told.ranking[0], plausible=False, reason=reason),))
    notes = [
        next(row.note for row in verdict_table(one) if row.question == "How large")
        for one in (told, replace(told, rounds=(first, *told.rounds[1:])))
    ]
    assert notes[1] == f"{reason}; {notes[0]}"


def effect(name: str, symbol: str, at_half: float, largest: float) -> EffectPower:
    sizes = tuple(float(size) for size in at_half * np.linspace(0.5, 1.5, len(result.PROBABILITIES)))
    return EffectPower(name, "physical", f"{name}.size", symbol, "1", 0.0, 0.0, largest, sizes, {"inlet_loss": 0.26})


POWER = Power(
    n_trials=6, false_alarm_rate=0.0042,
    effects=(effect("fold_inertia", "η", 0.7, 1.0), effect("air_drag", "C_D", 150.0, 3.0)),
    not_testable={"payload_drag": remark("column_blank", column="payload_g")}, model=("gravity", "eversion_damping"),
    numbers=(
        Number("eversion_damping.n", "", "n", "1", 0.37, 0.0037, 0.3625, 0.3775),
        Number("eversion_damping.B", "tube", "B", "", 6.4, 0.11, 6.4 * 0.966, 6.4 * 1.034),
    ),
    inputs=(result.PowerInput("frame rate", "1069 /s", "sheet"),),
)  # fmt: skip


def verdicts() -> str:
    told = [Diagnosis.from_json(diagnosis(verdict)) for verdict in VERDICTS]
    return "\n\n----\n".join("\n".join([verdict_sentence(said), "", str(said)]) for said in told)


def power() -> str:
    wary = replace(POWER, effects=(), wary=remark("excess_counted_as_noise"))
    return f"{POWER}\n\n----\n{wary}"


def plan() -> str:
    none = result.FurtherTrials(POWER["fold_inertia"], 0.5, 0.9, 0.2)
    enough, never = replace(none, before=0.95), replace(none, unlimited=0.4, n_conditions=12)
    trials = [{"replicates": 2, "pressure_kPa": 30.0, "payload_g": 20.0, "diameter_mm": 24.0, "thickness_um": 200.0,
               "length_mm": 280.0, "chamber_l": 3.7, "inlet_mm": 5.7, "growth_angle_deg": math.nan,
               "new_vine": False, "changed": ["inlet_mm"]}]  # fmt: skip
    pair = "air_drag | inlet_loss"
    facts = {"trials": trials, "if_true": {pair: {"air_drag": 10.0, "inlet_loss": 4.3}}, "least_sigma": 3.0}
    facts |= {"unresolved": [], "measurement": remark("")}
    made = [remark(code, **facts) for code in ("trials_to_make", "no_trials_separate")]
    first = remark("measure_first", faults=["length_scale", "time_base"], measurement=remark(""))
    further = [line for one in (none, enough, never) for line in further_lines(one)]
    return "\n".join([*further, *map(str, [*made, first])])


def test_a_refuted_model_is_known_and_an_extended_adequate_one_is_told_by_what_was_added():
    found = Diagnosis.from_json(diagnosis("missing"))
    assert [found.refutes(model) for model in ((), found.final_model, ["leak"])] == [True, False, False]
    after = replace(found, rounds=found.rounds[1:], effects=())
    assert ["γ = 1.1700 ± 0.0040" in verdict_line(each) for each in (after, found)] == [True, False]


def test_what_the_verdict_names_is_not_said_to_be_beyond_detection():
    said = replace(Diagnosis.from_json(diagnosis("missing")), power=POWER)
    (name,) = {one for entry in said.rounds for one in entry.answer_set}
    told = []
    for known in ("tail_stretch", name):
        more = replace(POWER, effects=(*POWER.effects, effect(known, "s", 2.0, 1.0)))
        told.append(str(verdict_table(replace(said, power=more))))
    assert ["tail stretch" in told[0], name.replace("_", " ") in told[1].split("not even then")[1]] == [True, False]


@pytest.mark.parametrize("make", [verdicts, power, plan])
def test_the_text_is_the_stored_one(make):
    stored = Path(__file__).with_name(f"{make.__name__}.txt")
    assert make() + "\n" == stored.read_text(encoding="utf-8"), f"if it is meant to be so, store it in {stored.name}"


def test_a_fitted_pressure_and_what_pulls_it_are_told_in_the_unit_of_the_sheet():
    stored = {"parameter": "yield_pressure.P_y", "vine": "", "symbol": "P_y", "unit": "Pa", "pressure_unit": "psi"}
    pressure = Number.from_json(stored | {"value": 6894.757, "sigma": 68.94757, "low_95": 6756.86, "high_95": 7032.65})
    assert estimate_text(pressure) == "P_y = 1.000 ± 0.010 psi (6.89 kPa)"
    assert estimate_text(replace(pressure, pressure_unit="kPa")) == "P_y = 6.895 ± 0.069 kPa"
    assert bounds_text(pressure, with_unit=True) == "0.9800 to 1.020 psi"
    row = {"symbol": "P_y", "vine": "", "against": "sheet", "from_level": 6894.757, "to_level": 13789.514}
    row |= {"change": 1.0, "change_sigma": 0.1, "z": 9.0}
    assert "1.00 ± 0.10 psi" in drift_text(row, 689.4757, "psi")
    assert "to 13.8 kPa" in drift_text(row, 689.4757)
    against = row | {"against": "pressure_Pa", "p": 1e-5}
    assert "from 1 psi to 2 psi" in drift_text(against, pressure_unit="psi")
    assert display_unit("1/Pa", "psi") == ("1/psi", pytest.approx(6894.757293))


def test_sizes_are_those_fitted_together_with_the_fault_that_remains():
    of = ("reservoir_depletion.gamma", "", "γ", "1")
    alone, together = (Number(*of, size, 0.01, size - 0.02, size + 0.02) for size in (1.8, 1.4))
    together = replace(together, low=-0.1, shared={"payloads": 0.009})
    fault = Candidate("film_mass", kind="measurement", in_answer_set=True, along=(together,))
    first = Round(verdict="missing", answer_set=("reservoir_depletion",))
    last = Round(verdict="artefact", answer_set=("film_mass",), ranking=(fault,))
    found = Diagnosis(rounds=(first, last), effects=("reservoir_depletion",), stored_parameters=(alone,))
    row = {row.question: row for row in verdict_table(found)}["How large"]
    assert ("γ = 1.400" in row.answer, "may be all of the size" in row.note) == (True, True)


def test_a_tail_that_goes_slack_is_a_setting_and_no_effect_to_add():
    slack = Diagnosis(rounds=(Round(verdict="missing", model=("gravity",)),), effects=("tail_slack", "air_drag"))
    assert slack.final_model == ("gravity", "air_drag")
    todo = verdict_table(slack)[-1].answer
    assert ("`tail_slack: free`" in todo, "vinetrack add" in todo) == (True, False)


def test_what_a_blank_column_kept_from_being_tried_comes_first():
    unexplained = Diagnosis(rounds=(Round(verdict="unexplained"),), not_tried=("inlet_loss",))
    assert "inlet loss" in verdict_table(unexplained)[-1].answer.replace("_", " ")
