"""Campaigns: the errors that are promised are those that fits then have; seeds 900 and up simulate them."""

from __future__ import annotations

import math

import numpy as np
import pytest

import vinetrack as vt
from vinetrack.experiment.planned import planned_trial
from vinetrack.planning.campaign_design import Candidates, Planned, Scope, candidates, plan, trials_of
from vinetrack.planning.campaign_information import (
    FilmingPlan,
    filmed,
    information,
    joint_model,
    reaches_steady,
    steady_error,
    steady_speed,
)
from vinetrack.planning.input_sources import StatedValues, predictive_inputs
from vinetrack.planning.predictive_inputs import PredictiveInputs
from vinetrack.planning.simulated_campaigns import make, simulate_campaign

CAMERA = FilmingPlan(1069.0, 1e-4)
SIZES = ((24, 200, 280), (12, 100, 140))


def vine_inputs(
    *sizes: tuple[float, float, float], spreads: tuple[float, float] = (0.01, 0.03)
) -> list[PredictiveInputs]:
    found = []
    for D, t, L in sizes:
        cells = {"diameter_mm": D, "thickness_um": t, "length_mm": L, "pressure_kPa": 100, "yield_pressure_kPa": 3}
        trial = planned_trial({name: str(value) for name, value in cells.items()}).trials[0]
        found.append(predictive_inputs(trial, StatedValues(n=0.37, spreads=spreads)))
    return found


@pytest.fixture(scope="module")
def planned() -> tuple[Candidates, Planned, Scope]:
    scope = Scope(pressure_Pa=(14e3, 45e3), payloads_kg=(0.0, 0.0356))
    found = candidates(vine_inputs(*SIZES), scope, CAMERA)
    return found, plan(found, scope, 0.004, 0.02), scope


def test_the_plan_meets_what_is_wanted_with_the_fewest_trials(planned: tuple[Candidates, Planned, Scope]) -> None:
    _, found, scope = planned
    assert found.best is not None
    assert found.best.meets(0.004, 0.02)
    assert all(other.n_trials >= found.best.n_trials for other in found.others)
    assert found.best.pressures >= scope.pressures[0]
    assert found.best.replicates >= scope.replicates[0]
    assert found.cheapest is not None
    assert found.cheapest.n_trials <= found.best.n_trials


def test_twice_the_trials_halve_the_variance_as_long_as_nothing_is_known_beforehand() -> None:
    one = predictive_inputs(
        planned_trial(
            {
                "diameter_mm": "24",
                "thickness_um": "200",
                "length_mm": "280",
                "pressure_kPa": "20",
                "yield_pressure_kPa": "3",
                "yield_pressure_sigma_kPa": "0",
            }
        ).trials[0],
        StatedValues(n=0.37),
    )
    found = candidates([one], Scope(pressure_Pa=(9e3, 45e3)), CAMERA)
    counts = np.ones(len(found.trials))
    (n_once, B_once), (n_twice, B_twice) = found.information.errors(counts), found.information.errors(2 * counts)
    assert n_twice == pytest.approx(n_once / math.sqrt(2))
    assert B_twice["24mm-200um-280mm"] == pytest.approx(B_once["24mm-200um-280mm"] / math.sqrt(2))


def test_the_information_is_that_of_a_fit_to_the_same_trials(planned: tuple[Candidates, Planned, Scope]) -> None:
    """The covariance that a fit states when it is told spreads and noise, of trials with the same frames."""
    found, made, _ = planned
    assert made.best is not None
    trials = trials_of(found, made.best)
    pairs = make(found.model, trials, CAMERA, (0.01, 0.03), np.random.default_rng(900))
    fit = vt.fit(found.model, pairs, spreads=(0.01, 0.03), noise=(1e-4, 0.0), profile=False)
    assert made.best.n_error == pytest.approx(fit["n"].sigma, rel=0.1)
    for vine, error in made.best.B_errors.items():
        number = fit[f"eversion_damping.B[{vine}]"]
        assert error == pytest.approx(number.sigma / number.value, rel=0.1)


def test_simulated_campaigns_show_the_errors_that_were_promised(planned: tuple[Candidates, Planned, Scope]) -> None:
    """Root mean square of 12 campaigns, seed 901: its own standard error is 20 %, so 50 % are two and a half."""
    found, made, _ = planned
    assert made.best is not None
    tried = simulate_campaign(found.model, trials_of(found, made.best), CAMERA, (0.01, 0.03), campaigns=12, seed=901)
    assert tried.campaigns == 12
    assert tried.n_rms == pytest.approx(made.best.n_error, rel=0.5)
    for vine, error in made.best.B_errors.items():
        assert tried.B_rms[vine] == pytest.approx(error, rel=0.5)
        assert tried.B_stated[vine] == pytest.approx(error, rel=0.25)
    assert tried.covered > 0.85


