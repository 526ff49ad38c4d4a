"""Curves and errors of a choice: those of the comparison without changes, and physically right ones with changes."""

from __future__ import annotations

import json
import math
import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from explorer_campaign import DEMO, SMALL, make_experiment, make_results

import vinetrack as vt
from vinetrack.core.records import Trial
from vinetrack.dynamics.simulate import Trajectory, simulate_many
from vinetrack.effects import Parameter
from vinetrack.explorer.campaign import (
    Campaign,
    ChoiceError,
    ExplorerTrial,
    added_and_dropped,
    choice_from_options,
    choice_in_use,
    condition_labels,
    errors_m,
    overall_m,
    simulate_curves,
    sized_model,
    slider_range,
)
from vinetrack.explorer.fitting import CURVE_COLUMNS, commands, curve_table, export_bytes, model_text
from vinetrack.explorer.plots import (
    error_bars,
    measured_lines,
    model_lines,
    plotted_rows,
    replicate_bands,
    residual_lines,
    symmetric_range,
    vine_colours,
)
from vinetrack.explorer.server import open_campaign
from vinetrack.laboratory.tracks import grow, read_ground_truth
from vinetrack.results.folder_layout import ResultsError

GAMMA, EXPONENT = "reservoir_depletion.gamma", "eversion_damping.n"


def test_without_changes_the_errors_are_those_of_the_comparison(campaign: Campaign) -> None:
    table = pd.read_csv(campaign.folder / "comparison.csv").set_index("condition")
    errors = errors_m(campaign, simulate_curves(campaign, sized_model(campaign, choice_in_use(campaign))))
    for condition, error in errors.items():
        assert error == pytest.approx(table.loc[condition, "rms_position_m"], rel=2e-3)
        assert campaign.floors_m[condition] == pytest.approx(table.loc[condition, "replicate_floor_m"])


def test_the_origin_behind_a_door_is_that_of_the_comparison(tmp_path: Path) -> None:
    """No point of a doubtful rest is fitted, but it still determines the origin."""
    experiment = make_experiment(tmp_path / "vines", SMALL[:4])
    for path in (experiment / "tracks").iterdir():
        table = pd.read_csv(path)
        table.assign(sigma_m=np.where(table["time_s"] < 0.015, 2e-3, 1e-4)).to_csv(path, index=False)
    door = open_campaign(make_results(experiment, tmp_path / "results"))
    table = pd.read_csv(door.folder / "comparison.csv").set_index("condition")
    curves = simulate_curves(door, sized_model(door, choice_in_use(door)))
    for seen, motion in zip(door.trials, curves, strict=True):
        assert seen.data.imprecise_rest is not None
        assert motion.origin_m == seen.origin_m
    for condition, error in errors_m(door, curves).items():
        assert error == pytest.approx(table.loc[condition, "rms_position_m"], rel=2e-3)


def test_where_no_rest_was_filmed_release_and_origin_stay_near_the_track(campaign: Campaign) -> None:
    """At constant speed release and origin are confounded: neither may diverge, with vines of 0.2 m."""
    blind = replace(campaign, trials=tuple(replace(seen, origin_known=False) for seen in campaign.trials))
    start = choice_in_use(blind)
    for n in (0.2, 0.37, 0.7):
        for seen, motion in zip(
            blind.trials, simulate_curves(blind, sized_model(blind, start.with_size(EXPONENT, n))), strict=True
        ):
            assert motion.rms_m < 0.1
            assert abs(motion.origin_m - seen.origin_m) < 0.1


def test_the_missing_effect_at_its_size_lowers_every_error_to_the_replicates(campaign: Campaign) -> None:
    start = choice_in_use(campaign)
    true = {"eversion_damping.B[24mm-200um-200mm]": 6.44, "eversion_damping.n": 0.37, GAMMA: 1.4}
    choice = start.with_effect("reservoir_depletion")
    for name, value in true.items():
        choice = choice.with_size(name, value)
    curves = simulate_curves(
        campaign, sized_model(campaign, choice), simulate_curves(campaign, sized_model(campaign, start))
    )
    before = errors_m(campaign, simulate_curves(campaign, sized_model(campaign, start)))
    after = errors_m(campaign, curves)
    assert all(after[name] < before[name] for name in campaign.conditions)
    assert overall_m(after, campaign.conditions) < 1.5 * overall_m(campaign.floors_m, campaign.conditions)


