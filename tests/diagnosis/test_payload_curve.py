"""Final speed against payload, for a vine whose motion is known in closed form, with errors propagated by hand.

With n = 0 and massless film the tail has the constant acceleration a = (½(P − P_y)A − ½B)/m + g, so that at growth y,
with x = 2y and ẋ² = 2ax, the leading edge has ẏ = √(a·y). The gas that moves along is the least mass: ¼ρ_gas·A·L, 35
mg.
"""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest

from vinetrack.core.records import Trial
from vinetrack.diagnosis.payload_curve import CURVE_COLUMNS, PAYLOADS, payload_curves, speeds_with_error
from vinetrack.dynamics.model import base_model
from vinetrack.experiment.schema import with_names
from vinetrack.inference.fit_result import Number

P, P_Y, B, AREA, G, LENGTH = 28e3, 3e3, 2.0, math.pi * 0.012**2, 9.81, 0.2
GAS = 0.25 * (P + 101_325) / (287 * 293) * AREA * LENGTH
EVEN = Trial(name="even", diameter_m=0.024, thickness_m=1e-10, length_m=LENGTH, pressure_Pa=P, yield_pressure_Pa=4e3)
SIGMA_B, SIGMA_P_Y, CORRELATION = 0.1, 150.0, -0.6


def acceleration(mass_kg: np.ndarray | float) -> np.ndarray:
    return np.asarray((0.5 * (P - P_Y) * AREA - 0.5 * B) / (mass_kg + GAS) + G)


def number(key: str, value: float, sigma: float, vine: str) -> Number:
    return Number(key, vine, "", "", value, sigma, value - 2 * sigma, value + 2 * sigma, math.inf, "linear")


def fitted(trials: list[Trial]) -> SimpleNamespace:
    """The parts of a fit that a curve uses: the sheet states P_y 4 kPa, the fit estimated 3."""
    vine = trials[0].vine
    numbers = (number("eversion_damping.B", B, SIGMA_B, vine), number("yield_pressure.P_y", P_Y, SIGMA_P_Y, vine))
    shared = CORRELATION * SIGMA_B * SIGMA_P_Y
    return SimpleNamespace(
        model=base_model().with_values({"eversion_damping.B": {vine: B, "other": 9.0}, "eversion_damping.n": 0.0}),
        numbers=numbers,
        covariance=np.array([[SIGMA_B**2, shared], [shared, SIGMA_P_Y**2]]),
        trials=tuple(
            SimpleNamespace(trial=trial, time_s=np.linspace(-0.1, 0.5, 50), release_s=0.0) for trial in trials
        ),
    )


def loaded(*payloads_kg: float, **changes: float) -> list[Trial]:
    return list(with_names([replace(EVEN, name=f"p{i}", payload_kg=kg, **changes) for i, kg in enumerate(payloads_kg)]))


def test_the_speed_under_constant_acceleration() -> None:
    found = fitted(loaded(0.01, 0.05))
    curve = payload_curves(found, 0.75)
    assert list(curve.columns) == list(CURVE_COLUMNS)
    mass_kg = np.linspace(0.01, 0.05, PAYLOADS)
    assert curve["payload_g"].to_numpy() == pytest.approx(1e3 * mass_kg)
    assert curve["final_at_mm"].tolist() == pytest.approx([150.0] * PAYLOADS)
    assert curve["final_lead_velocity_m_s"].to_numpy() == pytest.approx(np.sqrt(acceleration(mass_kg) * 0.15), rel=2e-4)


def test_errors_of_b_and_yield_pressure_are_propagated_with_their_correlation() -> None:
    """∂a/∂B = −1/2m and ∂a/∂P_y = −A/2m; ∂ẏ/∂a = ½√(y/a)."""
    trials = loaded(0.02, 0.04)
    _, sigma = speeds_with_error(fitted(trials), trials, 0.15, 0.5)
    for trial, found in zip(trials, sigma, strict=True):
        m = trial.payload_kg
        by_a = 0.5 * math.sqrt(0.15 / float(acceleration(m)))
        by_B, by_P = -by_a / (2 * m), -by_a * AREA / (2 * m)
        shared = 2 * by_B * by_P * CORRELATION * SIGMA_B * SIGMA_P_Y
        assert found == pytest.approx(math.sqrt((by_B * SIGMA_B) ** 2 + (by_P * SIGMA_P_Y) ** 2 + shared), rel=0.01)


def test_a_vine_with_one_payload_has_no_curve() -> None:
    assert payload_curves(fitted(loaded(0.02, 0.02)), 0.95).empty


def test_each_pressure_has_its_own_curve() -> None:
    low, high = loaded(0.01, 0.03), loaded(0.01, 0.03, pressure_Pa=40e3)
    curve = payload_curves(fitted([*low, *high]), 0.95)
    assert isinstance(curve, pd.DataFrame)
    assert curve.groupby("pressure_kPa").size().to_dict() == {28.0: PAYLOADS, 40.0: PAYLOADS}


def test_a_vine_that_does_not_reach_the_position_has_speed_zero() -> None:
    """Upwards with 35.6 g at 4 kPa: ½ × 1 kPa × 452 mm² − 1 N < 0.349 N of weight."""
    stuck = loaded(0.0356, 0.05, pressure_Pa=4e3, growth_angle_rad=math.pi)
    assert payload_curves(fitted(stuck), 0.95)["final_lead_velocity_m_s"].tolist() == [0.0] * PAYLOADS