def test_what_cannot_be_had_is_said_with_what_is_nearest(planned: tuple[Candidates, Planned, Scope]) -> None:
    found, _, scope = planned
    missed = plan(found, Scope(scope.pressure_Pa, scope.payloads_kg, most_trials=40), 1e-5, 1e-4)
    assert missed.best is None
    assert missed.cheapest is None
    assert missed.nearest.n_trials <= 40
    assert missed.endless.n_error < missed.nearest.n_error


def test_noise_that_is_correlated_tells_less() -> None:
    found = vine_inputs(SIZES[0])
    model = joint_model(found)
    trials = [
        planned_trial(
            {
                "diameter_mm": "24",
                "thickness_um": "200",
                "length_mm": "280",
                "pressure_kPa": str(pressure),
                "yield_pressure_kPa": "3",
            }
        ).trials[0]
        for pressure in (15, 25, 40)
    ]
    errors = []
    for rho in (0.0, 0.8):
        camera = FilmingPlan(1069.0, 5e-4, rho)
        data = [item for item in filmed(model, trials, camera) if item is not None]
        errors.append(information(model, data, camera, (0.0, 0.0)).errors(np.ones(3))[0])
    assert errors[1] > 1.5 * errors[0]


def test_conditions_that_take_too_long_or_too_few_frames_are_passed_over() -> None:
    slow = candidates(vine_inputs(SIZES[0]), Scope(pressure_Pa=(4e3, 60e3)), FilmingPlan(1069.0, 1e-4, longest_s=1.0))
    assert slow.rejected > 0
    assert min(trial.pressure_Pa for trial in slow.trials) > 10e3
    quick = candidates(vine_inputs(SIZES[0]), Scope(pressure_Pa=(9e3, 100e3)), FilmingPlan(200.0, 1e-4))
    assert max(trial.pressure_Pa for trial in quick.trials) < 60e3
    with pytest.raises(ValueError, match="No trial of the campaign could be filmed"):
        candidates(vine_inputs(SIZES[0]), Scope(pressure_Pa=(3.1e3, 3.2e3)), CAMERA)


def test_pressures_stay_below_the_burst_pressure_that_is_dared() -> None:
    found = candidates(vine_inputs(SIZES[0]), Scope(burst_share=0.5), CAMERA)
    assert max(trial.pressure_Pa for trial in found.trials) <= 0.5 * 2 * 200e-6 * 7.8e6 / 24e-3 * 1.005


def test_every_trial_of_a_campaign_has_a_name_of_its_own(planned: tuple[Candidates, Planned, Scope]) -> None:
    found, made, _ = planned
    assert made.best is not None
    trials = trials_of(found, made.best)
    assert len({trial.name for trial in trials}) == len(trials) == made.best.n_trials


def test_steady_speeds_alone_are_a_straight_line_in_logarithms() -> None:
    """Without doubt of P_y, σ_n is that of a slope: scatter over √Σ(ln v − mean)²."""
    (inputs,) = vine_inputs(SIZES[0])
    model = joint_model([inputs])
    trials = [
        planned_trial(
            {
                "diameter_mm": "24",
                "thickness_um": "200",
                "length_mm": "280",
                "pressure_kPa": str(pressure),
                "yield_pressure_kPa": "3",
                "yield_pressure_sigma_kPa": "0",
            }
        ).trials[0]
        for pressure in (10, 14, 20)
    ]
    logs = np.log([steady_speed(model, trial) for trial in trials])
    expected = 0.03 / math.sqrt(4 * np.sum((logs - logs.mean()) ** 2))
    found = steady_error(model, trials, np.full(3, 4.0), (0.0, 0.03), np.ones(3, dtype=bool))
    assert found == pytest.approx(expected, rel=1e-6)


def test_a_fast_or_loaded_vine_never_gets_steady() -> None:
    (inputs,) = vine_inputs(SIZES[0])
    cells = {"diameter_mm": "24", "thickness_um": "200", "length_mm": "280", "yield_pressure_kPa": "3"}
    trials = [
        planned_trial({**cells, "pressure_kPa": pressure, "payload_g": payload}).trials[0]
        for pressure, payload in (("12", "0"), ("12", "35.6"), ("60", "0"))
    ]
    assert reaches_steady(joint_model([inputs]), trials, 4.0).tolist() == [True, False, False]
