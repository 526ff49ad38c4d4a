"""Further trials: the next experiment, which separates tied hypotheses; the fewest trials that give an effect of some
size a target power; and those that would reveal most of what could be missing.

Designs are evaluated by linear theory: one trial of every condition is simulated once, information adds up over trials,
and trials are added one by one, each the best beside those before it (Fedorov 1972, Theory of Optimal Experiments).
"""

from __future__ import annotations

import itertools
import math
from bisect import bisect_left
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cache, partial
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, PlainSerializer

from vinetrack.core.problems import Remark, remark
from vinetrack.core.process import in_one_blas_thread
from vinetrack.core.records import Floats
from vinetrack.core.tables import JsonRecord
from vinetrack.diagnosis.linear_power import power_of, typical_shapes
from vinetrack.diagnosis.misfit_tests import MisfitTests, Products, in_noise, misfit_tests
from vinetrack.diagnosis.result import EffectPower, FurtherTrials
from vinetrack.dynamics.simulate import SimulationError
from vinetrack.experiment.schema import COLUMNS
from vinetrack.experiment.settings import Limits
from vinetrack.inference.errors import with_systematics
from vinetrack.inference.fit_data import FitError, FitTrial, prepare_trial
from vinetrack.inference.fit_result import Fit
from vinetrack.inference.marginal_likelihood import DEVIATION_COLUMNS, at_unknowns, solve_per_trial
from vinetrack.inference.optimiser import FixedTerms, solve
from vinetrack.inference.sensitivity import ORIGIN, RELEASE
from vinetrack.planning.candidate_trials import (
    NEW_VINE,
    OTHER_RIG,
    SAME_RIG,
    Condition,
    blank_film,
    extended,
    extended_fit,
    feasible_conditions,
    filmed,
    filming,
    tracks_of,
)

# ------------------------------------------------------------------------------
# Information of designs, by linear theory.
#
# With trial effects eliminated, a trial is a quadratic form in the unknowns of a campaign and in what is asked about
# it, and forms add up. Of a design with n_c trials of condition c, and the trials so far,
#
#     M = M_prior + M_so_far + Σ_c n_c M_c,   I = M_aa − M_aν M_νν⁻¹ M_νa
#
# is what the unknowns ν leave of the wanted columns a. Where these are the shape of an effect, I is the information
# about its size. Where they are by how much the trials move if another hypothesis is true, the diagonal of I is what a
# refit does not explain, in squared standard deviations.


class Designs:
    """Quadratic forms of the trials of a fit from the `n_before`-th on, shape (n_conditions, n, n), and of those so
    far, (n, n): unknowns, then the wanted ones among the shapes.
    """

    def __init__(self, fit: Fit, products: Products, n_before: int, wanted: Sequence[int]) -> None:
        problem, self.n_unknowns = products.problem, products.problem.prior_mean.size
        size = self.n_unknowns + len(wanted)
        blocks = products.without_trial_effects(fit.state)
        shapes_and_residual = np.full(blocks.shape[-1] - products.n_unknowns, -1)
        shapes_and_residual[np.array(wanted)] = np.arange(self.n_unknowns, size)
        index = np.hstack([problem.index, np.tile(shapes_and_residual, (len(fit.trials), 1))])
        of_trials = at_unknowns(blocks, index, size)
        # 1e-6: prior precision of parameters that no trial determines yet, such as B of a vine that has not been made
        # (chosen); what is asked about has none
        prior = np.append(np.maximum(problem.prior_precision, 1e-6), np.zeros(len(wanted)))
        self.so_far, self.each = np.diag(prior) + of_trials[:n_before].sum(axis=0), of_trials[n_before:]

    def left(self, design: Sequence[int], added: NDArray[np.intp] | None = None, times: float = 1.0) -> Floats:
        """What the unknowns leave of the wanted columns by a design, and one of each `added` with it, each trial made
        so many times. Shapes: design (n_trials,), added (n_designs,) → (n_designs or 1, n_wanted, n_wanted).
        """
        total = (self.so_far + times * self.each[list(design)].sum(axis=0))[None]
        total = total if added is None else total + times * self.each[added]
        free, a = slice(None, self.n_unknowns), slice(self.n_unknowns, None)
        explained = total[:, a, free] @ solve_per_trial(total[:, free, free], total[:, free, a])
        return np.asarray(total[:, a, a] - explained)


Criterion = Callable[..., Floats]  # Worth of designs, shape (n_designs,), by the arguments of `Designs.left`


