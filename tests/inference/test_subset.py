"""Fits to a subset of the trials, started from the fit of all, compared with fits from scratch. Seed 21."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from counted import trajectories
from lsoda_vine import small_campaign

import vinetrack as vt
from vinetrack.core.records import Track, Trial
from vinetrack.inference.fit import fit_subset, predict_prepared, predict_trials
from vinetrack.inference.fit_data import FitError
from vinetrack.inference.fit_result import Fit

Pairs = list[tuple[Trial, Track]]


@pytest.fixture(scope="module")
def pairs() -> Pairs:
    return small_campaign(seed=21, replicates=3)[0]


@pytest.fixture(scope="module")
def whole(pairs: Pairs) -> Fit:
    return vt.fit(vt.base_model(), pairs, profile=False)


def test_leaving_out_a_condition_agrees_with_a_fit_from_scratch(whole: Fit, pairs: Pairs) -> None:
    gone = pairs[0][0].condition
    rest = [pair for pair in pairs if pair[0].condition != gone]
    warm = fit_subset(whole, [trial.name for trial, _ in rest])
    cold = vt.fit(vt.base_model(), rest, profile=False)
    assert [trial.name for trial in warm.trials] == [trial.name for trial, _ in rest]
    for one, other in zip(warm.numbers, cold.numbers, strict=True):
        assert one.name == other.name
        assert abs(one.value - other.value) < 0.1 * other.sigma
        assert one.sigma == pytest.approx(other.sigma, rel=0.05)


def test_the_parameters_of_a_vine_that_is_left_out_are_dropped(whole: Fit, pairs: Pairs) -> None:
    stays = pairs[0][0].vine
    alone = fit_subset(whole, [trial.trial.vine == stays for trial in whole.trials])
    assert {number.vine for number in alone.numbers} == {"", stays}
    other = next(pair for pair in pairs if pair[0].vine != stays)
    with pytest.raises(FitError, match="cannot be predicted"):
        vt.predict(alone, [other])


def test_with_all_trials_the_fit_is_unchanged(whole: Fit) -> None:
    again = fit_subset(whole, [True] * len(whole.trials))
    for one, other in zip(again.numbers, whole.numbers, strict=True):
        assert abs(one.value - other.value) < 0.05 * other.sigma


def test_a_fixed_parameter_stays(whole: Fit, pairs: Pairs) -> None:
    stays = pairs[0][0].vine
    names = [trial.name for trial in whole.trials if trial.trial.vine == stays]
    held = fit_subset(whole, names, held=["eversion_damping.n", f"yield_pressure.P_y[{stays}]"])
    assert held["n"].value == whole["n"].value
    assert held[f"yield_pressure.P_y[{stays}]"].value == whole[f"yield_pressure.P_y[{stays}]"].value
    free = fit_subset(whole, names)
    assert held[f"eversion_damping.B[{stays}]"].sigma < 0.8 * free[f"eversion_damping.B[{stays}]"].sigma


def test_variance_components_can_be_fixed(whole: Fit) -> None:
    names = [trial.name for trial in whole.trials][:15]
    held = fit_subset(whole, names, hold_spreads=True, hold_noise=True)
    assert [held.spreads[k].value for k in ("pressure", "B")] == [whole.spreads[k].value for k in ("pressure", "B")]
    assert held.noise_correlation == whole.noise_correlation


def test_noise_fixed_by_the_user_is_kept(pairs: Pairs) -> None:
    told = vt.fit(vt.base_model(), pairs, profile=False, noise=(2e-4, 0.3))
    part = fit_subset(told, [trial.name for trial, _ in pairs[:9]])
    assert part.noise_m == pytest.approx(2e-4)
    assert part.noise_correlation == 0.3


def test_a_host_model_continues_to_serve(pairs: Pairs) -> None:
    host = vt.base_model() + vt.effects.linear_damping
    hosted = vt.fit(vt.base_model(), pairs, profile=False, host=host)
    part = fit_subset(hosted, [trial.name for trial, _ in pairs[:9]])
    assert part.predictor.host is host


def test_unknown_trials_and_none_at_all_are_refused(whole: Fit) -> None:
    with pytest.raises(FitError, match="no trial elsewhere"):
        fit_subset(whole, ["elsewhere"])
    with pytest.raises(FitError, match="keep one"):
        fit_subset(whole, [False] * len(whole.trials))
    with pytest.raises(FitError, match="mask has 2"):
        fit_subset(whole, [True, False])


def test_prepared_trials_are_predicted_as_if_read_again(whole: Fit, pairs: Pairs) -> None:
    again, anew = (
        predict_prepared(whole, whole.predictor.data, from_rest=True),
        predict_trials(whole, pairs, from_rest=True),
    )
    assert [one.release_s for one in again] == pytest.approx([one.release_s for one in anew], abs=1e-9)


def test_a_part_is_fitted_with_a_quarter_of_the_trajectories_of_a_fit(
    whole: Fit, pairs: Pairs, monkeypatch: pytest.MonkeyPatch
) -> None:
    simulated = trajectories(monkeypatch)
    vt.fit(vt.base_model(), pairs, profile=False)
    from_scratch = sum(simulated)
    conditions = dict.fromkeys(trial.trial.condition for trial in whole.trials)
    simulated.clear()
    for condition in conditions:
        keep = [trial.trial.condition != condition for trial in whole.trials]
        fit_subset(whole, keep, hold_spreads=True, hold_noise=True)
    assert sum(simulated) / len(conditions) < 0.25 * from_scratch


def test_yield_pressures_without_error_are_no_parameters(pairs: Pairs) -> None:
    exact = [(replace(trial, yield_pressure_sigma_Pa=0.0), track) for trial, track in pairs[:12]]
    found = vt.fit(vt.base_model(), exact, profile=False)
    part = fit_subset(found, [trial.name for trial, _ in exact[:9]])
    assert [number.key for number in part.numbers] == [number.key for number in found.numbers]
    assert np.isfinite(part.log_likelihood)
