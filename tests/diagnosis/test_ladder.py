"""Where a model fails: the ladder of errors, conditions beyond the scatter of replicates, and numbers that drift."""

import math
from dataclasses import replace

import numpy as np
import pytest
from grown import Pairs, grown, pairs_of, sheet

import vinetrack as vt
from vinetrack.diagnosis import diagnose, replicates, result, selection
from vinetrack.diagnosis import ladder as ladder_module
from vinetrack.diagnosis.drift import drift
from vinetrack.diagnosis.ladder import Errors, compare, excess, highest_pressure, in_sample, ladder, left_out
from vinetrack.diagnosis.locate import locate
from vinetrack.experiment.schema import with_names
from vinetrack.inference.fit import predict_prepared, prepared_pairs
from vinetrack.laboratory.tracks import campaign, damping_values, isometric_vine

DEPLETION = "reservoir_depletion"


@pytest.fixture(scope="module")
def pairs():
    """Vines at four pressures each on a chamber of 3.7 L that nothing refills."""
    vines = [campaign(isometric_vine(scale), (24, 30, 38, 48), 3, prefix=f"R{scale}_") for scale in (2, 4)]
    trials = with_names([replace(trial, chamber_m3=3.7e-3) for vine in vines for trial in vine])
    return pairs_of(grown(list(trials), 31, [DEPLETION]))


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
    told = diagnose._with_ladder(result.Diagnosis(rounds=(), effects=(), explanation="", fits=(found,)), lambda _: None)
    assert told.notes == tuple(table.attrs["notes"])


@pytest.mark.slow
def test_a_trial_that_cannot_be_followed_costs_its_own_prediction_and_no_other(fits, monkeypatch):
    stuck = fits[0].trials[4].name

    def predicted(fit, data, **told: bool):
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


B = "eversion_damping.B"


def fitted(pairs: Pairs):
    return vt.fit(vt.base_model(), pairs, profile=False)


def test_b_that_makes_up_for_a_wall_that_stretches_knows_the_pressure():
    """The higher the pressure, the wider and faster a vine is whose wall gives way."""
    table = drift(fitted(pairs_of(grown(sheet(), 51, ["wall_stretch"])))).table
    row = table[(table["against"] == "pressure_Pa") & table["vine"].str.startswith("24mm")].iloc[0]
    assert row["significant"]
    assert (row["from_level"], row["to_level"]) == (48e3, 24e3)
    assert row["change"] > 5 * row["change_sigma"] > 0


@pytest.mark.slow
def test_b_that_makes_up_for_an_emptying_chamber_grows_along_the_way_and_it_fails_by_condition(fits):
    """n and the yield pressures are free, and take what they can upon themselves."""
    found = drift(fits[0])
    rows = found.table[found.table["against"] == "growth"]
    assert rows["significant"].all()
    assert (rows["to_level"] > rows["from_level"]).all()
    best = np.maximum(found.table["z"], found.table["z_constancy"]).to_numpy()
    assert best[0] == best.max()
    failing = locate(fits[0])
    assert failing.fails
    worst = failing.by_condition.iloc[0]
    assert worst["rms_m"] == failing.by_condition["rms_m"].max()
    assert failing.by_condition["z"].max() > 3.5
    together = failing.along_position[failing.along_position["condition"] == ""]
    assert set(together["vine"]) == set(failing.by_condition["vine"])
    assert together["n_trials"].max() == 12


def test_every_trial_finds_the_b_it_was_grown_with():
    virtual = grown(sheet(replicates=2), 56, pressure_scatter=0.0)
    found = fitted(pairs_of(virtual))
    values = replicates.per_trial_estimates(found, B, replicates.align_trials(found))
    true = np.array([one.model.values[B] for one in virtual])
    # What the common law errs by stays in all trials of a vine; what is left is the noise of a track.
    away = np.log(values.value / true)
    vines = np.array([trial.vine for trial in values.trials])
    for vine in set(vines):
        away[vines == vine] -= away[vines == vine].mean()
    assert np.std(away) < 0.005
    assert np.std(values.deviation) > 0.015


@pytest.mark.slow
def test_vines_of_different_exponents_are_told():
    one, other = ([trial for trial in sheet() if (trial.diameter_m > 0.02) == wide] for wide in (False, True))
    fit = fitted(pairs_of([*grown(one, 58, values={"eversion_damping.n": 0.3}), *grown(other, 58)]))
    assert {told.code for told in selection.contradictions((fit,), (), None)} == {"still_drifts"}
    found = drift(fit)
    row = found.table[found.table["parameter"] == "eversion_damping.n"].iloc[0]
    assert row["significant"]
    values = found.groups[found.groups["parameter"] == "eversion_damping.n"]["value"]
    assert np.ptp(values) == pytest.approx(0.07, abs=0.03)


@pytest.mark.slow
def test_where_nothing_is_missing_nothing_drifts_or_fails_and_errors_are_as_large_as_replicates_make_them():
    """In the third campaign the noise remembers itself, in the fourth trials scatter little.

    With the smaller error of a thousand independent frames mean residuals would stray by 20 of them.
    """
    nuisances = [{}, {}, {"noise_correlation": 0.6}, {"damping_scatter": 0.005, "pressure_scatter": 0.002}]
    fits = [fitted(pairs_of(grown(sheet(), 72 + k, **more))) for k, more in enumerate(nuisances)]
    for found in map(drift, fits):
        assert found.remarks == ()
        assert found.table["z"].max() < 3
    complete = [locate(fit) for fit in fits]
    assert not any(found.fails for found in complete)
    for name in ("along_time", "along_position", "along_speed"):
        z = np.concatenate([getattr(found, name)["z"] for found in complete])
        assert 0.4 < np.sqrt(np.mean(z**2)) < 1.3
        assert np.mean(np.abs(z) > 3) < 0.02


@pytest.mark.slow
def test_a_misfit_of_one_condition_is_found_there_with_its_size_and_sign():
    """Eight millimetres ahead in the middle of the growth of one condition, by hand."""
    pairs = pairs_of(grown(sheet((4,)), 77, damping_scatter=0.005, pressure_scatter=0.002))
    chosen, bent = pairs[4][0].condition, []
    for trial, track in pairs:
        y = track.lead_position_m - track.lead_position_m[:5].mean()
        bump = 8e-3 * np.exp(-0.5 * ((y - 0.14) / 0.03) ** 2) * (trial.condition == chosen)
        bent.append((trial, replace(track, lead_position_m=track.lead_position_m + bump)))
    found = locate(fitted(bent))
    worst = found.by_condition.iloc[0]
    assert worst["condition"] == chosen
    assert worst["worst_residual_m"] == pytest.approx(7e-3, abs=3e-3)
    there = found.along_position[found.along_position["condition"] == chosen]
    best = there.loc[there["mean_residual_m"].idxmax()]
    assert 0.1 < best["lead_position_m"] < 0.18


def test_single_trials_are_judged_by_the_scatter_of_the_fit():
    found = locate(fitted(pairs_of(grown(sheet(replicates=1), 78))))
    assert found.scatter.dof == 0
    assert not found.fails
    assert found.by_condition["floor_m"].isna().all()