def conditions_by_effort(
    conditions: Sequence[Condition], best_new_vines: Callable[[NDArray[np.intp]], Sequence[str]]
) -> Iterator[NDArray[np.intp]]:
    """Yield the indices of the conditions to choose from with more and more effort: on the rig so far, with another
    rig as well, and with one new vine at a time as well, of those that `best_new_vines` chooses among their indices.
    """
    efforts = np.array([condition.effort for condition in conditions])
    for effort in (SAME_RIG, OTHER_RIG):
        if (efforts == effort).any():
            yield np.flatnonzero(efforts <= effort)
    new = np.flatnonzero(efforts == NEW_VINE)
    for vine in best_new_vines(new) if new.size else ():
        vines = np.array([condition.trial.vine for condition in conditions])
        yield np.flatnonzero((efforts < NEW_VINE) | (vines == vine))


def added_one_by_one(allowed: NDArray[np.intp], worth: Criterion, most: int) -> list[int]:
    """The trials of a design, each the best of those allowed beside the ones before it, as long as it gains."""
    design: list[int] = []
    now = float(worth(design)[0])
    while len(design) < most:
        values = worth(design, allowed)
        if not np.max(values) > now:
            break
        design.append(int(allowed[int(np.argmax(values))]))
        now = float(np.max(values))
    return design


# ------------------------------------------------------------------------------
# The next experiment: the trials that best separate hypotheses which the trials so far cannot tell apart, chosen by
# linear theory, their separation predicted by refits; where none help, what to measure instead.

NO_FURTHER_EFFECT = "nothing more"  # Name of the hypothesis whose effects all other hypotheses share


@dataclass(frozen=True)
class NextExperiment(JsonRecord):
    """The recommended next trials. `trials` has an entry for each condition: the columns of the sheet that may be
    chosen (`schema.LIMITED`; NaN where the sheet is blank), `replicates`, `vine`, `new_vine` and `changed`, the names
    of what differs from the rig so far.
    """

    advice: Annotated[Remark, PlainSerializer(str), Field(alias="text")]
    trials: tuple[Mapping[str, Any], ...] = ()
    separation_sigma: Mapping[str, float] = field(default_factory=dict)
    if_true_sigma: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    measurement: Annotated[Remark, PlainSerializer(lambda told: str(told) or None), Field(alias="calibration")] = field(
        default_factory=Remark
    )


def _smaller(between: Floats) -> Floats:
    """The smaller separation of the two directions of every pair. Shapes: between (…, n, n) → (…, n_pairs)."""
    first, second = np.triu_indices(between.shape[-1], 1)
    return np.minimum(between[..., first, second], between[..., second, first])


@in_one_blas_thread
def next_experiment(tied: Sequence[Fit], limits: Limits | None = None) -> NextExperiment:
    """Recommend trials that separate two or more hypotheses which fit the same trials equally well."""
    limits = limits or Limits()
    # 5: most hypotheses that a design separates (chosen)
    tied = list(tied)[:5]
    # Each is named by the effects that not all of them have, numbered where that is ambiguous.
    common = set.intersection(*(set(fit.model.names) for fit in tied))
    names = [" + ".join(name for name in fit.model.names if name not in common) or NO_FURTHER_EFFECT for fit in tied]
    names = [name if names.count(name) == 1 else f"{name} ({k + 1})" for k, name in enumerate(names)]
    measurement = _deciding_measurements(list(itertools.combinations(tied, 2)))
    differ = [effect for fit in tied for effect in fit.model if effect.name not in common]
    if differ and all(effect.kind == "measurement" for effect in differ):
        faults = [name for name in names if name != NO_FURTHER_EFFECT]
        return NextExperiment(remark("measure_first", faults=faults, measurement=measurement), measurement=measurement)
    films = filmed(tied, feasible_conditions([trial_data.trial for trial_data in tied[0].predictor.data], limits))
    if not films:
        return NextExperiment(remark("no_feasible_trial", measurement=measurement), measurement=measurement)
    designs = _designs_of(tied, [extended_fit(fit, films) for fit in tied])
    return _recommendation(tied, names, *_best_option(tied, designs, [condition for condition, _ in films], limits))


def _deciding_measurements(pairs: Sequence[tuple[Fit, Fit]]) -> Remark:
    """What to measure in order to exclude one of each pair of hypotheses: the effects whose files say so. Where a fault
    of the measurement is among them, a calibration decides, and only the calibration is named.
    """
    both_ways = [
        (one.model, other.model) for first, second in pairs for one, other in ((first, second), (second, first))
    ]
    effects = {effect.name: effect for model, other in both_ways for effect in model if effect.name not in other.names}
    measured = [effect for effect in effects.values() if effect.kind == "measurement"]
    return remark("deciding_measurements", effects=measured or list(effects.values())) if effects else Remark()


