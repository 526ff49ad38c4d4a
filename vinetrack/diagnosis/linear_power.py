"""Power of the score tests by linear theory: the size of every candidate that is detected with a given probability.

The diagnosis calls a candidate missing when its score, in standard errors, exceeds the threshold c of that candidate
(`family_test`). With an effect of size a the score of shape j is normal,

    z_j ~ N(μ_j(a), 1),   μ_j(a) = I_jk a / √I_jj,   corr(z_i, z_j) = I_ij / √(I_ii I_jj)

where k is the shape of the effect and I the information between shapes, with free parameters and trial effects
projected out. A size is therefore detected with probability p at a_p = σ (c + Φ⁻¹(p)), σ = 1/√I_kk. Refinements:
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import norm, t

from vinetrack.core.records import Floats
from vinetrack.diagnosis.candidates import CandidateShape, plausible_range
from vinetrack.diagnosis.expected_scores import (
    half_power_below,
    noiseless_start,
    score_ratios,
    sizes_at_systematic_error,
)
from vinetrack.diagnosis.likelihood_ratio import ANSWER_SET_DELTA_CHI2, CREDIBLE_RANGE_FACTOR
from vinetrack.diagnosis.misfit_tests import SINGLE_PROBE_LEVEL, MisfitTests
from vinetrack.diagnosis.power import PROBABILITIES, EffectPower, NumberWidth, Power, PowerInput
from vinetrack.diagnosis.score_test import informations_at
from vinetrack.effects import Effect
from vinetrack.inference.fit_problem import estimable
from vinetrack.inference.fit_result import Fit
from vinetrack.inference.parameters import DAMPING, EXPONENT
from vinetrack.inference.robust_covariance import FEWEST_CLUSTERS

DRAWS, SEED = 4000, 5  # Draws of the normal distributions, and their seed (derived)

# Factors on the between-trial standard deviations at which the information is computed (chosen)
SD_FACTORS = (1.0, 1.1, 1.25, 1.45, 1.75, 2.2, 3.0)

# Scores at the true standard deviations for which the inflation is tabulated (chosen)
SCORE_GRID = np.linspace(0.0, 40.0, 401)

LEAST_TAKEN_FOR = 0.05  # Probability from which another candidate is listed (chosen)


@dataclass(frozen=True)
class _Response:
    """Expected scores of all shapes when an effect has one of several sizes. `index` is that of `shape` among all.
    `sizes`, shape (n_sizes,), are deviations from absence in SI, increasing in absolute value; `scores`, shape
    (n_sizes, n_shapes), are the means of the scores in standard errors.
    """

    effect: Effect
    shape: CandidateShape
    index: int
    sizes: Floats
    scores: Floats


def power_of(
    tests: MisfitTests,
    not_testable: Mapping[str, str] | None = None,
    inputs: Sequence[PowerInput] = (),
    *,
    nonlinear: bool = False,
    first_round: MisfitTests | None = None,
) -> Power:
    """Compute which effects, at which sizes, the trials of a fit can detect."""
    null_scores, inflation, least = _null_scores(tests), error_inflation(tests), sizes_at_systematic_error(tests)
    effects = [
        power
        for response in _responses(tests, nonlinear=nonlinear)
        if (power := _effect_power(tests, response, null_scores, inflation, least)) is not None
    ]
    silent = dict.fromkeys(tests.sensitivities.silent, "no trial responds to it at any plausible size")
    wary = ""
    if tests.exceeds_slow_errors or tests.poorly_fitted:
        wary = "the residuals exceed the noise of the trials, and the sizes count the excess as noise"
    return Power(
        n_trials=len(tests.fit.trials),
        threshold=tests.family.single_shape_threshold,
        false_alarms=_false_alarms(first_round or tests),
        effects=tuple(effects),
        not_testable={**(not_testable or {}), **silent},
        numbers=_interval_widths(tests.fit),
        inputs=tuple(inputs) or inputs_of_fit(tests.fit),
        model=tests.fit.model.names,
        wary=wary,
    )


def effect_power(tests: MisfitTests, name: str) -> EffectPower | None:
    """Compute at which sizes the trials of a fit can detect one candidate among all others."""
    responses = _responses(tests, nonlinear=True, only=name)
    if not responses:
        return None
    return _effect_power(
        tests,
        responses[0],
        _null_scores(tests),
        error_inflation(tests),
        sizes_at_systematic_error(tests),
    )


def typical_shape_index(tests: MisfitTests, name: str) -> int | None:
    """Index of the shape by which an effect is represented; None where no trial has information about it."""
    effect = next(effect for effect in tests.effects if effect.name == name)
    indices = _typical_shapes(tests, effect)
    return indices[-1] if indices else None


def inputs_of_fit(fit: Fit) -> tuple[PowerInput, ...]:
    """Noise and between-trial standard deviations that a fit estimated or was given."""
    rows = [
        PowerInput("noise of a position", f"{1e3 * fit.noise_m:.3g} mm, correlation {fit.noise_correlation:.2f}", "fit")
    ]
    for name, spread in fit.spreads.items():
        origin = "fit" if spread.estimated else "assumed: too few trials to estimate it"
        rows.append(PowerInput(f"spread of {name} from trial to trial", f"{100 * spread.value:.2g} %", origin))
    return tuple(rows)


def _responses(tests: MisfitTests, *, nonlinear: bool, only: str = "") -> list[_Response]:
    """Expected scores of all shapes by the size of an effect: one response for each effect, or only one."""
    information = tests.scores.information
    root = np.sqrt(np.maximum(np.diag(information), 1e-300))
    start = noiseless_start(tests.fit) if nonlinear else None
    responses = []
    for effect in tests.effects:
        if only not in ("", effect.name):
            continue
        indices = _typical_shapes(tests, effect)
        if not indices:
            continue
        shapes = [tests.sensitivities.shapes[index] for index in indices]
        sizes = np.array(
            [
                shape.step if shape.whole else _plausible_sign(shape) / root[k]
                for shape, k in zip(shapes, indices, strict=True)
            ]
        )
        scores = information[indices] * sizes[:, None] / root
        if start is not None and not shapes[0].whole:
            unit = float(sizes[0])
            sizes, ratios = score_ratios(tests, indices[0], unit, start)
            scores = scores[0] * (ratios * sizes / unit)[:, None]
        responses.append(
            _Response(effect, shapes[0], indices[0], sizes, np.where(np.diag(information) > 0, scores, 0.0))
        )
    return responses


def _typical_shapes(tests: MisfitTests, effect: Effect) -> list[int]:
    """Indices of the shapes that represent an effect: the middle small step, else all finite sizes."""
    has_information = np.diag(tests.scores.information) > 0
    indices = [k for k, name in enumerate(tests.sensitivities.effects) if name == effect.name and has_information[k]]
    small = [k for k in indices if not tests.sensitivities.shapes[k].whole]
    return [small[len(small) // 2]] if small else sorted(indices, key=lambda k: abs(tests.sensitivities.shapes[k].step))


def _plausible_sign(shape: CandidateShape) -> int:
    """1 or −1: the side of absence on which the farther end of the plausible range lies."""
    if not shape.effect.parameters:
        return 1
    low, high = plausible_range(shape.size)
    return 1 if abs(high - shape.size.zero) >= abs(low - shape.size.zero) else -1


def _sided(scores: Floats, signs: Sequence[int]) -> Floats:
    """Scores of one-sided tests with their sign, of two-sided ones in absolute value, as in the diagnosis."""
    sided = np.array(signs)
    return np.asarray(np.where(sided == 0, np.abs(scores), scores * sided))


def _effect_power(
    tests: MisfitTests, response: _Response, null_scores: Floats, inflation: Floats, least: Floats
) -> EffectPower | None:
    """Detectable sizes of one effect, and how often others score higher at the size detected with 90 %."""
    indices = [k for k, name in enumerate(tests.sensitivities.effects) if name == response.effect.name]
    expected = _sided(response.scores, tests.signs)
    index = max(indices, key=lambda k: float(expected[-1, k]))
    means = np.maximum.accumulate(np.maximum(expected[:, index], 0.0))
    if not means[-1] > 0:
        return None
    needed = np.quantile(_required_means(tests, index, inflation[:, index]), PROBABILITIES)
    steps = np.array([_size_with_mean(means, response.sizes, mean) for mean in needed])
    if not response.shape.whole and np.isfinite(steps).all():
        steps = half_power_below(float(least[response.index]), steps)
    taken_for, named_alone = _confusion(tests, response, float(steps[PROBABILITIES.index(0.9)]), null_scores)
    effect, shape = response.effect, response.shape
    if not effect.parameters:
        sizes = tuple(steps.tolist())
        return EffectPower(effect.name, effect.kind, "", "size", "1", 0.0, 0.0, 1.0, sizes, taken_for, named_alone)
    size = shape.size
    ends = sorted(plausible_range(size), key=lambda end: abs(end - size.zero))
    same_side = (ends[0] - size.zero) * (ends[1] - size.zero) > 0
    return EffectPower(
        effect=effect.name,
        kind=effect.kind,
        parameter=f"{effect.name}.{size.name}",
        symbol=size.symbol,
        unit=size.unit,
        zero=size.zero,
        least=ends[0] if same_side else size.zero,
        largest=ends[1],
        sizes=tuple((size.zero + steps).tolist()),
        taken_for=taken_for,
        named_alone=named_alone,
        other_values=shape.other_values,
    )


def _size_with_mean(means: Floats, sizes: Floats, mean: float) -> float:
    """The size at which a score has this mean: proportional below the first size and beyond the last."""
    if mean >= means[-1]:
        return float(sizes[-1] * mean / means[-1])
    return float(np.interp(mean, np.concatenate([[0.0], means]), np.concatenate([[0.0], sizes])))


def _required_means(tests: MisfitTests, index: int, inflation: Floats) -> Floats:
    """For each draw of the noise, the mean that the score of a shape needs to exceed both thresholds. Derivation at the
    head of the module; p_i is the share of trial i in the information about the shape.
    """
    scores = tests.scores
    limit = tests.family.threshold(tests.sensitivities.effects[index])
    passes = SCORE_GRID / inflation >= limit
    threshold = float(SCORE_GRID[np.argmax(passes)]) if passes.any() else math.inf
    draw = np.random.default_rng(SEED)
    by_trial = np.maximum(scores.trial_informations[:, index, index], 0.0)
    trials, total = by_trial.size, float(by_trial.sum())
    if trials < FEWEST_CLUSTERS or not total > 0:
        return threshold - draw.standard_normal(DRAWS)
    share = by_trial / total
    noise = draw.standard_normal((DRAWS, trials))
    score = noise @ np.sqrt(share)
    residual = np.sqrt(share) * noise - share * score[:, None]
    residual = residual - residual.mean(axis=1, keepdims=True)
    ratio = np.sqrt(np.sum(residual**2, axis=1) * trials / scores.degrees)
    t_threshold = float(t.isf(norm.sf(limit), max(scores.degrees, 3.0)))
    return np.asarray(np.maximum(threshold, t_threshold * ratio) - score)


def error_inflation(tests: MisfitTests) -> Floats:
    """Factor by which the standard error of every shape grows because the fit takes part of the effect for scatter. The
    between-trial standard deviations of pressure and B are estimated without the effect. Multiplied by f_P and f_B they
    are those that minimise

        Σ_s ν (ln f_s² + 1 / f_s²) + x² I(f_P, f_B) / I(1, 1),

    Returns for an effect whose score at the true standard deviations would be `SCORE_GRID`; 1 where they are not
    estimated. Shape (n_scores, n_shapes).
    """
    fit, scores = tests.fit, tests.scores
    information = np.diag(scores.information)
    estimated = estimable(fit.solution.problem)
    factors = [np.array(SD_FACTORS) if free else np.ones(1) for free in estimated]
    spreads, penalties = [], []
    for pressure in factors[0]:
        for damping in factors[1]:
            spreads.append((fit.state.spread[0] * pressure, fit.state.spread[1] * damping))
            squares = np.array([pressure, damping]) ** 2
            penalties.append(scores.degrees * float(np.sum(np.log(squares) + 1 / squares - 1)))
    ratio = informations_at(fit, tests.products, spreads) / np.maximum(information, 1e-300)
    remaining = np.clip(ratio, 1e-6, 1.0)
    costs = np.array(penalties)[None, :, None] + SCORE_GRID[:, None, None] ** 2 * remaining
    best = np.argmin(costs, axis=1)
    return np.asarray(1 / np.sqrt(np.take_along_axis(remaining, best, axis=0)))


def _null_scores(tests: MisfitTests) -> Floats:
    """Draws of the scores of all shapes where nothing is missing, shape (DRAWS, n_shapes)."""
    values, vectors = np.linalg.eigh(tests.scores.cosines)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    return np.asarray(np.random.default_rng(SEED).standard_normal((DRAWS, len(values))) @ root.T)


def _confusion(
    tests: MisfitTests, response: _Response, size: float, null_scores: Floats
) -> tuple[dict[str, float], float]:
    """How often each other candidate scores highest at a size, and how often the effect is named alone. Both among
    draws in which any candidate exceeds its threshold. A score counts where its size is credible; an effect that
    contains another as a limit, be it this one or its rival, must be better by the Δχ² of the answer set.
    """
    if not math.isfinite(size):
        return {}, math.nan
    sizes = np.concatenate([[0.0], np.abs(response.sizes)])
    scores = np.vstack([np.zeros(response.scores.shape[1]), response.scores])
    if abs(size) > sizes[-1]:
        mean = response.scores[-1] * abs(size) / sizes[-1]
    else:
        mean = np.array([np.interp(abs(size), sizes, column) for column in scores.T])
    drawn = null_scores + mean
    counted = np.where(_credible(tests, drawn), _sided(drawn, tests.signs), 0.0)
    squares, names = _largest_by_effect(tests, np.maximum(counted, 0.0) ** 2)
    itself = names.index(response.effect.name)
    limits = np.array([tests.family.threshold(name) for name in names])
    alarm = np.any(squares > limits**2, axis=1)
    if np.count_nonzero(alarm) < DRAWS / 100:
        return {}, math.nan
    containing = {effect.name for effect in tests.effects if response.effect.name in effect.replaces}
    if any(name in response.effect.replaces for name in names):
        containing.add(response.effect.name)
    squares[:, [k for k, name in enumerate(names) if name in containing]] -= ANSWER_SET_DELTA_CHI2
    squares = squares[alarm]
    highest = np.argmax(squares, axis=1)
    others = np.delete(squares, itself, axis=1).max(axis=1, initial=-math.inf)
    rates = {name: float(np.mean(highest == k)) for k, name in enumerate(names) if k != itself}
    listed = sorted((name for name in rates if rates[name] >= LEAST_TAKEN_FOR), key=lambda name: -rates[name])
    return {name: rates[name] for name in listed}, float(np.mean(squares[:, itself] - others > ANSWER_SET_DELTA_CHI2))


def _credible(tests: MisfitTests, scores: Floats) -> Floats:
    """Whether the size that a score implies is one that the diagnosis would accept, see `likelihood_ratio`."""
    sigma = tests.scores.plain_sigma
    largest = np.array(
        [
            CREDIBLE_RANGE_FACTOR * max(abs(end - shape.size.zero) for end in plausible_range(shape.size))
            if shape.effect.parameters
            else math.inf
            for shape in tests.sensitivities.shapes
        ]
    )
    with np.errstate(invalid="ignore"):
        return np.asarray(np.abs(scores) <= largest / sigma + 3.0)


def _largest_by_effect(tests: MisfitTests, values: Floats) -> tuple[Floats, list[str]]:
    """The largest of the values of each effect's shapes, shape (n_draws, n_effects), and the names of the effects."""
    names = list(dict.fromkeys(tests.sensitivities.effects))
    effect_of_shape = np.array([names.index(name) for name in tests.sensitivities.effects])
    return np.stack([values[:, effect_of_shape == k].max(axis=1) for k in range(len(names))], axis=1), names


def _false_alarms(tests: MisfitTests) -> dict[str, float]:
    """False-alarm rate of every test of a round, as `misfit_tests` and `selection` set their levels."""
    level = tests.level
    rates = {
        "scores of all candidates": level,
        "any smooth force": 0.1 * level,
        "the loudest probe": min(SINGLE_PROBE_LEVEL, level),
        "replicates that err alike": 0.1 * level,
        "noise that is larger in motion": 0.1 * level,
    }
    trials = [trial.trial for trial in tests.fit.trials]
    if any(trial.specimen or trial.day or math.isfinite(trial.order) for trial in trials):
        rates["specimens, days or the order of trials"] = level
    return rates


def _interval_widths(fit: Fit) -> tuple[NumberWidth, ...]:
    """Half widths of the 95 % intervals of n and of every B."""
    widths = []
    for number in fit.numbers:
        if number.key in (DAMPING, EXPONENT) and math.isfinite(number.high - number.low):
            half = (number.high - number.low) / 2
            relative = number.key == DAMPING
            widths.append(
                NumberWidth(
                    "B" if relative else "n",
                    number.vine,
                    number.value,
                    half / number.value if relative and number.value > 0 else half,
                )
            )
    return tuple(widths)
