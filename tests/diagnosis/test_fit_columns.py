"""A fit is tested with sensitivities past the end of growth or, where they cannot be computed, with its last ones."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import vinetrack as vt
from vinetrack.diagnosis.score_test import fit_columns
from vinetrack.dynamics.simulate import SimulationError


def test_a_fit_whose_neighbours_cannot_be_simulated_is_tested_with_its_last_columns(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    fit = vt.fit(vt.base_model(), vt.example_tracks(), profile=False, thorough=False)
    before = fit_columns(fit)

    def cannot(*_: object, **__: object) -> None:
        raise SimulationError("Trial t: the model could not be integrated beyond 3.7 s.")

    monkeypatch.setattr(fit.predictor, "linearise", cannot)
    columns = fit_columns(replace(fit))
    assert len(columns) == len(before)
    for known, fresh in zip(columns, before, strict=True):
        assert np.allclose(known[:, -1], fresh[:, -1], atol=1e-12)
        # Where growth ends a step changes more than a derivative says.
        usual = np.median(np.abs(known - fresh), axis=0)
        assert np.all(usual <= 0.02 * np.max(np.abs(fresh), axis=0))
