"""The ladder of errors on campaigns grown in the virtual laboratory. Seeds 31 to 34; nothing was tuned on them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from grown import Pairs, grown, pairs_of

import vinetrack as vt
from vinetrack.diagnosis import diagnose
from vinetrack.diagnosis import ladder as ladder_module
from vinetrack.diagnosis.ladder import Errors, compare, excess, highest_pressure, in_sample, ladder, left_out
from vinetrack.diagnosis.result import Diagnosis
from vinetrack.experiment.schema import with_names
from vinetrack.inference.fit import predict_prepared, prepared_pairs
from vinetrack.inference.fit_data import FitTrial
from vinetrack.inference.fit_result import Fit, TrialFit
from vinetrack.laboratory.tracks import campaign, damping_values, isometric_vine

DEPLETION = "reservoir_depletion"


def hidden(seed: int, *effects: str) -> Pairs:
    """Vines at four pressures each on a chamber of 3.7 L that nothing refills."""
    vines = [campaign(isometric_vine(scale), (24, 30, 38, 48), 3, prefix=f"R{scale}_") for scale in (2, 4)]
    trials = with_names([replace(trial, chamber_m3=3.7e-3) for vine in vines for trial in vine])
    return pairs_of(grown(list(trials), seed, effects))


@pytest.fixture(scope="module")
def pairs():
    return hidden(31, DEPLETION)


@pytest.fixture(scope="module")
def fits(pairs):
    before = vt.fit(vt.base_model(), pairs, profile=False)
    return before, vt.refit(before, before.model + vt.effects.reservoir_depletion)


@pytest.mark.slow
def test_the_error_falls_to_that_of_the_truth_when_what_is_missing_is_added(fits, pairs):
    table = ladder(fits, ["", DEPLETION])
    assert table["added"].tolist() == ["", DEPLETION]
    before, after = (table.iloc[k] for k in range(2))
    for column in ("rms_in_sample_m", "rms_left_out_m", "rms_highest_pressure_m"):
        assert before[column] > 1.3 * after[column]
    # The model that the vines were grown with, no number of it fitted.
    truth = fits[1].model.with_values(damping_values([trial for trial, _ in pairs]) | {f"{DEPLETION}.gamma": 1.4})
    held = ["eversion_damping.B", "eversion_damping.n", f"{DEPLETION}.gamma", "P_y"]
    known = in_sample(vt.fit(truth, pairs, fixed=held, profile=False)).rms_m
    assert after["rms_left_out_m"] < 1.25 * known
    assert before["excess_left_out_m"] > 1.5 * after["excess_left_out_m"]
    assert table.attrs["notes"] == []


@pytest.mark.slow
def test_the_error_left_out_is_that_of_a_fit_that_never_saw_the_condition(pairs):
    """By hand: the model fitted anew to all other conditions, and laid on the one that was left out."""
    one_vine = [pair for pair in pairs if pair[0].name.startswith("R2")]
    found = vt.fit(vt.base_model(), one_vine, profile=False)
    predicted = []
    for condition in dict.fromkeys(trial.condition for trial, _ in one_vine):
        others = vt.fit(vt.base_model(), [pair for pair in one_vine if pair[0].condition != condition], profile=False)
        unseen = prepared_pairs([pair for pair in one_vine if pair[0].condition == condition])
        predicted += predict_prepared(others, unseen, from_rest=True)
    by_hand = Errors(tuple(predicted), {}).rms_m
    assert left_out(found).rms_m == pytest.approx(by_hand, rel=0.05)
    assert by_hand > 1.1 * in_sample(found).rms_m


def test_in_sample_error_and_floor_are_those_of_the_comparison(fits, pairs):
    table = compare(fits[0], pairs).table
    errors = in_sample(fits[0])
    assert errors.rms_m == pytest.approx(np.sqrt(np.mean(table["rms_position_m"] ** 2)))
    assert errors.floor[0] == pytest.approx(np.sqrt(np.mean(table["replicate_floor_m"] ** 2)))
    assert (excess(5.0, 3.0), excess(1.0, 3.0)) == (4.0, 0.0)
    assert math.isnan(excess(1.0, math.nan))


@pytest.mark.slow
def test_every_trial_is_left_out_once_and_the_highest_pressure_is_that_of_its_vine(pairs):
    lower = [pair for pair in pairs if "R4_48" not in pair[0].name and pair[0].name.endswith("_1")]
    found = vt.fit(vt.base_model(), lower, profile=False)
    assert sorted(one.trial.name for one in left_out(found).trials) == sorted(trial.name for trial, _ in lower)
    assert sorted(one.trial.name for one in highest_pressure(found).trials) == ["R2_48kPa_1", "R4_38kPa_1"]
    # Without replicates there is no floor.
    assert math.isnan(in_sample(found).floor[0])
    assert math.isnan(ladder([found], [""])["excess_left_out_m"].iloc[0])


@pytest.mark.slow
def test_a_vine_of_one_condition_cannot_be_predicted_and_that_is_said(pairs):
    single = [pair for pair in pairs if pair[0].name.startswith("R2") or "_38kPa" in pair[0].name]
    found = vt.fit(vt.base_model() + vt.effects.reservoir_depletion, single, profile=False)
    table = ladder([found], [""])
    assert len(left_out(found).not_predicted) == 3
    assert math.isfinite(table["rms_left_out_m"].iloc[0])
    note = table.attrs["notes"][0]
    assert (note.code, note.facts["left_out"], note.facts["count"]) == ("left_out_error_without", "conditions", 3)
    # The reader sees an error in sample of all trials beside one without them: a diagnosis says so.
    told = diagnose._with_ladder(Diagnosis(rounds=(), effects=(), explanation="", fits=(found,)), lambda _: None)
    assert told.notes == tuple(table.attrs["notes"])


@pytest.mark.slow
def test_a_trial_that_cannot_be_followed_costs_its_own_prediction_and_no_other(fits, monkeypatch):
    stuck = fits[0].trials[4].name

    def predicted(fit: Fit, data: Sequence[FitTrial], **told: bool) -> list[TrialFit]:
        if any(trial_data.trial.name == stuck for trial_data in data):
            raise vt.FitError("The model cannot be followed: it ends at 1.4 s")
        return predict_prepared(fit, data, **told)

    monkeypatch.setattr(ladder_module, "predict_prepared", predicted)
    for errors in (in_sample(fits[0]), left_out(fits[0])):
        assert errors.not_predicted == {stuck: "The model cannot be followed: it ends at 1.4 s"}
        assert len(errors.trials) == len(fits[0].trials) - 1
        assert math.isfinite(errors.rms_m)


def test_of_a_single_condition_nothing_can_be_left_out(pairs):
    found = vt.fit(vt.base_model(), pairs[:3], fixed=["n"], profile=False)
    table = ladder([found], [""])
    assert math.isfinite(table["rms_in_sample_m"].iloc[0])
    assert math.isnan(table["rms_left_out_m"].iloc[0])
    assert math.isnan(table["excess_left_out_m"].iloc[0])
    assert table.attrs["notes"]
