"""Power of the score tests by linear theory: the size of every candidate that is found with a given probability.

The diagnosis takes a candidate for missing when its score, in standard errors, exceeds the threshold c of that
candidate (`family_test`). With an effect of size a the score of shape j is normal,

    z_j ~ N(μ_j(a), 1),   μ_j(a) = I_jk a / √I_jj,   corr(z_i, z_j) = I_ij / √(I_ii I_jj)

where k is the shape of the effect and I the information between shapes, free numbers and trial effects projected off.
So a size is found with probability p at a_p = σ (c + Φ⁻¹(p)), σ = 1/√I_kk. Refinements:

- The diagnosis also asks that the score exceed what the scatter of single trials allows (Student's t). With the scores
  of single trials independent, s_i ~ N(I_i a, I_i), the mean that is needed, μ > c max(1, t_c r / c) − z₀ with r the
  ratio of both errors, is drawn jointly with z₀; its quantiles replace c + Φ⁻¹(p).
- The fit without the effect takes a part of it for scatter between trials, which widens σ (`error_inflation`): the
  score x that would be seen at the true spreads must exceed c g(x), g the ratio of the errors.
- A diagnosis does not count an effect that moves positions by less than their systematic errors, unless it predicts
  left-out conditions better (`contradictions`). So small an effect does that about as often as not: below the size that
  moves positions so far, the probability counts half (`expected_scores.half_power_below`).
- An effect whose small sizes do nothing is followed at finite sizes, between which μ_j(a) is interpolated.

What an effect is taken for follows from draws of the joint normal distribution at that size.
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

DRAWS, SEED = 4000, 5
"""Draws of the normal distributions. Derived: the quantile at 90 % is then known to 0.03 standard errors of the score
(√(0.9 · 0.1 / 4000) / 0.175), 0.5 % of a detectable size."""

FACTORS = (1.0, 1.1, 1.25, 1.45, 1.75, 2.2, 3.0)
"""Factors on between-trial spreads at which the information is worked out. Chosen: steps of a fifth, so that a
detectable size is known to some per cent; beyond 3 the fit would scatter so much that other tests sound."""

SCORES = np.linspace(0.0, 40.0, 401)
"""Scores at the true spreads for which the widening is tabulated. Chosen: ten times any threshold."""

LEAST_TAKEN_FOR = 0.05
"""Probability from which another candidate is listed. Chosen: one time in twenty; at half lists grow long, at twice a
name that turns up once in ten is passed over."""


@dataclass(frozen=True)
class _Response:
    """Expected scores of all shapes while an effect has one of several sizes.

    `place` is that of `shape` among all. `sizes`, shape (n_sizes,), are deviations from absence in SI, increasing in
    absolute value; `scores`, shape (n_sizes, n_shapes), the means of the scores in standard errors.
    """

    effect: Effect
    shape: CandidateShape
    place: int
    sizes: Floats
    scores: Floats


def power_of(
    questions: MisfitTests,
    not_testable: Mapping[str, str] | None = None,
    inputs: Sequence[PowerInput] = (),
    *,
    curved: bool = False,
    first: MisfitTests | None = None,
) -> Power:
    """Work out what the trials of a fit can see of every candidate.

    Parameters
    ----------
    questions : the fit, held against all candidates.
    not_testable : mapping, optional
        Candidates that were not asked about, with the reason.
    inputs : sequence of PowerInput
        What the power rests on, with its origin; noise and between-trial spreads of the fit where empty.
    curved : bool
        Whether scores are expected of a fit to noise-free trajectories with the effect in, a tenth of a second each;
        in proportion to the size where not.
    first : MisfitTests, optional
        Of the first model of a diagnosis, where effects were added to it: its tests decide whether an alarm is raised.

    Returns
    -------
    Power
    """
    joint, widening, least = _joint_draws(questions), error_inflation(questions), sizes_at_systematic_error(questions)
    effects = [
        power
        for response in _responses(questions, curved=curved)
        if (power := _effect_power(questions, response, joint, widening, least)) is not None
    ]
    silent = dict.fromkeys(questions.sensitivities.silent, "no trial responds to it at any plausible size")
    wary = ""
    if questions.exceeds_slow_errors or questions.poorly_fitted:
        wary = "the model misses the trials by more than their noise, which the sizes take for noise"
    return Power(
        n_trials=len(questions.fit.trials),
        threshold=questions.family.single_shape_threshold,
        false_alarms=_false_alarms(first or questions),
        effects=tuple(effects),
        not_testable={**(not_testable or {}), **silent},
        numbers=_widths(questions.fit),
        inputs=tuple(inputs) or inputs_of_fit(questions.fit),
        model=questions.fit.model.names,
        wary=wary,
    )


def effect_power(questions: MisfitTests, name: str) -> EffectPower | None:
    """Work out what the trials of a fit can see of one candidate, beside all others.

    Parameters
    ----------
    questions : the fit, held against all candidates.
    name : of the effect.

    Returns
    -------
    EffectPower or None
        As in `power_of` with `curved`; None where no score answers to it.
    """
    responses = _responses(questions, curved=True, only=name)
    if not responses:
        return None
    return _effect_power(
        questions,
        responses[0],
        _joint_draws(questions),
        error_inflation(questions),
        sizes_at_systematic_error(questions),
    )


def typical_shape_index(questions: MisfitTests, name: str) -> int:
    """The place of the shape that an effect is followed in.

    Parameters
    ----------
    questions : the fit, held against candidates.
    name : of an effect among them to which a trial answers.

    Returns
    -------
    int
    """
    effect = next(effect for effect in questions.effects if effect.name == name)
    return _typical_places(questions, effect)[-1]


def inputs_of_fit(fit: Fit) -> tuple[PowerInput, ...]:
    """Noise and between-trial spreads that a fit estimated, or was told.

    Parameters
    ----------
    fit : of the trials.

    Returns
    -------
    tuple of PowerInput
    """
    rows = [
        PowerInput("noise of a position", f"{1e3 * fit.noise_m:.3g} mm, correlation {fit.noise_correlation:.2f}", "fit")
    ]
    for name, spread in fit.spreads.items():
        origin = "fit" if spread.estimated else "assumed: too few trials to estimate it"
        rows.append(PowerInput(f"spread of {name} from trial to trial", f"{100 * spread.value:.2g} %", origin))
    return tuple(rows)


def _responses(questions: MisfitTests, *, curved: bool, only: str = "") -> list[_Response]:
    """Expected scores by size, from the information between shapes; one response an effect, of all or of one."""
    information = questions.scores.information
    root = np.sqrt(np.maximum(np.diag(information), 1e-300))
    start = noiseless_start(questions.fit) if curved else None
    responses = []
    for effect in questions.effects:
        if only not in ("", effect.name):
            continue
        places = _typical_places(questions, effect)
        if not places:
            continue
        shapes = [questions.sensitivities.shapes[place] for place in places]
        sizes = np.array(
            [shape.step if shape.whole else _toward(shape) / root[k] for shape, k in zip(shapes, places, strict=True)]
        )
        scores = information[places] * sizes[:, None] / root
        if start is not None and not shapes[0].whole:
            unit = float(sizes[0])
            sizes, bend = score_ratios(questions, places[0], unit, start)
            scores = scores[0] * (bend * sizes / unit)[:, None]
        responses.append(
            _Response(effect, shapes[0], places[0], sizes, np.where(np.diag(information) > 0, scores, 0.0))
        )
    return responses


def _typical_places(questions: MisfitTests, effect: Effect) -> list[int]:
    """Places of the shapes that an effect is followed in: the middle one, or several finite sizes where that is all."""
    known = np.diag(questions.scores.information) > 0
    places = [k for k, name in enumerate(questions.sensitivities.effects) if name == effect.name and known[k]]
    small = [k for k in places if not questions.sensitivities.shapes[k].whole]
    return (
        [small[len(small) // 2]] if small else sorted(places, key=lambda k: abs(questions.sensitivities.shapes[k].step))
    )


def _toward(shape: CandidateShape) -> int:
    """1 or −1: the side of absence on which the farther end of the plausible range lies."""
    if not shape.effect.parameters:
        return 1
    low, high = plausible_range(shape.size)
    return 1 if abs(high - shape.size.zero) >= abs(low - shape.size.zero) else -1


def _one_way(scores: Floats, signs: Sequence[int]) -> Floats:
    """Scores counted where their size can have that sign, as the diagnosis counts them."""
    sided = np.array(signs)
    return np.asarray(np.where(sided == 0, np.abs(scores), scores * sided))


def _effect_power(
    questions: MisfitTests, response: _Response, joint: Floats, widening: Floats, least: Floats
) -> EffectPower | None:
    """Detectable sizes of one effect, and what it is taken for at the size found with 90 %."""
    places = [k for k, name in enumerate(questions.sensitivities.effects) if name == response.effect.name]
    expected = _one_way(response.scores, questions.signs)
    place = max(places, key=lambda k: float(expected[-1, k]))
    means = np.maximum.accumulate(np.maximum(expected[:, place], 0.0))
    if not means[-1] > 0:
        return None
    needed = np.quantile(_needed_means(questions, place, widening[:, place]), PROBABILITIES)
    steps = np.array([_between(means, response.sizes, mean) for mean in needed])
    if not response.shape.whole and np.isfinite(steps).all():
        steps = half_power_below(float(least[response.place]), steps)
    taken_for, alone = _taken_for(questions, response, float(steps[PROBABILITIES.index(0.9)]), joint)
    effect, shape = response.effect, response.shape
    if not effect.parameters:
        return EffectPower(
            effect.name, effect.kind, "", "size", "1", 0.0, 0.0, 1.0, tuple(steps.tolist()), taken_for, alone
        )
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
        named_alone=alone,
        other_values=shape.other_values,
    )


def _between(means: Floats, sizes: Floats, mean: float) -> float:
    """The size at which a score has this mean, in proportion before the first size and behind the last."""
    if mean >= means[-1]:
        return float(sizes[-1] * mean / means[-1])
    return float(np.interp(mean, np.concatenate([[0.0], means]), np.concatenate([[0.0], sizes])))


def _needed_means(questions: MisfitTests, place: int, widening: Floats) -> Floats:
    """For every draw of the noise, the mean that the score of a shape needs to exceed both thresholds.

    Derivation at the head of the module; p_i is the share of trial i in the information about the shape.
    """
    scores = questions.scores
    limit = questions.family.threshold(questions.sensitivities.effects[place])
    passes = SCORES / widening >= limit
    threshold = float(SCORES[np.argmax(passes)]) if passes.any() else math.inf
    draw = np.random.default_rng(SEED)
    single = np.maximum(scores.trial_informations[:, place, place], 0.0)
    trials, total = single.size, float(single.sum())
    if trials < FEWEST_CLUSTERS or not total > 0:
        return threshold - draw.standard_normal(DRAWS)
    share = single / total
    noise = draw.standard_normal((DRAWS, trials))
    score = noise @ np.sqrt(share)
    left = np.sqrt(share) * noise - share * score[:, None]
    left = left - left.mean(axis=1, keepdims=True)
    ratio = np.sqrt(np.sum(left**2, axis=1) * trials / scores.degrees)
    by_scatter = float(t.isf(norm.sf(limit), max(scores.degrees, 3.0)))
    return np.asarray(np.maximum(threshold, by_scatter * ratio) - score)


def error_inflation(questions: MisfitTests) -> Floats:
    """By what factor the error of every shape grows once the fit has taken a part of it for scatter between trials.

    The spreads of pressure and B are estimated without the effect. Multiplied by f_P and f_B they are those at which

        Σ_s ν (ln f_s² + 1 / f_s²) + x² I(f_P, f_B) / I(1, 1)

    is least: the expected −2 ln L of ν degrees of freedom of scatter between trials, plus what the effect leaves of
    itself. Its information I is worked out at a grid of factors.

    Parameters
    ----------
    questions : the fit, held against all candidates.

    Returns
    -------
    array, shape (n_scores, n_shapes)
        For an effect whose score would be `SCORES` at the true spreads; 1 where the spreads are not estimated.
    """
    fit, scores = questions.fit, questions.scores
    information = np.diag(scores.information)
    estimated = estimable(fit.solution.problem)
    factors = [np.array(FACTORS) if free else np.ones(1) for free in estimated]
    spreads, penalties = [], []
    for pressure in factors[0]:
        for damping in factors[1]:
            spreads.append((fit.state.spread[0] * pressure, fit.state.spread[1] * damping))
            squares = np.array([pressure, damping]) ** 2
            penalties.append(scores.degrees * float(np.sum(np.log(squares) + 1 / squares - 1)))
    kept = informations_at(fit, questions.products, spreads) / np.maximum(information, 1e-300)
    part = np.clip(kept, 1e-6, 1.0)
    costs = np.array(penalties)[None, :, None] + SCORES[:, None, None] ** 2 * part
    best = np.argmin(costs, axis=1)
    return np.asarray(1 / np.sqrt(np.take_along_axis(part, best, axis=0)))


def _joint_draws(questions: MisfitTests) -> Floats:
    """Scores of all shapes where nothing is missing, shape (DRAWS, n_shapes)."""
    values, vectors = np.linalg.eigh(questions.scores.cosines)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    return np.asarray(np.random.default_rng(SEED).standard_normal((DRAWS, len(values))) @ root.T)


def _taken_for(
    questions: MisfitTests, response: _Response, size: float, joint: Floats
) -> tuple[dict[str, float], float]:
    """How often another candidate has the highest score at a size, and how often the effect is left alone.

    Both among draws in which any candidate passes the threshold. A score counts where its size is credible; one of an
    effect that holds another as a limit, this one or its rival, must be better by the answer set's Δχ².
    """
    if not math.isfinite(size):
        return {}, math.nan
    fractions = np.concatenate([[0.0], np.abs(response.sizes)])
    table = np.vstack([np.zeros(response.scores.shape[1]), response.scores])
    if abs(size) > fractions[-1]:
        mean = response.scores[-1] * abs(size) / fractions[-1]
    else:
        mean = np.array([np.interp(abs(size), fractions, column) for column in table.T])
    drawn = joint + mean
    counted = np.where(_credible(questions, drawn), _one_way(drawn, questions.signs), 0.0)
    squares, names = _by_effect(questions, np.maximum(counted, 0.0) ** 2)
    itself = names.index(response.effect.name)
    limits = np.array([questions.family.threshold(name) for name in names])
    heard = np.any(squares > limits**2, axis=1)
    if np.count_nonzero(heard) < DRAWS / 100:
        return {}, math.nan
    holding = {effect.name for effect in questions.effects if response.effect.name in effect.replaces}
    if any(name in response.effect.replaces for name in names):
        holding.add(response.effect.name)
    squares[:, [k for k, name in enumerate(names) if name in holding]] -= ANSWER_SET_DELTA_CHI2
    squares = squares[heard]
    first = np.argmax(squares, axis=1)
    others = np.delete(squares, itself, axis=1).max(axis=1, initial=-math.inf)
    rates = {name: float(np.mean(first == k)) for k, name in enumerate(names) if k != itself}
    listed = sorted((name for name in rates if rates[name] >= LEAST_TAKEN_FOR), key=lambda name: -rates[name])
    return {name: rates[name] for name in listed}, float(np.mean(squares[:, itself] - others > ANSWER_SET_DELTA_CHI2))


def _credible(questions: MisfitTests, scores: Floats) -> Floats:
    """Whether the size that a score stands for is one that a diagnosis would count, see `likelihood_ratio`."""
    sigma = questions.scores.plain_sigma
    room = np.array(
        [
            CREDIBLE_RANGE_FACTOR * max(abs(end - shape.size.zero) for end in plausible_range(shape.size))
            if shape.effect.parameters
            else math.inf
            for shape in questions.sensitivities.shapes
        ]
    )
    with np.errstate(invalid="ignore"):
        return np.asarray(np.abs(scores) <= room / sigma + 3.0)


def _by_effect(questions: MisfitTests, values: Floats) -> tuple[Floats, list[str]]:
    """The largest of the values of each effect's shapes, shape (n_draws, n_effects), and the names of the effects."""
    names = list(dict.fromkeys(questions.sensitivities.effects))
    of = np.array([names.index(name) for name in questions.sensitivities.effects])
    return np.stack([values[:, of == k].max(axis=1) for k in range(len(names))], axis=1), names


def _false_alarms(questions: MisfitTests) -> dict[str, float]:
    """Chance of a false alarm of every test of a round, as `misfit_tests` and `selection` set them."""
    level = questions.level
    rates = {
        "scores of all candidates": level,
        "any smooth force": 0.1 * level,
        "the loudest probe": min(SINGLE_PROBE_LEVEL, level),
        "replicates that err alike": 0.1 * level,
        "noise that is larger in motion": 0.1 * level,
    }
    trials = [trial.trial for trial in questions.fit.trials]
    if any(trial.specimen or trial.day or math.isfinite(trial.order) for trial in trials):
        rates["specimens, days or the order of trials"] = level
    return rates


def _widths(fit: Fit) -> tuple[NumberWidth, ...]:
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
