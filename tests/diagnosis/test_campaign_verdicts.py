"""Verdicts on whole campaigns of another simulator, with nuisances that the fit does not assume."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from grown import Pairs, grown, pairs_of
from hidden import Hidden, make, shots
from hidden.laboratory_folder import write_experiment
from hidden.laboratory_rows import campaign
from scipy.stats import norm

import vinetrack as vt
from vinetrack.core.records import Trial
from vinetrack.core.units import with_error
from vinetrack.diagnosis import likelihood_ratio
from vinetrack.diagnosis.candidate_fits import distinct_starts, start_values
from vinetrack.diagnosis.likelihood_ratio import (
    LikelihoodRatio,
    _compatible_with_none,
    answer_set,
    film_gain,
    in_sigmas,
    sizes_of,
)
from vinetrack.diagnosis.misfit_tests import noise_in_motion_p
from vinetrack.diagnosis.remarks import Remark
from vinetrack.diagnosis.result import NOT_TESTABLE, Diagnosis
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
from vinetrack.inference.fit_result import group_names, groups_of, make_layout
from vinetrack.inference.optimiser import variance_floor
from vinetrack.inference.robust_covariance import FILM_ERROR
from vinetrack.laboratory.tracks import Vine
from vinetrack.laboratory.tracks import campaign as laboratory_campaign


@lru_cache
def asked(kind: str, seed: int, *, once: bool = False) -> tuple[Hidden, Diagnosis]:
    """A campaign, each of its conditions once if so said, and the verdict."""
    campaign = make(kind, seed, trials=int(once))
    return campaign, vt.diagnose(list(campaign.pairs), ladder=False, advice=False)


@pytest.mark.slow
@pytest.mark.parametrize(("regime", "seed"), [("mixed_noise", 908), ("large_B_scatter", 913)])
def test_nothing_is_missed_where_nothing_is_missing(regime, seed):
    _, said = asked(f"null:{regime}", seed)
    assert said.verdict == "adequate"
    assert said.effects == ()
    assert said.answer_set == ()


@pytest.mark.slow
@pytest.mark.parametrize(("effect", "seed"), [("tail_friction", 918), ("reservoir_depletion", 905)])
def test_a_hidden_effect_is_in_the_answer_with_its_size(effect, seed):
    campaign, said = asked(effect, seed, once=True)
    assert said.verdict in ("missing", "ambiguous")
    assert effect in said.answer_set
    assert len(said.answer_set) <= 2
    numbers = {n.key: n for c in said.rounds[0].ranking if c.effect == effect for n in c.numbers}
    for key, size in campaign.truth.values.items():
        assert abs(numbers[key].value - size) < 4 * numbers[key].sigma


@pytest.mark.slow
def test_a_rough_patch_is_in_no_catalogue():
    _, said = asked("outsider:rough_patch", 962, once=True)
    assert said.verdict == "unexplained"
    assert said.effects == ()


@pytest.mark.slow
def test_two_hidden_effects_are_found_one_after_the_other():
    campaign, said = asked("tail_friction+length_scale", 930, once=True)
    named = {*said.effects, *said.rounds[-1].answer_set}
    assert set(campaign.truth.effects) <= named
    assert said.verdict in ("missing", "ambiguous")


# Film that weighs other than thickness and density say: a size for each vine, asked of all and of each alone.

FILM, DRAG = catalogue()["film_mass"], catalogue()["air_drag"]
TRIALS = [Trial(name="t1", vine="a"), Trial(name="t2", vine="b")]


@pytest.fixture(scope="module")
def answered(tmp_path_factory):
    """The truth about two vines whose film is off by +1.4 and −8.3 per cent, and what is said of them."""
    folder = tmp_path_factory.mktemp("film") / "e"
    known = campaign("film_uneven", 909, (24, 26))
    write_experiment(known, folder)
    return known.truth["truths"], vt.diagnose(vt.read_experiment(folder), ladder=False, advice=False)


@pytest.mark.slow
def test_film_of_one_vine_that_is_lighter_is_named_with_each_size(answered):
    truths, said = answered
    assert (said.verdict, said.answer_set) == ("artefact", ("film_mass",))
    (named,) = [candidate for candidate in said.rounds[0].ranking if candidate.effect == "film_mass"]
    assert len({number.vine for number in named.numbers}) == 2
    (n,) = [number for number in named.along if number.key == "eversion_damping.n"]
    assert abs(n.value - truths["eversion_damping.n"]) < 2 * n.sigma
    assert f"Fitted together with film_mass, n = {with_error(n.value, n.sigma)} instead of" in said.explanation
    for k, number in enumerate(named.numbers):
        assert abs(number.value - truths[f"film_mass.eps.{k}"]) < 3 * number.sigma < 0.03


def test_a_vine_is_asked_alone_where_there_are_several():
    assert [shape.group for shape in shapes_of(FILM)] == [""]
    assert [shape.group for shape in shapes_of(FILM, TRIALS[:1])] == [""]
    assert [(s.group, s.other_groups) for s in shapes_of(FILM, TRIALS)] == [("", ()), ("a", ("b",)), ("b", ("a",))]
    assert not any(shape.group for shape in shapes_of(DRAG, TRIALS))


def test_a_day_is_asked_alone_where_the_sheet_states_several_and_one_for_every_trial():
    rate = catalogue()["time_base"]
    known = [replace(trial, day=str(1 + k % 2)) for k, trial in enumerate(TRIALS)]
    assert [shape.group for shape in shapes_of(rate, known)] == ["", "day 1", "day 2"]
    assert [shape.group for shape in shapes_of(rate, [known[0], replace(known[1], day="")])] == [""]
    assert [shape.group for shape in shapes_of(rate, known[:1])] == [""]


@pytest.mark.slow
def test_what_one_vine_answers_alone_adds_up_to_what_all_answer(answered):
    fit = answered[1].fits[0]
    vines = list(dict.fromkeys(trial.trial.vine for trial in fit.trials))
    asked = effect_sensitivities(fit, shapes_of(FILM, [trial.trial for trial in fit.trials]))
    assert [shape.group for shape in asked.shapes] == ["", *vines]
    for trial, columns in zip(fit.trials, asked.columns, strict=True):
        alone = {vine: columns[:, 1 + k] for k, vine in enumerate(vines)}
        assert np.any(alone.pop(trial.trial.vine))
        assert not any(np.any(of_other) for of_other in alone.values())
        np.testing.assert_allclose(columns[:, 1:].sum(axis=1), columns[:, 0], rtol=0.02, atol=1e-5)


def test_a_fit_begins_from_the_vine_that_was_asked():
    shapes = shapes_of(FILM, TRIALS)
    assert start_values(shapes[0], 0.1) == {"film_mass.eps": 0.1}
    assert start_values(shapes[2], 0.1) == {"film_mass.eps": {"a": 0.0, "b": 0.1}}
    assert len(distinct_starts((shape, 0.1) for shape in [*shapes, shapes[1]])) == 3


@pytest.fixture(scope="module")
def film_free(answered):
    """The first fit with a size of the film of each vine."""
    return vt.refit(answered[1].fits[0], answered[1].fits[0].model + "film_mass")


@pytest.mark.slow
@pytest.mark.parametrize("fall", [4.0, 30.0, 3000.0])
def test_sizes_of_several_vines_count_as_so_many_numbers(answered, film_free, fall):
    fit = answered[1].fits[0]
    assert in_sigmas(fall, sizes_of((DRAG,), fit)) == math.sqrt(fall)
    assert in_sigmas(-fall, sizes_of((FILM,), fit)) == -math.sqrt(fall)
    got = in_sigmas(fall, sizes_of((FILM,), film_free))
    # Of two numbers the chance of such a fall is exp(−fall/2).
    assert got < math.sqrt(fall)
    assert norm.logsf(got) + math.log(2) == pytest.approx(-fall / 2, rel=1e-6)


@pytest.mark.slow
def test_a_size_that_is_something_in_one_vine_is_something(film_free):
    first, second = (number for number in film_free.numbers if number.key == "film_mass.eps")
    nothing = replace(first, value=0.1 * first.sigma)
    assert not _compatible_with_none((FILM,), _numbers(film_free, nothing, second))
    again = replace(second, value=0.1 * second.sigma)
    assert _compatible_with_none((FILM,), _numbers(film_free, nothing, again)).code == "size_may_be_zero"


@pytest.mark.slow
def test_film_gains_what_a_fit_with_free_film_gains_less_its_prior(answered, film_free):
    fit = answered[1].fits[0]
    sizes = [number.value for number in film_free.numbers if number.key == "film_mass.eps"]
    fall = 2 * (film_free.log_likelihood - fit.log_likelihood)
    gained = film_gain(fit)
    # The prior pulls sizes in, so it costs less than at the sizes of the free fit, and more than nothing.
    assert fall - sum((size / FILM_ERROR) ** 2 for size in sizes) < gained < fall
    assert film_gain(film_free) == 0


def _ratio(effect, log_likelihood, gain=0.0):
    fit = SimpleNamespace(log_likelihood=log_likelihood)
    return LikelihoodRatio((effect,), fit, 0.0, 0.0, plausible=True, reason=Remark(), film_gain=gain)


def _labels(*ratios):
    return {ratio.label for ratio in answer_set(ratios)[0]}


@pytest.fixture
def unlike(monkeypatch):
    """Hypotheses none of which predicts the curve of another."""
    monkeypatch.setattr(likelihood_ratio, "_distance", lambda *_: 1e3)


@pytest.mark.usefixtures("unlike")
def test_what_is_as_likely_with_film_a_little_off_is_not_excluded():
    scale, drag, leak = (catalogue()[name] for name in ("length_scale", "air_drag", "leak"))
    best = _ratio(scale, 100.0)
    assert _labels(best, _ratio(drag, 86.0)) == {"length_scale"}
    assert _labels(best, _ratio(drag, 86.0, 27.0)) == {"length_scale", "air_drag"}
    # With film off the drag is the likeliest, and the leak as far behind it as without.
    assert _labels(best, _ratio(drag, 86.0, 50.0), _ratio(leak, 80.0, 50.0)) == {"length_scale", "air_drag"}


@pytest.mark.usefixtures("unlike")
def test_film_that_explains_all_alone_brings_in_nothing_beside_it():
    drag = _ratio(DRAG, 86.0, 30.0)
    assert _labels(_ratio(FILM, 100.0), drag) == {"film_mass"}
    assert _labels(_ratio(FILM, 96.0), drag) == {"film_mass", "air_drag"}


@pytest.mark.usefixtures("unlike")
@pytest.mark.parametrize(("inflation", "kept"), [(1.0, {"supply_refill"}), (3.0, {"reservoir_depletion"})])
def test_a_larger_form_must_gain_what_excludes_a_hypothesis(inflation, kept):
    """A form that contains the other and gains 20 in −2 ln L: more than 9 of noise, less than 9 of noise three times
    as large.
    """
    larger, contained = catalogue()["supply_refill"], catalogue()["reservoir_depletion"]
    both = [replace(_ratio(larger, 110.0), inflation=inflation), replace(_ratio(contained, 100.0), inflation=inflation)]
    assert _labels(*both) == kept


def test_two_predictions_are_as_far_apart_as_the_noise_of_the_fit_makes_them():
    """Against the inverse of the covariance of AR(1) noise, whatever noise another model of the errors has."""
    rho, variance, difference = 0.6, 1e-8, np.array([1.0, 2.0, -1.0, 0.5]) * 1e-4
    lags = np.abs(np.subtract.outer(np.arange(4), np.arange(4)))
    expected = difference @ np.linalg.solve(variance / (1 - rho**2) * rho**lags, difference)

    def fit(position_m):
        state = SimpleNamespace(rho=rho, variance=np.array([variance]))
        data = [SimpleNamespace(relative_sd=None)]
        trials = [SimpleNamespace(predicted_position_m=position_m)]
        parts = {"predictor": SimpleNamespace(data=data), "solution": SimpleNamespace(state=state)}
        return SimpleNamespace(trials=trials, noise_correlation=0.1, **parts)

    assert likelihood_ratio._distance(fit(difference), fit(0 * difference)) == pytest.approx(expected)


def _numbers(fit, *changed):
    """A fit with these numbers in place of its own of the same names."""
    by_name = {number.name: number for number in changed}
    return replace(fit, numbers=tuple(by_name.get(number.name, number) for number in fit.numbers))


# A camera that was set otherwise on one day: a number for each day, and models that hold such numbers.

RATE = "time_base.eps"


@pytest.fixture(scope="module")
def of_two_days(tmp_path_factory):
    """What is said of a campaign of two days, the camera running by 4 to 8 % otherwise on the second, and its pairs."""
    folder = tmp_path_factory.mktemp("day") / "e"
    write_experiment(campaign("rate_day", 909, (24, 26)), folder)
    experiment = vt.read_experiment(folder)
    return experiment, vt.diagnose(experiment, ladder=False, advice=False)


@pytest.fixture(scope="module")
def fitted_by_day(of_two_days):
    return vt.fit(vt.base_model() + "time_base", of_two_days[0], profile=False)


@pytest.mark.slow
def test_a_frame_rate_that_was_off_on_one_day_is_named_with_the_day(of_two_days):
    said = of_two_days[1]
    assert said.verdict == "artefact"
    assert "time_base" in said.answer_set
    (named,) = [candidate for candidate in said.rounds[0].ranking if candidate.effect == "time_base"]
    first, second = named.numbers
    assert (first.vine, second.vine) == ("day 1", "day 2")
    assert abs(first.value) < 3 * first.sigma < 0.02
    assert 0.03 < abs(second.value) < 0.09
    assert second.sigma < 0.01


def test_days_count_where_the_sheet_states_several_and_one_for_every_trial():
    two = [Trial(name="a", vine="v", day="1"), Trial(name="b", vine="v", day="2")]
    assert groups_of(two, "day") == ["day 1", "day 2"]
    assert groups_of([two[0], replace(two[1], day="")], "day") == ["", ""]
    assert groups_of([two[0], two[0]], "day") == ["", ""]
    assert group_names([replace(two[0], day=day) for day in ("10", "2", "2")], "day") == ["day 2", "day 10"]
    assert groups_of(two, "vine") == ["v", "v"]
    assert groups_of(two, "all") == ["", ""]


def test_what_only_another_day_is_known_to_have_is_nothing_on_this_one():
    model = (vt.base_model() + "time_base").with_values({RATE: {"day 1": 0.05}})
    place = model.parameter_names.index(RATE)
    assert model.parameters_for("v", "day 1")[place] == 0.05
    assert model.parameters_for("v", "day 2")[place] == 0.0
    assert model.parameters_for("v")[place] == 0.0


@pytest.mark.slow
def test_a_fit_with_a_number_for_each_day_predicts_the_trials_of_each(fitted_by_day):
    days = {number.vine: number for number in fitted_by_day.numbers if number.key == RATE}
    assert set(days) == {"day 1", "day 2"}
    off, sigma = days["day 2"].value - days["day 1"].value, days["day 2"].sigma
    assert abs(off) > max(0.03, 5 * sigma)
    pairs = [pair for pair in fitted_by_day.pairs if pair[0].day == "2"]
    known = vt.predict(fitted_by_day, pairs)
    unknown = vt.predict(fitted_by_day, [(replace(trial, day=""), track) for trial, track in pairs])
    assert np.mean([trial.rms_m for trial in known]) < 0.6 * np.mean([trial.rms_m for trial in unknown])


@pytest.mark.slow
def test_a_band_around_a_prediction_takes_over_the_error_of_the_number_of_its_day(fitted_by_day):
    data = next(data for data in fitted_by_day.predictor.data if data.trial.day == "2")
    layout = make_layout(fitted_by_day.model, [data])
    _, places = values_for_trial(fitted_by_day, layout, data)
    place = places[layout.keys.index(RATE)]
    assert fitted_by_day.numbers[place].name == f"{RATE}[day 2]"


# A chamber that is larger than stated is a depletion with a γ that no gas has, and nothing else.

CHAMBER_RIVALS = ("reservoir_depletion", "supply_refill", "area_scale", "film_mass", "tail_friction", "leak")


@pytest.mark.slow
@pytest.mark.parametrize(("row", "seed"), [("chamber_larger", 914), ("chamber_smaller", 902)])
def test_a_chamber_that_was_misread_is_a_depletion(tmp_path, row, seed):
    known = campaign(row, seed, (10, 14), weighed=False)
    write_experiment(known, tmp_path / "e")
    said = vt.diagnose(vt.read_experiment(tmp_path / "e"), candidates=CHAMBER_RIVALS, ladder=False, advice=False)
    assert said.effects == ("reservoir_depletion",)
    assert said.final_verdict == "adequate"
    (gamma,) = [number for number in said.parameters if number.key == "reservoir_depletion.gamma"]
    assert gamma.value < 1.0 if row == "chamber_larger" else gamma.value > 1.4


# Payloads that weigh other than stated: one for each vine, of which one may be mistyped.


@pytest.mark.slow
def test_one_mistyped_payload_of_several_is_named_with_its_vine(tmp_path):
    """The payload of one of two vines weighs 15 % more than stated."""
    write_experiment(campaign("payload_mistyped", 912, (24, 40)), tmp_path / "e")
    said = vt.diagnose(vt.read_experiment(tmp_path / "e"), ladder=False, advice=False)
    assert (said.verdict, said.answer_set) == ("artefact", ("payload_mass",))
    numbers = next(row for row in said.rounds[0].ranking if row.effect == "payload_mass").numbers
    off = [number for number in numbers if abs(number.value) > 4 * number.sigma]
    assert len(off) == 1
    loaded_kg = {trial.trial.payload_kg for trial in said.fits[0].trials if trial.trial.vine == off[0].vine} - {0.0}
    assert off[0].value == pytest.approx(0.15 * max(loaded_kg), abs=3 * off[0].sigma)


# A slip in the whole sheet is named as what it is, however large the error that it leaves.

FLAT = 2 / math.pi - 1
FAULTS = ("area_scale", "film_mass", "length_scale", "pressure_gain", "time_base", "inlet_loss", "air_drag")
DIAMETER = catalogue()["area_scale"].parameters[0]


@pytest.fixture(scope="module")
def clean_pairs(tmp_path_factory):
    """A campaign with nothing missing."""
    folder = tmp_path_factory.mktemp("slips") / "e"
    write_experiment(campaign("clean", 909, (10, 14)), folder)
    fit = vt.fit(vt.base_model(), folder, profile=False)
    return list(fit.pairs)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("slip", "named", "size"),
    [
        ({"diameter_m": math.pi / 2}, "area_scale", FLAT),
        ({"diameter_m": 0.5}, "area_scale", 1.0),
        ({"thickness_m": 2.0}, "film_mass", -0.5),
    ],
    ids=["flat", "radius", "folded"],
)
def test_a_slip_in_a_column_is_named(clean_pairs, slip, named, size):
    slipped = [
        (replace(trial, **{name: factor * getattr(trial, name) for name, factor in slip.items()}), track)
        for trial, track in clean_pairs
    ]
    said = vt.diagnose(slipped, candidates=FAULTS, ladder=False, advice=False)
    assert said.verdict in ("artefact", "ambiguous")
    assert named in said.answer_set
    (row,) = [row for row in said.rounds[0].ranking if row.effect == named]
    assert all(abs(number.value - size) < 3 * number.sigma + 0.02 for number in row.numbers)
    assert row.plausible


def test_what_is_left_beside_a_slip_must_be_an_ordinary_error():
    _, high = DIAMETER.plausible
    inside, outside = (
        (1 + part * high) * (1 + FLAT) - 1 for part in (0.9 * RANGE_SHARE_BESIDE_SLIP, 1.2 * RANGE_SHARE_BESIDE_SLIP)
    )
    assert slip_of(DIAMETER, inside, 0.0) == DIAMETER.slips[0]
    assert is_plausible(DIAMETER, inside, 0.0)
    assert slip_of(DIAMETER, outside, 0.0) is None
    assert not is_plausible(DIAMETER, outside, 0.0)
    assert slip_of(DIAMETER, outside, 0.01) is not None


def test_an_ordinary_error_is_no_slip():
    """But film a fifth too light is polyethylene sooner than too thin: film is sold to within a tenth."""
    for name, part in (("area_scale", 1.0), ("length_scale", 1.0), ("time_base", 1.0), ("film_mass", 0.5)):
        parameter = catalogue()[name].parameters[0]
        assert parameter.slips
        assert all(slip_of(parameter, part * error, 0.01) is None for error in (*parameter.plausible, 0.0))


# Positions without noise, as a simulation gives them: they are no more exact than the model's own integrator.


@pytest.fixture
def without_noise(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[Path, float]:
    """Twelve trials of another simulator with nothing hidden, filmed by a camera that never errs; their exponent."""
    camera = shots.Camera

    def exact(_noise_m: float, **how: Any) -> shots.Camera:
        return camera(0.0, **how)

    monkeypatch.setattr(shots, "Camera", exact)
    shot = campaign("clean", 20600, (12, 12), weighed=False)
    write_experiment(shot, tmp_path / "simulated")
    return tmp_path / "simulated", float(shot.truth["truths"]["eversion_damping.n"])  # type: ignore[index]


@pytest.mark.slow
def test_nothing_is_missing_from_a_simulation_of_the_model_itself(without_noise: tuple[Path, float]) -> None:
    """What the integrator errs by, 1 µm in a metre, had passed for motion that is noisier than rest."""
    folder, n = without_noise
    said = vt.diagnose(folder, ladder=False, advice=False)
    assert said.verdict == "adequate"
    fit = said.fits[0]
    assert all(trial_data.noise_m**2 < variance_floor([trial_data])[0] for trial_data in fit.predictor.data)
    assert np.isfinite(fit.chi2_per_dof)
    assert noise_in_motion_p(fit) == 1.0
    assert fit["n"].value == pytest.approx(n, abs=3 * fit["n"].sigma)


# A growth angle counted from the level is a fault of the measurement, or not testable where nothing weighs enough.

ANGLE_RIVALS = ("growth_angle", "payload_friction", "pressure_gauge", "leak")


def filmed(vine: Vine, pressures_kPa: tuple[float, ...], payload_g: float, stated_deg: float, true_deg: float) -> Pairs:
    """Three trials a pressure of a vine that grew in one direction and is stated in another."""
    trials = [
        replace(trial, growth_angle_rad=math.radians(true_deg))
        for trial in laboratory_campaign(vine, pressures_kPa, 3, payload_g)
    ]
    pairs = pairs_of(grown(with_names(trials), 61))
    return [(replace(trial, growth_angle_rad=math.radians(stated_deg)), track) for trial, track in pairs]


def asked_of_angle(pairs: Pairs) -> Diagnosis:
    return vt.diagnose(pairs, candidates=ANGLE_RIVALS, ladder=False, advice=False)


@pytest.mark.slow
@pytest.mark.parametrize(("stated_deg", "true_deg"), [(90, 0), (0, 90)], ids=["level for down", "blank for level"])
def test_a_loaded_vine_tells_that_its_angle_is_wrong(stated_deg: float, true_deg: float) -> None:
    told = asked_of_angle(filmed(Vine(24, 200, 280), (14, 28, 41), 35.6, stated_deg, true_deg))
    assert (told.verdict, told.answer_set, told.effects) == ("artefact", ("growth_angle",), ())
    (slip,) = (number for row in told.ranking if row.effect == "growth_angle" for number in row.numbers)
    assert abs(slip.value - 1) < 4 * slip.sigma < 0.4


@pytest.mark.slow
def test_a_bare_vine_of_light_film_cannot_tell() -> None:
    bare = filmed(Vine(12, 100, 140), (24, 30, 38, 48), 0, 90, 0)
    told = asked_of_angle([(replace(trial, position_systematic_m=1e-4), track) for trial, track in bare])
    assert told.verdict == "adequate"
    (row,) = (row for row in told.ranking if row.effect == "growth_angle")
    assert row.status == NOT_TESTABLE
