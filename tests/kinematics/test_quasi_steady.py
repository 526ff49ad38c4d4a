"""Windows in which a vine keeps up with a falling pressure, against trajectories integrated here by SciPy."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from vinetrack.core.records import Track, Trial
from vinetrack.dynamics.model import base_model, make_model
from vinetrack.experiment.settings import RunSettings
from vinetrack.kinematics.damping import fit_damping
from vinetrack.kinematics.summary import TrialResult, summarise_trial

B, N, CHAMBER_M3, GAMMA, AMBIENT_PA = 6.44, 0.37, 1e-3, 1.4, 101_325.0
STEP_S = 1 / 1069
SETTINGS = RunSettings()


def vine(pressure_kPa: float, payload_kg: float = 0.0) -> Trial:
    return Trial(
        name=f"p{pressure_kPa:g}",
        vine="v",
        condition=f"{pressure_kPa:g}",
        capture_fps=1 / STEP_S,
        diameter_m=0.024,
        thickness_m=200e-6,
        length_m=0.28,
        pressure_Pa=1e3 * pressure_kPa,
        pressure_sigma_Pa=10 * pressure_kPa,
        yield_pressure_Pa=3e3,
        yield_pressure_sigma_Pa=200.0,
        payload_kg=payload_kg,
        chamber_m3=CHAMBER_M3,
    )


def pressure_at(trial: Trial, y: np.ndarray) -> np.ndarray:
    swept = trial.area_m2 * y
    return (trial.pressure_Pa + AMBIENT_PA) * (CHAMBER_M3 / (CHAMBER_M3 + swept)) ** GAMMA - AMBIENT_PA


def grown(trial: Trial, seed: int, noise_m: float = 1e-4) -> tuple[Track, np.ndarray]:
    """A track of `trial` emptying its chamber, and the pressure at its rows."""
    area, film = trial.area_m2, 1200 * math.pi * trial.diameter_m * trial.thickness_m

    def motion(_t: float, state: np.ndarray) -> list[float]:
        x, v = state
        mass = film * max(trial.length_m - x / 2, 1e-3) + trial.payload_kg
        drive = 0.5 * (pressure_at(trial, x / 2) - 3e3) * area + mass * 9.81
        return [v, (drive - 0.5 * B * max(v, 0.0) ** N) / mass]

    def end(_t: float, state: np.ndarray) -> float:
        return state[0] - 2 * 0.97 * trial.length_m

    end.terminal = True  # type: ignore[attr-defined]
    found = solve_ivp(motion, [0, 8], [0, 0], method="Radau", rtol=1e-9, atol=1e-12, dense_output=True, events=end)
    time_s = np.arange(0, found.t[-1] + 20 * STEP_S, STEP_S)
    since_s = time_s - 20.4 * STEP_S
    y = np.where(since_s > 0, found.sol(np.clip(since_s, 0, found.t[-1]))[0] / 2, 0.0)
    seen = 0.02 + y + noise_m * np.random.default_rng(seed).standard_normal(y.size)
    nothing = np.full(y.size, np.nan)
    return Track(time_s, seen, nothing, np.full(y.size, ""), nothing), pressure_at(trial, y)


def analysed(trial: Trial, seed: int, *, traced: bool, effects: tuple[str, ...] = ()) -> TrialResult:
    track, pressure_Pa = grown(trial, seed)
    model = make_model((*base_model().names, *effects))
    return summarise_trial(trial, replace(track, pressure_Pa=pressure_Pa) if traced else track, SETTINGS, model)


def test_a_measured_pressure_makes_a_point_of_a_speed_that_never_settles() -> None:
    result = analysed(vine(20), seed=1000, traced=True)
    window = result.windows["quasi_steady"]
    assert window.accepted
    assert window.drift < -0.1
    assert result.row["steady_rule"] == "quasi_steady"
    assert result.point["used"]
    assert result.point["force_N"] == pytest.approx(B * float(result.point["x_ss_m_s"]) ** N, rel=0.01)


def test_the_pressure_of_the_model_in_use_does_as_well_as_a_measured_one() -> None:
    traced = analysed(vine(20), seed=1001, traced=True)
    modelled = analysed(vine(20), seed=1001, traced=False, effects=("reservoir_depletion",))
    assert modelled.row["steady_rule"] == "quasi_steady"
    assert modelled.point["force_N"] == pytest.approx(traced.point["force_N"], rel=0.005)


def test_without_a_known_pressure_the_rule_is_not_asked() -> None:
    result = analysed(vine(20), seed=1002, traced=False)
    assert "quasi_steady" not in result.windows
    assert result.row["steady_rule"] == ""
    assert not result.point["used"]


def test_where_inertia_rules_there_is_no_window() -> None:
    loaded = analysed(vine(34, payload_kg=0.0), seed=1003, traced=True)
    window = loaded.windows.get("quasi_steady", loaded.windows["gated"])
    # The drive of 34 kPa falls so fast that the film's inertia takes more than a tenth of it.
    assert not window.accepted
    assert "inertia takes at least" in window.reason or "too few" in window.reason


def test_a_trial_with_a_payload_is_not_asked_either() -> None:
    assert "quasi_steady" not in analysed(vine(20, payload_kg=0.0356), seed=1004, traced=True).windows


def test_a_chamber_that_empties_gives_the_law_once_its_pressure_is_known() -> None:
    points = [analysed(vine(p), seed=1010 + i, traced=True).point for i, p in enumerate((12, 14, 16, 18, 20, 22, 24))]
    import pandas as pd

    table = pd.DataFrame([dict(point) for point in points])
    assert table["used"].sum() >= 4
    fit = fit_damping(table[table["used"]], resamples=200)["both_axes"]
    assert fit["n"] == pytest.approx(N, abs=0.01)
    assert fit["vines"]["v"]["B"] == pytest.approx(B, rel=0.01)
