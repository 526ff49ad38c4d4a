"""Where a model fails and which of its numbers drift, on vines from the virtual laboratory."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from grown import Pairs, grown, pairs_of, sheet

import vinetrack as vt
from vinetrack.diagnosis.drift import drift
from vinetrack.diagnosis.locate import locate
from vinetrack.diagnosis.replicates import align_trials, per_trial_estimates
from vinetrack.diagnosis.selection import contradictions
from vinetrack.inference.fit_result import Fit

B = "eversion_damping.B"


def fitted(pairs: Pairs) -> Fit:
    return vt.fit(vt.base_model(), pairs, profile=False)


@pytest.fixture(scope="module")
def emptying():
    """Vines on a chamber that nothing refills, without it."""
    return fitted(pairs_of(grown(sheet(), 51, ["reservoir_depletion"])))


def test_b_that_makes_up_for_a_wall_that_stretches_knows_the_pressure():
    """The higher the pressure, the wider and faster a vine is whose wall gives way."""
    table = drift(fitted(pairs_of(grown(sheet(), 51, ["wall_stretch"])))).table
    row = table[(table["against"] == "pressure_Pa") & table["vine"].str.startswith("24mm")].iloc[0]
    assert row["significant"]
    assert (row["from_level"], row["to_level"]) == (48e3, 24e3)
    assert row["change"] > 5 * row["change_sigma"] > 0


@pytest.mark.slow
def test_b_that_makes_up_for_an_emptying_chamber_grows_along_the_way(emptying):
    """n and the yield pressures are free, and take what they can upon themselves."""
    found = drift(emptying)
    rows = found.table[found.table["against"] == "growth"]
    assert rows["significant"].all()
    assert (rows["to_level"] > rows["from_level"]).all()
    best = np.maximum(found.table["z"], found.table["z_constancy"]).to_numpy()
    assert best[0] == best.max()


def test_every_trial_finds_the_b_it_was_grown_with():
    virtual = grown(sheet(replicates=2), 56, pressure_scatter=0.0)
    found = fitted(pairs_of(virtual))
    values = per_trial_estimates(found, B, align_trials(found))
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
    assert {told.code for told in contradictions((fit,), (), None)} == {"still_drifts"}
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
def test_an_emptying_chamber_makes_it_fail(emptying):
    failing = locate(emptying)
    assert failing.fails
    worst = failing.by_condition.iloc[0]
    assert worst["rms_m"] == failing.by_condition["rms_m"].max()
    assert failing.by_condition["z"].max() > 3.5
    together = failing.along_position[failing.along_position["condition"] == ""]
    assert set(together["vine"]) == set(failing.by_condition["vine"])
    assert together["n_trials"].max() == 12


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
