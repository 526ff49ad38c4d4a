"""What a choice predicts, and the lines, labels and commands that follow from it."""

from __future__ import annotations

import json
import math
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from explorer_campaign import DEMO, SMALL, make_experiment, make_results

from vinetrack.core.records import Trial
from vinetrack.effects import Parameter
from vinetrack.laboratory.tracks import grow, read_ground_truth
from vinetrack.pages.campaign import (
    Campaign,
    choice_in_use,
    commands,
    condition_labels,
    model_text,
    overall_m,
    predict_choice,
    slider_range,
)
from vinetrack.pages.explorer_server import open_campaign
from vinetrack.pages.plots import (
    error_bars,
    measured_lines,
    model_lines,
    replicate_bands,
    residual_lines,
    symmetric_range,
)
from vinetrack.results.folder_layout import ResultsError

GAMMA = "reservoir_depletion.gamma"


def test_the_origin_behind_a_door_is_that_of_the_comparison(tmp_path: Path) -> None:
    """No point of a doubtful rest is fitted, but it still determines the origin."""
    experiment = make_experiment(tmp_path / "vines", SMALL[:4])
    for path in (experiment / "tracks").iterdir():
        table = pd.read_csv(path)
        table.assign(sigma_m=np.where(table["time_s"] < 0.015, 2e-3, 1e-4)).to_csv(path, index=False)
    door = open_campaign(make_results(experiment, tmp_path / "results"))
    table = pd.read_csv(door.folder / "comparison.csv").set_index("condition")
    prediction = predict_choice(door, choice_in_use(door))
    for seen, predicted in zip(door.trials, prediction.trials, strict=True):
        assert seen.data.imprecise_rest is not None
        assert predicted.origin_m == seen.origin_m
    assert prediction.errors_m == pytest.approx(table["rms_position_m"].to_dict(), rel=1e-6)


def test_the_missing_effect_at_its_size_lowers_every_error_to_the_replicates(campaign: Campaign) -> None:
    start = choice_in_use(campaign)
    choice = start.with_effect("reservoir_depletion")
    for name, value in {"eversion_damping.B[24mm-200um-200mm]": 6.44, "eversion_damping.n": 0.37, GAMMA: 1.4}.items():
        choice = choice.with_size(name, value)
    before, after = (predict_choice(campaign, one).errors_m for one in (start, choice))
    assert all(after[name] < before[name] for name in campaign.conditions)
    assert overall_m(after, campaign.conditions) < 1.5 * overall_m(campaign.floors_m, campaign.conditions)


def test_an_effect_of_no_size_changes_nothing(campaign: Campaign) -> None:
    start = choice_in_use(campaign)
    none = predict_choice(campaign, start.with_effect("air_drag").with_size("air_drag.C_D", 0.0))
    for bare, with_it in zip(predict_choice(campaign, start).trials, none.trials, strict=True):
        np.testing.assert_allclose(with_it.predicted_position_m, bare.predicted_position_m, atol=1e-9)


def test_a_fit_that_was_refused_still_shows_the_trials(campaign: Campaign, tmp_path: Path) -> None:
    folder = tmp_path / "results"
    shutil.copytree(campaign.folder, folder)
    (folder / "fit.json").write_text(json.dumps({"model": [], "refused": "no reason"}))
    bare = open_campaign(folder)
    assert bare.refused == "no reason"
    assert bare.floors_m == {}
    assert choice_in_use(bare).numbers["eversion_damping.n"] == 0.37
    true = {one.stated.name: one for one in grow(bare.experiment.trials, read_ground_truth(DEMO))}
    assert len(bare.trials) == 6
    for seen in bare.trials:
        # The last frame at rest, where 0.1 mm of noise hides the first two milliseconds of the motion.
        assert seen.release_s == pytest.approx(true[seen.name].release_s, abs=2.5e-3)
        assert seen.origin_m == pytest.approx(true[seen.name].origin_m, abs=1e-4)


def test_a_folder_without_usable_trials_is_refused(campaign: Campaign, tmp_path: Path) -> None:
    folder = tmp_path / "results"
    shutil.copytree(campaign.folder, folder)
    for path in (folder / "tracks").iterdir():
        path.write_text(path.read_text().splitlines()[0] + "\n")
    with pytest.raises(ResultsError):
        open_campaign(folder)


def test_an_effect_is_added_at_the_end_and_keeps_its_size_when_removed(campaign: Campaign) -> None:
    choice = choice_in_use(campaign).with_effect("air_drag").with_size("air_drag.C_D", 0.7)
    assert choice.effects[-1] == "air_drag"
    out = choice.with_effect("air_drag", False)
    assert (out.effects, out.numbers["air_drag.C_D"]) == (campaign.in_use, 0.7)
    assert choice.with_effect("air_drag") is choice


