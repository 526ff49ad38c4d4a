"""Further trials: the next experiment, which separates tied hypotheses; the fewest trials that give an effect of some
size a target power; and those that would reveal most of what could be missing.

Designs are evaluated by linear theory: one trial of every condition is simulated once, information adds up over trials,
and trials are added one by one and exchanged until none gains (Fedorov 1972, Theory of Optimal Experiments).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vinetrack.core.problems import Remark, remark
from vinetrack.core.records import Floats
from vinetrack.core.threads import in_one_blas_thread
from vinetrack.diagnosis.campaign_power import CampaignDesign, planned_tests
from vinetrack.diagnosis.linear_power import effect_power, typical_shapes
from vinetrack.diagnosis.misfit_tests import MisfitTests
from vinetrack.diagnosis.power import EffectPower, FurtherTrials
from vinetrack.diagnosis.score_test import products_without_trial_effects, scores_of
from vinetrack.dynamics.simulate import SimulationError
from vinetrack.experiment.schema import COLUMNS
from vinetrack.experiment.settings import Limits
from vinetrack.inference.fit_data import FitError
from vinetrack.inference.fit_result import DAMPING, Fit
from vinetrack.inference.marginal_likelihood import at_unknowns
from vinetrack.inference.trial_effects import subset
from vinetrack.planning.discriminating_design import (
    NEW_VINE,
    OTHER_RIG,
    SAME_RIG,
    Condition,
    Hypothesis,
    conditions_by_effort,
    exchanged,
    extend,
    feasible_conditions,
    growth_courses,
    refit_terms,
    separations,
    simulated_rises,
    worth,
)
from vinetrack.planning.predictive_inputs import prior_ratio

# ------------------------------------------------------------------------------
# The next experiment: the trials that best separate hypotheses which the trials so far cannot tell apart.
#
# Every condition within the limits is rated by linear theory, and the best set of trials found by exchange. Its
# separation is predicted by refitting simulated trials. Where no trials help, or only measurements are in question, the
# advice is what to measure instead.

NO_FURTHER_EFFECT = "nothing more"  # Name of the hypothesis whose effects all other hypotheses share


@dataclass(frozen=True)
class NextExperiment:
    """The recommended next trials. `trials` has an entry for each condition: the columns of the sheet that may be
    chosen (`schema.LIMITED`; NaN where the sheet is blank), `replicates`, `vine`, `new_vine` and `changed`, the names
    of what differs from the rig so far.
    """

    advice: Remark
    trials: tuple[Mapping[str, Any], ...] = ()
    separation_sigma: Mapping[str, float] = field(default_factory=dict)
    if_true_sigma: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    measurement: Remark = field(default_factory=Remark)

    def to_json(self) -> dict[str, Any]:
        """As `diagnosis.json` holds it."""
        return {
            "text": str(self.advice),
            "trials": self.trials,
            "separation_sigma": self.separation_sigma,
            "if_true_sigma": self.if_true_sigma,
            "calibration": str(self.measurement) or None,
        }


def _separations(rises: Floats) -> Floats:
    """Root of the mean rise over the draws, shape (n, n); 0 where a wrong hypothesis fits better."""
    count = np.maximum(np.isfinite(rises).sum(axis=0), 1)
    return np.asarray(np.sqrt(np.maximum(np.nansum(rises, axis=0) / count, 0.0)))


def _by_pair(separations: Floats) -> dict[tuple[int, int], float]:
    """The smaller separation of the two directions, by pair."""
    pairs = itertools.combinations(range(len(separations)), 2)
    return {(a, b): float(min(separations[a, b], separations[b, a])) for a, b in pairs}


@in_one_blas_thread
def next_experiment(tied: Sequence[Fit], limits: Limits | None = None, *, seed: int = 0) -> NextExperiment:
    """Recommend trials that separate hypotheses which fit the same trials equally well."""
    limits = limits or Limits()
    if len(tied) < 2:
        raise FitError("A next experiment needs at least two hypotheses to separate: give at least two fits.")
    if len({tuple(trial_data.trial.name for trial_data in fit.predictor.data) for fit in tied}) > 1:
        raise FitError("The fits to separate are not of the same trials: fit all hypotheses to the same trials.")
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
    terms = _feasible_trials(tied, names, limits)
    if not terms:
        return NextExperiment(remark("no_feasible_trial", measurement=measurement), measurement=measurement)
    design, rises = _best_option(terms, limits, seed)
    return _recommendation(terms, design, rises, seed)


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


def _feasible_trials(tied: Sequence[Fit], names: Sequence[str], limits: Limits) -> list[Hypothesis]:
    """All hypotheses, extended to the conditions that can be filmed; none without any."""
    conditions = feasible_conditions([trial_data.trial for trial_data in tied[0].predictor.data], limits)
    if not conditions:
        return []
    courses = growth_courses([extend(fit, name, conditions) for fit, name in zip(tied, names, strict=True)])
    usable = [(condition, course) for condition, course in zip(conditions, courses, strict=True) if course is not None]
    if not usable:
        return []
    chosen, chosen_courses = zip(*usable, strict=True)
    try:
        return refit_terms([extend(fit, name, chosen) for fit, name in zip(tied, names, strict=True)], chosen_courses)
    except SimulationError as error:
        raise FitError(f"Further trials cannot be simulated under every hypothesis: {error}") from error


def _best_option(terms: list[Hypothesis], limits: Limits, seed: int) -> tuple[list[int], Floats]:
    """The best set of trials of the least effort that is sufficient, else of all: replicates of one condition,
    exchanged one at a time. Returns design (indices of conditions, one a trial), rises (see `simulated_rises`).
    """
    conditions = terms[0].conditions

    def worth_of(others: Sequence[int], places: NDArray[np.intp], replicates: int = 1) -> Floats:
        return worth(separations(terms, [[*others, *[k] * replicates] for k in places]))

    def best_vines(places: NDArray[np.intp]) -> list[str]:
        best_first = places[np.argsort(-worth_of([], places, limits.trials))]
        # 2: new vines that are tried, at most (chosen)
        return list(dict.fromkeys(conditions[k].trial.vine for k in best_first))[: 2 if len(terms) == 2 else 1]

    options: list[tuple[list[int], Floats]] = []
    before = -math.inf
    for _, allowed in conditions_by_effort(conditions, best_vines):
        values = worth_of([], allowed, limits.trials)
        start = [int(allowed[int(np.argmax(values))])] * limits.trials
        design, predicted = exchanged(start, float(np.max(values)), allowed, partial(worth_of, places=allowed))
        # 1.01: factor by which the worth of a design must exceed that with less effort to be considered (chosen)
        if predicted > 1.01 * before:
            before = predicted
            options.append((sorted(design), simulated_rises(terms, sorted(design), [0], seed)))
            # 8.0: separation, in standard deviations, beyond which no further effort, such as making a new vine, is
            # recommended (chosen)
            if min(_by_pair(_separations(options[-1][1])).values()) >= 8.0:
                return options[-1]
    return max(options, key=lambda option: float(worth(_separations(option[1])[None])[0]))


def _recommendation(terms: Sequence[Hypothesis], design: list[int], rises: Floats, seed: int) -> NextExperiment:
    least_separation = 3.0  # Separation, in standard deviations, below which trials are not recommended (chosen)
    fits, names = [one.fit for one in terms], [one.name for one in terms]
    between = _separations(np.concatenate([rises, simulated_rises(terms, design, [1], seed)]))
    expected = _by_pair(between)
    title = {(a, b): f"{names[a]} | {names[b]}" for a, b in expected}
    unresolved = [pair for pair, sigma in expected.items() if sigma < least_separation]
    worth_it = len(unresolved) < len(expected)
    # Where all pairs are resolved: those that a measurement would decide as well, with an effect of it in only one.
    kinds = [{effect.kind for effect in fit.model} for fit in fits]
    to_measure = unresolved or [(a, b) for a, b in expected if "measurement" in kinds[a] ^ kinds[b]]
    measurement = _deciding_measurements([(fits[a], fits[b]) for a, b in to_measure])
    trials = trial_entries(terms[0].conditions, design)
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


def trial_entries(every: Sequence[Condition], design: Sequence[int]) -> tuple[dict[str, Any], ...]:
    """Return the trials of a design as entries of `next_experiment`, one for each condition."""
    counted = zip(*np.unique(np.array(design), return_counts=True), strict=True)
    return tuple({**_entry(every[index]), "replicates": int(replicates)} for index, replicates in counted)


def _entry(condition: Condition, *more: str) -> dict[str, Any]:
    """The cells of the sheet that may be chosen, and `more` of them, NaN where blank; and what is new about a trial."""
    names = [*(name for name, column in COLUMNS.items() if column.limit), *more]
    return {
        **{name: float(f"{COLUMNS[name].of_trial(condition.trial):.6g}") for name in names},
        "vine": condition.trial.vine,
        "new_vine": condition.effort == NEW_VINE,
        "changed": list(condition.changed),
    }


# ------------------------------------------------------------------------------
# Information of candidate designs about the sizes of effects, by linear theory.
#
# With trial effects eliminated, the cross products of free parameters, shared systematic errors and the shape of the
# effect add up over trials. Of a design with n_c trials of condition c, and the trials so far,
#
#     M = M_prior + M_so_far + Σ_c n_c M_c,   I = M_aa − M_aν M_νν⁻¹ M_νa
#
# is the information about the size a with all other unknowns ν free. One trial of every condition is therefore
# simulated once, and designs are evaluated by linear algebra.

REPLICATES = 2  # Trials of a condition that are added at a time (chosen)

UNLIMITED_TRIALS = 1000  # Trials of each condition that stand for unlimited replicates (chosen)


class DesignInformation:
    """Information of designs about the size of an effect with everything else free. `conditions` are those that can be
    filmed; `each`, shape (n_conditions, n, n), is what `REPLICATES` trials of each add, the effect last.
    """

    def __init__(self, design: CampaignDesign, every: Sequence[Condition], effect: str) -> None:
        tests = tests_with_conditions(design, every, (effect,))
        fit, products, problem = tests.fit, tests.products, tests.products.problem
        # Unknowns of the fit, then the size of the effect; not the residual and other shapes
        size = problem.prior_mean.size + 1
        residual_and_shapes = np.full(1 + products.n_shapes, -1)
        residual_and_shapes[1 + typical_shapes(tests, effect)[-1]] = size - 1
        index = np.concatenate([problem.index, np.tile(residual_and_shapes, (len(fit.trials), 1))], axis=1)
        of_trials = at_unknowns(products_without_trial_effects(products, fit.state), index, size)
        # 1e-6: prior precision of parameters that no trial determines yet, such as B of a vine that has not been made
        # (chosen); the size of the effect has none.
        prior = np.append(np.maximum(problem.prior_precision, 1e-6), 0.0)
        # 12: frames of growth below which a trial is not worth filming (chosen)
        before = {trial.name for trial in design.trials}
        places = {trial.name: k for k, trial in enumerate(fit.trials)}
        moving = [trial_data.time_s.size - trial_data.n_rest for trial_data in fit.predictor.data]
        filmed = {name: k for name, k in places.items() if name not in before and moving[k] >= 12}
        self.conditions = tuple(condition for condition in every if condition.trial.name in filmed)
        self.each = REPLICATES * of_trials[[filmed[condition.trial.name] for condition in self.conditions]]
        done = [k for name, k in places.items() if name in before]
        self.so_far = np.diag(prior) + of_trials[done].sum(axis=0)

    def total(self, chosen: Sequence[int]) -> Floats:
        """Cross products of the trials so far and of a design. Shape (n, n)."""
        return np.asarray(self.so_far + self.each[list(chosen)].sum(axis=0))

    def of(self, totals: Floats) -> Floats:
        """Information about the size with all other unknowns free. Shapes: totals (n_designs, n, n) → (n_designs,)."""
        cross = totals[:, :-1, -1:]
        solved = np.linalg.solve(totals[:, :-1, :-1], cross)
        information = totals[:, -1:, -1:] - np.swapaxes(cross, 1, 2) @ solved
        return np.asarray(np.maximum(information[:, 0, 0], 0.0))

    def of_design(self, chosen: Sequence[int]) -> float:
        """Information from these trials and those so far."""
        return float(self.of(self.total(chosen)[None])[0])

    def fewest(self, wanted: float, most: int) -> tuple[list[int], dict[str, int]]:
        """The fewest pairs that reach the wanted information, else the best `most`; and how many
        trials by effort.
        """

        def cost(chosen: Sequence[int]) -> tuple[float, float]:
            information = self.of_design(chosen)
            return (len(chosen), 0.0) if information >= wanted else (math.inf, -information)

        def best_vines(places: NDArray[np.intp]) -> list[str]:
            """The new vines with the largest information in unlimited trials of all their conditions."""
            vines = np.array([condition.trial.vine for condition in self.conditions])
            new = list(dict.fromkeys(vines[places].tolist()))
            unlimited = [self.so_far + UNLIMITED_TRIALS * self.each[vines == vine].sum(axis=0) for vine in new]
            # 2: new vines that are tried, one at a time (chosen)
            return [new[k] for k in np.argsort(-self.of(np.stack(unlimited)))[:2]]

        options: dict[str, list[int]] = {}
        effort_words = {SAME_RIG: "on the rig so far", OTHER_RIG: "with another rig", NEW_VINE: "with a new vine"}
        for effort, allowed in conditions_by_effort(self.conditions, best_vines):
            words, chosen = effort_words[effort], self._smallest(allowed, wanted, most)
            options[words] = min(options.get(words, chosen), chosen, key=cost)
        reached = {words: REPLICATES * len(chosen) for words, chosen in options.items() if cost(chosen)[0] < math.inf}
        return min(options.values(), key=cost, default=[]), reached

    def _smallest(self, allowed: NDArray[np.intp], wanted: float, most: int) -> list[int]:
        """Pairs added one by one up to the wanted information, exchanged, and as many as are needed of these, the most
        informative first.
        """
        chosen: list[int] = []
        now = self.of_design(chosen)
        while now < wanted and len(chosen) < most:
            values = self.of(self.total(chosen) + self.each[allowed])
            if not np.max(values) > now:
                break
            chosen.append(int(allowed[int(np.argmax(values))]))
            now = float(np.max(values))
        chosen, _ = exchanged(chosen, now, allowed, lambda others: self.of(self.total(others) + self.each[allowed]))
        order: list[int] = []
        while chosen and (not order or self.of_design(order) < wanted):
            gains_of = self.of(self.total(order) + self.each[chosen])
            order.append(chosen.pop(int(np.argmax(gains_of))))
        return order


def tests_with_conditions(
    design: CampaignDesign, added: Sequence[Condition], candidates: Sequence[str] | None
) -> MisfitTests:
    """Misfit tests of a noise-free design with one trial of each condition added."""
    longest_s = max(camera.longest_s for camera in design.cameras)
    column = design.model.parameter_names.index(DAMPING)
    B = {trial.vine: float(design.model.parameters_of(trial)[column]) for trial in design.trials}
    for condition in added:
        like = design.trials[condition.like]
        B.setdefault(condition.trial.vine, B[like.vine] * prior_ratio(condition.trial, like))
    cameras = [replace(design.cameras[c.like], stops_s=math.inf, longest_s=longest_s) for c in added]
    extended = replace(
        design,
        model=design.model.with_values({DAMPING: B}),
        trials=(*design.trials, *(condition.trial for condition in added)),
        cameras=(*design.cameras, *cameras),
        candidates=candidates,
    )
    return planned_tests(extended)[0]


def tests_of_designs(
    design: CampaignDesign, conditions: Sequence[Condition]
) -> Callable[[Sequence[Condition]], MisfitTests]:
    """Return a function that gives the misfit tests of the trials so far and trials of these conditions, of which one
    each is simulated.
    """
    unique = list({condition.trial.name: condition for condition in conditions}.values())
    tests = tests_with_conditions(design, unique, design.candidates)
    fit, solution = tests.fit, tests.fit.solution
    place_of = {trial.name: k for k, trial in enumerate(fit.trials)}
    so_far = [place_of[trial.name] for trial in design.trials if trial.name in place_of]

    def with_trials(added: Sequence[Condition]) -> MisfitTests:
        places = [*so_far, *(place_of[condition.trial.name] for condition in added)]
        rows = np.array(places)
        predictor, problem, (state,) = subset(
            fit.predictor, solution.problem, rows, solution.state, every_parameter=True
        )
        columns = tuple(solution.columns[k] for k in places)
        part = replace(
            solution, state=state, problem=problem, cross_products=solution.cross_products[rows], columns=columns
        )
        trials = tuple(fit.trials[k] for k in places)
        of_part = replace(fit, predictor=predictor, solution=part, trials=trials, smooth=None)
        products = tests.products.of(places)
        sensitivities = replace(tests.sensitivities, columns=[tests.sensitivities.columns[k] for k in places])
        scores = scores_of(of_part, products)
        return replace(tests, fit=of_part, products=products, sensitivities=sensitivities, scores=scores)

    return with_trials


def further_trials(
    design: CampaignDesign, now: EffectPower, value: float, target: float, limits: Limits | None = None
) -> FurtherTrials:
    """Find the fewest further trials that give an effect of some size a target power."""
    limits = limits or Limits()
    # 48: most further trials considered where `limits.trials` is not stated (chosen)
    most = (limits.trials if "trials" in limits.model_fields_set else 48) // REPLICATES
    before = now.probability_at(value)
    plan = FurtherTrials(now, value, target, before)
    feasible = feasible_conditions(design.trials, limits)
    if before >= target or not feasible:
        return replace(plan, unlimited=before)
    search = DesignInformation(design, feasible, now.effect)
    deviation = abs(value - now.zero)
    wanted = search.of_design(()) * (abs(now.size_at(target) - now.zero) / deviation) ** 2
    if not math.isfinite(wanted):
        # 4.7: score that a size needs where the trials so far have no information about it (derived)
        wanted = (4.7 / deviation) ** 2
    # 3: searches, each with the required information corrected by the shortfall of the one before (chosen)
    for _ in range(3):
        chosen, needed = search.fewest(wanted, most)
        plan = _evaluated(design, search, replace(plan, n_conditions=len(search.conditions), needed=needed), chosen)
        shortfall = abs(plan.power.size_at(target) - now.zero) / deviation
        if plan.is_reached or not math.isfinite(shortfall) or len(chosen) >= most:
            break
        wanted = 1.02 * search.of_design(chosen) * shortfall**2
    return plan


def _evaluated(
    design: CampaignDesign, search: DesignInformation, plan: FurtherTrials, chosen: Sequence[int]
) -> FurtherTrials:
    """The plan with as many of these trials as needed, and the power after each."""
    conditions = [search.conditions[k] for k in chosen for _ in range(REPLICATES)]
    tests_with = tests_of_designs(design, conditions)
    trials: list[dict[str, Any]] = []
    power, probability = plan.power, plan.before
    while len(trials) < len(conditions) and probability < plan.target:
        power = effect_power(tests_with(conditions[: len(trials) + REPLICATES]), power.effect) or power
        probability = power.probability_at(plan.value)
        for condition in conditions[len(trials) : len(trials) + REPLICATES]:
            cells = _entry(condition, "yield_pressure_kPa", "capture_fps")
            known = {name: value for name, value in cells.items() if value == value}  # NaN is not equal to itself
            trials.append({**known, "probability": probability})
    endless = search.of((search.so_far + UNLIMITED_TRIALS * search.each.sum(axis=0))[None])[0]
    ratio = math.sqrt(endless / max(search.of_design(chosen[: len(trials) // REPLICATES]), 1e-300))
    unlimited = power.probability_at(power.zero + ratio * (plan.value - power.zero))
    return replace(plan, trials=tuple(trials), power=power, unlimited=max(unlimited, probability))
