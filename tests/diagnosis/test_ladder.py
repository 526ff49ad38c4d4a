"""Where a model fails: errors, conditions, numbers that drift; and what differs between trials, named as such."""

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
from grown import Pairs, grown, pairs_of, sheet

import vinetrack as vt
from vinetrack.core.records import Trial
from vinetrack.diagnosis import diagnose, hypotheses, result
from vinetrack.diagnosis import ladder as ladder_module
from vinetrack.diagnosis.hypotheses import Difference, between_fits, confounded, differences, robust_ratio, significant
from vinetrack.diagnosis.ladder import align_trials, compare, excess, highest_pressures, ladder, left_out_error, rms_of
from vinetrack.diagnosis.result import ADEQUATE, AMBIGUOUS, ARTEFACT, MISSING, Diagnosis
from vinetrack.diagnosis.selection import verdict_of
from vinetrack.experiment.schema import with_names
from vinetrack.inference.fit import fit, predict_prepared, refit
from vinetrack.inference.fit_data import prepare
from vinetrack.inference.fit_result import EXPONENT, Number
from vinetrack.laboratory.campaigns import campaign, damping_values, isometric_vine
from vinetrack.pipeline import analysis

DEPLETION = "reservoir_depletion"
B = "eversion_damping.B"
Numbers = dict[str, Number]
PHYSICS = ("reservoir_depletion", "tail_friction", "air_drag", "length_scale")
"""Where one effect beside the differences is the point; what the catalogue does to a verdict, others ask."""


@pytest.fixture(scope="module")
def pairs():
    """Vines at four pressures each on a chamber of 3.7 L that nothing refills."""
    vines = [campaign(isometric_vine(scale), (24, 30, 38, 48), 3, prefix=f"R{scale}_") for scale in (2, 4)]
    trials = with_names([replace(trial, chamber_m3=3.7e-3) for vine in vines for trial in vine])
    return pairs_of(grown(list(trials), 31, [DEPLETION]))


@pytest.fixture(scope="module")
def fits(pairs):
    before = vt.fit(vt.base_model(), pairs)
    return before, vt.refit(before, before.model + vt.effects.reservoir_depletion)


@pytest.mark.slow
def test_the_error_left_out_is_that_of_a_fit_that_never_saw_the_condition(pairs):
    """By hand: the model fitted anew to all other conditions, and laid on the one that was left out."""
    one_vine = [pair for pair in pairs if pair[0].name.startswith("R2")]
    model, predicted = vt.base_model() + "reservoir_depletion", []
    found = vt.fit(model, one_vine)
    for condition in dict.fromkeys(trial.condition for trial, _ in one_vine):
        others = vt.fit(model, [pair for pair in one_vine if pair[0].condition != condition])
        unseen, _ = prepare([pair for pair in one_vine if pair[0].condition == condition], weighted=False)
        predicted += predict_prepared(others, unseen, from_rest=True)
    assert left_out_error(found) == pytest.approx(rms_of(predicted), rel=0.003)
    assert rms_of(predicted) > 1.01 * rms_of(align_trials(found).trials)


def test_in_sample_error_and_floor_are_those_of_the_comparison(fits, pairs):
    table = compare(fits[0], pairs).table
    floor_m = align_trials(fits[0]).floor_m
    assert rms_of(align_trials(fits[0]).trials) == pytest.approx(np.sqrt(np.mean(table["rms_position_m"] ** 2)))
    assert floor_m == pytest.approx(np.sqrt(np.mean(table["replicate_floor_m"] ** 2)))
    # Laid on another model, replicates differ as much.
    assert align_trials(fits[1]).floor_m == pytest.approx(floor_m, rel=0.03)
    assert (excess(5.0, 3.0), excess(1.0, 3.0)) == (4.0, 0.0)
    assert math.isnan(excess(1.0, math.nan))


def test_replicates_that_differ_by_their_noise_alone_have_a_floor_of_that_size_however_fast_they_are():
    """The fastest grow by 9 mm from frame to frame, and no two frames are taken at the same time since release."""
    virtual = grown(sheet((2,), replicates=4), 72, damping_scatter=0.0, pressure_scatter=0.0)
    found = fitted(pairs_of(virtual))
    noise_m = np.median([trial.noise_m for trial in found.trials])
    assert compare(found, pairs_of(virtual)).table["replicate_floor_m"].between(0.7 * noise_m, 1.3 * noise_m).all()


