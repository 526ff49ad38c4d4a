"""A camera that was set otherwise on one day: a number for each day, and models that hold such numbers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hidden.laboratory_folder import write_experiment
from hidden.laboratory_rows import campaign

import vinetrack as vt
from vinetrack.core.records import Trial
from vinetrack.inference.parameters import group_names, groups_of, make_layout
from vinetrack.inference.prediction_band import values_for_trial

pytestmark = pytest.mark.slow

RATE = "time_base.eps"


@pytest.fixture(scope="module")
def answered(tmp_path_factory):
    """What is said of a campaign of two days, the camera running by 4 to 8 % otherwise on the second, and its pairs."""
    folder = tmp_path_factory.mktemp("day") / "e"
    write_experiment(campaign("rate_day", 909, (24, 26)), folder)
    experiment = vt.read_experiment(folder)
    return experiment, vt.diagnose(experiment, ladder=False, advice=False)


@pytest.fixture(scope="module")
def fitted(answered):
    return vt.fit(vt.base_model() + "time_base", answered[0], profile=False)


def test_a_frame_rate_that_was_off_on_one_day_is_named_with_the_day(answered):
    said = answered[1]
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


def test_a_fit_with_a_number_for_each_day_predicts_the_trials_of_each(fitted):
    days = {number.vine: number for number in fitted.numbers if number.key == RATE}
    assert set(days) == {"day 1", "day 2"}
    off, sigma = days["day 2"].value - days["day 1"].value, days["day 2"].sigma
    assert abs(off) > max(0.03, 5 * sigma)
    pairs = [pair for pair in fitted.pairs if pair[0].day == "2"]
    known = vt.predict(fitted, pairs)
    unknown = vt.predict(fitted, [(replace(trial, day=""), track) for trial, track in pairs])
    assert np.mean([trial.rms_m for trial in known]) < 0.6 * np.mean([trial.rms_m for trial in unknown])


def test_a_band_around_a_prediction_takes_over_the_error_of_the_number_of_its_day(fitted):
    data = next(data for data in fitted.predictor.data if data.trial.day == "2")
    layout = make_layout(fitted.model, [data])
    _, places = values_for_trial(fitted, layout, data)
    place = places[layout.keys.index(RATE)]
    assert fitted.numbers[place].name == f"{RATE}[day 2]"
