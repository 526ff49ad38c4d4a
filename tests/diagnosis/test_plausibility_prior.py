"""Plausible ranges weigh hypotheses: against integrals done by quadrature."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.stats import norm

from vinetrack.diagnosis.candidates import is_plausible
from vinetrack.diagnosis.likelihood_ratio import log_evidence, posterior_weights, prior_penalty
from vinetrack.effects import Parameter, catalogue
from vinetrack.inference.fit_result import Number

GAUGE = Parameter("delta", "δ", "Pa", 500.0, plausible=(-2e3, 2e3))


@dataclass
class KnownFit:
    """What these functions read of a fit."""

    numbers: tuple[Number, ...]
    log_likelihood: float = -10.0
    covariance: Any = field(default_factory=lambda: np.eye(1))


def fitted(value: float, sigma: float) -> Any:
    number = Number("g.delta", "", "δ", "Pa", value, sigma, value - 2 * sigma, value + 2 * sigma, math.inf, "linear")
    return KnownFit((number,), covariance=np.array([[sigma**2]]))


@pytest.mark.parametrize(("value", "sigma"), [(300.0, 200.0), (7.1e3, 1.7e3), (-1.5e3, 30.0)])
def test_the_marginal_likelihood_is_the_integral_over_the_prior(value: float, sigma: float) -> None:
    def inside(delta: float) -> float:
        return math.exp(-10 - 0.5 * ((delta - value) / sigma) ** 2) * norm.pdf(delta, 0.0, 1e3)

    whole, _ = quad(inside, -2e4, 2e4, points=[value - 3 * sigma, value, value + 3 * sigma, 0.0], epsabs=0, limit=300)
    assert log_evidence(fitted(value, sigma), {"g.delta": GAUGE}) == pytest.approx(math.log(whole), abs=1e-6)


def test_a_gauge_seven_kilopascals_off_is_a_surprise_and_one_within_two_is_none() -> None:
    # z² = 7.1² / (1.7² + 1²) = 12.96 with a prior of 1 kPa; less 4 at the edge of the plausible range.
    assert prior_penalty(fitted(7.1e3, 1.7e3), {"g.delta": GAUGE}) == pytest.approx(12.96 - 4, abs=0.01)
    assert prior_penalty(fitted(1.9e3, 100.0), {"g.delta": GAUGE}) == 0
    assert prior_penalty(fitted(7.1e3, 5e3), {"g.delta": GAUGE}) == 0


def test_a_number_of_which_the_data_say_nothing_costs_nothing() -> None:
    assert log_evidence(fitted(0.0, 1e7), {"g.delta": GAUGE}) == pytest.approx(-10, abs=1e-6)


def test_weights_add_up_and_follow_the_evidence() -> None:
    weights = posterior_weights([-10.0, -10.0 - math.log(3), -800.0])
    assert weights == pytest.approx([0.75, 0.25, 0.0])
    assert posterior_weights([]) == []


@pytest.mark.parametrize("phase_rad", [-3.67, 6.9, 3.0])
def test_any_phase_of_a_swing_is_plausible(phase_rad: float) -> None:
    """A phase of −3.67 rad is one of 2.61."""
    phase = next(parameter for parameter in catalogue()["supply_pulsation"].parameters if parameter.name == "phi")
    assert is_plausible(phase, phase_rad, 0.0)
    frequency = next(parameter for parameter in catalogue()["supply_pulsation"].parameters if parameter.name == "f")
    assert not is_plausible(frequency, 480.0, 0.0)
