"""Rows of a sheet that belong to other recordings, in campaigns that scipy grows; seeds 20000 and up."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace
from unittest.mock import Mock

import numpy as np
import pytest
from lsoda_vine import grown_position, vine_trial
from vine_truth import make_track

import vinetrack as vt
import vinetrack.diagnosis.replicates as odd_trials_module
from vinetrack.core.problems import remark
from vinetrack.core.records import Track, Trial
from vinetrack.diagnosis.diagnose import diagnose
from vinetrack.diagnosis.replicates import OddTrial, odd_trials, with_odd_trials
from vinetrack.diagnosis.result import Diagnosis
from vinetrack.inference.fit_data import prepare

PRESSURES_KPA = (18, 18, 21, 21, 25, 25, 29, 29, 34, 34, 40, 40)


def grown(name: str, kPa: float, seed: int) -> tuple[Trial, Track]:
    more = {"vine": "12mm", "condition": f"12mm_{kPa}", "length_m": 0.3, "growth_angle_rad": np.pi / 2}
    trial, draw = vine_trial(name, kPa, 12.0, **more), np.random.default_rng(seed)
    time = np.arange(0, 0.3, 0.001)
    position = grown_position(trial, time - 0.02, 1.83 * np.exp(0.02 * draw.normal()), 0.37)
    seen = np.isfinite(position)
    return trial, make_track(time[seen], position[seen] + draw.normal(0, 1e-4, np.count_nonzero(seen)))


@pytest.fixture(scope="module")
def campaign():
    return [grown(f"t{k}", kPa, 20000 + k) for k, kPa in enumerate(PRESSURES_KPA)]


def stated(pairs: list[tuple[Trial, Track]], **kPa: float) -> list[tuple[Trial, Track]]:
    told = {name: {"pressure_Pa": 1e3 * value, "condition": f"12mm_{value}"} for name, value in kPa.items()}
    return [(replace(trial, **told.get(trial.name, {})), track) for trial, track in pairs]


def odd(pairs: list[tuple[Trial, Track]]) -> dict[str, float]:
    return {trial.name: trial.implied_pressure_Pa for trial in odd_trials(prepare(pairs)[0])}


@pytest.mark.parametrize(
    ("trials", "told_kPa", "true_kPa"),
    [
        (12, {}, {}),
        (12, {"t2": 12}, {"t2": 21}),
        (12, {"t0": 40, "t11": 18}, {"t0": 18, "t11": 40}),
        (12, {"t5": 2}, {"t5": 25}),
        (12, {"t2": 12, "t3": 12}, {}),
        (12, {"t2": 22.5}, {}),
        (7, {"t2": 12}, {}),
        (12, {"t0": 12, "t4": 10, "t6": 13, "t9": 15}, {}),
    ],
    ids=["all agree", "swapped digits", "exchanged rows", "could not move", "all replicates", "a tenth", "few", "many"],
)
def test_rows_of_other_recordings_are_named_with_the_pressure_that_was(campaign, trials, told_kPa, true_kPa):
    """What all replicates share is no slip, a tenth is what trials differ by, few trials say nothing."""
    expected = {name: pytest.approx(1e3 * value, rel=0.05) for name, value in true_kPa.items()}
    assert odd(stated(campaign[:trials], **told_kPa)) == expected


@pytest.mark.slow
def test_a_diagnosis_without_a_cause_names_the_row(campaign):
    result = diagnose(stated(campaign, t2=12), candidates=["tail_friction"], ladder=False, advice=False)
    assert result.verdict == "unexplained"
    assert Diagnosis.from_json(result.to_json()).odd_trials == result.odd_trials == ("t2",)


@pytest.fixture(scope="module")
def adequate(campaign):
    return diagnose(campaign, candidates=["tail_friction"], ladder=False, advice=False)


@pytest.mark.slow
def test_an_odd_trial_of_an_adequate_campaign_is_a_note(adequate):
    assert adequate.verdict == "adequate"
    odd_ones = [OddTrial("t2", 12e3, 21e3), OddTrial("t5", 2e3, math.nan)]
    outcome = with_odd_trials(adequate, odd_ones, lambda _: pytest.fail("there is nothing to ask"))
    assert outcome.verdict == "adequate"
    assert outcome.notes[-1] == remark("odd_trials", odd=odd_ones, count=12)


@pytest.mark.slow
@pytest.mark.parametrize("others_say", ["tail_friction", "air_drag", "nothing"])
def test_a_name_stands_where_the_others_bear_it_out_and_is_taken_back_where_they_do_not(adequate, others_say):
    ranking = [replace(row, in_answer_set=True) for row in adequate.rounds[0].ranking if row.effect == "tail_friction"]
    last = replace(adequate.rounds[-1], verdict="missing", answer_set=("tail_friction",), ranking=tuple(ranking))
    named = replace(adequate, rounds=(last,), effects=("tail_friction",), explanation="A friction is missing.")
    others = {"tail_friction": named, "nothing": adequate}
    others["air_drag"] = replace(named, rounds=(replace(last, answer_set=("air_drag",)),))
    outcome = with_odd_trials(named, [OddTrial("t2", 12e3, 21e3)], lambda _: others[others_say])
    said = (outcome.verdict, outcome.answer_set, outcome.effects)
    if others_say == "tail_friction":
        assert said == ("missing", ("tail_friction",), ("tail_friction",))
        assert outcome.notes[-1].code == "odd_trials"
        return
    assert said == ("unexplained", (), ())
    assert not any(candidate.in_answer_set for candidate in outcome.rounds[0].ranking)


def test_where_the_others_cannot_be_fitted_the_row_is_named_all_the_same(adequate):
    unexplained = replace(adequate, rounds=(replace(adequate.rounds[-1], verdict="unexplained"),))
    without = Mock(side_effect=vt.FitError("there is nothing to fit"))
    outcome = with_odd_trials(unexplained, [OddTrial("t2", 12e3, 21e3)], without)
    assert outcome.notes[-1].code == "odd_trials"


def test_where_the_gauge_was_recorded_it_is_the_gauge_that_states_the_pressure(campaign):
    data = []
    for one in prepare(campaign)[0]:
        pressure_Pa = 12e3 if one.trial.name == "t2" else one.trial.pressure_Pa
        data.append(replace(one, trace=(one.time_s, np.full(one.time_s.size, pressure_Pa))))
    (slip,) = odd_trials(data)
    assert (slip.name, slip.stated_Pa) == ("t2", 12e3)
    assert slip.implied_pressure_Pa == pytest.approx(21e3, rel=0.05)


def test_curves_of_many_vines_do_not_make_usual_trials_odd(monkeypatch):
    """Normal scatter of 24 trials of six vines; the curves take a third of the degrees of freedom."""
    given = {"middle_speed": lambda data: data.speed, "_force_N": lambda trial, _: trial.force_N}
    given |= {"_stated_Pa": lambda _: math.nan, "_implied_pressure_Pa": lambda *_: math.nan, "CHANCE": 1e-2}
    for name, value in given.items():
        monkeypatch.setattr(odd_trials_module, name, value)
    draw, campaigns_with_odd = np.random.default_rng(20050), 0
    for _ in range(150):
        log_speed = draw.uniform(0, 1.5, 24)
        force_N = np.exp(0.37 * log_speed + 0.05 * draw.standard_normal(24))
        named = [{"name": str(k), "vine": str(k % 6), "condition": str(k)} for k in range(24)]
        trials = [SimpleNamespace(travel_ratio=2, force_N=force_N[k], **names) for k, names in enumerate(named)]
        data = [SimpleNamespace(speed=math.exp(log_speed[k]), trial=trial) for k, trial in enumerate(trials)]
        campaigns_with_odd += bool(odd_trials(data))
    assert campaigns_with_odd <= 6