def _designs_of(tied: Sequence[Fit], extended: Sequence[Fit]) -> list[Designs]:
    """The forms of each hypothesis once refitted; wanted is by how much trials move if another one is true."""
    count, designs = len(tied[0].trials), []
    for fit in extended:
        white = []
        for i, of_fit in enumerate(fit.solution.columns):
            further = float(i >= count)
            moved = [further * (of_fit[:, -1] - other.solution.columns[i][:, -1]) for other in extended]
            white.append(in_noise(fit, i, np.column_stack([of_fit[:, :-1], *moved, of_fit[:, -1]])))
        designs.append(Designs(fit, Products(np.stack(white), fit.solution.problem), count, range(len(tied))))
    return designs


def worth(between: Floats) -> Floats:
    """Return the worth of designs: the sum over pairs of d²/(d² + 5²), d the smaller separation of the two directions
    (T-optimality). Shapes: between (…, n, n), in standard deviations → (…).
    """
    square = _smaller(between) ** 2
    # 5.0: separation, in standard deviations, at which a pair has half of its largest worth (chosen)
    return np.asarray(np.sum(square / (square + 5.0**2), axis=-1))


def _best_option(
    tied: Sequence[Fit], designs: Sequence[Designs], conditions: Sequence[Condition], limits: Limits
) -> tuple[list[Condition], Floats]:
    """The best set of trials of the least effort that is sufficient, else of all. Returns design, separations (see
    `simulated_separations`).
    """

    def worth_of(*design: Any) -> Floats:
        """Worth by the separation of every ordered pair (true, refitted)."""
        squares = [np.einsum("naa->na", refitted.left(*design)) for refitted in designs]
        return worth(np.sqrt(np.maximum(np.stack(squares, axis=2), 0.0)))

    def best_vines(places: NDArray[np.intp]) -> list[str]:
        best_first = places[np.argsort(-worth_of((), places, limits.trials))]
        # 2: new vines that are tried, at most (chosen)
        return list(dict.fromkeys(conditions[k].trial.vine for k in best_first))[: 2 if len(tied) == 2 else 1]

    options: list[tuple[list[Condition], Floats]] = []
    before = -math.inf
    for allowed in conditions_by_effort(conditions, best_vines):
        design = sorted(added_one_by_one(allowed, worth_of, limits.trials))
        predicted = float(worth_of(design)[0])
        # 1.01: factor by which the worth of a design must exceed that with less effort to be considered (chosen)
        if predicted > 1.01 * before:
            trials = [conditions[k] for k in design]
            options.append((trials, simulated_separations(tied, trials)))
            before = min(predicted, float(worth(options[-1][1])))
            # 8.0: separation, in standard deviations, beyond which no further effort, such as making a new vine, is
            # recommended (chosen)
            if _smaller(options[-1][1]).min() >= 8.0:
                return options[-1]
    return max(options, key=lambda option: float(worth(option[1])))


def _recommendation(
    fits: Sequence[Fit], names: Sequence[str], design: Sequence[Condition], between: Floats
) -> NextExperiment:
    least_separation = 3.0  # Separation, in standard deviations, below which trials are not recommended (chosen)
    expected = dict(zip(itertools.combinations(range(len(fits)), 2), _smaller(between).tolist(), strict=True))
    title = {(a, b): f"{names[a]} | {names[b]}" for a, b in expected}
    unresolved = [pair for pair, sigma in expected.items() if sigma < least_separation]
    worth_it = len(unresolved) < len(expected)
    # Where all pairs are resolved: those that a measurement would decide as well, with an effect of it in only one.
    kinds = [{effect.kind for effect in fit.model} for fit in fits]
    to_measure = unresolved or [(a, b) for a, b in expected if "measurement" in kinds[a] ^ kinds[b]]
    measurement = _deciding_measurements([(fits[a], fits[b]) for a, b in to_measure])
    counts = Counter(condition.trial.name for condition in design)
    once = {condition.trial.name: condition for condition in design}
    trials = tuple({**_entry(condition), "replicates": counts[name]} for name, condition in once.items())
    if_true = {title[a, b]: {names[a]: float(between[a, b]), names[b]: float(between[b, a])} for a, b in title}
    told = {"trials": trials, "least_sigma": least_separation, "if_true": if_true}
    more = {"unresolved": [title[pair] for pair in unresolved], "measurement": measurement}
    return NextExperiment(
        advice=remark("trials_to_make" if worth_it else "no_trials_separate", **told, **more),
        trials=trials if worth_it else (),
        separation_sigma={title[pair]: sigma for pair, sigma in expected.items()},
        if_true_sigma=if_true,
        measurement=measurement,
    )


