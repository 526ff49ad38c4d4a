"""Trials of Figs. 4 and 5 found in an experiment and held against Eq. (2), by tables written by hand."""

from __future__ import annotations

import math

import numpy as np
import pandas as pd
import pytest
from scipy.integrate import solve_ivp

from vinetrack.core.records import Trial
from vinetrack.experiment.schema import with_names
from vinetrack.paper.arithmetic import NONE, follow
from vinetrack.paper.protocol import (
    Rest,
    eq2_speed_m_s,
    final_speeds,
    mean_motions,
    position_conditions,
    position_errors,
    speed_conditions,
)


def trial(name: str, pressure_kPa: float, payload_g: float, thickness_um: float = 200.0) -> Trial:
    return Trial(
        name=name,
        capture_fps=1069.0,
        diameter_m=0.024,
        thickness_m=thickness_um / 1e6,
        length_m=0.28,
        pressure_Pa=1e3 * pressure_kPa,
        yield_pressure_Pa=3e3,
        payload_kg=payload_g / 1e3,
    )


FIG4 = [trial("a", 28, 35.6), trial("b", 28, 35.6), trial("c", 7, 35.6)]
FIG5 = [trial("d", 41, 10, 150), trial("e", 41, 10, 150), trial("f", 41, 50, 150)]
OTHERS = [trial("g", 28, 20), trial("h", 41, 0, 150), trial("i", 20, 35.6), trial("j", 28, 35.6, 100)]
TRIALS = with_names([*FIG4, *FIG5, *OTHERS])


RESTS = {"a": Rest(0.03, -0.01), "b": Rest(0.1, 0.02)}


def filmed(**factors: float) -> dict[str, pd.DataFrame]:
    """Trials so many times as far as Eq. (2) at every instant, each on its own clock, still before and after."""
    plain = follow(TRIALS[0], NONE, 6.44)
    time_s = np.arange(0, 400) / 1069
    motions = {}
    for name, factor in factors.items():
        rest = RESTS[name]
        grown_m = np.interp(time_s - rest.release_s, plain.time_s, factor * plain.lead_position_m)
        lead_position_m = rest.origin_m + np.minimum(grown_m, 0.28)
        motions[name] = pd.DataFrame({"time_s": time_s, "lead_position_m": lead_position_m})
    return motions


def test_the_mean_counts_until_the_first_trial_has_grown_to_95_per_cent() -> None:
    """1.1 times Eq. (2) is there first, when Eq. (2) has grown to 0.95 · 280/1.1 = 242 mm."""
    mean = mean_motions(position_conditions(TRIALS), filmed(a=1.1, b=0.9), RESTS)
    plain = follow(TRIALS[0], NONE, 6.44)
    assert set(mean["pressure_kPa"]) == {28.0}
    assert mean["time_s"].min() == 0.0
    there_s = np.interp(0.95 * 0.28 / 1.1, plain.lead_position_m, plain.time_s)
    assert mean["time_s"].max() == pytest.approx(there_s, abs=2 / 1069)
    assert (mean["n_trials"] == 2).all()
    grown_m = np.interp(mean["time_s"], plain.time_s, plain.lead_position_m)
    np.testing.assert_allclose(mean["lead_position_m"], grown_m, atol=2e-5)
    np.testing.assert_allclose(mean["lead_position_sigma_m"], math.sqrt(0.02) * grown_m, atol=2e-5)


def test_what_trials_differ_by_leaves_their_mean() -> None:
    """10 % ahead and 4 % behind: the mean is 3 % ahead, single trials √((0.1² + 0.04²)/2) = 7.62 %."""
    (row,) = position_errors(position_conditions(TRIALS), filmed(a=1.1, b=0.96), RESTS).itertuples()
    assert row.rms_single_m / row.rms_mean_m == pytest.approx(math.sqrt(0.0058) / 0.03, rel=0.01)
    assert row.n_trials == 2


def test_speeds_are_taken_at_12_cm_from_where_each_trial_rested() -> None:
    """Speed 10 y beyond the rest: 1.2 m/s there, 1.4 where the origin lies 20 mm lower; mean 1.3, error 0.1."""
    y = np.linspace(0, 0.28, 500)
    kinematics = {name: pd.DataFrame({"lead_position_m": y, "lead_velocity_m_s": 10 * y}) for name in ("d", "e", "f")}
    table = final_speeds(speed_conditions(TRIALS), kinematics, {"d": Rest(0.0, 0.0), "e": Rest(0.0, 0.02)})
    (row,) = table.itertuples()
    assert (row.n_final, row.payload_g, row.pressure_kPa) == (2, pytest.approx(10), pytest.approx(41))
    assert row.final_lead_velocity_m_s == pytest.approx(1.3, rel=1e-6)
    assert row.final_lead_velocity_sigma_m_s == pytest.approx(0.1, rel=1e-4)


def test_eq2_by_another_integrator() -> None:
    """B in proportion to the wall: 6.44 × 150/200 = 4.83."""
    one = TRIALS[3]
    film, area = 1200 * math.pi * 0.024 * 150e-6, math.pi * 0.012**2

    def rates(_: float, state: np.ndarray) -> list[float]:
        x, v = state
        m = film * 0.28 - film / 2 * x + 0.010
        return [v, (0.5 * 38e3 * area - 0.5 * 4.83 * max(v, 0.0) ** 0.37) / m + 9.81]

    def there(_: float, state: np.ndarray) -> float:
        return float(state[0] - 0.24)

    there.terminal = True  # type: ignore[attr-defined]
    found = solve_ivp(rates, (0, 1), [0.0, 1e-9], events=there, method="LSODA", rtol=1e-9, atol=1e-12)
    assert eq2_speed_m_s(one) == pytest.approx(found.y_events[0][0][1] / 2, rel=2e-3)