def test_an_effect_of_no_size_changes_nothing(campaign: Campaign) -> None:
    start = choice_in_use(campaign)
    none = simulate_curves(
        campaign, sized_model(campaign, start.with_effect("air_drag").with_size("air_drag.C_D", 0.0))
    )
    for bare, with_it in zip(simulate_curves(campaign, sized_model(campaign, start)), none, strict=True):
        np.testing.assert_allclose(with_it.growth_m, bare.growth_m, atol=1e-9)


def test_curves_do_not_depend_on_the_start_of_the_alignment(campaign: Campaign) -> None:
    start = choice_in_use(campaign)
    far = simulate_curves(campaign, sized_model(campaign, start.with_size("eversion_damping.n", 0.6)))
    cold, warm = (
        simulate_curves(campaign, sized_model(campaign, start)),
        simulate_curves(campaign, sized_model(campaign, start), far),
    )
    for one, other in zip(cold, warm, strict=True):
        assert one.release_s == pytest.approx(other.release_s, abs=2e-6)


def test_a_motion_is_given_in_the_coordinates_of_its_track(campaign: Campaign) -> None:
    curves = simulate_curves(campaign, sized_model(campaign, choice_in_use(campaign)))
    seen, motion = campaign.trials[0], curves[0]
    positions = motion.lead_position_m(seen.data.time_s)
    np.testing.assert_allclose(seen.data.lead_position_m - positions, motion.residual_m, atol=1e-12)
    assert math.isnan(motion.lead_position_m(np.array([99.0]))[0])


def traced(seen: ExplorerTrial) -> ExplorerTrial:
    """With a pressure measured along that is the set one all the time."""
    trace = (np.array([-1.0, 2.0]), np.full(2, seen.data.trial.pressure_Pa))
    return replace(seen, data=replace(seen.data, trace=trace))


def test_a_motion_under_a_measured_pressure_keeps_its_release(campaign: Campaign) -> None:
    other = replace(campaign, trials=tuple(map(traced, campaign.trials)))
    start = choice_in_use(campaign)
    bare, along = (
        simulate_curves(campaign, sized_model(campaign, start)),
        simulate_curves(other, sized_model(other, start)),
    )
    for seen, motion in zip(other.trials, along, strict=True):
        assert motion.release_s == seen.release_s
    assert errors_m(other, along) == pytest.approx(errors_m(campaign, bare), rel=2e-3)
    far = sized_model(other, start.with_size("eversion_damping.n", 0.6))
    assert [motion.release_s for motion in simulate_curves(other, far, along)] == [motion.release_s for motion in along]


def test_a_slider_move_simulates_every_trial_once(campaign: Campaign, monkeypatch: pytest.MonkeyPatch) -> None:
    """The alignment shifts the simulated curve; `benchmarks/explorer_speed.py` measures the time of a move."""
    simulated: list[int] = []

    def counted(model: vt.Model, trials: Sequence[Trial], *more: Any, **named: Any) -> list[Trajectory]:
        simulated.append(len(trials))
        return simulate_many(model, trials, *more, **named)

    monkeypatch.setattr("vinetrack.explorer.campaign.simulate_many", counted)
    start = choice_in_use(campaign)
    before = simulate_curves(campaign, sized_model(campaign, start))
    simulate_curves(campaign, sized_model(campaign, start.with_size("eversion_damping.n", 0.42)), before)
    assert simulated == [len(campaign.trials)] * 2


def test_a_fit_that_was_refused_still_shows_the_trials(campaign: Campaign, tmp_path: Path) -> None:
    folder = tmp_path / "results"
    shutil.copytree(campaign.folder, folder)
    (folder / "fit.json").write_text(json.dumps({"model": [], "refused": "no reason"}))
    bare = open_campaign(folder)
    assert bare.refused == "no reason"
    assert bare.floors_m == {}
    assert len(bare.trials) == 6
    assert choice_in_use(bare).numbers["eversion_damping.n"] == 0.37
    true = {one.stated.name: one for one in grow(bare.experiment.trials, read_ground_truth(DEMO))}
    for seen in bare.trials:
        # The last frame at rest, where 0.1 mm of noise hides the first two milliseconds of the motion.
        assert seen.release_s == pytest.approx(true[seen.name].release_s, abs=2.5e-3)
        assert seen.origin_m == pytest.approx(true[seen.name].origin_m, abs=1e-4)


def test_a_folder_without_usable_trials_says_so(campaign: Campaign, tmp_path: Path) -> None:
    folder = tmp_path / "results"
    shutil.copytree(campaign.folder, folder)
    for path in (folder / "tracks").iterdir():
        path.write_text(path.read_text().splitlines()[0] + "\n")
    with pytest.raises(ResultsError, match="no trial to explore"):
        open_campaign(folder)