def test_slider_ranges_include_zero_the_plausible_range_and_the_fitted_value() -> None:
    drag = Parameter("C_D", "C_D", "1", 1.0, bounds=(0.0, 200.0), plausible=(0.0, 3.0))
    assert slider_range("air_drag.C_D", drag, 1.0) == (0.0, 3.0)
    low, high = slider_range("air_drag.C_D", drag, 17.0)
    assert low == 0.0
    assert 17.0 < high < 200.0
    assert slider_range("air_drag.C_D", drag, 200.0)[1] == 200.0
    gauge = Parameter("delta", "δ", "Pa", 500.0, bounds=(-2e4, 2e4), plausible=(-2e3, 2e3))
    assert slider_range("pressure_gauge.delta", gauge, -3e3) == (-3e3, 2e3)
    damping = Parameter("B", "B", "N·(s/m)ⁿ", 3.0, bounds=(0.0, math.inf), shared="vine")
    assert slider_range("eversion_damping.B", damping, 6.0) == (0.0, 12.0)


def test_a_condition_is_labelled_by_its_distinguishing_settings(campaign: Campaign) -> None:
    assert [campaign.labels[name] for name in campaign.conditions] == ["24 kPa", "36 kPa", "48 kPa, 20 g"]
    thick = Trial(name="a", diameter_m=0.012, thickness_m=1e-4, length_m=0.14, pressure_Pa=24e3)
    other = replace(thick, diameter_m=0.024, thickness_m=2e-4, length_m=0.2)
    thin = replace(other, thickness_m=1e-4)
    assert condition_labels({"a": thick, "b": other}) == {"a": "12 mm", "b": "24 mm"}
    labels = condition_labels({"a": thick, "b": other, "c": thin})
    assert (labels["b"], labels["c"]) == ("24 mm, 200 µm", "24 mm, 100 µm")
    assert len(set(condition_labels({"a": thick, "b": thick}).values())) == 2


def test_lines_are_in_milliseconds_and_millimetres_and_thinned(campaign: Campaign) -> None:
    prediction = predict_choice(campaign, choice_in_use(campaign))
    shown = [0, 1, 2]
    lines, left = measured_lines(campaign, shown), residual_lines(campaign, prediction, shown)
    assert lines["trial"] == [campaign.trials[i].name for i in shown]
    assert max(np.nanmax(part) for part in lines["ys"]) == pytest.approx(200, abs=1)
    assert all(len(part) <= 260 for part in lines["xs"])
    assert [len(part) for part in left["ys"]] == [len(part) for part in lines["ys"]]
    assert len(model_lines(campaign, prediction, shown)["xs"]) == 2
    assert len(replicate_bands(campaign, shown)["xs"]) == 2


def test_error_bars_have_a_row_per_condition_with_the_first_on_top(campaign: Campaign) -> None:
    now = dict.fromkeys(campaign.conditions, 2e-3)
    rows = error_bars(campaign, now, {}, campaign.floors_m, [campaign.conditions[0]])
    assert rows["label"] == ["48 kPa, 20 g", "36 kPa", "24 kPa"]
    assert rows["now"] == pytest.approx([2.0, 2.0, 2.0])
    assert all(math.isnan(value) for value in rows["before"])
    assert rows["alpha"][2] > rows["alpha"][0]


def test_the_range_of_residuals_moves_in_steps() -> None:
    assert symmetric_range({"ys": [np.array([0.1, -3.3])]}) == (-5.0, 5.0)
    assert symmetric_range({"ys": [np.array([math.nan, 4.6])]}) == (-5.0, 5.0)
    assert symmetric_range({"ys": []}) == (-0.12, 0.12)


def test_the_page_shows_the_command_that_reproduces_it(campaign: Campaign) -> None:
    start = choice_in_use(campaign)
    folder = campaign.folder.as_posix()
    assert commands(campaign, start, fitted=True) == [f"vinetrack compare {folder}"]
    more = start.with_effect("reservoir_depletion").with_effect("leak")
    assert commands(campaign, more, fitted=True, save=True) == [
        f"vinetrack add reservoir_depletion {folder} --save",
        f"vinetrack add leak {folder} --save",
    ]
    assert commands(campaign, more, fitted=False) == []
    assert commands(replace(campaign, in_use=(*campaign.in_use, "leak")), start, fitted=True) == []


def test_a_model_has_a_short_name() -> None:
    base = ("pressure_drive", "gravity", "eversion_damping", "yield_pressure")
    assert model_text(base) == "base model"
    assert model_text((*base, "air_drag")) == "base model + air drag"
    assert model_text(("gravity",)) == "gravity"