def test_an_adequate_model_is_off_by_as_much_as_the_scatter_of_trials_makes_expect():
    """Pressures and B scatter by far more than the noise, as they were drawn. On conditions left out, B and n are known
    from three of four conditions, and the error is 5 to 15 % larger.
    """
    ratios, beyond, inside = [], [], []
    for seed in range(5):
        virtual = grown(sheet((2,), replicates=3), 7200 + seed, damping_scatter=0.04, pressure_scatter=0.01)
        found = fitted(pairs_of(virtual))
        table, errors = compare(found, pairs_of(virtual)).table, ladder([found], [""]).iloc[0]
        ratios += [float(np.mean(table["rms_position_m"] ** 2) / np.mean(table["expected_m"] ** 2))]
        beyond += [errors["rms_left_out_m"] / errors["expected_m"]]
        assert errors["rms_left_out_m"] > 1.02 * errors["rms_in_sample_m"]
        inside += table["rms_position_m"].between(table["expected_low_m"], table["expected_high_m"]).tolist()
    assert 0.6 < np.mean(ratios) < 1.3
    assert np.mean(beyond) == pytest.approx(np.mean(np.sqrt(ratios)), abs=0.05)
    assert np.mean(inside) > 0.85
    # Trials without replicates do not say what to expect.
    alone = pairs_of(virtual)[::3]
    assert compare(fitted(alone), alone).table["expected_m"].isna().all()


def test_an_error_of_the_lens_which_trials_share_has_the_freedom_of_its_four_polynomials(pairs):
    course = ladder_module.ResidualCourse(pairs[0][0], np.zeros(99), np.zeros((99, 2)), np.zeros(99), 1e-14, 1e-8)
    mean_m2, degrees, _ = ladder_module.mean_square([course] * 6, ladder_module.Scatter(1.0, 5))
    assert (mean_m2, degrees) == pytest.approx((1e-8, 4.0), rel=1e-4)


@pytest.mark.slow
def test_every_trial_is_left_out_and_the_highest_pressure_is_that_of_its_vine(pairs):
    lower = [pair for pair in pairs if "R4_48" not in pair[0].name and pair[0].name.endswith("_1")]
    found = vt.fit(vt.base_model(), lower)
    aligned = align_trials(found)
    assert np.isfinite(aligned.left_out[0]).all()
    highest = [aligned.trials[i].trial.name for i in highest_pressures(aligned)]
    assert sorted(highest) == ["R2_48kPa_1", "R4_38kPa_1"]
    # Without replicates there is no floor.
    assert math.isnan(aligned.floor_m)
    assert math.isnan(ladder([found], [""])["excess_left_out_m"].iloc[0])


@pytest.mark.slow
def test_a_vine_of_one_condition_cannot_be_predicted_and_that_is_said(pairs):
    single = [pair for pair in pairs if pair[0].name.startswith("R2") or "_38kPa" in pair[0].name]
    found = vt.fit(vt.base_model() + vt.effects.reservoir_depletion, single)
    table = ladder([found], [""])
    assert np.count_nonzero(np.isnan(align_trials(found).left_out[0])) == 3
    assert math.isfinite(table["rms_left_out_m"].iloc[0])
    note = table.attrs["notes"][0]
    assert (note.code, note.facts["left_out"], note.facts["count"]) == ("left_out_error_without", "conditions", 3)
    # The reader sees an error in sample of all trials beside one without them: a diagnosis says so.
    told = diagnose._with_ladder(
        result.Diagnosis(rounds=(result.Round(verdict="adequate"),), effects=(), explanation="", fits=(found,))
    )
    assert told.notes == tuple(table.attrs["notes"])


def test_a_model_that_cannot_be_followed_costs_its_own_predictions_alone(fits, monkeypatch):
    def followed(fit):
        if fit is fits[1]:
            raise vt.FitError("it ends at 1.4 s")
        return align_trials(fit)

    monkeypatch.setattr(analysis, "align_trials", followed)
    tables = [table for _, table in analysis.predictions(*fits)]
    assert len(tables) == len(fits[0].trials)
    assert all(table["model_before_m"].notna().all() and table["model_after_m"].isna().all() for table in tables)
    assert analysis.predictions(fits[1], fits[1]) == []


