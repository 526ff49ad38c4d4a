"""Power of the score tests by linear theory: the size of every candidate that is detected with a given probability.

The diagnosis calls a candidate missing when its score, in standard errors, exceeds the threshold c of that candidate
(`family_test`). With an effect of size a the score of shape j is normal,

    z_j ~ N(μ_j(a), 1),   μ_j(a) = I_jk a / √I_jj,   corr(z_i, z_j) = I_ij / √(I_ii I_jj)

where k is the shape of the effect and I the information between shapes, with free parameters and trial effects
projected out. A size is therefore detected with probability p at a_p = σ (c + Φ⁻¹(p)), σ = 1/√I_kk; refined for finite
sizes (`score_ratios`), scatter of single trials (`_required_means`), and misfit taken for scatter (`error_inflation`).
"""

from __future__ import annotations

import itertools
import math
import warnings
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.special import ndtr, stdtrit

from vinetrack.core.problems import Remark, remark
from vinetrack.core.records import END_FRACTION, Floats, Track, Trial, plain_track
from vinetrack.diagnosis.hypotheses import ANSWER_SET_DELTA_CHI2, CREDIBLE_RANGE_FACTOR
from vinetrack.diagnosis.ladder import candidates_of
from vinetrack.diagnosis.misfit_tests import (
    FALSE_ALARM_LEVEL_FIRST_ROUND,
    PROBE_LEVEL,
    CandidateShape,
    MisfitTests,
    exceeds_slow_errors,
    level_of,
    misfit_tests,
    plausible_range,
    products_of,
    scores_of,
    testable,
)
from vinetrack.diagnosis.result import ADEQUATE, PROBABILITIES, EffectPower, Power, PowerInput, SimulatedRates
from vinetrack.dynamics.model import Model, host_for, make_model
from vinetrack.dynamics.simulate import SimulationError, Trajectory, simulate_many
from vinetrack.effects import Effect, EffectError
from vinetrack.experiment.schema import GROUPINGS
from vinetrack.inference.errors import FEWEST_CLUSTERS
from vinetrack.inference.fit import fit
from vinetrack.inference.fit_data import FitError, FitTrial
from vinetrack.inference.fit_result import DAMPING, EXPONENT, Fit
from vinetrack.inference.marginal_likelihood import DEVIATION_COLUMNS, matrix_root
from vinetrack.inference.optimiser import FixedTerms, estimable, solve
from vinetrack.inference.sensitivity import ORIGIN, RELEASE, Predictor
from vinetrack.planning.candidate_trials import at_solution, extended_fit, tracks_of
from vinetrack.tracks.importers import FEWEST_POINTS
from vinetrack.tracks.position_noise import ar1_noise

# ------------------------------------------------------------------------------
# Expected scores of effects of finite size. Free parameters that nearly imitate an effect move by many standard errors
# before it becomes detectable, and sensitivities change. So the effect is put into noise-free trajectories, the model
# without it is fitted to them with noise and between-trial standard deviations held, and the score is computed there:
# the Asimov data set of Cowan, Cranmer, Gross & Vitells, European Physical Journal C 71, 1554, 2011.


def noiseless_start(fit: Fit) -> Fit:
    """The fit with the deviations of its trials set to zero, linearised there: the same start for every effect."""
    trial_effects = fit.state.trial_effects.copy()
    trial_effects[:, DEVIATION_COLUMNS] = 0.0
    solution = replace(fit.solution, state=replace(fit.state, trial_effects=trial_effects))
    return extended_fit(replace(fit, solution=solution), ())


def score_ratios(tests: MisfitTests, shape_index: int, unit: float, start: Fit) -> tuple[Floats, Floats]:
    """Sizes of an effect and the ratios of its expected scores there to those of linear theory, up to a score above any
    threshold. Shape (n_sizes,) each.
    """
    multiples, ratios = list[float](), list[float]()
    # (4.0, …): multiples of the size of one standard error at which the score is computed (chosen)
    for multiple in (4.0, 7.0, 14.0, 28.0, 56.0):
        ratio = score_ratio(tests, shape_index, multiple * unit, start)
        # 2.0: ratio of an expected score to that of linear theory from which neither is used (chosen)
        if not 0 < ratio < 2.0:
            break
        multiples.append(multiple)
        ratios.append(ratio)
        # 6.5: expected score from which no larger size is tried (chosen)
        if ratio * multiple > 6.5:
            break
    return unit * np.array(multiples or [7.0]), np.array(ratios or [1.0])


