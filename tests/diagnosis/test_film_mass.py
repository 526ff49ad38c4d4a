"""Film that weighs other than thickness and density say: a size for each vine, asked of all and of each alone."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from hidden.laboratory_folder import write_experiment
from hidden.laboratory_rows import campaign
from scipy.stats import norm

import vinetrack as vt
from vinetrack.core.records import Trial
from vinetrack.core.units import with_error
from vinetrack.diagnosis import likelihood_ratio
from vinetrack.diagnosis.between_gain import film_gain
from vinetrack.diagnosis.candidate_fits import distinct_starts, start_values
from vinetrack.diagnosis.candidates import effect_sensitivities, shapes_of
from vinetrack.diagnosis.likelihood_ratio import (
    LikelihoodRatio,
    _compatible_with_none,
    answer_set,
    in_sigmas,
    sizes_of,
)
from vinetrack.diagnosis.remarks import Remark
from vinetrack.effects import catalogue
from vinetrack.inference.robust_covariance import FILM_ERROR

pytestmark = pytest.mark.slow

FILM, DRAG = catalogue()["film_mass"], catalogue()["air_drag"]
TRIALS = [Trial(name="t1", vine="a"), Trial(name="t2", vine="b")]


@pytest.fixture(scope="module")
def answered(tmp_path_factory):
    """The truth about two vines whose film is off by +1.4 and −8.3 per cent, and what is said of them."""
    folder = tmp_path_factory.mktemp("film") / "e"
    known = campaign("film_uneven", 909, (24, 26))
    write_experiment(known, folder)
    return known.truth["truths"], vt.diagnose(vt.read_experiment(folder), ladder=False, advice=False)


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


@pytest.mark.parametrize("fall", [4.0, 30.0, 3000.0])
def test_sizes_of_several_vines_count_as_so_many_numbers(answered, fall):
    fit = answered[1].fits[0]
    assert in_sigmas(fall, sizes_of((DRAG,), fit)) == math.sqrt(fall)
    assert in_sigmas(-fall, sizes_of((FILM,), fit)) == -math.sqrt(fall)
    with_film = vt.refit(fit, fit.model + "film_mass")
    got = in_sigmas(fall, sizes_of((FILM,), with_film))
    # Of two numbers the chance of such a fall is exp(−fall/2).
    assert got < math.sqrt(fall)
    assert norm.logsf(got) + math.log(2) == pytest.approx(-fall / 2, rel=1e-6)


def test_a_size_that_is_something_in_one_vine_is_something(answered):
    after = vt.refit(answered[1].fits[0], answered[1].fits[0].model + "film_mass")
    first, second = (number for number in after.numbers if number.key == "film_mass.eps")
    nothing = replace(first, value=0.1 * first.sigma)
    assert not _compatible_with_none((FILM,), _numbers(after, nothing, second))
    again = replace(second, value=0.1 * second.sigma)
    assert _compatible_with_none((FILM,), _numbers(after, nothing, again)).code == "size_may_be_zero"


def test_film_gains_what_a_fit_with_free_film_gains_less_its_prior(answered):
    fit = answered[1].fits[0]
    free = vt.refit(fit, fit.model + "film_mass")
    sizes = [number.value for number in free.numbers if number.key == "film_mass.eps"]
    fall = 2 * (free.log_likelihood - fit.log_likelihood)
    gained = film_gain(fit)
    # The prior pulls sizes in, so it costs less than at the sizes of the free fit, and more than nothing.
    assert fall - sum((size / FILM_ERROR) ** 2 for size in sizes) < gained < fall
    assert film_gain(free) == 0


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


def _numbers(fit, *changed):
    """A fit with these numbers in place of its own of the same names."""
    by_name = {number.name: number for number in changed}
    return replace(fit, numbers=tuple(by_name.get(number.name, number) for number in fit.numbers))