def fitted(pairs: Pairs):
    return vt.fit(vt.base_model(), pairs)


def test_b_that_makes_up_for_a_wall_that_stretches_knows_the_pressure():
    """The higher the pressure, the wider and faster a vine is whose wall gives way."""
    table = ladder_module.drift(fitted(pairs_of(grown(sheet(), 51, ["wall_stretch"])))).table
    row = table[(table["against"] == "pressure_Pa") & table["vine"].str.startswith("24mm")].iloc[0]
    assert row["significant"]
    assert (row["from_level"], row["to_level"]) == (48e3, 24e3)
    assert row["change"] > 5 * row["change_sigma"] > 0


def test_every_trial_finds_the_b_it_was_grown_with():
    virtual = grown(sheet(replicates=2), 56, pressure_scatter=0.0)
    found = fitted(pairs_of(virtual))
    aligned = align_trials(found)
    values = ladder_module.per_trial_estimates(found, aligned)
    base = aligned.predictor.layout.base[:, found.model.parameter_names.index(B)]
    true = np.array([one.model.values[B] for one in virtual])
    # What the common law errs by stays in all trials of a vine; what is left is the noise of a track.
    away = np.array(np.log(base / true) + values["deviation"])
    vines = np.array([trial.vine for trial in values["trial"]])
    for vine in set(vines):
        away[vines == vine] -= away[vines == vine].mean()
    assert np.std(away) < 0.005
    assert np.std(values["deviation"]) > 0.015


@pytest.mark.slow
def test_where_nothing_is_missing_nothing_drifts_or_fails_and_errors_are_as_large_as_replicates_make_them():
    """In the third campaign the noise remembers itself, in the fourth trials scatter little."""
    nuisances = [{}, {}, {"noise_correlation": 0.6}, {"damping_scatter": 0.005, "pressure_scatter": 0.002}]
    fits = [fitted(pairs_of(grown(sheet(), 72 + k, **more))) for k, more in enumerate(nuisances)]
    for found in map(ladder_module.drift, fits):
        assert found.remarks == ()
        assert found.table["z"].max() < 3
    z = np.concatenate([ladder_module.locate(fit).along_position["z"] for fit in fits])
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
    found = ladder_module.locate(fitted(bent))
    worst = found.worst.facts
    assert worst["condition"] == {"unit": "kPa", "pressure_Pa": pairs[4][0].pressure_Pa}
    assert worst["off_m"][0] == pytest.approx(7e-3, abs=3e-3)
    there = found.along_position[found.along_position["condition"] == chosen]
    best = there.loc[there["mean_residual_m"].idxmax()]
    assert 0.1 < best["lead_position_m"] < 0.18


def test_single_trials_are_judged_by_the_scatter_of_the_fit():
    found = ladder_module.locate(fitted(pairs_of(grown(sheet(replicates=1), 78))))
    assert math.isnan(found.worst.facts["floor_m"])
    assert found.along_position["z"].abs().max() < 4


def made(trials: Sequence[Trial], factors: Sequence[float], seed: int) -> Pairs:
    """Trials made in the order of the sheet, B of each multiplied by its factor."""
    pairs: Pairs = []
    sizes = damping_values(trials)[B]
    for place, (trial, factor) in enumerate(zip(trials, factors, strict=True)):
        held = {B: {vine: factor * size for vine, size in sizes.items()}}
        (one,) = pairs_of(grown([trial], 1000 * seed + place, (), held, damping_scatter=5e-3, pressure_scatter=3e-3))
        pairs.append((replace(one[0], order=float(place + 1)), one[1]))
    return pairs


def uses(trials: Sequence[Trial]) -> list[int]:
    return [sum(other.vine == trial.vine for other in trials[:i]) for i, trial in enumerate(trials)]


def diagnosed(pairs: Pairs, candidates: Sequence[str] = PHYSICS) -> tuple[Diagnosis, dict[str, Numbers]]:
    said = vt.diagnose(pairs, candidates=candidates, ladder=False, advice=False)
    return said, {row.effect: {n.vine: n for n in row.numbers} for row in said.rounds[0].ranking}