def score_ratio(tests: MisfitTests, shape_index: int, size: float, start: Fit) -> float:
    """Expected score of an effect at a size, divided by that of linear theory. NaN where the trajectories with the
    effect cannot be simulated, or the fit without it does not converge.
    """
    shape, sigma = tests.products.shapes[shape_index], float(tests.scores.plain_sigma[shape_index])
    try:
        refit = fitted_without(start, shape, size)
        scores = scores_of(refit, products_of(refit, [shape]))
    except (SimulationError, np.linalg.LinAlgError):
        return math.nan
    if not refit.solution.converged or not scores.score.size:
        return math.nan
    return float(scores.size[0] / scores.plain_sigma[0]) / (size / sigma)


def fitted_without(start: Fit, shape: CandidateShape, size: float) -> Fit:
    """Fit the model of a fit to noise-free trajectories with an effect; noise and between-trial scatter are held."""
    state, before = start.state, start.predictor
    jobs = before.jobs(state.theta, state.trial_effects).with_effect([shape.size.zero + size, *shape.other_values])
    moved = before.run(jobs, model=start.model + shape.effect)
    data = list(map(_as_moved, before.data, moved, state.trial_effects[:, ORIGIN]))
    if any(trial_data.time_s.size < FEWEST_POINTS or not np.ptp(trial_data.lead_position_m) > 0 for trial_data in data):
        raise SimulationError(f"With {shape.effect.name} at that size a trial does not move.")
    predictor = Predictor(before.layout, data, before.host).with_steps_of(before)
    held = FixedTerms(spread=state.spread, noise=(state.rho, state.variance))
    # 20, 0.2: most Gauss–Newton steps of the fit without the effect, beyond which it is not used (chosen)
    how: dict[str, Any] = {"most_iterations": 20, "least_decrease": 0.2}
    return at_solution(start, solve(predictor, start.solution.problem, state, held, **how))


def _as_moved(trial_data: FitTrial, trajectory: Trajectory, origin_m: float) -> FitTrial:
    """A trial with the positions of a trajectory, at the points that a fit uses: before the last part of the growth.
    Stretches without gaps begin anew behind a gap.
    """
    keep = ~(trajectory.lead_position_m >= END_FRACTION * trial_data.trial.length_m)
    stretch = np.cumsum(trial_data.first | np.concatenate([[False], ~keep[:-1]]))[keep]
    known = {name: getattr(trial_data, name) for name in ("time_s", "stated_m", "slow_m", "relative_sd")}
    of_points: dict[str, Any] = {name: None if values is None else values[keep] for name, values in known.items()}
    first = np.concatenate([[True], np.diff(stretch) > 0])
    position_m = origin_m + trajectory.observed_position_m[keep]
    return replace(trial_data, lead_position_m=position_m, first=first, **of_points)


# ------------------------------------------------------------------------------
# Detectable sizes: the distribution of every score at a size, against the threshold of its candidate.

DRAWS = 4000  # Draws of the normal distributions (derived)

# Scores at the true standard deviations for which the inflation is tabulated (chosen)
SCORE_GRID = np.linspace(0.0, 40.0, 401)


def power_of(
    tests: MisfitTests,
    not_testable: Mapping[str, Remark] | None = None,
    inputs: Sequence[PowerInput] = (),
    only: str = "",
) -> Power:
    """Compute which effects, or `only` one, at which sizes, a diagnosis of these trials and model can detect."""
    tests = replace(tests, level=level_of(tests.fit.model))
    # Planned trials, whose noise is stated; a diagnosis, of measured ones, can afford linear theory.
    start = noiseless_start(tests.fit) if tests.fit.solution.noise_held else None
    # Draws of the scores of all shapes where nothing is missing, shape (DRAWS, n_shapes)
    normal = np.random.default_rng(5).standard_normal((DRAWS, len(tests.signs)))
    known = normal @ matrix_root(tests.scores.cosines).T, error_inflation(tests)
    asked = [effect for effect in tests.effects if only in ("", effect.name)]
    powers = [_effect_power(tests, effect, start, *known) for effect in asked]
    return Power(
        n_trials=len(tests.fit.trials),
        false_alarm_rate=_false_alarm_rate(tests.fit),
        effects=tuple(power for power in powers if power is not None),
        not_testable={**(not_testable or {}), **dict.fromkeys(tests.products.silent, remark("no_response"))},
        numbers=tuple(number for number in tests.fit.numbers if number.key in (DAMPING, EXPONENT)),
        inputs=tuple(inputs or _inputs_of_fit(tests.fit)),
        model=tests.fit.model.names,
        wary=remark("excess_counted_as_noise") if exceeds_slow_errors(tests.fit) else Remark(),
    )


