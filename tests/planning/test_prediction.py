"""What is predicted, against the laws of motion written out by hand and against another integrator."""

from __future__ import annotations

import math

import numpy as np
import pytest
from lsoda_vine import grown_position
from scipy.integrate import solve_ivp

from vinetrack.core import published
from vinetrack.core.records import Trial
from vinetrack.experiment.planned import planned_trial
from vinetrack.planning.prediction import (
    EDGE,
    LEAST_TENSION,
    TAIL,
    TENSION,
    TIME,
    predict_vine,
    run,
)
from vinetrack.planning.predictive_inputs import BAND, YIELD, StatedValues, damping_prior, predictive_inputs

FAST = {name: str(value) for name, value in published.FAST_VINE.items()}
EXACT = {"yield_pressure_sigma_kPa": "0"}


def trial(**values: object) -> Trial:
    return planned_trial({**FAST, **EXACT, **{name: str(value) for name, value in values.items()}}).trials[0]


def certain(one: Trial, B: float, n: float = 0.37, **said: object) -> object:
    return predictive_inputs(one, StatedValues(B=B, n=n, spreads=(0.0, 0.0), **said))  # type: ignore[arg-type]


def test_the_fast_vine_has_the_speeds_that_eq_2_gives_it() -> None:
    """42, 47, 52, 55 m/s at 90, 95, 98, 99 % of the length, with the guessed B ≈ 3.3 and a film that goes to nothing.

    At 99 % the film weighs 0.04 g: less than a quarter of the gas, 0.1 g, which is the floor of what moves. With it
    Eq. (2) gives 53.8 m/s there.
    """
    fast = trial(yield_pressure_kPa=3)
    B = damping_prior(fast.diameter_m, fast.thickness_m)
    assert pytest.approx(3.3, abs=0.05) == B
    along = np.array([0.90, 0.95, 0.98, 0.99])
    ours = run(certain(fast, B), along * fast.length_m, 1, 1).lead_velocity_m_s[0]
    bare = _eq_2_without_a_floor(fast, B, 0.37, along)
    assert bare == pytest.approx([42, 47, 52, 55], abs=0.5)
    assert ours[:2] == pytest.approx(bare[:2], rel=1e-3)
    assert ours == pytest.approx(bare, rel=0.035)
    assert ours[3] == pytest.approx(53.8, abs=0.1)
    assert (ours <= bare + 0.01).all()


def _eq_2_without_a_floor(one: Trial, B: float, n: float, along: np.ndarray) -> np.ndarray:
    """Speed of the leading edge by scipy, m = λL − ½λx alone; places in place of times, so that none is missed."""
    area, film = math.pi * 0.025**2 / 4, 1200 * math.pi * 0.025 * 100e-6

    def slope(x: float, square: np.ndarray) -> np.ndarray:
        v = math.sqrt(max(square[0], 0.0))
        mass = film * (one.length_m - x / 2)
        return np.array([2 * ((0.5 * (62e3 - 3e3) * area - 0.5 * B * v**n) / mass + 9.81)])

    x = 2 * one.length_m * along
    found = solve_ivp(slope, (0, x[-1]), [0.0], "LSODA", t_eval=x, rtol=1e-9, atol=1e-9)
    return np.sqrt(found.y[0]) / 2


def test_without_damping_a_bare_vine_has_the_speed_that_the_balance_of_momentum_gives() -> None:
    """m ẍ = F with m = λ(L − x/2): ẋ² = −(4F/λ) ln(1 − y/L), level, F = ½(P − P_y)A."""
    one = trial(yield_pressure_kPa=2, growth_angle_deg=90)
    film = 1200 * math.pi * 25e-3 * 100e-6
    force = 0.5 * 60e3 * math.pi * 25e-3**2 / 4
    prediction = predict_vine(certain(one, 1e-9), samples=2, at_fraction=0.8)
    assert prediction[TAIL].median == pytest.approx(math.sqrt(4 * force / film * math.log(5)), rel=2e-3)
    assert prediction[EDGE].median == pytest.approx(prediction[TAIL].median / 2)
    assert prediction[TENSION].median == pytest.approx(force, rel=1e-6)


def test_time_and_speed_are_those_of_another_integrator() -> None:
    one = trial(diameter_mm=24, thickness_um=200, length_mm=280, pressure_kPa=28, yield_pressure_kPa=3, payload_g=35.6)
    prediction = predict_vine(certain(one, 6.44), samples=2)
    times = np.linspace(0, 0.3, 30_001)
    truth = grown_position(one, times, 6.44, 0.37)
    there = np.interp(0.95 * 0.28, truth[np.isfinite(truth)], times[np.isfinite(truth)])
    assert prediction[TIME].median == pytest.approx(there, rel=1e-4)
    near = np.abs(times - there) < 1e-3
    assert prediction[EDGE].median == pytest.approx(np.polyfit(times[near], truth[near], 1)[0], rel=1e-3)


def test_the_tension_is_what_the_tip_leaves_of_the_drive() -> None:
    """T₁ = ½(P − P_y)A − ½Bẋⁿ all along: 35.6 g pull the tail slack at 14 kPa, in the equation."""
    one = trial(diameter_mm=24, thickness_um=200, length_mm=280, pressure_kPa=14, yield_pressure_kPa=3, payload_g=35.6)
    prediction = predict_vine(certain(one, 6.44), samples=2)
    curve = prediction.curve
    force = 0.5 * 11e3 * math.pi * 24e-3**2 / 4
    expected = force - 0.5 * 6.44 * curve["tail_velocity_m_s"] ** 0.37
    assert curve["tension_N"].to_numpy()[5:] == pytest.approx(expected.to_numpy()[5:], abs=0.01)
    assert curve["tension_N"].iloc[0] == pytest.approx(force)
    assert prediction.slack == 1.0
    assert prediction[LEAST_TENSION].median == pytest.approx(curve["tension_N"].min(), abs=0.01)


def test_bands_are_those_of_the_one_thing_that_is_uncertain() -> None:
    """Speed falls as the yield pressure rises: its quantiles are the speeds at the quantiles of that."""
    inputs = predictive_inputs(planned_trial(FAST).trials[0], StatedValues(B=3.3, n=0.37, spreads=(0.0, 0.0)))
    prediction = predict_vine(inputs, samples=1500)
    drawn = np.quantile(inputs.draw(1500, 1)[YIELD], BAND, method="inverted_cdf")
    speeds = [
        predict_vine(certain(trial(yield_pressure_kPa=P_y / 1e3), 3.3), samples=1).quantities[0].median for P_y in drawn
    ]
    assert [prediction[EDGE].high, prediction[EDGE].median, prediction[EDGE].low] == pytest.approx(speeds, rel=2e-3)
    (share,) = prediction.shares
    assert (share.low, share.high) == pytest.approx((prediction[EDGE].low, prediction[EDGE].high), rel=0.03)


def test_a_quantile_of_time_along_the_growth_is_one_of_position_in_time() -> None:
    inputs = predictive_inputs(planned_trial(FAST).trials[0])
    prediction = predict_vine(inputs, samples=300)
    runs = run(inputs, prediction.curve["lead_position_m"].to_numpy(), 300, 1)
    when = float(prediction.curve["time_high_90_s"].iloc[60])
    positions = [float(np.interp(when, times, runs.places_m)) for times in runs.time_s]
    assert np.quantile(positions, 0.05, method="inverted_cdf") == pytest.approx(
        float(prediction.curve["lead_position_m"].iloc[60]), rel=0.01
    )