@pytest.fixture(scope="module")
def trials():
    return sheet((2, 4), replicates=3)


def misread(trials: Sequence[Trial], gains: Sequence[float], seed: int) -> tuple[Diagnosis, dict[str, Numbers]]:
    """What is said where the tube gets these parts of the pressures that the sheet states."""
    true = [replace(trial, pressure_Pa=trial.pressure_Pa * gain) for trial, gain in zip(trials, gains, strict=True)]
    pairs = made(true, [1.0] * len(trials), seed)
    stated = [(replace(t, pressure_Pa=s.pressure_Pa), track) for s, (t, track) in zip(trials, pairs, strict=True)]
    return diagnosed(stated, (*PHYSICS, "pressure_gain", "film_mass"))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("gain", "seed", "key", "size", "most"),
    [(lambda i: 1 - 0.0015 * i, 7, "P", -0.0015, 0.001), (lambda i: 0.96 if i >= 10 else 1, 8, "step", -0.0408, 0.02)],
    ids=["a supply that empties", "a regulator set anew"],
)
def test_what_changes_in_the_course_of_a_campaign_is_named_with_its_size(trials, gain, seed, key, size, most):
    """While pressures rise; a step with the trial from which on it holds."""
    result, sizes = misread(trials, [gain(i) for i in range(len(trials))], seed)
    assert result.verdict in (ARTEFACT, AMBIGUOUS)
    assert "order_drift" in result.answer_set
    ((begins, number),) = sizes["order_drift"].items()
    assert number.key == f"order_drift.{key}"
    assert abs(number.value - size) < 3 * number.sigma < most
    assert key == "P" or begins == f"from {trials[10].name} on"