def _entry(condition: Condition, *more: str) -> dict[str, Any]:
    """The cells of the sheet that may be chosen, and `more` of them, NaN where blank; the unit in which the sheet has
    the pressure; and what is new about a trial.
    """
    names = [*(name for name, column in COLUMNS.items() if column.limit), *more]
    return {
        **{name: float(f"{COLUMNS[name].of_trial(condition.trial):.6g}") for name in names},
        "pressure_unit": condition.trial.pressure_unit,
        "vine": condition.trial.vine,
        "new_vine": condition.effort == NEW_VINE,
        "changed": list(condition.changed),
    }


# ------------------------------------------------------------------------------
# What further trials promise. Each hypothesis in turn is taken as the truth, the new trials are simulated, and every
# hypothesis is fitted to all trials, old and new, with scatter and noise estimated anew as in a diagnosis, so that a
# wrong one can explain part of its misfit as scatter. The squared separation is the rise in the difference of −2 ln L.


def simulated_separations(tied: Sequence[Fit], design: Sequence[Condition]) -> Floats:
    """Return the separation of every (true, refitted) pair; 0 where a wrong hypothesis fits better, or a refit fails.
    The truth is at its best values and the deviations of the trials are plus or minus one standard deviation in turn,
    so that one draw shows the average. Shape (n, n).
    """
    # Deviations of pressure and B in standard deviations, balanced over replicates (derived)
    alternating = np.array([[1.0, 1.0], [-1.0, -1.0], [1.0, -1.0], [-1.0, 1.0]])[np.arange(len(design)) % 4]
    rises = np.zeros((len(tied), len(tied)))
    before = np.array([-2 * fit.log_likelihood for fit in tied])
    for a, truth in enumerate(tied):
        deviations = alternating * truth.solution.state.spread
        try:
            films = _noisy_films(truth, design, deviations, np.random.default_rng([0, 0, 0, a]))
        except SimulationError:
            continue
        if films:
            after = np.array([_refitted(fit, films) for fit in tied])
            rises[a] = after - before - (after[a] - before[a])
    return np.sqrt(np.maximum(np.nan_to_num(rises), 0.0))


def _noisy_films(
    truth: Fit, design: Sequence[Condition], deviations: Floats, rng: np.random.Generator
) -> list[tuple[Condition, FitTrial]]:
    """Trials of a design simulated under a hypothesis, with random release, origin and noise, and prepared as for a
    fit; without those that have too few points. Shapes: deviations (n_trials, 2).
    """
    (rest_frames, longest_s), before = filming(truth), len(truth.trials)
    frames_s = truth.predictor.frames_s[[condition.like for condition in design]]
    counts = rest_frames + np.ceil(longest_s / frames_s)
    blanks = [
        (condition, blank_film(truth, condition, frame_s * np.arange(count)))
        for condition, frame_s, count in zip(design, frames_s, counts, strict=True)
    ]
    predictor, problem, state = extended(truth, blanks)
    effects = state.trial_effects[before:]
    effects[:, RELEASE] = [(rest_frames - 1 + rng.uniform()) * frame_s for frame_s in frames_s]
    effects[:, ORIGIN] = rng.uniform(-0.02, 0.02, len(design))
    effects[:, DEVIATION_COLUMNS] = np.where(problem.has_deviation[before:], deviations, 0.0)
    jobs = predictor.jobs(state.theta, state.trial_effects)[before:]
    films = []
    for condition, (trial, track) in zip(design, tracks_of(predictor, state, jobs, rng), strict=True):
        with suppress(FitError):
            films.append((condition, prepare_trial(trial, track)))
    return films


