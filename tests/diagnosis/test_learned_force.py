"""The force that a model lacks: its algebra against closed forms, hidden forces, their laws and effect files."""

import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from grown import FORCES, effect_file, grown, hidden_force, pairs_of, sheet
from hidden import make
from scipy.interpolate import BSpline
from scipy.stats import multivariate_normal

import vinetrack as vt
from vinetrack.core.records import Floats
from vinetrack.diagnosis import force_inversion as inversion
from vinetrack.diagnosis import missing_force as learning
from vinetrack.diagnosis.ladder import align_trials
from vinetrack.diagnosis.missing_force import MissingForce, RankedLaw, missing_force
from vinetrack.diagnosis.propose import effect_text, propose, table_text
from vinetrack.dynamics.simulate import simulate_many
from vinetrack.effects import own_effects
from vinetrack.inference import gaussian_processes as smooth
from vinetrack.inference.sensitivity import PRESSURE, RELEASE

GROWTH = learning.Domain((learning.Axis("growth", 0.0, 0.25, 12),))
FAR = math.sqrt(5) / 0.4
ALIKE = (1 + FAR + FAR**2 / 3) * math.exp(-FAR)
"""Covariance of the ends of a variable at a length of 0.4: Rasmussen & Williams 2006, eq. 4.17."""
DOMAINS = [
    learning.Domain((learning.Axis("growth", 0.0, 0.25, 24),)),
    learning.Domain((learning.Axis("growth", 0.0, 0.25, 12), learning.Axis("speed", 0.0, 8.0, 8, 8.0 / 1.3))),
    learning.Domain((learning.Axis("time", 0.0, 0.4, 8, 0.4 / 0.1), learning.Axis("pressure", 1e4, 3e4, 5))),
]


def test_the_process_has_the_matern_covariance_and_may_be_conditioned_on_its_first_value():
    root = smooth.root_of_covariance(12, 0.4)
    covariance = root @ root.T
    assert np.diag(covariance) == pytest.approx(np.ones(12))
    # The second and the last but one lie at the ends: one whole apart.
    assert covariance[1, -2] == pytest.approx(ALIKE)
    root = smooth.root_of_covariance(12, 0.4, zero_at_start=True)
    ends = smooth.splines(np.array([0.0, 1.0]), 12)
    assert ends @ root @ root.T @ ends[0] == pytest.approx(np.zeros(2), abs=1e-12)


def test_splines_equal_those_of_scipy():
    at = np.random.default_rng(6).uniform(-0.2, 1.2, 300)
    expected = BSpline.design_matrix(np.clip(at, 0, 1), (np.arange(16) - 3) / 9, 3).toarray()
    assert smooth.splines(at, 12) == pytest.approx(expected, abs=1e-14)


@pytest.mark.slow
def test_a_force_without_a_formula_is_learned_and_proposed_as_a_table_that_explains_the_misfit(tmp_path):
    pairs = hidden_force(sheet((4,), replicates=2), 131, "waves", -0.3, tmp_path)
    proposal = propose(vt.base_model(), pairs, lambda _: None)
    table = proposal.table
    assert table.effect.name == "learned_growth"
    size = next(number for number in table.ratio.fit.numbers if number.key == "learned_growth.a")
    assert size.value == pytest.approx(1.0, abs=0.1)
    assert table.ratio.fit.chi2_per_dof < 1.5 < proposal.before.chi2_per_dof
    learned = missing_force(proposal.before).learned
    assert learned.domain.variables == ("growth",)
    assert sum(learned.weights.values()) == pytest.approx(1.0)
    grid = learned.table[(learned.table["condition"] == "") & (learned.table["trials"] > 0)]
    y = grid["lead_position_m"].to_numpy(float)
    middle = (y > np.quantile(y, 0.05)) & (y < np.quantile(y, 0.95))
    # A constant is taken over by the yield pressure.
    off = grid["force_N"].to_numpy(float) + 0.3 * np.sin(2 * math.pi * (y / 0.12) ** 1.5)
    assert np.mean(np.abs(off - np.median(off))[middle] < 0.06) > 0.8


