"""What of a fitted size another effect may account for: against refits and quadrature."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
from hidden_truth import Pairs, sheet
from scipy.integrate import quad
from scipy.stats import norm

import vinetrack as vt
from vinetrack.diagnosis import candidates as hypotheses
from vinetrack.diagnosis.effect_sets import confounders_of, size_not_excluded
from vinetrack.diagnosis.ladder import candidates_of, host_for
from vinetrack.diagnosis.misfit_tests import FALSE_ALARM_LEVEL_LATER_ROUNDS, MisfitTests, misfit_tests
from vinetrack.diagnosis.result import Confounder
from vinetrack.diagnosis.score_test import levers_of
from vinetrack.effects import Parameter
from vinetrack.inference.fit import fit
from vinetrack.laboratory.tracks import BASE, GroundTruth, damping_values, grow
from vinetrack.narrative.verdict_text import confounders_in_words

DRAG, INLET = "air_drag.C_D", "inlet_loss.K"
TRUE_DRAG, TRUE_INLET = 1.2, 1.0


@lru_cache(maxsize=1)
def both_act() -> Pairs:
    """Trials of two tubes through connectors a third as wide: air slows down there as drag would slow the vine."""
    trials = [replace(trial, inlet_m=0.33 * trial.diameter_m) for trial in sheet()]
    nature = GroundTruth(
        effects=(*BASE, "inlet_loss", "air_drag"),
        values={**damping_values(trials), INLET: TRUE_INLET, DRAG: TRUE_DRAG},
        damping_scatter=5e-3,
        pressure_scatter=1e-3,
        yield_error_kPa=0.05,
        noise_m=3e-5,
        seed=31,
    )
    return [(one.stated, one.track) for one in grow(trials, nature)]


@pytest.fixture(scope="module")
def after() -> MisfitTests:
    """The model with the inlet loss alone, fitted to trials that have drag too, held against all other effects."""
    model = vt.base_model() + vt.effects.inlet_loss
    candidates = candidates_of(model, None, None)
    found = fit(model, both_act(), host=host_for(model, candidates), profile=False)
    return misfit_tests(found, hypotheses.testable(candidates, found.predictor.data)[0], FALSE_ALARM_LEVEL_LATER_ROUNDS)


@pytest.fixture(scope="module")
def by_effect(after: MisfitTests) -> dict[str, Confounder]:
    return {one.effect: one for one in confounders_of(after, ["inlet_loss"])}


def test_levers_say_how_far_a_refit_with_the_other_effect_moves_the_size(after: MisfitTests) -> None:
    place = after.ranked_shapes("air_drag")[0]
    k = next(k for k, number in enumerate(after.fit.numbers) if number.key == INLET)
    lever = float(levers_of(after.fit, after.products)[k, place])
    drag = 0.2
    model = (after.fit.model + vt.effects.air_drag).with_values({DRAG: drag})
    with_drag = fit(model, both_act(), fixed=[DRAG], profile=False)
    fell = after.fit[INLET].value - with_drag[INLET].value
    # First order in C_D; spreads and noise are estimated anew in the refit.
    assert fell == pytest.approx(lever * drag, rel=0.1)


def test_what_nobody_can_exclude_is_named_and_the_wider_interval_holds_the_truth(
    after: MisfitTests, by_effect: dict[str, Confounder]
) -> None:
    # Linear damping takes the same sign of the force, fold inertia the other: found in refits with either held.
    linear, fold = by_effect["linear_damping"], by_effect["fold_inertia"]
    assert linear.value < linear.number.value < fold.value
    number = after.fit[INLET]
    for one in by_effect.values():
        assert one.low_95 <= number.low < TRUE_INLET < number.high <= one.high_95
    text = confounders_in_words(tuple(by_effect.values()))
    assert f"because of linear_damping (b up to {linear.limit:.2g} N·s/m)" in text
    assert f"because of fold_inertia (η up to {fold.limit:.2g})" in text


def test_a_size_that_stands_alone_carries_no_warning(after: MisfitTests) -> None:
    assert confounders_of(after, ["air_drag"]) == ()


def test_measurement_effects_are_no_part_of_a_size(after: MisfitTests) -> None:
    kinds = {effect.name: effect.kind for effect in after.effects}
    assert {kinds[one.effect] for one in confounders_of(after, ["inlet_loss"])} == {"physical"}


@pytest.mark.parametrize(("estimate", "sigma"), [(0.3, 0.2), (-0.5, 0.4), (2.0, 5.0)])
def test_what_trajectories_and_plausibility_say_of_a_size_is_the_posterior_by_quadrature(
    estimate: float, sigma: float
) -> None:
    parameter = Parameter("C", "C", "1", 1.0, bounds=(0.0, math.inf), plausible=(0.0, 2.0))

    def density(size: float) -> float:
        return float(norm.pdf(size, estimate, sigma) * norm.pdf(size, 0.0, 2.0 / 1.959964))

    whole = quad(density, 0, 20)[0]
    mean = quad(lambda size: size * density(size), 0, 20)[0] / whole
    variance = quad(lambda size: (size - mean) ** 2 * density(size), 0, 20)[0] / whole
    got_mean, got_sd, limit = size_not_excluded(estimate, sigma, parameter)
    assert (got_mean, got_sd) == pytest.approx((mean, math.sqrt(variance)), rel=1e-6)
    assert quad(density, 0, limit)[0] / whole == pytest.approx(0.95, abs=1e-6)


def test_a_size_of_either_sign_has_its_limit_on_the_side_that_the_data_favour() -> None:
    parameter = Parameter("e", "ε", "1", 0.0, plausible=(-0.1, 0.1))
    precision = 1 / 0.02**2 + (1.959964 / 0.1) ** 2
    for estimate in (0.03, -0.03):
        mean, sd, limit = size_not_excluded(estimate, 0.02, parameter)
        assert (mean, sd) == pytest.approx((estimate / 0.02**2 / precision, precision**-0.5), rel=1e-6)
        assert limit == pytest.approx(mean + np.sign(estimate) * 1.644854 * sd, rel=1e-6)
