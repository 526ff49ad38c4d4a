"""A fit whose next state cannot be simulated keeps the last one."""

from __future__ import annotations

import numpy as np
import pytest
from test_pressurised_in_recording import campaign

import vinetrack as vt
from vinetrack.core.records import Floats
from vinetrack.dynamics.simulate import SimulationError
from vinetrack.inference.sensitivity import Predictor


def test_a_fit_keeps_its_last_state_if_the_next_one_cannot_be_simulated(monkeypatch: pytest.MonkeyPatch):
    whole, calls = Predictor.linearise, []

    def breaks_later(self: Predictor, theta: Floats, own: Floats, *, trial_effects_only: bool = False) -> list[Floats]:
        calls.append(trial_effects_only)
        if not trial_effects_only and calls.count(False) > 2:
            raise SimulationError("Trial slow0: the model could not be integrated beyond 0.3 s.")
        return whole(self, theta, own, trial_effects_only=trial_effects_only)

    monkeypatch.setattr(Predictor, "linearise", breaks_later)
    fit = vt.fit(vt.base_model(), campaign()[:1], profile=False, thorough=False)
    assert not fit.converged
    assert np.isfinite(fit["n"].value)
