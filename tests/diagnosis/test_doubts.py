"""What is never known exactly and shared by many trials does not pass for a missing effect."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hidden_truth import Pairs, sheet

import vinetrack as vt
from vinetrack.diagnosis import candidates as hypotheses
from vinetrack.diagnosis import misfit_tests as questions
from vinetrack.diagnosis.ladder import candidates_of, host_for
from vinetrack.diagnosis.misfit_tests import FALSE_ALARM_LEVEL_FIRST_ROUND, MisfitTests, misfit_tests
from vinetrack.diagnosis.score_test import fit_columns, informations_at, products_of, scores_of
from vinetrack.inference.fit import fit
from vinetrack.inference.position_errors import smooth_errors
from vinetrack.inference.robust_covariance import Systematics, systematics_of
from vinetrack.laboratory.tracks import BASE, GroundTruth, damping_values, grow


def careful(payload_g: float, seed: int) -> Pairs:
    """Twenty-four trials of two vines that scatter by a tenth of a per cent, half of them with a payload."""
    loads = [(f"{trial.name}_{load:g}g", load, trial) for load in (0.0, payload_g) for trial in sheet()]
    trials = [replace(trial, name=name, payload_kg=1e-3 * load) for name, load, trial in loads]
    nature = GroundTruth(
        effects=BASE,
        values=damping_values(trials),
        damping_scatter=1e-3,
        pressure_scatter=1e-3,
        yield_error_kPa=0.05,
        noise_m=2e-5,
        noise_correlation=0.0,
        seed=seed,
    )
    return [(one.stated, one.track) for one in grow(trials, nature)]


def asked(pairs: Pairs) -> MisfitTests:
    model = vt.base_model()
    candidates = candidates_of(model, None, None)
    found = fit(model, pairs, host=host_for(model, candidates), profile=False)
    return misfit_tests(found, hypotheses.testable(candidates, found.predictor.data)[0], FALSE_ALARM_LEVEL_FIRST_ROUND)


@pytest.fixture
def without_doubts(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    def none(*about: Any, film: bool) -> Systematics:  # noqa: ARG001
        return Systematics.none([trial.time_s.size for trial in about[-1]])

    monkeypatch.setattr(questions, "systematics_of", none)
    return


def misweighed() -> Pairs:
    """Payloads of 60 g of which the sheet says one per cent less."""
    return [(replace(trial, payload_kg=trial.payload_kg / 1.01), track) for trial, track in careful(60.0, 8)]


def seen_crookedly() -> Pairs:
    """Tracks that say of themselves that they err by 20 µm, and do, slowly and all alike."""

    def bent(position_m: np.ndarray) -> np.ndarray:
        grown_m = position_m - position_m[0]
        return position_m + 2e-5 * np.cos(2 * np.pi * grown_m / 0.28)

    return [
        (
            replace(trial, video=Path("filmed.mp4")),
            replace(
                track,
                lead_position_m=bent(track.lead_position_m),
                lead_position_sigma_m=np.full(track.time_s.size, 2e-5),
            ),
        )
        for trial, track in careful(0.0, 9)
    ]


@pytest.mark.parametrize("make", [misweighed, seen_crookedly])
def test_a_doubt_shared_by_trials_is_no_missing_effect(make):
    assert not asked(make()).rejects_model


@pytest.mark.parametrize("make", [misweighed, seen_crookedly])
@pytest.mark.usefixtures("without_doubts")
def test_unless_it_is_left_out(make):
    assert asked(make()).rejects_model


def test_positions_that_somebody_else_measured_are_as_sure_as_they_say():
    measured = [(replace(trial, video=None, position_systematic_m=0.0), track) for trial, track in seen_crookedly()]
    assert asked(measured).rejects_model


def through_a_lens(allowance_m: float) -> Pairs:
    """Tracks through a lens that displaces the edge by up to 0.1 mm (k₃ u³ for u of 0.14 m about the middle)."""
    k3 = 1e-4 / 0.14**3
    return [
        (
            replace(trial, position_systematic_m=allowance_m),
            replace(track, lead_position_m=track.lead_position_m + k3 * (track.lead_position_m - 0.14) ** 3),
        )
        for trial, track in careful(0.0, 10)
    ]


def test_a_lens_of_a_tenth_of_a_millimetre_is_no_physics_where_that_much_is_allowed_for():
    assert not asked(through_a_lens(1e-4)).rejects_model
    assert asked(through_a_lens(0.0)).rejects_model


def test_the_smooth_error_of_position_is_found_along_with_n_and_b():
    model = vt.base_model()
    found = fit(model, through_a_lens(1e-4), profile=False)
    smooth = smooth_errors(found.predictor, found.solution)
    assert smooth is not None
    trial = max(found.trials, key=lambda one: float(np.ptp(one.lead_position_m)))
    place = found.trials.index(trial)
    grown_m = trial.predicted_position_m - trial.origin_m
    bent_m = 1e-4 / 0.14**3 * ((grown_m - 0.14) ** 3 + 0.14**3)
    # What a factor of length does is also what B and pressure do: only the curvature shows.
    left = smooth.displacement_m[place] - bent_m
    line = np.polynomial.Polynomial.fit(grown_m, left, 1)(grown_m)
    assert np.std(left - line) < 0.5 * np.std(bent_m - np.polynomial.Polynomial.fit(grown_m, bent_m, 1)(grown_m))
    without = fit(model, through_a_lens(0.0), profile=False)
    assert found.log_likelihood > without.log_likelihood + 50
    assert found["n"].sigma > without["n"].sigma


def test_errors_that_few_trials_feel_count_as_if_every_trial_had_a_column_for_them() -> None:
    """One payload and one set pressure a trial, and the same with columns of zeros for all others."""
    questioned = asked([*careful(20.0, 8), *careful(60.0, 9)])
    fitted, answers = questioned.fit, questioned.sensitivities
    felt = systematics_of(fitted.predictor, fitted.solution, fitted.trials)
    assert felt.n_columns < felt.count
    wide = [np.zeros((len(columns), felt.count + 1)) for columns in felt.columns]
    for column, columns, places in zip(wide, felt.columns, felt.places, strict=True):
        column[:, places] = columns
    every = np.tile(np.arange(felt.count), (len(wide), 1))
    dense = products_of(
        fitted, fit_columns(fitted), answers, Systematics([column[:, :-1] for column in wide], every, felt.count)
    )
    one_by_one = scores_of(fitted, dense)
    for name in ("score", "information", "trial_scores", "trial_informations"):
        expected = getattr(one_by_one, name)
        assert np.allclose(
            getattr(questioned.scores, name), expected, rtol=1e-6, atol=1e-9 * np.max(np.abs(expected))
        ), name
    spreads = [(0.01, 0.03), (1e-3, 0.1)]
    assert np.allclose(
        informations_at(fitted, questioned.products, spreads), informations_at(fitted, dense, spreads), rtol=1e-6
    )
