"""Nonlinear fit of a force: its score against finite differences, and motions beyond the end of growth of the model."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from grown import hidden_force, sheet

import vinetrack as vt
from vinetrack.diagnosis.force_inversion import force_sensitivities, on_tracks, uniform_splines
from vinetrack.diagnosis.force_laws import SearchPoint, _with_updated_motions, normal_equations
from vinetrack.diagnosis.force_surface import SmoothForce, candidate_domains
from vinetrack.diagnosis.missing_force import LinearMisfit, linear_misfit
from vinetrack.inference.fit_result import Fit
from vinetrack.inference.sensitivity import N_TRIAL_EFFECTS, ORIGIN, PRESSURE, RELEASE


@pytest.fixture(scope="module")
def slowed(tmp_path_factory: pytest.TempPathFactory) -> tuple[Fit, LinearMisfit]:
    """Vines with a friction along the growth, fitted by the model without it."""
    pairs = hidden_force(sheet((4,), 2), 231, "square", -1.2, tmp_path_factory.mktemp("slowed"))
    fit = vt.fit(vt.base_model(), pairs, profile=False)
    return fit, linear_misfit(fit)


def test_the_score_of_a_pressure_deviation_includes_a_force_that_depends_on_pressure(
    slowed: tuple[Fit, LinearMisfit],
) -> None:
    """The score of a trial's pressure deviation against a finite difference of the cost."""
    fit, linear = slowed
    domain = next(each for each in candidate_domains(linear.motions) if each.variables == ("growth", "pressure"))
    growth, pressure = (uniform_splines(np.linspace(0, 1, 40), count) for count in domain.counts)
    steep = [np.linalg.lstsq(columns, np.linspace(0, 1, 40), rcond=None)[0] for columns in (growth, pressure)]
    force = -0.5 * np.outer(*steep).ravel()
    effects = linear.inversion.trial_effects
    motions = on_tracks(linear.inversion, effects, linear.motions)
    point = SearchPoint(fit.solution.state.theta, effects, SmoothForce(domain, np.eye(domain.size)), force, motions)
    settled = point
    for _ in range(12):  # where a point far off the tracks is settled depends on where it begins
        settled = _with_updated_motions(fit, settled)
    trial = 0
    mine = point.theta.size + domain.size + trial * N_TRIAL_EFFECTS + PRESSURE
    slope = normal_equations(fit, linear.inversion, settled).score[mine]
    costs = []
    for step in (-1e-4, 1e-4):
        effects = settled.trial_effects.copy()
        effects[trial, PRESSURE] += step
        moved = replace(settled, trial_effects=effects)
        for _ in range(3):
            moved = _with_updated_motions(fit, moved)
        costs.append(normal_equations(fit, linear.inversion, moved).cost)
    assert slope == pytest.approx(-0.5 * (costs[1] - costs[0]) / 2e-4, rel=0.005)


def test_positions_respond_to_a_force_beyond_the_end_of_growth_of_the_model(slowed: tuple[Fit, LinearMisfit]) -> None:
    fit, linear = slowed
    early = [replace(motion, end_s=0.5 * float(motion.time_s[-1])) for motion in linear.motions]
    effects = linear.inversion.trial_effects
    at_tracks = on_tracks(linear.inversion, effects, early)
    assert all(motion.end_s == math.inf for motion in at_tracks)
    answers = force_sensitivities(fit, effects, at_tracks, lambda motion: np.ones((motion.time_s.size, 1)))
    seen = 0
    for i, (data, motion, answer) in enumerate(zip(fit.predictor.data, early, answers, strict=True)):
        since_s = data.time_s - effects[i, RELEASE]
        late = (since_s > motion.end_s) & (data.lead_position_m - effects[i, ORIGIN] < 0.9 * motion.trial.length_m)
        assert np.all(answer[late] > 0)
        seen += int(late.sum())
    assert seen > 20
