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
from vinetrack.core.records import Floats
from vinetrack.diagnosis import candidates as hypotheses
from vinetrack.diagnosis import misfit_tests as questions
from vinetrack.diagnosis.initial_fit import candidates_of, host_for
from vinetrack.diagnosis.misfit_tests import FIRST_LEVEL, MisfitTests, misfit_tests
from vinetrack.inference.fit import fit
from vinetrack.inference.position_errors import smooth_errors
from vinetrack.laboratory.tracks import BASE, Nature, grow
from vinetrack.laboratory.vine_campaigns import damping_values


def careful(payload_g: float, seed: int) -> Pairs:
    """Twenty-four trials of two vines that scatter by a tenth of a per cent, half of them with a payload."""
    loads = [(f"{trial.name}_{load:g}g", load, trial) for load in (0.0, payload_g) for trial in sheet()]
    trials = [replace(trial, name=name, payload_kg=1e-3 * load) for name, load, trial in loads]
    nature = Nature(
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
    return misfit_tests(found, hypotheses.testable(candidates, found.predictor.data)[0], FIRST_LEVEL)


@pytest.fixture
def without_doubts(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    def none(*about: Any) -> list[Floats]:
        return [np.zeros((trial.time_s.size, 0)) for trial in about[-1]]

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
    assert not asked(make()).something


@pytest.mark.parametrize("make", [misweighed, seen_crookedly])
@pytest.mark.usefixtures("without_doubts")
def test_unless_it_is_left_out(make):
    assert asked(make()).something


def test_positions_that_somebody_else_measured_are_as_sure_as_they_say():
    measured = [(replace(trial, video=None, position_systematic_m=0.0), track) for trial, track in seen_crookedly()]
    assert asked(measured).something


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
    assert not asked(through_a_lens(1e-4)).something
    assert asked(through_a_lens(0.0)).something


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