def _inputs_of_fit(fit: Fit) -> list[PowerInput]:
    """Noise and between-trial standard deviations that a fit estimated or was given."""
    noise = f"{1e3 * fit.noise_m:.3g} mm, correlation {fit.noise_correlation:.2f}"
    rows = [PowerInput("noise of a position", noise, "fit")]
    for name, spread in fit.spreads.items():
        origin = "fit" if spread.estimated else "assumed, not estimated"
        rows.append(PowerInput(f"spread of {name} from trial to trial", f"{100 * spread.value:.2g} %", origin))
    return rows


def typical_shapes(tests: MisfitTests, name: str) -> list[int]:
    """Indices of the shapes that represent an effect of one size for all vines: the middle small step, else all finite
    sizes, the largest last; none where no trial has information about it.
    """
    shapes, has_information = tests.products.shapes, np.diag(tests.scores.information) > 0
    for_all = [k for k, shape in enumerate(shapes) if shape.effect.name == name and not shape.group]
    indices = [k for k in for_all if has_information[k]]
    small = [k for k in indices if not shapes[k].whole]
    return [small[len(small) // 2]] if small else sorted(indices, key=lambda k: abs(shapes[k].step))


def _ends(shape: CandidateShape) -> tuple[float, float]:
    """Ends of the plausible range of a size as deviations from absence, the nearer first; 0 and 1 without a size."""
    if not shape.effect.parameters:
        return 0.0, 1.0
    near, far = sorted((end - shape.size.zero for end in plausible_range(shape.size)), key=abs)
    return near, far


def _sided(scores: Floats, signs: Sequence[int]) -> Floats:
    """Scores of one-sided tests with their sign, of two-sided ones in absolute value, as in the diagnosis."""
    sided = np.array(signs)
    return np.asarray(np.where(sided == 0, np.abs(scores), scores * sided))


def _effect_power(
    tests: MisfitTests, effect: Effect, start: Fit | None, null_scores: Floats, inflation: Floats
) -> EffectPower | None:
    """Detectable sizes of one effect, and how often others score higher at the size detected with 90 %; those of finite
    size from linear theory, without `start`.
    """
    typical = typical_shapes(tests, effect.name)
    if not typical:
        return None
    shapes = [tests.products.shapes[k] for k in typical]
    shape, (near, far) = shapes[0], _ends(shapes[0])
    # Sizes (deviations from absence in SI, increasing in absolute value), and the expected scores of all shapes there
    information = tests.scores.information
    root = np.sqrt(np.maximum(np.diag(information), 1e-300))
    sizes = np.array([one.step for one in shapes] if shape.whole else [math.copysign(1 / root[typical[0]], far)])
    scores = information[typical] * sizes[:, None] / root
    if start is not None and not shape.whole:
        unit = float(sizes[0])
        sizes, ratios = score_ratios(tests, typical[0], unit, start)
        scores = scores[0] * (ratios * sizes / unit)[:, None]
    scores = np.where(np.diag(information) > 0, scores, 0.0)
    indices = [k for k, name in enumerate(tests.products.effects) if name == effect.name]
    expected = _sided(scores, tests.signs)
    index = max(indices, key=lambda k: float(expected[-1, k]))
    means = np.maximum.accumulate(np.maximum(expected[:, index], 0.0))
    if not means[-1] > 0:
        return None
    needed = np.quantile(_required_means(tests, index, inflation[:, index]), PROBABILITIES)
    # The sizes at which the score has these means, and the expected scores of all shapes at that of 90 %
    steps = _along(needed, means, sizes)
    at_90, taken_for = steps[PROBABILITIES.index(0.9)], dict[str, float]()
    if math.isfinite(at_90):
        there = np.array([_along(np.abs(at_90), np.abs(sizes), of_shape) for of_shape in scores.T])
        taken_for = _confusion(tests, effect, there, null_scores)
    zero, of_size = 0.0, {"parameter": "", "symbol": "size", "unit": "1"}
    if effect.parameters:
        size = shape.size
        zero, of_size = size.zero, {"parameter": f"{effect.name}.{size.name}", "symbol": size.symbol, "unit": size.unit}
    return EffectPower(
        effect=effect.name,
        kind=effect.kind,
        **of_size,
        zero=zero,
        least=zero + near if near * far > 0 else zero,
        largest=zero + far,
        sizes=tuple((zero + steps).tolist()),
        taken_for=taken_for,
        other_values=shape.other_values,
        pressure_unit=tests.fit.trials[0].trial.pressure_unit,
    )


def _along(at: Floats, x: Floats, y: Floats) -> Floats:
    """A curve from 0 through these points, straight between them, proportional beyond the last. Shapes: x, y (n,)."""
    return np.asarray(np.where(at >= x[-1], y[-1] * at / x[-1], np.interp(at, [0.0, *x], [0.0, *y])))


def _required_means(tests: MisfitTests, index: int, inflation: Floats) -> Floats:
    """For each draw of the noise, the mean that the score of a shape needs to exceed both thresholds: that of the noise
    model, and that of Student's t with the standard error found from the scatter of single trials.
    """
    scores = tests.scores
    limit = tests.family[tests.products.effects[index]]
    passes = SCORE_GRID / inflation >= limit
    threshold = float(SCORE_GRID[np.argmax(passes)]) if passes.any() else math.inf
    draw = np.random.default_rng(5)
    by_trial = np.maximum(scores.trial_informations[:, index], 0.0)
    trials, total = by_trial.size, float(by_trial.sum())
    if trials < FEWEST_CLUSTERS or not total > 0:
        return threshold - draw.standard_normal(DRAWS)
    share = by_trial / total
    noise = draw.standard_normal((DRAWS, trials))
    score = noise @ np.sqrt(share)
    residual = np.sqrt(share) * noise - share * score[:, None]
    residual = residual - residual.mean(axis=1, keepdims=True)
    ratio = np.sqrt(np.sum(residual**2, axis=1) * trials / scores.degrees)
    t_threshold = -float(stdtrit(max(scores.degrees, 3.0), ndtr(-limit)))
    return np.asarray(np.maximum(threshold, t_threshold * ratio) - score)


def error_inflation(tests: MisfitTests) -> Floats:
    """Factor by which the standard error of every shape grows because the fit takes part of the effect for scatter. The
    between-trial standard deviations of pressure and B are estimated without the effect. Multiplied by f_P and f_B they
    are those that minimise

        Σ_s ν (ln f_s² + 1 / f_s²) + x² I(f_P, f_B) / I(1, 1)

    for an effect whose score x at the true standard deviations would be one of `SCORE_GRID`; 1 where they are not
    estimated, or from hundreds of trials. Shape (n_scores, n_shapes).
    """
    fit, scores = tests.fit, tests.scores
    # 256: trials from which what the fit takes for scatter is not computed: it is little, and takes long (chosen)
    if len(fit.trials) > 256:
        return np.ones((SCORE_GRID.size, len(scores.score)))
    # Factors on the between-trial standard deviations at which the information is computed (chosen)
    factors = [(1.0, 1.1, 1.25, 1.45, 1.75, 2.2, 3.0) if free else (1.0,) for free in estimable(fit.solution.problem)]
    pairs = np.array(list(itertools.product(*factors)))
    spreads = [(pressure, damping) for pressure, damping in (pairs * fit.state.spread).tolist()]
    penalties = scores.degrees * np.sum(2 * np.log(pairs) + 1 / pairs**2 - 1, axis=1)
    states = [replace(fit.state, spread=spread) for spread in spreads]
    information = np.array([np.diag(scores_of(fit, tests.products, state).information) for state in states])
    remaining = np.clip(information / np.maximum(np.diag(scores.information), 1e-300), 1e-6, 1.0)
    costs = penalties[None, :, None] + SCORE_GRID[:, None, None] ** 2 * remaining
    best = np.argmin(costs, axis=1)
    return np.asarray(1 / np.sqrt(np.take_along_axis(remaining, best, axis=0)))


def _confusion(tests: MisfitTests, effect: Effect, mean: Floats, null_scores: Floats) -> dict[str, float]:
    """How often each other candidate scores highest at a size, whose scores have this mean, among draws in which any
    candidate exceeds its threshold. A score counts where its size is credible, see `hypotheses`; an effect that
    contains another as a limit, be it this one or its rival, must be better by the Δχ² of the answer set.
    """
    drawn, effects = null_scores + mean, np.array(tests.products.effects)
    far = [abs(_ends(shape)[1]) if shape.effect.parameters else math.inf for shape in tests.products.shapes]
    with np.errstate(invalid="ignore"):
        credible = np.abs(drawn) <= CREDIBLE_RANGE_FACTOR * np.array(far) / tests.scores.plain_sigma + 3.0
    counted = np.maximum(np.where(credible, _sided(drawn, tests.signs), 0.0), 0.0) ** 2
    names = list(dict.fromkeys(tests.products.effects))
    squares = np.stack([counted[:, effects == name].max(axis=1) for name in names], axis=1)
    limits = np.array([tests.family[name] for name in names])
    alarm = np.any(squares > limits**2, axis=1)
    if np.count_nonzero(alarm) < DRAWS / 100:
        return {}
    containing = {other.name for other in tests.effects if effect.name in other.replaces}
    if any(name in effect.replaces for name in names):
        containing.add(effect.name)
    squares[:, [name in containing for name in names]] -= ANSWER_SET_DELTA_CHI2
    highest = np.argmax(squares[alarm], axis=1)
    rates = {name: float(np.mean(highest == k)) for k, name in enumerate(names) if name != effect.name}
    # 0.05: probability from which another candidate is listed (chosen)
    listed = sorted((name for name in rates if rates[name] >= 0.05), key=lambda name: -rates[name])
    return {name: rates[name] for name in listed}


def _false_alarm_rate(fit: Fit) -> float:
    """Upper bound on the false-alarm rate of the first round: the sum of the levels of its tests, of all candidates, of
    any smooth force, of replicates that err alike, and of specimens, days or the order where they are stated.
    """
    level, trials = FALSE_ALARM_LEVEL_FIRST_ROUND, [trial.trial for trial in fit.trials]
    stated = any(math.isfinite(trial.order) or any(getattr(trial, name) for name in GROUPINGS) for trial in trials)
    return level + min(PROBE_LEVEL, level) + 0.1 * level + level * stated


# ------------------------------------------------------------------------------
# Tests of a campaign: of trials that were fitted, or of planned ones, simulated without noise and tested with the noise
# and between-trial scatter expected of them.


def fitted_tests(fitted: Fit, candidates: Sequence[str] | None = None) -> tuple[MisfitTests, dict[str, Remark]]:
    """Misfit tests of a fit with all candidates, and the reasons by name of those that cannot act with this sheet."""
    tried = candidates_of(fitted.model, candidates, fitted.model.user_effects)
    effects, not_testable = testable(tried, fitted.predictor.data)
    return misfit_tests(fitted, effects, level_of(fitted.model)), not_testable


def planned_tests(
    model: Model,
    trials: Sequence[Trial],
    capture_fps: Sequence[float],
    spreads: tuple[float, float],
    noise: tuple[float, float],
    candidates: Sequence[str] | None = None,
) -> tuple[MisfitTests, dict[str, Remark]]:
    """Misfit tests of a noise-free campaign, under the noise of its positions, m, with its lag-one correlation, and the
    between-trial standard deviations of pressure and B: its scores are zero but for rounding, its information is what
    the campaign would have. `model` has the true values.
    """
    host = host_for(model, candidates_of(model, candidates, model.user_effects))
    rest_frames, longest_s = 20, 8.0  # Frames at rest before release, and growth after which filming ends, s (chosen)
    # Trials are released at different parts of a frame, evenly.
    begins = (np.arange(len(trials)) + 0.5) / len(trials) - rest_frames
    since_release = [
        np.arange(begin, longest_s * fps) / fps for begin, fps in zip(begins.tolist(), capture_fps, strict=True)
    ]
    # 1e-3: part of the stated noise that the noise-free campaign has (chosen)
    draw, rest_m = np.random.default_rng(0), 1e-3 * noise[0]
    pairs: list[tuple[Trial, Track]] = []
    motions = simulate_many(model, trials, since_release, host=host)
    for trial, time_s, moved in zip(trials, since_release, motions, strict=True):
        time_s = time_s[time_s < moved.end_time_s] if moved.status == "ended" else time_s
        position_m = moved.observed_position_m[: time_s.size] + ar1_noise(time_s.size, rest_m, 0.0, draw)
        pairs.append((trial, plain_track(time_s - time_s[0], position_m)))
    to_fit = make_model(model.names, model.user_effects)
    fitted = fit(to_fit, pairs, spreads=spreads, noise=noise, host=host)
    return fitted_tests(fitted, candidates)


# ------------------------------------------------------------------------------
# Simulated campaigns like a fitted one, diagnosed in full as measured ones are: a check on linear theory.


def filmed_again(
    fitted: Fit, draw: np.random.Generator, effect: str = "", values: Sequence[float] = ()
) -> list[tuple[Trial, Track]]:
    """The trials of a fit as its model would have them made once more, with an effect of these values unless it is
    blank; at most as long as they were recorded.
    """
    predictor, state, trials = fitted.predictor, fitted.state, [trial.trial for trial in fitted.trials]
    trial_effects, problem = state.trial_effects.copy(), fitted.solution.problem
    deviations = problem.deviation_sd(state.spread) * draw.standard_normal((len(trials), 2))
    trial_effects[:, DEVIATION_COLUMNS] = np.where(problem.has_deviation, deviations, 0.0)
    trial_effects[:, RELEASE] -= draw.uniform(size=len(trials)) * predictor.frames_s
    jobs = predictor.jobs(state.theta, trial_effects)
    misread = {vine: draw.standard_normal() for vine in dict.fromkeys(trial.vine for trial in trials)}
    stated, wrong = np.transpose([(t.yield_pressure_Pa, t.yield_pressure_sigma_Pa * misread[t.vine]) for t in trials])
    true_Pa = np.where(np.isnan(jobs.yield_pressure_Pa), stated, jobs.yield_pressure_Pa)
    jobs = replace(jobs, yield_pressure_Pa=np.maximum(true_Pa + np.nan_to_num(wrong), 0.0))
    model = fitted.model
    if effect:
        model, jobs = model + effect, jobs.with_effect(values)
    recorded_s = [track.time_s for trial, track in fitted.pairs if trial.name in {one.name for one in trials}]
    return tracks_of(predictor, replace(state, trial_effects=trial_effects), jobs, draw, recorded_s, model)


# What a diagnosis named, blank for nothing, and whether the effect was among it or was added later; None for no verdict
Outcome = tuple[str, bool] | None


def simulated_diagnosis(tests: MisfitTests, effect: str, values: Sequence[float], seed: int) -> Outcome:
    """Simulate one campaign like that of the tests, see `filmed_again`, and diagnose it in full."""
    from vinetrack.diagnosis.diagnose import diagnose

    model, candidates = tests.fit.model, [candidate.name for candidate in tests.effects]
    try:
        pairs = filmed_again(tests.fit, np.random.default_rng([seed, 77]), effect, values)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            diagnosis = diagnose(
                pairs, model=make_model(model.names, model.user_effects), candidates=candidates, ladder=False,
                advice=False, user_effects=model.user_effects,
            )  # fmt: skip
    except (FitError, SimulationError, EffectError, np.linalg.LinAlgError):
        return None
    named = "" if diagnosis.verdict == ADEQUATE else " or ".join(diagnosis.answer_set) or diagnosis.verdict
    return named, effect in (*diagnosis.answer_set, *diagnosis.effects)


def rates_of(effect: str, outcomes: Sequence[Outcome], value: float, promised: float) -> SimulatedRates:
    """Count the outcomes of campaigns with one effect, of this size; with none where it is blank."""
    known = [outcome for outcome in outcomes if outcome is not None]
    named = Counter(name for name, _ in known if name)
    return SimulatedRates(
        effect=effect,
        value=value,
        promised=promised,
        count=sum(found for _, found in known) if effect else named.total(),
        campaigns=len(known),
        named=tuple(named.most_common()),
        failed=len(outcomes) - len(known),
    )
