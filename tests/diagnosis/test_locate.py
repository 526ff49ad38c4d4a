"""Where a model fails by more than the scatter of replicates, on vines from the virtual laboratory.

Seeds 7 and 200 to 231 were looked at while the errors were built; those here, from 71, score.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from counted import trajectories
from grown import Pairs, grown, pairs_of, sheet

import vinetrack as vt
from vinetrack.diagnosis.locate import (
    CONDITION_COLUMNS,
    POSITION_COLUMNS,
    SPEED_COLUMNS,
    TIME_COLUMNS,
    Failure,
    locate,
)


def located(pairs: Pairs) -> Failure:
    return locate(vt.fit(vt.base_model(), pairs, profile=False))


@pytest.fixture(scope="module")
def depleting() -> Failure:
    return located(pairs_of(grown(sheet(), 71, ["reservoir_depletion"])))


@pytest.fixture(scope="module")
def complete() -> list[Failure]:
    """Campaigns with nothing missing; in the third the noise remembers itself, in the fourth trials scatter little."""
    nuisances = [{}, {}, {"noise_correlation": 0.6}, {"damping_scatter": 0.005, "pressure_scatter": 0.002}]
    return [located(pairs_of(grown(sheet(), 72 + k, **more))) for k, more in enumerate(nuisances)]


def test_where_nothing_is_missing_it_fails_nowhere_and_says_so(complete: list[Failure]) -> None:
    for found in complete:
        assert not found.fails
        assert found.sentences()[0].startswith("In no condition does the mean of the replicates deviate")


def test_errors_of_the_mean_residual_are_as_large_as_replicates_make_them(complete: list[Failure]) -> None:
    """Not the smaller one of a thousand independent frames: with that, these would stray by 20 of them."""
    for name in ("along_time", "along_position", "along_speed"):
        z = np.concatenate([getattr(found, name)["z"] for found in complete])
        assert 0.4 < np.sqrt(np.mean(z**2)) < 1.3
        assert np.mean(np.abs(z) > 3) < 0.02


def test_three_times_the_frames_make_no_error_smaller() -> None:
    few, many = (located(pairs_of(grown(sheet(capture_fps=fps), 76))).along_position for fps in (700.0, 2100.0))
    assert np.median(many["sigma_m"]) == pytest.approx(np.median(few["sigma_m"]), rel=0.2)


def test_an_emptying_chamber_makes_it_fail_and_the_words_say_where(depleting: Failure) -> None:
    assert depleting.fails
    worst = depleting.by_condition.iloc[0]
    assert worst["rms_m"] == depleting.by_condition["rms_m"].max()
    assert depleting.by_condition["z"].max() > 3.5
    assert any("B" in said and "pressure" in said for said in depleting.sentences()[1:])


def test_the_tables_have_their_columns(depleting: Failure) -> None:
    assert tuple(depleting.by_condition.columns) == CONDITION_COLUMNS
    assert tuple(depleting.along_time.columns) == TIME_COLUMNS
    assert tuple(depleting.along_position.columns) == POSITION_COLUMNS
    assert tuple(depleting.along_speed.columns) == SPEED_COLUMNS
    together = depleting.along_position[depleting.along_position["condition"] == ""]
    assert set(together["vine"]) == set(depleting.by_condition["vine"])
    assert together["n_trials"].max() == 12


def test_a_misfit_of_one_condition_is_found_there_with_its_size_and_sign() -> None:
    """Eight millimetres ahead in the middle of the growth of one condition, by hand."""
    pairs = pairs_of(grown(sheet((4,)), 77, damping_scatter=0.005, pressure_scatter=0.002))
    chosen = pairs[4][0].condition
    bent = []
    for trial, track in pairs:
        y = track.lead_position_m - track.lead_position_m[:5].mean()
        bump = 8e-3 * np.exp(-0.5 * ((y - 0.14) / 0.03) ** 2) * (trial.condition == chosen)
        bent.append((trial, replace(track, lead_position_m=track.lead_position_m + bump)))
    found = located(bent)
    worst = found.by_condition.iloc[0]
    assert worst["condition"] == chosen
    assert worst["worst_residual_m"] == pytest.approx(7e-3, abs=3e-3)
    there = found.along_position[found.along_position["condition"] == chosen]
    best = there.loc[there["mean_residual_m"].idxmax()]
    assert 0.1 < best["lead_position_m"] < 0.18


def test_single_trials_are_judged_by_the_scatter_of_the_fit() -> None:
    found = located(pairs_of(grown(sheet(replicates=1), 78)))
    assert found.scatter.dof == 0
    assert not found.fails
    assert found.by_condition["floor_m"].isna().all()


def test_24_trials_are_located_with_fewer_trajectories_than_a_fit_takes(monkeypatch: pytest.MonkeyPatch) -> None:
    simulated = trajectories(monkeypatch)
    found = vt.fit(vt.base_model(), pairs_of(grown(sheet(), 72)), profile=False)
    for_the_fit = sum(simulated)
    simulated.clear()
    locate(found)
    assert 0 < sum(simulated) < for_the_fit
