"""A refit finds an effect from a start that misses by far more than noise, wherever the fit before had its releases."""

from __future__ import annotations

import numpy as np
import pytest
from hidden_truth import grown

import vinetrack as vt

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


def test_an_effect_that_adds_nothing_makes_no_fit_worse():
    base = vt.fit(vt.base_model(), grown(seed=32), profile=False)
    for name in HIDDEN:
        found = vt.refit(base, base.model + getattr(vt.effects, name))
        assert found.log_likelihood > base.log_likelihood - 0.5
        assert np.isfinite(found.chi2_per_dof)
