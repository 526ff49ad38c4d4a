"""Parameters that drift with conditions on which they should not depend, on vines from the virtual laboratory.

Seeds 100 to 140 and 300 to 347 were looked at while the tests of drift were built; those here, from 51, score.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from counted import trajectories
from grown import Pairs, grown, pairs_of, sheet

import vinetrack as vt
from vinetrack.diagnosis import drift as drift_along
from vinetrack.diagnosis.drift import DRIFT_COLUMNS, GROUP_COLUMNS, Drift, drift
from vinetrack.diagnosis.replicates import align_trials, per_trial_estimates
from vinetrack.dynamics.model import Model
from vinetrack.inference.fit_result import Fit

B = "eversion_damping.B"


def fitted(pairs: Pairs, model: Model | None = None) -> Fit:
    return vt.fit(model or vt.base_model(), pairs, profile=False)


@pytest.fixture(scope="module")
def emptying() -> Pairs:
    """Vines on a chamber that nothing refills."""
    return pairs_of(grown(sheet(), 51, ["reservoir_depletion"]))


@pytest.fixture(scope="module")
def depleting(emptying: Pairs) -> Drift:
    """n and the yield pressures are free, and take what they can upon themselves."""
    return drift(fitted(emptying))


@pytest.fixture(scope="module")
def stretching() -> Drift:
    """Vines whose wall gives way: the higher the pressure, the wider and faster they are."""
    return drift(fitted(pairs_of(grown(sheet(), 51, ["wall_stretch"]))))


@pytest.mark.parametrize("seed", [52, 53, 54])
def test_where_nothing_is_missing_nothing_drifts(seed: int) -> None:
    found = drift(fitted(pairs_of(grown(sheet(), seed))))
    assert found.sentences == ()
    assert found.table["z"].max() < 3


def test_b_that_makes_up_for_a_wall_that_stretches_knows_the_pressure(stretching: Drift) -> None:
    table = stretching.table
    row = table[(table["against"] == "pressure_Pa") & table["vine"].str.startswith("24mm")].iloc[0]
    assert row["significant"]
    assert (row["from_level"], row["to_level"]) == (48e3, 24e3)
    assert row["change"] > 5 * row["change_sigma"] > 0
    assert any("B" in said and "to 24 kPa of pressure" in said for said in stretching.sentences)


def test_the_groups_behind_it_fall_with_the_pressure(stretching: Drift) -> None:
    groups = stretching.groups[stretching.groups["against"] == "pressure_Pa"]
    of_b = groups[groups["vine"].str.startswith("24mm")].sort_values("level")
    assert of_b["level"].tolist() == [24e3, 30e3, 38e3, 48e3]
    assert np.all(np.diff(of_b["ratio"]) < 0)
    assert np.all(of_b["ratio_sigma"] > 0.005)


def test_b_that_makes_up_for_an_emptying_chamber_grows_along_the_way(depleting: Drift) -> None:
    rows = depleting.table[depleting.table["against"] == "growth"]
    assert rows["significant"].all()
    assert (rows["to_level"] > rows["from_level"]).all()
    assert any("larger in the second half of the growth" in said for said in depleting.sentences)


def test_a_trial_that_stands_still_in_one_half_of_its_way_says_nothing_of_b(monkeypatch: pytest.MonkeyPatch) -> None:
    found = fitted(pairs_of(grown(sheet((4,), replicates=2), 58)))
    laid = align_trials(found)
    values = per_trial_estimates(found, B, laid)
    halves = drift_along._halves(found, laid, values.trial_effects)
    spoilt = halves.deviation.copy()
    spoilt[0, 1] = 1000.0
    monkeypatch.setattr(drift_along, "_halves", lambda *_: replace(halves, deviation=spoilt))
    (tested,) = drift_along.along_growth(found, laid, values)
    assert tested.row["n_trials"] == len(found.trials) - 1
    assert 0 <= tested.row["change"] < 0.1


def test_a_yield_pressure_pulled_from_the_sheet_is_said(depleting: Drift) -> None:
    row = depleting.table[depleting.table["against"] == "sheet"].iloc[0]
    assert row["significant"]
    assert abs(row["change"]) == pytest.approx(row["z"] * 200.0)
    assert any("of the sheet to" in said for said in depleting.sentences)


def test_the_tables_have_their_columns_and_the_most_significant_first(depleting: Drift) -> None:
    assert tuple(depleting.table.columns) == DRIFT_COLUMNS
    assert tuple(depleting.groups.columns) == GROUP_COLUMNS
    best = np.maximum(depleting.table["z"], depleting.table["z_constancy"]).to_numpy()
    assert best[0] == best.max()


def test_a_friction_on_the_payload_makes_b_know_the_payload() -> None:
    trials = sheet((4,), payloads_g=(0.0, 30.0, 60.0), replicates=2)
    found = drift(fitted(pairs_of(grown(trials, 55, ["payload_friction"], {"payload_friction.mu_p": 1.2}))))
    row = found.table[(found.table["parameter"] == B) & (found.table["against"] == "payload_kg")].iloc[0]
    assert row["significant"]
    assert (row["from_level"], row["to_level"]) == pytest.approx((0.0, 0.06))


def test_every_trial_finds_the_b_it_was_grown_with() -> None:
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


def test_a_number_that_all_share_is_asked_whether_it_suits_every_vine() -> None:
    """The sheet says 3.7 L, but the wide vine was grown on 2.8 L: alone it would have 1.32 for the true γ of 1.

    Behind a known lens: where smooth errors of position are allowed for, they hide this difference.
    """
    isothermal = {"reservoir_depletion.gamma": 1.0}
    narrow = [trial for trial in sheet() if trial.diameter_m < 0.02]
    wide = [trial for trial in sheet(chamber_m3=2.8e-3) if trial.diameter_m > 0.02]
    virtual = [one for part in (narrow, wide) for one in grown(part, 57, ["reservoir_depletion"], isothermal)]
    rig = {"chamber_m3": 3.7e-3, "position_systematic_m": 0.0}
    pairs = [(replace(trial, **rig), track) for trial, track in pairs_of(virtual)]
    found = drift(fitted(pairs, vt.base_model() + vt.effects.reservoir_depletion))
    row = found.table[(found.table["parameter"] == "reservoir_depletion.gamma") & (found.table["against"] == "vine")]
    assert row["significant"].iloc[0]
    values = found.groups[found.groups["parameter"].str.endswith("gamma") & (found.groups["against"] == "vine")]
    assert sorted(values["value"]) == pytest.approx([1.0, 1.32], abs=0.08)
    assert any(said.startswith("γ differs between the vines") for said in found.sentences)


def test_vines_of_different_exponents_are_told() -> None:
    trials = sheet()
    one = [trial for trial in trials if trial.diameter_m < 0.02]
    other = [trial for trial in trials if trial.diameter_m > 0.02]
    pairs = pairs_of([*grown(one, 58, values={"eversion_damping.n": 0.3}), *grown(other, 58)])
    found = drift(fitted(pairs))
    row = found.table[found.table["parameter"] == "eversion_damping.n"].iloc[0]
    assert row["significant"]
    values = found.groups[found.groups["parameter"] == "eversion_damping.n"]["value"]
    assert np.ptp(values) == pytest.approx(0.07, abs=0.03)


def test_without_replicates_the_line_itself_says_how_values_scatter() -> None:
    def once(seed: int, *effects: str) -> Drift:
        return drift(fitted(pairs_of(grown(sheet(replicates=1), seed, effects))))

    assert once(59).sentences == ()
    table = once(59, "reservoir_depletion").table
    assert table["significant"].any()
    against_pressure = table[(table["against"] == "pressure_Pa") & (table["vine"] != "")]
    assert set(against_pressure["dof"]) == {2}


def test_a_body_that_falls_has_nothing_to_drift() -> None:
    from lsoda_vine import as_track

    from vinetrack.core.records import Trial

    draw = np.random.default_rng(60)
    time_s = np.arange(120) / 240
    pairs = [
        (
            Trial(name=f"b{k}", vine="b", condition="c", travel_ratio=1.0, pressure_Pa=0.0, yield_pressure_Pa=0.0,
                  payload_kg=2.7e-3),
            as_track(time_s, 0.5 * 9.8 * np.maximum(time_s - 0.05, 0) ** 2 + 2e-4 * draw.standard_normal(120)),
        )
        for k in range(3)
    ]  # fmt: skip
    found = vt.fit(vt.make_model(["gravity"]), pairs, free=["gravity.g"], profile=False)
    assert drift(found).sentences == ()


def test_24_trials_are_asked_with_fewer_trajectories_than_a_fit_takes(monkeypatch: pytest.MonkeyPatch) -> None:
    simulated = trajectories(monkeypatch)
    found = fitted(pairs_of(grown(sheet(), 51)))
    for_the_fit = sum(simulated)
    simulated.clear()
    drift(found)
    assert 0 < sum(simulated) < for_the_fit
