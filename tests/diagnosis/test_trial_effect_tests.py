"""What trials take upon themselves, and what passes for noise, gives a model away that lacks something."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hidden_truth import Pairs, grown, sheet

import vinetrack as vt
from vinetrack.core.records import Trial
from vinetrack.diagnosis.misfit_tests import (
    CAREFUL_DAMPING_SCATTER,
    STRETCH_FRAMES,
    between_conditions_p,
    has_excess_scatter,
    noise_in_motion_p,
)
from vinetrack.experiment.schema import with_names
from vinetrack.inference.fit_result import Fit
from vinetrack.laboratory.tracks import BASE, GroundTruth, campaign, damping_values, grow, isometric_vine

WANDER_M = 2e-4


def fitted(pairs: Pairs) -> Fit:
    return vt.fit(vt.base_model(), pairs, profile=False)


def of_another_film(factors: dict[float, float], scatter: float = 0.02, trials: Sequence[Trial] = ()) -> Pairs:
    """Trials whose B is another at some of the pressures, kPa, alike in replicates but for some scatter."""
    pairs: Pairs = []
    for k, trial in enumerate(trials or sheet()):
        values = damping_values([trial])
        factor = factors.get(round(trial.pressure_Pa / 1e3), 1.0)
        by_vine = values["eversion_damping.B"]
        assert isinstance(by_vine, dict)
        values["eversion_damping.B"] = {vine: B * factor for vine, B in by_vine.items()}
        nature = GroundTruth(
            effects=BASE, values=values, damping_scatter=scatter, pressure_scatter=0.005, yield_error_kPa=0.1,
            noise_m=1e-4, noise_correlation=0.3, seed=40 + k,
        )  # fmt: skip
        pairs += [(one.stated, one.track) for one in grow([trial], nature)]
    return pairs


def wandering(*, at_rest: bool) -> Pairs:
    """Positions that wander slowly, in motion alone or all along."""
    draw = np.random.default_rng(3)
    pairs = grown(seed=31)
    spoilt = []
    for trial, track in pairs:
        kicks = draw.standard_normal(track.time_s.size)
        wander_m = np.zeros_like(kicks)
        for k in range(1, kicks.size):
            wander_m[k] = 0.9 * wander_m[k - 1] + WANDER_M * np.sqrt(1 - 0.9**2) * kicks[k]
        moves = track.lead_position_m > track.lead_position_m[:5].mean() + 2e-3
        begins = int(np.argmax(moves))
        wander_m[:begins] *= at_rest
        spoilt.append((trial, replace(track, lead_position_m=track.lead_position_m + wander_m)))
    return spoilt


def test_replicates_that_deviate_together_are_seen() -> None:
    assert between_conditions_p(fitted(of_another_film({20: 1.5, 22: 0.6}))) < 1e-5


@pytest.mark.slow
def test_replicates_that_scatter_are_not() -> None:
    assert all(between_conditions_p(fitted(grown(seed=seed))) > 0.05 for seed in (32, 33, 34))


def test_a_scatter_that_replicates_have_too_is_none_of_the_model() -> None:
    """Tubes of which no two are alike scatter as a model does that bends each trial, but not by condition."""
    trials = with_names(campaign(isometric_vine(4), (14, 17, 20, 24, 28, 33), 2, prefix="a"))
    loose = fitted(of_another_film({}, 0.08, trials))
    bent = fitted(of_another_film({17: 0.6, 24: 1.5}, 0.02, trials))
    assert min(loose.state.spread[1], bent.state.spread[1]) > CAREFUL_DAMPING_SCATTER
    assert not has_excess_scatter(loose)
    assert has_excess_scatter(bent)


@pytest.mark.parametrize("replicate", [0, 1])
def test_without_replicates_a_scatter_may_be_that_of_the_model(replicate: int) -> None:
    fit = fitted(of_another_film({}, 0.08)[replicate::2])
    assert len({trial.trial.condition for trial in fit.trials}) == len(fit.trials)
    assert fit.state.spread[1] > CAREFUL_DAMPING_SCATTER
    assert has_excess_scatter(fit)


def test_of_many_replicates_a_difference_that_care_allows_is_none_of_the_model() -> None:
    """Two in a hundred between conditions are significant among fifty replicates each, and no reason to search."""
    fit = fitted(of_another_film({}, 0.08, with_names(campaign(isometric_vine(4), (14, 17, 20, 24, 28, 33), 2))))
    draw = np.random.default_rng(20750)
    trials = [
        replace(trial, damping_deviation=float(np.expm1(0.05 * draw.standard_normal() + 0.02 * (-1) ** (k % 12 // 2))))
        for k, trial in enumerate(50 * fit.trials)
    ]
    assert not has_excess_scatter(replace(fit, trials=tuple(trials)))


def test_what_is_louder_in_motion_than_at_rest_is_heard() -> None:
    assert noise_in_motion_p(fitted(wandering(at_rest=False))) < 1e-5


@pytest.mark.slow
def test_noise_that_is_the_same_at_rest_is_noise() -> None:
    assert noise_in_motion_p(fitted(wandering(at_rest=True))) > 1e-2
    assert all(noise_in_motion_p(fitted(grown(seed=seed))) > 1e-2 for seed in (35, 36))


@pytest.mark.parametrize(("heavy", "most"), [(False, 0.02), (True, 0.04)])
def test_heavy_tails_alone_are_not_louder_in_motion(heavy: bool, most: float) -> None:
    """600 campaigns in which nothing differs: few alarms at 1 %, also where single stretches are far louder."""
    draw, alarms = np.random.default_rng(20732), 0
    for _ in range(600):
        white = draw.standard_normal((12, 16, STRETCH_FRAMES))
        if heavy:
            white /= np.sqrt(draw.chisquare(5, (12, 16, 1)) / 5)
        trials = [SimpleNamespace(whitened=one.ravel()) for one in white]
        data = SimpleNamespace(
            slow_m=None, gauge_error=0.0, n_rest=8 * STRETCH_FRAMES, noise_m=1e-4, lead_position_m=np.array([0.0, 0.3])
        )
        fit: Any = SimpleNamespace(trials=trials, predictor=SimpleNamespace(data=[data] * 12))
        alarms += noise_in_motion_p(fit) < 0.01
    assert alarms / 600 < most


def test_recordings_are_not_held_against_their_rest() -> None:
    filmed = []
    for trial, track in wandering(at_rest=False):
        stated = replace(track, lead_position_systematic_m=np.full(track.time_s.size, 1e-4))
        filmed.append((replace(trial, video=Path("filmed.mp4")), stated))
    assert noise_in_motion_p(fitted(filmed)) == 1.0
