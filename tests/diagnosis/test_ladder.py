"""The ladder of errors on campaigns grown in the virtual laboratory. Seeds 31 to 34; nothing was tuned on them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from counted import trajectories

import vinetrack as vt
from vinetrack.core.records import Track, Trial
from vinetrack.diagnosis import diagnose
from vinetrack.diagnosis import ladder as ladder_module
from vinetrack.diagnosis.ladder import (
    LADDER_COLUMNS,
    MOVED_COLUMNS,
    Errors,
    compare,
    excess,
    highest_pressure,
    in_sample,
    ladder,
    left_out,
    moved,
)
from vinetrack.diagnosis.result import Diagnosis
from vinetrack.experiment.schema import with_names
from vinetrack.inference.fit import predict_prepared, predict_trials
from vinetrack.inference.fit_data import FitTrial
from vinetrack.inference.fit_result import Fit, TrialFit
from vinetrack.laboratory.tracks import BASE, GroundTruth, campaign, damping_values, grow, isometric_vine

Pairs = list[tuple[Trial, Track]]
DEPLETION = "reservoir_depletion"


def grown(seed: int, *effects: str, scales: Sequence[int] = (2, 4), replicates: int = 3, **more: float) -> Pairs:
    """Vines at four pressures each on a chamber of 3.7 L that nothing refills."""
    trials = [
        replace(trial, chamber_m3=3.7e-3)
        for scale in scales
        for trial in campaign(isometric_vine(scale), (24, 30, 38, 48), replicates, prefix=f"R{scale}_")
    ]
    trials = list(with_names(trials))
    nature = GroundTruth(effects=(*BASE, *effects), values={**damping_values(trials), **more}, seed=seed)
    return [(one.stated, one.track) for one in grow(trials, nature)]


@pytest.fixture(scope="module")
def pairs() -> Pairs:
    return grown(31, DEPLETION)


@pytest.fixture(scope="module")
def fits(pairs: Pairs) -> tuple[Fit, Fit]:
    before = vt.fit(vt.base_model(), pairs, profile=False)
    return before, vt.refit(before, before.model + vt.effects.reservoir_depletion)


def with_the_truth(pairs: Pairs) -> Fit:
    """The model that the vines were grown with, no number of it fitted."""
    model = vt.base_model() + vt.effects.reservoir_depletion
    truth = model.with_values(damping_values([trial for trial, _ in pairs]) | {f"{DEPLETION}.gamma": 1.4})
    held = ["eversion_damping.B", "eversion_damping.n", f"{DEPLETION}.gamma", "P_y"]
    return vt.fit(truth, pairs, fixed=held, profile=False)


@pytest.mark.slow
def test_the_error_falls_to_that_of_the_truth_when_what_is_missing_is_added(
    fits: tuple[Fit, Fit], pairs: Pairs
) -> None:
    table = ladder(fits, ["", DEPLETION])
    assert tuple(table.columns) == LADDER_COLUMNS
    assert table["added"].tolist() == ["", DEPLETION]
    before, after = (table.iloc[k] for k in range(2))
    for column in ("rms_in_sample_m", "rms_left_out_m", "rms_highest_pressure_m"):
        assert before[column] > 1.3 * after[column]
    assert after["rms_left_out_m"] < 1.25 * in_sample(with_the_truth(pairs)).rms_m
    assert before["excess_left_out_m"] > 1.5 * after["excess_left_out_m"]
    assert table.attrs["notes"] == []


@pytest.mark.slow
def test_the_error_left_out_is_that_of_a_fit_that_never_saw_the_condition(pairs: Pairs) -> None:
    """By hand: the model fitted anew to all other conditions, and laid on the one that was left out."""
    one_vine = [pair for pair in pairs if pair[0].name.startswith("R2")]
    found = vt.fit(vt.base_model(), one_vine, profile=False)
    predicted = []
    for condition in dict.fromkeys(trial.condition for trial, _ in one_vine):
        seen = [pair for pair in one_vine if pair[0].condition != condition]
        unseen = [pair for pair in one_vine if pair[0].condition == condition]
        predicted += predict_trials(vt.fit(vt.base_model(), seen, profile=False), unseen, from_rest=True)
    by_hand = Errors(tuple(predicted), {}).rms_m
    assert left_out(found).rms_m == pytest.approx(by_hand, rel=0.05)
    assert by_hand > 1.1 * in_sample(found).rms_m


def test_in_sample_error_and_floor_are_those_of_the_comparison(fits: tuple[Fit, Fit], pairs: Pairs) -> None:
    table = compare(fits[0], pairs).table
    errors = in_sample(fits[0])
    assert errors.rms_m == pytest.approx(np.sqrt(np.mean(table["rms_position_m"] ** 2)))
    assert errors.floor[0] == pytest.approx(np.sqrt(np.mean(table["replicate_floor_m"] ** 2)))


@pytest.mark.slow
def test_every_trial_is_left_out_once_and_the_highest_pressure_is_that_of_its_vine(fits: tuple[Fit, Fit]) -> None:
    names = sorted(trial.name for trial in fits[1].trials)
    assert sorted(trial.name for trial in left_out(fits[1]).trials) == names
    assert sorted(trial.name for trial in highest_pressure(fits[1]).trials) == [name for name in names if "48" in name]


@pytest.mark.slow
def test_the_highest_pressure_is_that_of_each_vine(pairs: Pairs) -> None:
    lower = [pair for pair in pairs if "R4_48" not in pair[0].name and pair[0].name.endswith("_1")]
    found = vt.fit(vt.base_model(), lower, profile=False)
    assert sorted(one.trial.name for one in highest_pressure(found).trials) == ["R2_48kPa_1", "R4_38kPa_1"]


@pytest.mark.slow
def test_a_vine_of_one_condition_cannot_be_predicted_and_that_is_said(pairs: Pairs) -> None:
    single = [pair for pair in pairs if pair[0].name.startswith("R2") or "_38kPa" in pair[0].name]
    found = vt.fit(vt.base_model() + vt.effects.reservoir_depletion, single, profile=False)
    table = ladder([found], [""])
    assert len(left_out(found).not_predicted) == 3
    assert math.isfinite(table["rms_left_out_m"].iloc[0])
    assert next((note.code, note.facts["left_out"], note.facts["count"]) for note in table.attrs["notes"]) == (
        "left_out_error_without",
        "conditions",
        3,
    )
    # The reader sees an error in sample of all trials beside one without them: a diagnosis says so.
    told = diagnose._with_ladder(Diagnosis(rounds=(), effects=(), explanation="", fits=(found,)), lambda _: None)
    assert told.notes == tuple(table.attrs["notes"])


@pytest.mark.slow
def test_a_trial_that_cannot_be_followed_costs_its_own_prediction_and_no_other(
    fits: tuple[Fit, Fit], monkeypatch: pytest.MonkeyPatch
) -> None:
    """As on real tubes that stick, where the numbers of the other trials leave one at a corner of its motion."""
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


def test_of_a_single_condition_nothing_can_be_left_out(pairs: Pairs) -> None:
    found = vt.fit(vt.base_model(), pairs[:3], fixed=["n"], profile=False)
    table = ladder([found], [""])
    assert math.isfinite(table["rms_in_sample_m"].iloc[0])
    assert math.isnan(table["rms_left_out_m"].iloc[0])
    assert math.isnan(table["excess_left_out_m"].iloc[0])
    assert table.attrs["notes"]


@pytest.mark.slow
def test_without_replicates_there_is_no_floor(pairs: Pairs) -> None:
    found = vt.fit(vt.base_model(), pairs[::3], profile=False)
    assert math.isnan(in_sample(found).floor[0])
    assert math.isnan(ladder([found], [""])["excess_left_out_m"].iloc[0])


def test_the_excess_is_what_the_floor_leaves_of_the_error() -> None:
    assert excess(5.0, 3.0) == 4.0
    assert excess(1.0, 3.0) == 0.0
    assert math.isnan(excess(1.0, math.nan))


def test_b_and_n_come_home_along_the_ladder(fits: tuple[Fit, Fit]) -> None:
    table = moved(fits, ["", DEPLETION])
    assert tuple(table.columns) == MOVED_COLUMNS
    n = table[table["parameter"] == "eversion_damping.n"]
    away = np.abs(n["value"].to_numpy() - 0.37)
    assert away[1] < 0.01 < away[0]
    assert len(table) == sum(len(one.numbers) for one in fits)


@pytest.mark.slow
def test_what_is_left_out_of_24_trials_is_fitted_from_near_its_end(
    fits: tuple[Fit, Fit], pairs: Pairs, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nine fits to parts of the trials a model, and as many predictions; each begins where all trials ended."""
    simulated = trajectories(monkeypatch)
    vt.fit(vt.base_model(), pairs, profile=False)
    for_one_fit = sum(simulated)
    simulated.clear()
    ladder(fits, ["", DEPLETION])
    assert 0 < sum(simulated) / 2 < 4 * for_one_fit
