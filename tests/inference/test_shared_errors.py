"""Which part of an error all trials share, and how far a fit pulls the yield pressure from the sheet."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from lsoda_vine import small_campaign

import vinetrack as vt
from vinetrack.diagnosis.drift import against_the_sheet
from vinetrack.inference import optimiser
from vinetrack.inference.fit_result import Fit, Number
from vinetrack.inference.optimiser import solve


def fitted(seed: int = 1, replicates: int = 3, **changes: float) -> Fit:
    pairs, _ = small_campaign(seed, damping=5e-3, pressure=2e-3, replicates=replicates)
    return vt.fit(vt.base_model(), [(replace(trial, **changes), track) for trial, track in pairs], profile=False)


def test_the_lens_adds_to_the_error_what_is_said_to_be_its_part():
    exact, bent = fitted(position_systematic_m=0.0), fitted(position_systematic_m=2e-4)
    assert "lens" not in exact["n"].shared
    added = bent["n"].sigma ** 2 - exact["n"].sigma ** 2
    # The lens also widens the scatter of trials, which is counted there.
    assert 0.5 * added < bent["n"].shared["lens"] ** 2 < added


def test_what_trials_share_stays_where_their_number_grows():
    few, many = fitted(replicates=2), fitted(replicates=8)
    for one, other in zip(few.numbers, many.numbers, strict=True):
        assert other.shared["set pressures"] >= one.shared["set pressures"]
        assert other.sigma < one.sigma
        assert Number.from_json(one.to_json()).shared == one.shared


def test_a_yield_pressure_is_pulled_by_what_the_fit_adds_to_the_sheet():
    """The sheet's value is part of the fitted one: the difference has its variance less that of the fit."""
    rng, z = np.random.default_rng(3), []
    for seed in range(12):
        pairs, _ = small_campaign(seed, damping=5e-3, pressure=2e-3, replicates=3)
        stated = {vine: 3e3 + 300.0 * rng.standard_normal() for vine in dict.fromkeys(trial.vine for trial, _ in pairs)}
        told = {vine: {"yield_pressure_Pa": P_y, "yield_pressure_sigma_Pa": 300.0} for vine, P_y in stated.items()}
        misread = [(replace(trial, **told[trial.vine]), track) for trial, track in pairs]
        fit = vt.fit(vt.base_model(), misread, profile=False)
        z += [test.row["z"] for test in against_the_sheet(fit)]
    assert math.sqrt(np.mean(np.square(z))) == pytest.approx(1.0, abs=0.3)


def test_a_fit_that_no_step_improves_far_from_its_optimum_has_not_converged(monkeypatch):
    fit = fitted()
    start = replace(fit.solution.state, theta=fit.solution.state.theta + 0.5)
    monkeypatch.setattr(optimiser, "_accepted_step", lambda *_, **__: (None, 0.0))
    assert not solve(fit.predictor, fit.solution.problem, start, warm=True).converged
    assert solve(fit.predictor, fit.solution.problem, fit.solution.state, warm=True).converged
