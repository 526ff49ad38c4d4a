"""Errors and intervals of a fit where statistics prescribe them. Seeds from 20640, which were not used for tuning."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from lsoda_vine import filmed, vine_trial
from scipy.stats import t as student

import vinetrack as vt
from vinetrack.inference.position_errors import precision


@pytest.mark.parametrize("trials", [5, 7])
def test_the_mean_of_replicates_has_one_degree_of_freedom_less_and_students_interval(trials: int) -> None:
    """Replicates of one condition whose B scatters by far more than any is measured: Student's problem."""
    draw = np.random.default_rng([20640, trials])
    pairs, factors = [], np.exp(0.04 * draw.standard_normal(trials))
    for k, factor in enumerate(factors):
        trial = replace(vine_trial(f"t{k}", 20), vine="v", condition="c")
        pairs.append((trial, filmed(trial, draw, damping=float(factor))[0]))
    model = vt.base_model().with_values({"eversion_damping.n": 0.4})
    found = vt.fit(model, pairs, fixed=["n", "P_y"], profile=False)
    B = found["B"]
    assert precision(found.solution).degrees[0] == pytest.approx(trials - 1, rel=0.05)
    standard_error = float(np.std(np.log(factors), ddof=1)) / math.sqrt(trials)
    assert B.sigma / B.value == pytest.approx(standard_error, rel=0.1)
    half_width = math.log(B.high / B.low) / 2
    assert half_width / (B.sigma / B.value) == pytest.approx(student.ppf(0.975, B.dof), rel=1e-3)