def _refitted(fit: Fit, films: Sequence[tuple[Condition, FitTrial]]) -> float:
    """−2 ln L of a hypothesis fitted to old and further trials; NaN where the fit fails."""
    most = 20  # Iterations of a refit, at most (chosen)
    predictor, problem, state = extended(fit, films)
    try:
        # Scatter and noise are fixed at first, lest misfit that the parameters have yet to remove be taken as scatter.
        fixed = FixedTerms(state.spread, (state.rho, state.variance))
        # 10.0: least decrease of the last of these steps (chosen)
        solution = solve(predictor, problem, state, fixed, most_iterations=most, least_decrease=10.0)
        solution = solve(predictor, problem, solution.state, most_iterations=most)
        # These absorb part of what is wrong in a hypothesis, as in every fit.
        gain = with_systematics(solution).gain
    except SimulationError:
        return math.nan
    return -2 * (solution.log_likelihood() + gain)


# ------------------------------------------------------------------------------
# The fewest trials that give an effect of some size a target power, by its information in candidate designs.

REPLICATES = 2  # Trials of a condition that are added at a time (chosen)

UNLIMITED = 1000  # Pairs of trials of each condition that stand for unlimited replicates (chosen)


def further_trials(
    tests: MisfitTests, now: EffectPower, value: float, target: float, limits: Limits | None = None
) -> FurtherTrials:
    """Find the fewest further trials that give an effect of some size a target power; `tests` are of those so far."""
    limits, trials = limits or Limits(), [trial.trial for trial in tests.fit.trials]
    # 48: most further trials considered where `limits.trials` is not stated (chosen)
    most = whole = (limits.trials if "trials" in limits.model_fields_set else 48) // REPLICATES
    before = now.probability_at(value)
    plan = FurtherTrials(now, value, target, before, before)
    if before >= target:
        return plan
    fit = replace(tests.fit, solution=replace(tests.fit.solution, state=tests.fit.state), with_errors=None)
    films = filmed([fit], feasible_conditions(trials, limits))
    if not films:
        return plan
    (effect,) = (effect for effect in tests.effects if effect.name == now.effect)
    of_effect = misfit_tests(extended_fit(fit, films), [effect], tests.level)
    designs = Designs(of_effect.fit, of_effect.products, len(trials), typical_shapes(of_effect, effect.name)[-1:])

    def information(design: Sequence[int], added: NDArray[np.intp] | None = None, times: float = 1.0) -> Floats:
        return np.maximum(designs.left(design, added, REPLICATES * times)[:, 0, 0], 0.0)

    conditions = [condition for condition, _ in films]
    vines = np.array([condition.trial.vine for condition in conditions])

    def best_vine(places: NDArray[np.intp]) -> list[str]:
        """The new vine with the largest information in unlimited trials of all its conditions."""
        known = {v: information(np.flatnonzero(vines == v).tolist(), times=UNLIMITED)[0] for v in vines[places]}
        return [max(known, key=lambda vine: known[vine])]

    chosen, power = list[int](), cache(lambda _: now)
    for allowed in conditions_by_effort(conditions, best_vine):
        pairs = added_one_by_one(allowed, information, most)
        if not pairs:
            continue
        with_pairs = cache(partial(_with_pairs, replace(tests, fit=fit), now, [films[k] for k in pairs]))
        short = len(pairs)  # How many of these pairs fall short of the target
        if with_pairs(short).probability_at(value) >= target:
            short = bisect_left(range(1, short), target, key=lambda count: with_pairs(count).probability_at(value))
        if short < len(pairs) or most == whole:
            chosen, power = pairs[: short + 1], with_pairs
        if short < len(pairs):
            most = short  # With more effort only fewer trials are worth it.
    made: list[dict[str, Any]] = []
    for k, place in enumerate(chosen, 1):
        cells = _entry(conditions[place], "yield_pressure_kPa", "capture_fps")
        known = {name: cell for name, cell in cells.items() if cell == cell}  # NaN is not equal to itself
        made += [{**known, "probability": power(k).probability_at(value)}] * REPLICATES
    final = power(len(chosen))
    plan = replace(plan, power=final, trials=tuple(made), n_conditions=len(films))
    endless, so_many = information(range(len(films)), times=UNLIMITED)[0], information(chosen)[0]
    away = math.sqrt(endless / max(so_many, 1e-300)) * (value - final.zero)
    return replace(plan, unlimited=max(final.probability_at(final.zero + away), plan.after))


def _with_pairs(
    tests: MisfitTests, now: EffectPower, films: Sequence[tuple[Condition, FitTrial]], count: int
) -> EffectPower:
    """The power for an effect with the first so many of these films made as well, each twice."""
    made = [film for film in films[:count] for _ in range(REPLICATES)]
    with_all = misfit_tests(extended_fit(tests.fit, made), tests.effects, tests.level)
    return next(iter(power_of(with_all, only=now.effect).effects), now)