def test_own_effects_may_be_chosen(tmp_path: Path) -> None:
    settings = "capture_fps: 1069\nyield_pressure_kPa: 3\neffects: [spring_line.py]\n"
    experiment = make_experiment(tmp_path / "vines", ("d24_24kPa_1", "d24_36kPa_1"), settings + "chamber_l: 2\n")
    (experiment / "spring_line.py").write_text(
        '"""Spring line: pulls the tail back.\n\n    tail force −k x\n\nShorten it.\n"""\n\n'
        "from vinetrack.effects import Parameter\n\n"
        'PARAMETERS = (Parameter("k", "k", "N/m", 0.5, bounds=(0.0, 20.0)),)\n\n\n'
        "def tail_force(s, rig, k):\n    return -k * s.tail_position\n"
    )
    own = open_campaign(make_results(experiment, tmp_path / "results"))
    start = choice_in_use(own)
    slow = simulate_curves(own, sized_model(own, start.with_effect("spring_line").with_size("spring_line.k", 2.0)))
    assert slow[0].path_m.mean() < simulate_curves(own, sized_model(own, start))[0].path_m.mean()


# ---- choices ---------------------------------------------------------------------------------------------------------


def test_an_effect_is_added_at_the_end_and_keeps_its_size_when_removed(campaign: Campaign) -> None:
    choice = choice_in_use(campaign).with_effect("air_drag").with_size("air_drag.C_D", 0.7)
    assert choice.effects[-1] == "air_drag"
    assert added_and_dropped(campaign, choice) == (["air_drag"], [])
    out = choice.with_effect("air_drag", False)
    assert out.effects == campaign.in_use
    assert out.numbers["air_drag.C_D"] == 0.7
    assert choice.with_effect("air_drag") is choice


def test_a_choice_is_made_from_options_of_the_command_line(campaign: Campaign) -> None:
    start = choice_in_use(campaign)
    choice = choice_from_options(campaign, start, ["leak"], [], [f"{GAMMA}=1.2", "eversion_damping.B=6"])
    assert choice.effects[-2:] == ("leak", "reservoir_depletion")
    assert choice.numbers[GAMMA] == 1.2
    assert choice.numbers["eversion_damping.B[24mm-200um-200mm]"] == 6.0


@pytest.mark.parametrize(
    ("add", "drop", "sizes", "words"),
    [
        (["air_drga"], [], [], "did you mean air_drag"),
        (["inlet_loss"], [], [], "inlet_loss needs inlet_mm"),
        ([], ["gravity"], [], "gravity is one of the base effects"),
        ([], [], ["air_drag.C=1"], "is no size"),
        ([], [], ["air_drag.C_D"], "is no size"),
        ([], [], ["air_drag.C_D=much"], "is no number"),
        ([], [], ["air_drag.C_D=-1"], "outside its bounds, 0 to 200"),
    ],
)
def test_unknown_names_and_values_are_refused_in_a_sentence(
    campaign: Campaign, add: list[str], drop: list[str], sizes: list[str], words: str
) -> None:
    with pytest.raises(ChoiceError, match=words):
        choice_from_options(campaign, choice_in_use(campaign), add, drop, sizes)


def test_slider_ranges_include_zero_the_plausible_range_and_the_fitted_value() -> None:
    drag = Parameter("C_D", "C_D", "1", 1.0, bounds=(0.0, 200.0), plausible=(0.0, 3.0))
    assert slider_range("air_drag.C_D", drag, 1.0) == (0.0, 3.0)
    low, high = slider_range("air_drag.C_D", drag, 17.0)
    assert low == 0.0
    assert 17.0 < high < 200.0
    assert slider_range("air_drag.C_D", drag, 200.0)[1] == 200.0
    gamma = Parameter("gamma", "γ", "1", 1.4, bounds=(1.0, 1.4), plausible=(1.0, 1.4))
    assert slider_range(GAMMA, gamma, 1.4) == (1.0, 1.4)
    gauge = Parameter("delta", "δ", "Pa", 500.0, bounds=(-2e4, 2e4), plausible=(-2e3, 2e3))
    assert slider_range("pressure_gauge.delta", gauge, -3e3) == (-3e3, 2e3)
    damping = Parameter("B", "B", "N·(s/m)ⁿ", 3.0, bounds=(0.0, math.inf), shared="vine")
    assert slider_range("eversion_damping.B", damping, 6.0) == (0.0, 12.0)


