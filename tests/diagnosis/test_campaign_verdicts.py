"""Verdicts on whole campaigns of another simulator, with nuisances that the fit does not assume."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from grown import Pairs, grown
from grown import pairs_of as grown_pairs
from hidden import make, shots
from hidden.laboratory_folder import write_experiment
from hidden.laboratory_rows import campaign

import vinetrack as vt
from vinetrack.core.problems import Remark
from vinetrack.core.records import Trial
from vinetrack.core.units import with_error
from vinetrack.diagnosis import likelihood_ratio, misfit_tests, result
from vinetrack.diagnosis.likelihood_ratio import LikelihoodRatio, answer_set, film_gain
from vinetrack.diagnosis.score_test import (
    RANGE_SHARE_BESIDE_SLIP,
    effect_sensitivities,
    is_plausible,
    shapes_of,
    slip_of,
)
from vinetrack.effects import catalogue
from vinetrack.experiment.schema import with_names
from vinetrack.inference.fit import values_for_trial
from vinetrack.inference.fit_data import pairs_of
from vinetrack.inference.fit_result import group_names, groups_of, make_layout
from vinetrack.inference.optimiser import variance_floor
from vinetrack.inference.robust_covariance import FILM_ERROR
from vinetrack.laboratory.tracks import Vine
from vinetrack.laboratory.tracks import campaign as laboratory_campaign


def diagnosed(pairs, candidates=None) -> result.Diagnosis:
    return vt.diagnose(pairs, candidates=candidates, ladder=False, advice=False)


def laboratory(folder: Path, row: str, seed: int, size: tuple[int, int], **more: bool):
    known = campaign(row, seed, size, **more)
    write_experiment(known, folder / "e")
    return known.truth["truths"], vt.read_experiment(folder / "e")


def row_of(said: result.Diagnosis, effect: str) -> result.Candidate:
    (row,) = (row for row in said.rounds[0].ranking if row.effect == effect)
    return row


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "seed", "verdicts"),
    [
        ("null:mixed_noise", 908, {"adequate"}),
        ("null:large_B_scatter", 913, {"adequate"}),
        ("tail_friction", 918, {"missing", "ambiguous"}),
        ("reservoir_depletion", 905, {"missing", "ambiguous"}),
        ("outsider:rough_patch", 962, {"unexplained"}),
    ],
)
def test_what_is_missing_is_in_the_answer_with_its_size_and_nothing_where_nothing_is(kind, seed, verdicts):
    """Where something is, each condition once. The rough patch is in no catalogue."""
    hidden = make(kind, seed, trials=int(not kind.startswith("null")))
    said = diagnosed(list(hidden.pairs))
    assert said.verdict in verdicts
    if "missing" not in verdicts:
        assert said.effects == said.answer_set == ()
        return
    assert kind in said.answer_set
    assert len(said.answer_set) <= 2
    numbers = {number.key: number for number in row_of(said, kind).numbers}
    for key, size in hidden.truth.values.items():
        assert abs(numbers[key].value - size) < 4 * numbers[key].sigma


FILM, DRAG = catalogue()["film_mass"], catalogue()["air_drag"]
TRIALS = [Trial(name="t1", vine="a"), Trial(name="t2", vine="b")]


@pytest.mark.slow
def test_film_of_one_vine_that_is_lighter_is_named_with_each_size(tmp_path):
    """Of two vines whose film is off by +1.4 and −8.3 per cent."""
    truths, experiment = laboratory(tmp_path, "film_uneven", 909, (24, 26))
    said = diagnosed(experiment)
    assert (said.verdict, said.answer_set) == ("artefact", ("film_mass",))
    named = row_of(said, "film_mass")
    (n,) = (number for number in named.along if number.key == "eversion_damping.n")
    assert abs(n.value - truths["eversion_damping.n"]) < 2 * n.sigma
    assert f"Fitted together with film_mass, n = {with_error(n.value, n.sigma)} instead of" in said.explanation
    for k, number in enumerate(named.numbers):
        assert abs(number.value - truths[f"film_mass.eps.{k}"]) < 3 * number.sigma < 0.03
    # What one vine answers alone adds up to what all answer.
    fit = said.fits[0]
    vines = list(dict.fromkeys(trial.trial.vine for trial in fit.trials))
    asked = effect_sensitivities(fit, shapes_of(FILM, [trial.trial for trial in fit.trials]))
    assert [shape.group for shape in asked.shapes] == ["", *vines]
    for trial, columns in zip(fit.trials, asked.columns, strict=True):
        alone = {vine: columns[:, 1 + k] for k, vine in enumerate(vines)}
        assert np.any(alone.pop(trial.trial.vine))
        assert not any(np.any(of_other) for of_other in alone.values())
        np.testing.assert_allclose(columns[:, 1:].sum(axis=1), columns[:, 0], rtol=0.02, atol=1e-5)
    # Film gains what a fit with free film gains, less its prior.
    film_free = vt.refit(fit, fit.model + "film_mass")
    sizes = [number.value for number in film_free.numbers if number.key == "film_mass.eps"]
    fall = 2 * (film_free.log_likelihood - fit.log_likelihood)
    gained = film_gain(fit)
    # The prior pulls sizes in, so it costs less than at the sizes of the free fit, and more than nothing.
    assert fall - sum((size / FILM_ERROR) ** 2 for size in sizes) < gained < fall
    assert film_gain(film_free) == 0


def test_vines_and_days_are_asked_alone_where_there_are_several_and_each_trial_has_one():
    assert [shape.group for shape in shapes_of(FILM)] == [""]
    assert [(s.group, s.other_groups) for s in shapes_of(FILM, TRIALS)] == [("", ()), ("a", ("b",)), ("b", ("a",))]
    assert not any(shape.group for shape in shapes_of(DRAG, TRIALS))
    known = [replace(trial, day=str(1 + k % 2)) for k, trial in enumerate(TRIALS)]
    for of, days in ((known, ["day 1", "day 2"]), ([known[0], replace(known[1], day="")], []), (known[:1], [])):
        assert [shape.group for shape in shapes_of(catalogue()["time_base"], of)] == ["", *days]
        assert groups_of(of, "day") == (days or [""] * len(of))
    assert group_names([replace(known[0], day=day) for day in ("10", "2", "2")], "day") == ["day 2", "day 10"]


@pytest.mark.parametrize(
    ("given", "kept"),
    [
        ({"length_scale": (100, 0, 1), "air_drag": (86, 0, 1)}, {"length_scale"}),
        ({"length_scale": (100, 0, 1), "air_drag": (86, 27, 1)}, {"length_scale", "air_drag"}),
        # With film off the drag is the likeliest, and the leak as far behind it as without.
        ({"length_scale": (100, 0, 1), "air_drag": (86, 50, 1), "leak": (80, 50, 1)}, {"length_scale", "air_drag"}),
        ({"film_mass": (100, 0, 1), "air_drag": (86, 30, 1)}, {"film_mass"}),
        ({"film_mass": (96, 0, 1), "air_drag": (86, 30, 1)}, {"film_mass", "air_drag"}),
        # A form that contains the other gains 20 in −2 ln L: more than 9, less than 9 of noise three times as large.
        ({"supply_refill": (110, 0, 1), "reservoir_depletion": (100, 0, 1)}, {"supply_refill"}),
        ({"supply_refill": (110, 0, 3), "reservoir_depletion": (100, 0, 3)}, {"reservoir_depletion"}),
    ],
)
def test_what_is_as_likely_with_film_a_little_off_is_excluded_only_by_film_alone(monkeypatch, given, kept):
    """By ln L, gain by film and inflation; none predicts the curve of another. A larger form must gain as much."""
    monkeypatch.setattr(likelihood_ratio, "_distance", lambda *_: 1e3)
    ratios = []
    for name, (log_likelihood, gain, inflation) in given.items():
        known = SimpleNamespace(log_likelihood=log_likelihood), 0.0, 0.0, True, Remark()
        ratios.append(LikelihoodRatio((catalogue()[name],), *known, film_gain=gain, inflation=inflation))
    assert {ratio.label for ratio in answer_set(ratios)[0]} == kept


def test_two_predictions_are_as_far_apart_as_the_noise_of_the_fit_makes_them():
    """Against the inverse of the covariance of AR(1) noise, whatever noise another model of the errors has."""
    rho, variance, difference = 0.6, 1e-8, np.array([1.0, 2.0, -1.0, 0.5]) * 1e-4
    lags = np.abs(np.subtract.outer(np.arange(4), np.arange(4)))
    expected = difference @ np.linalg.solve(variance / (1 - rho**2) * rho**lags, difference)

    def fit(position_m):
        solution = SimpleNamespace(state=SimpleNamespace(rho=rho, variance=np.array([variance])))
        parts = {"predictor": SimpleNamespace(data=[SimpleNamespace(relative_sd=None)]), "solution": solution}
        trials = [SimpleNamespace(predicted_position_m=position_m)]
        return SimpleNamespace(trials=trials, noise_correlation=0.1, **parts)

    assert likelihood_ratio._distance(fit(difference), fit(0 * difference)) == pytest.approx(expected)


@pytest.mark.slow
def test_a_frame_rate_that_was_off_on_one_day_is_named_with_the_day_and_known_to_predictions(tmp_path):
    """A campaign of two days, the camera running by 4 to 8 % otherwise on the second."""
    of_two_days = laboratory(tmp_path, "rate_day", 909, (24, 26))[1]
    said = diagnosed(of_two_days)
    assert said.verdict == "artefact"
    assert "time_base" in said.answer_set
    first, second = row_of(said, "time_base").numbers
    assert (first.vine, second.vine) == ("day 1", "day 2")
    assert abs(first.value) < 3 * first.sigma < 0.02
    assert 0.03 < abs(second.value) < 0.09
    assert second.sigma < 0.01
    # A band around a prediction takes over the error of the number of its day.
    fitted_by_day = vt.fit(vt.base_model() + "time_base", of_two_days, profile=False)
    pairs = [pair for pair in fitted_by_day.pairs if pair[0].day == "2"]
    known = vt.predict(fitted_by_day, pairs)
    unknown = vt.predict(fitted_by_day, [(replace(trial, day=""), track) for trial, track in pairs])
    assert np.mean([trial.rms_m for trial in known]) < 0.6 * np.mean([trial.rms_m for trial in unknown])
    data = next(data for data in fitted_by_day.predictor.data if data.trial.day == "2")
    layout = make_layout(fitted_by_day.model, [data])
    _, places = values_for_trial(fitted_by_day, layout, data)
    place = places[layout.keys.index("time_base.eps")]
    assert fitted_by_day.numbers[place].name == "time_base.eps[day 2]"


@pytest.mark.slow
@pytest.mark.parametrize(("row", "seed"), [("chamber_larger", 914), ("chamber_smaller", 902)])
def test_a_chamber_that_was_misread_is_a_depletion(tmp_path, row, seed):
    """With a γ that no gas has, and nothing else."""
    rivals = ("reservoir_depletion", "supply_refill", "area_scale", "film_mass", "tail_friction", "leak")
    said = diagnosed(laboratory(tmp_path, row, seed, (10, 14), weighed=False)[1], rivals)
    assert said.effects == ("reservoir_depletion",)
    assert said.final_verdict == "adequate"
    (gamma,) = [number for number in said.parameters if number.key == "reservoir_depletion.gamma"]
    assert gamma.value < 1.0 if row == "chamber_larger" else gamma.value > 1.4


@pytest.mark.slow
def test_one_mistyped_payload_of_several_is_named_with_its_vine(tmp_path):
    said = diagnosed(laboratory(tmp_path, "payload_mistyped", 912, (24, 40))[1])
    assert (said.verdict, said.answer_set) == ("artefact", ("payload_mass",))
    off = [number for number in row_of(said, "payload_mass").numbers if abs(number.value) > 4 * number.sigma]
    assert len(off) == 1
    loaded_kg = {trial.trial.payload_kg for trial in said.fits[0].trials if trial.trial.vine == off[0].vine} - {0.0}
    assert off[0].value == pytest.approx(0.15 * max(loaded_kg), abs=3 * off[0].sigma)


FLAT = 2 / math.pi - 1
DIAMETER = catalogue()["area_scale"].parameters[0]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("column", "factor", "named", "size"),
    [
        ("diameter_m", math.pi / 2, "area_scale", FLAT),
        ("diameter_m", 0.5, "area_scale", 1.0),
        ("thickness_m", 2.0, "film_mass", -0.5),
    ],
    ids=["flat", "radius", "folded"],
)
def test_a_slip_in_a_column_is_named(tmp_path, column, factor, named, size):
    pairs, _ = pairs_of(laboratory(tmp_path, "clean", 909, (10, 14))[1])
    slipped = [(replace(t, **{column: factor * getattr(t, column)}), track) for t, track in pairs]
    faults = ("area_scale", "film_mass", "length_scale", "pressure_gain", "time_base", "inlet_loss", "air_drag")
    said = diagnosed(slipped, faults)
    assert said.verdict in ("artefact", "ambiguous")
    assert named in said.answer_set
    row = row_of(said, named)
    assert all(abs(number.value - size) < 3 * number.sigma + 0.02 for number in row.numbers)
    assert row.plausible


def test_what_is_left_beside_a_slip_must_be_an_ordinary_error_and_that_is_no_slip():
    most = RANGE_SHARE_BESIDE_SLIP * DIAMETER.plausible[1]
    inside, outside = ((1 + part * most) * (1 + FLAT) - 1 for part in (0.9, 1.2))
    assert slip_of(DIAMETER, inside, 0.0) == DIAMETER.slips[0]
    assert is_plausible(DIAMETER, inside, 0.0)
    assert slip_of(DIAMETER, outside, 0.0) is None
    assert not is_plausible(DIAMETER, outside, 0.0)
    assert slip_of(DIAMETER, outside, 0.01) is not None
    # But film a fifth too light is polyethylene sooner than too thin: film is sold to within a tenth.
    for name, part in (("area_scale", 1.0), ("length_scale", 1.0), ("time_base", 1.0), ("film_mass", 0.5)):
        parameter = catalogue()[name].parameters[0]
        assert parameter.slips
        assert all(slip_of(parameter, part * error, 0.01) is None for error in (*parameter.plausible, 0.0))


@pytest.mark.slow
def test_nothing_is_missing_from_a_simulation_of_the_model_itself(tmp_path, monkeypatch):
    """Without noise. What the integrator errs by, 1 µm in a metre, had passed for motion that is noisier than rest."""
    camera = shots.Camera
    monkeypatch.setattr(shots, "Camera", lambda _noise_m, **how: camera(0.0, **how))
    truths, experiment = laboratory(tmp_path, "clean", 20600, (12, 12), weighed=False)
    said = diagnosed(experiment)
    assert said.verdict == "adequate"
    fit = said.fits[0]
    assert all(seen.noise_m**2 < variance_floor([seen])[0] for seen in fit.predictor.data)
    assert np.isfinite(fit.chi2_per_dof)
    assert misfit_tests.noise_in_motion_p(fit) == 1.0
    assert fit["n"].value == pytest.approx(truths["eversion_damping.n"], abs=3 * fit["n"].sigma)


ANGLE_RIVALS = ("growth_angle", "payload_friction", "pressure_gauge", "leak")


def filmed(vine: Vine, pressures_kPa: tuple[float, ...], payload_g: float, stated_deg: float, true_deg: float) -> Pairs:
    """Three trials a pressure of a vine that grew in one direction and is stated in another."""
    made = laboratory_campaign(vine, pressures_kPa, 3, payload_g)
    trials = with_names([replace(trial, growth_angle_rad=math.radians(true_deg)) for trial in made])
    pairs = grown_pairs(grown(trials, 61))
    return [(replace(trial, growth_angle_rad=math.radians(stated_deg)), track) for trial, track in pairs]


@pytest.mark.slow
@pytest.mark.parametrize(("stated_deg", "true_deg"), [(90, 0), (0, 90)], ids=["level for down", "blank for level"])
def test_a_loaded_vine_tells_that_its_angle_is_wrong(stated_deg, true_deg):
    told = diagnosed(filmed(Vine(24, 200, 280), (14, 28, 41), 35.6, stated_deg, true_deg), ANGLE_RIVALS)
    assert (told.verdict, told.answer_set, told.effects) == ("artefact", ("growth_angle",), ())
    (slip,) = row_of(told, "growth_angle").numbers
    assert abs(slip.value - 1) < 4 * slip.sigma < 0.4


@pytest.mark.slow
def test_a_bare_vine_of_light_film_cannot_tell():
    bare = filmed(Vine(12, 100, 140), (24, 30, 38, 48), 0, 90, 0)
    told = diagnosed([(replace(t, position_systematic_m=1e-4), track) for t, track in bare], ANGLE_RIVALS)
    assert told.verdict == "adequate"
    assert row_of(told, "growth_angle").status == result.NOT_TESTABLE