def test_evidence_mean_and_covariance_are_those_of_the_mixture_over_hyperparameters():
    """Each length scale and amplitude by the normal distribution of the positions, weighted by its density."""
    draw = np.random.default_rng(3)
    design = smooth.splines(draw.uniform(0, 1, 60), 12)
    positions = design @ draw.standard_normal(12) + draw.standard_normal(60)
    sizes, hypotheses = np.geomspace(0.1, 3.0, 4), GROWTH.hypotheses
    assert {start for start, _ in hypotheses} == {"nothing", "a constant"}
    modes = [GROWTH.modes(*each) for each in hypotheses]
    found = smooth.posterior(design.T @ design, design.T @ positions, modes, sizes)
    logs, means, covariances = [], [], []
    for each in modes:
        for prior in (each @ each.T) * sizes[:, None, None] ** 2:
            predicted = np.eye(60) + design @ prior @ design.T
            gain = prior @ np.linalg.solve(predicted, design).T
            logs.append(multivariate_normal(cov=predicted).logpdf(positions))
            means.append(gain @ positions)
            covariances.append(prior - gain @ design @ prior)
    without = multivariate_normal(cov=np.eye(60)).logpdf(positions)
    assert found.log_evidence == pytest.approx(np.log(np.mean(np.exp(logs))) - without, abs=1e-6)
    assert (found.hypothesis, found.amplitude) == (np.argmax(logs) // 4, sizes[np.argmax(logs) % 4])
    density = np.exp(np.array(logs) - max(logs))
    weights = density * (density > math.exp(-smooth.NEGLIGIBLE_LOG_RATIO))
    weights /= weights.sum()
    mean = weights @ means
    spread = np.tensordot(weights, covariances, 1) + ((means - mean).T * weights) @ (means - mean)
    assert found.mean == pytest.approx(mean, abs=1e-9)
    assert found.covariance == pytest.approx(spread, abs=1e-9)
    # Several sets of coefficients share the hyperparameters: of twice the same, the evidence is that of both.
    both = smooth.posterior(np.array([design.T @ design] * 2), np.array([design.T @ positions] * 2), modes, sizes)
    assert both.log_evidence == pytest.approx(np.log(np.mean(np.exp(2 * (np.array(logs) - without)))), abs=1e-6)


def test_one_variable_and_two_have_equal_prior_odds():
    weights = learning.variable_weights(dict.fromkeys(("growth", "growth+speed", "growth+time"), 3.0))
    assert weights["growth"] == pytest.approx(0.5)
    assert weights["growth+speed"] == pytest.approx(0.25)


def test_a_spring_under_a_constant_force_oscillates_about_its_new_equilibrium():
    """ẍ = 1 − ω²x from rest: x = (1 − cos ωt)/ω²."""
    omega, time_s = 20.0, np.linspace(0, 0.3, 401)[None]
    pushed = np.full_like(time_s, -(omega**2)), 0 * time_s, np.ones((*time_s.shape, 1))
    moved, sped = inversion.integrate_responses(time_s, *pushed)
    assert moved[0, :, 0] == pytest.approx((1 - np.cos(omega * time_s[0])) / omega**2, abs=1e-4 / omega**2)
    assert sped[0, :, 0] == pytest.approx(np.sin(omega * time_s[0]) / omega, abs=1e-4 / omega)
    # A spring far too stiff for the steps is at rest there: the method is L-stable.
    stiff, _ = inversion.integrate_responses(time_s, -1e10 + 0 * time_s, *pushed[1:])
    assert stiff[0, -1, 0] == pytest.approx(1e-10)


def test_a_step_that_leaves_a_trial_without_points_leads_where_nothing_can_be_computed(tmp_path):
    pairs = hidden_force(sheet((4,), 2), 231, "square", -1.2, tmp_path)
    problem = inversion.ForceProblem(vt.fit(vt.base_model(), pairs))
    domain = learning.candidate_domains(problem.start.motions)[0]
    late = replace(problem.start, trial_effects=problem.start.trial_effects - [0.0, 1.0, 0.0, 0.0])
    with pytest.raises(np.linalg.LinAlgError):
        inversion.ForceEquations(problem, late, domain.unit_push)


def test_the_response_to_a_pressure_deviation_includes_a_force_that_depends_on_pressure(tmp_path):
    pairs = hidden_force(sheet((4,), 2), 231, "square", -1.2, tmp_path)
    slowed = inversion.ForceProblem(vt.fit(vt.base_model(), pairs))
    tracks, theta = slowed.start, slowed.start.theta
    domains = learning.candidate_domains(tracks.motions)
    domain = next(each for each in domains if each.variables == ("growth", "pressure"))
    growth, pressure = (smooth.splines(np.linspace(0, 1, 40), count) for count in domain.counts)
    steep = [np.linalg.lstsq(columns, np.linspace(0, 1, 40), rcond=None)[0] for columns in (growth, pressure)]
    force = -0.5 * np.outer(*steep).ravel()

    def at(effects: Floats, motions, times: int) -> inversion.ForcePoint:
        """The point with motions that obey the equation of motion."""
        push = lambda motion: domain.unit_push(motion) @ force  # noqa: E731
        for _ in range(times):
            point = slowed.point(theta, effects, motions, push)
            equations = inversion.ForceEquations(slowed, point, domain.unit_push, force)
            defects = [columns[:, -1:] for columns in equations.accelerations]
            moved = zip(point.motions, defects, *inversion._responses(point.motions, defects), strict=True)
            motions = [inversion._moved(motion, *(each[:, 0] for each in change)) for motion, *change in moved]
        return slowed.point(theta, effects, motions, push)

    settled = at(tracks.trial_effects, tracks.motions, 12)
    columns = [each[:, :1] for each in settled.by_parameters]
    (slope, *_) = inversion.acceleration_sensitivities(slowed.fit, settled.trial_effects, settled.motions, columns)
    since_s, positions = slowed.data[0].time_s - settled.trial_effects[0, RELEASE], []
    for step in (-1e-4, 1e-4):
        effects = settled.trial_effects.copy()
        effects[0, PRESSURE] += step
        positions.append(inversion._observed(at(effects, settled.motions, 3).motions[0], since_s)[0])
    exact = (positions[1] - positions[0]) / 2e-4
    assert slope[:, 0] == pytest.approx(exact, abs=0.005 * np.abs(exact).max())


def missing_from(folder: Path, name: str, size_N: float, seed: int) -> MissingForce:
    pairs = hidden_force(sheet((4,)), seed, name, size_N, folder)
    return missing_force(vt.fit(vt.base_model(), pairs))


@pytest.mark.slow
def test_a_rough_patch_is_learned_where_it_is_in_every_condition_and_is_no_simple_law(tmp_path):
    patch = missing_from(tmp_path, "patch", -0.4, 91)
    assert patch.sentence.code in ("like_no_law", "no_law_agreed_on")
    assert patch.learned.domain.variables == ("growth",)
    along = patch.learned.table[patch.learned.table["condition"] != ""]
    assert along[["lead_position_m", "tail_velocity_m_s", "time_s", "pressure_Pa"]].notna().all(axis=None)
    for _, one in along.groupby("condition"):
        lowest = one.loc[one["force_N"].idxmin()]
        assert 0.12 < lowest["lead_position_m"] < 0.15
        assert -0.6 < lowest["force_N"] - one["force_N"].median() < -0.3


@pytest.mark.slow
def test_nothing_is_learned_about_tracks_along_which_the_model_is_unstable():
    """Two of forty trials would move by 10^6 times their growth if their pressures deviated as usual."""
    fit = vt.fit(vt.base_model(), list(make("outsider:squeeze", 40001).pairs))
    assert missing_force(fit).learned is None


@pytest.mark.slow
def test_a_friction_that_falls_with_speed_depends_on_speed(tmp_path):
    assert missing_from(tmp_path, "stribeck", -1.5, 93).learned.domain.variables == ("speed",)


def test_sensitivities_to_a_force_equal_differences_of_simulations(tmp_path):
    """With a much tighter integrator tolerance than usual, because a narrow force lies between its usual steps."""
    model = vt.base_model() + vt.effects.reservoir_depletion
    virtual = grown(sheet(payloads_g=(0.0, 20.0), replicates=1), 98, ["reservoir_depletion"])
    found = vt.fit(model, pairs_of(virtual))
    own = align_trials(found).trial_effects
    motions = inversion.motions_of(found, own)
    shapes = {
        "bump": lambda m: np.exp(-0.5 * ((m.lead_position_m - 0.08) / 0.01) ** 2),
        "slow": lambda m: 1 / (0.3 + m.tail_velocity_m_s),
    }
    pushes = [np.column_stack([f(m) for f in shapes.values()]) / m.mass_kg[:, None] for m in motions]
    answers = inversion.acceleration_sensitivities(found, own, motions, pushes)
    jobs = found.predictor.jobs(found.solution.state.theta, own)
    times = [item.time_s - job.release_s for item, job in zip(found.predictor.data, jobs, strict=True)]
    with_force, trials = model + own_effects([effect_file(tmp_path)])["hidden"], [motion.trial for motion in motions]
    for k, name in enumerate(shapes):
        moved = []
        for step in (1e-3, -1e-3):
            rows = np.array([[*job.row, step, float(list(FORCES).index(name))] for job in jobs])
            moved.append(simulate_many(with_force, trials, times, parameters=rows, relative_tolerance=1e-7))
        for answer, more, less in zip(answers, *moved, strict=True):
            exact = (more.observed_position_m - less.observed_position_m) / 2e-3
            ended = (more.time_s >= more.end_time_s) | (less.time_s >= less.end_time_s)  # NaN: growth goes on
            off = (answer[:, k] - exact)[~ended]
            assert np.max(np.abs(off)) < 2e-3 * np.max(np.abs(exact))


def learned(domain: learning.Domain, seed: int) -> learning.LearnedForce:
    count = math.prod(domain.counts)
    known = np.random.default_rng(seed).standard_normal(count), np.eye(count) * 1e-4
    where = {"lead_position_m": 0.1, "tail_velocity_m_s": 2.0, "time_s": 0.1, "pressure_Pa": 2e4, "is_visited": True}
    motion = SimpleNamespace(**{name: np.array([value]) for name, value in where.items()})
    motion.trial = SimpleNamespace(condition="one")
    found, weights = smooth.Posterior(*known, 50.0, 0, 0.1), {domain.name: 1.0}
    return learning.LearnedForce(domain, found, [motion], weights, (), 0.99, True)


@pytest.mark.parametrize("domain", DOMAINS, ids=lambda domain: domain.name)
def test_the_effect_file_reproduces_the_learned_force_over_the_visited_range(domain, tmp_path):
    force = learned(domain, 4)
    path = tmp_path / "learned.py"
    path.write_text(table_text(force, "From 24 trials of a bench."), encoding="utf-8")
    effect = own_effects([path])[path.stem]
    draw = np.random.default_rng(5)
    at = [draw.uniform(axis.low - 0.1 * (axis.high - axis.low), axis.high * 1.2, 40) for axis in domain.axes]
    names = {"growth": "lead_position", "speed": "tail_velocity", "time": "time", "pressure": "pressure"}
    state = SimpleNamespace(**{names[name]: value for name, value in zip(domain.variables, at, strict=True)})
    expected = domain.basis(at) @ force.found.mean
    shown = effect.functions["tail_force"](state, None, 1.0)
    assert shown == pytest.approx(expected, abs=1e-4 * np.abs(expected).max())
    assert effect.functions["tail_force"](state, None, 0.0) == pytest.approx(0.0 * expected)


@pytest.mark.parametrize("law", [learning.Law(powers, peak=7.0) for powers in learning.LAWS], ids=lambda law: law.name)
def test_the_effect_file_of_a_law_reproduces_the_law(law, tmp_path):
    path = tmp_path / f"proposed_{law.name}.py"
    estimate = inversion.ForceEstimate(0.0, np.array([-0.2]), 0.01, 1.0)
    path.write_text(effect_text(RankedLaw(law, estimate, 0.0), "From 24 trials of a bench."), encoding="utf-8")
    # Its worked number comes from the law, its function from the formula: reading it holds one against the other.
    effect = own_effects([path])[path.stem]
    assert effect.worked[0].expected != 0


@pytest.mark.slow
def test_a_force_that_grows_with_time_is_proposed_and_predicts_left_out_conditions(tmp_path):
    pairs = hidden_force(sheet((4,)), 101, "growing", -0.3, tmp_path)
    proposal = propose(vt.base_model(), pairs, lambda _: None)
    best = proposal.tied[0]
    assert best.effect.name == "proposed_time"
    rate = next(number for number in best.ratio.fit.numbers if number.key == "proposed_time.k")
    assert rate.low < -0.3 / 0.2 < rate.high
    assert best.rms_left_out_m < proposal.rms_left_out_m


@pytest.mark.slow
def test_nothing_is_proposed_where_nothing_is_missing():
    proposal = propose(vt.base_model(), pairs_of(grown(sheet((4,)), 102)), lambda _: None)
    assert not proposal.tied
    assert np.isfinite(proposal.rms_left_out_m)