@pytest.mark.slow
def test_a_regulator_set_anew_every_day_is_named_by_its_gains(trials):
    known = [replace(trial, day=str(1 + 3 * i // len(trials))) for i, trial in enumerate(trials)]
    result, sizes = misread(known, [{"1": 1.0, "2": 1.05, "3": 0.96}[trial.day] for trial in known], seed=10)
    assert result.verdict in (ARTEFACT, AMBIGUOUS)
    assert "day" in result.answer_set
    size = {vine: number.value for vine, number in sizes["day"].items() if number.key == "day.gain"}
    assert size["day 2"] - size["day 3"] == pytest.approx(np.log(1.05 / 0.96), abs=0.025)


@pytest.mark.parametrize("sd", ["B_sd", "pressure_sd_Pa", "gain_sd"])
def test_a_difference_between_days_is_tried_in_the_form_that_has_a_standard_deviation(trials, monkeypatch, sd):
    forms = partial(hypotheses.of_column, **{sd: 0.03})
    monkeypatch.setitem(hypotheses.BETWEEN, "day", forms)
    known = [replace(trial, day=str(k % 2)) for k, trial in enumerate(trials)]
    found = differences(fit(vt.base_model(), made(known, [1.0] * len(known), seed=9)))
    assert [len(each.terms) for each in found if each.name == "day"] == [1]


@pytest.mark.slow
def test_the_best_of_many_places_is_no_more_than_chance(trials):
    """Where nothing differs, a change may begin anywhere: what is worth as much as one chance in a thousand is rare."""
    pairs = made(trials, [1.0] * len(trials), seed=9)
    among = {difference.name: difference for difference in differences(fit(vt.base_model(), pairs))}
    drift = among["order_drift"]
    assert drift.n_forms >= 3
    assert drift.p > 0.003


@pytest.mark.slow
def test_wear_that_only_the_order_of_the_rows_shows_is_told_beside_an_adequate_model(trials):
    """It decides nothing where the sheet states no order; but B and n hold it, and a reader must know."""
    pairs = made(trials, [1 + 0.01 * seen for seen in uses(trials)], seed=11)
    unstated = [(replace(trial, order=np.nan), track) for trial, track in pairs]
    apart = significant(differences(fit(vt.base_model(), unstated)), 0.003)
    assert "order_drift" in {difference.name for difference in apart}
    assert not any(difference.stated for difference in apart)
    result, _ = diagnosed(unstated, ("air_drag",))
    assert result.verdict == ADEQUATE
    assert "order" in result.explanation  # what is unstated is told beside the verdict


@pytest.mark.slow
def test_another_tube_for_high_pressures_is_named(trials):
    other = [trial.pressure_Pa >= (38e3 if trial.diameter_m > 0.02 else 50e3) for trial in trials]
    pairs = made(trials, [1.1 if each else 1.0 for each in other], seed=3)
    known = [(replace(t, specimen="ab"[each]), track) for (t, track), each in zip(pairs, other, strict=True)]
    result, _ = diagnosed(known)
    assert result.verdict in (ARTEFACT, AMBIGUOUS)
    assert "specimen" in result.answer_set


@pytest.mark.slow
def test_exponents_that_differ_by_vine_are_named(trials):
    pairs: Pairs = []
    for vine, exponent in zip(dict.fromkeys(trial.vine for trial in trials), (0.40, 0.46), strict=True):
        of_vine, values = [trial for trial in trials if trial.vine == vine], {"eversion_damping.n": exponent}
        pairs += pairs_of(grown(of_vine, 4, (), values, damping_scatter=0.01))
    result, sizes = diagnosed(pairs)
    assert (result.verdict, result.answer_set) == (ARTEFACT, ("n_by_vine",))
    for number, exponent in zip(sizes["n_by_vine"].values(), (0.40, 0.46), strict=True):
        assert abs(number.value - exponent) < 4 * number.sigma


@pytest.fixture(scope="module")
def questioned(trials):
    """B rises by 2 % with every use of a tube, pressures in rising order."""
    return fit(vt.base_model(), made(trials, [1 + 0.02 * seen for seen in uses(trials)], seed=1))


def test_the_linear_estimate_is_what_the_refit_gains(questioned):
    drift = next(one for one in differences(questioned) if one.name == "order_drift")
    after = refit(questioned, between=drift.terms)
    assert 2 * (after.log_likelihood - questioned.log_likelihood) == pytest.approx(drift.gain, rel=0.1)
    slope = after["order_drift.B"]
    assert abs(slope.value - 0.02 / 1.1) < 0.003  # 2 % of the first B is 1.8 % of the mean
    assert drift.p < 1e-6


def test_exponents_that_scatter_more_than_the_noise_tells_are_worth_less(questioned, monkeypatch):
    by_vine = Difference("n_by_vine", shared={EXPONENT: "vine"}, gain=5.0)
    (plain,) = between_fits(questioned, [by_vine], 0.0, str)
    robust = robust_ratio(plain.fit, (EXPONENT,))
    assert robust_ratio(plain.fit, ("n_by_vine",)) == 1.0  # no number is called that
    assert abs(plain.sigma) == pytest.approx(np.sqrt(abs(plain.delta_chi2)) / robust)
    monkeypatch.setattr("vinetrack.diagnosis.hypotheses.robust_ratio", lambda _, names: 3.0 * (EXPONENT in names))
    (wider,) = between_fits(questioned, [by_vine], 0.0, str)
    assert abs(wider.sigma) == pytest.approx(np.sqrt(abs(wider.delta_chi2)) / 3)
    assert wider.inflation == pytest.approx(9.0)  # the same for significance, evidence and answer set


def test_only_differences_that_follow_the_conditions_are_confounded(trials):
    rising = np.arange(len(trials), dtype=float)[:, None]
    assert confounded(rising, trials)
    assert not confounded(rising[np.random.default_rng(0).permutation(len(trials))], trials)
    assert not confounded(rising % 3, trials)  # a tube for each replicate


@pytest.mark.parametrize(
    ("kinds", "verdict"),
    [
        (("between_trials",), ARTEFACT),
        (("between_trials", "measurement"), ARTEFACT),
        (("between_trials", "physical"), AMBIGUOUS),
        (("physical",), MISSING),
    ],
)
def test_a_verdict_says_whether_any_physics_may_be_missing(kinds, verdict):
    rivals: list = [SimpleNamespace(effects=(SimpleNamespace(kind=kind),)) for kind in kinds]
    assert verdict_of(rivals) == verdict
