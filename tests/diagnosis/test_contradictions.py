"""What the ladder of errors and drifting parameters say against a verdict reaches the reader."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from hidden_truth import grown, sheet

import vinetrack as vt
from vinetrack.core.records import Track, Trial
from vinetrack.diagnosis.remarks import remark
from vinetrack.diagnosis.selection import contradictions, displacement_m, is_within_position_errors
from vinetrack.inference.fit import fit, refit
from vinetrack.inference.fit_result import Fit
from vinetrack.laboratory.tracks import BASE, GroundTruth, damping_values, grow


@pytest.fixture(scope="module")
def plain() -> Fit:
    return fit(vt.base_model(), grown(seed=51), profile=False)


def exponents_apart(by: float) -> list[tuple[Trial, Track]]:
    """Two vines that the sheet lets share one n, and whose n differ."""
    pairs = []
    for prefix, change in (("a", -by / 2), ("b", by / 2)):
        trials = [trial for trial in sheet() if trial.name.startswith(prefix)]
        values = {**damping_values(trials), "eversion_damping.n": 0.37 + change}
        nature = GroundTruth(
            effects=BASE, values=values, damping_scatter=5e-3, pressure_scatter=1e-3, noise_m=3e-5, seed=9
        )
        pairs += [(one.stated, one.track) for one in grow(trials, nature)]
    return pairs


def errors(*left_out_m: float) -> pd.DataFrame:
    return pd.DataFrame({"rms_left_out_m": left_out_m})


def test_an_effect_that_predicts_no_condition_better_is_said_to(plain: Fit) -> None:
    (told,) = contradictions((plain,), ("latch_release",), errors(4.09e-3, 4.09e-3))
    assert told == remark("left_out_error_does_not_fall", name="latch_release", without_m=4.09e-3, with_m=4.09e-3)
    assert contradictions((plain,), ("latch_release",), errors(4.09e-3, 3.2e-3)) == ()
    assert contradictions((plain,), ("latch_release",), errors(4.09e-3, np.nan)) == ()


def test_a_model_that_holds_is_not_contradicted(plain: Fit) -> None:
    assert contradictions((plain,), (), None) == ()


def test_n_that_differs_between_vines_contradicts_an_adequate_model() -> None:
    found = fit(vt.base_model(), exponents_apart(0.06), profile=False)
    assert {told.code for told in contradictions((found,), (), None)} == {"still_drifts"}


def test_an_effect_counts_as_within_position_errors_only_if_small_and_no_help(plain: Fit) -> None:
    model = plain.model + vt.effects.tail_friction
    after = refit(plain, model, thorough=False)
    moved_m = displacement_m(plain, after)
    assert 0 < moved_m < 1e-3
    differences = [
        np.abs(one.predicted_position_m - other.predicted_position_m).max()
        for one, other in zip(plain.trials, after.trials, strict=True)
    ]
    assert moved_m == pytest.approx(np.sqrt(np.mean(np.square(differences))))
    assert not is_within_position_errors(_known_to(plain, 0.5 * moved_m), after)
    # Nothing is missing: fitted to the noise, tail friction predicts left-out conditions worse.
    assert is_within_position_errors(_known_to(plain, 2 * moved_m), after)


def _known_to(found: Fit, systematic_m: float) -> Fit:
    """The same fit, its positions stated to have smooth errors of this size."""
    data = [replace(item, position_systematic_m=systematic_m) for item in found.predictor.data]
    predictor = found.predictor
    other = type(predictor)(predictor.layout, data, predictor.host)
    return replace(found, predictor=other)
