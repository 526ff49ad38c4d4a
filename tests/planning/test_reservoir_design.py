"""The chamber that keeps the pressure, against the gas law worked by hand and against a vine grown out of it."""

from __future__ import annotations

import math

import numpy as np
import pytest

from vinetrack.core.records import Trial
from vinetrack.dynamics.model import make_model
from vinetrack.dynamics.simulate import simulate
from vinetrack.experiment.planned import planned_trial
from vinetrack.planning.fastest_vine import (
    GAMMAS,
    chamber_for,
    final_with,
    gauge_loss,
    supplied_chamber,
    supplied_loss,
    swept_m3,
)
from vinetrack.planning.predictive_inputs import StatedValues, predictive_inputs

ATM = 101_325.0


def trial(**values: object) -> Trial:
    known = {
        "diameter_mm": 24,
        "thickness_um": 200,
        "length_mm": 280,
        "pressure_kPa": 28,
        "yield_pressure_kPa": 3,
        "chamber_l": 3.7,
    }
    return planned_trial({name: str(value) for name, value in {**known, **values}.items()}).trials[0]


@pytest.mark.parametrize(
    ("pressure_kPa", "slow", "fast"),
    [(28, 0.15, 0.21), (14, 0.27, 0.38), (7, 0.51, 0.71)],
    ids=lambda value: f"{value}",
)
def test_the_losses_of_the_papers_reservoir(pressure_kPa: float, slow: float, fast: float) -> None:
    swept = swept_m3(trial())
    for gamma, expected in ((1.0, slow), (1.4, fast)):
        assert gauge_loss(1e3 * pressure_kPa, swept, 3.7e-3, gamma, ATM) == pytest.approx(expected, abs=0.005)


def test_the_injectors_1_7_per_cent_are_5_3_of_gauge() -> None:
    one = trial(
        diameter_mm=2.5, thickness_um=50, length_mm=12.5, pressure_kPa=48, chamber_l=20 * math.pi * 7.5**2 / 1e6
    )
    assert swept_m3(one) / one.chamber_m3 == pytest.approx(0.017, abs=5e-4)
    assert gauge_loss(48e3, swept_m3(one), one.chamber_m3, 1.0, ATM) == pytest.approx(0.053, abs=5e-4)


@pytest.mark.parametrize("gamma", GAMMAS.values())
@pytest.mark.parametrize("loss", [0.01, 0.05, 0.5])
def test_a_chamber_that_is_sized_loses_just_what_it_may(gamma: float, loss: float) -> None:
    volume = chamber_for(28e3, 1e-4, loss, gamma, ATM)
    assert gauge_loss(28e3, 1e-4, volume, gamma, ATM) == pytest.approx(loss)


def test_speeds_with_a_chamber_are_those_of_the_effect() -> None:
    inputs = predictive_inputs(trial(payload_g=35.6), StatedValues(B=6.44, n=0.37))
    model = make_model([*inputs.model.names, "reservoir_depletion"]).with_values(
        {**inputs.model.values, "reservoir_depletion.gamma": 1.0}
    )
    times = np.linspace(0.0, 1.0, 20_001)
    found = simulate(model, inputs.trial, times)
    assert final_with(inputs, 3.7e-3, 1.0, 0.95) == pytest.approx(2 * found.end_lead_velocity_m_s, rel=2e-3)


def test_a_quick_supply_saves_a_chamber() -> None:
    inputs = predictive_inputs(trial(), StatedValues(B=6.44, n=0.37))
    closed = chamber_for(28e3, swept_m3(inputs.trial), 0.05, 1.4, ATM)
    volumes = [supplied_chamber(inputs, 0.05, tau_s, 1.4) for tau_s in (0.02, 0.2)]
    assert volumes[0] < volumes[1] < closed
    assert supplied_loss(inputs, volumes[1], 0.2, 1.4) == pytest.approx(0.05, abs=5e-4)