# ---- labels, lines, files, commands ----------------------------------------------------------------------------------


def test_a_condition_is_labelled_by_its_distinguishing_settings(campaign: Campaign) -> None:
    assert [campaign.labels[name] for name in campaign.conditions] == ["24 kPa", "36 kPa", "48 kPa, 20 g"]
    thick = Trial(name="a", diameter_m=0.012, thickness_m=1e-4, length_m=0.14, pressure_Pa=24e3)
    other = replace(thick, diameter_m=0.024, thickness_m=2e-4, length_m=0.2)
    thin = replace(other, thickness_m=1e-4)
    assert condition_labels({"a": thick, "b": other}) == {"a": "12 mm", "b": "24 mm"}
    labels = condition_labels({"a": thick, "b": other, "c": thin})
    assert labels["b"] == "24 mm, 200 µm"
    assert labels["c"] == "24 mm, 100 µm"
    assert len(set(condition_labels({"a": thick, "b": thick}).values())) == 2


def test_lines_are_in_milliseconds_and_millimetres_and_thinned(campaign: Campaign) -> None:
    curves = simulate_curves(campaign, sized_model(campaign, choice_in_use(campaign)))
    shown = [0, 1, 2]
    lines, left = measured_lines(campaign, shown), residual_lines(campaign, curves, shown)
    assert lines["trial"] == [campaign.trials[i].name for i in shown]
    assert max(np.nanmax(part) for part in lines["ys"]) == pytest.approx(200, abs=1)
    assert all(len(part) <= 260 for part in lines["xs"])
    assert [len(part) for part in left["ys"]] == [len(part) for part in lines["ys"]]
    assert len(model_lines(campaign, curves, shown)["xs"]) == 2
    assert len(replicate_bands(campaign, shown)["xs"]) == 2
    assert len(range(*plotted_rows(10_000, 2000).indices(10_000))) <= 260


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


def test_each_vine_has_its_colour(campaign: Campaign) -> None:
    assert vine_colours(campaign) == [("measured", "#0072B2")]


def test_the_curves_are_exported_as_a_table_and_as_a_figure(campaign: Campaign) -> None:
    choice = choice_in_use(campaign)
    curves = simulate_curves(campaign, sized_model(campaign, choice))
    table = curve_table(campaign, choice, curves, range(6))
    assert tuple(table.columns) == CURVE_COLUMNS
    np.testing.assert_allclose(table["lead_position_m"] - table["model_position_m"], table["residual_m"], atol=1e-12)
    assert export_bytes(campaign, choice, curves, [0], "csv").decode().splitlines()[0] == ",".join(CURVE_COLUMNS)
    assert b"<svg" in export_bytes(campaign, choice, curves, range(6), "svg")
    assert export_bytes(campaign, choice, curves, [], "png").startswith(b"\x89PNG")
    with pytest.raises(ChoiceError, match="use one of csv"):
        export_bytes(campaign, choice, curves, [0], "xls")


def test_the_page_shows_the_command_that_reproduces_it(campaign: Campaign) -> None:
    start = choice_in_use(campaign)
    folder = campaign.folder.as_posix()
    assert commands(campaign, start, start, fitted=True) == [f"vinetrack compare {folder}"]
    more = start.with_effect("reservoir_depletion").with_effect("leak")
    assert commands(campaign, start, more, fitted=True, save=True) == [
        f"vinetrack add reservoir_depletion {folder} --save",
        f"vinetrack add leak {folder} --save",
    ]
    moved = start.with_effect("leak").with_size("leak.rate", 0.25)
    assert commands(campaign, start, moved, fitted=False) == [
        f"vinetrack explore {folder} --add leak --set leak.rate=0.25"
    ]
    own = replace(campaign, experiment=_with_model(campaign, ("leak",)))
    less = choice_in_use(own).with_effect("leak", False)
    assert commands(own, choice_in_use(own), less, fitted=True) == [f"vinetrack explore {folder} --drop leak --refit"]


def _with_model(campaign: Campaign, more: tuple[str, ...]) -> object:
    settings = campaign.experiment.settings
    return replace(campaign.experiment, settings=settings.model_copy(update={"model": (*settings.model, *more)}))


def test_a_model_has_a_short_name() -> None:
    base = ("pressure_drive", "gravity", "eversion_damping", "yield_pressure")
    assert model_text(base) == "base model"
    assert model_text((*base, "air_drag")) == "base model + air drag"
    assert model_text(("gravity",)) == "gravity"
