"""The damping law once more under a model of the pressure, on vines from the virtual laboratory. Seed 41."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

import vinetrack as vt
from vinetrack.core.records import Track, Trial
from vinetrack.experiment.schema import with_names
from vinetrack.experiment.settings import RunSettings
from vinetrack.kinematics.summary import (
    LAW_COLUMNS,
    DampingLaw,
    TrialMotion,
    law_table,
    look_at_motions,
    redo_damping,
    summarise_trial,
)
from vinetrack.laboratory.tracks import (
    BASE,
    PAPER_B,
    PAPER_N,
    GroundTruth,
    damping_pressures_kPa,
    damping_values,
    grow,
    isometric_vine,
)
from vinetrack.laboratory.tracks import campaign as of_vine

SETTINGS = RunSettings.model_validate({"damping": {"resamples": 300}})


def running_down(seed: int) -> list[tuple[Trial, Track]]:
    """Two small vines on a chamber of 0.25 L: at the lowest pressure a third of it is lost along the way."""
    trials = [
        replace(trial, chamber_m3=2.5e-4)
        for scale in (1, 2)
        for trial in of_vine(isometric_vine(scale), damping_pressures_kPa(scale, 6), 3, prefix=f"R{scale}_")
    ]
    trials = list(with_names(trials))
    nature = GroundTruth(effects=(*BASE, "reservoir_depletion"), values=damping_values(trials), seed=seed)
    return [(one.stated, one.track) for one in grow(trials, nature)]


@pytest.fixture(scope="module")
def pairs() -> list[tuple[Trial, Track]]:
    return running_down(41)


@pytest.fixture(scope="module")
def motions(pairs: list[tuple[Trial, Track]]) -> list[TrialMotion]:
    return look_at_motions(pairs, SETTINGS)


@pytest.fixture(scope="module")
def before(motions: list[TrialMotion]) -> DampingLaw:
    return redo_damping(vt.base_model(), motions, SETTINGS)


@pytest.fixture(scope="module")
def after(pairs: list[tuple[Trial, Track]], motions: list[TrialMotion]) -> DampingLaw:
    found = vt.fit(vt.base_model() + vt.effects.reservoir_depletion, pairs, profile=False)
    return redo_damping(found.model, motions, SETTINGS)


def worst_B(law: DampingLaw, method: str) -> float:
    """Largest relative error of a B."""
    vines = law.laws[method]["vines"].values()
    return max(abs(vine["B"] / PAPER_B[round(vine["diameter_mm"] / 6)] - 1) for vine in vines)


def test_b_and_n_come_home_with_the_pressure_of_the_model(before: DampingLaw, after: DampingLaw) -> None:
    """With the set pressure nothing is steady and our rules refuse; the published rule goes on, and is wrong."""
    assert before.laws["both_axes"]["refused"]
    assert worst_B(before, "paper") > 0.1
    assert worst_B(after, "both_axes") < 0.03
    low, high = after.laws["both_axes"]["n_95"]
    assert low < PAPER_N < high


def test_trials_without_a_steady_window_get_a_quasi_steady_one(before: DampingLaw, after: DampingLaw) -> None:
    assert after.points["used"].sum() > before.points["used"].sum()


def test_it_is_what_a_run_with_that_model_gives(
    pairs: list[tuple[Trial, Track]], before: DampingLaw, after: DampingLaw
) -> None:
    """The road from a track to its row takes the same steps."""
    for k in (0, 20):
        point = summarise_trial(*pairs[k], SETTINGS, vt.base_model()).point
        assert point["x_ss_m_s"] == pytest.approx(before.points["x_ss_m_s"].iloc[k], nan_ok=True)
        assert point["force_N"] == pytest.approx(before.points["force_N"].iloc[k], nan_ok=True)
    assert tuple(after.points.columns) == tuple(before.points.columns)


def test_laws_before_and_after_stand_in_one_table(before: DampingLaw, after: DampingLaw) -> None:
    table = law_table({"base": before.laws, "base+reservoir_depletion": after.laws})
    assert tuple(table.columns) == LAW_COLUMNS
    home = table[(table["model"] != "base") & (table["method"] == "both_axes")]
    assert len(home) == 2
    assert set(table.loc[table["model"] == "base", "method"]) == {"paper"}
    assert np.all((home["B_low_95"] < home["B"]) & (home["B"] < home["B_high_95"]))


def test_a_trial_that_lacks_what_the_model_needs_is_left_out_with_the_reason(motions: list[TrialMotion]) -> None:
    blank = [replace(motions[0], trial=replace(motions[0].trial, chamber_m3=float("nan"))), *motions[1:]]
    law = redo_damping(vt.base_model() + vt.effects.reservoir_depletion, blank, SETTINGS)
    assert list(law.left_out) == [motions[0].trial.name]
    assert "chamber_l" in law.left_out[motions[0].trial.name]


def test_too_short_a_track_is_passed_over_and_none_at_all_is_refused(pairs: list[tuple[Trial, Track]]) -> None:
    trial, track = pairs[0]
    few = replace(track, lead_position_m=np.where(np.arange(track.time_s.size) < 4, track.lead_position_m, np.nan))
    motions = look_at_motions([(trial, few)], SETTINGS)
    assert motions == []
    with pytest.raises(ValueError, match="no trial"):
        redo_damping(vt.base_model(), motions, SETTINGS)


def test_a_law_that_was_refused_has_no_row(motions: list[TrialMotion]) -> None:
    law = redo_damping(vt.base_model(), motions[:2], SETTINGS)
    assert law.laws["both_axes"]["refused"]
    assert isinstance(law_table({"base": law.laws}), pd.DataFrame)
    assert law_table({"base": law.laws}).empty
