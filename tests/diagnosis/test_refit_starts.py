"""A refit finds an effect from a start that misses by far more than noise, wherever the fit before had its releases."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hidden_truth import grown

import vinetrack as vt
import vinetrack.inference.fit
from vinetrack.diagnosis import candidate_fits
from vinetrack.diagnosis.candidate_fits import SubsetFitter, full_fit
from vinetrack.diagnosis.likelihood_ratio import LikelihoodRatio
from vinetrack.diagnosis.remarks import Remark
from vinetrack.effects import find_effect
from vinetrack.inference.parameters import YIELD_PRESSURE
from vinetrack.inference.solving import solve_onward

HIDDEN = {
    "pressure_damping": ({"pressure_damping.beta": 1.5e-5}, {}),
    "latch_release": (
        {"latch_release.F": 0.6, "latch_release.reach": 0.015},
        {"latch_release.F": 0.3, "latch_release.reach": 0.01},
    ),
}


@pytest.mark.parametrize("name", HIDDEN)
def test_a_hidden_effect_is_found_from_where_the_model_without_it_ended(name):
    values, start = HIDDEN[name]
    base = vt.fit(vt.base_model(), grown(values, seed=31), profile=False)
    found = vt.refit(base, base.model + getattr(vt.effects, name), start=start)
    assert found.log_likelihood > base.log_likelihood + 10
    assert found.chi2_per_dof < 1.3
    for key, size in values.items():
        assert abs(found[key].value - size) < 4 * found[key].sigma


def test_a_full_fit_begins_at_the_yield_pressures_that_a_part_of_the_trials_found(monkeypatch):
    """A friction at rest beside the yield pressure that was found without it would hold the vine back altogether."""
    begun = []

    def watched(predictor, before, theta, *held, **more):
        layout = predictor.layout
        begun.append(dict(zip((number.name for number in layout.free), layout.values(theta), strict=True)))
        return solve_onward(predictor, before, theta, *held, **more)

    base = vt.fit(vt.base_model(), grown({"pressure_damping.beta": 1.5e-5}, seed=33), profile=False)
    climb = SubsetFitter(base).fit_hypothesis(
        (vt.effects.pressure_damping,), {"pressure_damping.beta": 1e-5}, iterations=9
    )
    yields_Pa = {number.name: number.value for number in base.numbers if number.key == YIELD_PRESSURE}
    assert climb.yields_Pa.keys() == yields_Pa.keys()
    assert any(abs(climb.yields_Pa[name] - value) > 1.0 for name, value in yields_Pa.items())
    monkeypatch.setattr(vinetrack.inference.fit, "solve_onward", watched)
    assert full_fit(base, climb) is not None
    for name, value in climb.yields_Pa.items():
        assert begun[0][name] == pytest.approx(value)


def test_an_effect_that_adds_nothing_makes_no_fit_worse():
    base = vt.fit(vt.base_model(), grown(seed=32), profile=False)
    for name in HIDDEN:
        found = vt.refit(base, base.model + getattr(vt.effects, name))
        assert found.log_likelihood > base.log_likelihood - 0.5
        assert np.isfinite(found.chi2_per_dof)


@pytest.mark.parametrize(("gained", "kept"), [(-0.5, False), (0.6, True)])
def test_a_rival_that_ends_higher_from_where_the_best_ended_is_kept(
    monkeypatch: pytest.MonkeyPatch, gained: float, kept: bool
) -> None:
    """Its −2 ln L lies 10 above the best, outside the answer set; with 1.2 less it is a member."""

    def ratio(name: str, log_likelihood: float) -> Any:
        fit: Any = SimpleNamespace(
            log_likelihood=log_likelihood, predictor=None, solution=None, model=SimpleNamespace(values={})
        )
        return LikelihoodRatio((find_effect(name),), fit, 0.0, 0.0, plausible=True, reason=Remark())

    best, rival = ratio("leak", -100.0), ratio("air_drag", -105.0)
    refitted = SimpleNamespace(log_likelihood=-105.0 + gained)
    monkeypatch.setattr(candidate_fits, "is_poor_fit", lambda *_: False)
    monkeypatch.setattr(candidate_fits, "refit", lambda *_, **__: refitted)
    monkeypatch.setattr(candidate_fits, "likelihood_ratio", lambda _before, _effects, fit: fit)
    model = SimpleNamespace(with_effects=lambda _: SimpleNamespace(parameter_names=()))
    fits: Any = SimpleNamespace(
        credible_fits=[best, rival],
        fitted={"leak": best, "air_drag": rival},
        tests=SimpleNamespace(fit=SimpleNamespace(model=model)),
    )
    candidate_fits.CandidateFits._refit_rivals_from_best(fits)
    assert (fits.fitted["air_drag"] is refitted) == kept
    assert fits.fitted["leak"] is best
